"""Least squares on square-root information: ordinary, with a weight per joint, and on line."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import lapack

from asbuilt.arrays import Array, Mask
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import BaseParameters
from asbuilt.dynamics.kernels.blas import use_one_blas_thread
from asbuilt.dynamics.regressor import RegressorPlan
from asbuilt.errors import IdentifiabilityError, UsageError
from asbuilt.findings import Cure
from asbuilt.identification.estimators.methods import estimator
from asbuilt.identification.information.estimate import (
    Estimate,
    EstimationData,
    deviation_of,
    noise_floor,
    residual_deviation,
)
from asbuilt.identification.information.square_root_information import SquareRootInformation
from asbuilt.identification.information.triangular import (
    FactorSolution,
    solve_factor,
    solve_fast,
)

Weighting = Literal["joint"]

WEIGHT_CONVERGENCE = 1e-8
ROUGH_WEIGHTS = 0.2
"""Relative change of weights at which a fit is near enough to see whether it is worth finishing:
some five steps, where all digits take thirty."""
MOST_ITERATIONS = 50
NEAR = 0.1
"""Relative change of weights below which steps are extrapolated."""
ENOUGH_BY_SQUARES = 200.0
"""Scaled condition number (Frobenius) per parameter, 1 of orthogonal columns, up to which weights
come from normal equations: of 50 parameters these are off by 1e-8, and residuals by the square of
that."""
LARGE_CONDITION = 200.0
"""Scaled condition number above which model errors are amplified (below 100 is good: Gautier and
Khalil, Int. J. Robotics Research 11, 1992).
"""
MOST_TERMS = 6


@use_one_blas_thread()
def fit_least_squares(
    information: SquareRootInformation,
    *,
    weights: Weighting | ArrayLike | None = None,
    prior: ArrayLike | None = None,
    undetermined: Literal["toward_prior", "refuse"] = "toward_prior",
    settled: float = WEIGHT_CONVERGENCE,
) -> Estimate:
    """Minimise `sum_k weights_k^2 |tau_k - W_k beta|^2`.

    Parameters
    ----------
    information
        Square-root information of n joints and p base parameters.
    weights
        None for ordinary least squares; `"joint"` for 1 / sigma_k with `sigma_k^2 = |e_k|^2 / (N -
        t_k)`, t_k the parameters that joint k spends, iterated to convergence (Gautier, IROS 1997);
        or n positive numbers. Joints without torque have a weight of 0.
    prior
        Values (p,) toward which undetermined directions are resolved by the smallest change in
        parameters scaled to equal torque; NaN counts as 0.
    undetermined
        `"refuse"` raises for undetermined directions.
    settled
        Relative change of the weights of `"joint"` at which they have converged.

    Raises
    ------
    IdentifiabilityError
        If directions are undetermined without prior or refused, or rows are fewer than parameters.
    """
    rows = information.n_rows
    toward = None if prior is None else np.nan_to_num(np.asarray(prior, dtype=np.float64), nan=0.0)
    w, iterations, converged = _choose_weights(information, weights, toward, settled)
    # The iteration solves without a decision on the rank; the result makes it once.
    solution = solve_factor(information.stacked(w), rows, toward)
    sigma = residual_deviation(information, solution.x, solution.inverse_root, w)
    if solution.rank < information.base.n_base and (toward is None or undetermined == "refuse"):
        raise _make_refusal(information, solution)
    return Estimate(
        method="ols" if weights is None else "wls",
        beta=solution.x,
        covariance=(solution.residual_energy / max(rows - solution.rank, 1))
        # Of ordinary least squares too: the energy is that of the weighted rows.
        * solution.inverse_root
        @ solution.inverse_root.T,
        sigma=sigma,
        weights=w,
        solution=solution,
        undetermined=_name_directions(information, solution),
        # What is rounding is zero there: a coefficient of another unit may be small and open.
        determined=np.all(solution.open_directions == 0.0, axis=0),
        iterations=iterations,
        converged=converged,
    )


def joint_noise(
    information: SquareRootInformation,
    prior: Array,
    settled: float = WEIGHT_CONVERGENCE,
    near: Array | None = None,
) -> Array:
    """Return the deviation (n,) of each joint's residual in the fit with `"joint"` weights.

    It is that of `fit_least_squares`, without its parameters and their errors; `near` is that of
    a fit nearby, from which fewer steps lead there.
    """
    weights, _, _ = _choose_weights(information, "joint", prior, settled, near)
    return _solve_weighted(information, weights, prior)[1]


def _choose_weights(
    information: SquareRootInformation,
    weights: Weighting | ArrayLike | None,
    toward: Array | None,
    settled: float,
    near: Array | None = None,
) -> tuple[Array, int, bool]:
    """Return the weights (n,) of a fit, the iterations they took, and whether they converged."""
    n = information.n_joints
    refuse_few_rows(information)
    floor = noise_floor(information)
    iterated = isinstance(weights, str)
    if iterated and weights != "joint":
        raise UsageError(
            f"weights {weights!r} are unknown; expected 'joint', None or {n} positive numbers, one"
            " per joint"
        )
    seen = information.has_torque
    given = np.ones(n) if weights is None or isinstance(weights, str) else weights
    w = np.where(seen, check_weights(given, seen), 0.0)
    if near is not None:
        w[seen] = 1.0 / np.maximum(near[seen], floor)
    iterations = int(not iterated)
    converged = True
    ahead = FixedPoint(NEAR)
    while iterated:
        iterations += 1
        renewed = 1.0 / np.maximum(_solve_weighted(information, w, toward)[1], floor)
        converged = bool(np.all(np.abs(renewed - w) <= settled * renewed))
        if converged or iterations > MOST_ITERATIONS:
            break
        # In logarithms, so that an extrapolated weight stays positive.
        image = np.log(renewed[seen])
        tried = ahead.advance(np.log(w[seen]), image)
        # Without an extrapolation the weights are taken as they are, not through a logarithm.
        w[seen] = renewed[seen] if tried is image else np.exp(tried)
    return w, iterations, converged


def _solve_weighted(
    information: SquareRootInformation, weights: Array, toward: Array | None
) -> tuple[Array, Array]:
    """Return parameters (p,) of weighted least squares and the deviation of each joint (n,).

    By normal equations where their digits are enough, as their sum over joints costs a small part
    of a factor of all rows: residuals are of second order in an error of the parameters.
    """
    found = solve_squares(information.summed(weights))
    if found is None:
        x, root = solve_fast(information.stacked(weights), information.n_rows, toward)
        return x, residual_deviation(information, x, root, weights)
    x, root = found
    return x, deviation_of(information, x, information.spent(weights, root @ root.T))


def solve_squares(total: Array) -> tuple[Array, Array] | None:
    """Return x (p,) and the inverse root (p, p) of normal equations `[A | b]` (p + 1, p + 1).

    None where their condition takes too many digits, or there is nothing to solve.
    """
    # Where rows were taken away rounding may be left below zero.
    size = np.sqrt(np.maximum(np.diag(total)[:-1], 0.0))
    if size.size == 0 or not np.all(size > 0.0):
        return None
    most = ENOUGH_BY_SQUARES * size.size
    factor, problem = lapack.dpotrf(total[:-1, :-1] / np.outer(size, size), clean=1)
    inverse, singular = lapack.dtrtri(factor) if problem == 0 else (factor, 1)
    if singular or np.linalg.norm(inverse) * np.linalg.norm(factor) > most:
        return None
    root = inverse / size[:, None]
    return root @ (root.T @ total[:-1, -1]), root


def refuse_few_rows(information: SquareRootInformation, part: float = 1.0) -> None:
    """Raise `IdentifiabilityError` for fewer torques than parameters in a part of the samples."""
    if part * information.n_rows <= information.base.n_base:
        raise IdentifiabilityError(
            f"{information.n_samples} samples of {information.n_joints} joints give"
            f" {information.n_rows} torques, too few for {information.base.n_base} parameters of"
            f" {information.base.robot}",
            cure=Cure("record longer, decimate less or choose fewer drive terms"),
        )


@estimator("ols", "ordinary least squares", "equal weight for every torque", held_fixed=())
def estimate_ols(data: EstimationData) -> Estimate:
    """Estimate by ordinary least squares: equal weight for every torque."""
    return fit_least_squares(data.information, prior=data.prior, undetermined=data.undetermined)


@estimator("wls", "weighted least squares", "a weight per joint, from its own noise")
def estimate_wls(data: EstimationData) -> Estimate:
    """Estimate by least squares with a weight per joint."""
    return fit_least_squares(
        data.information, weights="joint", prior=data.prior, undetermined=data.undetermined
    )


def format_combination(direction: Array, names: tuple[str, ...]) -> str:
    """Return a direction as readable text, largest coefficient 1 in front.

    >>> format_combination(np.array([0.0, -0.5, 1.0]), ("Ixx1", "mx2", "Fv1"))
    'Fv1 - 0.5 mx2'
    """
    order: list[int] = np.argsort(-np.abs(direction), kind="stable").tolist()
    lead = direction[order[0]]
    shown = [j for j in order if direction[j] != 0.0]
    # Divided by the largest coefficient, whose sign then is plus.
    text = names[shown[0]]
    for j in shown[1:MOST_TERMS]:
        factor = direction[j] / lead
        size = f"{abs(factor):.3g}"
        text += f" {'-' if factor < 0 else '+'} {names[j] if size == '1' else f'{size} {names[j]}'}"
    return text + (f" + ... ({len(shown) - MOST_TERMS} more)" if len(shown) > MOST_TERMS else "")


def _name_directions(
    information: SquareRootInformation, solution: FactorSolution
) -> tuple[str, ...]:
    """Return the undetermined directions as text."""
    names = information.base.names
    return tuple(format_combination(direction, names) for direction in solution.open_directions)


def _make_refusal(
    information: SquareRootInformation, solution: FactorSolution
) -> IdentifiabilityError:
    names = _name_directions(information, solution)
    listed = "; ".join(names[:8]) + (f"; and {len(names) - 8} more" if len(names) > 8 else "")
    return IdentifiabilityError(
        f"the recording determines {solution.rank} of {information.base.n_base} parameters of"
        f" {information.base.robot}; undetermined: {listed}",
        cure=Cure(
            "move the joints concerned more (several at once, both directions, changing speed), or"
            " resolve these directions toward CAD",
            settings={"undetermined": "toward_prior"},
        ),
    )


def check_weights(weights: ArrayLike, seen: Mask) -> Array:
    """Return weights of n joints as an array, positive where `seen` (n,); else `UsageError`."""
    w = np.asarray(weights, dtype=np.float64)
    n = len(seen)
    if w.shape != (n,) or not np.all(np.isfinite(w)) or np.any(w[seen] <= 0):
        raise UsageError(f"weights must be {n} positive numbers, one per joint, got {w.tolist()}")
    return w


@dataclass(frozen=True, slots=True, eq=False)
class RecursiveEstimate:
    """Hold the estimate after a sample.

    `beta` and `std_errors` (p,), `sigma` of a weighted residual and the samples that still count.

    Standard errors take residuals as independent; directions without excitation have zero,
    and `rank` says how many have some.
    """

    beta: Array
    std_errors: Array
    sigma: float
    rank: int
    n_effective: float


class RecursiveIdentification:
    """Keep the triangular factor R of [W | tau] and renew it sample by sample.

    `R <- triangle of [sqrt(f) R; weights [Y | tau]]`.

    With `forgetting` f = 1 the estimate is the fit of all samples at once; with f < 1 a sample
    counts f^age, a memory of 1 / (1 - f) samples, so that a change of load is followed. `weights`
    (n,) are one per joint, 1 / sigma of a batch fit say. `prior` (p,) holds values of what no
    sample excites. With `prior_strength` > 0 (how many samples of unit weighted torque it is worth)
    it is never forgotten, so that rest loses nothing. Friction that depends on load uses the load
    of `model`.

    Source: Bierman, Factorization Methods for Discrete Sequential Estimation, 1977, chapter 5;
    square-root form of recursive least squares with forgetting.

    Examples
    --------
    >>> from asbuilt.description.load import load_robot
    >>> from asbuilt.dynamics.base.base_parameters import find_base_parameters
    >>> model = load_robot("kuka-iiwa7-r800")
    >>> line = RecursiveIdentification(model, find_base_parameters(model), forgetting=0.999)
    >>> line.update([0.1] * 7, [0.0] * 7, [0.0] * 7, [0.0] * 7).rank
    6
    """

    def __init__(
        self,
        model: RobotModel,
        base: BaseParameters,
        *,
        weights: ArrayLike | None = None,
        forgetting: float = 1.0,
        prior: ArrayLike | None = None,
        prior_strength: float = 0.0,
    ) -> None:
        n = model.n_joints
        p = base.n_base
        w = np.ones(n) if weights is None else check_weights(weights, np.ones(n, dtype=np.bool_))
        if not 0.0 < forgetting <= 1.0:
            raise UsageError(
                f"the forgetting factor must lie above 0 and be at most 1, got {forgetting}; 0.999"
                " remembers about 1000 samples"
            )
        if not 0.0 <= prior_strength < np.inf:
            raise UsageError(
                "the strength of the prior must be a number of samples and not negative, got"
                f" {prior_strength}"
            )
        toward = np.nan_to_num(np.zeros(p) if prior is None else np.array(prior, float), nan=0.0)
        if toward.shape != (p,):
            raise UsageError(
                f"the prior of {base.robot} needs {p} base parameters, got shape {toward.shape}"
            )
        self.model = model
        self.base = base
        self.forgetting = float(forgetting)
        self._weights = w
        self._prior = toward
        self._strength = float(prior_strength)
        self._plan = RegressorPlan.of(model, base.drive, base.columns)
        # Column-major, so that LAPACK overwrites the rows in place.
        self._rows = np.zeros((p + 1 + n, p + 1), order="F")
        self._counted = 0.0

    @property
    def factor(self) -> Array:
        """The triangular factor (p + 1, p + 1) of the weighted, forgotten stack."""
        return np.triu(self._rows[: self.base.n_base + 1])

    def update(
        self, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike, tau: ArrayLike
    ) -> RecursiveEstimate:
        """Add one sample, each (n,), or a few at once, (m, n), and return the estimate after it.

        Raises `IdentifiabilityError` for NaN.
        """
        arrays = [np.atleast_2d(np.asarray(x, dtype=np.float64)) for x in (q, qd, qdd, tau)]
        n = self.model.n_joints
        p = self.base.n_base
        if any(x.shape != (len(arrays[0]), n) for x in arrays):
            raise UsageError(
                f"a sample of {self.model.name} needs q, qd, qdd and tau of {n} values each, got"
                f" {[x.shape for x in arrays]}"
            )
        if not all(np.all(np.isfinite(x)) for x in arrays):
            raise IdentifiabilityError("a sample holds NaN or infinite values; leave it out")
        stack = self._plan.stack(*arrays[:3]).reshape(-1, n, p)
        for columns, torque in zip(stack, arrays[3], strict=True):
            # The square of the factor is the information: it forgets by f.
            self._rows[: p + 1] *= np.sqrt(self.forgetting)
            self._rows[p + 1 :, :p] = self._weights[:, None] * columns
            self._rows[p + 1 :, p] = self._weights * torque
            self._rows, _, _, _ = lapack.dgeqrf(self._rows, overwrite_a=True)
            # Below the diagonal LAPACK leaves the reflections.
            self._rows[:] = np.triu(self._rows)
            self._counted = self.forgetting * self._counted + 1.0
        return self.estimate()

    def estimate(self) -> RecursiveEstimate:
        """Return the estimate from the samples so far."""
        solution = self.solution()
        variance = solution.residual_energy / max(
            self._counted * self.model.n_joints - solution.rank, 1.0
        )
        return RecursiveEstimate(
            beta=solution.x,
            std_errors=np.sqrt(variance * np.sum(solution.inverse_root**2, axis=1)),
            sigma=float(np.sqrt(variance)),
            rank=solution.rank,
            n_effective=self._counted,
        )

    def solution(self) -> FactorSolution:
        """Return the least-squares solution behind the estimate."""
        p = self.base.n_base
        factor = self.factor
        if self._strength > 0.0:
            # The mean length of a column per sample is what one sample says about its parameter.
            length = np.linalg.norm(factor[:, :p], axis=0) / np.sqrt(max(self._counted, 1.0))
            # A column that was never excited has no length; any positive one holds its parameter.
            pull = np.sqrt(self._strength) * np.where(length > 0, length, 1.0)
            # Stacked for the answer alone: a prior in the kept factor would be forgotten with it.
            rows = np.vstack([factor, np.column_stack([np.diag(pull), pull * self._prior])])
            factor = np.triu(np.asarray(lapack.dgeqrf(rows)[0])[: p + 1])
        return solve_factor(factor, max(1, round(self._counted)) * self.model.n_joints, self._prior)


KEPT_STEPS = 5
"""Steps that are combined."""


class FixedPoint:
    """Extrapolate an iteration `x <- g(x)`.

    The step is the combination of the last ones whose changes `g(x) - x` cancel best (Anderson,
    J. ACM 12, 1965; Walker and Ni, SIAM J. Numerical Analysis 49, 2011); of one number, the secant.
    Far from the fixed point (a change above `near`), and after a change that grew, it is the plain
    one, so that the iteration stays with its own fixed point.

    >>> ahead, x = FixedPoint(), np.array([0.0])
    >>> for _ in range(3):
    ...     x = ahead.advance(x, 1.0 + 0.9 * x)
    >>> x.round(6).tolist()
    [10.0]
    """

    def __init__(self, near: float = np.inf) -> None:
        self._near = near
        self._changes: list[Array] = []
        self._images: list[Array] = []

    def advance(self, given: Array, image: Array) -> Array:
        """Return the values (n,) to try after those `given` became their `image`."""
        change = image - given
        size = float(np.max(np.abs(change), initial=0.0))
        if size > self._near or (self._changes and size > np.max(np.abs(self._changes[-1]))):
            self._changes = []
            self._images = []
        self._changes = [*self._changes[-KEPT_STEPS:], change]
        self._images = [*self._images[-KEPT_STEPS:], image]
        if len(self._changes) < 2:
            return image
        share = np.linalg.lstsq(np.diff(self._changes, axis=0).T, change, rcond=None)[0]
        return np.asarray(image - np.diff(self._images, axis=0).T @ share)
