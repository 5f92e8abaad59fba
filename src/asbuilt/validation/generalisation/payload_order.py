"""Whether torques under load belong to the joints they are logged for."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.inertia import shift_matrix
from asbuilt.dynamics.newton_euler import inverse_dynamics
from asbuilt.errors import RecordingError
from asbuilt.experiment.signal.samples import Samples
from asbuilt.findings import Cure
from asbuilt.identification import IdentificationResult, predict_torque
from asbuilt.tables import round_significant

# Say when torques count as swapped or negated; own choices, tested on real robots.
#
# `SWAP_LEFT` is the part of the squared error that a swap of two torques or one opposite sign may
# leave at most; `SWAP_NOISE` the squared error per torque, in noise variances of the result, below
# which nothing is tried.

SWAP_LEFT = 0.25
SWAP_NOISE = 4.0


def refuse_swapped(
    result: IdentificationResult, loaded: Sequence[Samples], link: int, placement: Array
) -> None:
    """Refuse torques under load that fit far better with two swapped or one negated.

    With the arm known, any body at `placement` (4, 4) on `link` explains the right order best.
    This also covers wrists, whose friction the result has. Recordings are looked at one by one.

    Raises
    ------
    RecordingError
        If torques seem swapped or negated.
    """
    weights = result.weights
    for samples in loaded:
        arm = predict_torque(result.model, result.base, result.estimates, samples)
        basis = _build_body_torques(result, samples, link, placement)
        as_logged = _measure_remaining_error((arm.measured - arm.predicted) * weights, basis)
        # A body explains the torques as logged: nothing is asked.
        if as_logged < SWAP_NOISE:
            continue
        tried = [
            (_measure_remaining_error((changed - arm.predicted) * weights, basis), what, cure)
            for changed, what, cure in _list_changes(arm.measured, result.joint_names)
        ]
        best, what, cure = min(tried, key=lambda trial: trial[0])
        if best < SWAP_LEFT * as_logged:
            raise RecordingError(
                f"{samples.source}: the torques do not fit the arm of the result with any body at"
                f" its flange; {what} (error {round_significant(np.sqrt(as_logged), 2)} times the"
                " noise"
                f" of the result as logged, {round_significant(np.sqrt(best), 2)} times then)",
                cure=cure,
            )


def _build_body_torques(
    result: IdentificationResult, samples: Samples, link: int, placement: Array
) -> Array:
    """Return an orthonormal basis (N n, r) of the weighted torques that a body there can make."""
    shift = shift_matrix(placement)
    model = result.model
    columns = np.empty((samples.n_filtered, model.n_joints, 10))
    for i in range(10):
        # The body in the link's axes, parameter by parameter.
        links = np.zeros(10 * model.n_links)
        links[10 * link : 10 * link + 10] = shift[:, i]
        columns[:, :, i] = samples.filtered(
            inverse_dynamics(model, samples.q, samples.qd, samples.qdd, parameters=links)
        )
    basis, lengths, _ = np.linalg.svd(
        (columns * result.weights[:, None]).reshape(-1, 10), full_matrices=False
    )
    # A body in a frame on an axis has directions without torque.
    rounding = np.finfo(np.float64).eps * len(basis) * lengths.max(initial=0.0)
    return np.asarray(basis[:, lengths > rounding])


def _list_changes(measured: Array, names: Sequence[str]) -> Iterator[tuple[Array, str, Cure]]:
    """Yield the torques with two joints swapped, or one negated."""
    n = len(names)
    for j, k in combinations(range(n), 2):
        order = np.arange(n)
        order[[j, k]] = k, j
        yield (
            measured[:, order],
            f"the torques of {names[j]} and {names[k]} look swapped",
            Cure(
                "check the order of the torque columns; a recording sheet names them:"
                " [columns] torque = [...]",
                {"checked": False},
            ),
        )
    for k in range(n):
        signs = np.where(np.arange(n) == k, -1.0, 1.0)
        listed = ", ".join(f"{sign:g}" for sign in signs)
        yield (
            measured * signs,
            f"the torque of {names[k]} alone has the opposite sign",
            Cure(f"turn it in a recording sheet: sign = [{listed}]", {"checked": False}),
        )


def _measure_remaining_error(error: Array, basis: Array) -> float:
    # What an orthonormal basis leaves: |y|^2 - |Q^T y|^2.
    """Return the mean square of a weighted error (N, n) that a basis (N n, r) leaves."""
    y = error.ravel()
    return float(y @ y - np.sum((basis.T @ y) ** 2)) / y.size
