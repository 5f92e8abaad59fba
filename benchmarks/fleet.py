"""Logs reduced for a ledger: speed with reading, workers, overhead, memory, sizes, and a simulation
of 1000 arms over a year.

    python benchmarks/fleet.py [--tasks 10000] [--minutes 60]
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
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import polars as pl

from asbuilt.description.load import load_robot
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.executor import open_workers
from asbuilt.experiment.logs.options import ReadingOptions
from asbuilt.experiment.logs.recordings import as_recordings
from asbuilt.identification.information.square_root_information import accumulate_stream
from asbuilt.workflow.fleet.identification import FleetIdentification, fleet_identify
from asbuilt.workflow.fleet.ledger.ledger import open_ledger
from asbuilt.workflow.fleet.reduction.add import FleetOptions, add_logs
from asbuilt.workflow.prepare import prepare
from factor import DRIVE, ROBOT, recorded

READING = ReadingOptions(torque_source="sensor")
ARMS, DAYS, HOURS, RATE = 1000, 365, 1.0, 100.0
COLUMNS = 15
"""Columns of a log that counts as raw: time, 7 positions, 7 torques, 8 bytes each."""
TASK = 0.01


def write_log(path: Path, seconds: float, rate: float, seed: int) -> Path:
    """Write a log of positions and torques as Parquet."""
    model, drive, rng = load_robot(ROBOT), DriveSet.parse(DRIVE), np.random.default_rng(seed)
    q, _, _, tau = recorded(model, drive, np.arange(0.0, seconds, 1.0 / rate) + seed, rng)
    columns = {"t": np.arange(len(q)) / rate}
    columns |= {f"q_{k}": q[:, k] for k in range(7)} | {f"tau_{k}": tau[:, k] for k in range(7)}
    pl.DataFrame(columns).write_parquet(path)
    return path


def speed(folder: Path, minutes: float, rate: float) -> dict[str, float]:
    """Return CPU seconds of a log, reading included, and of its parts in memory."""
    log = write_log(folder / f"{rate:.0f}_2026-03-01.parquet", 60.0 * minutes, rate, 1)
    ledger = folder / f"ledger{rate:.0f}"

    def added() -> float:
        began = _cpu()
        add_logs(ledger, ROBOT, [log], robot_id=f"R{began}", reading=READING, fleet=HERE)
        return _cpu() - began

    added()
    whole = min(added() for _ in range(3))
    settings = next(iter(open_ledger(str(ledger)).types().values()))
    read = as_recordings(settings.model, [log], READING)

    def timed() -> tuple[float, float]:
        began = _cpu()
        training = prepare(settings.model, read, chain=settings.chain, checked=False).training
        middle = _cpu()
        accumulate_stream(settings.model, settings.base, training, threads=1)
        return middle - began, _cpu() - middle

    chain, factor = (min(each) for each in zip(*(timed() for _ in range(3)), strict=True))
    entry = next(ledger.rglob("*.parquet")).stat().st_size
    n = 60.0 * minutes * rate
    return {
        "samples": n,
        "microseconds_per_sample": 1e6 * whole / n,
        "factor_share": factor / whole,
        "chain_and_factor_share": (chain + factor) / whole,
        "log_mb": log.stat().st_size / 1e6,
        "entry_mb": entry / 1e6,
        "entry_of_raw_hour": entry / (3600.0 * rate * COLUMNS * 8),
    }


HERE = FleetOptions(workers=0)


def _cpu() -> float:
    """CPU seconds of this process and of those it has waited for."""
    return sum(
        used.ru_utime + used.ru_stime
        for used in map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    )


def memory(folder: Path, minutes: float, rate: float) -> dict[str, float]:
    """Return the peak memory [MB] of a worker that reduces a log, its reader apart."""
    log = write_log(folder / f"m{rate:.0f}_2026-03-01.parquet", 60.0 * minutes, rate, 1)
    code = (
        "import resource, sys; from asbuilt import add_logs, FleetOptions, ReadingOptions;"
        f" done = add_logs(sys.argv[1], {ROBOT!r}, [sys.argv[2]], robot_id='R',"
        " reading=ReadingOptions(torque_source='sensor'), fleet=FleetOptions(workers=0));"
        " assert done.added, done.failed;"
        " print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(folder / f"m{rate:.0f}"), str(log)],
        check=True,
        capture_output=True,
        text=True,
    )
    return {"log_mb": log.stat().st_size / 1e6, "peak_mb": float(done.stdout)}


def workers(folder: Path, count: int = 12) -> dict[str, float]:
    """Return wall seconds of many logs on one and on two workers, start of the pool excluded."""
    logs = [
        write_log(folder / f"w_2026-04-{k:02d}.parquet", 600.0, 100.0, k)
        for k in range(1, count + 1)
    ]
    found = {}
    for n in (1, 2):
        times: list[float] = []

        def note(what: str, fraction: float, times: list[float] = times) -> None:
            times.append(time.monotonic())

        add_logs(
            folder / f"by{n}",
            ROBOT,
            logs,
            robot_id="R",
            reading=READING,
            fleet=FleetOptions(workers=n),
            progress=note,
        )
        found[f"seconds_{n}"] = times[-1] - times[0]
    return found | {"ratio": found["seconds_1"] / found["seconds_2"]}


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
        yield "at 1 kHz", speed(folder, minutes / 5.0, 1000.0)
        yield "memory, 100 Hz", memory(folder, minutes, 100.0)
        yield "memory, 1 kHz", memory(folder, minutes, 1000.0)
        yield "one and two workers", workers(folder)
        yield "identify", identify(folder)
    yield "overhead of a process pool", overhead(tasks)
    yield "overhead of Dask", on_dask(tasks)
    for count in (1, 8, 64, 512, 4096):
        yield (
            "1000 arms, a year",
            simulated(
                1e-6 * slow["microseconds_per_sample"], 6e7 / minutes * slow["log_mb"], count
            ),
        )


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--tasks", type=int, default=10_000)
    parser.add_argument("--minutes", type=float, default=60.0)
    given = parser.parse_args()
    for title, values in results(given.tasks, given.minutes):
        print(
            title, json.dumps({key: round(value, 4) for key, value in values.items()}), flush=True
        )
