"""Relative torque error on other motion of every recorded robot, by every way to identify.

    python benchmarks/other_motions.py                       the whole table, about 20 min of CPU
    python benchmarks/other_motions.py "LWR4+" UR10e         some robots
    python benchmarks/other_motions.py --out now.jsonl --beside before.jsonl

Each set of recordings is identified by `asbuilt.identify` with the options of the command line, and
the robot's other recordings are predicted; a robot with a single motion holds blocks of it out.
`default` is the command line without options, `plain` is weighted least squares without effects;
`exported` is the default's model of bodies. A recording that repeats the motion fitted is marked
with `=`: it tells how well that motion is fitted, not how well another one is predicted.

A row is one set with all its other motions, by the mean squared error. What the default loses to
the best way has a standard error, from paired differences of time blocks. `--beside` compares with
rows that another tree wrote.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from asbuilt.description.model import RobotModel
from asbuilt.errors import AsbuiltError
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.signal.preparation import prepare_samples
from asbuilt.validation.generalisation.coverage import measure_repeated_share
from asbuilt.validation.prediction import Validation
from asbuilt.workflow.study import Study, identify
from drive_terms import SHARED
from recorded_robots import ROBOTS, SINGLE, Robot, recorded_robots, sets_of

WAYS: dict[str, dict[str, Any]] = {
    "default": {},
    "plain": {"method": "wls", "effects": "none"},
    "wls": {"method": "wls"},
    "consistent": {"method": "consistent"},
    "entropic": {"method": "entropic"},
    "no effects": {"effects": "none"},
}
"""Options of every way."""
REPEATED = 0.5
"""Share of states near those fitted from which on a recording repeats the motion."""
WORSE = 0.03
"""Share of the best way's error by which the default may be worse."""
BLOCKS, SHORTEST = 20, 1.0
"""Time blocks of a recording predicted, and the least length of one [s]."""


@dataclass(frozen=True)
class Row:
    """One set of recordings identified in one way, and its errors on other motions.

    `errors` and `cad` are relative errors on each other motion, `exported` those of the exported
    robot, `repeats` whether it is the motion fitted. `energies` are the squared errors of time
    blocks in the squared torque of their recording, `effects` those in the model with a value.
    """

    robot: str
    train: str
    way: str
    others: tuple[str, ...] = ()
    errors: tuple[float, ...] = ()
    exported: tuple[float, ...] = ()
    cad: tuple[float, ...] = ()
    repeats: tuple[bool, ...] = ()
    energies: tuple[tuple[float, ...], ...] = ()
    effects: tuple[str, ...] = ()
    took: str = ""
    seconds: float = 0.0
    problem: str = ""

    @property
    def key(self) -> tuple[str, str]:
        """Robot and recordings."""
        return self.robot, self.train

    def mean(self, errors: Sequence[float]) -> float:
        """Return the root of the mean squared error on motions that do not repeat, else on all."""
        new = [error for error, same in zip(errors, self.repeats, strict=True) if not same]
        return float(np.sqrt(np.mean(np.square(new or errors)))) if errors else np.nan

    @property
    def error(self) -> float:
        """Error on other motion of the fitted model."""
        return self.mean(self.errors)


@dataclass
class Table:
    """Rows by set and way."""

    rows: dict[tuple[str, str], dict[str, Row]] = field(default_factory=dict)

    def add(self, row: Row) -> None:
        """Add a row, or put it in the place of an older one."""
        self.rows.setdefault(row.key, {})[row.way] = row


def excess_over(own: Row, other: Row) -> tuple[float, float]:
    """Return the error of a row over that of another, less 1, with its standard error.

    With the energies `a_b`, `p_b` of the time blocks and `r = sum a / sum p`, the variance of r is
    that of `sum (a_b - r p_b) / sum p`.
    """
    a, p = (np.concatenate([*map(np.array, row.energies)]) for row in (own, other))
    ratio = float(a.sum() / p.sum())
    n = len(a)
    spread = float(np.sqrt(np.sum((a - ratio * p) ** 2) * n / max(n - 1, 1)) / p.sum())
    return float(np.sqrt(ratio)) - 1.0, 0.5 * spread / float(np.sqrt(ratio))


def measure_set(
    name: str, robot: Robot, model: RobotModel, logs: Sequence[Recording], train: tuple[int, ...]
) -> Iterator[Row]:
    """Yield the rows of one set of recordings, way by way."""
    label = "+".join(Path(logs[k].source).stem for k in train)
    others = [k for k in range(len(logs)) if k not in train and robot.holdout is None]
    for way, options in WAYS.items():
        began = time.process_time()
        try:
            study = identify(
                model,
                [logs[k] for k in train],
                validation=[logs[k] for k in others],
                checked=False,
                **{"holdout": robot.holdout} if robot.holdout else {},
                **options,
            )
        except (AsbuiltError, np.linalg.LinAlgError) as problem:
            yield Row(name, label, way, problem=f"{type(problem).__name__}: {problem}"[:200])
            continue
        seconds = time.process_time() - began
        chain = study.result.chain
        repeats = [False] * len(study.validations)
        if others and chain is not None:
            used = [prepare_samples(logs[k], chain) for k in train]
            repeats = [
                measure_repeated_share(used, prepare_samples(logs[k], chain)) >= REPEATED
                for k in others
            ]
        yield make_row(name, label, way, study, repeats, seconds)


def make_row(
    name: str, label: str, way: str, study: Study, repeats: Sequence[bool], seconds: float
) -> Row:
    """Return the row of a study."""
    found = study.validations
    chosen = [note for note in study.result.notes if note.startswith("Chosen automatically")]
    return Row(
        name,
        label,
        way,
        tuple(Path(each.source.partition(", held out")[0]).stem for each in found),
        tuple(each.metrics_as_built.relative_error for each in found),
        tuple((each.metrics_exported or each.metrics_as_built).relative_error for each in found),
        tuple(each.metrics_cad.relative_error for each in found),
        tuple(repeats),
        tuple(
            block_energies(each)
            for each, same in zip(found, repeats, strict=True)
            if not same or all(repeats)
        ),
        tuple(each.text for each in study.effects if each.in_model),
        " ".join(chosen).removeprefix("Chosen automatically: ").partition(" (")[0],
        seconds,
    )


def block_energies(found: Validation) -> tuple[float, ...]:
    """Return the squared error of each time block in the squared torque of the recording."""
    t = found.t
    seconds = max(SHORTEST, float(t[-1] - t[0]) / BLOCKS)
    block = np.unique(np.floor((t - t[0]) / seconds + 1e-9), return_inverse=True)[1]
    squares = np.bincount(block, np.nansum(found.error**2, axis=1))
    return tuple((squares / np.nansum(found.measured**2)).tolist())


def measure_rows(names: Sequence[str], data: Path, known: set[tuple[str, str]]) -> Iterator[Row]:
    """Yield the rows of robots by name, without sets that are known; of all without names."""
    for name, robot, model, logs in recorded_robots(names or (*ROBOTS, *SINGLE), data):
        for train in sets_of(robot):
            label = "+".join(Path(logs[k].source).stem for k in train)
            if (name, label) not in known:
                yield from measure_set(name, robot, model, logs, train)


def format_errors(row: Row | None, errors: Callable[[Row], Sequence[float]]) -> str:
    """Return errors in percent, those on repeated motion with `=`."""
    if row is None or row.problem:
        return "-"
    listed = zip(errors(row), row.repeats, strict=True)
    return " ".join(f"{100 * error:.2f}{'=' if same else ''}" for error, same in listed)


def print_set(rows: dict[str, Row], before: dict[str, Row]) -> None:
    """Print a set of recordings: a line a way, and what the default loses."""
    default = rows.get("default")
    first = next(iter(rows.values()))
    print(f"\n{first.robot} from {first.train}", flush=True)
    for way, row in rows.items():
        text = row.problem or f"{format_errors(row, lambda each: each.errors):<40}{row.took}"
        print(f"    {way:<12}{text}")
    if default is None or default.problem:
        return
    print(f"    {'exported':<12}{format_errors(default, lambda each: each.exported)}")
    print(f"    {'CAD':<12}{format_errors(default, lambda each: each.cad)}")
    if "default" in before:
        print(f"    {'before':<12}{format_errors(before['default'], lambda each: each.errors)}")
    for effect in default.effects:
        print(f"    in the model: {effect}")


def best_way(rows: dict[str, Row]) -> Row | None:
    """Return the row of the least error on other motion."""
    good = [row for row in rows.values() if not row.problem and np.isfinite(row.error)]
    return min(good, key=lambda row: row.error, default=None)


def summarise(table: Table, before: Table) -> dict[str, float]:
    """Print a line a set, count where the default is worse than the best way, return numbers."""
    print(f"\n{'':<44}{'before':>8}{'default':>9}{'plain':>8}{'best':>8}  way, default to best")
    worse = counted = lost = 0
    numbers: dict[str, float] = {}
    for (robot, train), rows in table.rows.items():
        default = rows.get("default")
        best = best_way(rows)
        if default is None or default.problem or best is None:
            continue
        counted += 1
        over, error = excess_over(default, best) if best is not default else (0.0, 0.0)
        far = default.error > (1.0 + WORSE) * best.error
        worse += far
        old = before.rows.get((robot, train), {}).get("default")
        plain = rows.get("plain")
        note = f"{100 * over:+.1f} +- {100 * error:.1f} %" + (" WORSE" if far else "")
        if old is not None and not old.problem:
            change, spread = excess_over(default, old)
            if change > spread and change > 1e-3:
                lost += 1
                note += f"; to before {100 * change:+.1f} +- {100 * spread:.1f} %"
        listed = [
            np.nan if row is None or row.problem else 100 * row.error
            for row in (old, default, plain, best)
        ]
        print(
            f"{robot[:18]:<19}{train[:24]:<25}{listed[0]:8.2f}{listed[1]:9.2f}{listed[2]:8.2f}"
            f"{listed[3]:8.2f}  {best.way}, {note}"
        )
        numbers[f"{robot} {train}"] = 100 * default.error
    print(
        f"\nThe default is worse than the best way by more than {100 * WORSE:g} % in {worse} of"
        f" {counted} sets; worse than before by more than its standard error in {lost}."
    )
    return numbers | {"worse": float(worse), "sets": float(counted)}


def read_table(path: Path | None) -> Table:
    """Return the rows of a file."""
    table = Table()
    if path is not None and path.exists():
        for line in path.read_text().splitlines():
            table.add(Row(**{k: freeze(value) for k, value in json.loads(line).items()}))
    return table


def freeze(value: Any) -> Any:
    """Return lists of JSON as the tuples that they were."""
    return tuple(map(freeze, value)) if isinstance(value, list) else value


def report(
    names: Sequence[str], data: Path = SHARED, out: Path | None = None, beside: Path | None = None
) -> dict[str, float]:
    """Measure what the file does not have yet, print the table, and return its numbers."""
    table = read_table(out)
    before = read_table(beside)
    for row in _measured(names, data, set(table.rows), before):
        table.add(row)
        if out is not None:
            out.parent.mkdir(parents=True, exist_ok=True)
            with out.open("a") as file:
                file.write(json.dumps(asdict(row)) + "\n")
    return summarise(table, before)


def _measured(
    names: Sequence[str], data: Path, known: set[tuple[str, str]], before: Table
) -> Iterable[Row]:
    """Yield rows as they are measured, and print each set when it is whole."""
    rows: dict[str, Row] = {}
    for row in measure_rows(names, data, known):
        yield row
        rows[row.way] = row
        if len(rows) == len(WAYS):
            print_set(rows, before.rows.get(row.key, {}))
            rows = {}


def measure(data: Path = SHARED) -> dict[str, float | str]:
    """Return the error of the default on other motion [%], by set of recordings."""
    if not (data / "data").is_dir():
        return {"skipped": "no recordings beside the repository"}
    return {**report((), data)}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=SHARED)
    parser.add_argument("robots", nargs="*", help="robots (default: all)")
    parser.add_argument("--ways", help="ways, separated by commas (default: all)")
    parser.add_argument("--out", type=Path, help="file of rows, which is continued")
    parser.add_argument("--beside", type=Path, help="rows of another tree")
    given = parser.parse_args()
    if given.ways:
        for way in set(WAYS) - set(given.ways.split(",")):
            WAYS.pop(way)
    report(given.robots, given.data, given.out, given.beside)
