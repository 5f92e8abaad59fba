"""Entropic fits along descending weights of CAD, each from the one before."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress

import numpy as np

from asbuilt.arrays import Array
from asbuilt.dynamics.base.base_parameters import BaseParameters
from asbuilt.dynamics.kernels.blas import use_one_blas_thread
from asbuilt.errors import IdentifiabilityError
from asbuilt.findings import Cure
from asbuilt.identification.bodies.body_bounds import BodyBounds, bound_generously
from asbuilt.identification.bodies.cad_prior import CadPrior
from asbuilt.identification.bodies.conic_fit import ConicProblem
from asbuilt.identification.bodies.entropic_fit import (
    BARRIER,
    Coordinates,
    EntropicFits,
    EntropicProblem,
)
from asbuilt.identification.information.triangular import triangular_factor

DESCENT: tuple[float, ...] = tuple(10.0**exponent for exponent in range(6, -2, -1))
"""Weights on the way from CAD to weaker ones: costs of a divergence of 1 from CAD."""
START_PARTS = (1e-2, 1e-3, 1e-4)
"""Least pseudo-inertias of the start relative to CAD; later ones for masses far below CAD."""


class EntropicPath:
    """Fits from the strongest weight to weaker ones, each from the one before."""

    def __init__(self, problem: EntropicProblem, start: Array) -> None:
        self._problem, self._start = problem, start
        self._reached: dict[float, EntropicFits] = {}

    @classmethod
    def of(cls, prior: CadPrior, coordinates: Coordinates, bounds: BodyBounds) -> EntropicPath:
        """Return the path of a robot, which begins at CAD or next to it within the bounds."""
        return cls(EntropicProblem(prior, coordinates, bounds), _find_inside(prior, bounds))

    def descending(self, factors: Array, weights: Iterable[float]) -> dict[float, Array]:
        """Return rough fits (m, n_standard) by weight; those that do not converge are left out."""
        wanted = set(weights)
        fits = {}
        for weight in sorted(wanted | set(DESCENT), reverse=True):
            if weight < min(wanted):
                break
            try:
                fits[weight] = self.roughly(factors, weight)
            except IdentifiabilityError:
                continue
        return {weight: fit for weight, fit in fits.items() if weight in wanted}

    def roughly(self, factors: Array, weight: float, *, barrier: float = BARRIER) -> Array:
        """Return the fits of many factors, to a small part of a standard error, for one weight."""
        stronger = [self._reached[other] for other in self._reached if other > weight]
        start = stronger[-1] if stronger else np.tile(self._start, (len(factors), 1))
        # Squared distance from the minimum, in squared standard errors, at which a rough fit ends.
        self._reached[weight] = self._problem.fit(
            factors, weight, start, barrier=barrier, close=1e-3
        )
        return self._reached[weight].chi

    def unbarred(self, factors: Array, weight: float) -> Array:
        """Return rough fits in which CAD, not the barrier, decides what factors leave open.

        The barrier of the bounds would outweigh CAD at weights below one, and put masses in the
        middle of their bounds.
        """
        return self.roughly(factors, weight, barrier=BARRIER * min(weight, 1.0))

    def exactly(self, factor: Array, weight: float) -> Array:
        """Return the fit of one factor, from the last rough one or through stronger weights."""
        if weight not in self._reached:
            self._reached.clear()
            for each in (stronger for stronger in DESCENT if stronger > weight):
                with suppress(IdentifiabilityError):
                    self.roughly(factor[None], each)
            self.roughly(factor[None], weight)
        return np.asarray(
            self._problem.fit(factor[None], weight, self._reached[weight].alone(-1)).chi[0]
        )


def _find_inside(prior: CadPrior, bounds: BodyBounds) -> Array:
    """Return parameters strictly inside the bounds: CAD if possible, else the nearest."""
    chi = prior.parameters.copy()
    lifted = prior.non_negative
    # 0.1: start of bounded drive parameters, in units of their scale.
    chi[lifted] = np.maximum(chi[lifted], 0.1 * prior.drive_scale[lifted - 10 * prior.n_links])
    if np.all(bounds.slack(chi) > 0):
        return chi
    margin = np.minimum(1e-3 * np.linalg.norm(bounds.rows, axis=1), 0.25 * _measure_widths(bounds))
    tighter = BodyBounds(bounds.rows, bounds.offsets - margin, bounds.labels)
    p = len(prior.parameters)
    nothing = np.zeros((p + 1, p + 1))
    for part in START_PARTS:
        with suppress(IdentifiabilityError):
            return ConicProblem(prior, np.eye(p), tighter, smallest_part=part).fit(nothing, 1.0)
    raise IdentifiabilityError(
        f"the bounds on masses, centres of mass and drives of {prior.robot} are infeasible",
        cure=Cure("widen the bounds"),
    )


def _measure_widths(bounds: BodyBounds) -> Array:
    """Return the width of every bound to its opposite, infinite without one."""
    opposite = np.all(bounds.rows[:, None] == -bounds.rows[None], axis=2)
    width = bounds.offsets[:, None] + bounds.offsets[None]
    return np.asarray(np.min(np.where(opposite, width, np.inf), axis=1, initial=np.inf))


WEAKEST = 1e-4
"""Weight of CAD below which no parameters are within the uncertainty."""
CLOSE = 0.01
"""Relative distance of the chi-square from its limit at which the search for the weight ends."""
MOST_HALVINGS = 20


def find_plausible_parameters(
    cad: CadPrior, base: BaseParameters, beta: Array, information_root: Array, limit: float
) -> tuple[Array, float] | None:
    """Return the standard parameters closest to CAD within the uncertainty, and their chi-square.

    They have the least divergence from CAD with `|R (K chi - beta)|^2 <= limit`, within the bounds
    of `bound_generously`. The entropic fit to R has the minimum of the divergence under this limit
    at the weight of CAD that meets the limit; bisection finds it.

    Parameters
    ----------
    cad, base
        CAD values, and the base parameters.
    beta
        Base parameters (p,).
    information_root
        R (r, p) with `R^T R` the inverse covariance of beta.
    limit
        Largest chi-square.

    Returns
    -------
    tuple or None
        Standard parameters (n_standard,) and their chi-square; None if none are found.
    """
    p = len(beta)
    rows = np.column_stack([information_root, information_root @ beta])
    factor = triangular_factor(np.vstack([rows, np.zeros((1, p + 1))]))

    def chi_square(chi: Array) -> float:
        return float(np.sum((information_root @ (base.regrouping @ chi - beta)) ** 2))

    with use_one_blas_thread():
        try:
            path = EntropicPath.of(cad, Coordinates.of(base), bound_generously(cad))
            above, weight, found = np.inf, DESCENT[0], None
            while weight >= WEAKEST:
                (chi,) = path.unbarred(factor[None], weight)
                if chi_square(chi) <= limit:
                    found = chi
                    break
                above, weight = weight, weight / 10.0
            if found is None:
                return None
            below = weight
            for _ in range(MOST_HALVINGS if np.isfinite(above) else 0):
                if chi_square(found) >= (1.0 - CLOSE) * limit:
                    break
                weight = float(np.sqrt(above * below))
                (chi,) = path.unbarred(factor[None], weight)
                if chi_square(chi) <= limit:
                    below, found = weight, chi
                else:
                    above = weight
        except IdentifiabilityError:
            return None
    return found, chi_square(found)
