"""Entropic fits along descending weights of CAD, and the closest to CAD that the data allow."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass

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
from asbuilt.identification.information.triangular import factor_distance

DESCENT: tuple[float, ...] = tuple(10.0**exponent for exponent in range(6, -2, -1))
"""Weights on the way from CAD to weaker ones: costs of a divergence of 1 from CAD."""
TO_THE_DATA: tuple[float, ...] = (*DESCENT, 1e-2, 1e-3, 1e-4)
"""Weights on the way to where the data alone decide."""
CLOSE = 0.01
"""Relative distance of the chi-square from its limit at which the search for the weight ends."""
MOST_HALVINGS = 20


START_PARTS = (1e-2, 1e-3, 1e-4)
"""Least pseudo-inertias of the start relative to CAD; later ones for masses far below CAD."""


@dataclass(frozen=True, slots=True)
class _Reached:
    """Hold fits of one weight, and the factors (m, p + 1, p + 1) that they are of."""

    factors: Array
    fits: EntropicFits


class EntropicPath:
    """Fits from the strongest weight to weaker ones, each from the one before.

    The path begins at CAD, or next to it within the bounds.
    """

    def __init__(self, prior: CadPrior, base: BaseParameters, bounds: BodyBounds) -> None:
        self._problem = EntropicProblem(prior, Coordinates.of(base), bounds)
        self._start = _find_inside(prior, bounds)
        self._reached: dict[float, _Reached] = {}

    def fit_descending(self, factors: Array, weights: Iterable[float]) -> dict[float, Array]:
        """Return rough fits (m, n_standard) by weight; those that do not converge are left out."""
        wanted = set(weights)
        fits = dict[float, Array]()
        # Through all stronger weights, as links may lie far from CAD.
        for weight in sorted({*wanted, *(w for w in DESCENT if w > min(wanted))}, reverse=True):
            reached = self._reached.get(weight)
            if reached is not None and reached.factors is factors:
                fits[weight] = reached.fits.chi
                continue
            with suppress(IdentifiabilityError):
                fits[weight] = self.fit_roughly(factors, weight)
        return {weight: fit for weight, fit in fits.items() if weight in wanted}

    def fit_roughly(self, factors: Array, weight: float, *, barrier: float = BARRIER) -> Array:
        """Return the fits of many factors, to a small part of a standard error, for one weight."""
        # The last stronger weight that converged is the nearest start.
        stronger = [self._reached[other].fits for other in self._reached if other > weight]
        start = stronger[-1] if stronger else np.tile(self._start, (len(factors), 1))
        # Squared distance from the minimum, in squared standard errors, at which a rough fit ends.
        fits = self._problem.fit(factors, weight, start, barrier=barrier, close=1e-3)
        self._reached[weight] = _Reached(factors, fits)
        return fits.chi

    def fit_unbarred(self, factors: Array, weight: float) -> Array:
        """Return rough fits in which CAD, not the barrier, decides what factors leave open.

        The barrier of the bounds would outweigh CAD at weights below one, and put masses in the
        middle of their bounds.
        """
        return self.fit_roughly(factors, weight, barrier=BARRIER * min(weight, 1.0))

    def fit_exactly(self, factor: Array, weight: float) -> Array:
        """Return the fit of one factor, from the last rough one or through stronger weights."""
        if weight not in self._reached:
            # What was reached belongs to other factors.
            self._reached.clear()
            for stronger_weight in (stronger for stronger in DESCENT if stronger > weight):
                with suppress(IdentifiabilityError):
                    self.fit_roughly(factor[None], stronger_weight)
            self.fit_roughly(factor[None], weight)
        return np.asarray(
            self._problem.fit(factor[None], weight, self._reached[weight].fits.last).chi[0]
        )


def _find_inside(prior: CadPrior, bounds: BodyBounds) -> Array:
    """Return parameters strictly inside the bounds: CAD if possible, else the nearest."""
    chi = prior.parameters.copy()
    lifted = prior.non_negative
    # 0.1: start of bounded drive parameters, in units of their scale.
    # Bounded drives start inside, where the barrier has a value.
    chi[lifted] = np.maximum(chi[lifted], 0.1 * prior.drive_scale[lifted - 10 * prior.n_links])
    if np.all(bounds.slack(chi) > 0):
        return chi
    # At most a quarter of the way between opposite bounds, so that something is left between them.
    margin = np.minimum(1e-3 * np.linalg.norm(bounds.rows, axis=1), 0.25 * _measure_widths(bounds))
    tighter = BodyBounds(bounds.rows, bounds.offsets - margin, bounds.labels)
    p = len(prior.parameters)
    # Without data the program is the distance from CAD alone.
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


@use_one_blas_thread()
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
    factors = factor_distance(information_root, beta)[None]

    def fit(weight: float) -> tuple[Array, float]:
        (chi,) = path.fit_unbarred(factors, weight)
        return chi, float(np.sum((information_root @ (base.regrouping @ chi - beta)) ** 2))

    with suppress(IdentifiabilityError):
        path = EntropicPath(cad, base, bound_generously(cad))
        above = np.inf
        for weight in TO_THE_DATA:
            below = weight
            found = fit(weight)
            if found[1] <= limit:
                break
            above = weight
        # Even the data alone do not come below the limit.
        else:
            return None
        for _ in range(MOST_HALVINGS if np.isfinite(above) else 0):
            if found[1] >= (1.0 - CLOSE) * limit:
                break
            # Halved by the logarithm, as weights span decades.
            weight = float(np.sqrt(above * below))
            tried = fit(weight)
            # The found weight always meets the limit, whenever the search ends.
            if tried[1] <= limit:
                below = weight
                found = tried
            else:
                above = weight
        return found
    return None
