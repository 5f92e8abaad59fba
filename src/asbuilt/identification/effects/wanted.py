"""Which effects a user wants in the model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, cast

from asbuilt.dynamics.drives.selection import NO_DRIVE, DriveSet
from asbuilt.errors import UsageError

TILT = "tilt"
Choice = Literal["auto", "find", "none", "list"]


@dataclass(frozen=True, slots=True)
class EffectsWanted:
    """Say which effects become part of the model.

    Parameters
    ----------
    choice
        Those that the recordings show ("auto"), none but these are named ("find"), none ("none"),
        or those of a list ("list").
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
        return cls("list", DriveSet.parse(terms) if terms else DriveSet(), TILT in parts)

    def __str__(self) -> str:
        if self.choice != "list":
            return self.choice
        return ",".join((*self.drive.specifications, *([TILT] if self.tilt else [])))
