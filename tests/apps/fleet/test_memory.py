"""Memory of a worker, beside that of the process that reads for it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from asbuilt.description import bundled_robot
from asbuilt.dynamics import inverse_dynamics

ROBOT = "kuka-iiwa7-r800"
MOST = 700.0
"""Megabytes."""
PROGRAM = """
import re, sys
from pathlib import Path
from asbuilt import FleetOptions, add_logs
ledger, robot, log = sys.argv[1:]
done = add_logs(ledger, robot, [log], robot_id="R", fleet=FleetOptions(workers=0))
assert done.fixed and len(done.added) == 1, done.failed
print(int(re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())[1]) / 1024)
"""


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="reads the peak from /proc")
@pytest.mark.study
def test_the_first_log_of_a_type_is_read_in_chunks_too(tmp_path: Path) -> None:
    """20 minutes at 1 kHz, 144 MB in memory; `ru_maxrss` would count what this process holds."""
    model, rng = bundled_robot(ROBOT), np.random.default_rng(1)
    t = np.arange(1_200_000) / 1000.0
    q, qd, qdd = (np.zeros((t.size, model.n_joints)) for _ in range(3))
    for k in range(model.n_joints):
        for w in 2.0 * np.pi * np.array([0.05, 0.13, 0.31]) * (1.0 + 0.07 * k):
            sine, cosine = np.sin(w * t + k), np.cos(w * t + k)
            q[:, k] += 0.4 * sine
            qd[:, k] += 0.4 * w * cosine
            qdd[:, k] -= 0.4 * w**2 * sine
    tau = inverse_dynamics(model, q, qd, qdd) + 2.0 * np.sign(qd) + rng.normal(size=q.shape)
    q += 1e-5 * rng.normal(size=q.shape)
    columns = {"t": t} | {f"q_{k}": q[:, k] for k in range(7)}
    log = tmp_path / "run_2026-03-01.parquet"
    pl.DataFrame(columns | {f"tau_{k}": tau[:, k] for k in range(7)}).write_parquet(log)
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(tmp_path / "ledger"), ROBOT, str(log)],
        check=False,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert float(done.stdout) < MOST
