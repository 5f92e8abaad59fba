"""Formats in which simulators take drives and their control, and their registry."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import ClassVar

from asbuilt.description.model import Joint, RobotModel
from asbuilt.identification.result.result import IdentificationResult
from asbuilt.identification.result.torque_prediction import set_link_parameters
from asbuilt.registry import Registry
from asbuilt.writers.models.c.c_code import CCode, generate_c_code
from asbuilt.writers.models.control import NO_GAINS, find_command_delay, note_left_out_control
from asbuilt.writers.models.physical import (
    convert_to_plain_friction,
    note_left_out_drives,
)
from asbuilt.writing import atomic_write


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
    def delay(self) -> float:
        """Delay of commands [s], not below zero; `left_out` says so."""
        return find_command_delay(self.result)

    @property
    def has_gains(self) -> bool:
        """Whether any joint has gains of position control."""
        return any(joint.drive.kp is not None for joint in self.model.joints)

    @property
    def origin(self) -> str:
        """Where the numbers come from, in one line of plain characters."""
        text = f"{self.result.robot}, identified from {', '.join(self.result.sources)}"
        # Into comments of any language: no escapes, quotes or line breaks.
        return " ".join(re.sub(r"[^ -~]", "?", text).replace("\\", "/").replace('"', "'").split())

    def by_joint(self, value: Callable[[Joint], float | None]) -> dict[str, float]:
        """Return a value of every joint by name, zero where there is none."""
        # Of the plain robot, so that asymmetric friction is in its Coulomb friction and offset.
        return {joint.name: float(value(joint) or 0.0) for joint in self.plain.joints}

    def generate_exact_c(self, stem: str, prefix: str) -> CCode:
        """Return C code of exactly the identified parameters, whose torque is the result's.

        They need not be those of possible bodies. All names begin with `prefix`; the header is
        `stem`.h.
        """
        result = self.result
        torque = result.torque_model
        model = set_link_parameters(result.model, result.base, result.estimates)
        return generate_c_code(
            model, drive=torque.drive, drive_values=torque.values, stem=stem, prefix=prefix
        )

    def left_out(
        self,
        kind: str,
        *,
        carried: Collection[str] = (),
        delay: bool = False,
        gains: bool = True,
        falling: bool = False,
    ) -> tuple[str, ...]:
        """Return notes on what a format cannot hold, apart from `carried` terms and the options."""
        present = {key for joint in self.model.joints for key in joint.drive.terms}
        # Offsets of the model, without the share that plain friction adds: that share is told with
        # it.
        offsets = self.by_joint(lambda joint: joint.drive.offset)
        listed = ", ".join(f"{name} {offset:.4g}" for name, offset in offsets.items() if offset)
        cases = {
            f"{key.replace('_', ' ')} friction is written as Coulomb friction": key in present
            and key not in carried
            for key in ("asymmetric_coulomb", "smooth_coulomb")
        }
        lost = f"{kind} has no place for the offsets of the drives [N m or N]: {listed}"
        cases[lost] = bool(listed)
        return (
            *note_left_out_drives(self.plain, carried, kind),
            *(note for note, holds in cases.items() if holds),
            *note_left_out_control(self.result, kind, delay=delay, falling=falling),
            *([NO_GAINS] if gains and not self.has_gains else []),
        )


class SimulatorFormat(ABC):
    """A format for drives and control; a subclass registers an instance in `SIMULATOR_FORMATS`."""

    key: ClassVar[str]
    title: ClassVar[str]
    exact: ClassVar[bool] = False
    """Whether it holds the identified parameters themselves, which need no possible bodies."""

    @abstractmethod
    def document(self, drives: ExportedDrives, path: Path) -> tuple[str, tuple[str, ...]]:
        """Return the text of the file, and notes on what it cannot hold."""

    def write(self, drives: ExportedDrives, path: Path) -> tuple[Path, tuple[str, ...]]:
        """Write the file, or a folder of several; return it and its notes."""
        text, notes = self.document(drives, path)
        return atomic_write(path, text), notes


SIMULATOR_FORMATS: Registry[SimulatorFormat] = Registry(
    "simulator format", None, "asbuilt.simulator_formats"
)
"""Simulator formats by key."""
