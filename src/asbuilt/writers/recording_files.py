"""Recordings as files that `asbuilt identify` and other programs read, and the truth behind simulated ones."""

from __future__ import annotations

import io
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from asbuilt.errors import UsageError
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.simulation import SimulatedRecording
from asbuilt.writers.files import atomic_write
from asbuilt.writers.robot_toml import write_robot_toml
from asbuilt.writers.tabular import write_json


def write_recording(path: str | os.PathLike[str], recording: Recording) -> Path:
    """Write a recording as CSV or Parquet, by suffix: `t`, then `q_NAME`, `qd_NAME` where logged, and `tau_NAME` for every joint."""
    suffix = Path(path).suffix.lower()
    if suffix not in (".csv", ".parquet"):
        raise UsageError(f"a recording is written as .csv or .parquet, not as {Path(path).name!r}")
    columns: dict[str, Any] = {"t": recording.t}
    for letter, values in (("q", recording.q), ("qd", recording.qd), ("qdd", recording.qdd), ("tau", recording.tau)):
        if values is not None:
            columns |= {f"{letter}_{name}": np.ascontiguousarray(values[:, k]) for k, name in enumerate(recording.joint_names)}
    content = io.BytesIO()
    frame = pl.DataFrame(columns)
    if suffix == ".csv":
        frame.write_csv(content)
    else:
        frame.write_parquet(content)
    return atomic_write(path, content.getvalue())


def write_simulation(path: str | os.PathLike[str], simulated: SimulatedRecording) -> dict[str, Path]:
    """Write a simulated recording and beside it the parameters (JSON) and the robot (TOML) that made it."""
    log = write_recording(path, simulated.recording)
    truth = write_json(log.with_name(f"{log.stem}_truth.json"), truth_document(simulated))
    robot = write_robot_toml(log.with_name(f"{log.stem}_robot.toml"), simulated.model)
    return {"recording": log, "truth": truth, "robot": robot}


def truth_document(simulated: SimulatedRecording) -> dict[str, Any]:
    """Return the true standard parameters by name, and how the recording was made."""
    return {
        "robot": simulated.model.name,
        "drive": str(simulated.drive),
        "gravity": simulated.model.gravity.tolist(),
        "parameters": dict(zip(simulated.names, simulated.truth.tolist(), strict=True)),
        "notes": list(simulated.recording.notes),
        "settings": dict(simulated.settings),
    }


def simulate_document(simulated: SimulatedRecording, files: Mapping[str, Path]) -> dict[str, Any]:
    """Return what `asbuilt simulate --json` prints."""
    recording = simulated.recording
    return {
        "robot": simulated.model.name,
        "n_samples": recording.n_samples,
        "rate": recording.rate,
        "duration": recording.duration,
        "joints": list(recording.joint_names),
        "drive": str(simulated.drive),
        "files": {kind: str(path) for kind, path in files.items()},
    }
