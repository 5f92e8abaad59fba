"""How much of what its robot could have shown a recording shows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from asbuilt.description.model import RobotModel
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.excitation.attained import InformationEfficiency, information_efficiency
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.signal_chain import SignalChain, prepare_samples

TOO_LITTLE = 1e-3
"""Share of the attainable information on its worst told parameter below which a joint is said to have moved too little."""


@dataclass(frozen=True, slots=True, eq=False)
class Attainment:
    """Hold the share of the attainable information that a recording carries, as a whole and at each joint, for the drive terms of its torque source."""

    joint_names: tuple[str, ...]
    drive: DriveSet
    efficiency: InformationEfficiency

    @property
    def too_little(self) -> tuple[str, ...]:
        """Joints that moved too little, or too much like others, for their parameters to be told."""
        return tuple(name for name, part in zip(self.joint_names, self.efficiency.by_joint, strict=True) if part < TOO_LITTLE)

    def as_text(self) -> str:
        """Return one or two sentences."""
        whole = (
            f"It carries {100 * self.efficiency.d_efficiency:.2g} % of the attainable information per sample (drive terms {self.drive})."
        )
        if not self.too_little:
            return whole
        return f"{whole} Moved too little or too alike to tell all of their parameters: {', '.join(self.too_little)}; asbuilt excite designs a better motion."

    def as_document(self) -> dict[str, Any]:
        """Return plain numbers and names."""
        return {
            "d_efficiency": self.efficiency.d_efficiency,
            "by_joint": dict(zip(self.joint_names, self.efficiency.by_joint.tolist(), strict=True)),
            "moved_too_little": list(self.too_little),
            "drive": str(self.drive),
        }


def recorded_information(model: RobotModel, recording: Recording) -> Attainment:
    """Compare the states of a recording, after the default signal chain, with the best that the robot's limits admit.

    The drive terms are those that the torque source calls for. Raises RecordingError where the recording is too short for the filters.
    """
    drive = DriveSet.default(recording.torque_source)
    samples = prepare_samples(recording, SignalChain())
    return Attainment(model.joint_names, drive, information_efficiency(model, drive, samples))
