"""Physical consistency of base parameters, and proofs of inconsistency: by which, by how much."""

from __future__ import annotations

from dataclasses import dataclass

import clarabel
import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse

from asbuilt.arrays import Array
from asbuilt.description.appearance import find_prefix
from asbuilt.dynamics.base.base_parameters import BaseParameters
from asbuilt.dynamics.kernels.blas import use_one_blas_thread
from asbuilt.errors import IdentifiabilityError
from asbuilt.identification.bodies.cad_prior import (
    IDENTITY_SVEC,
    PSEUDO_INERTIA_SVEC,
    CadPrior,
    find_non_negative_columns,
    smat,
)
from asbuilt.identification.bodies.conic_fit import scale_near_one, solve_cone_program
from asbuilt.tables import SIGNIFICANT_SIGMAS, format_plus_minus, round_significant

ROUNDING_OF_DRIVES = 1e-9
"""Negative friction or armature that is rounding: 1e-9 N m at unit velocity or acceleration."""


INERTIAS = 6
MOMENTS = 9
"""Ends of inertias and of first moments among the ten parameters of a body; the mass is last."""


def check_base_parameters(base: BaseParameters, beta: ArrayLike) -> Array:
    """Return beta as an array (p,); raises `IdentifiabilityError` for another shape or NaN."""
    values = np.asarray(beta, dtype=np.float64)
    if values.shape != (base.n_base,) or not np.all(np.isfinite(values)):
        raise IdentifiabilityError(
            f"{base.robot} needs {base.n_base} finite base parameters, got shape {values.shape}:"
            f" {values.tolist()}"
        )
    return values


def consistency_margin(base: BaseParameters, beta: ArrayLike) -> float:
    """Return the largest t with `K chi = beta` and `P_i >= t 1` for every link.

    The pseudo-inertia `P = [[tr(I)/2 1 - I, m c], [m c^T, m]]` of a physically consistent link is
    positive semidefinite (Wensing, Kim & Slotine, IEEE RA-L 3, 2018), so a negative margin proves
    beta inconsistent. Armatures among the drive terms must be at least t too. Other drive
    parameters that share base parameters with these, such as the offset of a vertical slide, may
    have any value. A semidefinite program; infinite if nothing bounds t.

    Raises
    ------
    IdentifiabilityError
        If beta has another shape than (p,) or is not finite, or the solver fails.
    """
    values = check_base_parameters(base, beta)
    return _find_margin(base, values, *_find_units(base, values))


def _find_units(base: BaseParameters, values: Array) -> tuple[Array, float]:
    """Return the unit of each standard parameter, and that of mass, for a robot of such values.

    One of each for arms; a thousand times the length is a million times the inertia.
    """
    links = np.flatnonzero(base.columns < 10 * base.n_links)
    place = base.columns[links] % 10
    sizes = np.abs(values[links])
    inertia = float(np.max(sizes[place < INERTIAS], initial=0.0))
    moment = float(np.max(sizes[(place >= INERTIAS) & (place < MOMENTS)], initial=0.0))
    if not inertia * moment > 0.0:
        return np.ones(len(base.standard_names)), 1.0
    length = find_prefix(inertia / moment, 1e3)
    mass = find_prefix(moment / length, 1e6)
    body = mass * np.repeat([length**2, length, 1.0], [6, 3, 1])
    drives = len(base.standard_names) - 10 * base.n_links
    return np.append(np.tile(body, base.n_links), np.full(drives, mass * length**2)), mass


def _find_margin(base: BaseParameters, beta: Array, units: Array, mass: float) -> float:
    """Return the margin of parameters, in units in which they are near one."""
    # Tolerances of the solver are absolute: in units of the robot's size numbers are near one.
    regrouping = base.regrouping * units / units[base.columns][:, None]
    values = beta / units[base.columns]
    n_links = base.n_links
    counted = np.array(
        [j < 10 * n_links or name.startswith("Ia") for j, name in enumerate(base.standard_names)]
    )
    # Rows of drives alone say nothing of bodies.
    rows = np.flatnonzero(np.any(regrouping[:, counted] != 0, axis=1))
    shared = np.any(regrouping[rows] != 0, axis=0) & ~counted
    free = np.concatenate([np.flatnonzero(counted), np.flatnonzero(shared)])
    armatures = range(10 * n_links, int(counted.sum()))
    n = len(free)
    fixed = sparse.hstack(
        [sparse.csc_matrix(regrouping[np.ix_(rows, free)]), sparse.csc_matrix((len(rows), 1))]
    )
    positive = sparse.hstack(
        [
            -sparse.eye_array(len(armatures), n, k=10 * n_links),
            sparse.csc_matrix(np.ones((len(armatures), 1))),
        ]
    )
    bodies = sparse.hstack(
        [
            sparse.kron(sparse.eye_array(n_links), sparse.csc_matrix(-PSEUDO_INERTIA_SVEC)),
            sparse.csc_matrix((10 * n_links, n - 10 * n_links)),
            sparse.csc_matrix(np.tile(IDENTITY_SVEC, n_links)[:, None]),
        ]
    )
    constraints = sparse.vstack([fixed, positive, bodies])
    # K chi = beta; armatures and P_i above t.
    bounds = np.concatenate([values[rows], np.zeros(len(armatures) + 10 * n_links)])
    cones = [
        clarabel.ZeroConeT(len(rows)),
        clarabel.NonnegativeConeT(len(armatures)),
        *[clarabel.PSDTriangleConeT(4)] * n_links,
    ]
    # Maximise t.
    goal = np.append(np.zeros(n), -1.0)
    solution = solve_cone_program(goal, constraints, bounds, cones)
    # Without a bound t grows for ever: no link is constrained.
    if "DualInfeasible" in solution.status:
        return float("inf")
    if not solution.is_solved:
        raise IdentifiabilityError(
            f"the physical consistency of the base parameters of {base.robot} is undecided (solver"
            f" status {solution.status})"
        )
    return mass * float(solution.x[-1])


def decide_consistency(base: BaseParameters, beta: ArrayLike) -> tuple[float | None, bool | None]:
    """Return the margin and whether links are consistent, None where the solver cannot decide."""
    try:
        values = check_base_parameters(base, beta)
        units, mass = _find_units(base, values)
        margin = _find_margin(base, values, units, mass)
    except IdentifiabilityError:
        return None, None
    largest = float(np.max(np.abs(values / units[base.columns]), initial=1.0))
    # Negative margin, in units of the largest parameter, that is rounding of the solver.
    return margin, margin >= -1e-8 * largest * mass


def non_passive_drives(base: BaseParameters, beta: ArrayLike) -> tuple[str, ...]:
    """Return the names of single drive parameters that are negative, against passivity."""
    values = np.asarray(beta, dtype=np.float64)
    alone = (np.count_nonzero(base.regrouping, axis=1) == 1) & np.isin(
        # Among others a parameter may be negative while its own one is not.
        base.columns,
        find_non_negative_columns(base.n_links, base.n_joints, base.drive),
    )
    return tuple(base.names[j] for j in np.flatnonzero(alone & (values < -ROUNDING_OF_DRIVES)))


FEW = 3
"""Parameters of a combination that is short enough."""


# Hold how the shortest inconsistent combination is searched.

# Reweighted l1 minimisations (Candes, Wakin & Boyd, J. Fourier Anal. Appl. 14, 2008).
SHORTEST_ROUNDS = 6
SHORTEST_DEAREST = 100.0  # Largest l1 weight of a parameter, relative to its standard error
SHORTEST_SOLVED = 1e-9  # Negative part of a coefficient that is rounding
# Coefficient, in standard errors relative to the largest, that is left out
SHORTEST_ROUNDING = 1e-4


@dataclass(frozen=True, slots=True, eq=False)
class Inconsistency:
    """Hold a proof that base parameters beta (p,) are physically inconsistent.

    `y^T beta >= 0` for all consistent links and passive drives, yet here `value = y^T beta < 0`.

    Parameters
    ----------
    names, ids, coefficients
        Parameters with nonzero y, and y.
    value, std_error
        `y^T beta` and its standard error.
    sigmas
        Distance of beta from the nearest consistent one in standard errors of all parameters,
        `min |L^-1 (beta - K chi)|` with `C = L L^T`.
    """

    names: tuple[str, ...]
    ids: tuple[int, ...]
    coefficients: Array
    value: float
    std_error: float
    sigmas: float

    @property
    def sentence(self) -> str:
        """What is inconsistent, and by how much."""
        total = " ".join(
            f"{'-' if c < 0 else '+'}"
            f" {'' if (size := round_significant(abs(c))) in ('1', '1.00') else size + ' '}{name}"
            for c, name in zip(self.coefficients.tolist(), self.names, strict=True)
        )
        alone = self.value / self.std_error if self.std_error > 0 else -np.inf
        return (
            f"{total.removeprefix('+ ')} is {format_plus_minus(self.value, self.std_error)} (base"
            f" parameter{'s' if len(self.ids) > 1 else ''} {', '.join(map(str, self.ids))}),"
            f" {round_significant(-alone, 2)} standard errors below zero, but at least zero for"
            " every"
            " physically consistent robot; all parameters together are"
            f" {round_significant(self.sigmas, 2)} standard errors from the nearest consistent ones"
        )


@use_one_blas_thread()
def find_inconsistency(
    base: BaseParameters, prior: CadPrior, beta: ArrayLike, covariance: ArrayLike
) -> Inconsistency | None:
    """Return a proof with few parameters that beta is inconsistent; None if it is consistent.

    The cone of consistent base parameters `{K chi: P_i >= 0, drives >= 0}` has beta outside if and
    only if some y is non-negative on all of it and negative at beta (Farkas' lemma for cones: Boyd
    & Vandenberghe, Convex Optimization, 2004, section 5.9). Of these, `min sqrt(y^T C y) / |y^T
    beta|` is one over the distance from beta to the cone in standard errors; an added
    `sum |y_j| sqrt(C_jj)` keeps y short. Clarabel solves second-order and semidefinite programs.
    """
    problem = _Separation(
        base, prior, np.asarray(beta, dtype=np.float64), np.asarray(covariance, dtype=np.float64)
    )
    surest = problem.solve(np.zeros(base.n_base))
    if surest is None:
        return None
    plainest = problem.plainest()
    proof = problem.shortened(surest) if plainest is None else plainest
    # Largest first by torque, in which parameters of different units compare.
    order = np.argsort(-np.abs(proof) * problem.size, kind="stable")[: np.count_nonzero(proof)]
    # Largest coefficient 1, for reading.
    y = proof / np.abs(proof[order[0]])
    return Inconsistency(
        names=tuple(base.names[j] for j in order),
        ids=tuple(int(base.ids[j]) for j in order),
        coefficients=y[order],
        value=float(y @ problem.beta),
        std_error=problem.error(y),
        # One over `min |L^T u|` at y^T beta = -1 is the distance of beta from the cone.
        sigmas=-float(surest @ problem.beta)
        / max(problem.error(surest), np.finfo(np.float64).tiny),
    )


class _Separation:
    """The program for y, in units of the standard errors.

    `images` (n_standard, p) is what a unit of each parameter does to bodies near 1 and to drives.
    """

    def __init__(
        self, base: BaseParameters, prior: CadPrior, beta: Array, covariance: Array
    ) -> None:
        self.beta = beta
        size = np.sqrt(np.diag(covariance))
        # Parameters without an error count as the surest that has one.
        self.size = np.where(size > 0, size, size[size > 0].min(initial=1.0))
        bodies, _ = scale_near_one(prior)
        self.images = (base.regrouping @ bodies).T / self.size
        self.inertial = 10 * prior.n_links
        drives = np.arange(self.inertial, len(prior.parameters))
        self.passive = np.intersect1d(drives, prior.non_negative)
        self.free = np.setdiff1d(drives, prior.non_negative)
        eigenvalues, vectors = np.linalg.eigh(covariance / np.outer(self.size, self.size))
        # Rounding leaves eigenvalues just below zero.
        self.root = vectors * np.sqrt(np.maximum(eigenvalues, 0.0))

    def error(self, y: Array) -> float:
        """Return the standard error of `y^T beta`."""
        return float(np.linalg.norm(self.root.T @ (y * self.size)))

    def plainest(self) -> Array | None:
        """Return y (p,) with the most significant single negative parameter; None if none is."""
        # The dual of the semidefinite cone is itself: a unit of the parameter is such a body.
        bodies = smat(self.images[: self.inertial].T.reshape(len(self.beta), -1, 10))
        size = np.abs(self.images).max(axis=0)
        eigenvalues = np.linalg.eigvalsh(bodies).min(axis=(1, 2))
        drives = self.images[self.passive].min(axis=0, initial=0.0)
        proof = (np.minimum(eigenvalues, drives) >= -SHORTEST_SOLVED * size) & ~np.any(
            # Free drives may take any value, so that no proof may contain them.
            self.images[self.free],
            axis=0,
        )
        sigmas = np.where(proof, -self.beta / self.size, 0.0)
        surest = int(np.argmax(sigmas))
        return None if sigmas[surest] < SIGNIFICANT_SIGMAS else np.eye(len(self.beta))[surest]

    def shortened(self, surest: Array) -> Array:
        """Return a proof with few parameters, starting from the most significant."""
        proof = surest
        prices = np.ones(len(surest))
        for _ in range(SHORTEST_ROUNDS):
            candidate = self.solve(prices)
            proof = proof if candidate is None else candidate
            if candidate is None or np.count_nonzero(proof) <= FEW:
                break
            # Candes, Wakin and Boyd: what is small is dearer in the next round.
            share = np.abs(proof) * self.size
            least = share.max() / SHORTEST_DEAREST
            prices = np.minimum(SHORTEST_DEAREST, share.max() / np.maximum(share, least))
        return proof

    def solve(self, prices: Array) -> Array | None:
        """Return y (p,), or None if there is no proof.

        With `u_j = y_j sqrt(C_jj)`: minimise `|L^T u| + sum prices_j |u_j|` subject to `u^T beta =
        -1` and `K^T y` in the dual cone; variables are u, bounds of |u_j|, and |L^T u|.
        """
        p = len(self.beta)
        at = self.beta / self.size
        identity = np.eye(len(self.beta))
        # beta = 0 is consistent.
        length = float(np.linalg.norm(at))
        if length == 0.0:
            return None

        def alone(rows: Array) -> Array:
            return np.hstack([rows, np.zeros((len(rows), p + 1))])

        # u^T beta = -1, and nothing of drives without sign.
        equal = alone(np.vstack([at / length, self.images[self.free]]))
        none = np.zeros((p, 1))
        bounded = np.block([[identity, -identity, none], [-identity, -identity, none]])
        cone = np.vstack([np.append(np.zeros(2 * p), -1.0), alone(-self.root.T)])
        constraints = np.vstack(
            [
                equal,
                bounded,
                alone(-self.images[self.passive]),
                cone,
                alone(-self.images[: self.inertial]),
            ]
        )
        # The one at the top: everything else is homogeneous.
        right = np.append(-1.0, np.zeros(len(constraints) - 1))
        cones = [
            clarabel.ZeroConeT(len(equal)),
            clarabel.NonnegativeConeT(2 * p + self.passive.size),
            clarabel.SecondOrderConeT(p + 1),
            *[clarabel.PSDTriangleConeT(4)] * (self.inertial // 10),
        ]
        goal = np.concatenate([np.zeros(p), prices, [1.0]])
        solution = solve_cone_program(goal, constraints, right, cones)
        if not solution.is_solved:
            return None
        u = solution.x[:p]
        u[np.abs(u) <= SHORTEST_ROUNDING * np.abs(u).max()] = 0.0
        return u / self.size
