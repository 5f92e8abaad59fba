"""Least and greatest values of quantities over physically consistent bodies near an estimate."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import qr
from scipy.special import chdtri

from asbuilt.arrays import Array
from asbuilt.dynamics.base.base_parameters import BaseParameters
from asbuilt.dynamics.kernels.blas import use_one_blas_thread
from asbuilt.errors import UsageError
from asbuilt.findings import Cure
from asbuilt.identification.bodies.body_bounds import BodyBounds
from asbuilt.identification.bodies.cad_prior import CadPrior
from asbuilt.identification.bodies.conic_fit import ConicProblem, scale_near_one
from asbuilt.identification.information.triangular import factor_distance

ROUNDING = 1e-5
"""Value, relative to its size in CAD, that the solver does not distinguish from zero; and part of a
quantity beyond the directions that the data determine."""
LEAST_CHANCE = 1e-3
"""Probability below which stated bounds contradict the estimate."""
LEAST_SHARE = 1e-3
"""Least part of a confounding relation, relative to the largest, that is named."""


@dataclass(frozen=True, eq=False)
class FeasibleRegion:
    """Hold the physically consistent bodies whose base parameters lie near an estimate.

    The bodies `{chi: P_i >= 0, bounds, |R (K chi - beta)|^2 <= d + s quantile}`: P_i the
    pseudo-inertia of link i, d the least distance `|R (K chi - beta)|^2` of consistent bodies, and
    s = d / r where d exceeds its number r of directions, else 1: what the model misses widens all.

    Parameters
    ----------
    prior
        Scales of the bodies, and which drive parameters are not negative; CAD has no weight.
    base
        The base parameters.
    beta
        Their estimate (p,).
    root
        R (r, p), `R^T R` its information, with a row for each direction that is determined.
    bounds
        Passive drives, and whatever else is certain or stated.
    quantile
        Of chi-square, which sets the level.
    chosen
        Standard parameters (n_standard,) of a robot that belongs to the bodies wherever it meets
        the bounds, with all between it and them; None if there is none. A fit that is held near CAD
        or consistent may lie farther from least squares than errors allow; where it was chosen
        since it predicts other motion no worse, the data do not exclude it.
    """

    prior: CadPrior
    base: BaseParameters
    beta: Array
    root: Array
    bounds: BodyBounds
    quantile: float
    chosen: Array | None = None

    @cached_property
    def _problem(self) -> ConicProblem:
        # Bodies at the border of consistency belong to the region.
        return ConicProblem(self.prior, self.base.regrouping, self.bounds, smallest_part=0.0)

    @cached_property
    def _factor(self) -> Array:
        return factor_distance(self.root, self.beta)

    @cached_property
    def distance(self) -> float:
        """The least `|R (K chi - beta)|^2` of consistent bodies: 0 of a consistent estimate."""
        nearest = self._problem.fit(self._factor)
        return float(np.sum((self.root @ (self.base.regrouping @ nearest - self.beta)) ** 2))

    @cached_property
    def scale(self) -> float:
        """The factor s on squared errors by what the model misses."""
        # A distance beyond its degrees is model error, and widens the region as it would an error.
        return max(1.0, self.distance / max(len(self.root), 1))

    @cached_property
    def radius(self) -> float:
        """The largest `|R (K chi - beta)|`."""
        return float(np.sqrt(self.distance + self.scale * self.quantile))

    def within(self, stated: BodyBounds) -> FeasibleRegion:
        """Return the part of the region within further bounds.

        Raises `UsageError` if these contradict the estimate: no bodies within them lie in the
        region in which all quantities together hold.
        """
        part = replace(self, bounds=self.bounds.and_also(stated))
        # A region in which all quantities together hold, wider than that of a single one.
        together = chdtri(len(self.root), LEAST_CHANCE) * self.scale
        if part.distance > self.distance + together:
            raise UsageError(
                f"the stated bounds contradict the log of {self.prior.robot}: the nearest bodies"
                f" within them are {np.sqrt(part.distance):.3g} standard errors from its torques,"
                f" the nearest of all {np.sqrt(self.distance):.3g}",
                cure=Cure("state wider bounds, or none"),
            )
        # The part is of the same data: its model error is the whole region's.
        vars(part)["scale"] = self.scale
        return part

    @use_one_blas_thread()
    def find_interval(self, value: Array, divisor: Array | None = None) -> tuple[float, float]:
        """Return the least and the greatest `value @ chi`, over `divisor @ chi` if there is one.

        Infinite where nothing bounds it. Raises `IdentifiabilityError` if the solver fails.
        """
        ends = [
            # The greatest is minus the least of the negative.
            -sign * np.inf
            if divisor is None and self._grows_unseen(-sign * value)
            else sign * self._problem.find_extreme(self._factor, self.radius, sign * value, divisor)
            for sign in (1.0, -1.0)
        ]
        # Rounding about zero, such as a mass of -1e-10 kg.
        size = ROUNDING * self._measure_size(value)
        least, greatest = (0.0 if divisor is None and abs(x) < size else x for x in ends)
        # Rounding of two solves can turn a point's ends around.
        greatest = max(least, greatest)
        if self.chosen is None or not self.holds(self.chosen):
            return least, greatest
        # The least of a convex set and a point is that of either, for ratios, too.
        own = float(value @ self.chosen)
        if divisor is not None:
            own /= float(divisor @ self.chosen)
        return min(least, own), max(greatest, own)

    def _grows_unseen(self, value: Array) -> bool:
        """Return whether a mass at the origin of a link, which nothing sees or bounds, adds to it.

        What is so has no greatest value, and needs no program to say so.
        """
        masses = 10 * np.arange(self.prior.n_links) + 9
        unseen = ~np.any(self.base.regrouping[:, masses], axis=0)
        unbounded = np.all(self.bounds.rows[:, masses] >= 0.0, axis=0)
        return bool(np.any(value[masses[unseen & unbounded]] > 0.0))

    def holds(self, parameters: Array) -> bool:
        """Return whether parameters (n_standard,) meet the linear bounds, but for rounding."""
        return bool(np.all(self.bounds.wider(ROUNDING, parameters).slack(parameters) >= 0.0))

    def excludes_zero(self, value: Array) -> bool:
        """Return whether the estimate alone shows that no body of the region has `value @ chi = 0`.

        All bodies, consistent or not, have it within `radius` standard errors of the estimate.
        """
        known = self.find_estimate(value)
        if known is None:
            return False
        estimate, error = known
        chosen = estimate if self.chosen is None else float(value @ self.chosen)
        return estimate * chosen > 0.0 and abs(estimate) > (1.0 + ROUNDING) * self.radius * error

    def find_estimate(self, value: Array) -> tuple[float, float] | None:
        """Return `value @ chi` with its standard error if the data determine it, else None.

        They do if it is a combination `w^T R K` of what they determine; its error then is `|w|`.
        """
        scaled = self._scales * value
        # value @ chi = w^T (R K chi): solved in units of the bodies.
        own, size, of_bodies = self._seen_axes
        along = of_bodies @ scaled
        w = own @ (along / size)
        if np.linalg.norm(along @ of_bodies - scaled) > ROUNDING * np.linalg.norm(scaled):
            return None
        return float(w @ self.root @ self.beta), float(np.linalg.norm(w))

    def find_confounded(self, value: Array) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Return the fewest standard parameters that change unseen together with a quantity.

        The change d with `R K d = 0` and `value @ d = 1` of least `sum_j |d_j| / scale_j` is a
        linear program. The first names are parameters that the quantity does not have, the second
        its own, which alone have no effect on the torques if there are no first ones.
        """
        from scipy.optimize import linprog  # noqa: PLC0415 - light start

        scales = self._scales
        n = len(value)
        unseen = self._unseen
        # R K d = 0 where K d is a combination of what R does not see: of many joints K has few
        # non-zeros, and R K none that is zero.
        regrouping = self.base.regrouping * scales
        size = np.maximum(np.linalg.norm(regrouping, axis=1), np.linalg.norm(unseen, axis=1))
        # Unit rows, so that directions count alike whatever their size.
        size = np.where(size > 0.0, size, 1.0)[:, None]
        own = scales * value / np.linalg.norm(scales * value)
        rows = np.vstack([regrouping / size, own])
        open_rows = np.vstack([unseen / size, np.zeros((1, unseen.shape[1]))])
        right = np.append(np.zeros(len(regrouping)), 1.0)
        solution = linprog(
            # A change is the difference of two non-negative parts: their sum is its l1 norm.
            np.append(np.ones(2 * n), np.zeros(unseen.shape[1])),
            A_eq=np.hstack([rows, -rows, -open_rows]),
            b_eq=right,
            bounds=[(0.0, None)] * (2 * n) + [(None, None)] * unseen.shape[1],
        )
        if solution.x is None:
            return (), ()
        change = np.abs(solution.x[:n] - solution.x[n : 2 * n])
        order = np.argsort(-change, kind="stable")
        named = order[change[order] > LEAST_SHARE * change.max()].tolist()
        names = self.base.standard_names
        return (
            tuple(names[j] for j in named if value[j] == 0.0),
            tuple(names[j] for j in named if value[j] != 0.0),
        )

    @cached_property
    def _scales(self) -> Array:
        """Sizes of the standard parameters in CAD (n_standard,)."""
        bodies, _ = scale_near_one(self.prior)
        return np.asarray(np.linalg.norm(bodies, axis=1))

    @cached_property
    def _unseen(self) -> Array:
        """Changes (p, p - r) of base parameters that R does not see, orthonormal where scaled."""
        length = np.linalg.norm(self.root, axis=0)
        scale = np.where(length > 0.0, length, 1.0)
        every, _ = qr((self.root / scale).T)
        return every[:, len(self.root) :] / scale[:, None]

    @cached_property
    def _seen_axes(self) -> tuple[Array, Array, Array]:
        """Singular vectors and values of R K (r, n_standard) in units of the parameters' scales."""
        own, size, of_bodies = np.linalg.svd(
            self.root @ self.base.regrouping * self._scales, full_matrices=False
        )
        seen = size > 1e-10 * size.max(initial=0.0)
        return own[:, seen], size[seen], of_bodies[seen]

    def _measure_size(self, value: Array) -> float:
        return float(np.linalg.norm(self._scales * value))
