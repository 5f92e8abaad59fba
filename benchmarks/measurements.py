"""Long measurements that can be stopped, and shares with their intervals."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import beta

Run = Callable[..., Iterator[Any]]
"""`map`, or that of a pool of processes: yields results in the order of tasks."""


def resume(
    path: Path | None, tasks: Sequence[Any], work: Callable[[Any], dict[str, Any]], run: Run
) -> Iterator[dict[str, Any]]:
    """Yield the document of each task, from the file where it has one; others are added to it.

    The file has a JSON line for each task, so that a measurement that was stopped goes on.
    `work` turns a task, which must be plain data, into plain data; a document has its task beside.
    """
    lines = path.read_text().splitlines() if path is not None and path.exists() else []
    known = {json.dumps(each["task"]): each for each in map(json.loads, lines)}
    wanted = [json.loads(json.dumps(task)) for task in tasks]
    missing = [task for task in wanted if json.dumps(task) not in known]
    found = iter(run(work, missing))
    for task in wanted:
        if json.dumps(task) in known:
            yield known[json.dumps(task)]
            continue
        document = {"task": task, **next(found)}
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            with path.open("a") as file:
                file.write(json.dumps(document) + "\n")
        yield document


def count(held: Sequence[bool]) -> str:
    """Return a share with its 95 % interval by Clopper and Pearson, such as `.95 (.91 to .98)`."""
    k, n = int(np.sum(held)), len(held)
    least = beta.ppf(0.025, k, n - k + 1) if k else 0.0
    greatest = beta.ppf(0.975, k + 1, n - k) if k < n else 1.0
    return f"{k} of {n}, {k / n:.3f} ({least:.3f} to {greatest:.3f})"
