"""Information efficiency of a recording, relative to the best motion within the robot's limits."""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from asbuilt.arrays import Array
from asbuilt.codec import make_plain
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.drives.drive_set import DriveSet
from asbuilt.dynamics.drives.torque import choose_usual_drive
from asbuilt.excitation import InformationEfficiency, MotionBounds, information_efficiency
from asbuilt.excitation.limits import complete_limits
from asbuilt.experiment import Recording, RecordingStream, Samples, head_of
from asbuilt.experiment.recording import join_recordings
from asbuilt.findings import Cure, join_names
from asbuilt.workflow.prepare import prepare

# Hold when a joint moved too little, and what is reported of it.

# Efficiency of a joint's worst parameter below which the joint moved too little
EFFICIENCY_TOO_LITTLE = 1e-3
EFFICIENCY_SLOW = 0.25  # Top speed, as a share of the limit, below which a joint moved slowly
# Position range, as a share of the full one or of a turn, below which a joint moved little
EFFICIENCY_NARROW = 0.3
EFFICIENCY_BEYOND = 1.05  # Factor by which speeds or accelerations exceed a limit that is reported
EFFICIENCY_MOST_NAMED = 3  # Parameters named in the text


BETTER_MOTION = Cure("design a motion within the limits", call="design_motion")


@dataclass(frozen=True, slots=True, eq=False)
class RecordedInformation:
    """Hold the information efficiency of a recording, as a whole and of each joint.

    Parameters
    ----------
    joint_names
        Names of the n joints.
    drive
        Drive terms of the torque source.
    efficiency
        Information relative to the bound by the limits.
    travel
        Position range of each joint as a share of the full one, or of a turn if less, (n,).
    top_speed
        Largest speed of each joint as a share of the limit, (n,).
    assumed
        Kinds of limits that the description does not give.
    """

    joint_names: tuple[str, ...]
    drive: DriveSet
    efficiency: InformationEfficiency
    travel: Array
    top_speed: Array
    assumed: tuple[str, ...]

    @property
    def too_little(self) -> tuple[str, ...]:
        """Joints that moved too little, or too much in step, to determine their parameters."""
        return tuple(self.joint_names[k] for k in self._lacking)

    @property
    def std_error_ratios(self) -> Array:
        """Standard error of each joint's worst parameter over its value for the best motion, (n,).

        The best motion has the same length; infinite if the parameter is undetermined.
        """
        with np.errstate(divide="ignore"):
            # No information: an infinite error.
            return np.asarray(1.0 / np.sqrt(self.efficiency.by_joint))

    def as_text(self, cure_text: Callable[[Cure], str] = str) -> str:
        """Return the efficiency, the joints that limit it, and the worst parameters, in 80 columns.

        `cure_text` writes the cure, for an interface that adds the names of its commands.
        """
        limits = f"; limits of {join_names(list(self.assumed))} assumed" if self.assumed else ""
        paragraphs = [
            f"The motion has {100 * self.efficiency.d_efficiency:.2g} % of the information that the"
            f" joint limits allow at most (drive terms {self.drive}{limits})."
            f"{self._word_excess()}"
        ]
        if self._lacking:
            slow = [k for k in self._lacking if self.top_speed[k] < EFFICIENCY_SLOW]
            narrow = [k for k in self._lacking if self.travel[k] < EFFICIENCY_NARROW]
            rest = [self.joint_names[k] for k in self._lacking if k not in {*slow, *narrow}]
            parts = [
                self._list_shares(slow, self.top_speed, "of the speed limit"),
                self._list_shares(narrow, self.travel, "of the range"),
                f"{join_names(rest)}, gently or in step with others" if rest else "",
            ]
            advice = cure_text(BETTER_MOTION)
            paragraphs += [
                f"Joints that moved too little: {'; '.join(part for part in parts if part)}.",
                f"{self._word_worst()} {advice[:1].upper()}{advice[1:]}.",
            ]
        return "\n".join(
            textwrap.fill(paragraph, 80, subsequent_indent="  ") for paragraph in paragraphs
        )

    def as_document(self) -> dict[str, Any]:
        """Return plain numbers and names; None is a standard error that is infinite."""
        return {
            "d_efficiency": self.efficiency.d_efficiency,
            **{
                key: dict(zip(self.joint_names, make_plain(values), strict=True))
                for key, values in (
                    ("by_joint", self.efficiency.by_joint),
                    ("std_error_ratio", self.std_error_ratios),
                    ("travel", self.travel),
                    ("top_speed", self.top_speed),
                )
            },
            "moved_too_little": list(self.too_little),
            "drive": str(self.drive),
            "assumed_limits": list(self.assumed),
        }

    @property
    def _lacking(self) -> list[int]:
        return [
            k for k, part in enumerate(self.efficiency.by_joint) if part < EFFICIENCY_TOO_LITTLE
        ]

    def _list_shares(self, joints: list[int], parts: Array, of_what: str) -> str:
        named = [f"{self.joint_names[k]} {100 * parts[k]:.0f} %" for k in joints]
        return f"{join_names(named)} {of_what}" if named else ""

    def _word_excess(self) -> str:
        outside = [
            f"{name} {factor:.2g} times"
            # Noise of derivatives exceeds limits a little.
            for name, factor in zip(self.joint_names, self.efficiency.beyond, strict=True)
            if factor > EFFICIENCY_BEYOND
        ]
        text = (
            " The bound holds for the speeds and accelerations recorded, noise included, which"
            f" exceed the limits: {join_names(outside)}."
        )
        return text if outside else ""

    def _word_worst(self) -> str:
        ratios = self.std_error_ratios
        names = self.efficiency.base.names
        # Of the joints that moved too little, the worst first.
        worst = sorted(self._lacking, key=lambda k: -ratios[k])[:EFFICIENCY_MOST_NAMED]
        listed = [
            f"{names[index]} {float(f'{ratios[k]:.2g}'):g} times"
            if np.isfinite(ratios[k])
            else f"{names[index]} infinite"
            for k in worst
            if (index := self.efficiency.worst[k]) is not None
        ]
        return f"Largest standard errors relative to the best motion: {join_names(listed)}."


def recorded_information(
    model: RobotModel, recording: Recording | RecordingStream
) -> RecordedInformation:
    """Compare the states of a recording with the best that the robot's limits allow.

    The recording passes the default signal chain; the drive terms follow its torque source. Of a
    stream a dozen chunks at most, spread evenly, stand for all; its position range is of all.

    Raises
    ------
    RecordingError
        If the recording is too short for the filters.
    """
    source = head_of(recording).torque_source
    # A description's own terms, else those of the torque source.
    drive = choose_usual_drive(model, source) if model.usual_drive else DriveSet.default(source)
    span = None
    if isinstance(recording, RecordingStream):
        recording, span = _spread_chunks(recording)
    (samples,) = prepare(model, [recording], checked=False).training
    if span is None:
        span = np.stack([samples.q.min(axis=0), samples.q.max(axis=0)])
    return RecordedInformation(
        model.joint_names,
        drive,
        information_efficiency(model, drive, samples),
        *_measure_limit_use(model, span, samples),
        complete_limits(model)[1],
    )


MOST_CHUNKS = 12
"""Chunks of a stream that stand for all: some 360,000 samples, of which 20,000 are compared."""


def _spread_chunks(stream: RecordingStream) -> tuple[Recording, Array]:
    """Return chunks spread evenly over a stream, as one recording with gaps, and its span (2, n).

    The span are the lowest and highest positions of all chunks.
    """
    kept: list[Recording] = []
    stride = 1
    span = np.array([[np.inf], [-np.inf]])
    for k, chunk in enumerate(stream):
        low = np.nanmin(chunk.q, axis=0, initial=np.inf)
        high = np.nanmax(chunk.q, axis=0, initial=-np.inf)
        span = np.stack([np.minimum(span[0], low), np.maximum(span[1], high)])
        if k % stride == 0:
            kept.append(chunk)
        if len(kept) > MOST_CHUNKS:
            kept = kept[::2]
            stride *= 2
    return join_recordings(kept), span


def _measure_limit_use(model: RobotModel, span: Array, samples: Samples) -> tuple[Array, Array]:
    """Return position range and top speed of each joint, as shares of its limits, two (n,).

    `span` are the lowest and highest positions, (2, n).
    """
    bounds = MotionBounds.assumed(model)
    # A joint that turns for ever has a turn as its range.
    turn = np.where([joint.is_revolute for joint in model.joints], 2 * np.pi, np.inf)
    full = np.minimum(bounds.upper - bounds.lower, turn)
    return (span[1] - span[0]) / full, np.max(np.abs(samples.qd), axis=0) / bounds.velocity
