"""Time from samples to solved parameters, 43 base + 21 drive columns, against Pinocchio from Python and `numpy.linalg.lstsq`.

`python benchmarks/factor.py --hour` adds an hour at 1 kHz read from Parquet: wall time and peak memory of a process that does nothing else.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pinocchio as pin
import polars as pl
from scipy.linalg import qr

from asbuilt.description.load import load_robot
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base_parameters import find_base_parameters
from asbuilt.dynamics.blas import one_blas_thread
from asbuilt.dynamics.drive_torque import drive_torque
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.dynamics.newton_euler import inverse_dynamics
from asbuilt.experiment.parallel_filter import design_parallel_filter
from asbuilt.experiment.samples import Samples
from asbuilt.experiment.signal_chain import stream_samples
from asbuilt.experiment.streaming import stream_recording
from asbuilt.identification.consistency import consistency_margin
from asbuilt.identification.identify import conclude, design_values
from asbuilt.identification.least_squares import fit_least_squares
from asbuilt.identification.square_root_information import accumulate, accumulate_stream

ROBOT = "kuka-iiwa7-r800"
DRIVE = "viscous,coulomb,offset"
N_SAMPLES = 100_000
N_PEER = 10_000
RATE = 1000.0
HOUR = 3600.0
CHUNK = 60_000


def best(work: Callable[[], object], n_samples: int, repeats: int) -> float:
    """Return the shortest of several runs [microseconds per sample]; the first call, which compiles, does not count."""
    work()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return min(times) / n_samples * 1e6


def recorded(model: RobotModel, drive: DriveSet, t: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Return q, qd, qdd and noisy tau of a periodic motion at the times t, the same motion for all parts of a recording."""
    n, omega = model.n_joints, 2 * np.pi * 0.1
    shape = np.random.default_rng(7)
    q, qd, qdd = (np.zeros((t.size, n)) for _ in range(3))
    for k in range(1, 6):
        a, b = shape.normal(scale=0.5 / k, size=(2, n))
        c, s = np.cos(k * omega * t)[:, None], np.sin(k * omega * t)[:, None]
        q += a * s + b * c
        qd += k * omega * (a * c - b * s)
        qdd -= (k * omega) ** 2 * (a * s + b * c)
    tau = inverse_dynamics(model, q, qd, qdd) + drive_torque(drive, np.tile([1.0, 2.0, 0.1], n), q, qd, qdd)
    return q, qd, qdd, tau + rng.normal(scale=0.1, size=q.shape)


def peer_solve(
    model: RobotModel, chosen: np.ndarray, peer: pin.Model, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, tau: np.ndarray
) -> np.ndarray:
    """Stack Pinocchio's regressor sample by sample with friction columns and solve by LAPACK's singular values."""
    n, data = model.n_joints, peer.createData()
    w = np.zeros((len(q), n, len(chosen) + 3 * n))
    for i in range(len(q)):
        w[i, :, : len(chosen)] = pin.computeJointTorqueRegressor(peer, data, q[i], qd[i], qdd[i])[:, chosen]
    for k in range(n):
        w[:, k, len(chosen) + 3 * k : len(chosen) + 3 * k + 3] = np.column_stack([qd[:, k], np.sign(qd[:, k]), np.ones(len(q))])
    with one_blas_thread():
        return np.linalg.lstsq(w.reshape(len(q) * n, -1), tau.ravel(), rcond=None)[0]


def pinocchio_model(model: RobotModel) -> pin.Model:
    """Build the same chain in Pinocchio; masses do not matter to a regressor."""
    built, after = pin.Model(), pin.SE3.Identity()
    for i, joint in enumerate(model.joints):
        built.addJoint(i, pin.JointModelRZ(), after * pin.SE3(np.array(joint.before)), joint.name)
        after = pin.SE3(np.array(joint.after))
    return built


def independent_columns(peer: pin.Model, n_base: int, n: int) -> np.ndarray:
    """Return `n_base` independent columns of Pinocchio's regressor."""
    rng, data = np.random.default_rng(0), peer.createData()
    stack = np.vstack([pin.computeJointTorqueRegressor(peer, data, *rng.normal(size=(3, n))) for _ in range(60)])
    return np.sort(qr(stack, mode="r", pivoting=True)[1][:n_base])


def measure(*, hour: bool = False) -> dict[str, float | str]:
    """Return microseconds per sample, milliseconds and ratios to the peer."""
    model, drive = load_robot(ROBOT), DriveSet.parse(DRIVE)
    base = find_base_parameters(model, drive)
    t = np.arange(N_SAMPLES) / RATE
    q, qd, qdd, tau = recorded(model, drive, t, np.random.default_rng(0))
    samples = Samples(t, q, qd, qdd, tau, rate=RATE, joint_names=model.joint_names)
    parallel = Samples(t, q, qd, qdd, tau, rate=RATE, joint_names=model.joint_names, parallel=design_parallel_filter(10.0, RATE, 20))
    peer = pinocchio_model(model)
    chosen = independent_columns(peer, base.n_base - 3 * model.n_joints, model.n_joints)
    part = tuple(array[:N_PEER] for array in (q, qd, qdd, tau))

    ours = best(lambda: accumulate(model, base, samples, threads=1), N_SAMPLES, 5)
    theirs = best(lambda: peer_solve(model, chosen, peer, *part), N_PEER, 2)
    information = accumulate(model, base, samples)
    estimate = fit_least_squares(information, weights="joint", prior=design_values(model, base))
    numbers: dict[str, float | str] = {
        "regressor_and_factor_us_per_sample": ours,
        "regressor_and_factor_two_threads_us_per_sample": best(lambda: accumulate(model, base, samples, threads=2), N_SAMPLES, 5),
        "regressor_filter_and_factor_us_per_sample": best(lambda: accumulate(model, base, parallel, threads=1), N_SAMPLES, 5),
        "pinocchio_from_python_and_lstsq_us_per_sample": theirs,
        "ratio_regressor_and_factor_to_pinocchio_and_lstsq": theirs / ours,
        "weighted_fit_ms": best(lambda: fit_least_squares(information, weights="joint"), 1, 5) / 1e3,
        "consistency_ms": best(lambda: consistency_margin(base, estimate.beta), 1, 5) / 1e3,
    }
    return numbers | (measure_hour() if hour else {})


def measure_hour() -> dict[str, float | str]:
    """Write an hour at 1 kHz as Parquet, then identify it in a fresh process on two threads."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "hour.parquet"
        write_hour(path)
        size = path.stat().st_size / 1e6
        subprocess.run([sys.executable, __file__, "--identify", str(path)], check=True, capture_output=True)
        done = subprocess.run([sys.executable, __file__, "--identify", str(path)], check=True, capture_output=True, text=True)
    return {"hour_file_mb": size} | json.loads(done.stdout)


def write_hour(path: Path) -> None:
    """Write positions and torques of one hour in row groups of a minute."""
    model, drive, rng = load_robot(ROBOT), DriveSet.parse(DRIVE), np.random.default_rng(1)
    parts = []
    for start in range(0, int(HOUR * RATE), CHUNK):
        t = np.arange(start, start + CHUNK) / RATE
        q, _, _, tau = recorded(model, drive, t, rng)
        columns = {"t": t} | {f"q_{k}": q[:, k] for k in range(7)} | {f"tau_{k}": tau[:, k] for k in range(7)}
        parts.append(path.with_name(f"part_{start:08d}.parquet"))
        pl.DataFrame(columns).write_parquet(parts[-1])
    pl.scan_parquet(parts).sink_parquet(path, row_group_size=CHUNK)
    for part in parts:
        part.unlink()


def identify_hour(path: Path) -> dict[str, float]:
    """Identify from a file larger than is held in memory; prints its numbers as JSON."""
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
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hour", action="store_true", help="also an hour at 1 kHz from Parquet")
    parser.add_argument("--identify", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.identify:
        print(json.dumps(identify_hour(arguments.identify)))
    else:
        print(json.dumps(measure(hour=arguments.hour), indent=2))
