"""Held-out torque errors of real robots, per joint, by every way to identify them, beside those of
a plain fit; Markdown, also in out/recordings.md.

    python benchmarks/run.py recordings --data ../shared
    python benchmarks/recordings.py --data ../shared --only "LWR4+" --out table.md

Recordings are read from the folder given; where it is absent nothing is measured. The figures of
the plain fit, of the manufacturer's model and of CAD that stand in front are those of
`data/README.md` in that folder.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Literal, NamedTuple

from asbuilt.description.load import load_robot
from asbuilt.description.model import RobotModel
from asbuilt.errors import AsbuiltError
from asbuilt.experiment.logs.readers import read_recordings
from asbuilt.identification.result.torque_prediction import TorqueMetrics
from asbuilt.workflow.study import StudyOptions, identify
from drive_terms import CASES as TERM_CASES
from drive_terms import SHARED, UR10E_SHEET, Case

UR10E = TERM_CASES["UR10e"]
CASES = {
    "LBR Med 7, slow": TERM_CASES["LBR Med 7"],
    "LBR Med 7, fast, 16 s": TERM_CASES["LBR Med 7, short"],
    "LBR Med 7, joints moving alike": Case(
        "lbrstack_med7.urdf",
        tuple(
            f"lbr_med7/joint_states_{part}.csv" for part in ("positions", "velocities", "efforts")
        ),
        holdout="blocks:5s:3",
        options={"flip_torque": True},
    ),
    "LWR4+": TERM_CASES["LWR4+"],
    "LWR4+, the other way round": Case(
        "kuka_lwr4.urdf", ("kuka_lwr4/measurements_2.npz",), ("kuka_lwr4/measurements_1.npz",)
    ),
    "UR10e": UR10E._replace(judged=(*UR10E.judged, "ur10e/ur-20_02_19_14harm50sec.csv")),
    "UR10e under load": UR10E._replace(
        train=("ur10e/ur-20_02_19_14harm50secLoad.csv",), judged=(), holdout="blocks:5s:3"
    ),
    "UR10": TERM_CASES["UR10"],
}
PLAIN = "plain fit"
STATED: dict[str, dict[tuple[str, str], tuple[float, ...]]] = {
    "LBR Med 7, slow": {
        (PLAIN, ""): (0.55, 0.41, 0.36, 0.40, 0.13, 0.09, 0.09),
        ("manufacturer's model", ""): (0.72, 1.01, 0.43, 0.78, 0.26, 0.22, 0.27),
        ("CAD", ""): (0.72, 4.63, 0.64, 3.08, 0.42, 0.40, 0.27),
    },
    "LWR4+": {
        (f"{PLAIN}, with a third recording", ""): (0.31, 0.27, 0.28, 0.18, 0.25, 0.19, 0.19),
        ("CAD", ""): (1.32, 1.77, 0.80, 0.82, 1.11, 0.92, 0.29),
    },
    "UR10e": {
        (PLAIN, "ur-20_02_12-40sec_12harm.csv"): (2.24, 3.68, 1.72, 0.34, 0.37, 0.31),
        (PLAIN, "ur-20_01_17-ptp_10_points.csv"): (2.36, 3.49, 1.37, 0.26, 1.13, 1.44),
    },
}
"""RMS errors [N m] that data/README.md states.

By case, then what they are of and the recording where there are several.
"""
"""How a warning names springs that it suspects, from the data used alone."""
HALF_A_DIGIT = 0.005
"""Stated errors have two decimals; an error up to this much larger is not above them."""
REAL = "yes"


class Way(NamedTuple):
    """One way to identify: estimator, drive terms where they are not the default ones, whether the
    mounting is estimated.
    """

    method: str
    drive: str | None = None
    mounting: bool = False

    def __str__(self) -> str:
        drive = f", drive {self.drive}" if self.drive else ""
        return f"{self.method}{drive}{', mounting' if self.mounting else ''}"


WAYS = (Way("wls"), Way("consistent"), Way("auto"), Way("auto", "auto"))


class Row(NamedTuple):
    """Say how one recording is predicted.

    By `way`, which took `method`, whose parameters `bodies` can or cannot have; or what went wrong.
    """

    way: str
    judged: str = "as below"
    method: str = ""
    bodies: str = ""
    metrics: TorqueMetrics | None = None
    seconds: float | None = None
    problem: str = ""

    def as_markdown(self, n_joints: int, plain: tuple[float, ...] | None) -> str:
        """Return a line of the table."""
        if self.metrics is None:
            return _line([self.way, self.judged, self.problem, *[""] * (n_joints + 4)])
        errors = [
            f"{band:.3g} ({logged:.3g})"
            for band, logged in zip(self.metrics.rms, self.metrics.rms_recorded, strict=True)
        ]
        above = ""
        if plain is not None:
            above = (
                " ".join(
                    str(k + 1)
                    for k in range(n_joints)
                    if self.metrics.rms[k] > plain[k] + HALF_A_DIGIT
                )
                or "none"
            )
        relative, took = (
            f"{100 * self.metrics.relative_error:.2f} %",
            "" if self.seconds is None else f"{self.seconds:.1f}",
        )
        return _line(
            [self.way, self.judged, self.method, self.bodies, relative, *errors, above, took]
        )


def measure(
    data: Path = SHARED, only: tuple[str, ...] = (), out: Path = Path("out/recordings.md")
) -> dict[str, float | str]:
    """Print the tables row by row, write them, and return the held-out relative errors and how many
    results real bodies have.
    """
    if not (data / "data").is_dir():
        return {
            "skipped": (
                f"no recordings: there is no folder {data / 'data'}; give --data FOLDER with data/"
                " and models/ in it"
            )
        }
    out.parent.mkdir(parents=True, exist_ok=True)
    numbers: dict[str, float | str] = {}
    lines: list[str] = []

    def say(line: str) -> None:
        lines.append(line)
        print(line, flush=True)
        out.write_text("\n".join(lines) + "\n")

    say(
        "Held-out RMS torque errors [N m] in the band that the filter passes, in brackets against"
        " the torque as logged. Mounting is estimated where"
    )
    say(
        "a study finds the robot askew, and springs are taken where it suspects them. *above* lists"
        " the joints whose error is above that of the plain fit."
    )
    real = total = 0
    for name in only or tuple(CASES):
        case = CASES[name]
        model = load_robot(str(data / "models" / case.robot))
        n, stated = model.n_joints, STATED.get(name, {})
        say(f"\n### {name}\n")
        say(
            _line(
                [
                    "method",
                    "judged by",
                    "taken",
                    "real bodies",
                    "relative error",
                    *(str(k + 1) for k in range(n)),
                    "above",
                    "s",
                ]
            )
        )
        say("|" + "---|" * (n + 7))
        for (what, where), errors in stated.items():
            say(
                _line(
                    [
                        f"before: {what}",
                        where,
                        "",
                        "",
                        "",
                        *(f"{error:.2f}" for error in errors),
                        "",
                        "",
                    ]
                )
            )
        for row in rows(model, data / "data", case, out.parent):
            plain = next(
                (
                    errors
                    for (what, where), errors in stated.items()
                    if what.startswith(PLAIN) and where in ("", row.judged)
                ),
                None,
            )
            say(row.as_markdown(n, plain))
            if row.metrics is not None and row.seconds is not None:
                numbers[f"{name}: {row.way}, {row.judged}"] = row.metrics.relative_error
                real, total = real + (row.bodies == REAL), total + 1
    say(f"\n{real} of {total} rows are of results that real bodies have.")
    numbers["rows_of_real_bodies"], numbers["rows"] = float(real), float(total)
    return numbers


def rows(model: RobotModel, data: Path, case: Case, scratch: Path) -> Iterator[Row]:
    """Yield how CAD, then every way, predicts each recording that the case is judged by."""
    options = dict(case.options)
    if "gain" in options:
        options["sheet"] = scratch / "ur10e_sheet.toml"
        options["sheet"].write_text(UR10E_SHEET)
    logs = read_recordings([data / path for path in case.train], model=model, **options)
    judges = [read_recordings([data / path], model=model, **options)[0] for path in case.judged]
    ways, cad_shown = list(WAYS), False
    for way in ways:
        start = time.perf_counter()
        mounting: Literal["as_described", "estimate"] = (
            "estimate" if way.mounting else "as_described"
        )
        chosen = StudyOptions(
            method=way.method,
            drive=way.drive,
            holdout=case.holdout,
            mounting=mounting,
            effects="find",
        )
        try:
            study = identify(model, logs, validation=judges, options=chosen)
        except AsbuiltError as problem:
            yield Row(str(way), problem=str(problem))
            continue
        seconds, result = time.perf_counter() - start, study.result
        if not cad_shown:
            yield from (
                Row("CAD", _judged(each.source), metrics=each.metrics_cad)
                for each in study.validations
            )
            cad_shown = True
        named = [(each.effect, each.joint) for each in study.effects]
        if ("tilt", None) in named and not any(each.mounting for each in ways):
            ways += [way._replace(mounting=True) for way in WAYS]
        sprung = [model.joint_names.index(joint) + 1 for key, joint in named if key == "spring"]
        if sprung and not any("spring" in (each.drive or "") for each in ways):
            springs = f"auto,spring:joints={'/'.join(map(str, sorted(sprung)))}"
            ways.append(Way("auto", springs, any(each.mounting for each in ways)))
        bodies = {
            True: REAL,
            False: f"**no** ({result.consistency_margin:.2g})",
            None: "not decided",
        }[result.physically_consistent]
        for each in study.validations:
            yield Row(
                str(way),
                _judged(each.source),
                result.method,
                bodies,
                each.metrics_as_built,
                seconds,
            )


def _judged(source: str) -> str:
    path, held, rule = source.partition(", held out ")
    return f"held out {rule}" if held else Path(path).name


def _line(cells: list[str]) -> str:
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--data", type=Path, default=SHARED, help="folder with data/ and models/ in it"
    )
    parser.add_argument(
        "--only",
        action="append",
        default=[],
        choices=list(CASES),
        help="this case only (may be given again)",
    )
    parser.add_argument(
        "--out", type=Path, default=Path("out/recordings.md"), help="Markdown file to write"
    )
    arguments = parser.parse_args()
    found = measure(arguments.data, tuple(arguments.only), arguments.out)
    if "skipped" in found:
        print(f"skipped: {found['skipped']}")
