"""Torques or currents that are logged without a sign."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from asbuilt.arrays import Array
from asbuilt.experiment.command.magnitude import (
    MagnitudeLaw,
    is_magnitude,
    magnitude_laws,
)
from asbuilt.experiment.quality.running_statistics import Extremes
from asbuilt.experiment.recording import Recording
from asbuilt.findings import Cure, Finding, joined

FEWEST_JOINTS = 2
"""Joints from which it is no accident that none has a torque of the other sign."""


def unsigned_findings(measured: Extremes, beginning: Recording) -> Iterator[Finding]:
    """Find torques that are never negative at any joint, though joints move both ways.

    `measured` are the extremes of the torques, `beginning` the first samples of the recording,
    whose commands, if there are any, say what was logged.
    """
    if not is_unsigned(measured.low, measured.high) or not _reverses(beginning):
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
    return bool(np.count_nonzero(used) >= FEWEST_JOINTS and np.all(np.asarray(low) >= 0.0))


def _reverses(recording: Recording) -> bool:
    """Whether a joint with magnitudes moves both ways, for a tenth of its way at least."""
    for q, tau in zip(recording.q.T, recording.tau.T, strict=True):
        moved = np.diff(q[np.isfinite(q)])
        forth, back = float(moved[moved > 0].sum()), float(-moved[moved < 0].sum())
        if is_magnitude(tau) and min(forth, back) > 0.1 * max(forth, back):
            return True
    return False
