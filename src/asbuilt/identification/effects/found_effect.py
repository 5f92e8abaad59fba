"""An effect that a search found, with what it explains."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class FoundEffect:
    """Hold an effect that the description lacks and the recordings show.

    Parameters
    ----------
    effect, joint
        Key of the effect, and the joint it acts at; None: the whole robot.
    estimate, std_error, unit
        Its size; of several parameters the length of their vector.
    in_model
        Whether the model of the result has it.
    torque
        RMS torque that it adds at its joint, of all joints together without one [N m or N].
    error_before, error_after
        Relative torque error on held-out groups of different motion, without and with it.
    alternatives
        Other effects that explain the recordings as well: such as `spring at elbow`.
    text
        A sentence.
    """

    effect: str
    joint: str | None
    estimate: float
    std_error: float
    unit: str
    in_model: bool
    torque: float
    error_before: float
    error_after: float
    alternatives: tuple[str, ...]
    text: str


def tilts(effects: Sequence[FoundEffect]) -> bool:
    """Return whether a base tilt is in the model."""
    return any(each.effect == "tilt" and each.in_model for each in effects)
