"""What is wrong with a recording before it is used."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from asbuilt.description.model import RobotModel
from asbuilt.errors import RecordingError
from asbuilt.experiment.logs.long_recordings import RecordingStream, head_of
from asbuilt.experiment.quality.clock_checks import clock_findings
from asbuilt.experiment.quality.excitation_checks import excitation_findings
from asbuilt.experiment.quality.first_pass import Survey, survey
from asbuilt.experiment.quality.motion_checks import DEGREE, in_degrees, motion_findings
from asbuilt.experiment.quality.second_pass import look_closer
from asbuilt.experiment.quality.smoothed_motion import EvenPieces, smoothed_motion
from asbuilt.experiment.quality.torque_checks import torque_findings
from asbuilt.experiment.recording import Recording
from asbuilt.findings import Finding

_ORDER = {"error": 0, "warning": 1, "info": 2}
TOO_LITTLE = ("too_few_samples", "too_short")
"""Codes of errors that forbid an identification of the whole robot, and no other use of a
recording.
"""
UNKNOWN_TORQUE = ("torque_flipped", "joint_torque_flipped", "torque_scale")
"""Codes of errors that say no more than that gains are wrong or not known, for uses that look for
the gains.
"""


@dataclass(frozen=True)
class RecordingCheck:
    """Hold the findings on one recording, errors first; `rate` in Hz, `duration` in s."""

    robot: str
    source: str
    n_samples: int
    n_joints: int
    rate: float
    duration: float
    findings: tuple[Finding, ...]

    @property
    def errors(self) -> tuple[Finding, ...]:
        """Findings that would make an identification wrong."""
        return tuple(finding for finding in self.findings if finding.severity == "error")

    @property
    def warnings(self) -> tuple[Finding, ...]:
        """Findings that would make an identification poor."""
        return tuple(finding for finding in self.findings if finding.severity == "warning")

    @property
    def ok(self) -> bool:
        """Whether nothing forbids an identification."""
        return not self.errors

    @property
    def codes(self) -> tuple[str, ...]:
        """Codes of the findings, in their order."""
        return tuple(finding.code for finding in self.findings)

    def as_text(self) -> str:
        """Write the findings down, one paragraph each, under a line that says what was checked."""
        head = (
            f"{self.source} on {self.robot}: {self.n_samples} samples x {self.n_joints} joints,"
            f" {self.duration:.4g} s at {self.rate:.4g} Hz"
        )
        verdict = (
            f"{len(self.errors)} errors, {len(self.warnings)} warnings"
            if self.errors or self.warnings
            else "nothing wrong was found"
        )
        return "\n".join([head, verdict, *(str(finding) for finding in self.findings)])

    def raise_errors(self, *, but: Collection[str] = ()) -> None:
        """Raise the first error, with the others after it, if there is any whose code is not among
        `but`.

        Raises
        ------
        RecordingError
            If a finding has the severity "error".
        """
        errors = [finding for finding in self.errors if finding.code not in but]
        if errors:
            raise RecordingError(
                "\n".join(
                    f"{self.source}: {finding.message}. {finding.cure}." for finding in errors
                )
            )


def check_recording(model: RobotModel, recording: Recording | RecordingStream) -> RecordingCheck:
    """Look for everything that would spoil an identification of `model` from `recording`, and say
    it with place, value and cure.

    Checked are the clock, missing values, units, signs, the order of joints, limits, saturation,
    filtering and excitation; where the clock is wrong, the clock and missing values alone. A stream
    is gone through twice; besides its times only a dozen pieces of it are held.

    Raises
    ------
    RecordingError
        If the recording's joints are not those of the model.
    """
    stretches = recording if isinstance(recording, RecordingStream) else (recording,)
    known = survey(model, stretches)
    findings = list(clock_findings(known))
    if not any(
        finding.severity == "error" and finding.code.startswith("clock_") for finding in findings
    ):
        findings += _findings_in_time(model, stretches, known)
    findings += (Finding("note", "info", note.removesuffix(".")) for note in known.notes)
    return RecordingCheck(
        robot=model.name,
        source=recording.source,
        n_samples=known.n_samples,
        n_joints=known.n_joints,
        rate=known.rate,
        duration=known.duration,
        findings=tuple(sorted(findings, key=lambda finding: _ORDER[finding.severity])),
    )


def refuse_spoilt(
    model: RobotModel,
    recordings: Iterable[Recording | RecordingStream],
    *,
    but: Collection[str] = TOO_LITTLE,
) -> None:
    """Raise the errors of the first recording that has some, those of the codes `but` apart.

    A stream is judged by its first stretch.
    """
    for recording in recordings:
        check_recording(model, head_of(recording)).raise_errors(but=but)


def _findings_in_time(
    model: RobotModel, stretches: Iterable[Recording], known: Survey
) -> Iterator[Finding]:
    """Look at motion, torque and excitation, which means nothing before the clock is right."""
    pieces = EvenPieces.of(known.t, known.usable)
    closer = look_closer(model, stretches, known, () if pieces is None else pieces.rows)
    motion = None if pieces is None else smoothed_motion(pieces, closer.pieces)
    degrees = in_degrees(model, known, motion) is not None
    revolute = np.array([joint.is_revolute for joint in model.joints])
    yield from motion_findings(model, known, motion)
    yield from torque_findings(
        model, known, closer, motion, np.where(revolute & degrees, DEGREE, 1.0)
    )
    if not degrees:
        yield from excitation_findings(model, known, motion)
