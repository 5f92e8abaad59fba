"""From base parameters to a full robot.

Real bodies for every link that give the identified torques and are closest to CAD.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import clarabel
import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse

from asbuilt.arrays import Array
from asbuilt.description.inertia import pseudo_inertias
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import BaseParameters
from asbuilt.dynamics.kernels.blas import one_blas_thread
from asbuilt.dynamics.regressor import observation_matrix
from asbuilt.errors import IdentifiabilityError
from asbuilt.identification.bodies.body_bounds import BodyBounds, non_negative_drives
from asbuilt.identification.bodies.cad_prior import CadPrior, cad_prior
from asbuilt.identification.bodies.cone_program import solve_cone_program
from asbuilt.identification.bodies.conic_fit import SMALLEST_PART, fit_consistent_bodies, near_one
from asbuilt.identification.bodies.entropic_fit import Coordinates, EntropicProblem
from asbuilt.identification.information.triangular import triangular_factor

EXACT_PART = 1e-6
"""Base parameters are kept exactly where bodies of at least this part of CAD have them.

Below, rounding would decide what is possible.
"""
FINE_BARRIER = 1e-12
LEAST_SHARE = 1e-5
"""Armature that is left where an armature and a link share a base parameter and nothing else tells
them apart.
"""
RANDOM_STATES = 500
RANDOM_RATE = 2.0
"""Largest velocity [rad/s or m/s] and acceleration [rad/s^2 or m/s^2] of random motion.

Joints without limits turn through the whole circle or slide by a metre.
"""
RANDOM_SEED = 2015
RELATIVE_RESOLUTION = 1e-3
"""Torque differences are weighed against this part of the torque when the nearest possible robot is
sought: the pull to CAD then has no say.
"""


@dataclass(frozen=True, slots=True, eq=False)
class StandardParameters:
    """Hold the standard parameters of a whole robot.

    `parameters` (n_standard,), and the base parameters `beta` (p,) that they give.

    `exact` says whether beta is the one asked for, `possible` whether all links are real bodies
    (and, where the nearest was asked for, all drives passive). `torque_rms` (n,) [N m or N] is what
    the difference from the beta asked for costs in random motion, beside `torque_rms_of_motion`
    (n,), the torque itself; `nearest_in` says in which motion the torque of the nearest is. `part`
    is the largest t with `P_i >= t P0_i` for every link, P0 being CAD; `smallest_eigenvalue` that
    of all pseudo-inertias; `divergence` (n,) is the entropic distance of every link from CAD;
    `notes` say what CAD did not.
    """

    parameters: Array
    beta: Array
    exact: bool
    possible: bool
    part: float
    smallest_eigenvalue: float
    divergence: Array
    torque_rms: Array
    torque_rms_of_motion: Array
    nearest_in: Literal["random motion", "the data used"]
    notes: tuple[str, ...]

    @property
    def verdict(self) -> str:
        """Say in one sentence what these parameters are."""
        margin = (
            f"the pseudo-inertia of every link is at least {self.part:.2g} of that of CAD (smallest"
            f" eigenvalue {self.smallest_eigenvalue:.2g})"
        )
        if not self.possible:
            return (
                "gives the identified torques exactly, with standard parameters next to CAD; the"
                " base parameters are NOT physically consistent: no real bodies have them"
            )
        if self.exact:
            return (
                "gives the identified torques exactly, with real bodies, of all such the closest"
                f" to CAD; {margin}"
            )
        away = "in the torque of the data used"
        if self.nearest_in == "random motion":
            cost = float(np.sqrt(np.mean(self.torque_rms**2)))
            of = float(np.sqrt(np.mean(self.torque_rms_of_motion**2)))
            away = f"{cost:.2g} N m RMS away in random motion (of {of:.3g} N m)"
        return (
            "no real bodies and passive drives give the identified torques exactly; these are the"
            f" nearest that can be, {away}; {margin}"
        )


def standard_parameters(
    model: RobotModel,
    base: BaseParameters,
    beta: ArrayLike,
    *,
    nearest: bool = False,
    information: ArrayLike | None = None,
) -> StandardParameters:
    """Return real bodies for every link with `K chi = beta` exactly that are closest to CAD.

    Least entropic divergence from it.

    Where no real bodies have beta, either beta is kept, with the impossible bodies closest to CAD
    in the metric there, or (`nearest`) the nearest possible beta takes its place: least `(K chi -
    beta)^T A (K chi - beta)` with the `information` matrix A (p, p) of the data used (least
    weighted torque difference there), or, where none is given, that of random motion (least RMS
    torque difference); then again the bodies closest to CAD. The nearest has passive drives, too.
    Otherwise drive parameters that beta tells by themselves stay as they are; an armature that
    shares a base parameter with a link is not negative.

    Convex throughout: a conic program for how deep inside `K chi = beta` leads, Newton's method for
    the closest (Lee, Wensing & Park, IEEE Trans. Robotics 36, 2020; Wensing, Kim & Slotine, IEEE
    RA-L 3, 2018).

    Raises `IdentifiabilityError` where beta has another shape or is not finite.
    """
    asked = np.asarray(beta, dtype=np.float64)
    if asked.shape != (base.n_base,) or not np.all(np.isfinite(asked)):
        raise IdentifiabilityError(
            f"{base.robot} needs {base.n_base} finite base parameters, got shape {asked.shape}:"
            f" {asked.tolist()}"
        )
    cad = cad_prior(model, base.drive)
    coordinates = Coordinates.of(base)
    drives = non_negative_drives(cad)
    moving = np.any(coordinates.dependent[cad.non_negative] != 0.0, axis=1)
    shared = BodyBounds(
        drives.rows[moving], drives.offsets[moving], tuple(np.array(drives.labels)[moving])
    )
    told = drives.rows[~moving] @ (coordinates.kept @ asked)
    motion = random_motion_rows(model, base)
    of_motion = _joint_rms(motion @ asked, model.n_joints)
    with one_blas_thread():
        chi, part = deepest_inside(cad, coordinates, asked, shared)
        exact = part > EXACT_PART and not (nearest and np.any(told < 0.0))
        possible = exact or nearest
        if not exact and nearest:
            factor = _distance_factor(asked, motion, information)
            chi = fit_consistent_bodies(cad, base.regrouping, factor=factor, bounds=drives).chi
            least = LEAST_SHARE * cad.drive_scale[cad.non_negative - 10 * cad.n_links] * moving
            chi[cad.non_negative] = np.maximum(chi[cad.non_negative], least)
            chi, part = deepest_inside(cad, coordinates, base.regrouping @ chi, shared)
        chi = (
            _closest_above(cad, coordinates, chi, part, shared)
            if possible
            else _closest_in_metric(cad, coordinates, asked)
        )
    kept = base.regrouping @ chi
    return StandardParameters(
        parameters=chi,
        beta=kept,
        exact=exact or not nearest,
        possible=possible,
        part=float(cad.relative_eigenvalues(chi).min()),
        smallest_eigenvalue=float(
            np.linalg.eigvalsh(pseudo_inertias(chi[: 10 * cad.n_links].reshape(-1, 10))).min()
        ),
        divergence=cad.divergence(chi),
        torque_rms=_joint_rms(motion @ (kept - asked), model.n_joints),
        torque_rms_of_motion=of_motion,
        nearest_in="random motion" if information is None else "the data used",
        notes=cad.notes,
    )


def deepest_inside(
    cad: CadPrior, coordinates: Coordinates, beta: Array, bounds: BodyBounds
) -> tuple[Array, float]:
    """Return parameters with `K chi = beta` and the largest t <= 1 such that `P_i >= t P0_i` for
    every link and `bounds` hold with some t to spare.

    t is negative where no real bodies have beta. Raises `IdentifiabilityError` where the solver
    gives up.
    """
    bodies, q0 = near_one(cad)
    inertial = 10 * cad.n_links
    near = _closest_in_metric(cad, coordinates, beta)
    whitened = np.linalg.solve(bodies, np.column_stack([near, coordinates.dependent]))
    along, triangle = np.linalg.qr(whitened[:, 1:])
    free = coordinates.dependent @ np.linalg.inv(triangle)
    room = np.append(np.full(len(bounds.rows), LEAST_SHARE), 1.0)[:, None]
    rows = np.vstack([bounds.rows @ free, np.zeros((1, free.shape[1]))])
    constraints = np.vstack(
        [np.hstack([-rows, room]), np.hstack([-along[:inertial], q0[:inertial, None]])]
    )
    right = np.concatenate([bounds.slack(near), [1.0], whitened[:inertial, 0]])
    cones = [clarabel.NonnegativeConeT(len(rows)), *[clarabel.PSDTriangleConeT(4)] * cad.n_links]
    size = constraints.shape[1]
    goal = np.append(np.zeros(size - 1), -1.0)
    solution = solve_cone_program(
        sparse.csc_matrix((size, size)), goal, sparse.csc_matrix(constraints), right, cones
    )
    if not solution.is_solved:
        raise IdentifiabilityError(
            f"whether real bodies have the {len(beta)} base parameters of {cad.robot} could not be"
            f" decided: the solver says {solution.status}"
        )
    return near + free @ solution.x[:-1], float(solution.x[-1])


def _closest_above(
    cad: CadPrior, coordinates: Coordinates, chi: Array, part: float, bounds: BodyBounds
) -> Array:
    """Return the closest to CAD with the base parameters of chi and `P_i >= floor P0_i`, the floor
    being half of `part` at most.

    The divergence is that of what is above the floor, `D(P - floor P0 || (1 - floor) P0)`, least at
    CAD as well.
    """
    floor = min(SMALLEST_PART, 0.5 * part)
    inertial = 10 * cad.n_links
    below = np.concatenate([floor * cad.parameters[:inertial], np.zeros(len(chi) - inertial)])
    above = replace(cad, parameters=cad.parameters - below)
    problem = EntropicProblem(above, coordinates, bounds, held=True)
    return np.asarray(
        problem.fit(None, 1.0, (chi - below)[None], barrier=FINE_BARRIER).chi[0] + below
    )


def _closest_in_metric(cad: CadPrior, coordinates: Coordinates, beta: Array) -> Array:
    """Return the parameters with `K chi = beta` that are closest to CAD in the metric there,
    possible or not.
    """
    bodies, _ = near_one(cad)
    whitened = np.linalg.solve(
        bodies, np.column_stack([coordinates.kept @ beta - cad.parameters, coordinates.dependent])
    )
    d, *_ = np.linalg.lstsq(whitened[:, 1:], -whitened[:, 0], rcond=None)
    return np.asarray(coordinates.kept @ beta + coordinates.dependent @ d)


def _distance_factor(beta: Array, motion: Array, information: ArrayLike | None) -> Array:
    """Return the triangular factor [R R beta] (p + 1, p + 1) of the distance from beta."""
    p = len(beta)
    if information is None:
        torque = float(np.sqrt(np.mean((motion @ beta) ** 2)))
        root = motion / max(RELATIVE_RESOLUTION * torque, np.finfo(np.float64).tiny)
    else:
        A = np.asarray(information, dtype=np.float64)
        size = np.sqrt(np.maximum(np.diag(A), np.finfo(np.float64).tiny))
        eigenvalues, axes = np.linalg.eigh(A / np.outer(size, size))
        root = np.sqrt(np.maximum(eigenvalues, 0.0))[:, None] * axes.T * size
    return triangular_factor(
        np.vstack([np.column_stack([root, root @ beta]), np.zeros((1, p + 1))])
    )


def random_motion_rows(model: RobotModel, base: BaseParameters) -> Array:
    """Return the observation matrix (N n, p) of random motion within the limits of the robot,
    sample by sample, the same at every call.
    """
    rng = np.random.default_rng(RANDOM_SEED)
    limits = [joint.limits for joint in model.joints]
    reach = [np.pi if joint.is_revolute else 1.0 for joint in model.joints]
    low = np.array(
        [
            limit.lower if np.isfinite(limit.lower) else -far
            for limit, far in zip(limits, reach, strict=True)
        ]
    )
    high = np.array(
        [
            limit.upper if np.isfinite(limit.upper) else far
            for limit, far in zip(limits, reach, strict=True)
        ]
    )
    shape = (RANDOM_STATES, model.n_joints)
    q = rng.uniform(low, high, shape)
    qd, qdd = (
        rng.uniform(-RANDOM_RATE, RANDOM_RATE, shape),
        rng.uniform(-RANDOM_RATE, RANDOM_RATE, shape),
    )
    return observation_matrix(model, q, qd, qdd, drive=base.drive, columns=base.columns)


def _joint_rms(torque: Array, n_joints: int) -> Array:
    return np.asarray(np.sqrt(np.mean(torque.reshape(-1, n_joints) ** 2, axis=0)))
