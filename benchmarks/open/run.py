"""The open benchmark: every tool on every task, in one run, from the same files.

    python benchmarks/open/run.py                       # what is installed, data in ../shared
    python benchmarks/open/run.py --install             # environments of the tools first
    python benchmarks/open/run.py --data DIR --download # fetch data, digests checked
    python benchmarks/open/run.py --task lwr4 --tool asbuilt --tool wls
    python benchmarks/open/run.py --resume              # what an interrupted run left to do

Prints one JSON line for each task and tool, adds it to the file of results at once, the numbers
of each robot in `robots/` beside it, and writes the page from that file.
"""

from __future__ import annotations

import argparse
import fcntl
import hashlib
import json
import os
import signal
import subprocess
import tempfile
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, as_completed, wait
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from adapter import LONGEST
from bench import bench_problem
from commanded import commanded_problem, rollout_errors
from legged import against_torques, legged_problem
from page import read_results, write_page
from plain import Motion
from prepare import Problem, halves, read_task_logs, write_problem
from score import (
    against_truth,
    agreement,
    consistent,
    coverage,
    relative_error,
    torque_errors,
    weight_ratio,
)
from task import DOWNLOADED, HERE, RESULTS, SHARED, Task, download, tasks
from tool import Tool, tools
from virtual import virtual_problems

import asbuilt

SPECIAL = {"legs": legged_problem, "twin": legged_problem, "command": commanded_problem}
"""Kinds of task with a log that is no arm's with torques."""
ABSENT = "not installed; run with --install"
"""Note of a row that is printed, but takes the place of no other."""
PATIENCE = 6.0
"""How long a tool is waited for in its CPU seconds: a machine may have other work."""
AHEAD = 3
"""Rows in work or waiting, for each core, beyond which no further task is prepared."""
PAGES = ("page.py", "pages.py", "shown.py")
"""Modules that no row rests on."""


def answered(tool: Tool, problem: Problem, folder: Path) -> dict[str, Any]:
    """Return what a tool answers for a problem: see `adapter`."""
    reason = tool.cannot.get("*")
    if reason is not None:
        return {"cannot": reason}
    if not tool.python.exists():
        return {"cannot": ABSENT}
    out = folder / f"answers_{tool.name}_{problem.folder.name}"
    out.mkdir(parents=True, exist_ok=True)
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH" or not tool.requires}
    one = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL")}
    command = [tool.python, HERE / "adapter.py", tool.path, problem.folder.resolve(), out]
    settings: dict[str, Any] = {"timeout": PATIENCE * LONGEST, "capture_output": True, "text": True}
    try:
        done = subprocess.run(command, env=environment | one, check=False, **settings)
    except subprocess.TimeoutExpired:
        return {"cannot": f"hung for {PATIENCE * LONGEST:.0f} s"}
    if done.returncode in (-signal.SIGXCPU, -signal.SIGKILL):
        return {"cannot": f"took more than {LONGEST} s"}
    if done.returncode in (-signal.SIGTERM, -signal.SIGINT):
        raise InterruptedError(f"{tool.name} was ended from outside: --resume goes on from here")
    written = out / "answer.json"
    if not written.exists():
        return {"failed": f"it stopped with exit code {done.returncode} and no answer"}
    answer: dict[str, Any] = json.loads(written.read_text())
    answer["torques"] = [np.load(each) for each in sorted(out.glob("answer_*.npy"))]
    if "failed" in answer:
        answer["failed"] = answer["failed"][:300]
    return answer


def scored(task: Task, problems: list[Problem], answers: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the scores of one tool on the problems of a task."""
    for each in answers:
        for key in ("cannot", "failed"):
            if key in each:
                return {"note": each[key], "failed": key == "failed"}
    found: dict[str, Any] = {"cpu_seconds": sum(each["cpu_seconds"] for each in answers)}
    found["note"] = answers[0].get("note", "")
    if task.kind == "command":
        found["per_motion"] = rollout_errors(problems[0], answers[0]["torques"])
        return found | {"error": float(np.mean(found["per_motion"]))}
    pairs = (
        []
        if task.kind in ("legs", "twin")
        else [
            torque_errors(
                _states(problem, k),
                hidden,
                answer["torques"][k],
                _rate(problem),
                task.cutoff,
                task.edge,
            )
            for problem, answer in zip(problems, answers, strict=True)
            for k, hidden in enumerate(problem.hidden)
        ]
    )
    if task.kind in ("legs", "twin"):
        found |= against_torques(problems[0], answers[0]["torques"][0])
    if task.kind == "ratio":
        moments, true = answers[0]["parameters"], task.settings["ratio"]
        half = len(moments) // 2
        ratio, spread = weight_ratio(moments[:half], moments[half:])
        found |= coverage(np.array([(ratio - true) / spread]))
        found["error"] = abs(ratio / true - 1.0)
        found["note"] = f"{ratio:.3g} +- {spread:.2g} for {true:.3g}"
        return found
    if task.kind == "payload":
        mass = task.settings["mass"]
        values, spread = (
            np.array([each["parameters"][0][key] for each in answers]) for key in ("value", "error")
        )
        found["error"] = float(np.sqrt(np.mean((values / mass - 1.0) ** 2)))
        found |= coverage((values - mass) / spread)
        weighed = ", ".join(f"{v:.3g} +- {s:.2g}" for v, s in zip(values, spread, strict=True))
        found["note"] = f"{weighed} kg for {mass:g} kg"
        return found
    if task.kind == "virtual":  # robots of different size: the mean of their errors
        found["error"] = float(np.mean([relative_error([each], task.norm)[0] for each in pairs]))
    elif pairs and task.kind != "halves":
        found["error"], found["per_joint"] = relative_error(pairs, task.norm, _limits(problems[0]))
    if task.kind == "halves":
        found |= coverage(agreement(answers[0]["parameters"], answers[1]["parameters"]))
    if task.kind == "virtual":
        z = [
            against_truth(answer["parameters"], problem.truth or {})
            for problem, answer in zip(problems, answers, strict=True)
        ]
        found |= coverage(np.concatenate(z))
    if all(each["links"] is not None for each in answers):
        masses = [
            sum(row[9] for row in answer["links"]) / problem.mass
            for problem, answer in zip(problems, answers, strict=True)
            if problem.mass is not None
        ]
        found["mass_ratio"] = float(np.mean(masses)) if masses else None
        found["consistent"] = all(consistent(np.array(each["links"])) for each in answers)
    if task.kind == "torque":
        found["details"] = answers[0].get("details", {})
    return found


def _states(problem: Problem, k: int) -> Motion:
    stored = np.load(problem.folder / f"test_{k}.npz")
    return Motion(*(stored[key] for key in ("t", "q", "qd", "qdd")))


def _limits(problem: Problem) -> Any:
    return np.array([joint.limits.torque for joint in problem.model.joints])


def _rate(problem: Problem) -> float:
    return float(json.loads((problem.folder / "facts.json").read_text())["rate"])


def problems_of(task: Task, data: Path, scratch: Path) -> list[Problem]:
    """Return the prepared problems of a task: one, two halves, or one for each virtual robot."""
    if "pendulum" in task.settings:
        return [bench_problem(task, scratch / "part_0")]
    if "robots" in task.settings:
        return virtual_problems(task, scratch)
    if task.kind in SPECIAL:
        return [SPECIAL[task.kind](task, data, scratch / "part_0")]
    model, training, test = read_task_logs(task, data, scratch)
    described = task.description
    own = str((data / described).resolve()) if described.startswith("models/") else described
    parts = halves(training) if task.kind == "halves" else (training,)
    return [
        write_problem(task, model, part, test, scratch / f"part_{k}", description=own)
        for k, part in enumerate(parts)
    ]


def rows(
    wanted: list[tuple[Task, list[Tool]]],
    data: Path,
    jobs: int,
    took: dict[tuple[str, str], float],
) -> Iterator[dict[str, Any]]:
    """Yield one row for each task and tool as it comes; `jobs` tools run at a time, each on a core.

    What took longest [CPU s] goes first, so that no core waits for the other at the end. The next
    task is prepared while the tools work on those before.
    """

    def cost(task: Task, *tools: Tool) -> float:
        return sum(took.get((task.name, tool.name), 0.0) for tool in tools)

    running: set[Future[dict[str, Any]]] = set()
    with (
        tempfile.TemporaryDirectory(prefix="asbuilt_open_") as scratch,
        ThreadPoolExecutor(jobs) as pool,
    ):
        for task, own in sorted(wanted, key=lambda each: -cost(each[0], *each[1])):
            folder = Path(scratch) / task.name
            problems = problems_of(task, data, folder)
            for tool in sorted(own, key=lambda each: -cost(task, each)):
                running.add(pool.submit(row, task, tool, problems, folder))
            while len(running) > AHEAD * jobs:
                done, running = wait(running, return_when=FIRST_COMPLETED)
                yield from (each.result() for each in done)
        yield from (each.result() for each in as_completed(running))


def row(task: Task, tool: Tool, problems: list[Problem], scratch: Path) -> dict[str, Any]:
    """Return the row of one tool."""
    head = {"task": task.name, "tool": tool.name}
    reason = task.skips.get(tool.name)
    if reason is not None:
        return head | {"note": reason, "code": code_of(task, tool)}
    answers = [answered(tool, each, scratch) for each in problems]
    found = scored(task, problems, answers)
    return head | {
        "version": answers[0].get("version"),
        **{key: found.get(key) for key in ("error", "coverage", "mass_ratio")},
        **found,
        "lines": tool.lines,
        "date": datetime.now(tz=UTC).date().isoformat(),
        "code": code_of(task, tool),
    }


def store(row: dict[str, Any], path: Path) -> None:
    """Put a row into the file of results in place of an older one of its task and tool.

    Several runs may write at a time, and one that is killed leaves the file as it was.
    """
    own = row["task"], row["tool"]
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        fcntl.flock(folder, fcntl.LOCK_EX)
        lines = path.read_text().splitlines() if path.exists() else []
        kept = [line for line in lines if ((old := json.loads(line))["task"], old["tool"]) != own]
        written = path.with_suffix(".part")
        written.write_text("\n".join(sorted([*kept, json.dumps(_rounded(row))])) + "\n")
        written.replace(path)
    finally:
        os.close(folder)


def code_of(task: Task, tool: Tool) -> str:
    """Return a digest of what a row rests on: task, adapter, runner, and of asbuilt its source."""
    read = [HERE / "tasks" / f"{task.name}.toml", tool.path]
    read += [path for path in sorted(HERE.glob("*.py")) if path.name not in PAGES]
    if tool.name == "asbuilt":
        read += sorted(Path(asbuilt.__file__).parent.rglob("*.py"))
    return hashlib.sha256(b"".join(path.read_bytes() for path in read)).hexdigest()[:12]


def _rounded(value: Any, digits: int = 5) -> Any:
    """Return numbers with so many digits."""
    if isinstance(value, float):
        return float(f"{value:.{digits}g}")
    if isinstance(value, dict):
        return {key: _rounded(each, digits) for key, each in value.items()}
    return [_rounded(each, digits) for each in value] if isinstance(value, list) else value


def main() -> None:
    """Run, print, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, help="folder with data/ and models/")
    parser.add_argument("--download", action="store_true", help="fetch what the folder lacks")
    parser.add_argument("--task", action="append", choices=list(tasks()), default=[])
    parser.add_argument("--tool", action="append", choices=list(tools()), default=[])
    parser.add_argument("--install", action="store_true", help="make the tools' environments")
    parser.add_argument("--resume", action="store_true", help="leave out rows of the same code")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="tools at a time")
    parser.add_argument("--results", type=Path, default=RESULTS, help="file of results")
    parser.add_argument("--no-page", action="store_true", help="write no page")
    arguments = parser.parse_args()
    chosen = {k: v for k, v in tools().items() if not arguments.tool or k in arguments.tool}
    if arguments.install:
        for tool in chosen.values():
            if tool.requires and "*" not in tool.cannot:
                tool.install()
    data = arguments.data or (DOWNLOADED if arguments.download else SHARED)
    known = read_results(arguments.results) if arguments.results.exists() else {}
    wanted: list[tuple[Task, list[Tool]]] = []
    for name in arguments.task or list(tasks()):
        task = tasks()[name]
        problems = download(task, data) if arguments.download else []
        lacks, damaged = task.missing(data), task.damaged(data)
        if lacks or damaged:
            reason = "; ".join(problems) or f"{data} lacks {', '.join(lacks)}"
            if damaged:
                reason = f"the digest of {', '.join(damaged)} differs from that of the task"
            print(json.dumps({"task": name, "tool": None, "note": reason}), flush=True)
            continue
        left = [
            tool
            for tool in chosen.values()
            if not arguments.resume
            or known.get((name, tool.name), {}).get("code") != code_of(task, tool)
        ]
        if left:
            wanted.append((task, left))
    took = {key: each.get("cpu_seconds") or 0.0 for key, each in known.items()}
    for found in rows(wanted, data, arguments.jobs, took):
        details = found.pop("details", None)
        print(json.dumps(_rounded(found)), flush=True)
        if details:
            robots = arguments.results.parent / "robots"
            robots.mkdir(exist_ok=True)
            text = json.dumps(_rounded(details, 9)) + "\n"
            (robots / f"{found['task']}.json").write_text(text)
        if found["note"] != ABSENT:
            store(found, arguments.results)
    if not arguments.no_page:
        write_page(arguments.results)


if __name__ == "__main__":
    main()
