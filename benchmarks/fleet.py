"""Logs reduced for a ledger: speed with reading, workers, overhead, memory, sizes, and a simulation
of 1000 arms over a year.

    python benchmarks/fleet.py [--tasks 10000] [--minutes 60] [--overhead]
"""

from __future__ import annotations

import argparse
import heapq
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl

from asbuilt.apps.fleet.identification import fleet_identify
from asbuilt.apps.fleet.ledger.ledger import open_ledger
from asbuilt.apps.fleet.options import FleetIdentification, FleetOptions
from asbuilt.apps.fleet.reduction.add import add_logs
from asbuilt.apps.fleet.reduction.log_task import LogTask, reduce_log
from asbuilt.description.load import load_robot
from asbuilt.dynamics.drives.drive_set import DriveSet
from asbuilt.executor import open_workers
from asbuilt.experiment.logs.long_recordings import RecordingStream
from asbuilt.experiment.logs.reading_options import ReadingOptions
from asbuilt.experiment.quality.checks import check_recording
from asbuilt.experiment.signal.preparation import stream_samples
from asbuilt.experiment.signal.samples import Samples
from asbuilt.identification.information.square_root_information import (
    accumulate,
    accumulate_stream,
)
from asbuilt.workflow.prepare import prepare
from factor import DRIVE, N_SAMPLES, ROBOT, recorded

READING = ReadingOptions(torque_source="sensor")
ARMS, DAYS, HOURS, RATE = 1000, 365, 1.0, 100.0
COLUMNS = 15
"""Columns of a log that counts as raw: time, 7 positions, 7 torques, 8 bytes each."""
TASK = 0.01


def write_log(path: Path, seconds: float, rate: float, seed: int) -> Path:
    """Write a log of positions and torques as Parquet, or as CSV if its name says so."""
    model, drive, rng = load_robot(ROBOT), DriveSet.parse(DRIVE), np.random.default_rng(seed)
    q, _, _, tau = recorded(model, drive, np.arange(0.0, seconds, 1.0 / rate) + seed, rng)
    columns = {"t": np.arange(len(q)) / rate}
    columns |= {f"q_{k}": q[:, k] for k in range(7)} | {f"tau_{k}": tau[:, k] for k in range(7)}
    frame = pl.DataFrame(columns)
    frame.write_csv(path) if path.suffix == ".csv" else frame.write_parquet(path)
    return path


def speed(folder: Path, minutes: float, rate: float, kind: str = "parquet") -> dict[str, float]:
    """Return CPU seconds of a log, reading included, and of its parts.

    Both shares divide the time of regressor and factor in memory by the time of all: of the samples
    that are left after thinning, and of the samples as logged.
    """
    log = write_log(folder / f"{rate:.0f}_2026-03-01.{kind}", 60.0 * minutes, rate, 1)
    ledger = folder / f"ledger{rate:.0f}{kind}"

    def added() -> None:
        add_logs(ledger, ROBOT, [log], robot_id=f"R{_cpu()}", reading=READING, fleet=HERE)

    added()
    whole = _least(added)
    settings = next(iter(open_ledger(str(ledger)).types().values()))
    model, base = settings.model, settings.base
    stream = RecordingStream(log, model, READING)
    reading = _least(lambda: sum(chunk.n_samples for chunk in stream))
    check = _least(lambda: check_recording(model, stream.head))
    chunks = list(stream)
    chain = _least(lambda: sum(part.n_samples for part in stream_samples(chunks, settings.chain)))
    training = prepare(model, [stream], chain=settings.chain, checked=False).training
    factor = _least(lambda: accumulate_stream(model, base, training, threads=1))
    q, qd, qdd, tau = recorded(
        model, settings.drive, np.arange(N_SAMPLES) / rate, np.random.default_rng(1)
    )
    t = np.arange(N_SAMPLES) / rate
    plain = Samples(t, q, qd, qdd, tau, rate=rate, joint_names=model.joint_names)
    each = _least(lambda: accumulate(model, base, plain, threads=1)) / N_SAMPLES
    entry = next(ledger.rglob("*.parquet")).stat().st_size
    n = 60.0 * minutes * rate
    return {
        "samples": n,
        "microseconds_per_sample": 1e6 * whole / n,
        "of_reading": 1e6 * reading / n,
        "of_check": 1e6 * check / n,
        "of_chain": 1e6 * chain / n,
        "of_factor": 1e6 * factor / n,
        "factor_of_logged_samples": 1e6 * each,
        "speed_beside_logged_samples": each * n / whole,
        "speed_beside_thinned_samples": factor / whole,
        "log_mb": log.stat().st_size / 1e6,
        "entry_mb": entry / 1e6,
        "entry_of_raw_hour": entry / (3600.0 * rate * COLUMNS * 8),
    }


HERE = FleetOptions(workers=0)


def _least(work: Callable[[], object], times: int = 3) -> float:
    """Return the CPU seconds of the fastest of some runs."""
    found = []
    for _ in range(times):
        began = _cpu()
        work()
        found.append(_cpu() - began)
    return min(found)


def _cpu() -> float:
    """CPU seconds of this process, of those it has waited for, and of readers that still run."""
    ended = sum(
        used.ru_utime + used.ru_stime
        for used in map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    )
    return ended + sum(map(_cpu_of, _children()))


def _children() -> list[str]:
    """Return the numbers of the processes that this one has started and that still run."""
    lists = Path("/proc/self/task").glob("*/children")
    return [number for each in lists for number in each.read_text().split()]


def _cpu_of(process: str) -> float:
    """CPU seconds of another process and of those it has waited for (proc(5))."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")


def memory(folder: Path, minutes: float, rate: float) -> dict[str, float]:
    """Return the peak memory [MB] of a worker that reduces a log, its reader apart.

    `ru_maxrss` would count what this process held when it started the worker.
    """
    log = write_log(folder / f"m{rate:.0f}_2026-03-01.parquet", 60.0 * minutes, rate, 1)
    code = (
        "import re, sys; from pathlib import Path;"
        " from asbuilt import add_logs, FleetOptions, ReadingOptions;"
        f" done = add_logs(sys.argv[1], {ROBOT!r}, [sys.argv[2]], robot_id='R',"
        " reading=ReadingOptions(torque_source='sensor'), fleet=FleetOptions(workers=0));"
        " assert done.added, done.failed;"
        " said = Path('/proc/self/status').read_text();"
        " print(int(re.search(r'VmHWM:\\s+(\\d+)', said)[1]) / 1024)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(folder / f"m{rate:.0f}"), str(log)],
        check=True,
        capture_output=True,
        text=True,
    )
    return {"log_mb": log.stat().st_size / 1e6, "peak_mb": float(done.stdout)}


def workers(folder: Path, count: int = 12) -> dict[str, float]:
    """Return wall and CPU seconds of many logs on one and on two workers, without their start.

    The CPU time of a worker tells what is lost to the work itself from what another process took.
    """
    logs = [
        str(write_log(folder / f"w_2026-04-{k:02d}.parquet", 600.0, 100.0, k))
        for k in range(1, count + 1)
    ]
    add_logs(folder / "w", ROBOT, logs[:1], robot_id="R", reading=READING, fleet=HERE)
    path = next(iter(open_ledger(str(folder / "w")).types().values())).path
    found = {}
    for n in (1, 2):
        tasks = [
            LogTask(str(folder / "w"), path, f"{n}-{k}", (Path(log),), READING)
            for k, log in enumerate(logs)
        ]
        warm = [replace(task, robot_id=f"warm {n}-{k}") for k, task in enumerate(tasks[: 2 * n])]
        with open_workers(n) as pool:
            list(pool.run(costly, warm))
            began = time.monotonic()
            spent = [done.result or 0.0 for done in pool.run(costly, tasks)]
            found[f"seconds_{n}"] = time.monotonic() - began
        found[f"cpu_per_task_{n}"] = sum(spent) / count
    return found | {
        "ratio": found["seconds_1"] / found["seconds_2"],
        "ratio_if_cores_are_free": 2.0 * found["cpu_per_task_1"] / found["cpu_per_task_2"],
    }


def costly(task: LogTask) -> float:
    """Reduce a log; return the CPU seconds of its process."""
    began = _cpu()
    report = reduce_log(task)
    if not report.added:
        raise RuntimeError(report.problem)
    return _cpu() - began


def rest(seconds: float) -> int:
    """Do nothing; the result tells the process apart."""
    time.sleep(seconds)
    return os.getpid()


def overhead(tasks: int, scheduler: str | None = None) -> dict[str, float]:
    """Return the overhead of tasks of 10 ms on two workers, beyond their own time."""
    with open_workers(None if scheduler else 2, scheduler) as pool:
        list(pool.run(rest, [TASK] * 50))
        began = time.monotonic()
        done = sum(1 for _ in pool.run(rest, (TASK for _ in range(tasks))))
        wall = time.monotonic() - began
    return {"tasks": done, "seconds": wall, "overhead": wall / (done * TASK / 2) - 1.0}


def on_dask(tasks: int) -> dict[str, float]:
    """Return the overhead on a Dask cluster of two processes."""
    from distributed import LocalCluster  # noqa: PLC0415 (slow)

    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        return overhead(tasks, cluster.scheduler_address)


def identify(folder: Path) -> dict[str, float]:
    """Return milliseconds of `fleet identify` from 12 logs, by method."""
    logs = sorted(folder.glob("w_*.parquet"))
    add_logs(folder / "by2", ROBOT, logs, robot_id="R", reading=READING, fleet=HERE)
    found = {}
    for method in ("wls", "consistent"):
        options = FleetIdentification(method=method)
        times = []
        for _ in range(4):
            began = time.monotonic()
            fleet_identify(folder / "by2", "R", options=options)
            times.append(time.monotonic() - began)
        found[f"{method}_ms"] = 1e3 * min(times)
    return found


def simulated(
    seconds_per_sample: float,
    size: float,
    n_workers: int,
    *,
    store: float = 1.25e9,
    scheduler: float = 1e-3,
) -> dict[str, float]:
    """Simulate 1000 arms over a year on some workers, log by log.

    A log of `size` bytes is read from a store whose bandwidth [bytes/s] all share, then reduced;
    the scheduler hands out one task after the other, `scheduler` seconds each.
    """
    samples = RATE * 3600.0 * HOURS
    compute = samples * seconds_per_sample
    free = [(0.0, k) for k in range(n_workers)]
    issued = stored = end = busy = 0.0
    for _ in range(ARMS * DAYS):
        at, k = heapq.heappop(free)
        issued = max(issued, at) + scheduler
        stored = max(stored, issued) + size / store
        finished = stored + compute
        busy += compute
        end = max(end, finished)
        heapq.heappush(free, (finished, k))
    return {
        "workers": n_workers,
        "hours": end / 3600.0,
        "busy": busy / (end * n_workers),
        "core_hours": busy / 3600.0,
        "terabytes": ARMS * DAYS * size / 1e12,
        "ledger_gb": ARMS * DAYS * 0.54e6 / 1e9,
    }


def results(tasks: int, minutes: float) -> Iterator[tuple[str, dict[str, float]]]:
    """Yield every measurement with its name."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        slow = speed(folder, minutes, 100.0)
        yield "an hour at 100 Hz", slow
        yield "an hour at 100 Hz, CSV", speed(folder, minutes, 100.0, "csv")
        yield "at 1 kHz", speed(folder, minutes, 1000.0)
        yield "memory, 100 Hz", memory(folder, minutes, 100.0)
        yield "memory, 1 kHz", memory(folder, minutes, 1000.0)
        yield "one and two workers", workers(folder)
        yield "identify", identify(folder)
    yield from overheads(tasks)
    for count in (1, 8, 64, 512, 4096):
        yield (
            "1000 arms, a year",
            simulated(
                1e-6 * slow["microseconds_per_sample"], 6e7 / minutes * slow["log_mb"], count
            ),
        )


def overheads(tasks: int) -> Iterator[tuple[str, dict[str, float]]]:
    """Yield the overhead of tasks on a process pool and on Dask."""
    yield "overhead of a process pool", overhead(tasks)
    yield "overhead of Dask", on_dask(tasks)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--tasks", type=int, default=10_000)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--overhead", action="store_true", help="that of the workers alone")
    given = parser.parse_args()
    found = overheads(given.tasks) if given.overhead else results(given.tasks, given.minutes)
    for title, values in found:
        print(
            title, json.dumps({key: round(value, 4) for key, value in values.items()}), flush=True
        )
