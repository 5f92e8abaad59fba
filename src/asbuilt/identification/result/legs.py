"""What a robot on legs adds to a result: the motion that it lacks, and moments under its feet."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import BaseParameters
from asbuilt.dynamics.kernels.blas import use_one_blas_thread
from asbuilt.dynamics.reactions import contact_jacobians
from asbuilt.dynamics.regressor import observation_matrix
from asbuilt.excitation.motions.on_legs import leg_motions
from asbuilt.experiment.signal.samples import Samples
from asbuilt.findings import Cure, Finding, join_names, undesigned
from asbuilt.identification.estimators.least_squares import fit_least_squares
from asbuilt.identification.information.estimate import Estimate
from asbuilt.identification.information.square_root_information import SquareRootInformation
from asbuilt.identification.result.as_built_parameters import known_information
from asbuilt.identification.result.determination import (
    FURTHER_SECONDS,
    WELL,
    best_motions,
    error_ratios,
    sample_information,
    weak_parameters,
)
from asbuilt.identification.result.result import IdentificationResult
from asbuilt.identification.uncertainty.bias import OmittedBias, derive_estimate_moves
from asbuilt.scaled import Scaled
from asbuilt.tables import format_plus_minus

MOTIONS = 2
NAMES = 4
"""Motions that are advised, and parameters that are named of each."""
NEARLY = 0.9
"""Part of the parameters that the best motion helps for which a gentler one is advised: own choice,
since more parameters than that are lost if a hop fails."""


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
    return (*own, *_advise_motion(result, samples))


def _advise_motion(result: IdentificationResult, samples: Sequence[Samples]) -> Iterator[Finding]:
    """Say which motion of legs would determine what the samples of a result leave open.

    Squats, sways, turns, lifted legs and hops about the posture of the robot are compared by the
    information that 20 s of each add.
    """
    weak = weak_parameters(result)
    if not weak.size:
        return
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
    names = [motion.name for motion in motions]
    advice = best_motions(result, weak, table, names, [slice(None)] * MOTIONS, NEARLY)
    if not advice:
        return
    parts = [
        f"of {tip.motion} {'would at least halve ' if k == 0 else ''}the errors of"
        f" {len(tip.names)} ({join_names(tip.names, NAMES)})"
        for k, tip in enumerate(advice)
    ]
    yield Finding(
        "weak_excitation",
        "warning",
        f"This motion leaves {weak.size} of {result.n_base} parameters with errors above"
        f" {100 * WELL:g} %; {FURTHER_SECONDS:g} s {', and '.join(parts)}",
        Cure("record that too, and identify from all logs together"),
    )


def standing_posture(samples: Sequence[Samples]) -> Array:
    """Return the median position (n,) of samples where most contacts are closed."""
    q = np.concatenate([sample.q for sample in samples])
    touched = [
        sample.reactions.contact for sample in samples if sample.reactions.contact is not None
    ]
    if len(touched) < len(samples):
        return np.asarray(np.median(q, axis=0))
    closed = np.concatenate([np.sum(each > 0.0, axis=1) for each in touched])
    posture = np.median(q[closed == closed.max()], axis=0)
    if closed.max() == 0:
        posture[4:6] = 0.0  # it falls, and stands upright before it does
    return np.asarray(posture)


KINDS = ("torsional", "rolling")
SAMPLES = 1500
"""Samples of a recording that are looked at."""
BLOCKS = 12
"""Parts of a recording by whose scatter the moments have errors."""
SURE = 4.0
"""Standard errors from which a moment is named: the model's own error is no noise."""
SLOWEST = 0.1
"""Rate of turning [rad/s] below which a foot sticks, and its moment has no direction."""
PASSES = 6
"""Passes of the weights of samples: in some a foot slides, and forces say little."""


@dataclass(frozen=True, slots=True, eq=False)
class FootMoments:
    """Hold the friction of feet that turn, and by how much it moves the base parameters.

    A foot that is pressed down by f and turns at w has the moment `-l f sign(w)` about the normal,
    and the same about the ground's axes as it rolls, each with a length l [m].

    Parameters
    ----------
    lengths, errors
        Torsional and rolling length, and standard errors (2,); those of no account are zero.
    bias
        Of weighted least squares without moments (p,).
    """

    lengths: Array
    errors: Array
    bias: Array

    @property
    def sizes(self) -> str:
        """The lengths as text."""
        parts = [
            f"{kind} {format_plus_minus(1e3 * length, 1e3 * error)} mm"
            for kind, length, error in zip(KINDS, self.lengths, self.errors, strict=True)
            if length > 0.0
        ]
        return " and ".join(parts)

    @property
    def finding(self) -> Finding:
        """What is said of them."""
        return Finding(
            "foot_moments",
            "warning",
            "Feet have moments that brake their turning, which forces at a point do not have:"
            f" friction per force, {self.sizes}; errors of parameters include what they do to them",
            Cure("log forces and moments at the feet, or use motions on which feet do not turn"),
        )

    def omitted(self, information: SquareRootInformation, estimate: Estimate) -> OmittedBias:
        """Return the bias of an estimate that has no such moments."""
        own = derive_estimate_moves(information, estimate) @ self.bias
        return OmittedBias(
            bias=own,
            covariance=np.outer(own, own),
            free_bias=self.bias,
            free_covariance=np.outer(self.bias, self.bias),
            effects=f"moments under the feet, {self.sizes}",
        )


@use_one_blas_thread()
def find_foot_moments(
    model: RobotModel,
    information: SquareRootInformation,
    estimate: Estimate,
    samples: Sequence[Samples],
) -> FootMoments | None:
    """Return the friction of feet that turn; None if there is no sure one.

    Lengths are fitted with all base parameters to what forces at the feet leave, with errors by the
    scatter of time blocks. Samples weigh `1 / (1 + r / median(r))` with their squared residual r.
    """
    used = [batch for batch in samples if batch.reactions]
    if model.n_floating != 6 or not used or any(contact.flat for contact in model.contacts):
        return None
    base = information.base
    p = base.n_base
    plain = fit_least_squares(information, weights="joint", prior=estimate.beta).beta
    noise = np.maximum(estimate.sigma, np.finfo(np.float64).tiny)
    blocks = [
        block
        for batch in used
        for block in np.array_split(_build_rows(model, base, plain, noise, batch), BLOCKS)
    ]
    moves, errors = _fit_robustly(blocks)
    if moves is None or errors is None:
        return None
    sure = moves[p:] > SURE * errors
    if not sure.any():
        return None
    return FootMoments(np.where(sure, moves[p:], 0.0), errors, -moves[:p])


def _fit_robustly(blocks: Sequence[Array]) -> tuple[Array | None, Array | None]:
    """Return how parameters and lengths move (p + 2,) to fit rows, and errors of the lengths (2,).

    `blocks` are samples by joints by columns, the last of which is to be explained. None if rows
    have no sign of a moment.
    """
    rows = np.concatenate(blocks)
    size = rows.shape[2]
    numbers = np.repeat(np.arange(len(blocks)), [len(block) for block in blocks])
    weight = np.ones(len(rows))
    for _ in range(PASSES):
        weighted = (rows * np.sqrt(weight)[:, None, None]).reshape(-1, size)
        gram = weighted.T @ weighted
        normal = Scaled(gram[:-1, :-1])
        moves = normal.solve(gram[:-1, -1])
        left = rows[:, :, -1] - rows[:, :, :-1] @ moves
        squares = np.sum(left**2, axis=1)
        weight = 1.0 / (1.0 + squares / max(float(np.median(squares)), np.finfo(np.float64).tiny))
    if not normal.determined[-len(KINDS) :].any():
        return None, None
    by_sample = np.einsum("sjc,sj,s->sc", rows[:, :, :-1], left, weight)
    scores = np.array([by_sample[numbers == b].sum(axis=0) for b in range(len(blocks))])
    spread = normal.solve(scores.T)[-len(KINDS) :]
    errors = np.sqrt(np.sum(spread**2, axis=1) * len(blocks) / (len(blocks) - 1))
    return np.asarray(moves), np.asarray(errors)


def _build_rows(
    model: RobotModel, base: BaseParameters, beta: Array, noise: Array, batch: Samples
) -> Array:
    """Return columns of base parameters and of both lengths, and what beta leaves, (N, n, p + 3).

    In units of the noise (n,), and without what forces at the feet can explain.
    """
    every = slice(None, None, -(-batch.n_samples // SAMPLES))
    q, qd, qdd, tau = (x[every] for x in (batch.q, batch.qd, batch.qdd, batch.tau))
    contact = batch.reactions.contact
    assert contact is not None
    closed = contact[every] > 0.0
    n = model.n_joints
    W = observation_matrix(model, q, qd, qdd, drive=base.drive, columns=base.columns)
    W = W.reshape(len(q), n, -1)
    left = tau - W @ beta
    as_soles = tuple(replace(contact, flat=True) for contact in model.contacts)
    J = np.stack(contact_jacobians(replace(model, contacts=as_soles), q), axis=1)
    J = J * closed[:, :, None, None]
    # Forces at the points, three each, follow from the equations; what they leave has none.
    across = J[:, :, :3].reshape(len(q), -1, n)
    back = np.linalg.pinv(across)
    force = np.einsum("snm,sn->sm", back, -left).reshape(len(q), -1, 3)
    turning = np.einsum("sckj,sj->sck", J[:, :, 3:], qd)
    pressed = np.maximum(force[:, :, 2], 0.0)
    spin = turning[:, :, 2] / np.maximum(np.abs(turning[:, :, 2]), SLOWEST)
    level = turning[:, :, :2]
    roll = level / np.maximum(np.linalg.norm(level, axis=2, keepdims=True), SLOWEST)
    # Of the joints, which the motors give in addition: the opposite of what the ground does.
    torsional = np.einsum("sc,scj->sj", pressed * spin, J[:, :, 5])
    rolling = np.einsum("sck,sckj->sj", pressed[:, :, None] * roll, J[:, :, 3:5])
    whole = np.concatenate([W, np.stack([torsional, rolling, left], axis=2)], axis=2)
    whole -= np.einsum("smj,snm,snc->sjc", across, back, whole, optimize=True)
    return whole / noise[:, None]
