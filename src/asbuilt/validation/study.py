"""The whole of an identification: check, prepare, hold out, identify, predict what was held out, compare with CAD."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base_parameters import find_base_parameters
from asbuilt.dynamics.drive_defaults import usual_drive
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.errors import AsbuiltError, IdentifiabilityError, UsageError
from asbuilt.experiment.checks import RecordingCheck, check_recording
from asbuilt.experiment.hold_out import hold_out
from asbuilt.experiment.long_recordings import RecordingStream
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.samples import Samples
from asbuilt.experiment.signal_chain import SignalChain, prepare_samples
from asbuilt.identification.cause_evidence import gather_evidence
from asbuilt.identification.drive_choice import DriveChoice, settle_drive
from asbuilt.identification.error_basis import ErrorKind
from asbuilt.identification.identify import identify
from asbuilt.identification.metrics import TorqueMetrics
from asbuilt.identification.mounting import Mounting, find_mounting
from asbuilt.identification.result import IdentificationResult, IdentificationWarning
from asbuilt.identification.spring_search import suspected_springs
from asbuilt.validation.attribution import Attribution, attribute
from asbuilt.validation.comparison import Comparison, compare, recording_name
from asbuilt.validation.cutoff_sweep import CutoffSweep, sweep_cutoffs
from asbuilt.validation.prediction import Validation, validate
from asbuilt.validation.standing import StandingErrors, standing_errors

Progress = Callable[[str, float], None]

STANDING_ERROR = 0.5
"""Share of a joint's squared error at standstill from which it is said so."""
ASKEW = np.deg2rad(0.5)
"""Tilt of the mounting [rad] from which it is said so."""
BADLY_FITTING = ("bodies_strained", "bodies_refused")
"""Warnings of an automatic choice where something acts that real bodies cannot follow,"""
SEARCHED = 30_000
"""for which, up to so many samples, it is looked whether the robot stands askew, and for springs."""
GAINS_TAKEN = (
    "Torques come from currents, whose gains were taken as exact: where the torque per ampere of a joint is 3 % off, so is what its torque tells, beyond the "
    "standard errors. asbuilt gains finds it from a payload of known mass."
)
OVERFIT = 2.0
"""Held-out error of a joint, in multiples of its error on the data used, from which the fit is said not to generalise."""
NOTICEABLE = 0.1
"""Held-out error of a joint, as a fraction of its own torque, below which that is not said."""
BEHIND_CAD = 1.05
"""Held-out error of a joint as built, in multiples of that of CAD, from which CAD is said to predict better."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StudyOptions:
    """Say how to identify: drive terms (None: by torque source; "auto", or "auto,spring:joints=2": chosen on held-out blocks), estimator, signal chain, what to hold out, what to do without excitation.

    `holdout` is a rule of `hold_out`; `checked` False uses recordings whatever `check_recording` says of them; `mounting` "estimate" finds how the robot stands;
    `sweep_cutoff` chooses the low-pass cutoff by held-out error; `errors` come from time blocks by formula, by drawing them, or from the textbook.
    """

    drive: DriveSet | str | None = None
    method: str = "wls"
    chain: SignalChain = field(default_factory=SignalChain)
    holdout: str | None = None
    unexcited: Literal["toward_prior", "refuse"] = "toward_prior"
    mounting: Literal["as_described", "estimate"] = "as_described"
    block_seconds: float | None = None
    sweep_cutoff: bool = False
    errors: ErrorKind = "blocks"
    checked: bool = True
    threads: int | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Study:
    """Hold a result with all that it was judged by: checks of the recordings, predictions of held-out data, comparison with CAD, and why CAD is off, where that was asked.

    `training` predicts the data used; `validations` what was held out, then the other recordings, in the order given. `cutoffs` says how the cutoff was chosen,
    where it was swept.
    """

    result: IdentificationResult
    checks: tuple[RecordingCheck, ...]
    training: tuple[Validation, ...]
    validations: tuple[Validation, ...]
    comparison: Comparison
    cutoffs: CutoffSweep | None = None
    attribution: Attribution | None = None


def run_study(
    model: RobotModel,
    recordings: Sequence[Recording | RecordingStream | Samples],
    *,
    validation: Sequence[Recording | RecordingStream | Samples] = (),
    options: StudyOptions | None = None,
    progress: Progress | None = None,
) -> Study:
    """Identify a robot from recordings (or samples already prepared) and judge the result on what was held out.

    Recordings go through one signal chain, whose open choices follow the motion in all of them, so that none is cut short; of a stream the first stretch is
    checked and chosen by. Raises RecordingError where a check finds an error.
    """
    options = options or StudyOptions()
    report = progress or (lambda what, fraction: None)
    if not recordings:
        raise UsageError(f"no recording is given to identify {model.name} from")
    report("check", 0.0)
    heads = [_head(item) for item in (*recordings, *validation)]
    checks = tuple(check_recording(model, head) for head in heads if head is not None) if options.checked else ()
    for check in checks:
        check.raise_errors()
    report("filter", 0.0)
    logged = [head for head in heads if head is not None]
    chain = options.chain.resolved(*logged) if logged else options.chain
    cutoffs = (
        _swept(model, [head for head in heads[: len(recordings)] if head is not None], chain, options, report)
        if options.sweep_cutoff
        else None
    )
    if cutoffs is not None:
        chain = replace(chain, cutoff=cutoffs.chosen, parallel_cutoff=None)
    learning = [_prepared(item, chain) for item in recordings]
    judging = [_prepared(item, chain) for item in validation]
    if options.holdout is not None:
        parts = [hold_out(samples, options.holdout) for samples in learning]
        learning = [train for train, _ in parts]
        judging = [replace(held, source=f"{held.source}, held out {options.holdout}") for _, held in parts] + judging
    report("identify", 0.0)
    chosen = settle_drive(model, learning, options.drive)
    stands = (
        find_mounting(model, learning, drive=chosen.drive, block_seconds=options.block_seconds) if options.mounting == "estimate" else None
    )
    model = model if stands is None else stands.model
    result = identify(
        model,
        learning,
        base=find_base_parameters(model, chosen.drive),
        method=options.method,
        unexcited=options.unexcited,
        errors=options.errors,
        block_seconds=options.block_seconds,
        threads=options.threads,
    )
    if stands is not None:
        result = replace(result, notes=(*result.notes, stands.sentence))
    if any(samples.torque_source == "current" for samples in learning):
        result = replace(result, notes=(*result.notes, GAINS_TAKEN))
    if cutoffs is not None:
        result = replace(result, notes=(*result.notes, f"Cutoff: {cutoffs.why}"))
    report("predict", 0.0)
    training = tuple(validate(result, samples) for samples in learning)
    validations = tuple(validate(result, samples) for samples in judging)
    result = _judged(_with_drive_choice(result, chosen), checks, validations)
    with suppress(IdentifiabilityError):
        result = replace(
            result, evidence=gather_evidence(result.model, result.base, learning, judging[:1], block_seconds=options.block_seconds)
        )
    attribution = None
    if result.evidence is not None and options.mounting == "as_described":
        attribution = attribute(result)
        stands = _searched(result, learning, chosen.drive, options)
        result = _mounting_doubted(result, attribution.tilt, stands)
    result = _springs_suspected(result, stands, learning, chosen.drive, options)
    report("predict", 1.0)
    return Study(result, checks, training, validations, compare(result, validation=validations or training), cutoffs, attribution)


def _searched(result: IdentificationResult, learning: Sequence[Samples], drive: DriveSet, options: StudyOptions) -> Mounting | None:
    """Find how the robot stands where real bodies fit badly; None elsewhere, and for long recordings."""
    if not _to_be_searched(result, learning):
        return None
    try:
        return find_mounting(result.model, learning, drive=drive, block_seconds=options.block_seconds)
    except AsbuiltError:
        return None


def _mounting_doubted(result: IdentificationResult, tilt: float, stands: Mounting | None) -> IdentificationResult:
    if stands is not None and stands.is_askew:
        message = (
            f"The robot seems to stand askew by {np.rad2deg(stands.angle):.1f} deg, which values that no bodies have imitate and real bodies cannot follow: {stands.sentence}. "
            "Check the mounting or identify with --mounting estimate."
        )
    elif tilt >= ASKEW:
        message = (
            f"The robot seems to stand askew by {np.rad2deg(tilt):.1f} deg, which its description does not know and links then have to imitate. Check the mounting "
            "or identify with --mounting estimate."
        )
    else:
        return result
    return replace(result, warnings=(*result.warnings, IdentificationWarning("mounting_askew", message)))


def _to_be_searched(result: IdentificationResult, learning: Sequence[Samples]) -> bool:
    fits = not any(warning.code in BADLY_FITTING for warning in result.warnings)
    return not fits and sum(len(samples.t) for samples in learning) <= SEARCHED


def _springs_suspected(
    result: IdentificationResult, stands: Mounting | None, learning: Sequence[Samples], drive: DriveSet, options: StudyOptions
) -> IdentificationResult:
    """Say where springs that no file describes would explain what real bodies cannot follow, on a robot that stands as it was found to."""
    if not _to_be_searched(result, learning):
        return result
    askew = stands is not None and stands.is_askew
    model = stands.model if stands is not None and askew else result.model
    springs = suspected_springs(model, learning, drive, block_seconds=options.block_seconds)
    if not springs:
        return result
    joints = "/".join(str(joint) for joint in sorted(spring.joint + 1 for spring in springs))
    message = (
        f"A spring would explain what real bodies cannot follow at {', '.join(map(str, springs))}: cables or hoses that wind up there, or a sensor that drifts with position. "
        f"Where that can be, identify with {'--mounting estimate ' if askew else ''}--drive {drive},spring:joints={joints}."
    )
    return replace(result, warnings=(*result.warnings, IdentificationWarning("spring_suspected", message)))


def _swept(model: RobotModel, recordings: Sequence[Recording], chain: SignalChain, options: StudyOptions, report: Progress) -> CutoffSweep:
    if not recordings:
        raise UsageError("a cutoff can be chosen for recordings only; these samples are filtered already")
    drive = options.drive if isinstance(options.drive, DriveSet) else usual_drive(model, recordings[0].torque_source)
    return sweep_cutoffs(model, recordings, drive=drive, chain=chain, holdout=options.holdout, progress=report)


def _head(item: Recording | RecordingStream | Samples) -> Recording | None:
    return item.head if isinstance(item, RecordingStream) else item if isinstance(item, Recording) else None


def _prepared(item: Recording | RecordingStream | Samples, chain: SignalChain) -> Samples:
    if isinstance(item, RecordingStream):
        return item.prepared(chain)
    return item if isinstance(item, Samples) else prepare_samples(item, chain)


def _with_drive_choice(result: IdentificationResult, chosen: DriveChoice) -> IdentificationResult:
    """Return the result with how its drive terms were chosen, among its warnings where terms were added or do not pay."""
    spoken = [IdentificationWarning("drive_terms", f"{sentence[0].upper()}{sentence[1:]}.") for sentence in chosen.sentences]
    spoken += [IdentificationWarning("drive_shapes", warning) for warning in chosen.warnings]
    return replace(result, warnings=(*result.warnings, *spoken), provenance=(*result.provenance, *chosen.sentences))


def _judged(result: IdentificationResult, checks: Sequence[RecordingCheck], validations: Sequence[Validation]) -> IdentificationResult:
    """Return the result with its held-out metrics, the findings of the checks and the verdict on generalisation among its warnings."""
    found = [
        IdentificationWarning(finding.code, f"{recording_name(check.source)}: {finding.message}. {finding.cure}.")
        for check in checks
        for finding in check.warnings
    ]
    for validation in validations:
        found += _generalisation(result.train, validation) + _standstill(validation)
    if not validations:
        found.append(
            IdentificationWarning(
                "nothing_held_out",
                "No recording was held out: errors are those of the data used and flatter the fit. Give --validate LOG or --holdout blocks:5s:3.",
            )
        )
    return replace(
        result,
        validation=tuple(validation.metrics_as_built for validation in validations),
        cad=validations[0].metrics_cad if validations else result.cad,
        warnings=(*result.warnings, *found),
    )


def _standstill(validation: Validation) -> list[IdentificationWarning]:
    """Say where most of a joint's error falls on the time in which it stands still."""
    errors = standing_errors(validation)
    held = np.flatnonzero(_held(errors))
    if not held.size:
        return []
    listed = "; ".join(
        f"{errors.joint_names[k]}: {100 * errors.energy[k]:.0f} % of the squared error in the {100 * errors.time[k]:.0f} % of the time it stands, RMS {errors.standing[k]:.3g} there and "
        f"{errors.moving[k]:.3g} ({100 * errors.relative_moving[k]:.1f} %) while it moves"
        for k in held
    )
    return [
        IdentificationWarning(
            "error_at_standstill",
            f"On {recording_name(validation.source)} static friction holds joints that stand while others move, and may take any value up to break-away, which no friction "
            f"law in velocity predicts. {listed}. Judge these joints by their motion.",
        )
    ]


def _held(errors: StandingErrors) -> NDArray[np.bool_]:
    """Tell the joints (n,) most of whose error is that of static friction at standstill, which says nothing of how the fit carries over."""
    return np.asarray((errors.energy > STANDING_ERROR) & (errors.standing > 2.0 * errors.moving) & (errors.time > 0.05), dtype=np.bool_)


def _generalisation(train: TorqueMetrics, validation: Validation) -> list[IdentificationWarning]:
    built, cad = validation.metrics_as_built, validation.metrics_cad
    found = []
    standing = standing_errors(validation)
    error = np.where(_held(standing), standing.moving, built.rms)
    worse = np.flatnonzero((error > OVERFIT * train.rms) & (built.relative_error_per_joint > NOTICEABLE))
    if worse.size:
        listed = ", ".join(f"{built.joint_names[k]} {error[k]:.3g} against {train.rms[k]:.3g}" for k in worse)
        found.append(
            IdentificationWarning(
                "does_not_generalise",
                f"Torque errors on {recording_name(built.source)} are more than {OVERFIT:g} times those of the data used ({listed}): the recording is too short or too "
                "little varied for so many parameters. Record longer, add recordings, or use fewer drive terms.",
            )
        )
    behind = np.flatnonzero(built.rms > BEHIND_CAD * cad.rms)
    if behind.size:
        listed = ", ".join(f"{built.joint_names[k]} {built.rms[k]:.3g} against {cad.rms[k]:.3g}" for k in behind)
        found.append(
            IdentificationWarning(
                "cad_predicts_better",
                f"On {recording_name(built.source)} the CAD values predict these joints better than the fit: {listed}.",
            )
        )
    return found
