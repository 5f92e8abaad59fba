"""An hour of a 7-joint arm at 1 kHz, 3.6 million samples in Parquet, identified on two threads.

Wall time and peak memory.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import polars as pl

from asbuilt.description.load import load_robot
from asbuilt.dynamics.base.base_parameters import find_base_parameters
from asbuilt.dynamics.drives.drive_set import DriveSet
from asbuilt.experiment.logs.long_recordings import stream_recording
from asbuilt.experiment.signal.preparation import stream_samples
from asbuilt.identification.bodies.cad_prior import design_values
from asbuilt.identification.estimators.least_squares import fit_least_squares
from asbuilt.identification.information.square_root_information import accumulate_stream
from asbuilt.identification.result.estimate_to_result import conclude
from factor import DRIVE, RATE, ROBOT, recorded

HOUR = 3600.0
CHUNK = 60_000


def measure() -> dict[str, float | str]:
    """Return seconds and megabytes of a process that does nothing else, the second to run after the
    caches are warm.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "hour.parquet"
        write_hour(path)
        size = path.stat().st_size / 1e6
        subprocess.run([sys.executable, __file__, str(path)], check=True, capture_output=True)
        done = subprocess.run(
            [sys.executable, __file__, str(path)], check=True, capture_output=True, text=True
        )
    return {"hour_file_mb": size} | json.loads(done.stdout)


def write_hour(path: Path) -> None:
    """Write positions and torques of one hour in row groups of a minute."""
    model, drive, rng = load_robot(ROBOT), DriveSet.parse(DRIVE), np.random.default_rng(1)
    parts = []
    for start in range(0, int(HOUR * RATE), CHUNK):
        t = np.arange(start, start + CHUNK) / RATE
        q, _, _, tau = recorded(model, drive, t, rng)
        columns = (
            {"t": t}
            | {f"q_{k}": q[:, k] for k in range(7)}
            | {f"tau_{k}": tau[:, k] for k in range(7)}
        )
        parts.append(path.with_name(f"part_{start:08d}.parquet"))
        pl.DataFrame(columns).write_parquet(parts[-1])
    pl.scan_parquet(parts).sink_parquet(path, row_group_size=CHUNK)
    for part in parts:
        part.unlink()


def identify_hour(path: Path) -> dict[str, float]:
    """Identify from a file larger than is held in memory."""
    model, drive = load_robot(ROBOT), DriveSet.parse(DRIVE)
    start = time.perf_counter()
    base = find_base_parameters(model, drive)
    stream = stream_samples(stream_recording(path, model=model, chunk_samples=CHUNK))
    information = accumulate_stream(model, base, stream, threads=2)
    estimate = fit_least_squares(information, weights="joint", prior=design_values(model, base))
    result = conclude(model, information, estimate, rate=information.n_samples / HOUR)
    return {
        "hour_s": time.perf_counter() - start,
        "hour_peak_memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3,
        "hour_relative_error": result.train.relative_error,
        "hour_samples_used": float(result.n_samples),
        "hour_blocks": float(information.n_blocks),
    }


if __name__ == "__main__":
    print(json.dumps(identify_hour(Path(sys.argv[1]))))
