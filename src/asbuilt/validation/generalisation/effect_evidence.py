"""Whether an effect that a model lacks is significant by its own scatter between time blocks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from asbuilt.dynamics.base.base_parameters import find_base_parameters
from asbuilt.dynamics.drives.selection import DriveSet, available_terms
from asbuilt.errors import AsbuiltError
from asbuilt.identification.errors.block_scatter import student_probability, widening
from asbuilt.identification.errors.uncertainty import block_uncertainty
from asbuilt.identification.estimators.methods import methods
from asbuilt.identification.information.estimation_data import EstimationData
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
    drive = _with_term(result.base.drive, key, joints)
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


def _with_term(drive: DriveSet, key: str, joints: Sequence[int]) -> DriveSet:
    """Return drive terms with one more at these joints, beside those that have it already."""
    described = next((term for term in drive.terms if term.key == key), None)
    numbers = {k + 1 for k in joints} | set(() if described is None else described.joints or ())
    listed = "/".join(map(str, sorted(numbers)))
    (term,) = DriveSet.parse(f"{key}:joints={listed}").terms
    return drive.with_term(term)
