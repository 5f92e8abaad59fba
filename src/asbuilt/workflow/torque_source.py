"""What the torque of recordings is: measured, or what something else makes of commands."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

from asbuilt.description.model import RobotModel
from asbuilt.dynamics.drives.drive_set import DriveSet
from asbuilt.experiment import Recorded
from asbuilt.findings import Finding
from asbuilt.identification.identify import Fit
from asbuilt.workflow.prepare import Prepared

if TYPE_CHECKING:
    from asbuilt.dynamics import PositionServo
    from asbuilt.identification.trajectories.refined_fit import RefinedFit
    from asbuilt.identification.trajectories.simulated_robot import ServoCoordinates
    from asbuilt.identification.uncertainty.pose_noise import ExpectedScores


class MeasuredTorque:
    """Say that torques were measured, so that nothing about them is to be identified.

    A study asks its source of torques by these methods; another source overrides them.
    """

    @property
    def expected(self) -> ExpectedScores | None:
        """Scores that its noise lends the parameters."""
        return None

    @property
    def law(self) -> PositionServo | None:
        """What makes torques of commands, and moves a simulated robot with them."""
        return None

    @property
    def free(self) -> ServoCoordinates | None:
        """What of the law is unknown, so that trajectories are fitted to it."""
        return None

    @property
    def is_measured(self) -> bool:
        """Whether delays, effects and errors of single recordings are those of a sensor."""
        return True

    @property
    def of_result(self) -> dict[str, Any]:
        """What it adds to a result, by field."""
        return {}

    def settle_samples(self, prepared: Prepared, recordings: Sequence[Recorded]) -> Prepared:
        """Return the samples of recordings as it accounts for them."""
        return prepared

    def with_delays(self, prepared: Prepared, recordings: Sequence[tuple[str, str]]) -> Prepared:
        """Return samples with its delay, where it has one, by name and digest of recordings."""
        return prepared

    def refined(self, refined: RefinedFit) -> MeasuredTorque:
        """Return it as trajectories show it."""
        return self

    def with_errors(self, fit: Fit) -> Fit:
        """Return a fit whose errors include its own."""
        return fit

    def sentences(self, model: RobotModel) -> tuple[str, ...]:
        """Return what the torques rest on."""
        return ()

    def findings(self, model: RobotModel, drive: DriveSet) -> Iterable[Finding]:
        """Return what is worth knowing of it."""
        return ()
