"""Gains and delay of a position servo, found in turn until they settle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from asbuilt.arrays import Array, Mask
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import BaseParameters
from asbuilt.dynamics.drives.position_servo import PositionServo
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.signal.signal_chain import SignalChain
from asbuilt.identification.bodies.cad_prior import CadPrior
from asbuilt.identification.servo.servo_delay import DelayFit, fit_delay
from asbuilt.identification.servo.servo_replay import Replay, replay
from asbuilt.identification.servo.servo_rows import (
    CommandedMotion,
    ServoRows,
    reduce_servo_recordings,
)
from asbuilt.identification.servo.servo_scale import ServoScale, find_scale


@dataclass(frozen=True, slots=True)
class ServoIterations:
    """Say when the delay has settled: at most so many steps, each below `convergence` [s].

    The recordings are replayed so many times, each with the servo that followed from the last.
    """

    most: int = 12
    replays: int = 2
    convergence: float = 2e-5
    longest: float = 0.2


ITERATIONS = ServoIterations()
USUAL_SLOPES = (0.3, 3.0)
"""Range of the slope by which steps fall per delay, 1 if they lead to the best one at once."""


@dataclass(frozen=True, slots=True, eq=False)
class Settled:
    """Hold a servo with the standard error of its delay, and the fit that it rests on.

    `kp` (n,) multiply the signals of the rows: stiffnesses, or 1 where the rows hold them.
    """

    servo: PositionServo
    error: float
    rows: ServoRows
    scale: ServoScale | None
    found: DelayFit
    kp: tuple[float, ...]


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Settling:
    """Hold what gains and delay are found from.

    Parameters
    ----------
    model, base, design
        The robot, its base parameters, and CAD.
    motions, recordings
        Recordings with the servo that each had, but for its gains and delay.
    servo
        What is stated or was found of the servo; an unknown stiffness is NaN.
    chain, holdout
        The signal chain, its cutoff settled, and the rule of what to leave out.
    free_delay
        Whether the delay is identified.
    shared
        Whether all unknown stiffnesses are one.
    """

    model: RobotModel
    base: BaseParameters
    design: CadPrior
    motions: Sequence[CommandedMotion]
    recordings: Sequence[Recording]
    servo: PositionServo
    chain: SignalChain
    free_delay: bool
    shared: bool = False
    holdout: str | None = None

    @property
    def unknown(self) -> Mask:
        """Which stiffnesses are unknown, (n,)."""
        return np.asarray(np.isnan(self.servo.kp))

    def settle(self, late: float) -> tuple[Settled, Replay | None]:
        """Return servo and fit from a first delay [s], and the last replay; None if it diverged.

        Each replay is that of the robot and servo found before, with links that can exist: those
        of a fit without bounds may not.
        """
        at, replayed = self._alternated(late, None), None
        for last in (False,) * (ITERATIONS.replays - 1) + (True,):
            # Smallest eigenvalue of the inertia of a link that is replayed, in that of CAD: own
            # choice.
            replayed = replay(
                self.model,
                self.base,
                self.recordings,
                at.servo,
                self.chain,
                self.design.made_consistent(at.found.parameters, 0.1),
                self.holdout,
                roughly=not last,
            )
            if replayed is None:
                break
            at = self._alternated(at.servo.delay or 0.0, replayed)
        return at, replayed

    def _alternated(self, late: float, replayed: Replay | None) -> Settled:
        """Return the gains and the delay that are found in turn from a start."""
        kd, error = np.nan_to_num(np.array(self.servo.kd)).tolist(), 0.0
        before: tuple[float, float] | None = None
        for _ in range(ITERATIONS.most):
            rows = reduce_servo_recordings(self.motions, self.recordings, late)
            kp, scale = self._gains(rows)
            own = kp.tolist(), kd
            if self.model.contacts:
                own = np.where(self.unknown, kp, 1.0).tolist(), [1.0] * len(kd)
            found = fit_delay(rows, self.base, self.design, *own, replayed)
            if not self.free_delay:
                break
            step, error = _take_secant_step(late, found.step, before), found.std_error
            before = late, found.step
            late = float(np.clip(late + step, -ITERATIONS.longest, ITERATIONS.longest))
            if abs(step) < max(ITERATIONS.convergence, 0.05 * error):
                break
        servo = replace(self.servo, kp=tuple(kp.tolist()), kd=tuple(kd), delay=late)
        return Settled(servo, error, rows, scale, found, tuple(own[0]))

    def _gains(self, rows: ServoRows) -> tuple[Array, ServoScale | None]:
        """Return the stiffness of every joint, and how unknown ones were found."""
        given, unknown = np.array(self.servo.kp), self.unknown
        if not np.any(unknown):
            return given, None
        links = self.design.parameters.copy()
        links[10 * self.model.n_links :] = 0.0
        kd = (1.0,) * unknown.size if self.model.contacts else self.servo.kd
        scale = find_scale(rows, self.base, links, kd, unknown, shared=self.shared)
        return np.where(unknown, np.where(np.isfinite(scale.kp), scale.kp, 1.0), given), scale


def _take_secant_step(late: float, step: float, before: tuple[float, float] | None) -> float:
    """Return how far from a delay its best one lies, by the steps there and at the delay before.

    Steps overshoot, or fall short, by an about constant factor. Without a delay before, or where
    that factor is not usual, it is the step itself.
    """
    if before is None or late == before[0]:
        return step
    slope = (step - before[1]) / (late - before[0])
    return -step / slope if -USUAL_SLOPES[1] < slope < -USUAL_SLOPES[0] else step
