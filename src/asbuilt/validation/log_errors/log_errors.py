"""Errors of a log that its residual shows: clock, zero positions, gains, and what drifts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from typing import TYPE_CHECKING

import numpy as np

from asbuilt.arrays import Array
from asbuilt.dynamics.kernels.blas import one_blas_thread
from asbuilt.dynamics.regressor import RegressorPlan
from asbuilt.identification.estimators.methods import methods
from asbuilt.identification.information.estimation_data import EstimationData
from asbuilt.identification.information.rows import sample_blocks
from asbuilt.identification.information.square_root_information import accumulate_stream
from asbuilt.identification.result.design_values import design_values
from asbuilt.validation.log_errors.error_columns import (
    Candidate,
    ErrorColumns,
    Kind,
    largest_torques,
)
from asbuilt.validation.log_errors.forward_selection import BlockEquations, Chosen

if TYPE_CHECKING:
    from asbuilt.experiment.signal.samples import Samples
    from asbuilt.identification.result.result import IdentificationResult

MOST = 6
"""Columns chosen, of the log and of the model together."""
SEARCHED = 40_000
"""Samples that are searched; of longer recordings every so many blocks."""
CLOCK_ROUNDS, CLOCK_FOUND = 12, 2e-3
"""Newton steps of the clock, and the step at which it is found."""
LARGEST_STEP = 0.5
"""Largest step of the logarithm of the clock's rate."""


@dataclass(frozen=True, slots=True)
class Bounds:
    """Say between which values an error is plausible, and from which size on it matters."""

    lowest: float
    highest: float
    matters: float


BOUNDS: dict[Kind, Bounds] = {
    "clock": Bounds(-np.inf, np.inf, 0.01),
    "zero": Bounds(-np.deg2rad(20.0), np.deg2rad(20.0), np.deg2rad(0.3)),
    "scale": Bounds(-1.15, 1.0, 0.03),
    "nonlinear": Bounds(-0.8, 0.0, 0.05),
    "drift": Bounds(-np.inf, np.inf, 0.02),
    "warming": Bounds(-1.5, 1.5, 0.05),
    "spring": Bounds(-np.inf, np.inf, 0.02),
}
"""Own choices: what a robot in use can have; `drift` and `spring` in
largest torques of the joint."""
IN_TORQUES = ("drift", "spring")
NAMED = 0.05
"""Share of the squared residual from which on an error is named."""
PRISMATIC_ZERO = Bounds(-0.05, 0.05, 1e-3)


@dataclass(frozen=True, slots=True)
class LogError:
    """Hold an error of a log: value and standard error as `Candidate` says, and its share.

    `share` is what it takes away from the squared torque residual.
    """

    kind: Kind
    joint: str | None
    value: float
    std_error: float
    share: float


def log_errors(
    result: IdentificationResult,
    training: Sequence[Samples],
    *,
    block_seconds: float | None = None,
) -> tuple[LogError, ...]:
    """Return the errors of the log that the residual of a result shows, the largest share first.

    Columns of all candidates are added to the weighted least squares fit one at a time
    (`BlockEquations.selected`). A clock that is off by more than what is first order is found by
    Newton's method, if it explains most, and then named alone: the others are of wrong velocities.

    Parameters
    ----------
    result
        The result; candidates are linearised about its values.
    training
        The samples it was identified from.
    block_seconds
        Length of the time blocks of standard errors [s].
    """
    if not training:
        return ()
    found = _selected(result, training, block_seconds)
    if found and found[0].kind == "clock":
        clock = _clock(result, training, found[0], block_seconds)
        return () if clock is None else (clock,)
    of_log = [each for each in found if each.kind not in ("clock", "tilt", "drive")]
    curved = {each.joint for each in of_log if each.kind == "nonlinear"}
    return tuple(
        each
        for each in of_log
        if each.share >= NAMED and not (each.kind == "scale" and each.joint in curved)
    )


def _selected(
    result: IdentificationResult, training: Sequence[Samples], block_seconds: float | None
) -> list[LogError]:
    columns, equations = _equations(result, training, result.estimates, block_seconds)
    candidates = columns.candidates

    def admitted(column: int, value: float) -> bool:
        bounds = _bounds(result, candidates[column])
        return bounds is None or bounds.lowest <= value <= bounds.highest

    largest = largest_torques(training)
    found: list[LogError] = []
    for each in equations.selected(MOST, admitted):
        own = candidates[each.column]
        bounds = _bounds(result, own)
        size = largest[own.joint] if own.kind in IN_TORQUES and own.joint is not None else 1.0
        if bounds is None or abs(each.value) >= bounds.matters * size:
            found.append(_named(result, own, each))
    return found


def _named(result: IdentificationResult, own: Candidate, chosen: Chosen) -> LogError:
    joint = None if own.joint is None else result.model.joint_names[own.joint]
    return LogError(own.kind, joint, chosen.value, chosen.std_error, chosen.share)


def _bounds(result: IdentificationResult, candidate: Candidate) -> Bounds | None:
    """Return the bounds of a candidate; None for what the model may lack."""
    if candidate.kind == "zero" and candidate.joint is not None:
        revolute = result.model.joints[candidate.joint].is_revolute
        return BOUNDS["zero"] if revolute else PRISMATIC_ZERO
    return BOUNDS.get(candidate.kind)


def _clock(
    result: IdentificationResult,
    training: Sequence[Samples],
    first: LogError,
    block_seconds: float | None,
) -> LogError | None:
    """Return the error of the clock by Newton steps; None if they do not settle."""
    factor, step, error = 1.0, first.value, first.std_error
    for _ in range(CLOCK_ROUNDS):
        step = float(np.clip(step, -LARGEST_STEP, LARGEST_STEP))
        factor *= float(np.exp(step))
        if abs(step) < CLOCK_FOUND:
            return replace(first, value=factor - 1.0, std_error=factor * error)
        faster = [
            replace(samples, qd=samples.qd * factor, qdd=samples.qdd * factor**2)
            for samples in training
        ]
        _, equations = _equations(result, faster, None, block_seconds)
        (tried,) = equations.tried([0]) or (None,)
        if tried is None:
            return None
        step, error = tried.value, tried.std_error
    return None


def _equations(
    result: IdentificationResult,
    training: Sequence[Samples],
    values: Array | None,
    block_seconds: float | None,
) -> tuple[ErrorColumns, BlockEquations]:
    """Return candidates about values (None: those of the fit), and their normal equations."""
    model, base = result.model, result.base
    information = accumulate_stream(model, base, training, block_seconds=block_seconds)
    data = EstimationData(model, information, training, design_values(model, base))
    estimate = methods.find("wls").estimate(data)
    about = estimate.beta if values is None else values
    columns = ErrorColumns(model, base, about, largest_torques(training))
    m = len(columns.candidates)
    plan = RegressorPlan.of(model, base.drive, base.columns, spare_rows=m + 1)
    root = estimate.solution.inverse_root
    r = root.shape[1]
    n_samples = sum(samples.n_samples for samples in training)
    every = max(1, round(n_samples / SEARCHED))
    parts: list[tuple[Array, Array, float]] = []
    with one_blas_thread():
        blocks = sample_blocks(model, training, block_seconds)
        for part in islice(blocks, 0, None, every):
            beside = partial(columns.evaluate, part.samples)
            gram, score, square = np.zeros((r + m, r + m)), np.zeros(r + m), 0.0
            for chunk in part.chunks(plan, beside):
                for k, rows in enumerate(chunk):
                    support, weight = plan.support[k], estimate.weights[k]
                    known = rows[: -m - 1]
                    e = weight * (rows[-1] - estimate.beta[support] @ known)
                    x = weight * np.vstack([root[support].T @ known, rows[-m - 1 : -1]])
                    gram += x @ x.T
                    score += x @ e
                    square += float(e @ e)
            parts.append((gram, score, square))
    grams, scores, squares = map(np.array, zip(*parts, strict=True))
    return columns, BlockEquations(grams, scores, squares, r)
