"""What a robot on legs adds to findings: the motion that it lacks."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from asbuilt.arrays import Array
from asbuilt.dynamics.kernels.blas import use_one_blas_thread
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
