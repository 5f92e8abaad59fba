"""What `asbuilt excite` designs for the bundled robots in 10, 20 and 40 s, and what recorded
motions were worth beside that; Markdown, also in out/designs.md.

    python benchmarks/designs.py --data ../shared
    python benchmarks/designs.py --only ur10e --only scara
    python benchmarks/run.py designs

Recordings are read from the folder given; where it is absent the second table is left out.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.load import load_robot, robot_names
from asbuilt.dynamics.base.base_parameters import find_base_parameters
from asbuilt.dynamics.drives.drive_set import DriveSet
from asbuilt.excitation.design.design import design_motion
from asbuilt.excitation.design.design_options import DesignOptions
from asbuilt.excitation.design.designed_motion import Design
from asbuilt.excitation.information.information import Information, mean_information
from asbuilt.excitation.information.information_bound import information_efficiency
from asbuilt.excitation.limits import MotionBounds
from asbuilt.experiment.logs.readers import read_recordings
from asbuilt.experiment.signal.preparation import prepare_samples, resolve_chain
from asbuilt.experiment.signal.signal_chain import SignalChain
from drive_terms import CASES, SHARED, UR10E_SHEET

DURATIONS = (10.0, 20.0, 40.0)
LONGEST_PERIOD = 40.0
DRIVE = DriveSet.parse(DesignOptions.drive)
SHOWN = ("position", "velocity", "acceleration", "torque")


class Recorded(NamedTuple):
    """A recorded motion: the robot's description and the files."""

    robot: str
    files: tuple[str, ...]
    case: str


RECORDED = {
    "UR10e, 12 harmonics, 30 s": Recorded(
        "ur10e.urdf", ("ur10e/ur-20_02_10-30sec_12harm.csv",), "UR10e"
    ),
    "UR10e, 12 harmonics, 40 s": Recorded(
        "ur10e.urdf", ("ur10e/ur-20_02_12-40sec_12harm.csv",), "UR10e"
    ),
    "UR10e, 14 harmonics, 50 s": Recorded(
        "ur10e.urdf", ("ur10e/ur-20_02_19_14harm50sec.csv",), "UR10e"
    ),
    "UR10e, point to point": Recorded(
        "ur10e.urdf", ("ur10e/ur-20_01_17-ptp_10_points.csv",), "UR10e"
    ),
    "UR10": Recorded("ur10.urdf", ("ur10_rosbag2/ur10_exciting_trajectory.db3",), "UR10"),
    "LWR4+, first": Recorded("kuka_lwr4.urdf", ("kuka_lwr4/measurements_1.npz",), "LWR4+"),
    "LWR4+, second": Recorded("kuka_lwr4.urdf", ("kuka_lwr4/measurements_2.npz",), "LWR4+"),
    "LBR Med 7, slow": Recorded(
        "lbrstack_med7.urdf", ("lbr_med7/measurements_with_ext_tau_1_dgr.csv",), "LBR Med 7"
    ),
    "LBR Med 7, fast": Recorded("lbrstack_med7.urdf", ("lbr_med7/measurements.csv",), "LBR Med 7"),
}


def measure(
    data: Path = SHARED,
    time_limit: float | None = None,
    only: tuple[str, ...] = (),
    out: Path = Path("out/designs.md"),
) -> dict[str, float | str]:
    """Print the tables row by row, write them, and return efficiencies and condition numbers."""
    out.parent.mkdir(parents=True, exist_ok=True)
    numbers: dict[str, float | str] = {}
    lines: list[str] = []

    def say(*cells: object) -> None:
        lines.append(f"| {' | '.join(map(str, cells))} |" if len(cells) > 1 else str(cells[0]))
        print(lines[-1], flush=True)
        out.write_text("\n".join(lines) + "\n")

    limit = "" if time_limit is None else f" --time-limit {time_limit:g}"
    say(
        f"Fourier series as `asbuilt excite ROBOT --duration S{limit}` designs"
        " them: viscous, Coulomb and offset for every joint, noise 1 N m (N),"
    )
    say(
        "95 % of the limits of motion and 80 % of those of torque allowed; harmonics x periods;"
        " margins on a grid of 1 kHz, as shares of the whole limits."
    )
    say("")
    heads = (
        "robot",
        "duration",
        "harmonics",
        "parameters",
        "found in",
        "searches",
        "log det",
        "of the bound",
        "of the bound for these harmonics",
    )
    say(*heads, "condition number", "scaled", *(f"margin of {quantity}" for quantity in SHOWN))
    say("|" + "---|" * (len(heads) + 2 + len(SHOWN)))
    assumed: dict[str, tuple[str, ...]] = {}
    for robot in [name for name in robot_names() if not only or name in only]:
        for duration in DURATIONS:
            design = design_motion(
                load_robot(robot),
                DesignOptions(duration=duration, time_limit=time_limit),
            )
            worst = design.limits.worst_margin
            if design.assumed:
                assumed[robot] = design.assumed
            say(
                robot,
                f"{duration:g} s",
                f"{design.size}"
                + (f" x {periods}" if (periods := design.options.periods or 1) > 1 else ""),
                design.base.n_base,
                f"{design.solve_seconds:.1f} s",
                len(design.candidates),
                f"{design.log_det:.2f}",
                _percent(design.d_efficiency),
                _percent(design.family_efficiency),
                f"{design.condition_number:.1f}",
                f"{design.scaled_condition_number:.2f}",
                *(
                    _percent(worst[quantity]) + ("*" if quantity in design.assumed else "")
                    for quantity in SHOWN
                ),
            )
            numbers[f"{robot}, {duration:g} s: scaled_condition_number"] = (
                design.scaled_condition_number
            )
            numbers[f"{robot}, {duration:g} s: d_efficiency"] = float(design.d_efficiency or 0.0)
            numbers[f"{robot}, {duration:g} s: worst_margin"] = min(
                margin for margin in worst.values() if margin is not None
            )
    if assumed:
        say("")
        say(
            "\\* limits that the description lacks for some joints: those of"
            " `MotionBounds.assumed`."
        )
    if (data / "data").is_dir():
        numbers |= _beside_recordings(data, time_limit, only, out.parent, say)
    return numbers


def _beside_recordings(
    data: Path,
    time_limit: float | None,
    only: tuple[str, ...],
    scratch: Path,
    say: Callable[..., None],
) -> dict[str, float | str]:
    """Say what recorded motions are worth, and what is designed for the same robot and duration."""
    numbers: dict[str, float | str] = {}
    sheet = scratch / "ur10e_sheet.toml"
    sheet.write_text(UR10E_SHEET)
    say("")
    say(
        "Recorded motions of real robots beside what is designed for the same description and"
        " duration (in periods of at most 40 s): condition number of the"
    )
    say(
        "unweighted observation matrix of the base columns with viscous, Coulomb and offset"
        " columns, as it is and with columns scaled to unit length; information per"
    )
    say(
        "sample as share of the bound; and which share of its velocity limit the joint that is"
        " farthest from it reaches."
    )
    say("")
    heads = (
        "recording",
        "duration",
        "condition number",
        "designed",
        "scaled",
        "designed",
        "of the bound",
        "designed",
        "velocity",
        "designed",
    )
    say(*heads)
    say("|" + "---|" * len(heads))
    for name, recorded in RECORDED.items():
        if only and name not in only:
            continue
        model = load_robot(str(data / "models" / recorded.robot))
        case = CASES[recorded.case]
        options = dict(case.options) | ({"sheet": sheet} if "gain" in case.options else {})
        log = read_recordings(
            [data / "data" / path for path in recorded.files], model=model, **options
        )[0]
        samples = prepare_samples(log, resolve_chain(SignalChain(), log))
        base = find_base_parameters(model, DRIVE)
        mean = mean_information(Information.of(model, base), samples.q, samples.qd, samples.qdd)
        periods = math.ceil(log.duration / LONGEST_PERIOD)
        design = design_motion(
            model,
            DesignOptions(duration=log.duration, periods=periods, time_limit=time_limit),
        )
        share = information_efficiency(model, DRIVE, samples).d_efficiency
        limit = MotionBounds.assumed(model).velocity
        plain, scaled = condition_numbers(mean)
        say(
            name,
            f"{log.duration:.0f} s",
            f"{plain:.0f}",
            f"{design.condition_number:.0f}",
            f"{scaled:.1f}",
            f"{design.scaled_condition_number:.1f}",
            _percent(share),
            _percent(design.d_efficiency),
            _percent(float((np.abs(samples.qd).max(axis=0) / limit).min())),
            _percent(_least_speed(design, limit)),
        )
        numbers[f"{name}: condition_number"], numbers[f"{name}: scaled_condition_number"] = (
            plain,
            scaled,
        )
        numbers[f"{name}: designed condition_number"] = design.condition_number
        numbers[f"{name}: designed scaled_condition_number"] = design.scaled_condition_number
    return numbers


def condition_numbers(mean: Array) -> tuple[float, float]:
    """Return the condition number of an observation matrix W from `W^T W`, as it is and with
    columns of unit length.
    """
    size = 1.0 / np.sqrt(np.diag(mean))
    return float(np.sqrt(np.linalg.cond(mean))), float(
        np.sqrt(np.linalg.cond(mean * np.outer(size, size)))
    )


def _least_speed(design: Design, limit: Array) -> float:
    t = design.motion.sample_times(1000.0)
    return float((np.abs(design.motion.at(t)[1]).max(axis=0) / limit).min())


def _percent(share: float | None) -> str:
    return "" if share is None else f"{100 * share:.1f} %"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--data", type=Path, default=SHARED, help="folder with data/ and models/ in it"
    )
    parser.add_argument("--time-limit", type=float, help="longest time for each design [s]")
    parser.add_argument(
        "--only",
        action="append",
        default=[],
        choices=[*robot_names(), *RECORDED],
        help="this robot or recording only (may be given again)",
    )
    parser.add_argument(
        "--out", type=Path, default=Path("out/designs.md"), help="Markdown file to write"
    )
    arguments = parser.parse_args()
    measure(arguments.data, arguments.time_limit, tuple(arguments.only), arguments.out)
