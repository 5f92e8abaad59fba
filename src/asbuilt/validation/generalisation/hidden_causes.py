"""What acts on a robot that its description lacks and real bodies cannot imitate.

A mounting that is askew, springs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from asbuilt.description.model import RobotModel
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.dynamics.drives.terms.spring import Spring
from asbuilt.errors import IdentifiabilityError, UsageError
from asbuilt.experiment.quality.running_statistics import IN_STEP, PositionMoments
from asbuilt.experiment.signal.samples import Samples
from asbuilt.identification.calibration.mounting import Mounting, find_mounting
from asbuilt.identification.drives.spring_search import suspected_springs
from asbuilt.identification.result.result import IdentificationResult, IdentificationWarning

ASKEW = np.deg2rad(0.5)
"""Tilt of the mounting [rad] from which it is said so."""
RELIEF = 0.02
"""Part of the torque residual that a tilt found has to take away to be spoken of."""
BADLY_FITTING = ("consistent_fit_costly", "consistent_fit_rejected")
"""Warnings of an automatic choice where something acts that real bodies cannot follow,"""
SEARCHED = 30_000
"""for which, up to so many samples, it is looked whether the robot stands askew, and for springs."""


def with_hidden_causes(
    result: IdentificationResult,
    learning: Sequence[Samples],
    drive: DriveSet,
    *,
    tilt: float | None = None,
    stands: Mounting | None = None,
    block_seconds: float | None = None,
) -> IdentificationResult:
    """Return the result with warnings of what seems to act unseen.

    `tilt` [rad] is by how much nested models would turn gravity, None where that was not asked;
    `stands` how the robot was found to stand, where it was. Where real bodies fit badly, mounting
    and springs are looked for in the samples it was learnt from, unless these are long.
    """
    searched = (
        any(warning.code in BADLY_FITTING for warning in result.warnings)
        and sum(len(samples.t) for samples in learning) <= SEARCHED
    )
    if tilt is not None:
        stands = _mounting(result, learning, drive, block_seconds) if searched else None
        result = _mounting_doubted(result, tilt, stands)
    return (
        _springs_suspected(result, stands, learning, drive, block_seconds) if searched else result
    )


def _mounting(
    result: IdentificationResult,
    learning: Sequence[Samples],
    drive: DriveSet,
    block_seconds: float | None,
) -> Mounting | None:
    """Find how the robot stands.

    None where the samples do not tell, or there is no gravity to point anywhere.
    """
    try:
        return find_mounting(result.model, learning, drive=drive, block_seconds=block_seconds)
    except (IdentifiabilityError, UsageError):
        return None


def _mounting_doubted(
    result: IdentificationResult, tilt: float, stands: Mounting | None
) -> IdentificationResult:
    if stands is not None and stands.is_tilted and stands.relief > RELIEF:
        message = (
            f"The robot seems to stand askew by {np.rad2deg(stands.angle):.1f} deg, which values"
            f" that no bodies have imitate and real bodies cannot follow: {stands.sentence}. Check"
            " the mounting or identify with --mounting estimate."
        )
    elif tilt >= ASKEW:
        message = (
            f"The robot seems to stand askew by {np.rad2deg(tilt):.1f} deg, which its description"
            " does not know and links then have to imitate. Check the mounting or identify with"
            " --mounting estimate."
        )
    else:
        return result
    return replace(
        result, warnings=(*result.warnings, IdentificationWarning("mounting_askew", message))
    )


def _springs_suspected(
    result: IdentificationResult,
    stands: Mounting | None,
    learning: Sequence[Samples],
    drive: DriveSet,
    block_seconds: float | None,
) -> IdentificationResult:
    """Say where springs that no file describes would explain what real bodies cannot follow, on a
    robot that stands as it was found to.
    """
    askew = stands is not None and stands.is_tilted
    model = stands.model if stands is not None and askew else result.model
    springs = suspected_springs(model, learning, drive, block_seconds=block_seconds)
    if not springs:
        return result
    described = [
        number for term in drive.terms if term.key == Spring.key for number in term.joints or ()
    ]
    joints = "/".join(map(str, sorted([*described, *(spring.joint + 1 for spring in springs)])))
    terms = ",".join((*drive.without(Spring.key).specifications, f"{Spring.key}:joints={joints}"))
    message = (
        f"A spring would explain what real bodies cannot follow at {', '.join(map(str, springs))}:"
        " cables or hoses that wind up there, or a sensor that drifts with position."
        f" {_in_step(model, learning, [spring.joint for spring in springs])}Where that can be,"
        f" identify with {'--mounting estimate ' if askew else ''}--drive {terms}."
    )
    return replace(
        result, warnings=(*result.warnings, IdentificationWarning("spring_suspected", message))
    )


def _in_step(model: RobotModel, learning: Sequence[Samples], suspects: Sequence[int]) -> str:
    """Say which joints move in step with those of springs, so that what looks like a spring may go
    with any of them; empty where none does.
    """
    likeness = PositionMoments.none(model.n_joints)
    for samples in learning:
        likeness = likeness.with_more(samples.q)
    moving = likeness.moving
    alike = np.abs(likeness.correlations(moving)) > IN_STEP
    told = []
    for k in (joint for joint in suspects if joint in moving):
        others = [
            model.joint_names[j]
            for j, same in zip(moving, alike[moving.index(k)], strict=True)
            if same and j != k
        ]
        if others:
            told.append(f"{model.joint_names[k]} moves in step with {', '.join(others)}")
    return (
        f"In this motion {'; '.join(told)}: what looks like a spring may go with any of these,"
        " which only another motion can tell. "
        if told
        else ""
    )
