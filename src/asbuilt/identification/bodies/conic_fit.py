"""Least torque error over physically consistent parameters, by conic programs of Clarabel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import clarabel
import numpy as np
from scipy import sparse
from scipy.linalg import lapack, solve_triangular

from asbuilt.arrays import Array
from asbuilt.errors import IdentifiabilityError
from asbuilt.findings import Cure
from asbuilt.identification.bodies.body_bounds import BodyBounds
from asbuilt.identification.bodies.cad_prior import (
    IDENTITY_SVEC,
    PSEUDO_INERTIA_SVEC,
    CadPrior,
    smat,
    svec,
)


@dataclass(frozen=True, slots=True, eq=False)
class ConeSolution:
    """Hold the solver's status, its last point and the number of iterations."""

    status: str
    x: Array
    iterations: int

    @property
    def is_solved(self) -> bool:
        """Whether `x` is the minimiser, at least to reduced precision."""
        return self.status in ("Solved", "AlmostSolved")


def solve_cone_program(
    linear: Array,
    constraints: Any,
    right: Array,
    cones: list[Any],
    *,
    quadratic: sparse.csc_matrix | None = None,
    settings: dict[str, float | bool] | None = None,
) -> ConeSolution:
    """Minimise `x^T P x / 2 + c^T x` subject to `A x + s = b`, s in the cones.

    P is upper triangular, zero by default, A dense or sparse, `settings` have Clarabel's names, and
    semidefinite cones take the `svec` of a matrix. Source: Goulart & Chen, Clarabel: an
    interior-point solver for conic programs, 2024.
    """
    if quadratic is None:
        quadratic = sparse.csc_matrix((len(linear), len(linear)))
    chosen = clarabel.DefaultSettings()
    chosen.verbose = False
    # Fits run side by side in threads of their own.
    chosen.max_threads = 1
    for name, value in (settings or {}).items():
        setattr(chosen, name, value)
    try:
        solution = clarabel.DefaultSolver(
            quadratic, linear, sparse.csc_matrix(constraints), right, cones, chosen
        ).solve()
    except (
        BaseException
    ) as problem:  # a panic of the solver, whose type nothing exports, is no Exception
        if type(problem).__name__ != "PanicException":
            raise
        return ConeSolution(f"Panic ({problem})", np.full(len(linear), np.nan), 0)
    return ConeSolution(
        str(solution.status), np.array(solution.x, dtype=np.float64), int(solution.iterations)
    )


SMALLEST_PART = 1e-3
"""Lower bound of every pseudo-inertia in CAD's: `P_i >= part P0_i`."""
TINY_WEIGHT = 1e-3
"""Weight of the distance from CAD, in squared weighted residuals, for a unique solution."""
RESOLVED = (1e-11, 1e-9, 1e-7)
"""Least weights of CAD relative to the stiffest direction of the data, against rounding.

They matter only for data with almost no noise. A later one is tried if the solver fails, as for
torques far from CAD's.
"""
CERTAIN = 1e-13
"""Tolerance of a proof of infeasibility; large residuals look like proofs at the usual one."""
ROUGH = 1e-6
"""Relative gap and infeasibility of a rough fit; the solver's defaults are 1e-8."""
EXACTLY: dict[str, float | bool] = {"tol_infeas_abs": CERTAIN, "tol_infeas_rel": CERTAIN}
ROUGHLY: dict[str, float | bool] = EXACTLY | {
    "tol_gap_abs": ROUGH,
    "tol_gap_rel": ROUGH,
    "tol_feas": ROUGH,
    "iterative_refinement_enable": False,
}


ABOUT: tuple[dict[str, float | bool], ...] = (
    {"tol_gap_abs": ROUGH, "tol_gap_rel": ROUGH, "tol_feas": 0.1 * ROUGH},
    {},
    {"static_regularization_constant": 1e-7},
)
"""Settings for bounds, each tried where the one before fails: six digits, which optima at bodies
without extent on a line or plane reach where the default of eight stalls."""
FARTHEST = 1e4
OPEN = 0.9
"""Distance of a value from zero, in bodies of CAD, at which its search ends, and the part of it
from which the value counts as unbounded: a link of ten thousand times its mass is no bound. Of a
ratio, such as a centre of mass, the square root, since inertia grows with the square of it.
"""


class ConicProblem:
    """Minimise `|R K chi - z|^2 / 2 + weight |chi - chi0|_g^2 / 2` over consistent chi.

    Subject to `P_i >= smallest_part P0_i` for every link and to `bounds`. [R z] is a triangular
    factor (p + 1, p + 1), K the `regrouping` (p, n_standard), chi0 the CAD values, g their metric:
    the distance `tr((P0^-1 dP)^2)` of every link, the same in all frames and units (the constant
    pull-back of Lee, Wensing & Park, IEEE Trans. Robotics 36, 2020).
    The variables are `Q_i = L_i^-1 P_i L_i^-T`, `P0_i = L_i L_i^T`, all near 1: `chi = bodies q`,
    q0 is CAD. Positive definiteness after Wensing, Kim & Slotine, IEEE RA-L 3, 2018, and Sousa &
    Cortesao, IJRR 33, 2014.

    The constraints are `pattern (q, r) + s = (z, limits)`, r the residual, s in the `cones`; the
    first p rows take `R torque` at `places` of their data, whose entries `nonzero` (n_standard, p)
    can be nonzero. The linear bounds are `bounds q <= margin`.
    """

    def __init__(
        self,
        prior: CadPrior,
        regrouping: Array,
        bounds: BodyBounds | None = None,
        smallest_part: float = SMALLEST_PART,
    ) -> None:
        self.prior = prior
        self.smallest_part = smallest_part
        self.bodies, self.q0 = scale_near_one(prior)
        n = len(prior.parameters)
        inertial = 10 * prior.n_links
        p = len(regrouping)
        # Unit rows: tolerances of the solver are absolute.
        self.bounds = np.zeros((0, n))
        self.margin = np.zeros(0)
        if bounds is not None:
            bound_rows = -bounds.rows @ self.bodies
            size = np.linalg.norm(bound_rows, axis=1)
            self.bounds = bound_rows / size[:, None]
            self.margin = bounds.offsets / size
        below = np.vstack([self.bounds, -np.eye(inertial, n)])
        # Q_i >= part 1, as all CAD bodies are 1 in these variables.
        self.limits = np.concatenate(
            [self.margin, -smallest_part * np.tile(IDENTITY_SVEC, prior.n_links)]
        )
        self.torque = regrouping @ self.bodies
        # R is triangular: row i of `R torque` has the entries of all rows of `torque` from i on.
        nonzero = (np.triu(np.ones((p, p))) @ (self.torque != 0.0) > 0.0).astype(np.float64)
        self.nonzero = nonzero.T > 0.0
        self.pattern = sparse.csc_matrix(
            np.block([[nonzero, -np.eye(p)], [below, np.zeros((len(below), p))]])
        )
        self.places = np.flatnonzero(
            (self.pattern.indices < p) & (np.arange(self.pattern.nnz) < self.pattern.indptr[n])
        )
        linear = [clarabel.NonnegativeConeT(len(self.margin))] if len(self.margin) else []
        self.cones = [
            clarabel.ZeroConeT(p),
            *linear,
            *([clarabel.PSDTriangleConeT(4)] * prior.n_links),
        ]

    def fit(self, factor: Array, weight: float = TINY_WEIGHT, *, rough: bool = False) -> Array:
        """Return the minimiser chi (n_standard,) for the triangular factor [R z] (p + 1, p + 1).

        A `rough` one is within about a thousandth of a standard error. Raises
        `IdentifiabilityError` if the bounds are infeasible or the solver fails.
        """
        prior = self.prior
        z = factor[:-1, -1]
        p = len(z)
        n = len(self.q0)
        inertial = 10 * self.prior.n_links
        torque = factor[:-1, :-1] @ self.torque
        stiffest = float(np.max(np.sum(torque**2, axis=0)))
        for resolved in RESOLVED:
            # Next to the stiffest direction less weight would be lost to rounding.
            floored = max(weight, resolved * stiffest)
            # 1e-3: weight of drive parameters relative to the weight of links.
            pull = np.concatenate(
                [
                    np.repeat(floored * prior.strength, 10),
                    np.full(n - inertial, max(min(floored, 1.0) * 1e-3, prior.drive_weight)),
                ]
            )
            # A tiny weight pulls bodies to the border of consistency: nothing would be saved.
            inside = self._inside(torque, z, pull) if weight > TINY_WEIGHT else None
            if inside is not None:
                return self._unscale(inside)
            # P is diagonal: the pull of CAD on q, and the residual's square.
            quadratic = sparse.csc_matrix(
                (np.concatenate([pull, np.ones(p)]), np.arange(n + p), np.arange(n + p + 1)),
                (n + p, n + p),
            )
            solution = solve_cone_program(
                np.concatenate([-pull * self.q0, np.zeros(p)]),
                self._fill_pattern(torque),
                np.concatenate([z, self.limits]),
                self.cones,
                quadratic=quadratic,
                settings=ROUGHLY if rough else EXACTLY,
            )
            if "PrimalInfeasible" in solution.status and len(self.bounds):
                raise IdentifiabilityError(
                    f"the bounds on masses, centres of mass and drives of {prior.robot} are"
                    " infeasible",
                    cure=Cure("widen the bounds"),
                )
            if solution.is_solved:
                return self._unscale(solution.x[:n])
        raise IdentifiabilityError(
            f"the physically consistent fit of {prior.robot} failed after {solution.iterations}"
            f" iterations with solver status {solution.status}",
            cure=Cure("check the data for values of extreme size"),
        )

    def find_extreme(
        self, factor: Array, radius: float, value: Array, divisor: Array | None = None
    ) -> float:
        """Return the least `value @ chi / divisor @ chi` over consistent chi near the data.

        Over all chi within the bounds with `|R K chi - z| <= radius` and, if there is a `divisor`
        (n_standard,), with `divisor @ chi > 0`. Minus infinity if there is no least one, or the
        solver finds none.
        With `chi = x / t` the program is linear in (x, t) and its constraints are cones: `divisor @
        x = 1`, or `t = 1` without one (Charnes & Cooper, Naval Research Logistics 9, 1962). t = 0
        is a limit that bodies come arbitrarily near to.

        Raises `IdentifiabilityError` if no chi meets the constraints.
        """
        z = factor[:-1, -1]
        n = len(self.q0)
        p = len(z)
        goal = self.bodies.T @ value
        normal = np.zeros(n)
        if divisor is not None:
            normal = self.bodies.T @ divisor
            # In units of the divisor, so that one limit of distance serves all ratios.
            goal = goal / np.linalg.norm(normal)
            normal = normal / np.linalg.norm(normal)
        size = float(np.linalg.norm(goal))
        farthest = FARTHEST if divisor is None else np.sqrt(FARTHEST)
        rows = np.zeros((3, n + p + 1))
        rows[0, :n] = normal
        rows[0, -1] = float(divisor is None)
        # Row 0: divisor @ x = 1, or t = 1; row 1: t >= 0; row 2: the goal not beyond `farthest`.
        rows[1, -1] = -1.0
        rows[2, :n] = -goal / size
        ball = np.zeros((p + 1, n + p + 1))
        # |r| <= radius t
        ball[0, -1] = -radius
        ball[1:, n:-1] = -np.eye(p)
        constraints = self._fill_pattern(factor[:-1, :-1] @ self.torque)
        # z and limits are multiplied by t, as x = t chi.
        of_t = sparse.csc_matrix(-np.concatenate([z, self.limits])[:, None])
        further = sparse.csc_matrix(np.vstack([rows, ball]))
        whole = sparse.vstack([sparse.hstack([constraints, of_t]), further])
        right = np.zeros(whole.shape[0])
        right[constraints.shape[0]] = 1.0
        right[constraints.shape[0] + 2] = farthest
        cones = [
            *self.cones,
            clarabel.ZeroConeT(1),
            clarabel.NonnegativeConeT(2),
            clarabel.SecondOrderConeT(p + 1),
        ]
        towards = np.append(goal / size, np.zeros(p + 1))
        for settings in ABOUT:
            solution = solve_cone_program(towards, whole, right, cones, settings=settings)
            if solution.is_solved or "PrimalInfeasible" in solution.status:
                break
        if "PrimalInfeasible" in solution.status:
            raise IdentifiabilityError(
                f"no physically consistent bodies of {self.prior.robot} within the bounds have"
                " these torques",
                cure=Cure("state wider bounds, or none"),
            )
        if not solution.is_solved:
            return -np.inf
        found = float(goal @ solution.x[:n])
        # An optimum at the end of the search is none: nothing bounds the value.
        return found if found > -OPEN * size * farthest else -np.inf

    def _fill_pattern(self, torque: Array) -> sparse.csc_matrix:
        """Return the constraints (q, r) with `R torque` at its places."""
        constraints = self.pattern.copy()
        constraints.data[self.places] = torque.T[self.nonzero]
        constraints.eliminate_zeros()  # those between branches of the robot
        return constraints

    def _unscale(self, q: Array) -> Array:
        """Return chi, with drive parameters moved to their bound if rounding left them beyond."""
        q = q.copy()
        inertial = 10 * self.prior.n_links
        # A bound of a single parameter: rounding is moved onto it.
        for row, margin in zip(self.bounds[:, inertial:], self.margin, strict=True):
            (places,) = np.nonzero(row)
            if len(places) == 1 and row @ q[inertial:] > margin:
                q[inertial + places] = margin / row[places]
        return self.bodies @ q

    def _inside(self, torque: Array, z: Array, pull: Array) -> Array | None:
        """Return the minimiser within the linear bounds if it is consistent without cones, or None.

        Least distance programming by non-negative least squares (Lawson & Hanson, Solving Least
        Squares Problems, 1974, chapter 23).
        """
        root, info = lapack.dpotrf(torque.T @ torque + np.diag(pull), lower=1)
        # Without a positive definite form the program with cones decides.
        if info:
            return None
        solved = solve_triangular(
            root,
            np.column_stack([torque.T @ z + pull * self.q0, -self.bounds.T]),
            lower=True,
            check_finite=False,
        )
        u = solved[:, 0]
        slopes = solved[:, 1:]
        # Violations of the bounds by the unconstrained minimum.
        broken = -(self.margin + u @ slopes)
        if np.any(broken > 0.0):
            from scipy.optimize import nnls  # noqa: PLC0415 - light start

            goal = np.append(np.zeros(len(u)), 1.0)
            both = np.vstack([slopes, broken])
            error = both @ nnls(both, goal)[0] - goal
            # The bounds have no common point: the program with cones says so in its own words.
            if error[-1] >= 0.0:
                return None
            u = u - error[:-1] / error[-1]
        q = np.asarray(solve_triangular(root, u, lower=True, trans="T", check_finite=False))
        bodies = smat(q[: 10 * self.prior.n_links].reshape(-1, 10))
        return q if np.linalg.eigvalsh(bodies)[:, 0].min() >= self.smallest_part else None


def scale_near_one(prior: CadPrior) -> tuple[Array, Array]:
    """Return M and q0 (CAD) with `chi = M q`: svec(Q_i) of every link, then scaled drives."""
    n = len(prior.parameters)
    inertial = 10 * prior.n_links
    roots = np.linalg.cholesky(prior.pseudo_inertias)[:, None]
    # P = L Q L^T, solved for the parameters that have this svec.
    images = svec(roots @ smat(np.eye(10)) @ roots.swapaxes(-1, -2)).swapaxes(-1, -2)
    M = np.zeros((n, n))
    places = np.arange(inertial).reshape(-1, 10)
    M[places[:, :, None], places[:, None, :]] = np.linalg.solve(PSEUDO_INERTIA_SVEC, images)
    M[range(inertial, n), range(inertial, n)] = prior.drive_scale
    q0 = np.concatenate(
        [np.tile(IDENTITY_SVEC, prior.n_links), prior.parameters[inertial:] / prior.drive_scale]
    )
    return M, q0
