"""Whether "USE" can be trusted: what a verdict promises beside the error on another motion.

Robots whose torque Pinocchio computes, with effects of ordinary size that CAD lacks
(`benchmarks/effects.py`), and recordings of real robots that moved in another way too. Each is
identified from one log with the defaults. "USE" is right if the exported robot predicts another
motion with at most 1.5 times the promised error; a model is good if it predicts another motion
better than CAD, and then must not be refused.

    python benchmarks/verdicts.py --robots 60 --out out/verdicts.jsonl
    python benchmarks/verdicts.py --recorded UR10e AIRBOT --out out/recorded.jsonl

A recording of a robot with a single motion promises by its first part, and its rest is the other
motion. Logs of two arms of one make promise nothing of each other, and are left out.

Rows are added to the file, and cases that it has are not measured again. Rules were settled on the
virtual robots below 30, the LWR4+, the UR10e and the Kinova; the others are the test. "UNTESTED"
promises nothing, and is right where no other motion was given.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any

import numpy as np

from asbuilt.description.model import RobotModel
from asbuilt.errors import AsbuiltError
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.signal.preparation import prepare_samples
from asbuilt.identification.result.torque_prediction import TorqueMetrics
from asbuilt.validation.generalisation.coverage import measure_repeated_share
from asbuilt.validation.verdicts.reasons import DIMMING, OF_MOTION
from asbuilt.workflow.study import Study, identify
from asbuilt.workflow.study_options import ValidationOptions
from asbuilt.workflow.validation import validate
from drive_terms import SHARED
from effects import case
from measurements import count
from other_motions import REPEATED
from recorded_robots import ROBOTS, SINGLE, recorded_robots, sets_of

TRUSTED = 1.5
"""Error on another motion, in multiples of what was promised, up to which "USE" is right."""
SAID = tuple(DIMMING[code] for code in sorted(OF_MOTION & DIMMING.keys()))
"""What the first line says if other motion may have another error."""
FIRST_PART = 0.6
"""Part of a single motion that is identified from."""
SETTLED_ON = (*(str(k) for k in range(30)), "LWR4+", "UR10e", "Kinova")
"""Cases by which the rules were settled."""


@dataclass(frozen=True)
class Row:
    """One model: its verdict, and the errors of its export and of CAD on another motion."""

    case: str
    other: str
    use: str
    text: str
    reasons: tuple[str, ...]
    promised: float | None
    error: float | None
    cad: float
    torque_ratio: float = np.nan
    repeats: bool = False
    problem: str = ""

    @property
    def group(self) -> str:
        """Name of the robot."""
        return self.case.partition(" ")[0]

    @property
    def ratio(self) -> float:
        """Error on the other motion in multiples of what was promised."""
        return (self.error or np.nan) / (self.promised or np.nan)

    @property
    def right(self) -> bool:
        """Whether the first line is true: the promise holds, or it says why it may not."""
        said = self.use == "untested" or any(phrase in self.text for phrase in SAID)
        return said or self.ratio <= TRUSTED

    @property
    def good(self) -> bool:
        """Whether the model predicts the other motion better than CAD."""
        return (self.error or np.inf) < self.cad


def virtual_rows(numbers: Iterable[int], known: set[str]) -> Iterator[Row]:
    """Yield the rows of virtual robots by number."""
    for number in numbers:
        if str(number) in known:
            continue
        drawn = case(number)
        try:
            study = identify(drawn.cad, drawn.log)
            yield _row(str(number), "other", study, drawn.other)
        except AsbuiltError as problem:
            yield _failed(str(number), problem)


def recorded_rows(
    names: Sequence[str], known: set[str], validated: bool, data: Path = SHARED
) -> Iterator[Row]:
    """Yield the rows of recordings: each set identified from, with each other motion.

    With `validated` the next recording validates, and the others are what the promise is about.
    """
    for name, robot, model, logs in recorded_robots(names or (*ROBOTS, *SINGLE), data):
        if robot.holdout:
            yield from divided_rows(name, model, logs, known)
        if robot.holdout or robot.two_arms:
            continue
        pairs = tuple(combinations(range(len(logs)), 2)) if 2 < len(logs) < 6 else ()
        for train in dict.fromkeys((*sets_of(robot), *pairs)):
            label = f"{name} {'+'.join(Path(logs[k].source).stem for k in train)}"
            judges = [(max(train) + 1) % len(logs)] if validated else []
            label += "".join(f" | {Path(logs[k].source).stem}" for k in judges)
            others = [k for k in range(len(logs)) if k not in (*train, *judges)]
            if label in known or not others:
                continue
            try:
                study = identify(
                    model,
                    [logs[k] for k in train],
                    validation=[logs[k] for k in judges],
                    checked=False,
                )
            except AsbuiltError as problem:
                yield _failed(label, problem)
                continue
            used = [logs[k] for k in train]
            for k in others:
                other = Path(logs[k].source).stem
                yield _row(label, other, study, logs[k], _repeats(study, used, logs[k]))


def divided_rows(
    name: str, model: RobotModel, logs: Sequence[Recording], known: set[str]
) -> Iterator[Row]:
    """Yield the rows of recordings whose first part is identified from, and the rest predicted."""
    for log in logs:
        label = f"{name} {Path(log.source).stem}, first part"
        if label in known:
            continue
        parts = *np.quantile(log.t, (0.0, FIRST_PART)), log.t[-1]
        first, rest = (
            replace(log.between(*span), source=f"{log.source}, {name}")
            for name, span in zip(("first part", "rest"), pairwise(parts), strict=True)
        )
        try:
            study = identify(model, first, checked=False)
            yield _row(label, "rest", study, rest, _repeats(study, [first], rest))
        except AsbuiltError as problem:
            yield _failed(label, problem)


def _repeats(study: Study, used: Sequence[Recording], other: Recording) -> bool:
    """Return whether a recording is of the motion fitted."""
    chain = study.result.chain
    before = [prepare_samples(log, chain) for log in used]
    return measure_repeated_share(before, prepare_samples(other, chain)) >= REPEATED


def _row(label: str, other: str, study: Study, log: Any, repeats: bool = False) -> Row:
    (found,) = validate(study, log, options=ValidationOptions(checked=False))
    exported = found.metrics_exported or found.metrics_as_built
    verdict = study.verdict
    return Row(
        label,
        other,
        verdict.use,
        verdict.text,
        verdict.reasons,
        verdict.error.decisive,
        exported.relative_error,
        found.metrics_cad.relative_error,
        _rms(exported) / _promised_rms(study),
        repeats,
    )


def _rms(metrics: TorqueMetrics) -> float:
    """Return the RMS torque error of all joints together [N m]."""
    return float(np.sqrt(np.nansum(metrics.rms**2)))


def _promised_rms(study: Study) -> float:
    """Return the RMS torque error [N m] of the recording that the promise goes by."""
    each = [one.metrics_exported or one.metrics_as_built for one in study.validations]
    if not each or study.verdict.use == "untested":
        return np.nan
    return _rms(max(each, key=lambda one: one.relative_error))


def _failed(label: str, problem: AsbuiltError) -> Row:
    text = f"{type(problem).__name__}: {problem}"
    return Row(label, "", "", "", (), None, None, np.inf, problem=text[:200])


def report(rows: Sequence[Row]) -> dict[str, float]:
    """Print the counts of settled and tested cases, and return those of the test."""
    numbers: dict[str, float] = {}
    whole = [each for each in rows if not each.problem and not each.repeats]
    for kind, wanted in (("settled on", True), ("tested", False)):
        part = [each for each in whole if (each.group in SETTLED_ON) == wanted]
        print(f"{kind}: {len({each.case for each in part})} models, {len(part)} other motions")
        true = sum(each.right for each in part)
        if part:
            print(f"    the first line is true in {count([each.right for each in part])}")
            tested = [each.ratio <= TRUSTED for each in part if each.use != "untested"]
            print(f"    the promise alone holds in {count(tested)}")
        numbers[f"{kind} right"] = true
        for use in ("yes", "with care", "untested", "no"):
            some = [each for each in part if each.use == use]
            right = sum(each.ratio <= TRUSTED for each in some)
            good = sum(each.good for each in some)
            newton = sum(each.torque_ratio <= TRUSTED for each in some)
            print(
                f"    {use:<10}{len(some):>4}; promise holds in {right} (in N m {newton}), better"
                f" than CAD {good},"
                f" median error / promise {np.median([e.ratio for e in some] or [np.nan]):.2f}"
            )
            numbers |= {f"{kind} {use}": len(some), f"{kind} {use} right": right}
    for each in whole:
        if (each.use == "yes" and not each.ratio <= TRUSTED) or (each.use == "no" and each.good):
            print(f"    wrong: {each.case} -> {each.other}: {each.ratio:.2f}, {each.text}")
    for each in rows:
        if each.problem:
            print(f"    refused: {each.case}: {each.problem}")
    return numbers


def read_rows(path: Path | None) -> list[Row]:
    """Return the rows of a file."""
    if path is None or not path.exists():
        return []
    return [
        Row(**{**json.loads(line), "reasons": tuple(json.loads(line)["reasons"])})
        for line in path.read_text().splitlines()
    ]


def measure(robots: int = 12) -> dict[str, float]:
    """Return the counts of the first virtual robots beyond those settled on."""
    return report(list(virtual_rows(range(30, 30 + robots), set())))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", type=int, default=0, help="how many virtual robots")
    parser.add_argument("--first", type=int, default=0, help="number of the first")
    parser.add_argument("--recorded", nargs="*", help="recorded robots (none named: all)")
    parser.add_argument(
        "--validated", action="store_true", help="another recording validates, not blocks"
    )
    parser.add_argument("--out", type=Path, help="file of rows, which is continued")
    given = parser.parse_args()
    every = read_rows(given.out)
    known = {each.case for each in every}
    sources = [virtual_rows(range(given.first, given.first + given.robots), known)]
    if given.recorded is not None:
        sources.append(recorded_rows(given.recorded, known, given.validated))
    for source in sources:
        for row in source:
            every.append(row)
            print(f"{row.case} -> {row.other}: {row.ratio:.2f} {row.text}{row.problem}", flush=True)
            if given.out is not None:
                given.out.parent.mkdir(parents=True, exist_ok=True)
                with given.out.open("a") as file:
                    file.write(json.dumps(asdict(row)) + "\n")
    report(every)
