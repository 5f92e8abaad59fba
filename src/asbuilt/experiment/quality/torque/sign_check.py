"""Torques or currents that are logged without a sign."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from asbuilt.arrays import Array, Mask
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.newton_euler import inverse_dynamics
from asbuilt.experiment.command.magnitude import (
    MagnitudeLaw,
    is_magnitude,
    magnitude_laws,
)
from asbuilt.experiment.quality.running_statistics import Extremes
from asbuilt.experiment.recording import Recording
from asbuilt.findings import Cure, Finding, joined


def unsigned_findings(
    model: RobotModel, measured: Extremes, beginning: Recording
) -> Iterator[Finding]:
    """Find torques that are never negative at any joint, though joints move both ways.

    `measured` are the extremes of the torques, `beginning` the first samples of the recording,
    whose commands, if there are any, say what was logged. A joint that the model's gravity always
    loads in the positive direction says nothing.
    """
    high = np.where(_held_up(model, beginning), 0.0, measured.high)
    if not is_unsigned(measured.low, high):
        return
    if not _reverses(beginning):
        return
    laws = magnitude_laws(beginning)
    if laws and all(law is not None and law.holds and law.kind == "motor" for law in laws):
        cure = Cure(
            'write sign = "command" in a recording sheet: the torque then has the sign of the'
            " control error"
        )
    else:
        cure = Cure(
            "use the commanded positions if the log has them, with torque_source = command",
            settings={"torque_source": "command"},
        )
    yield Finding(
        "torque_unsigned",
        "warning",
        "no joint has a negative torque, though they move both ways: the log seems to hold"
        f" magnitudes whose sign is unknown{law_text(beginning.joint_names, laws)}",
        cure,
    )


def law_text(names: Sequence[str], laws: Sequence[MagnitudeLaw | None]) -> str:
    """Return what the command explains of magnitudes, to follow a sentence; empty if nothing."""
    parts = []
    for kind, what in (
        ("motor", "motor currents, in proportion to the torque"),
        ("supply", "supply currents, which grow with the square of the torque"),
    ):
        listed = [
            f"{name} ({100.0 * law.explained:.0f} % explained by the command)"
            for name, law in zip(names, laws, strict=True)
            if law is not None and law.holds and law.kind == kind
        ]
        if listed:
            parts.append(f"those of {joined(listed)} are {what}")
    return f"; {'; '.join(parts)}" if parts else ""


def is_unsigned(low: Array, high: Array) -> bool:
    """Return whether the extremes (n,) of the joints are those of magnitudes."""
    used = np.asarray(high) > 0.0
    # Joints from which it is no accident that none has a torque of the other sign.
    return bool(np.count_nonzero(used) >= 2 and np.all(np.asarray(low) >= 0.0))


def _held_up(model: RobotModel, recording: Recording) -> Mask:
    """Return which joints (n,) bear a weight of one sign, positive, at all positions met."""
    q = recording.q[np.all(np.isfinite(recording.q), axis=1)]
    # Poses of a recording at which gravity is looked at.
    q = q[:: max(1, len(q) // 200)]
    weight = inverse_dynamics(model, q, np.zeros(q.shape), np.zeros(q.shape), threads=1)
    low, high = weight.min(axis=0, initial=np.inf), weight.max(axis=0, initial=0.0)
    # Weight, as a share of the largest, that is none but rounding.
    return np.asarray((low > 0.0) & (low > 1e-6 * high))


def _reverses(recording: Recording) -> bool:
    """Whether a joint with magnitudes moves both ways, for a tenth of its way at least."""
    for q, tau in zip(recording.q.T, recording.tau.T, strict=True):
        moved = np.diff(q[np.isfinite(q)])
        forth, back = float(moved[moved > 0].sum()), float(-moved[moved < 0].sum())
        if is_magnitude(tau) and min(forth, back) > 0.1 * max(forth, back):
            return True
    return False
