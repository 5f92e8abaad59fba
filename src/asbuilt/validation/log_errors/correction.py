"""Errors taken out of a log: its clock, zero positions, scales and drifts."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from asbuilt.arrays import Array
from asbuilt.validation.log_errors.error_columns import Candidate, progress

if TYPE_CHECKING:
    from asbuilt.experiment.signal.samples import Samples

LARGEST_STEP = 0.5
"""Largest step of the logarithm of the clock's rate."""
PER_JOINT = ("zero", "scale", "drift")
"""Kinds of errors that are taken out of the log of one joint."""
DEAD = -0.8
"""Scale below which a torque cannot be divided by it."""


@dataclass(frozen=True, slots=True)
class Correction:
    """Hold what is taken out of a log: clock, zero positions, scales and drifts, (n,) each."""

    zero: Array
    scale: Array
    drift: Array
    clock: float = 1.0

    @classmethod
    def nothing(cls, n: int) -> Correction:
        """Return what takes nothing out of the log of n joints."""
        return cls(np.zeros(n), np.zeros(n), np.zeros(n))

    def taking(self, candidate: Candidate, step: float) -> tuple[Correction, float]:
        """Return this with more taken out, and the step taken, 0 for what stays in the fit."""
        if candidate.kind == "clock":
            step = float(np.clip(step, -LARGEST_STEP, LARGEST_STEP))
            return replace(self, clock=self.clock * float(np.exp(step))), step
        if candidate.kind not in PER_JOINT or candidate.joint is None:
            return self, 0.0
        if candidate.kind == "scale" and step < DEAD:
            return self, 0.0
        held = np.array(getattr(self, candidate.kind))
        held[candidate.joint] += step * (
            1.0 + held[candidate.joint] if candidate.kind == "scale" else 1.0
        )
        changed: dict[str, Any] = {candidate.kind: held}
        return replace(self, **changed), 0.0 if candidate.kind == "drift" else step

    def value(self, candidate: Candidate) -> float | None:
        """Return what was taken out by a candidate; None for what stays in the fit."""
        if candidate.kind == "clock":
            return self.clock - 1.0
        if candidate.kind not in PER_JOINT or candidate.joint is None:
            return None
        held = getattr(self, candidate.kind)
        dead = candidate.kind == "scale" and held[candidate.joint] == 0.0
        return None if dead else float(held[candidate.joint])

    def of(self, samples: Samples) -> Samples:
        """Return samples without these errors."""
        tau = samples.tau - self.drift * progress(samples.t, samples.t)[:, None]
        return replace(
            samples,
            q=samples.q - self.zero,
            qd=samples.qd * self.clock,
            qdd=samples.qdd * self.clock**2,
            tau=tau / (1.0 + self.scale),
        )
