"""How much of what its robot could have shown a recording shows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.excitation.information.efficiency import InformationEfficiency, information_efficiency
from asbuilt.excitation.limits import MotionBounds
from asbuilt.excitation.state_bounds import limited_model
from asbuilt.experiment.logs.long_recordings import RecordingStream, head_of, prepare_logged
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.signal.samples import Samples
from asbuilt.experiment.signal.signal_chain import SignalChain
from asbuilt.findings import joined

TOO_LITTLE = 1e-3
"""Share of the attainable information on its worst told parameter below which a joint is said to
have moved too little.
"""
SLOW = 0.25
"""Top speed, as part of the limit, below which a joint is said to have moved slowly."""
NARROW = 0.3
"""Travel, as part of its range or of one turn, below which a joint is said to have moved within a
small range.
"""
MOST_NAMED = 3
"""Parameters named in words."""


@dataclass(frozen=True, slots=True, eq=False)
class Attainment:
    """Hold the share of the attainable information that a recording carries, as a whole and at each
    joint, for the drive terms of its torque source.

    `travel` (n,) is how much of its range, or of one turn where that is less, each joint went
    through; `top_speed` (n,) its largest speed as part of the limit. `assumed` names the kinds of
    limit that the description does not give.
    """

    joint_names: tuple[str, ...]
    drive: DriveSet
    efficiency: InformationEfficiency
    travel: Array
    top_speed: Array
    assumed: tuple[str, ...]

    @property
    def too_little(self) -> tuple[str, ...]:
        """Joints that moved too little, or too much like others, for their parameters to be told."""
        return tuple(self.joint_names[k] for k in self._lacking)

    @property
    def std_error_ratios(self) -> Array:
        """Standard error of each joint's worst told parameter over that of the best motion of the
        same length (n,); infinite where it is not told at all.
        """
        with np.errstate(divide="ignore"):
            return np.asarray(1.0 / np.sqrt(self.efficiency.by_joint))

    def as_text(self) -> str:
        """Return what is carried, which joints held it back and how, and which parameters suffer
        most.
        """
        limits = f"; limits of {joined(list(self.assumed))} assumed" if self.assumed else ""
        whole = (
            f"It carries {100 * self.efficiency.d_efficiency:.2g} % of the attainable information"
            f" per sample (drive terms {self.drive}{limits})."
        )
        if not self._lacking:
            return whole
        slow = [k for k in self._lacking if self.top_speed[k] < SLOW]
        narrow = [k for k in self._lacking if self.travel[k] < NARROW]
        rest = [k for k in self._lacking if k not in slow and k not in narrow]
        ways = [
            self._listed("slowly, in parts of the speed limit: ", slow, self.top_speed),
            self._listed("within a small range, in parts of the full one: ", narrow, self.travel),
            (
                "gently or too much like others: " + joined([self.joint_names[k] for k in rest])
                if rest
                else ""
            ),
        ]
        return (
            f"{whole}\nMoved too little to tell all parameters -"
            f" {'; '.join(way for way in ways if way)}.\n{self._worst()} asbuilt excite designs a"
            " better motion."
        )

    def as_document(self) -> dict[str, Any]:
        """Return plain numbers and names; None stands for a standard error that is infinite."""
        by_joint = {
            "by_joint": self.efficiency.by_joint,
            "std_error_ratio": self.std_error_ratios,
            "travel": self.travel,
            "top_speed": self.top_speed,
        }
        return {
            "d_efficiency": self.efficiency.d_efficiency,
            **{
                key: dict(zip(self.joint_names, map(_finite, values), strict=True))
                for key, values in by_joint.items()
            },
            "moved_too_little": list(self.too_little),
            "drive": str(self.drive),
            "assumed_limits": list(self.assumed),
        }

    @property
    def _lacking(self) -> list[int]:
        return [k for k, part in enumerate(self.efficiency.by_joint) if part < TOO_LITTLE]

    def _listed(self, how: str, joints: list[int], parts: Array) -> str:
        return (
            how + joined([f"{self.joint_names[k]} {100 * parts[k]:.0f} %" for k in joints])
            if joints
            else ""
        )

    def _worst(self) -> str:
        worst = sorted(self._lacking, key=lambda k: -self.std_error_ratios[k])[:MOST_NAMED]
        names = [
            self.efficiency.base.names[index]
            for k in worst
            if (index := self.efficiency.worst[k]) is not None
        ]
        ratios = [self.std_error_ratios[k] for k in worst]
        said = [
            (
                f"{name} {float(f'{ratio:.2g}'):g} times"
                if np.isfinite(ratio)
                else f"{name} not told at all"
            )
            for name, ratio in zip(names, ratios, strict=True)
        ]
        return (
            "Least told, by standard error against the best motion of the same length:"
            f" {joined(said)}."
        )


def recorded_information(model: RobotModel, recording: Recording | RecordingStream) -> Attainment:
    """Compare the states of a recording, after the default signal chain, with the best that the
    robot's limits admit.

    The drive terms are those that the torque source calls for. Raises RecordingError where the
    recording is too short for the filters.
    """
    drive = DriveSet.default(head_of(recording).torque_source)
    samples = prepare_logged(recording, SignalChain())
    travel, top_speed = _use_of_limits(model, samples)
    return Attainment(
        model.joint_names,
        drive,
        information_efficiency(model, drive, samples),
        travel,
        top_speed,
        limited_model(model)[1],
    )


def _use_of_limits(model: RobotModel, samples: Samples) -> tuple[Array, Array]:
    """Return the travel of each joint as part of its range or of one turn, and its top speed as
    part of the limit, two (n,).
    """
    bounds = MotionBounds.assumed(model)
    turn = np.where([joint.is_revolute for joint in model.joints], 2 * np.pi, np.inf)
    full = np.minimum(bounds.upper - bounds.lower, turn)
    return np.ptp(samples.q, axis=0) / full, np.max(np.abs(samples.qd), axis=0) / bounds.velocity


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
