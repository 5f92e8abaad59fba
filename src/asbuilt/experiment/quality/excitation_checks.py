"""Whether a recording can tell the parameters at all."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import find_base_parameters
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.dynamics.regressor import observation_matrix
from asbuilt.experiment.quality.first_pass import Survey
from asbuilt.experiment.quality.smoothed_motion import SmoothedMotion
from asbuilt.findings import Finding, joined

_WEAK_CONDITION = 100.0
"""Scaled condition number from which a motion excites poorly; designed ones have 10 to 50."""
_RANK_TOLERANCE = 1e-7
"""Singular value, or length of a column, in parts of the largest, below which it counts as zero."""
_MOST_SAMPLES = 800
"""Samples that are enough for it."""


def excitation_findings(
    model: RobotModel, recording: Survey, motion: SmoothedMotion | None
) -> Iterator[Finding]:
    """Compare samples with parameters, and look at the scaled condition number of the observation
    matrix on this motion.

    Base parameters with viscous, Coulomb and offset terms; columns are scaled to unit length before
    their singular values are taken.
    """
    base = find_base_parameters(model, DriveSet.parse("viscous,coulomb,offset"))
    if recording.n_samples < base.n_base:
        yield Finding(
            "too_few_samples",
            "error",
            f"{recording.n_samples} samples are fewer than the {base.n_base} parameters to find"
            " (base parameters, viscous, Coulomb and offset terms)",
            f"Record at least some thousand samples of {model.name} in motion",
        )
        return
    if motion is None:
        yield Finding(
            "too_short",
            "error",
            f"no stretch of the recording is long enough to differentiate: {recording.n_samples}"
            f" samples in {recording.duration:.3g} s",
            "Record at least ten seconds without gaps",
        )
        return
    rows = motion.thinned(_MOST_SAMPLES)
    observed = observation_matrix(
        model,
        motion.q[rows],
        motion.qd[rows],
        motion.qdd[rows],
        drive=base.drive,
        columns=base.columns,
    )
    lengths = np.linalg.norm(observed, axis=0)
    dead = lengths <= _RANK_TOLERANCE * np.max(lengths)
    _, values, directions = np.linalg.svd(
        observed / np.where(dead, 1.0, lengths), full_matrices=False
    )
    rank = int(np.sum(values > _RANK_TOLERANCE * values[0]))
    order = np.argsort(-np.abs(directions[-1]))
    involved = joined([base.names[k] for k in order[:4]])
    if rank < base.n_base:
        yield Finding(
            "rank_deficient",
            "warning",
            f"this motion tells {rank} of {base.n_base} parameters; the least told are {involved}",
            "Move every joint on its own course (asbuilt excite), or choose fewer drive terms"
            " (--drive); what is not told stays at CAD",
        )
    elif values[0] / values[-1] > _WEAK_CONDITION:
        yield Finding(
            "weak_excitation",
            "warning",
            "this motion excites the robot poorly: the scaled condition number is"
            f" {values[0] / values[-1]:.3g} (good motions have 10 to 50), {recording.duration:.3g}"
            f" s long; hardest to tell apart are {involved}",
            "An identification from it alone may not hold on other motions; validate on another"
            " recording, add recordings, or design a motion (asbuilt excite)",
        )
