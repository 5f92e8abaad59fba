"""What the root of a robot is in a log: fixed, or a base that moves and has columns of its own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Literal

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.experiment.recording import Recording

if TYPE_CHECKING:
    from asbuilt.experiment.free_base.base_checks import FloatingRoot
    from asbuilt.experiment.free_base.ground import Ground
    from asbuilt.experiment.logs.formats.log_format import LogTable
    from asbuilt.experiment.logs.sheet import RecordingSheet


class FixedRoot:
    """Say that the root does not move, so that a log is of the joints alone.

    Who reads logs, checks them or measures simulated motion asks the root by these methods;
    `FloatingRoot` has them too, and what holds a root, which only one that moves needs.
    """

    moves: Literal[False] = False

    def complete(
        self,
        recording: Recording,
        table: LogTable,
        sheet: RecordingSheet,
        finish: Callable[[Recording], Recording],
    ) -> Recording:
        """Return a finished recording of the joints: a log has nothing of a fixed root."""
        return finish(recording)

    def settle(self, model: RobotModel, recordings: Sequence[Recording]) -> RobotModel:
        """Return the robot with what recordings show of how it stands."""
        return model

    def measure_ground(self, recording: Recording, starts: Array, horizon: float) -> Ground | None:
        """Return the ground in windows (W,) of a length [s]; None where nothing stands on it."""
        return None

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
