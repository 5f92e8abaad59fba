"""Least squares on square-root information, ordinary or with a weight per joint."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array, Mask
from asbuilt.dynamics.kernels.blas import use_one_blas_thread
from asbuilt.errors import IdentifiabilityError, UsageError
from asbuilt.findings import Cure
from asbuilt.identification.estimators.methods import estimator
from asbuilt.identification.fixed_point import FixedPoint
from asbuilt.identification.information.estimate import (
    Estimate,
    EstimationData,
    noise_floor,
    residual_deviation,
)
from asbuilt.identification.information.square_root_information import SquareRootInformation
from asbuilt.identification.information.triangular import (
    NEGLIGIBLE_COEFFICIENT,
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
    n = information.n_joints
    rows = information.n_rows
    refuse_few_rows(information)
    toward = None if prior is None else np.nan_to_num(np.asarray(prior, dtype=np.float64), nan=0.0)
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
    iterations = int(not iterated)
    converged = True
    ahead = FixedPoint(NEAR)
    while iterated:
        iterations += 1
        x, root = solve_fast(information.stacked(w), rows, toward)
        renewed = 1.0 / np.maximum(residual_deviation(information, x, root, w), floor)
        converged = bool(np.all(np.abs(renewed - w) <= settled * renewed))
        if converged or iterations > MOST_ITERATIONS:
            break
        # In logarithms, so that an extrapolated weight stays positive.
        image = np.log(renewed[seen])
        tried = ahead.advance(np.log(w[seen]), image)
        # Without an extrapolation the weights are taken as they are, not through a logarithm.
        w[seen] = renewed[seen] if tried is image else np.exp(tried)
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
        determined=np.all(np.abs(solution.open_directions) <= NEGLIGIBLE_COEFFICIENT, axis=0),
        iterations=iterations,
        converged=converged,
    )


def refuse_few_rows(information: SquareRootInformation) -> None:
    """Raise `IdentifiabilityError` for fewer torques than parameters."""
    if information.n_rows <= information.base.n_base:
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
    shown = [j for j in order if abs(direction[j]) > NEGLIGIBLE_COEFFICIENT * abs(lead)]
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
