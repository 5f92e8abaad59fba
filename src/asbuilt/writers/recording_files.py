"""Files of recordings, and of the truth behind simulated ones."""

from __future__ import annotations

import io
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np
import polars as pl
import tomli_w

from asbuilt.description.model import PLAIN_TERMS, DriveValues, RobotModel
from asbuilt.errors import UsageError
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.virtual.virtual_robot import SimulatedRecording
from asbuilt.writers.files import atomic_write, path_texts
from asbuilt.writers.models.robot_toml import write_robot_toml
from asbuilt.writers.tables.tabular import write_json


def write_recording(path: str | os.PathLike[str], recording: Recording) -> Path:
    """Write a recording as CSV or Parquet, by suffix.

    The columns are `t`, then `q_NAME`, `qd_NAME` and `qdd_NAME` if logged, and `tau_NAME` of every
    joint, or `command_NAME` if the torque was computed from the command of a servo.

    Raises
    ------
    UsageError
        If the suffix is another.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in (".csv", ".parquet"):
        raise UsageError(
            f"a recording is written as .csv or .parquet, not as {Path(path).name!r}",
            file=str(path),
            available=(".csv", ".parquet"),
        )
    columns: dict[str, Any] = {"t": recording.t}
    command = recording.command if recording.torque_source == "command" else None
    for symbol, values in (
        ("q", recording.q),
        ("qd", recording.qd),
        ("qdd", recording.qdd),
        ("tau" if command is None else "command", recording.tau if command is None else command),
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
    """Write a simulated recording, its sheet, and the parameters and the robot behind it.

    The sheet is LOG.toml, the parameters are JSON, the robot is TOML.
    """
    log = write_recording(path, simulated.recording)
    sheet = atomic_write(
        log.with_name(f"{log.name}.toml"), _sheet_text(simulated.recording, log.name)
    )
    truth = write_json(log.with_name(f"{log.stem}_truth.json"), truth_document(simulated))
    robot = write_robot_toml(log.with_name(f"{log.stem}_robot.toml"), robot_that_moved(simulated))
    return {"recording": log, "sheet": sheet, "truth": truth, "robot": robot}


def robot_that_moved(simulated: SimulatedRecording) -> RobotModel:
    """Return the robot that moved, with the drive values that its logged torques contain."""
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
    head = f"# Recording sheet of {log}, read together with it.\n"
    if recording.torque_source == "current":
        head += (
            "# Currents times the nominal torque constant [N m]; gains = [...] holds corrections of"
            " it, from a payload of known mass.\n"
        )
    sheet: dict[str, Any] = {"torque_source": recording.torque_source}
    servo = recording.servo if recording.torque_source == "command" else None
    if servo is not None:
        sheet |= {"kp": _short(servo.kp), "kd": _short(servo.kd)}
        if np.all(np.isfinite(servo.torque_limit)):
            sheet["torque_limit"] = _short(servo.torque_limit)
        if np.any(servo.deadband):
            sheet["deadband"] = _short(servo.deadband)
        if np.any(servo.leads):
            sheet["lead"] = _short(servo.lead)
        if np.all(np.isfinite(servo.no_load_speed)):
            sheet["no_load_speed"] = _short(servo.no_load_speed)
    return head + tomli_w.dumps(sheet)


def _short(values: tuple[float, ...]) -> float | list[float]:
    """Return one number where all are alike."""
    return values[0] if len(set(values)) == 1 else list(values)


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


def simulation_text(simulated: SimulatedRecording) -> str:
    """Return how a recording was simulated, in lines of 80 columns."""
    recording = simulated.recording
    head = (
        f"{simulated.model.name}: {recording.n_samples} samples x {recording.n_joints} joints,"
        f" {recording.duration:.4g} s at {recording.rate:.4g} Hz"
    )
    return "\n".join([head, *(line for note in recording.notes for line in wrap(note, 80))])


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
