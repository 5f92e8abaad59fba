"""Whether the torques under load belong to the joints they are logged for.

With the arm known, any body at the flange explains the right order best.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.inertia import shift_matrix
from asbuilt.dynamics.newton_euler import inverse_dynamics
from asbuilt.errors import RecordingError
from asbuilt.experiment.signal.samples import Samples
from asbuilt.identification.result.result import IdentificationResult
from asbuilt.identification.result.torque_prediction import predict_torque
from asbuilt.tables import significant

DECISIVE = 0.25
"""Part of the squared error, in noise of the joints, that an exchange of two torques or a turned
sign must leave at most to be believed.
"""
AUDIBLE = 4.0
"""Squared error per torque, in noise variances of the result, below which all is well as it is."""


def refuse_exchanged(
    result: IdentificationResult, loaded: Sequence[Samples], link: int, placement: Array
) -> None:
    """Raise RecordingError where the arm of the result and some body at `placement` (4, 4) on
    `link` explain torques under load far better once two are exchanged or one is turned.

    CAD tells the order of joints that gravity loads; this tells that of wrists, whose friction the
    result knows. Each recording is judged alone.
    """
    shift, weights = shift_matrix(placement), result.weights
    n = result.model.n_joints
    for samples in loaded:
        arm = predict_torque(result.model, result.base, result.estimates, samples)
        columns = np.empty((*arm.measured.shape, 10))
        for i in range(10):
            links = np.zeros(10 * n)
            links[10 * link : 10 * link + 10] = shift[:, i]
            columns[:, :, i] = samples.filtered(
                inverse_dynamics(result.model, samples.q, samples.qd, samples.qdd, parameters=links)
            )
        basis, lengths, _ = np.linalg.svd(
            (columns * weights[:, None]).reshape(-1, 10), full_matrices=False
        )
        basis = basis[:, lengths > np.finfo(np.float64).eps * len(basis) * lengths.max(initial=0.0)]
        as_logged = _left((arm.measured - arm.predicted) * weights, basis)
        if as_logged < AUDIBLE:
            continue
        tried: list[tuple[float, str, str]] = []
        for j, k in combinations(range(n), 2):
            order = np.arange(n)
            order[[j, k]] = k, j
            pair = f"those of {result.joint_names[j]} and {result.joint_names[k]} look swapped"
            tried.append(
                (
                    _left((arm.measured[:, order] - arm.predicted) * weights, basis),
                    pair,
                    (
                        "Check the order of the torque columns; name them in a recording sheet:"
                        " [columns] torque = [...]"
                    ),
                )
            )
        for k in range(n):
            signs = np.where(np.arange(n) == k, -1.0, 1.0)
            listed = ", ".join(f"{sign:g}" for sign in signs)
            tried.append(
                (
                    _left((arm.measured * signs - arm.predicted) * weights, basis),
                    f"that of {result.joint_names[k]} alone has the opposite sign",
                    f"Turn it in a recording sheet: sign = [{listed}]",
                )
            )
        best, what, cure = min(tried)
        if best < DECISIVE * as_logged:
            raise RecordingError(
                f"{samples.source}: the torques do not fit the arm of the result with any body at"
                f" its flange; {what} (error {significant(np.sqrt(as_logged), 2)} times the noise"
                f" of the result as logged, {significant(np.sqrt(best), 2)} times then). {cure};"
                " --unchecked takes the recording as it is"
            )


def _left(error: Array, basis: Array) -> float:
    """Return the mean square of a weighted torque error (N, n) beside what orthonormal columns (N
    n, r) of a body explain.
    """
    y = error.ravel()
    return float(y @ y - np.sum((basis.T @ y) ** 2)) / y.size
