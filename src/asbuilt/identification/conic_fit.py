"""The least torque error that real bodies allow: a conic program on the square-root information, solved by Clarabel in milliseconds."""

from __future__ import annotations

from dataclasses import dataclass

import clarabel
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from asbuilt.description.inertia import LinkInertia
from asbuilt.errors import IdentifiabilityError
from asbuilt.identification.body_bounds import BodyBounds
from asbuilt.identification.cad_prior import CadPrior, smat, svec

Array = NDArray[np.float64]

SMALLEST_PART = 1e-3
"""Every body stays above this part of its CAD body: `P_i >= part P0_i`."""
TINY_PULL = 1e-3
"""Weight of the distance to CAD, in units of the squared weighted residual, that makes the solution unique."""
RESOLVED = (1e-11, 1e-9, 1e-7)
"""Pull to CAD relative to the stiffest direction of the data, below which rounding would decide: it only counts where there is next to no noise. The stronger ones
are tried where the solver gives up, as with torques that no robot near CAD could have."""
DRIVE_PULL = 1e-3
"""Pull of drive parameters beside that of bodies."""
CERTAIN = 1e-13
"""How precise a proof must be that bounds contradict one another: large residuals look like proofs at the solver's usual tolerance."""


@dataclass(frozen=True, slots=True, eq=False)
class ConicFit:
    """Hold the minimiser `chi` (n_standard,), the largest part t of the CAD bodies below all bodies (`P_i >= t P0_i`), and the iterations it took."""

    chi: Array
    part: float
    iterations: int


def fit_real_bodies(
    prior: CadPrior,
    regrouping: Array,
    *,
    factor: Array,
    bounds: BodyBounds | None = None,
    weight: float = TINY_PULL,
    smallest_part: float = SMALLEST_PART,
) -> ConicFit:
    """Minimise `|R K chi - z|^2 / 2 + weight |chi - chi0|_g^2 / 2` subject to `P_i >= smallest_part P0_i` for every link and to `bounds`.

    [R z] is the triangular `factor` (p + 1, p + 1), K the `regrouping` (p, n_standard), chi0 the CAD values, g their metric: the distance
    `tr((P0^-1 dP)^2)` of every body, the same in all frames and units (the constant pull-back of Lee, Wensing & Park, IEEE Trans. Robotics 36, 2020).
    The variables are `Q_i = L_i^-1 P_i L_i^-T`, `P0_i = L_i L_i^T`, near 1 all of them, which a solver likes. Positive definiteness after Wensing, Kim &
    Slotine, IEEE RA-L 3, 2018, and Sousa & Cortesao, IJRR 33, 2014.

    Raises `IdentifiabilityError` where the bounds leave nothing, saying so.
    """
    return RealBodies.of(prior, regrouping, bounds, smallest_part).fit(factor, weight)


@dataclass(frozen=True, slots=True, eq=False)
class RealBodies:
    """Hold what all conic fits of one robot have in common: `fit` is `fit_real_bodies` for another factor.

    `chi = bodies q`, q0 is CAD, `torque = regrouping bodies`; `rows`, `limits` and `cones` are the constraints on q that do not depend on the data.
    """

    prior: CadPrior
    bounded: bool
    bodies: Array
    q0: Array
    torque: Array
    rows: sparse.csc_matrix
    limits: Array
    cones: tuple[object, ...]

    @classmethod
    def of(cls, prior: CadPrior, regrouping: Array, bounds: BodyBounds | None = None, smallest_part: float = SMALLEST_PART) -> RealBodies:
        """Return the program of a robot with these bounds."""
        bodies, q0 = near_one(prior)
        n, inertial = len(prior.parameters), 10 * prior.n_links
        blocks, right, cones = [], [], []
        if bounds is not None and len(bounds.offsets):
            bounded = bounds.rows @ bodies
            size = np.linalg.norm(bounded, axis=1)
            blocks.append(sparse.csc_matrix(-bounded / size[:, None]))
            right.append(bounds.offsets / size)
            cones.append(clarabel.NonnegativeConeT(len(bounded)))
        blocks.append(sparse.csc_matrix(-sparse.eye_array(inertial, n)))
        right.append(-smallest_part * np.tile(svec(np.eye(4)), prior.n_links))
        cones += [clarabel.PSDTriangleConeT(4)] * prior.n_links
        rows = sparse.csc_matrix(sparse.vstack(blocks))
        return cls(prior, bounds is not None, bodies, q0, regrouping @ bodies, rows, np.concatenate(right), tuple(cones))

    def fit(self, factor: Array, weight: float = TINY_PULL) -> ConicFit:
        """Return the minimiser for the triangular factor [R z] (p + 1, p + 1)."""
        prior, z = self.prior, factor[:-1, -1]
        p, n, inertial = len(z), len(self.q0), 10 * self.prior.n_links
        torque = factor[:-1, :-1] @ self.torque
        stiffest = float(np.max(np.sum(torque**2, axis=0)))
        data = sparse.hstack([sparse.csc_matrix(torque), -sparse.eye_array(p)])
        alone = sparse.hstack([self.rows, sparse.csc_matrix((self.rows.shape[0], p))])
        constraints, limits = sparse.csc_matrix(sparse.vstack([data, alone])), np.concatenate([z, self.limits])
        cones = [clarabel.ZeroConeT(p), *self.cones]
        for resolved in RESOLVED:
            pulled = max(weight, resolved * stiffest)
            pull = np.concatenate([np.repeat(pulled * prior.strength, 10), np.full(n - inertial, min(pulled, 1.0) * DRIVE_PULL)])
            quadratic = sparse.csc_matrix(sparse.diags_array(np.concatenate([pull, np.ones(p)])))
            linear = np.concatenate([-pull * self.q0, np.zeros(p)])
            solution = clarabel.DefaultSolver(quadratic, linear, constraints, limits, cones, _settings()).solve()
            status = str(solution.status)
            if "PrimalInfeasible" in status and self.bounded:
                raise IdentifiabilityError(
                    f"no bodies of {prior.robot} keep all the bounds on masses, centres of mass and drives; widen them"
                )
            if status in ("Solved", "AlmostSolved"):
                break
        else:
            raise IdentifiabilityError(
                f"no real bodies of {prior.robot} were found in {solution.iterations} iterations: the solver says {status}; "
                "the data may hold values of extreme size"
            )
        chi = self.bodies @ np.array(solution.x[:n])
        return ConicFit(chi, float(prior.relative_eigenvalues(chi).min()), int(solution.iterations))


def _settings() -> clarabel.DefaultSettings:
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_threads = 1
    settings.tol_infeas_abs = settings.tol_infeas_rel = CERTAIN
    return settings


def near_one(prior: CadPrior) -> tuple[Array, Array]:
    """Return M and q0 with `chi = M q`: q holds svec(Q_i) of every link, then the drives in units of their scale; q0 is CAD."""
    roots = np.linalg.cholesky(prior.pseudo_inertias)
    n, inertial = len(prior.parameters), 10 * prior.n_links
    M = np.zeros((n, n))
    units = np.array([smat(row) for row in np.eye(10)])
    for i, L in enumerate(roots):
        images = L @ units @ L.T
        M[10 * i : 10 * i + 10, 10 * i : 10 * i + 10] = np.array([LinkInertia.from_pseudo_inertia(image).parameters for image in images]).T
    M[range(inertial, n), range(inertial, n)] = prior.drive_scale
    q0 = np.concatenate([np.tile(svec(np.eye(4)), prior.n_links), prior.parameters[inertial:] / prior.drive_scale])
    return M, q0
