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
from asbuilt.identification.trajectories.law_starts import (
    RefinedLaw,
    choose_starts,
    derive_refined_law,
)
from asbuilt.identification.trajectories.objective import Objective, Point
from asbuilt.identification.trajectories.refinement import Refinement, refine
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
        uncertainty=replace(fit.uncertainty, covariance=own),
        provenance=(*fit.provenance, note),
    )
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


def thin_windows(windows: Sequence[Windows]) -> tuple[Windows, ...]:
    """Return every k-th window, so that together they last `RULES.most_seconds`."""
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
