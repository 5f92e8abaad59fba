"""Walks over the samples and modules executed by a plain `identify`, on five recordings.

A walk evaluates the regressor rows of as many samples as are fitted: ten walks over a tenth of them
count as one. Rows that were kept and are read once more, and samples whose torque is predicted by
inverse dynamics, count in the same way, each by itself. A module is executed if one of its
functions is called; import alone is none.

    python benchmarks/passes.py [NAME ...] [--modules]
"""

from __future__ import annotations

import argparse
import contextlib
import io
import sys
import tempfile
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

import asbuilt
from asbuilt.cli.app import main as run_command
from asbuilt.dynamics import newton_euler
from asbuilt.identification.information import rows, square_root_information

PACKAGE = Path(asbuilt.__file__).resolve().parent
SHARED = Path(__file__).resolve().parents[2] / "shared"
WALKING = {
    "blas.py",
    "newton_euler.py",
    "rows.py",
    "square_root_information.py",
    "torque_prediction.py",
}
"""Modules that walk for others; a walk belongs to the module that asks them to."""
UR10E_SHEET = """header = false
torque_source = "current"
[columns]
time = 1
position = "2-7"
velocity = "8-13"
torque = "14-19"
"""
COMMANDS = {
    "ur10e_virtual": "ur10e $SCRATCH/log.csv",
    "ur10e": (
        "$MODELS/ur10e.urdf $DATA/ur10e/ur-20_02_10-30sec_12harm.csv --sheet $SCRATCH/ur10e.toml"
        " --gain 14.87,13.26,11.13,10.62,11.03,11.47"
    ),
    "lwr4": "$MODELS/kuka_lwr4.urdf $DATA/kuka_lwr4/measurements_1.npz",
    "med7": (
        "$MODELS/lbrstack_med7.urdf $DATA/lbr_med7/measurements_with_ext_tau_1_dgr.csv"
        " --rate 100 --flip-torque"
    ),
    "go2": "$MODELS/go2/go2.xml $DATA/go2_hung/traj_0.pt --fixed-base --kp 20 --kd 1.5",
}
"""The recordings, as `asbuilt identify` reads them."""


@dataclass
class Passes:
    """Count samples walked over and predicted, by the module that asked, and modules executed."""

    walked: Counter[str] = field(default_factory=Counter)
    read: Counter[str] = field(default_factory=Counter)
    predicted: Counter[str] = field(default_factory=Counter)
    modules: set[str] = field(default_factory=set)
    rows: int = 1
    """Filtered samples of the longest walk, which is one over all that is fitted."""
    samples: int = 1
    """Samples of the longest walk, before filtering."""

    def walks(self) -> dict[str, float]:
        """Return the walks of each module, in units of the samples that are fitted."""
        return {name: count / self.rows for name, count in self.walked.most_common()}

    def readings(self) -> dict[str, float]:
        """Return how often each module reads rows that were kept, in the same unit."""
        return {name: count / self.rows for name, count in self.read.most_common()}

    def predictions(self) -> dict[str, float]:
        """Return the predictions of each module, in the same unit."""
        return {name: count / self.samples for name, count in self.predicted.most_common()}


def _find_asker() -> str:
    """Return the module that walks: the nearest that does not walk for others."""
    frame: FrameType | None = sys._getframe(2)
    while frame is not None:
        path = Path(frame.f_code.co_filename)
        if PACKAGE in path.parents and path.name not in WALKING:
            return str(path.relative_to(PACKAGE))
        frame = frame.f_back
    return "?"


@contextlib.contextmanager
def count_passes() -> Iterator[Passes]:
    """Count what runs inside."""
    found = Passes()
    divide = rows.divide_into_blocks
    chunks = rows.SampleBlock.chunks
    iterate = rows.Rows.__iter__
    parts = rows.Rows.parts
    evaluate = newton_euler._evaluate_torques
    accumulate = square_root_information.accumulate_stream
    threads: list[str] = []
    """Who asked for what the threads of a pool do."""

    def accumulated(*given: Any, **named: Any) -> Any:
        threads.append(_find_asker())
        try:
            return accumulate(*given, **named)
        finally:
            threads.pop()

    def divided(*given: Any, **named: Any) -> Iterator[Any]:
        count, samples = 0, dict[int, int]()
        for part in divide(*given, **named):
            count += part.n_outputs
            samples[id(part.samples)] = part.samples.n_samples
            found.rows = max(found.rows, count)
            found.samples = max(found.samples, sum(samples.values()))
            yield part

    def chunked(self: rows.SampleBlock, *given: Any, **named: Any) -> Iterator[Any]:
        asker = _find_asker()
        if asker == "?" and threads:
            asker = threads[-1]
        known = None if self.kept is None else self.kept.find(given[0], self.samples)
        (found.walked if known is None else found.read)[asker] += self.n_outputs
        yield from chunks(self, *given, **named)

    def iterated(self: rows.Rows) -> Iterator[Any]:
        kept, asker = self.are_kept, _find_asker()
        for block in iterate(self):
            if kept:
                found.read[asker] += block.time.n_samples
            yield block

    def divided_again(self: rows.Rows) -> Iterator[Any]:
        asker, known = _find_asker(), self._parts is not None
        for part in parts(self):
            if known:
                found.read[asker] += part[0].shape[1]
            yield part

    def evaluated(model: Any, q: Any, *further: Any) -> Any:
        found.predicted[_find_asker()] += len(q)
        return evaluate(model, q, *further)

    def record(frame: FrameType, event: str, argument: object) -> None:
        code = frame.f_code
        if event == "call" and code.co_flags & 0x2:  # functions have fast locals, modules none
            found.modules.add(code.co_filename)

    _replace_everywhere(divide, divided)
    _replace_everywhere(evaluate, evaluated)
    _replace_everywhere(accumulate, accumulated)
    rows.SampleBlock.chunks = chunked  # type: ignore[method-assign]
    rows.Rows.__iter__ = iterated  # type: ignore[method-assign]
    rows.Rows.parts = divided_again  # type: ignore[method-assign]
    threading.setprofile(record)
    sys.setprofile(record)
    try:
        yield found
    finally:
        sys.setprofile(None)
        threading.setprofile(None)  # type: ignore[arg-type]
        _replace_everywhere(divided, divide)
        _replace_everywhere(evaluated, evaluate)
        _replace_everywhere(accumulated, accumulate)
        rows.SampleBlock.chunks = chunks  # type: ignore[method-assign]
        rows.Rows.__iter__ = iterate  # type: ignore[method-assign]
        rows.Rows.parts = parts  # type: ignore[method-assign]
        found.modules = {each for each in found.modules if each.startswith(str(PACKAGE))}


def _replace_everywhere(old: Callable[..., Any], new: Callable[..., Any]) -> None:
    """Replace a function under every name by which modules of the package hold it."""
    for name, module in list(sys.modules.items()):
        if name.startswith("asbuilt"):
            for key, value in list(vars(module).items()):
                if value is old:
                    setattr(module, key, new)


def run(name: str, command: str) -> Passes:
    """Run `identify` on a recording and count."""
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder)
        (scratch / "ur10e.toml").write_text(UR10E_SHEET)
        places = {
            "$SCRATCH": folder,
            "$MODELS": str(SHARED / "models"),
            "$DATA": str(SHARED / "data"),
        }
        for word, place in places.items():
            command = command.replace(word, place)
        if name == "ur10e_virtual":
            log = str(scratch / "log.csv")
            _run_quietly(["simulate", "ur10e", "--duration", "20", "--seed", "1", "--out", log])
        words = ["identify", *command.split(), "--json"]
        _run_quietly(words)  # kernels and lazy imports are not what is counted
        with count_passes() as found:
            _run_quietly(words)
        return found


def _run_quietly(words: list[str]) -> None:
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        try:
            run_command(words)
        except SystemExit as end:
            if end.code not in (0, None, 1):
                raise


def measure() -> dict[str, float]:
    """Return walks, predictions and executed modules of each recording that is at hand."""
    numbers: dict[str, float] = {}
    for name, command in COMMANDS.items():
        if name != "ur10e_virtual" and not (SHARED / "data").is_dir():
            continue
        found = run(name, command)
        numbers[f"{name}_walks"] = sum(found.walks().values())
        numbers[f"{name}_readings"] = sum(found.readings().values())
        numbers[f"{name}_predictions"] = sum(found.predictions().values())
        numbers[f"{name}_modules"] = len(found.modules)
    return numbers


def main() -> None:
    """Print the passes of recordings, each with the modules that ask for them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", help=f"recordings of {', '.join(COMMANDS)}")
    parser.add_argument("--modules", action="store_true", help="list the modules executed")
    arguments = parser.parse_args()
    for name in arguments.names or COMMANDS:
        found = run(name, COMMANDS[name])
        kinds = {
            "walks": found.walks(),
            "readings": found.readings(),
            "predictions": found.predictions(),
        }
        sums = ", ".join(f"{sum(each.values()):.1f} {kind}" for kind, each in kinds.items())
        print(
            f"{name}: {sums} over {found.samples} samples ({found.rows} filtered),"
            f" {len(found.modules)} modules"
        )
        for kind, each in kinds.items():
            print(f"  {kind}:")
            for module, count in each.items():
                print(f"    {count:6.2f}  {module}")
        if arguments.modules:
            print("\n".join(f"    {each}" for each in sorted(found.modules)))


if __name__ == "__main__":
    main()
