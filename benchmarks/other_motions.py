"""Relative torque error on other motions of the same robot, by estimator, beside CAD.

Each recording is identified with the default signal chain and drive terms, and the others of the
same robot are predicted; `plain` is weighted least squares with a 5 Hz cutoff. What is predicted is
filtered like what was fitted; `auto, same samples` is `auto` on the samples of `plain`, since a
lower cutoff takes error away from any model. Recordings that repeat the motion fitted are marked
with `=`: they tell how well that motion is fitted, not how well another one is predicted. The mass
is that of the exported robot in masses of CAD, with the ratio of the link furthest from CAD.

How much worse `auto` is than `plain` and than CAD has a standard error, from the paired differences
of time blocks of the recording predicted.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from scipy.special import stdtr

from asbuilt.arrays import Array
from asbuilt.description.load import load_robot
from asbuilt.dynamics.drives.torque import choose_usual_drive
from asbuilt.errors import AsbuiltError
from asbuilt.experiment.logs.readers import read_recordings
from asbuilt.experiment.signal.preparation import prepare_samples, resolve_chain
from asbuilt.experiment.signal.signal_chain import SignalChain
from asbuilt.identification.effects.search import find_effects
from asbuilt.identification.identify import identify_samples
from asbuilt.identification.result.result import IdentificationResult
from asbuilt.validation.generalisation.coverage import measure_repeated_share
from asbuilt.validation.prediction import Validation, validate_samples
from asbuilt.workflow.delays import settle_delays
from asbuilt.workflow.prepare import digest_recording
from asbuilt.writers.tables.mass_tables import exported_masses
from drive_terms import SHARED, UR10E_SHEET

METHODS = ("auto", "wls", "consistent")
PLAIN_CUTOFF = 5.0
SAME = "auto, same samples"
REPEATED = 0.5
"""Share of states near those fitted from which on a recording repeats the motion."""
BLOCKS, SHORTEST = 20, 1.0
"""Time blocks of a recording predicted, and the least length of one [s]."""


class Robot(NamedTuple):
    """Recordings of one robot: sets to identify from, and whether its mounting is estimated too."""

    description: str
    folder: str
    recordings: tuple[str, ...]
    sets: tuple[tuple[int, ...], ...] = ()
    tilt: bool = False
    options: Mapping[str, Any] = MappingProxyType({})


ROBOTS = {
    "LWR4+": Robot(
        "kuka_lwr4.urdf",
        "kuka_lwr4",
        ("measurements_1.npz", "measurements_2.npz", "measurements_3.npz"),
        sets=((0, 1),),
        tilt=True,
    ),
    "LBR Med 7": Robot(
        "lbrstack_med7.urdf",
        "lbr_med7",
        ("measurements_with_ext_tau_1_dgr.csv", "measurements.csv"),
        tilt=True,
        options={"rate": 100.0, "flip_torque": True},
    ),
    "UR10e": Robot(
        "ur10e.urdf",
        "ur10e",
        (
            "ur-20_02_10-30sec_12harm.csv",
            "ur-20_02_12-40sec_12harm.csv",
            "ur-20_01_17-ptp_10_points.csv",
            "ur-20_02_19_14harm50sec.csv",
            "ur-20_01_31-unload.csv",
        ),
        options={"gain": [14.87, 13.26, 11.13, 10.62, 11.03, 11.47]},
    ),
    "AIRBOT": Robot(
        "airbot/airbot_play.urdf",
        "airbot",
        (
            "vali_ga_N12T25.csv",
            "vali_opt.csv",
            "vali_ptrnSrch_N7T25QR-5.csv",
            "vali_ptrnSrch_N8T25QR-8.csv",
        ),
        options={"sheet": "sheet.toml"},
    ),
}


class Excess(NamedTuple):
    """Relative torque error over that of another model, less 1, with its standard error."""

    value: float
    error: float

    @property
    def sure(self) -> bool:
        """Whether the error is larger beyond one standard error."""
        return self.value > self.error

    @property
    def text(self) -> str:
        """The excess in percent."""
        return f"{100 * self.value:+.1f} +- {100 * self.error:.1f} %"


class Row(NamedTuple):
    """Errors [%] on the other recordings, by method, of one set of recordings.

    `repeated` are the shares of their states that the motion fitted came near to. `excess` is the
    error of `auto` over that of `plain` on the same samples, and over that of CAD.
    """

    robot: str
    train: str
    errors: dict[str, tuple[float, ...]]
    masses: dict[str, str]
    took: str
    seconds: float
    repeated: tuple[float, ...]
    excess: dict[str, tuple[Excess, ...]]

    def on_other_motions(self, over: str) -> list[Excess]:
        """Return the excess over `plain` or CAD on recordings that do not repeat the motion."""
        pairs = zip(self.excess[over], self.repeated, strict=True)
        return [each for each, near in pairs if near < REPEATED]


def excess_over(own: Array, other: Array, t: Array) -> Excess:
    """Return the relative error of residuals `own` over that of `other`, both (N, n), less 1.

    With the energies `a_b`, `p_b` of the time blocks and `r = sum a / sum p`, the variance of r is
    that of `sum (a_b - r p_b) / sum p`.
    """
    seconds = max(SHORTEST, float(t[-1] - t[0]) / BLOCKS)
    block = np.unique(np.floor((t - t[0]) / seconds + 1e-9), return_inverse=True)[1]
    a, p = (np.bincount(block, np.sum(each**2, axis=1)) for each in (own, other))
    r, n = float(a.sum() / p.sum()), len(a)
    spread = float(np.sqrt(np.sum((a - r * p) ** 2) * n / max(n - 1, 1)) / p.sum())
    return Excess(float(np.sqrt(r)) - 1.0, 0.5 * spread / float(np.sqrt(r)))


def rows(
    data: Path, scratch: Path, names: tuple[str, ...] = (), delay: str | None = "auto"
) -> Iterator[Row]:
    """Yield the errors of every set of recordings of every robot."""
    for name, robot in ROBOTS.items():
        if names and name not in names:
            continue
        model = load_robot(str(data / "models" / robot.description))
        options = dict(robot.options)
        folder = data / "data" / robot.folder
        if "gain" in options:
            options["sheet"] = scratch / "ur10e_sheet.toml"
            options["sheet"].write_text(UR10E_SHEET)
        elif "sheet" in options:
            options["sheet"] = folder / options["sheet"]
        logs = [
            read_recordings([folder / each], model=model, **options)[0] for each in robot.recordings
        ]
        for train in (*((k,) for k in range(len(logs))), *robot.sets):
            for tilt in (False, True) if robot.tilt else (False,):
                yield _row(name, model, logs, train, tilt, delay)


def _row(
    name: str, model: Any, logs: list[Any], train: tuple[int, ...], tilt: bool, delay: str | None
) -> Row:
    others = [k for k in range(len(logs)) if k not in train]
    errors: dict[str, tuple[float, ...]] = {}
    masses: dict[str, str] = {}
    took, seconds = "", 0.0
    repeated: tuple[float, ...] = ()
    excess: dict[str, tuple[Excess, ...]] = {}
    best = None
    for cutoff, methods in ((None, METHODS), (PLAIN_CUTOFF, ("plain", "auto"))):
        chain = resolve_chain(SignalChain(cutoff=cutoff, delay=delay), *(logs[k] for k in train))
        heads = [logs[k] for k in train]
        late = settle_delays(model, heads, [digest_recording(head) for head in heads], chain, None)
        used, held = (
            [
                late.applied(prepare_samples(logs[k], late.chain_of(own)), own)
                for k in which
                for own in (digest_recording(logs[k]),)
            ]
            for which in (train, others)
        )
        drive = choose_usual_drive(model, logs[0].torque_source)
        tilted = {"tilt"} if tilt else set()
        own = find_effects(model, drive, used, keys=tilted, stated=tilted).model
        for method in methods:
            label = method if cutoff is None or method == "plain" else f"{method} {cutoff:g} Hz"
            start = time.perf_counter()
            try:
                result = identify_samples(
                    own, used, drive=drive, method="wls" if method == "plain" else method
                )
            except AsbuiltError as problem:
                errors[label] = (np.nan,) * len(held)
                took += f" {label}: {problem}"
                continue
            if label == "auto":
                seconds = time.perf_counter() - start
                took = "delay " + ", ".join(each.text for each in late.recordings) + "; "
                took += result.notes[0].removeprefix("Chosen automatically: ").split(" predicts")[0]
            if label == "auto":
                best = result
                repeated = tuple(measure_repeated_share(used, each) for each in held)
            found = [validate_samples(result, each) for each in held]
            errors[label] = tuple(100 * each.metrics_as_built.relative_error for each in found)
            masses[label] = mass_text(result)
            if label == "auto":
                errors["CAD"] = tuple(100 * each.metrics_cad.relative_error for each in found)
                excess["CAD"] = tuple(
                    excess_over(each.error, each.measured - each.predicted_cad, each.t)
                    for each in found
                )
            if label == "plain" and best is not None:
                again = [validate_samples(best, each) for each in held]
                errors[SAME] = tuple(100 * each.metrics_as_built.relative_error for each in again)
                excess["plain"] = _paired(again, found)
    label = "+".join(logs[k].source.rpartition("/")[2] for k in train)
    told = label + (", tilt" if tilt else "")
    return Row(name, told, errors, masses, took, seconds, repeated, excess)


def _paired(own: list[Validation], other: list[Validation]) -> tuple[Excess, ...]:
    return tuple(
        excess_over(each.error, beside.error, each.t)
        for each, beside in zip(own, other, strict=True)
    )


def mass_text(result: IdentificationResult) -> str:
    """Return total mass in that of CAD, and the ratio of the link furthest from CAD."""
    masses = exported_masses(result)
    if masses is None or masses.total_cad is None:
        return "none"
    _, cad, built = zip(*masses.links, strict=True)
    ratios = np.array(built) / np.array(cad, dtype=np.float64)
    worst = float(np.max(np.maximum(ratios, 1.0 / ratios))) if ratios.min() > 0.0 else np.inf
    return f"{masses.total_as_built / masses.total_cad:.2f} ({worst:.1f})"


def measure(data: Path = SHARED) -> dict[str, float | str]:
    """Return the mean relative error [%] of each method on other motions, by robot."""
    if not (data / "data").is_dir():
        return {"skipped": "no recordings beside the repository"}
    return report(data, ())


def report(
    data: Path, names: tuple[str, ...], delay: str | None = "auto"
) -> dict[str, float | str]:
    """Print the table, and return the means."""
    scratch = Path("out")
    scratch.mkdir(exist_ok=True)
    found: dict[tuple[str, str], list[float]] = {}
    excess: dict[tuple[str, str], list[Excess]] = {}
    for row in rows(data, scratch, names, delay):
        for over in row.excess:
            excess.setdefault((row.robot, over), []).extend(row.on_other_motions(over))
        print(f"{row.robot} from {row.train}: {row.took} ({row.seconds:.1f} s)")
        for method, errors in row.errors.items():
            found.setdefault((row.robot, method), []).extend(errors)
            listed = " ".join(
                f"{error:7.2f}{'=' if near >= REPEATED else ' '}"
                for error, near in zip(errors, row.repeated, strict=True)
            )
            print(f"    {method:<20}{listed}   mass {row.masses.get(method, '')}", flush=True)
        for over, each in row.excess.items():
            print(f"    auto over {over:<10}{', '.join(one.text for one in each)}", flush=True)
    numbers: dict[str, float | str] = {
        f"{robot}_{method}_percent": float(np.mean(errors))
        for (robot, method), errors in found.items()
    }
    for (robot, over), each in excess.items():
        values = 100 * np.array([one.value for one in each])
        mean, error = float(values.mean()), float(values.std(ddof=1) / np.sqrt(len(values)))
        worse = [one.text for one in each if one.sure]
        print(
            f"{robot}: error of auto over that of {over} on the same samples of {len(each)} other"
            f" motions: {mean:+.1f} +- {error:.1f} % (worst {values.max():+.1f} %); larger beyond"
            f" one standard error: {', '.join(worse) or 'nowhere'}"
        )
        numbers[f"{robot}_auto_over_{over}_percent"] = mean
        numbers[f"{robot}_worse_than_{over}"] = float(len(worse))
    for over in ("plain", "CAD"):
        together = [one for (_, which), each in excess.items() if which == over for one in each]
        surest = max(one.value / one.error for one in together)
        p = min(1.0, float(stdtr(BLOCKS - 1, -surest)) * len(together))
        print(
            f"auto over {over}: larger beyond one standard error in {sum(e.sure for e in together)}"
            f" of {len(together)} (by chance in 16 %), by {surest:.1f} of them at most (p = {p:.2g}"
            " for as many comparisons)"
        )
        numbers[f"worse_than_{over}_p"] = p
    return numbers


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=SHARED)
    parser.add_argument("robots", nargs="*", help="robots (default: all)")
    parser.add_argument("--delay", choices=("auto", "none"), default="auto")
    arguments = parser.parse_args()
    delay = None if arguments.delay == "none" else arguments.delay
    report(arguments.data, tuple(arguments.robots), delay)
