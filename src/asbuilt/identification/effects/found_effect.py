"""An effect that a search found, with what it explains."""

from __future__ import annotations

from dataclasses import dataclass

from asbuilt.tables import round_significant


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

    @property
    def improvement(self) -> str:
        """The torque error without and with it, as text."""
        return describe_improvement(self.error_before, self.error_after)


def describe_found_effect(
    title: str, joint: str | None, size: str, before: float, after: float
) -> str:
    """Return the sentence on an effect of a size, with the torque errors without and with it."""
    where = f"{title} at {joint}" if joint else title
    return f"{where} {size}: {describe_improvement(before, after)}"


def describe_improvement(before: float, after: float) -> str:
    """Return relative torque errors without and with an effect as text."""
    return (
        f"torque error {round_significant(100 * before, 2)} ->"
        f" {round_significant(100 * after, 2)} %"
    )
