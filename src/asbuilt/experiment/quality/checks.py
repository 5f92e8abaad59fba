"""Check of a recording before it is used: findings on clock, motion, torque and excitation."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.load import load_robot
from asbuilt.description.model import RobotModel
from asbuilt.description.plausibility import (
    check_plausibility,
    find_wrong_units,
    list_corrections,
)
from asbuilt.description.structure.locking import report_locks
from asbuilt.errors import RecordingError, UsageError
from asbuilt.experiment.gravity_load import DEGREE
from asbuilt.experiment.logs.long_recordings import RecordingStream, take_first_samples
from asbuilt.experiment.logs.reading_options import merge_reading_options
from asbuilt.experiment.logs.recordings import RecordingLike, read_fitted_recordings
from asbuilt.experiment.quality.command_checks import EXPLAINED, check_commands
from asbuilt.experiment.quality.motion_checks import (
    check_excitation,
    check_recorded_motion,
    find_impossible_motion,
)
from asbuilt.experiment.quality.passes import (
    FirstPass,
    blank_incredible,
    order_as_modelled,
    run_first_pass,
    run_second_pass,
)
from asbuilt.experiment.quality.position_checks import (
    MEASURED,
    PositionNoise,
    check_encoders,
    check_followers,
    check_positions,
    check_structure,
)
from asbuilt.experiment.quality.reductions import SmoothedMotion
from asbuilt.experiment.quality.signal_checks import (
    check_channels,
    check_clock,
    check_noise_floor,
    check_saturation,
    check_signs,
    check_spikes,
)
from asbuilt.experiment.quality.torque_checks import check_torques
from asbuilt.experiment.quality.torque_fit import TorqueFit
from asbuilt.experiment.quality.unit_checks import check_position_unit
from asbuilt.experiment.recording import FLIPPED_TWICE, Recording
from asbuilt.experiment.root import root_of
from asbuilt.experiment.signal.samples import Samples
from asbuilt.findings import Cure, Finding, join_names, list_findings, rank_findings
from asbuilt.tables import preformat, wrap_text

TOO_LITTLE = ("too_few_samples", "too_short")
"""Codes of errors that forbid an identification of the whole robot, and no other use."""


@dataclass(frozen=True, repr=False)
class RecordingCheck:
    """Hold the findings on one recording, errors first.

    Parameters
    ----------
    robot, source
        Names of the robot and of the recording.
    n_samples, n_joints
        Size of the recording.
    rate, duration
        Sampling rate [Hz] and duration [s].
    findings
        What was found, sorted by severity.
    position_step, position_noise
        Step of the positions of each joint [rad or m], 0 where none was found, and the spectrum of
        their noise about the default cutoff [rad^2/Hz]; empty where the clock is wrong.
    """

    robot: str
    source: str
    n_samples: int
    n_joints: int
    rate: float
    duration: float
    findings: tuple[Finding, ...]
    position_step: tuple[float, ...] = ()
    position_noise: tuple[float, ...] = ()

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
        """Whether no finding forbids an identification."""
        return not self.errors

    @property
    def codes(self) -> tuple[str, ...]:
        """Codes of the findings, in their order."""
        return tuple(finding.code for finding in self.findings)

    @property
    def verdict(self) -> str:
        """Number of errors and warnings, such as `"1 ERROR, 2 warnings"`."""
        counts = [
            f"{len(listed)} {name}{'s' if len(listed) > 1 else ''}"
            for name, listed in (("ERROR", self.errors), ("warning", self.warnings))
            if listed
        ]
        # The plural s stays small next to capitals, for reading.
        return ", ".join(counts).replace("ERRORs", "ERRORS") or "No errors, no warnings"

    @property
    def headline(self) -> str:
        """What a user decides by: whether the recording can be identified from, and why not."""
        name = PurePath(self.source).name or self.source
        size = f"{self.duration:.4g} s of {self.n_joints} joints at {self.rate:.4g} Hz"
        # Of kind "info" alone nothing asks for care.
        if not (self.errors or self.warnings):
            return f"READY: {name} has no errors and no warnings in {size}."
        first = (*self.errors, *self.warnings)[0].brief(160).rstrip(".")
        state = "NOT READY" if self.errors else "READY WITH CARE"
        return f"{state}: {first} ({self.verdict} in {name}, {size})."

    def as_text(self, *, full: bool = False, cure_text: Callable[[Cure], str] = str) -> str:
        """Return the verdict and the findings in lines of 80 columns, errors first.

        Parameters
        ----------
        full
            Print every finding; by default findings of one code on several joints are one
            paragraph, and three of severity "info" are printed.
        cure_text
            Function that writes a cure, for an interface that adds the names of its options.
        """
        head = [
            wrap_text(self.headline),
            wrap_text(f"{self.source} on {self.robot}, {self.n_samples} samples"),
        ]
        paragraphs = list_findings(self.findings, cure_text, full=full)
        return "\n".join([*head, *([""] if paragraphs else []), *paragraphs])

    def __repr__(self) -> str:
        return (
            f"RecordingCheck({self.source!r} on {self.robot}: {self.verdict}; found"
            f" {', '.join(self.codes) or 'nothing'})"
        )

    def __str__(self) -> str:
        return self.as_text()

    def _repr_html_(self) -> str:
        return preformat(self.as_text())

    def raise_errors(self, *, but: Collection[str] = ()) -> None:
        """Raise the first error whose code is not among `but`, if there is one.

        Raises
        ------
        RecordingError
            With the fields `code`, `joint`, `time`, `file` and `findings`, all errors.
        """
        errors = [finding for finding in self.errors if finding.code not in but]
        if errors:
            first = errors[0]
            # Each code once, however many joints it is found at.
            also = join_names(list(dict.fromkeys(finding.code for finding in errors[1:])) or [""])
            raise RecordingError(
                f"{self.source}: {first.message}" + (f" (also found: {also})" if also else ""),
                cure=first.cure,
                code=first.code,
                joint=first.joint,
                time=first.time,
                file=self.source,
                findings=tuple(errors),
            )


def _read_one(
    robot: RobotModel | str | Path, item: RecordingLike, settings: Mapping[str, Any]
) -> tuple[RobotModel, Recording | RecordingStream]:
    """Return a robot as it was recorded, and its one recording."""
    model = load_robot(robot)
    options = merge_reading_options(None, settings)
    model, (found,) = read_fitted_recordings(model, (item,), options)
    if len(found) != 1 or isinstance(found[0], Samples):
        raise UsageError("check_recording takes one recording; check several one by one")
    return model, found[0]


def check_recording(
    model: RobotModel | str | Path, recording: RecordingLike, **settings: Any
) -> RecordingCheck:
    """Check clock, missing values, units, signs, order of joints, limits, filters and excitation.

    Where the clock is wrong, only the clock and missing values are checked. A stream is read
    twice; a dozen segments of it and the times of a million samples at most are held in memory.

    Parameters
    ----------
    model
        The robot that was recorded, the name of a bundled one, or the path of a description.
    recording
        Its recording, with the joints of `model`, or what holds one, as for `identify`.
    **settings
        How a file, a data frame or a dict is read: single fields of `ReadingOptions`.

    Returns
    -------
    RecordingCheck
        Findings with place, value and cure.

    Raises
    ------
    RecordingError
        If the recording's joints are not the model's, or a file cannot be read.
    UsageError
        If several recordings are given.

    Examples
    --------
    >>> from asbuilt.description.load import bundled_robot
    >>> from asbuilt.excitation.motions.fourier import random_fourier
    >>> from asbuilt.experiment.virtual.simulation import simulate_recording
    >>> model = bundled_robot("two-link")
    >>> recording = simulate_recording(model, random_fourier(model, rng=1), rate=100.0)
    >>> check_recording(model, recording.flipped()).errors[0].code
    'torque_flipped'
    """
    if not (isinstance(model, RobotModel) and isinstance(recording, Recording | RecordingStream)):
        return check_recording(*_read_one(model, recording, settings))
    # Where the root moves, a stream is checked as if it were held.
    root = root_of(model)
    if root.moves and isinstance(recording, Recording):
        # The joints are checked as if the root were held, then the root.
        held = check_recording(*root.hold(recording))
        has_clock = not _has_clock_error(held.findings)
        of_both = root.add_findings(held.findings, recording, has_clock=has_clock)
        return replace(
            held,
            n_joints=model.n_joints,
            findings=rank_findings(of_both),
            position_step=(),
            position_noise=(),
        )
    chunks = recording if isinstance(recording, RecordingStream) else (recording,)
    known = run_first_pass(model, chunks)
    findings = list(check_clock(known))
    noise = None
    # Rates and derivatives mean nothing without a clock.
    if not _has_clock_error(findings):
        beginning = order_as_modelled(
            model, blank_incredible(take_first_samples(recording, MEASURED))
        )
        beginning = beginning.with_torque_of(known.first.has_torque)
        of_structure = list(check_structure(model, beginning))
        of_commands = list(check_commands(model, beginning))
        # Positions that no posture has contradict torques too: one cause, one finding.
        findings += [*of_structure, *of_commands]
        follows = not any(f.severity == "error" for f in of_structure)
        if follows:
            of_torques = [
                *_check_in_time(model, chunks, known),
                *check_signs(model, known.torque_range, beginning),
            ]
            # What wrong commands explain is not said of torques that are computed from them.
            findings += (f for f in of_torques if not (of_commands and f.code in EXPLAINED))
        noise = PositionNoise.of(beginning)
        findings += check_positions(model, noise)
        findings += check_encoders(model, beginning)
        findings += check_followers(model, beginning) if follows else ()
    findings += report_locks(model)
    reported = {(finding.code, finding.link) for finding in findings}
    findings += (f for f in _report_description(model) if (f.code, f.link) not in reported)
    findings += map(_report_note, known.first.notes)
    return RecordingCheck(
        robot=model.name,
        source=recording.source,
        n_samples=known.n_samples,
        n_joints=known.n_joints,
        rate=known.rate,
        duration=known.duration,
        findings=rank_findings(findings),
        position_step=() if noise is None else tuple(noise.step.tolist()),
        position_noise=() if noise is None else tuple(noise.density.tolist()),
    )


def _has_clock_error(findings: Iterable[Finding]) -> bool:
    return any(f.severity == "error" and f.code.startswith("clock_") for f in findings)


def _report_description(model: RobotModel) -> list[Finding]:
    """Return what is absurd about the described masses; the torques do not depend on them.

    A wrong unit spoils every comparison with CAD, one link its own.
    """
    return [
        replace(each, severity="warning" if each.code == "description_units" else "info")
        for each in check_plausibility(model)
        if each.severity == "error"
    ]


def _choose_description(model: RobotModel, motion: SmoothedMotion, scale: Array) -> RobotModel:
    """Return the robot with whose masses the torques agree best, where CAD's cannot be.

    What an impossible mass explains must not be said of the torques.
    """
    possible = (model, *list_corrections(model))
    if len(possible) == 1:
        return model
    return min(possible, key=lambda each: TorqueFit.of(each, motion, scale).cost)


def _report_corrected_masses(model: RobotModel, described: RobotModel) -> Iterator[Finding]:
    """Yield the impossible masses in whose place the torques of the log agree with others."""
    units = find_wrong_units(model) is not None
    for link, meant in zip(model.links, described.links, strict=True):
        # A unit is a matter of all links, and is reported as one.
        if units or link.inertia.mass == meant.inertia.mass:
            continue
        yield Finding(
            "implausible_density",
            "warning",
            f"link {link.name} has {link.inertia.mass:.4g} kg in the description, denser than any"
            f" matter, and the torques of the log agree with {meant.inertia.mass:.4g} kg",
            Cure("correct its mass in the description"),
            link=link.name,
        )


def _report_note(note: str) -> Finding:
    """Return what reading the recording did; flips that cancel are seldom meant."""
    if note == FLIPPED_TWICE:
        return Finding(
            "flips_cancel",
            "warning",
            note,
            Cure("take both flips out, or keep one if the sign is then wrong"),
        )
    return Finding("note", "info", note.removesuffix("."))


def _check_in_time(
    model: RobotModel, chunks: Iterable[Recording], known: FirstPass
) -> Iterator[Finding]:
    """Find problems of motion, torque and excitation, which need a correct clock."""
    # Segments are read in a second pass, as the first one finds where they lie.
    closer = run_second_pass(model, chunks, known)
    motion = closer.motion
    # Positions in another unit make every later comparison wrong.
    other_unit = check_position_unit(model, known, motion)
    if other_unit is not None:
        yield other_unit
        return
    excess = find_impossible_motion(model, known, motion)
    of_motion = list(check_recorded_motion(model, known, motion, excess))
    yield from of_motion
    yield from check_channels(model, known)
    yield from check_saturation(model, known, closer)
    yield from check_spikes(model, known)
    yield from check_noise_floor(closer.torques, known.rate)
    # Positions of one joint with velocities of another have no torque to compare with.
    swapped = any(finding.code == "velocity_swapped" for finding in of_motion)
    if motion is not None and not swapped and (excess is None or excess.unit == "deg"):
        # Degrees are converted here, so that torques can still be compared.
        scale = [DEGREE if excess and joint.is_revolute else 1.0 for joint in model.joints]
        described = _choose_description(model, motion, np.array(scale))
        yield from _report_corrected_masses(model, described)
        yield from check_torques(described, known, motion, np.array(scale))
    if excess is None:
        yield from check_excitation(model, known, motion)
