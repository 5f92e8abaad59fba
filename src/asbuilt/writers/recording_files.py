"""Files of recordings and motions, and of simulated ones with the truth behind them."""

from __future__ import annotations

import io
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import tomli_w

from asbuilt import writers
from asbuilt.arrays import Array
from asbuilt.description.model import PLAIN_TERMS, DriveValues, RobotModel
from asbuilt.errors import MotionError, UsageError
from asbuilt.excitation import Motion, Trajectory, times_to_end
from asbuilt.experiment import FreeMotion, Recording, SimulatedRecording
from asbuilt.tables import round_significant, wrap_text
from asbuilt.writers.files import path_texts
from asbuilt.writers.models.robot_toml import write_robot_toml
from asbuilt.writers.tables.tabular import write_json
from asbuilt.writing import atomic_write

WHAT = {
    "drop": "released at rest, drives without torque",
    "step": "a step of all joints under a controller of 3 Hz",
    "free": "free motion without friction or drive torque",
}


def write_recording(path: str | os.PathLike[str], recording: Recording) -> Path:
    """Write a recording as CSV or Parquet, by suffix.

    The columns are `t`, then `q_NAME`, `qd_NAME` and `qdd_NAME` if logged, and `tau_NAME` of every
    joint, or `command_NAME` if the torque was computed from the command.

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
    command = recording.driving_command
    logged = {"q": recording.q, "qd": recording.qd, "qdd": recording.qdd}
    logged |= {"tau": recording.tau} if command is None else {"command": command}
    return write_columns(path, recording.t, recording.joint_names, logged)


def write_log(path: str | os.PathLike[str], recording: Recording) -> dict[str, Path]:
    """Write a recording with the sheet that says what its torques are, and return both by kind."""
    log = write_recording(path, recording)
    sheet = log.with_name(f"{log.name}.toml")
    atomic_write(sheet, _write_sheet_text(recording, log.name))
    return {"recording": log, "sheet": sheet}


def write_columns(
    path: str | os.PathLike[str],
    t: Array,
    names: Sequence[str],
    quantities: Mapping[str, Array | None],
    more: Mapping[str, Array] | None = None,
) -> Path:
    """Write times (N,), and quantities of all joints (N, n) as `QUANTITY_NAME`, and `more` (N,).

    As Parquet if the suffix is .parquet, else as CSV with the digits that read back to the same
    double.
    """
    of_joints = {
        f"{quantity}_{name}": np.ascontiguousarray(values[:, k])
        for quantity, values in quantities.items()
        if values is not None
        for k, name in enumerate(names)
    }
    frame = pl.DataFrame({"t": t, **of_joints, **(more or {})})
    content = io.BytesIO()
    (frame.write_parquet if Path(path).suffix.lower() == ".parquet" else frame.write_csv)(content)
    return atomic_write(path, content.getvalue())


def write_simulation(
    path: str | os.PathLike[str], simulated: SimulatedRecording
) -> dict[str, Path]:
    """Write a simulated recording, its sheet, and the parameters and the robot behind it.

    The sheet is LOG.toml, the parameters are JSON, the robot is TOML.
    """
    log = write_recording(path, simulated.recording)
    truth = {
        "robot": simulated.model.name,
        "drive": str(simulated.drive),
        "gravity": simulated.model.gravity.tolist(),
        "parameters": dict(zip(simulated.names, simulated.truth.tolist(), strict=True)),
        "notes": list(simulated.recording.notes),
        "settings": dict(simulated.settings),
    }
    sheet = _write_sheet_text(simulated.recording, log.name)
    robot = restore_moved_robot(simulated)
    return {
        "recording": log,
        "sheet": atomic_write(log.with_name(f"{log.name}.toml"), sheet),
        "truth": write_json(log.with_name(f"{log.stem}_truth.json"), truth),
        "robot": write_robot_toml(log.with_name(f"{log.stem}_robot.toml"), robot),
    }


def restore_moved_robot(simulated: SimulatedRecording) -> RobotModel:
    """Return the robot that moved, with the drive values that its logged torques contain."""
    model = simulated.model
    drive = simulated.drive
    values = simulated.truth[len(model.parameters) :].reshape(model.n_joints, -1)
    keys = [term.key for term in drive.terms for _ in term.symbols]
    joints = []
    for joint, own in zip(model.joints, values.tolist(), strict=True):
        plain = {key: value for key, value in zip(keys, own, strict=True) if key in PLAIN_TERMS}
        known = DriveValues(**plain, gear_ratio=joint.drive.gear_ratio, terms=joint.drive.terms)
        joints.append(replace(joint, drive=known))
    return replace(model, joints=tuple(joints))


def _write_sheet_text(recording: Recording, log: str) -> str:
    currents = (
        "# Currents times the nominal torque constant [N m]; gains = [...] holds corrections of it,"
        " from a payload of known mass.\n"
    )
    sheet: dict[str, Any] = {"torque_source": recording.torque_source}
    law = recording.drive_law
    if law is not None:
        known = {
            "kp": True,
            "kd": True,
            "torque_limit": np.all(np.isfinite(law.torque_limit)),
            "deadband": np.any(law.deadband),
            "lead": np.any(law.leads),
            "no_load_speed": np.all(np.isfinite(law.no_load_speed)),
        }
        given = {name: getattr(law, name) for name, is_known in known.items() if is_known}
        # One number where all are alike.
        sheet |= {k: v[0] if len(set(v)) == 1 else list(v) for k, v in given.items()}
    return (
        f"# Recording sheet of {log}, read together with it.\n"
        + (currents if recording.torque_source == "current" else "")
        + tomli_w.dumps(sheet)
    )


def simulation_text(simulated: SimulatedRecording) -> str:
    """Return how a recording was simulated, in lines of 80 columns."""
    recording = simulated.recording
    head = (
        f"{simulated.model.name}: {recording.n_samples} samples x {recording.n_joints} joints,"
        f" {recording.duration:.4g} s at {recording.rate:.4g} Hz"
    )
    return "\n".join([head, *map(wrap_text, recording.notes)])


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


def write_motion(
    path: str | os.PathLike[str],
    motion: Motion | Trajectory,
    joint_names: Sequence[str],
    rate: float = 1000.0,
) -> Path:
    """Write a motion, sampled at `rate` [Hz], or a trajectory as CSV.

    Numbers have the digits that read back to the same double.

    The end of a motion is its last line whatever the rate, so that a motion that ends at rest does
    so in the file. Raises MotionError if names and joints do not go together, UsageError if the
    place is not writable.
    """
    trajectory = motion
    if not isinstance(trajectory, Trajectory):
        t = times_to_end(trajectory, rate)
        trajectory = Trajectory(t, *trajectory.at(t))
    names = tuple(joint_names)
    if len(names) != trajectory.n_joints or len(set(names)) != len(names):
        raise MotionError(
            f"a motion of {trajectory.n_joints} joints needs as many different names, got"
            f" {', '.join(names) or 'none'}"
        )
    states = {"q": trajectory.q, "qd": trajectory.qd, "qdd": trajectory.qdd}
    return write_columns(path, trajectory.t, names, states)


def write_free_motion(path: Path, motion: FreeMotion) -> dict[str, Path]:
    """Write positions, velocities, torques and energies as CSV, and a figure of them as PNG."""
    states, energies = (
        {name: getattr(motion, name) for name in names}
        for names in (("q", "qd", "tau"), ("kinetic", "potential", "work", "dissipated"))
    )
    figure = writers.energy_figure(motion, title=f"{motion.model.name}: {WHAT[motion.release]}")
    return {
        "motion": write_columns(path, motion.t, motion.model.joint_names, states, energies),
        "figure": writers.save_figure(figure, path.with_suffix(".png")),
    }


def free_motion_document(motion: FreeMotion, files: Mapping[str, Path]) -> dict[str, Any]:
    """Return what `asbuilt simulate --free --json` prints; energies in J."""
    return {
        "robot": motion.model.name,
        "release": motion.release,
        "duration": float(motion.t[-1]),
        "n_samples": int(motion.t.size),
        "joints": list(motion.model.joint_names),
        "start": motion.q[0].tolist(),
        "end": motion.q[-1].tolist(),
        "largest_velocity": np.max(np.abs(motion.qd), axis=0).tolist(),
        "energy": {
            "largest_kinetic": float(motion.kinetic.max()),
            "lowest_potential": float(motion.potential.min()),
            "work": float(motion.work[-1]),
            "dissipated": float(motion.dissipated[-1]),
            "imbalance": motion.imbalance,
        },
        "files": path_texts(files),
    }


def free_motion_text(motion: FreeMotion) -> str:
    """Return the energy balance in three lines."""
    energies = motion.kinetic.max(), motion.potential.min(), motion.work[-1], motion.dissipated[-1]
    kinetic, potential, work, dissipated = map(round_significant, energies)
    return (
        f"{motion.model.name}, {WHAT[motion.release]}, {motion.t[-1]:g} s\n"
        f"kinetic energy up to {kinetic} J, potential energy down to {potential} J\n"
        f"work of the drives {work} J, dissipated {dissipated} J; error of the balance"
        f" {motion.imbalance:.1e}"
    )
