"""Standard parameters of a whole robot from base parameters, closest to CAD."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import clarabel
import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array
from asbuilt.description.inertia import pseudo_inertias
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import BaseParameters
from asbuilt.dynamics.kernels.blas import use_one_blas_thread
from asbuilt.errors import IdentifiabilityError
from asbuilt.identification.bodies.body_bounds import (
    BodyBounds,
    bound_known_masses,
    bound_passive_drives,
    bound_widely,
)
from asbuilt.identification.bodies.cad_prior import CadPrior, build_cad_prior
from asbuilt.identification.bodies.conic_fit import (
    SMALLEST_PART,
    ConicProblem,
    scale_near_one,
    solve_cone_program,
)
from asbuilt.identification.bodies.consistency import check_base_parameters
from asbuilt.identification.bodies.entropic_fit import Coordinates, EntropicProblem
from asbuilt.identification.bodies.entropic_path import find_plausible_parameters
from asbuilt.identification.information.random_states import build_random_motion_rows
from asbuilt.identification.information.triangular import factor_distance
from asbuilt.scaled import Scaled

# Hold how exactly standard parameters reproduce base parameters.

# Least part of CAD at which base parameters are kept exactly; below, rounding decides
STANDARD_EXACT_PART = 1e-6
# Torque in its noise beyond which beta is kept exactly: no chi-square could be kept (simulations)
STANDARD_SHARPEST = 1e7
# Weight of the logarithmic barrier of that fit, far below the usual one
STANDARD_FINE_BARRIER = 1e-12
# Least armature that shares a base parameter with a link, in units of its scale
STANDARD_LEAST_SHARE = 1e-5
STANDARD_ROUNDING = 1e-6  # Relative violation of a bound that is rounding of the fit
# Noise of the nearest consistent fit in torque RMS, so small that CAD has no influence
STANDARD_RELATIVE_RESOLUTION = 1e-3


LIMIT = 1.0
"""Largest squared torque, over all samples together and in noise variances, by which the parameters
closest to CAD may move the torques of the data. Residuals are correlated, so that standard errors
are several times those of the noise alone: within *them*, exports of short logs predicted other
motion by up to half worse than the estimate did.
"""


@dataclass(frozen=True, slots=True, eq=False)
class StandardParameters:
    """Hold the standard parameters of a whole robot.

    Parameters
    ----------
    parameters
        Standard parameters (n_standard,).
    beta
        Their base parameters (p,).
    exact
        Whether beta is the requested one.
    consistent
        Whether all links are physically consistent (for the nearest: all drives passive too).
    part
        Largest t with `P_i >= t P0_i` for every link, P0 being CAD.
    smallest_eigenvalue
        Of all pseudo-inertias.
    divergence
        Entropic divergence of every link from CAD, shape (n,).
    torque_rms
        Torque of the difference from the requested beta in random motion, shape (n,) [N m or N].
    torque_rms_of_motion
        Torque of that motion itself, shape (n,) [N m or N].
    nearest_in
        Motion in which the nearest beta is nearest.
    notes
        What was corrected or guessed in CAD.
    chi_square, limit
        Squared torque of `beta` beside the requested one on the data used, in noise variances, and
        its limit, if the parameters are those closest to CAD within the noise; else 0.
    """

    parameters: Array
    beta: Array
    exact: bool
    consistent: bool
    part: float
    smallest_eigenvalue: float
    divergence: Array
    torque_rms: Array
    torque_rms_of_motion: Array
    nearest_in: Literal["random motion", "the data used"]
    notes: tuple[str, ...]
    chi_square: float = 0.0
    limit: float = 0.0

    @property
    def substituted(self) -> bool:
        """Whether the nearest consistent base parameters replace inconsistent ones."""
        return not self.exact and not self.limit

    @property
    def verdict(self) -> str:
        """What these parameters are, as text."""
        margin = (
            f"the pseudo-inertia of every link is at least {self.part:.2g} of CAD's (smallest"
            f" eigenvalue {self.smallest_eigenvalue:.2g})"
        )
        torques = self.torque_rms, self.torque_rms_of_motion
        moved, whole = (float(np.sqrt(np.mean(torque**2))) for torque in torques)
        if not self.consistent:
            return (
                "exact identified torques, standard parameters closest to CAD; the base parameters"
                " are NOT physically consistent"
            )
        if self.exact:
            return (
                "exact identified torques, physically consistent standard parameters closest to"
                f" CAD; {margin}"
            )
        if self.limit:
            return (
                "physically consistent standard parameters closest to CAD within the noise of the"
                f" data used (chi-square {self.chi_square:.3g}, limit {self.limit:.3g}), torque"
                f" {moved:.2g} N m RMS from the identified one in random motion (of {whole:.3g}"
                f" N m); {margin}"
            )
        away = "in the torque of the data used"
        if self.nearest_in == "random motion":
            away = f"{moved:.2g} N m RMS away in random motion (of {whole:.3g} N m)"
        return (
            "nearest physically consistent model, since the identified base parameters are"
            f" inconsistent: {away}; {margin}"
        )


@use_one_blas_thread()
def find_standard_parameters(
    model: RobotModel,
    base: BaseParameters,
    beta: ArrayLike,
    *,
    nearest: bool = False,
    information: ArrayLike | None = None,
    noise_root: Array | None = None,
) -> StandardParameters:
    """Return the standard parameters with `K chi = beta` of least divergence from CAD.

    With `noise_root` and a consistent beta, they have the least divergence from CAD among all that
    move the torques of the data by less than their noise: what torques do not determine stays near
    CAD.

    If beta is inconsistent, either it is kept with the inconsistent links closest to CAD in the
    metric there, or (`nearest`) the nearest consistent beta with passive drives takes its place.
    Otherwise single drive parameters stay, and an armature that shares a base parameter with a link
    is not negative. Convex throughout: a conic program for the largest part of CAD in `K chi =
    beta`, Newton's method for the closest (Lee, Wensing & Park, IEEE Trans. Robotics 36, 2020;
    Wensing, Kim & Slotine, IEEE RA-L 3, 2018).

    Parameters
    ----------
    model, base
        The robot as designed and its base parameters.
    beta
        Base parameters (p,).
    nearest
        Whether the nearest consistent beta replaces an inconsistent one.
    information
        Matrix A (p, p) of the distance `(K chi - beta)^T A (K chi - beta)` of the nearest: the
        information of the data used, or of random motion by default.
    noise_root
        R (r, p) with `R^T R` the information of what beta was fitted to, torque in units of its
        noise and whatever held beta besides; the limit of `|R (K chi - beta)|^2` is `LIMIT`. None:
        a consistent beta is kept exactly.

    Raises
    ------
    IdentifiabilityError
        If beta has another shape or is not finite.
    """
    asked = check_base_parameters(base, beta)
    cad = build_cad_prior(model, base.drive)
    coordinates = Coordinates.of(base)
    drives = bound_passive_drives(cad)
    # Drive parameters that dependent ones change share a base parameter with a link.
    moving = np.any(coordinates.dependent[cad.non_negative] != 0.0, axis=1)
    shared = BodyBounds(
        drives.rows[moving], drives.offsets[moving], tuple(np.array(drives.labels)[moving])
    )
    # Those alone in theirs are what beta says, passive or not.
    alone = drives.rows[~moving] @ (coordinates.kept @ asked)
    motion = build_random_motion_rows(model, base)
    of_motion = _measure_joint_rms(motion @ asked, model.n_joints)
    # Rounding: CAD values may lie on their bound.
    known = bound_known_masses(cad).wider(STANDARD_ROUNDING, cad.parameters)
    shared = shared.and_also(known)
    passive = drives.and_also(bound_known_masses(cad))
    within = shared.and_also(bound_widely(cad).wider(STANDARD_ROUNDING, cad.parameters))
    chi, part = find_deepest_inside(cad, coordinates, asked, within)
    # Wide bounds give way before beta does: they are only likely.
    if part > STANDARD_EXACT_PART:
        shared = within
    else:
        chi, part = find_deepest_inside(cad, coordinates, asked, shared)
    # The nearest model has passive drives, so that negative friction refutes exactness.
    exact = part > STANDARD_EXACT_PART and not (nearest and np.any(alone < 0.0))
    consistent = exact or nearest
    if not exact and nearest:
        distance = factor_distance(_find_root(asked, motion, information), asked)
        chi = ConicProblem(cad, base.regrouping, passive).fit(distance)
        scale = cad.drive_scale[cad.non_negative - 10 * cad.n_links]
        # Next to zero, not at it: the search for the deepest point needs an interior.
        chi[cad.non_negative] = np.maximum(
            chi[cad.non_negative], STANDARD_LEAST_SHARE * scale * moving
        )
        chi, part = find_deepest_inside(cad, coordinates, base.regrouping @ chi, shared)
    plausible = None
    # A beta that is sharper than rounding is kept exactly, as in simulations.
    if (
        (exact and noise_root is not None and not np.any(alone < 0.0))
        and len(noise_root)
        and np.linalg.norm(noise_root @ asked) <= STANDARD_SHARPEST
    ):
        plausible = find_plausible_parameters(cad, base, asked, noise_root, LIMIT)
    chi = (
        plausible[0]
        if plausible is not None
        else _find_closest_above(cad, coordinates, chi, part, shared)
        if consistent
        else _find_closest_in_metric(cad, coordinates, asked)
    )
    kept = base.regrouping @ chi
    return StandardParameters(
        parameters=chi,
        beta=kept,
        exact=plausible is None and (exact or not nearest),
        consistent=consistent,
        part=float(cad.relative_eigenvalues(chi).min()),
        smallest_eigenvalue=float(
            np.linalg.eigvalsh(pseudo_inertias(chi[: 10 * cad.n_links].reshape(-1, 10))).min()
        ),
        divergence=cad.divergence(chi),
        torque_rms=_measure_joint_rms(motion @ (kept - asked), model.n_joints),
        torque_rms_of_motion=of_motion,
        nearest_in="random motion" if information is None else "the data used",
        notes=cad.notes,
        chi_square=0.0 if plausible is None else plausible[1],
        limit=0.0 if plausible is None else LIMIT,
    )


def find_deepest_inside(
    cad: CadPrior, coordinates: Coordinates, beta: Array, bounds: BodyBounds
) -> tuple[Array, float]:
    """Return parameters with `K chi = beta` and the largest t <= 1 with `P_i >= t P0_i`.

    `bounds` hold with some t as slack. t is negative if beta is inconsistent. Raises
    `IdentifiabilityError` if the solver fails.
    """
    bodies, q0 = scale_near_one(cad)
    inertial = 10 * cad.n_links
    # From the closest in the metric, which has K chi = beta, along directions that keep it.
    near = _find_closest_in_metric(cad, coordinates, beta)
    whitened = np.linalg.solve(bodies, np.column_stack([near, coordinates.dependent]))
    # Orthonormal directions, so that the solver sees one scale.
    along, triangle = np.linalg.qr(whitened[:, 1:])
    free = coordinates.dependent @ np.linalg.inv(triangle)
    # Bounds hold with a little of t as slack, bodies with the whole.
    slack = np.append(np.full(len(bounds.rows), STANDARD_LEAST_SHARE), 1.0)[:, None]
    rows = np.vstack([bounds.rows @ free, np.zeros((1, free.shape[1]))])
    constraints = np.block([[-rows, slack], [-along[:inertial], q0[:inertial, None]]])
    # t <= 1: deeper than CAD itself is no aim.
    right = np.concatenate([bounds.slack(near), [1.0], whitened[:inertial, 0]])
    cones = [clarabel.NonnegativeConeT(len(rows)), *[clarabel.PSDTriangleConeT(4)] * cad.n_links]
    goal = np.append(np.zeros(free.shape[1]), -1.0)
    solution = solve_cone_program(goal, constraints, right, cones)
    if not solution.is_solved:
        raise IdentifiabilityError(
            f"the physical consistency of {len(beta)} base parameters of {cad.robot} is undecided"
            f" (solver status {solution.status})"
        )
    return near + free @ solution.x[:-1], float(solution.x[-1])


def _find_closest_above(
    cad: CadPrior, coordinates: Coordinates, chi: Array, part: float, bounds: BodyBounds
) -> Array:
    """Return the closest to CAD with the base parameters of chi and `P_i >= floor P0_i`.

    The floor is half of `part` at most; the divergence `D(P - floor P0 || (1 - floor) P0)` is that
    above the floor, least at CAD too.
    """
    # Half of what is possible leaves an interior for the barrier.
    floor = min(SMALLEST_PART, 0.5 * part)
    # Drives have no floor.
    below = floor * cad.parameters
    below[10 * cad.n_links :] = 0.0
    problem = EntropicProblem(
        replace(cad, parameters=cad.parameters - below),
        coordinates,
        bounds.raised(below),
        held=True,
    )
    return np.asarray(
        problem.fit(None, 1.0, (chi - below)[None], barrier=STANDARD_FINE_BARRIER).chi[0] + below
    )


def _find_closest_in_metric(cad: CadPrior, coordinates: Coordinates, beta: Array) -> Array:
    """Return the closest to CAD with `K chi = beta` in the metric there, consistent or not."""
    bodies, _ = scale_near_one(cad)
    whitened = np.linalg.solve(
        bodies, np.column_stack([coordinates.kept @ beta - cad.parameters, coordinates.dependent])
    )
    # Of least norm in the whitened parameters, in which CAD's metric is 1.
    d, *_ = np.linalg.lstsq(whitened[:, 1:], -whitened[:, 0], rcond=None)
    return np.asarray(coordinates.kept @ beta + coordinates.dependent @ d)


def _find_root(beta: Array, motion: Array, information: ArrayLike | None) -> Array:
    """Return the root R (r, p) of the distance from beta."""
    if information is None:
        torque = float(np.sqrt(np.mean((motion @ beta) ** 2)))
        # So small a noise that CAD decides nothing.
        return motion / max(STANDARD_RELATIVE_RESOLUTION * torque, np.finfo(np.float64).tiny)
    return Scaled(np.asarray(information, dtype=np.float64)).root


def _measure_joint_rms(torque: Array, n_joints: int) -> Array:
    return np.asarray(np.sqrt(np.mean(torque.reshape(-1, n_joints) ** 2, axis=0)))
