"""Files of a free motion: table, figure, text."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from asbuilt.experiment.virtual.free_motion import FreeMotion
from asbuilt.tables import significant
from asbuilt.writers.figures.energy_figure import energy_figure
from asbuilt.writers.figures.figure_style import save_figure
from asbuilt.writers.files import atomic_write, path_texts

WHAT = {
    "drop": "released at rest, drives without torque",
    "step": "a step of all joints under a controller of 3 Hz",
    "free": "free motion without friction or drive torque",
}


def write_free_motion(path: Path, motion: FreeMotion) -> dict[str, Path]:
    """Write positions, velocities, torques and energies as CSV, and a figure of them as PNG."""
    columns: dict[str, Any] = {"t": motion.t}
    for symbol, values in (("q", motion.q), ("qd", motion.qd), ("tau", motion.tau)):
        columns |= {
            f"{symbol}_{name}": values[:, k] for k, name in enumerate(motion.model.joint_names)
        }
    columns |= {
        name: getattr(motion, name) for name in ("kinetic", "potential", "work", "dissipated")
    }
    content = io.BytesIO()
    pl.DataFrame(columns).write_csv(content)
    table = atomic_write(path, content.getvalue())
    title = f"{motion.model.name}: {WHAT[motion.release]}"
    return {
        "motion": table,
        "figure": save_figure(energy_figure(motion, title=title), table.with_suffix(".png")),
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
    kinetic, potential, work, dissipated = (
        significant(float(value))
        for value in (
            motion.kinetic.max(),
            motion.potential.min(),
            motion.work[-1],
            motion.dissipated[-1],
        )
    )
    return (
        f"{motion.model.name}, {WHAT[motion.release]}, {motion.t[-1]:g} s\n"
        f"kinetic energy up to {kinetic} J, potential energy down to {potential} J\n"
        f"work of the drives {work} J, dissipated {dissipated} J; error of the balance"
        f" {motion.imbalance:.1e}"
    )
