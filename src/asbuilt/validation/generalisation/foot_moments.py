"""Moments that brake the turning of feet on the ground, which forces at points do not have."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics import observation_matrix
from asbuilt.dynamics.contact import contact_jacobians
from asbuilt.dynamics.kernels.blas import use_one_blas_thread
from asbuilt.experiment.signal.samples import Samples
from asbuilt.findings import Cure, Finding
from asbuilt.identification import IdentificationResult
from asbuilt.scaled import Scaled
from asbuilt.tables import format_plus_minus

SAMPLES = 1500
"""Samples of a recording that are looked at."""
BLOCKS = 12
"""Parts of a recording by whose scatter the moments have errors."""
SURE = 4.0
"""Standard errors from which a moment is named: the model's own error is no noise."""
SLOWEST = 0.02
"""Rate of turning [rad/s] below which a foot sticks, and its moment has no direction."""


@use_one_blas_thread()
def report_foot_moments(
    result: IdentificationResult, samples: Sequence[Samples]
) -> Iterator[Finding]:
    """Name friction that brakes the turning and rolling of feet.

    A foot that is pressed down by f and turns at w has the moment `-l f sign(w)` about the normal,
    and the same about the ground's axes as it rolls, each with a length l. Both are fitted with all
    base parameters to what forces at the feet leave, with errors by the scatter of time blocks.
    """
    model = result.model
    used = [batch for batch in samples if batch.contact is not None]
    if model.n_floating != 6 or not used or any(contact.flat for contact in model.contacts):
        return
    n_base = result.n_base
    blocks: list[Array] = []
    for batch in used:
        rows = _build_rows(result, model, batch)
        blocks += [part.T @ part for part in np.array_split(rows, BLOCKS)]
    total = np.sum(blocks, axis=0)
    normal = Scaled(total[:-1, :-1])
    if not normal.determined[n_base:].any():
        return
    values = normal.solve(total[:-1, -1])
    scores = np.array([block[:-1, -1] - block[:-1, :-1] @ values for block in blocks])
    spread = normal.solve(scores.T)
    errors = np.sqrt(np.sum(spread**2, axis=1) * len(blocks) / (len(blocks) - 1))
    parts = [
        f"{what} {format_plus_minus(1e3 * values[place], 1e3 * errors[place])} mm"
        for what, place in (("torsional", n_base), ("rolling", n_base + 1))
        if values[place] > SURE * errors[place] > 0.0
    ]
    if parts:
        yield Finding(
            "foot_moments",
            "warning",
            f"Feet have moments that brake their turning, which forces at a point do not have:"
            f" friction per force, {' and '.join(parts)}; errors of parameters do not include them",
            Cure("log forces and moments at the feet, or use motions on which feet do not turn"),
        )


def _build_rows(result: IdentificationResult, model: RobotModel, batch: Samples) -> Array:
    """Return rows of base parameters, both moments per length, and torque, without forces."""
    every = slice(None, None, -(-batch.n_samples // SAMPLES))
    q, qd, qdd, tau = (x[every] for x in (batch.q, batch.qd, batch.qdd, batch.tau))
    assert batch.contact is not None
    closed = batch.contact[every] > 0.0
    n = model.n_joints
    base = result.base
    W = observation_matrix(model, q, qd, qdd, drive=base.drive, columns=base.columns)
    W = W.reshape(len(q), n, -1)
    as_soles = tuple(replace(contact, flat=True) for contact in model.contacts)
    J = np.stack(contact_jacobians(replace(model, contacts=as_soles), q), axis=1)
    J = J * closed[:, :, None, None]
    # Forces at the points, three each, follow from the equations; what they leave has none.
    across = J[:, :, :3].reshape(len(q), -1, n)
    back = np.linalg.pinv(across)
    force = np.einsum("snm,sn->sm", back, W @ result.estimates - tau).reshape(len(q), -1, 3)
    turning = np.einsum("sckj,sj->sck", J[:, :, 3:], qd)
    pressed = np.maximum(force[:, :, 2], 0.0)
    spin = turning[:, :, 2] / np.maximum(np.abs(turning[:, :, 2]), SLOWEST)
    level = turning[:, :, :2]
    roll = level / np.maximum(np.linalg.norm(level, axis=2, keepdims=True), SLOWEST)
    moments = np.stack(
        [
            -np.einsum("sc,scj->sj", pressed * spin, J[:, :, 5]),
            -np.einsum("sck,sckj->sj", pressed[:, :, None] * roll, J[:, :, 3:5]),
        ],
        axis=2,
    )
    whole = np.concatenate([W, -moments, tau[:, :, None]], axis=2)
    whole -= np.einsum("smj,snm,snc->sjc", across, back, whole, optimize=True)
    whole /= result.sigma[:, None]
    return whole.reshape(-1, whole.shape[2])
