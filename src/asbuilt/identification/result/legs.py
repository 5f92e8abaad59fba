"""What a robot on legs adds to findings: the motion that it lacks, and moments at its feet."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics import observation_matrix
from asbuilt.dynamics.kernels.blas import use_one_blas_thread
from asbuilt.dynamics.reactions import contact_jacobians
from asbuilt.excitation.motions.on_legs import leg_motions
from asbuilt.experiment.signal.samples import Samples
from asbuilt.findings import Cure, Finding, join_names, undesigned
from asbuilt.identification.result.as_built_parameters import known_information
from asbuilt.identification.result.determination import (
    LIMITS,
    Advice,
    best_motions,
    error_ratios,
    sample_information,
    weak_parameters,
)
from asbuilt.identification.result.result import IdentificationResult
from asbuilt.scaled import Scaled
from asbuilt.tables import format_plus_minus

MOTIONS = 2
NAMES = 4
"""Motions that are advised, and parameters that are named of each."""
NEARLY = 0.9
"""Part of the parameters that the best motion helps for which a gentler one is advised: own choice,
since more parameters than that are lost if a hop fails."""


FOOT_SAMPLES = 1500
"""Samples of a recording that are looked at."""
FOOT_BLOCKS = 12
"""Parts of a recording by whose scatter the moments have errors."""
SURE = 4.0
"""Standard errors from which a moment is named: the model's own error is no noise."""
SLOWEST = 0.02
"""Rate of turning [rad/s] below which a foot sticks, and its moment has no direction."""


@use_one_blas_thread()
def with_leg_findings(
    findings: Iterable[Finding], result: IdentificationResult, samples: Sequence[Samples]
) -> tuple[Finding, ...]:
    """Return findings on a robot whose base moves, in its words and with what it alone has.

    No motion is designed for it, so that no cure names one.
    """
    own = (replace(each, cure=each.cure and undesigned(each.cure)) for each in findings)
    if result.model.n_floating != 6:
        return tuple(own)
    return (*own, *_advise_motion(result, samples), *_report_foot_moments(result, samples))


def _advise_motion(result: IdentificationResult, samples: Sequence[Samples]) -> Iterator[Finding]:
    """Say which motion of legs would determine what the samples of a result leave open.

    Squats, sways, turns, lifted legs and hops about the posture of the robot are compared by the
    information that 20 s of each add.
    """
    advice, weak = leg_advice(result, samples)
    if not advice:
        return
    parts = [
        f"of {each.motion} {'would at least halve' if k == 0 else ''} the errors of"
        f" {len(each.names)} ({join_names(each.names, NAMES)})".replace("  ", " ")
        for k, each in enumerate(advice)
    ]
    yield Finding(
        "weak_excitation",
        "warning",
        f"This motion leaves {weak} of {result.n_base} parameters with errors above"
        f" {100 * LIMITS.well:g} %; {LIMITS.seconds:g} s {', and '.join(parts)}",
        Cure("record that too, and identify from all logs together"),
    )


def leg_advice(
    result: IdentificationResult, samples: Sequence[Samples]
) -> tuple[tuple[Advice, ...], int]:
    """Return the motions that help most, and how many parameters are weak."""
    weak = weak_parameters(result)
    if not weak.size:
        return (), 0
    motions = list(leg_motions(result.model, standing_posture(samples)))
    logged = samples[0].reactions
    extras = (
        motion.share
        * sample_information(
            result,
            motion.q,
            motion.qd,
            motion.qdd,
            replace(logged, contact=motion.closed.astype(np.float64)) if logged else logged,
        )
        for motion in motions
    )
    table = error_ratios(result, known_information(result), weak, extras)
    return best_motions(
        result, weak, table, [motion.name for motion in motions], [slice(None)] * MOTIONS, NEARLY
    ), weak.size


def standing_posture(samples: Sequence[Samples]) -> Array:
    """Return the median position (n,) of samples where most contacts are closed."""
    q = np.concatenate([sample.q for sample in samples])
    touched = [sample.contact for sample in samples if sample.contact is not None]
    if len(touched) < len(samples):
        return np.asarray(np.median(q, axis=0))
    closed = np.concatenate([np.sum(each > 0.0, axis=1) for each in touched])
    posture = np.median(q[closed == closed.max()], axis=0)
    if closed.max() == 0:
        posture[4:6] = 0.0  # it falls, and stands upright before it does
    return np.asarray(posture)


def _report_foot_moments(
    result: IdentificationResult, samples: Sequence[Samples]
) -> Iterator[Finding]:
    """Name friction that brakes the turning and rolling of feet.

    A foot that is pressed down by f and turns at w has the moment `-l f sign(w)` about the normal,
    and the same about the ground's axes as it rolls, each with a length l. Both are fitted with all
    base parameters to what forces at the feet leave, with errors by the scatter of time blocks.
    """
    model = result.model
    used = [batch for batch in samples if batch.contact is not None]
    if not used or any(contact.flat for contact in model.contacts):
        return
    n_base = result.n_base
    blocks: list[Array] = []
    for batch in used:
        rows = _build_moment_rows(result, model, batch)
        blocks += [part.T @ part for part in np.array_split(rows, FOOT_BLOCKS)]
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


def _build_moment_rows(result: IdentificationResult, model: RobotModel, batch: Samples) -> Array:
    """Return rows of base parameters, both moments per length, and torque, without forces."""
    every = slice(None, None, -(-batch.n_samples // FOOT_SAMPLES))
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
