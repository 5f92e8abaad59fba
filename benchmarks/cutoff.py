"""Held-out torque error with the default cutoff beside that with `--cutoff auto`.

Each recording is swept as `--cutoff auto` does it: blocks of it are held out, and their error is
against the torque as recorded, which no filter makes smaller. The goal is a default whose error is
within 10 % of that of the cutoff chosen so, on every recording.

The default is one rule; its threshold is a factor on the cutoff. Leaving out one robot at a time,
the factor with the least error on the others is applied to the robot left out. A factor of 1 that
is best, or costs next to nothing, shows that the rule does not hang on the robots it was settled
on.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from asbuilt.description.load import load_robot
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.drives.torque import choose_usual_drive
from asbuilt.errors import AsbuiltError
from asbuilt.experiment.logs.readers import read_recordings
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.signal.preparation import resolve_chain
from asbuilt.experiment.signal.signal_chain import SignalChain
from asbuilt.workflow.cutoff_sweep import MULTIPLES, sweep_cutoffs
from drive_terms import SHARED, UR10E_SHEET
from recorded_robots import USUAL

GOAL = 1.1
"""Error of the default over that of `--cutoff auto` that is as good."""
METHOD = "consistent"
"""A quick estimator that leaves no direction to chance; `auto` takes ten times as long."""


class Robot(NamedTuple):
    """Recordings of one robot, each read on its own."""

    description: str
    paths: tuple[tuple[str, ...], ...]
    options: Mapping[str, Any] = MappingProxyType({})


MORE = {
    "LBR Med 7": (
        tuple(
            f"lbr_med7/joint_states_{part}.csv" for part in ("positions", "velocities", "efforts")
        ),
    ),
    "UR10e": (
        ("ur10e/ur-20_02_19_14harm50secLoad.csv",),
        ("ur10e/ur-20_01_31-load.csv",),
    ),
}
"""Recordings beside those of `recorded_robots`."""
ALONE = {
    "UR10": Robot(
        "ur10.urdf",
        (("ur10_rosbag2/ur10_exciting_trajectory.db3",),),
        MappingProxyType({"torque_source": "motor"}),
    ),
    "Rokae": Robot(
        "rokae_xmate.toml",
        (("rokae_two_channels/rokae_a.csv",), ("rokae_two_channels/rokae_a_motor.csv",)),
    ),
    "TX40": Robot("staubli_tx40.toml", (("tx40/tx40.csv",),)),
}


class Row(NamedTuple):
    """Say what the default cutoff [Hz] costs on one recording.

    `factors` and `scores` are the cutoffs tried in multiples of the default, and their held-out
    errors over the least.
    """

    robot: str
    recording: str
    default: float
    chosen: float
    factors: tuple[float, ...]
    scores: tuple[float, ...]

    def score(self, factor: float) -> float:
        """Return the error at a multiple of the default; past the last one tried, of that one."""
        return float(np.interp(np.log(factor), np.log(self.factors), self.scores))

    @property
    def ratio(self) -> float:
        """Error of the default over that of the cutoff chosen."""
        return self.score(1.0) / self.score(self.chosen / self.default)

    @property
    def text(self) -> str:
        """One line of the table."""
        return (
            f"{self.robot:<10} {self.recording:<40} {self.default:7.2f} {self.chosen:7.2f}"
            f" {100 * (self.ratio - 1.0):+7.1f} {'' if self.ratio <= GOAL else 'ABOVE'}"
        )


def robots() -> dict[str, Robot]:
    """Return all robots and their recordings of torque."""
    known = {
        name: Robot(
            robot.description,
            (*((f"{robot.folder}/{each}",) for each in robot.recordings), *MORE.get(name, ())),
            robot.options,
        )
        for name, robot in USUAL.items()
    }
    return known | ALONE


def recordings(
    data: Path, scratch: Path, names: tuple[str, ...] = ()
) -> Iterator[tuple[str, RobotModel, Recording]]:
    """Yield all recordings with the name and model of their robot."""
    for name, robot in robots().items():
        if names and name not in names:
            continue
        model, options = load_robot(str(data / "models" / robot.description)), dict(robot.options)
        if "gain" in options:
            options["sheet"] = scratch / "ur10e_sheet.toml"
            options["sheet"].write_text(UR10E_SHEET)
        elif "sheet" in options:
            options["sheet"] = (data / "data" / robot.paths[0][0]).with_name(options["sheet"])
        for paths in robot.paths:
            own = dict(options)
            if len(paths) > 1:
                own.pop("rate", None)
            yield (
                name,
                model,
                read_recordings([data / "data" / each for each in paths], model=model, **own)[0],
            )


def swept(name: str, model: RobotModel, recording: Recording, method: str) -> Row:
    """Return what the default cutoff costs on a recording."""
    default = resolve_chain(SignalChain(), recording).cutoff
    assert default is not None
    sweep = sweep_cutoffs(
        model, [recording], drive=choose_usual_drive(model, recording.torque_source), method=method
    )
    return Row(
        name,
        recording.source.rpartition("/")[2],
        default,
        sweep.chosen,
        tuple(trial.cutoff / default for trial in sweep.trials),
        tuple(trial.score for trial in sweep.trials),
    )


def cost(rows: list[Row], factor: float) -> float:
    """Return the mean over robots of the logarithm of the error at a factor, over the least."""
    means = [
        np.mean([np.log(row.score(factor)) for row in rows if row.robot == name])
        for name in {row.robot for row in rows}
    ]
    return float(np.mean(means))


def left_out(rows: list[Row]) -> dict[str, tuple[float, float, float]]:
    """Return the factor best for all other robots, and the errors with it and with 1, by robot."""
    found = {}
    for name in dict.fromkeys(row.robot for row in rows):
        own = [row for row in rows if row.robot == name]
        others = [row for row in rows if row.robot != name]
        if others:
            best = min(MULTIPLES, key=lambda factor: cost(others, factor))
            found[name] = (best, float(np.exp(cost(own, best))), float(np.exp(cost(own, 1.0))))
    return found


def measure(
    data: Path = SHARED, names: tuple[str, ...] = (), method: str = METHOD
) -> dict[str, float | str]:
    """Print the tables, and return the ratio of every recording and the factors of every robot."""
    if not (data / "data").is_dir():
        return {"skipped": "no recordings beside the repository"}
    scratch = Path("out")
    scratch.mkdir(exist_ok=True)
    rows: list[Row] = []
    print(f"{'robot':<10} {'recording':<40} {'default':>7} {'auto':>7} {'ratio':>7}")
    print(f"{'':<51} {'Hz':>7} {'Hz':>7} {'%':>7}")
    for name, model, recording in recordings(data, scratch, names):
        try:
            rows.append(swept(name, model, recording, method))
        except AsbuiltError as problem:
            print(f"{name:<10} {recording.source.rpartition('/')[2]:<40} {problem}")
            continue
        print(rows[-1].text, flush=True)
    numbers: dict[str, float | str] = {f"{row.robot}: {row.recording}": row.ratio for row in rows}
    numbers["worst"] = max(row.ratio for row in rows)
    print("\nleft out   best factor of the others   error with it   with 1 (over the least)")
    for name, (factor, with_it, as_is) in left_out(rows).items():
        print(f"{name:<10} {factor:27.2g} {with_it:15.3f} {as_is:8.3f}")
        numbers[f"{name}: left out"], numbers[f"{name}: as it is"] = with_it, as_is
    return numbers


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=SHARED)
    parser.add_argument("--method", default=METHOD)
    parser.add_argument("robots", nargs="*", help="robots (default: all)")
    arguments = parser.parse_args()
    measure(arguments.data, tuple(arguments.robots), arguments.method)
