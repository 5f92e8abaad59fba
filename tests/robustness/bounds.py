"""What inputs that are huge, endless or too deep cost: peak memory and time of a command.

    python tests/robustness/bounds.py [GROUP]
    python tests/robustness/bounds.py --together GROUP...

runs the cases in a process of their own each, or all of some groups in one, and prints one JSON
object a case.
"""

from __future__ import annotations

import contextlib
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from robustness import corpus
from robustness.corpus import Case

LARGEST = 500.0
"""Peak memory [MB] that a refused input may cost,"""
SLOWEST = 2.0
"""and time [s], start of the interpreter included."""
TOGETHER = (("logs",), ("deep",), ("results",), ("deep sheets", "sheets", "options"))
"""Groups that share a process; what one leaves behind counts to the peak of the next."""


@dataclass(frozen=True)
class Cost:
    """Hold what a case cost: exit status, time [s], peak memory [MB] of its largest process."""

    group: str
    name: str
    status: int
    seconds: float
    megabytes: float


def cases() -> dict[str, list[Case]]:
    """Return the cases whose size, not damage, is the trouble, by group."""
    log = corpus.csv_log().encode()
    two = {"log.csv": log}
    return {
        "deep": [
            Case(f"{suffix} {what}", ("show", f"@case{suffix}"), {f"case{suffix}": data})
            for what, suffix, data in corpus.deep()
        ],
        "deep sheets": [
            Case(what, ("check", "two-link", "@log.csv", "--sheet", "@s.toml"),
                 {**two, "s.toml": x})
            for what, suffix, x in corpus.deep()
            if suffix == ".toml"
        ],
        "logs": [
            Case(f"{suffix} {what}", ("check", "two-link", f"@x{suffix}"), {f"x{suffix}": data})
            for what, suffix, data in corpus.hostile_logs()
        ],
        "sheets": [
            Case(what, ("check", "two-link", "@log.csv", "--sheet", "@s.toml"),
                 {**two, "s.toml": text.encode()})
            for what, text in corpus.sheets() if what.startswith(("columns", "file"))
        ],
        "options": [Case(" ".join(words)[:60], words, {}) for words in corpus.OPTIONS],
        "results": [
            Case(what, ("show", "@r.json"), {"r.json": text.encode()})
            for what, text in corpus.huge_results()
        ],
    }  # fmt: skip


def measured(group: str, case: Case, folder: Path) -> Cost:
    """Run a case in a process of its own."""
    command = [sys.executable, "-m", "asbuilt", *case.written(folder)]
    process = subprocess.Popen(
        [each for each in command if "\0" not in each],
        cwd=folder,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
    )
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    seconds = usage.ru_utime + usage.ru_stime
    return Cost(group, case.name, process.returncode, seconds, usage.ru_maxrss / 1e3)


def costs(only: str | None = None) -> Iterator[Cost]:
    """Yield the cost of every case of a group, or of all."""
    for group, members in cases().items():
        if only in (None, group):
            for case in members:
                with tempfile.TemporaryDirectory() as folder:
                    yield measured(group, case, Path(folder))


def together(group: str) -> Iterator[Cost]:
    """Run the cases of a group one after another in this process; peaks are those until then."""
    from asbuilt.cli import main

    for case in cases()[group]:
        with tempfile.TemporaryDirectory() as folder, open(os.devnull, "w") as nowhere:
            began, status = time.process_time(), 0
            with contextlib.redirect_stdout(nowhere), contextlib.redirect_stderr(nowhere):
                try:
                    main(case.written(Path(folder)))
                except SystemExit as end:
                    status = int(end.code or 0)
            yield Cost(group, case.name, status, time.process_time() - began, peak())


def peak() -> float:
    """Return the peak memory [MB] of this process, or of its largest child (Linux)."""
    lines = Path("/proc/self/status").read_text().splitlines()
    own = next(float(line.split()[1]) for line in lines if line.startswith("VmHWM"))
    children = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    return max(own, children) / 1e3


if __name__ == "__main__":
    chosen = sys.argv[1:]
    found = costs(*chosen[:1])
    if chosen[:1] == ["--together"]:
        found = (cost for group in chosen[1:] for cost in together(group))
    for cost in found:
        print(json.dumps(cost.__dict__), flush=True)
