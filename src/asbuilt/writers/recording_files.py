"""Recordings as files that `asbuilt identify` and other programs read, and the truth behind
simulated ones.
"""

from __future__ import annotations

import io
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import tomli_w

from asbuilt.description.model import PLAIN_TERMS, DriveValues, RobotModel
from asbuilt.errors import UsageError
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.virtual.simulation import SimulatedRecording
from asbuilt.writers.files import atomic_write, path_texts
from asbuilt.writers.models.robot_toml import write_robot_toml
from asbuilt.writers.tables.tabular import write_json


def write_recording(path: str | os.PathLike[str], recording: Recording) -> Path:
    """Write a recording as CSV or Parquet, by suffix.

    `t`, then `q_NAME`, `qd_NAME` where logged, and `tau_NAME` for every joint.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in (".csv", ".parquet"):
        raise UsageError(f"a recording is written as .csv or .parquet, not as {Path(path).name!r}")
    columns: dict[str, Any] = {"t": recording.t}
    for symbol, values in (
        ("q", recording.q),
        ("qd", recording.qd),
        ("qdd", recording.qdd),
        ("tau", recording.tau),
    ):
        if values is not None:
            columns |= {
                f"{symbol}_{name}": np.ascontiguousarray(values[:, k])
                for k, name in enumerate(recording.joint_names)
            }
    content = io.BytesIO()
    frame = pl.DataFrame(columns)
    if suffix == ".csv":
        frame.write_csv(content)
    else:
        frame.write_parquet(content)
    return atomic_write(path, content.getvalue())


def write_simulation(
    path: str | os.PathLike[str], simulated: SimulatedRecording
) -> dict[str, Path]:
    """Write a simulated recording, the sheet that says what its torques are (LOG.toml), and the
    parameters (JSON) and the robot (TOML) that made it.
    """
    log = write_recording(path, simulated.recording)
    sheet = atomic_write(
        log.with_name(f"{log.name}.toml"), _sheet_text(simulated.recording, log.name)
    )
    truth = write_json(log.with_name(f"{log.stem}_truth.json"), truth_document(simulated))
    robot = write_robot_toml(log.with_name(f"{log.stem}_robot.toml"), robot_that_moved(simulated))
    return {"recording": log, "sheet": sheet, "truth": truth, "robot": robot}


def robot_that_moved(simulated: SimulatedRecording) -> RobotModel:
    """Return the robot behind a recording with the drive values that its logged torques contain."""
    model, drive = simulated.model, simulated.drive
    values = simulated.truth[len(model.parameters) :].reshape(model.n_joints, -1)
    keys = [term.key for term in drive.terms for _ in term.symbols]
    joints = []
    for joint, own in zip(model.joints, values, strict=True):
        plain = {
            key: float(value) for key, value in zip(keys, own, strict=True) if key in PLAIN_TERMS
        }
        joints.append(
            replace(
                joint,
                drive=DriveValues(
                    **plain, gear_ratio=joint.drive.gear_ratio, terms=joint.drive.terms
                ),
            )
        )
    return replace(model, joints=tuple(joints))


def _sheet_text(recording: Recording, log: str) -> str:
    told = f"# Recording sheet of {log}, which asbuilt reads beside it: what its torques are.\n"
    if recording.torque_source == "current":
        told += (
            "# Currents times the nominal torque constant [N m]; gains = [...] takes corrections of"
            " it, such as `asbuilt gains` finds.\n"
        )
    return told + tomli_w.dumps({"torque_source": recording.torque_source})


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
        "files": path_texts(files),
    }
