"""The root of a robot with a free base: its coordinates are read and checked with the joints."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.description.structure.free_base import AXES
from asbuilt.experiment.free_base.base_checks import check_free_base, drop_base_joints
from asbuilt.experiment.free_base.columns import (
    add_base_coordinates,
    base_rotations,
    with_base_columns,
)
from asbuilt.experiment.free_base.feet import set_rolling_radii
from asbuilt.experiment.logs.formats.log_format import LogTable
from asbuilt.experiment.logs.sheet import RecordingSheet
from asbuilt.experiment.quality.torque_fit import COMPARED_TORQUES
from asbuilt.experiment.recording import Recording
from asbuilt.findings import Finding, undesigned

OF_HELD_BASE = (*COMPARED_TORQUES, "rank_deficient", "weak_excitation")
"""Codes of findings about a robot that is held: on legs contacts push it, and excite it."""


@dataclass(frozen=True)
class FloatingRoot:
    """Say that the base moves: a log has its pose or an inertial sensor, and maybe contacts."""

    model: RobotModel

    moves: ClassVar[bool] = True

    def complete(
        self,
        recording: Recording,
        table: LogTable,
        sheet: RecordingSheet,
        finish: Callable[[Recording], Recording],
    ) -> Recording:
        """Return a finished recording with the coordinates of the base before the joints."""
        recording, sensor = with_base_columns(recording, table, sheet, self.model)
        return add_base_coordinates(finish(recording), self.model, sensor)

    def settle(self, model: RobotModel, recordings: Sequence[Recording]) -> RobotModel:
        """Return the robot with the radii on which its feet roll."""
        return set_rolling_radii(model, recordings) if model.has_reactions else model

    def hold(self, recording: Recording) -> tuple[RobotModel, Recording]:
        """Return robot and recording with the base held."""
        return self.model.standing, drop_base_joints(self.model, recording)

    def add_findings(
        self, found: Sequence[Finding], recording: Recording, *, has_clock: bool
    ) -> tuple[Finding, ...]:
        """Return findings on the held robot, and those on base and contacts.

        What compares torques with the model's is left out, since contacts push the robot. Without
        a clock base and contacts are not checked.
        """
        # Cures name a motion designed for a held base, which one on legs cannot use.
        kept = (
            replace(finding, cure=finding.cure and undesigned(finding.cure))
            for finding in found
            if finding.code not in OF_HELD_BASE
        )
        return (*kept, *(check_free_base(self.model, recording) if has_clock else ()))

    def measure_errors(
        self, measured: Sequence[Array], simulated: Sequence[Array]
    ) -> tuple[float, float] | None:
        """Return the root mean square of distances [m] and tilts [rad] between the bases."""
        if self.model.n_floating != len(AXES):
            return None
        q = [
            np.concatenate([x[:, 1:].reshape(-1, x.shape[2]) for x in y])
            for y in (measured, simulated)
        ]
        places, verticals = (
            np.linalg.norm(np.subtract(*pair), axis=1)
            for pair in ([x[:, :3] for x in q], [base_rotations(x)[:, 2] for x in q])
        )
        # Chord between unit vectors: 2 arcsin of its half is the angle.
        tilts = 2.0 * np.arcsin(np.clip(0.5 * verticals, 0.0, 1.0))
        return float(np.sqrt(np.mean(places**2))), float(np.sqrt(np.mean(tilts**2)))
