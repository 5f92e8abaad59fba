"""Whether an effect that a model lacks is significant by its own scatter between time blocks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import BaseParameters, find_base_parameters
from asbuilt.dynamics.drives.selection import DriveSet, available_terms
from asbuilt.dynamics.kernels.blas import one_blas_thread
from asbuilt.dynamics.newton_euler import gravity_torque
from asbuilt.dynamics.regressor import RegressorPlan
from asbuilt.errors import AsbuiltError
from asbuilt.identification.errors.block_scatter import student_probability, widening
from asbuilt.identification.errors.delay_errors import DelayColumns, DelaySolution
from asbuilt.identification.errors.uncertainty import block_uncertainty
from asbuilt.identification.estimators.methods import methods
from asbuilt.identification.information.estimate import Estimate
from asbuilt.identification.information.estimation_data import EstimationData
from asbuilt.identification.information.rows import sample_blocks
from asbuilt.identification.information.square_root_information import accumulate_stream
from asbuilt.identification.result.design_values import design_values

if TYPE_CHECKING:
    from asbuilt.experiment.signal.samples import Samples
    from asbuilt.identification.result.result import IdentificationResult


def own_evidence(
    result: IdentificationResult,
    training: Sequence[Samples],
    key: str,
    joints: Sequence[int],
    *,
    block_seconds: float | None = None,
) -> dict[int, tuple[float, float]]:
    """Return size in standard errors and p value of a drive term at each of some joints (from 0).

    The samples are fitted with the term by weighted least squares. Its standard error is that from
    time blocks (`block_uncertainty`), with its own degrees of freedom: the correlation of residuals
    differs from column to column. Empty if the term cannot be fitted.
    """
    drive = with_term(result.base.drive, key, joints)
    try:
        base = find_base_parameters(result.model, drive)
        information = accumulate_stream(result.model, base, training, block_seconds=block_seconds)
        data = EstimationData(
            result.model, information, training, design_values(result.model, base)
        )
        estimate = methods.find("wls").estimate(data)
        errors = block_uncertainty(information, estimate)
    except (AsbuiltError, np.linalg.LinAlgError):
        return {}
    n = base.n_base
    freedom = np.full(n, np.inf) if errors.scatter is None else errors.scatter.degrees_of_freedom
    sigmas = np.divide(
        estimate.beta, errors.std_errors, out=np.zeros(n), where=errors.std_errors > 0
    )
    p_values, narrow = student_probability(sigmas, freedom), sigmas * widening(freedom)
    found: dict[int, tuple[float, float]] = {}
    for k in joints:
        names = {f"{symbol}{k + 1}" for symbol in available_terms()[key].symbols}
        places = [j for j, name in enumerate(base.names) if name in names]
        if places:
            best = min(places, key=lambda j: float(p_values[j]))
            found[k] = float(abs(narrow[best])), float(p_values[best])
    return found


def with_term(drive: DriveSet, key: str, joints: Sequence[int]) -> DriveSet:
    """Return drive terms with one more at these joints, beside those that have it already."""
    described = next((term for term in drive.terms if term.key == key), None)
    numbers = {k + 1 for k in joints} | set(() if described is None else described.joints or ())
    listed = "/".join(map(str, sorted(numbers)))
    (term,) = DriveSet.parse(f"{key}:joints={listed}").terms
    return drive.with_term(term)


def tilt_evidence(
    result: IdentificationResult,
    training: Sequence[Samples],
    axes: Array,
    *,
    block_seconds: float | None = None,
) -> float:
    """Return the size of a base tilt about `axes` (2, 3) in standard errors from time blocks.

    The gravity torques of the links by design under `g x axis` are two further columns of the fit.
    """
    estimate = plain_fit(result.model, result.base, training, block_seconds)
    solved = fitted_tilt(result.model, result.base, estimate, training, axes, block_seconds)
    if not np.all(np.isfinite(solved.covariance)):
        return 0.0
    tilt = solved.increments
    return float(np.sqrt(tilt @ np.linalg.solve(solved.covariance, tilt)))


def fitted_tilt(
    model: RobotModel,
    base: BaseParameters,
    estimate: Estimate,
    training: Sequence[Samples],
    axes: Array,
    block_seconds: float | None = None,
) -> DelaySolution:
    """Return the base tilt about `axes` (2, 3) beside an estimate, in rad.

    Its errors are from the scatter of time blocks that the tilt leaves.
    """
    plan = RegressorPlan.of(model, base.drive, base.columns, spare_rows=len(axes) + 1)
    tilted = [model.with_gravity(np.cross(model.gravity, axis)) for axis in axes]
    root, m = estimate.solution.inverse_root, len(axes)
    parts: list[tuple[Array, Array, Array, Array, Array]] = []
    with one_blas_thread():
        for part in sample_blocks(model, training, block_seconds):
            r = root.shape[1]
            sums = np.zeros((r + m, r + m)), np.zeros(r + m)
            for chunk in part.chunks(plan, _gravity(tilted, part.samples.q)):
                for k, rows in enumerate(chunk):
                    support, columns = plan.support[k], rows[: -m - 1]
                    e = estimate.weights[k] * (rows[-1] - estimate.beta[support] @ columns)
                    x = np.vstack([root[support].T @ columns, rows[-m - 1 : -1]])
                    x *= estimate.weights[k]
                    sums[0][...] += x @ x.T
                    sums[1][...] += x @ e
            gram, score = sums
            parts.append((gram[:r, :r], gram[:r, r:], gram[r:, r:], score[:r], score[r:]))
    place: Any = np.zeros(len(parts), dtype=np.int64)
    grams, across, own, by_beta, by_tilt = map(np.array, zip(*parts, strict=True))
    blocks = DelayColumns(grams, across, own, by_beta, by_tilt, place, root)
    shares = np.eye(m)[None]
    tilt = blocks.solve(shares)
    return replace(tilt, covariance=_fitted(blocks, tilt.increments).solve(shares).covariance)


def _gravity(models: Sequence[RobotModel], q: Array) -> Callable[[slice], list[Array]]:
    """Return what gives the gravity torques of models on a span of positions."""
    return lambda span: [gravity_torque(each, q[span]) for each in models]


def _fitted(blocks: DelayColumns, values: Array) -> DelayColumns:
    """Return normal equations whose residual is that with these values of the further columns.

    Without them the effect itself would count as scatter between blocks.
    """
    moved = np.linalg.pinv(blocks.grams.sum(axis=0), hermitian=True) @ blocks.across.sum(axis=0)
    back = moved @ values
    return replace(
        blocks,
        beta_scores=blocks.beta_scores - blocks.across @ values + blocks.grams @ back,
        delay_scores=blocks.delay_scores
        - blocks.own @ values
        + np.einsum("brm,r->bm", blocks.across, back),
    )


def plain_fit(
    model: RobotModel,
    base: BaseParameters,
    training: Sequence[Samples],
    block_seconds: float | None,
) -> Estimate:
    """Return the weighted least squares fit of a model."""
    information = accumulate_stream(model, base, training, block_seconds=block_seconds)
    design = design_values(model, base)
    return methods.find("wls").estimate(EstimationData(model, information, training, design))
