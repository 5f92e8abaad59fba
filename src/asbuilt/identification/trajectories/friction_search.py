"""Whether trajectories call for a drive term that a refinement lacks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from asbuilt.arrays import Array, Mask
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import find_base_parameters
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.dynamics.drives.term import DriveTerm
from asbuilt.identification.bodies.cad_prior import CadPrior, build_cad_prior
from asbuilt.identification.trajectories.objective import Objective
from asbuilt.identification.trajectories.refinement import Refinement
from asbuilt.identification.trajectories.sensitivity import Trajectories

FADING = ("stribeck",)
"""Terms of friction near rest: of either sign for torques, but one below zero is no friction."""


BREAKAWAY = 3.0
"""Largest friction at rest per friction in fast motion. Dry hard steel has .78 / .42 = 1.9 (Marks'
Standard Handbook for Mechanical Engineers, table of coefficients of friction); the rest is left to
lubricant that parts the surfaces. What holds a joint more is no friction of two surfaces, but soft
contact of a simulator, a deadband, or a servo at its limit."""


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
    model, drive = objective.trajectories.model, objective.trajectories.base.drive
    n, wider = model.n_joints, drive.with_term(term)
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
    added, links = np.zeros_like(free), 10 * model.n_links
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
