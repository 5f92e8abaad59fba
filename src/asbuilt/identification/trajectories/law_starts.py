"""Starts of a refinement under commands: a stiffer servo, a lead in place of a negative delay."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from asbuilt.arrays import Array
from asbuilt.dynamics import PositionServo
from asbuilt.identification.trajectories.objective import Objective, Point
from asbuilt.identification.trajectories.refinement import Steps, refine
from asbuilt.identification.trajectories.simulated_robot import FittedLaw, ServoCoordinates

STIFFER = 4.0
"""Factor of the stiffness of the other start of an unknown servo."""
CHANCE = 4.5
"""Fall of the logarithmic likelihood beyond chance: three standard errors of a number."""
FEW = Steps(rounds=1, most=8)
FEWEST = Steps(rounds=1, most=4)
"""Steps by which starts are compared: two, and many that lie along a valley."""
LATE = (0.0, 0.005, 0.01, 0.015, 0.02)
"""Delays [s] from which the search for a lead starts: positions of servo and log are up to a
sample late."""


@dataclass(frozen=True, slots=True)
class RefinedLaw:
    """Hold the servo as refined; None where torques drove the robot.

    `delay_error`, `stiffness_error` and `lead_error` are standard errors of delay [s], relative
    stiffness, and lead [s]; NaN if not fitted.
    """

    servo: PositionServo | None
    delay_error: float
    stiffness_error: float
    lead_error: float


def derive_refined_law(objective: Objective, point: Point, covariance: Array) -> RefinedLaw:
    """Return the law at a point, with errors by the covariance of parameters of base and law."""
    law = objective.start.law
    first = objective.trajectories.base.n_base
    errors = np.sqrt(np.diag(covariance))
    kp = 1.0 if law.servo is None else max(law.servo.kp[0], np.finfo(np.float64).tiny)
    return RefinedLaw(
        point.law.servo,
        delay_error=float(errors[-2]) if law.free.delay else np.nan,
        stiffness_error=float(errors[first] / kp) if law.free.stiffness else np.nan,
        lead_error=float(errors[-1]) if law.free.lead else np.nan,
    )


def choose_starts(
    objective: Objective, first: Point, wanted: ServoCoordinates | None, *, begun: bool
) -> tuple[Objective, Point]:
    """Return objective and start from which a search leads lowest.

    `wanted` is what may be fitted of the law, `begun` whether trajectories have found the start
    before, so that no other one is tried.
    """
    servo = first.law.servo
    if servo is None:
        return objective, first
    if first.law.free.stiffness and not begun:
        first = _choose_stiffness(objective, first, servo)
    if wanted is None or not wanted.lead:
        return objective, first
    if any(servo.lead):
        known = replace(objective.start.law, free=wanted)
        objective = replace(objective, start=replace(objective.start, law=known))
        return objective, replace(first, law=replace(first.law, free=wanted))
    return _try_lead(objective, first, servo)


def _choose_stiffness(objective: Objective, start: Point, servo: PositionServo) -> Point:
    """Return the start, or one with stiffer servos and no delay, after a few steps of each.

    Stiffness, damping and delay of an unknown servo trade off, so that a search may miss the
    best of them; a few steps show which start leads lower under the same weights.
    """
    chi = start.chi.copy()
    links = 10 * objective.n_links
    chi[:links] = objective.prior.parameters[:links]
    chi[links:] *= STIFFER
    stiffer = replace(servo, kp=tuple(STIFFER * kp for kp in servo.kp), delay=0.0)
    other = replace(start, chi=chi, law=replace(start.law, servo=stiffer))
    tried = [refine(objective, begin, steps=FEW) for begin in (start, other)]
    costs = [objective.cost(found.point, found.motions, tried[0].weights) for found in tried]
    return tried[int(np.argmin(costs))].point


def _try_lead(objective: Objective, start: Point, servo: PositionServo) -> tuple[Objective, Point]:
    """Return objective and start with a lead and no delay in place of a delay below zero.

    They are as they were if that explains the trajectories worse by more than chance. The
    derivative gain of such a servo answers a step of the command with all the torque that it has,
    so the torque limits of the description hold unless others are stated.
    """
    described = np.array([joint.limits.torque for joint in objective.trajectories.model.joints])
    stated = np.array(servo.torque_limit)
    limits = tuple(np.where(np.isfinite(stated), stated, described).tolist())
    free = replace(objective.start.law.free, lead=True)

    def leading(servo: PositionServo, late: float = 0.0) -> FittedLaw:
        lead = np.maximum(servo.leads - (servo.delay or 0.0), 0.0) + late
        ahead = replace(servo, delay=late, lead=tuple(lead.tolist()), torque_limit=limits)
        return FittedLaw(ahead, free)

    ahead = replace(objective, start=replace(objective.start, law=leading(servo)))
    plain = refine(objective, start, steps=FEW)
    built = plain.point.law.servo
    if built is None or not (built.delay or 0.0) < 0.0:
        return objective, start
    # delay and lead trade off along a valley that steps of the command make rough
    tried = [
        refine(ahead, replace(plain.point, law=leading(built, late)), steps=FEWEST) for late in LATE
    ]
    costs = [ahead.cost(found.point, found.motions, plain.weights) for found in tried]
    other = refine(ahead, tried[int(np.argmin(costs))].point, steps=FEW)
    worse = ahead.cost(other.point, other.motions, plain.weights) - objective.cost(
        plain.point, plain.motions, plain.weights
    )
    return (objective, plain.point) if worse > CHANCE else (ahead, other.point)
