"""Checks whether a recording excites the base parameters."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import find_base_parameters
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.dynamics.regressor import observation_matrix
from asbuilt.experiment.quality.first_pass import FirstPass
from asbuilt.experiment.quality.smoothed_motion import SmoothedMotion
from asbuilt.findings import Cure, Finding, joined

_WEAK_CONDITION = 100.0
"""Scaled condition number from which a motion excites poorly; designed motions have 10 to 50."""
_RANK_TOLERANCE = 1e-7
"""Singular value or column norm, relative to the largest, below which it counts as zero."""


def excitation_findings(
    model: RobotModel, recording: FirstPass, motion: SmoothedMotion | None
) -> Iterator[Finding]:
    """Find recordings with too few samples, rank deficiency, or a large scaled condition number.

    The observation matrix is that of the base parameters with viscous, Coulomb and offset terms,
    its columns scaled to unit length.
    """
    base = find_base_parameters(model, DriveSet.parse("viscous,coulomb,offset"))
    if recording.n_samples < base.n_base:
        yield Finding(
            "too_few_samples",
            "error",
            f"{recording.n_samples} samples are fewer than the {base.n_base} parameters to identify"
            " (base parameters, viscous, Coulomb and offset terms)",
            Cure(f"record at least some thousand samples of {model.name} in motion"),
        )
        return
    if motion is None:
        yield Finding(
            "too_short",
            "error",
            "no segment of the recording is long enough to differentiate:"
            f" {recording.n_samples} samples in {recording.duration:.3g} s",
            Cure("record at least ten seconds without gaps"),
        )
        return
    # Number of samples used; more do not change the condition number noticeably.
    rows = motion.thinned(800)
    states = (motion.q[rows], motion.qd[rows], motion.qdd[rows])
    observed = observation_matrix(model, *states, drive=base.drive, columns=base.columns)
    lengths = np.linalg.norm(observed, axis=0)
    zero = lengths <= _RANK_TOLERANCE * np.max(lengths)
    triangle = np.linalg.qr(observed / np.where(zero, 1.0, lengths), mode="r")
    _, values, directions = np.linalg.svd(triangle, full_matrices=False)
    rank = int(np.sum(values > _RANK_TOLERANCE * values[0]))
    worst = joined([base.names[k] for k in np.argsort(-np.abs(directions[-1]))[:4]])
    if rank < base.n_base:
        yield Finding(
            "rank_deficient",
            "warning",
            f"this motion determines {rank} of {base.n_base} parameters; the least excited are"
            f" {worst}",
            Cure(
                "move every joint independently, or choose fewer drive terms; undetermined"
                " parameters keep their CAD values",
                call="design_motion",
            ),
        )
    elif values[0] / values[-1] > _WEAK_CONDITION:
        yield Finding(
            "weak_excitation",
            "warning",
            f"the scaled condition number is {values[0] / values[-1]:.3g} (good motions have 10 to"
            f" 50) over {recording.duration:.3g} s; least excited are {worst}",
            Cure(
                "add recordings or design a motion, and validate on another recording",
                call="design_motion",
            ),
        )
