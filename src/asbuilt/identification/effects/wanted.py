"""Which effects a user wants in the model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, cast

from asbuilt.dynamics.drives.drive_set import NO_DRIVE, DriveSet, available_terms
from asbuilt.errors import UsageError

TILT = "tilt"
Choice = Literal["auto", "find", "none", "list"]


@dataclass(frozen=True, slots=True)
class EffectsWanted:
    """Say which effects become part of the model.

    Parameters
    ----------
    choice
        All that the recordings show ("auto"), none but these are named ("find"), none ("none"), or
        what is listed ("list").
    drive
        Drive terms of a list.
    tilt
        Whether a list has the base tilt.
    """

    choice: Choice = "auto"
    drive: DriveSet = NO_DRIVE
    tilt: bool = False

    @property
    def named(self) -> bool:
        """Whether what the recordings show is named."""
        return self.choice != "none"

    @classmethod
    def parse(cls, text: str) -> EffectsWanted:
        """Read "auto", "find", "none" or a list of effects, with joints where they have some.

        >>> EffectsWanted.parse("spring:joints=2,tilt")
        EffectsWanted(choice='list', drive=..., tilt=True)

        Raises
        ------
        UsageError
            For effects that a model cannot have.
        """
        word = text.strip().lower()
        if word in ("auto", "find", "none"):
            return cls(cast(Choice, word))
        parts = [part.strip() for part in word.split(",") if part.strip()]
        terms = [part for part in parts if part != TILT]
        if not parts or "none" in parts or "find" in parts or "auto" in parts:
            raise UsageError(
                f"effects {text!r} are neither auto, find or none nor a list of effects, such as"
                " spring:joints=2,tilt",
                value=text,
            )
        for part in terms:
            _refuse_without_place(part.partition(":")[0])
        return cls("list", DriveSet.parse(terms) if terms else DriveSet(), TILT in parts)

    def __str__(self) -> str:
        listed = (*self.drive.specifications, *([TILT] if self.tilt else []))
        return ",".join(listed) if self.choice == "list" else self.choice


def _refuse_without_place(key: str) -> None:
    """Refuse an effect that no list can put into a model, with where it belongs."""
    if key in available_terms():
        return
    from asbuilt.identification.effects.effect import EFFECTS  # noqa: PLC0415 - light start

    effect = EFFECTS.get(key)
    if effect is None:
        return
    if key == TILT:
        why = "is one of the whole robot, and takes no joints"
    elif effect.of_log:
        why = "is an error of the log, which no model has; correct it in a recording sheet"
    elif effect.in_model:
        why = "is part of the bodies, which every model has; it is named where CAD lacks it"
    else:
        why = "has no place in a model; it is named where recordings show it"
    raise UsageError(f"effect {key!r} ({effect.title}) {why}", value=key)
