"""A fit to torques continued by a fit to trajectories, and drive terms that these call for."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from asbuilt.arrays import Array, Mask
from asbuilt.description.model import RobotModel
from asbuilt.dynamics import DriveSet, DriveTerm, PositionServo, find_base_parameters
from asbuilt.identification.bodies.cad_prior import CadPrior, build_cad_prior
from asbuilt.identification.estimators.consistent_fit import ConsistentEstimate, fit_toward_cad
from asbuilt.identification.identify import Fit
from asbuilt.identification.trajectories.objective import Objective, Point
from asbuilt.identification.trajectories.refinement import Refinement, Steps, refine
from asbuilt.identification.trajectories.sensitivity import Trajectories
from asbuilt.identification.trajectories.simulated_robot import (
    FittedLaw,
    ServoCoordinates,
    SimulatedRobot,
)
from asbuilt.identification.trajectories.windows import Windows

# Hold weights of a refined fit, and how much is simulated for it.

# Weight of torque rows whose samples are simulated too, so that none counts twice; they decide
# where trajectories leave a direction open
FIT_SAME_SAMPLES = 0.01
# Weight of the divergence of links from CAD: about a third of a link, in every direction
FIT_BELIEF = 10.0
# Time [s] of all windows simulated for a fit; longer recordings give every k-th window
FIT_MOST_SECONDS = 60.0


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


@dataclass(frozen=True, slots=True, eq=False)
class RefinedFit:
    """Hold a fit refined by trajectories.

    Attributes
    ----------
    fit
        The refined fit.
    law
        The law that drives the robot, as refined.
    start, robot
        The robots before and after.
    objective, refinement
        What was minimised, and how the search ended.
    value_errors
        Standard errors of the drive parameters, shape (n, columns_per_joint).
    undetermined
        Parameters of drives and law that stay near the start.
    """

    fit: Fit
    law: RefinedLaw
    start: SimulatedRobot
    robot: SimulatedRobot
    objective: Objective
    refinement: Refinement
    value_errors: Array
    undetermined: tuple[str, ...]


def refine_fit(
    fit: Fit,
    windows: Sequence[Windows],
    law: PositionServo | None,
    *,
    free: ServoCoordinates | None = None,
    belief: float = FIT_BELIEF,
    begin: Array | None = None,
    progress: Callable[[float], None] | None = None,
) -> RefinedFit:
    """Continue a fit by trajectories of the windows.

    Parameters
    ----------
    fit
        The fit to torques.
    windows
        What to simulate, from the samples of the fit.
    law
        The law if a command drives the simulation, with all gains known or estimated.
    free
        What is fitted of it; None: its delay. A lead takes the place of a delay below zero unless
        the trajectories contradict: the log may count positions from a later time.
    belief
        Weight of the divergence of links from CAD; infinite holds the links of CAD.
    begin
        Standard parameters to begin with, (n_standard,), found by trajectories before; None: from
        the fit, and other starts of an unknown law.
    progress
        Called with the fraction done.
    """
    model = fit.model
    base = fit.base
    linear = fit.estimate
    links = slice(10 * model.n_links)
    prior = build_simulated_prior(model, base.drive)
    if not isinstance(linear, ConsistentEstimate):
        linear = fit_toward_cad(fit.information, prior)
    chi = np.array(linear.standard)
    chi[prior.non_negative] = np.maximum(chi[prior.non_negative], 0.0)
    if not np.isfinite(belief):
        chi[links] = prior.parameters[links]
    windows = thin_windows(windows)
    starts = tuple(np.stack([cut.start_q, cut.start_qd], axis=1) for cut in windows)
    start = Point(chi, FittedLaw.of(law, free), starts)
    share = FIT_SAME_SAMPLES * fit.uncertainty.effective_samples / fit.information.n_samples
    objective = Objective(
        Trajectories(model, base),
        tuple(windows),
        fit.information,
        np.sqrt(share) / linear.sigma,
        prior,
        belief,
        start,
    )
    first = start if begin is None else replace(start, chi=begin)
    objective, first = choose_starts(objective, first, free, begun=begin is not None)
    found = refine(objective, first, progress=progress)
    covariance = objective.covariance(found.point, found.quadratic)
    own = covariance[: base.n_base, : base.n_base]
    beta = base.regrouping @ found.point.chi
    sigma = np.sqrt(fit.information.residual_energy(beta) / fit.information.n_samples)
    note = _word_note(found, windows)
    refined = replace(
        fit,
        estimate=replace(
            linear,
            beta=beta,
            standard=found.point.chi,
            covariance=own,
            sigma=np.maximum(sigma, np.finfo(np.float64).tiny),
            notes=(*linear.notes, note),
            refit=None,
        ),
        provenance=(*fit.provenance, note),
    ).with_errors(uncertainty=replace(fit.uncertainty, covariance=own))
    before, built = (
        replace(objective.robot(each), model=model.with_parameters(each.chi[links]))
        for each in (start, found.point)
    )
    return RefinedFit(
        refined,
        derive_refined_law(objective, found.point, covariance),
        before,
        built,
        objective,
        found,
        objective.drive_errors(found.quadratic),
        objective.undetermined(found.quadratic),
    )


def derive_refined_law(objective: Objective, point: Point, covariance: Array) -> RefinedLaw:
    """Return the law at a point, with errors by the covariance of parameters of base and law."""
    law = objective.start.law
    first = objective.trajectories.base.n_base
    errors = np.sqrt(np.diag(covariance))
    kp = np.ones(1) if law.servo is None else np.array(law.servo.kp)
    # All stiffnesses have one relative error; a joint that the servo does not hold has none.
    k = int(np.argmax(kp))
    return RefinedLaw(
        point.law.servo,
        delay_error=float(errors[-2]) if law.free.delay else np.nan,
        stiffness_error=float(errors[first + k] / kp[k]) if law.free.stiffness else np.nan,
        lead_error=float(errors[-1]) if law.free.lead else np.nan,
    )


def thin_windows(windows: Sequence[Windows]) -> tuple[Windows, ...]:
    """Return every k-th window, so that together they last `FIT_MOST_SECONDS`."""
    total = sum(window.n_windows * window.horizon for window in windows)
    every = max(1, int(np.ceil(total / FIT_MOST_SECONDS)))
    count = 0
    chosen = list[Windows]()
    for window in windows:
        at = np.arange((-count) % every, window.n_windows, every)
        count += window.n_windows
        if len(at):
            chosen.append(window.some(at))
    return tuple(chosen)


def _word_note(found: Refinement, windows: Sequence[Windows]) -> str:
    count = sum(window.n_windows for window in windows)
    return (
        f"Refined by trajectories: {count} windows of {windows[0].horizon:g} s simulated under the"
        f" logged {windows[0].signal.kind}, {found.iterations} steps of Levenberg and Marquardt"
    )


# Starts of a search under commands: a stiffer servo, a lead in place of a negative delay.

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


FADING = ("stribeck",)
"""Terms of friction near rest: of either sign for torques, but one below zero is no friction."""
BREAKAWAY = 3.0
"""Largest friction at rest per friction in fast motion. Dry hard steel has .78 / .42 = 1.9 (Marks'
Standard Handbook for Mechanical Engineers, table of coefficients of friction); the rest is left to
lubricant that parts the surfaces. What holds a joint more is no friction of two surfaces, but soft
contact of a simulator, a deadband, or a drive at its limit."""


def build_simulated_prior(model: RobotModel, drive: DriveSet) -> CadPrior:
    """Return the prior of a robot whose friction near rest is at least that in motion.

    With less, simulated joints that come to rest creep and slip.
    """
    prior = build_cad_prior(model, drive)
    fading = [term.key in FADING for term in drive.terms for _ in term.symbols] * model.n_joints
    bounded = np.union1d(prior.non_negative, 10 * model.n_links + np.flatnonzero(fading))
    return replace(prior, non_negative=bounded)


def widen_parameters(parameters: Array, drive: DriveSet, wider: DriveSet, n_joints: int) -> Array:
    """Return standard parameters with the columns of a wider set of drive terms, new ones zero."""
    links = len(parameters) - n_joints * drive.columns_per_joint
    found = np.zeros((n_joints, wider.columns_per_joint))
    found[:, ~_find_new_columns(drive, wider)] = parameters[links:].reshape(n_joints, -1)
    return np.concatenate([parameters[:links], found.ravel()])


def predict_fall(objective: Objective, found: Refinement, term: DriveTerm) -> float:
    """Return by how much a drive term would lower the cost, by the quadratic model at zero of it.

    The score test: nothing is simulated again (Rao, Proc. Cambridge Philos. Soc. 44, 1948).
    """
    model = objective.trajectories.model
    drive = objective.trajectories.base.drive
    n = model.n_joints
    wider = drive.with_term(term)
    point, start = (
        replace(each, chi=widen_parameters(each.chi, drive, wider, n))
        for each in (found.point, objective.start)
    )
    wide = replace(
        objective,
        trajectories=Trajectories(model, find_base_parameters(model, wider)),
        torque_weights=np.zeros(n),
        prior=build_simulated_prior(model, wider),
        start=start,
    )
    quadratic = wide.quadratic(point, found.motions, found.weights)
    free = ~wide.at_bound(point, quadratic.gradient)
    added = np.zeros_like(free)
    links = 10 * model.n_links
    added[links : len(point.chi)] = np.tile(_find_new_columns(drive, wider), n)
    return quadratic.fall(free) - quadratic.fall(free & ~added)


def is_friction_at_rest(drive: DriveSet, values: Array, errors: Array) -> bool:
    """Return whether friction near rest has sizes of two surfaces, within two standard errors.

    `values` and `errors` are parameters of the drive terms, (n, columns_per_joint).
    """
    of = np.array([term.key for term in drive.terms for _ in term.symbols])
    added, least = (x[:, np.isin(of, FADING)].sum(axis=1) for x in (values, values - 2.0 * errors))
    moving = values[:, of == "coulomb"].sum(axis=1)
    return bool(np.all((added <= 0.0) | (least <= (BREAKAWAY - 1.0) * moving)))


def _find_new_columns(drive: DriveSet, wider: DriveSet) -> Mask:
    """Return which columns of a joint belong to terms that only the wider set has."""
    return np.array([term.key not in drive.keys for term in wider.terms for _ in term.symbols])
