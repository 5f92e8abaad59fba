"""What the ends of logs of a few seconds are worth: the tasks kinova and schunk of the benchmark.

    python benchmarks/short_logs.py --data ../shared

asbuilt leaves out what its filters disturb at the ends of a log; a peer's fit is repeated with as
much left out. All are scored as in the benchmark.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import asbuilt
from asbuilt.experiment import Recording, SignalChain

OPEN = Path(__file__).resolve().parent / "open"
sys.path[:0] = [str(OPEN)]
sys.path.append(str(OPEN / "adapters"))  # last: adapters have names of packages

import lmi  # noqa: E402
from adapter import Facts  # noqa: E402
from plain import Motion  # noqa: E402
from prepare import Problem, read_task_logs, write_problem  # noqa: E402
from score import relative_error, torque_errors  # noqa: E402
from task import Task, tasks  # noqa: E402

CHAINS = {
    "asbuilt": SignalChain(),
    "asbuilt, filter whose response ends": SignalChain(derivative="gaussian"),
    "asbuilt, ends as filtered": SignalChain(trimmed=False),
    "asbuilt, no second low-pass": SignalChain(parallel=False),
}
EDGES = (0.2, 0.25, 0.3)
"""Seconds that the peer leaves out at either end; the first is that of the tasks."""


def scores(task: Task, data: Path, folder: Path) -> Iterator[tuple[str, float, float]]:
    """Yield a fit, the seconds that it rests on, and its error on the test."""
    model, training, test = read_task_logs(task, data, folder)
    described = str((data / task.description).resolve())
    problem = write_problem(task, model, training, test, folder, description=described)
    facts = Facts(folder=folder, **json.loads((folder / "facts.json").read_text()))
    joints, robot = tuple(facts.joints), asbuilt.load_robot(facts.description)
    logs = [
        Recording(joint_names=joints, torque_source=facts.torque_source, source=name, **log)
        for name, log in zip(facts.training, facts.logs(), strict=True)
    ]
    for name, chain in CHAINS.items():
        result = asbuilt.identify(robot, logs, chain=chain, effects="none").result
        yield name, result.duration, scored(task, problem, lambda m, r=result: r.predict(*m[1:4]))
    for edge in EDGES:
        less = replace(facts, edge=edge)
        seconds = sum(float(np.ptp(x.t[x.inner(edge)])) for x in less.plain())
        yield f"lmi, {edge:g} s left out", seconds, scored(task, problem, lmi.fit(less).predict)


def scored(task: Task, problem: Problem, predict: Callable[[Motion], Any]) -> float:
    """Return the error on the tests of a task."""
    told = json.loads((problem.folder / "facts.json").read_text())
    pairs = []
    for k, hidden in enumerate(problem.hidden):
        stored = np.load(problem.folder / f"test_{k}.npz")
        states = Motion(*(stored[key] for key in ("t", "q", "qd", "qdd")))
        answer = predict(states)
        pairs.append(torque_errors(states, hidden, answer, told["rate"], task.cutoff, task.edge))
    return relative_error(pairs, "torque")[0]


def main() -> None:
    """Print a line for each fit."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--data", type=Path, required=True)
    arguments = parser.parse_args()
    for name in ("kinova", "schunk"):
        with tempfile.TemporaryDirectory() as folder:
            for fit, seconds, error in scores(tasks()[name], arguments.data, Path(folder)):
                print(f"{name:8}{fit:40}{seconds:6.2f} s {100 * error:8.1f} %", flush=True)


if __name__ == "__main__":
    main()
