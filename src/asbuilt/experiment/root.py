"""What the root of a robot is in a log: fixed, or a base that moves and has columns of its own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.experiment.recording import Recording
from asbuilt.findings import Finding

if TYPE_CHECKING:
    from asbuilt.experiment.free_base.base_checks import FloatingRoot
    from asbuilt.experiment.logs.formats.log_format import LogTable
    from asbuilt.experiment.logs.sheet import RecordingSheet


class FixedRoot:
    """Say that the root does not move, so that a log is of the joints alone.

    Who reads and checks logs asks the root by these methods; `FloatingRoot` has them too.
    """

    moves = False

    def complete(
        self,
        recording: Recording,
        table: LogTable,
        sheet: RecordingSheet,
        finish: Callable[[Recording], Recording],
    ) -> Recording:
        """Return a finished recording of the joints with what the log has of the root."""
        return finish(recording)

    def hold(self, recording: Recording) -> tuple[RobotModel, Recording]:
        """Return robot and recording with the root held, of one that moves."""
        raise NotImplementedError

    def add_findings(
        self, found: Sequence[Finding], recording: Recording, *, has_clock: bool
    ) -> tuple[Finding, ...]:
        """Return findings on the held robot in its words, with those on the root."""
        return tuple(found)

    def settle(self, model: RobotModel, recordings: Sequence[Recording]) -> RobotModel:
        """Return the robot with what recordings show of how it stands."""
        return model

    def measure_errors(
        self, measured: Sequence[Array], simulated: Sequence[Array]
    ) -> tuple[float, float] | None:
        """Return the root mean square of distances [m] and tilts [rad] between roots.

        Motions are (W, L, n), whose starts are the same. None where roots do not move in space.
        """
        return None


def root_of(model: RobotModel) -> FixedRoot | FloatingRoot:
    """Return what the root of a robot is."""
    if not model.mixes_joints:
        return FixedRoot()
    from asbuilt.experiment.free_base.base_checks import (  # noqa: PLC0415 - light start
        FloatingRoot,
    )

    return FloatingRoot(model)
