"""Formats in which simulators take drives and servos, and their registry."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import ClassVar

from asbuilt.description.model import Joint, RobotModel
from asbuilt.dynamics.drives.position_servo import PositionServo
from asbuilt.identification.result.result import IdentificationResult
from asbuilt.registry import Registry
from asbuilt.writers.models.physical import (
    convert_to_plain_friction,
    note_left_out_drives,
    note_left_out_servo,
)


@dataclass(frozen=True, eq=False)
class ExportedDrives:
    """Hold the robot as built, with the drive terms for simulators, and its result."""

    model: RobotModel
    result: IdentificationResult

    @cached_property
    def plain(self) -> RobotModel:
        """The robot with plain Coulomb friction in place of asymmetric and smooth friction."""
        return convert_to_plain_friction(self.model)

    @property
    def servo(self) -> PositionServo | None:
        """The identified servo."""
        return self.result.servo

    @property
    def delay(self) -> float:
        """Delay of the servo [s], zero where it is below: no simulator has commands early."""
        return 0.0 if self.servo is None else max(self.servo.delay or 0.0, 0.0)

    @property
    def has_gains(self) -> bool:
        """Whether any joint has a position servo."""
        return any(joint.drive.kp is not None for joint in self.model.joints)

    @property
    def origin(self) -> str:
        """Where the numbers come from, in one line of plain characters."""
        text = f"{self.result.robot}, identified from {', '.join(self.result.sources)}"
        return " ".join(re.sub(r"[^ -~]", "?", text).replace("\\", "/").replace('"', "'").split())

    def by_joint(self, value: Callable[[Joint], float | None]) -> dict[str, float]:
        """Return a value of every joint by name, zero where there is none."""
        return {joint.name: float(value(joint) or 0.0) for joint in self.plain.joints}

    def left_out(
        self,
        kind: str,
        *,
        carried: Collection[str] = (),
        offset: bool = False,
        delay: bool = False,
        gains: bool = True,
        falling: bool = False,
    ) -> tuple[str, ...]:
        """Return notes on what a format cannot hold, apart from `carried` terms and the options."""
        notes = list(note_left_out_drives(self.plain, carried, kind))
        for key in ("asymmetric_coulomb", "smooth_coulomb"):
            if key not in carried and any(key in joint.drive.terms for joint in self.model.joints):
                notes.append(f"{key.replace('_', ' ')} friction is written as Coulomb friction")
        offsets = self.by_joint(lambda joint: joint.drive.offset)
        if not offset and any(offsets.values()):
            listed = ", ".join(f"{name} {each:.4g}" for name, each in offsets.items() if each)
            notes.append(f"{kind} has no place for the offsets of the drives [N m or N]: {listed}")
        notes += note_left_out_servo(self.servo, kind, delay=delay, falling=falling)
        if gains and not self.has_gains:
            notes.append(
                "no position servo was identified: gains are zero, and commands are torques"
            )
        return tuple(notes)


class SimulatorFormat(ABC):
    """A format for drives and servos; a subclass registers an instance in `SIMULATOR_FORMATS`."""

    key: ClassVar[str]
    title: ClassVar[str]

    @abstractmethod
    def document(self, drives: ExportedDrives, path: Path) -> tuple[str, tuple[str, ...]]:
        """Return the text of the file, and notes on what it cannot hold."""


SIMULATOR_FORMATS: Registry[SimulatorFormat] = Registry(
    "simulator format", "asbuilt.writers.models.simulators.formats", "asbuilt.simulator_formats"
)
"""Simulator formats by key."""


def find_simulator_format(key: str) -> SimulatorFormat:
    """Return the format of this name; raises `UsageError` if there is none."""
    return SIMULATOR_FORMATS.find(key)
