"""The whole of an identification.

Check, prepare, hold out, identify, predict what was held out, compare with CAD.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import find_base_parameters
from asbuilt.dynamics.drives.defaults import usual_drive
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.errors import IdentifiabilityError, UsageError
from asbuilt.experiment.logs.long_recordings import RecordingStream
from asbuilt.experiment.quality.checks import RecordingCheck, check_recording
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.signal.hold_out import hold_out, parse_rule
from asbuilt.experiment.signal.samples import Samples
from asbuilt.experiment.signal.signal_chain import SignalChain, prepare_samples
from asbuilt.identification.calibration.mounting import find_mounting
from asbuilt.identification.drives.drive_choice import DriveChoice, settle_drive
from asbuilt.identification.errors.error_basis import ErrorKind
from asbuilt.identification.identify import identify
from asbuilt.identification.information.cause_data import gather_cause_data
from asbuilt.identification.result.result import IdentificationResult, IdentificationWarning
from asbuilt.validation.attribution.attribution import Attribution, attribute
from asbuilt.validation.comparison.comparison import Comparison, compare
from asbuilt.validation.generalisation.generalisation import with_findings, with_repeats
from asbuilt.validation.generalisation.hidden_causes import with_hidden_causes
from asbuilt.validation.prediction import Validation, validate
from asbuilt.workflow.cutoff_sweep import CutoffSweep, sweep_cutoffs

Progress = Callable[[str, float], None]

GAINS_TAKEN = (
    "Torques come from currents, whose gains were taken as exact: where the torque per ampere of a"
    " joint is 3 % off, so is what its torque tells, beyond the standard errors. asbuilt gains"
    " finds it from a payload of known mass."
)


@dataclass(frozen=True, slots=True, kw_only=True)
class StudyOptions:
    """Say how to identify.

    | field | meaning |
    |---|---|
    | `drive` | drive terms; None: those that the torque source calls for; "auto" (or "auto,spring:joints=2"): chosen on held-out blocks |
    | `method` | the estimator, a key of `methods`; the command line takes "auto" where none is named |
    | `chain` | the signal chain; what it leaves open is chosen from the recordings |
    | `holdout` | a rule of `hold_out`, such as "blocks:5s:3"; None holds nothing out |
    | `undetermined` | directions that no motion excites stay at CAD and are named, or the study refuses |
    | `mounting` | gravity points as described, or its direction is found along with the bodies |
    | `block_seconds` | length of the time blocks that errors are judged by [s]; None: 5 s, less in short recordings |
    | `sweep_cutoff` | choose the cutoff of the low-pass by held-out error |
    | `errors` | standard errors from time blocks by formula, by drawing the blocks, or from the textbook |
    | `checked` | refuse recordings in which `check_recording` finds errors |
    | `threads` | threads of the kernels; None: all cores where that pays |

    Raises
    ------
    UsageError
        If the rule cannot be read.
    """

    drive: DriveSet | str | None = None
    method: str = "wls"
    chain: SignalChain = field(default_factory=SignalChain)
    holdout: str | None = None
    undetermined: Literal["toward_prior", "refuse"] = "toward_prior"
    mounting: Literal["as_described", "estimate"] = "as_described"
    block_seconds: float | None = None
    sweep_cutoff: bool = False
    errors: ErrorKind = "blocks"
    checked: bool = True
    threads: int | None = None

    def __post_init__(self) -> None:
        if self.holdout is not None:
            parse_rule(self.holdout)


@dataclass(frozen=True, slots=True, eq=False)
class Study:
    """Hold a result with all that it was judged by.

    Checks of the recordings, predictions of held-out data, comparison with CAD, and why CAD is off,
    where that was asked.

    `training` predicts the data used; `validations` what was held out, then the other recordings,
    in the order given. `cutoffs` says how the cutoff was chosen, where it was swept.
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
    """Identify a robot from recordings (or samples already prepared) and judge the result on what
    was held out.

    Recordings go through one signal chain, whose open choices follow the motion in all of them, so
    that none is cut short; of a stream the first stretch is checked and chosen by. Raises
    RecordingError where a check finds an error.
    """
    options = options or StudyOptions()
    report = progress or (lambda what, fraction: None)
    if not recordings:
        raise UsageError(f"no recording is given to identify {model.name} from")
    report("check", 0.0)
    heads = [_head(item) for item in (*recordings, *validation)]
    checks = (
        tuple(check_recording(model, head) for head in heads if head is not None)
        if options.checked
        else ()
    )
    for check in checks:
        check.raise_errors()
    report("filter", 0.0)
    logged = [head for head in heads if head is not None]
    chain = options.chain.resolved(*logged) if logged else options.chain
    cutoffs = (
        _swept(
            model,
            [head for head in heads[: len(recordings)] if head is not None],
            chain,
            options,
            report,
        )
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
        judging = [
            replace(held, source=f"{held.source}, held out {options.holdout}") for _, held in parts
        ] + judging
    report("identify", 0.0)
    chosen = settle_drive(model, learning, options.drive)
    stands = (
        find_mounting(model, learning, drive=chosen.drive, block_seconds=options.block_seconds)
        if options.mounting == "estimate"
        else None
    )
    model = model if stands is None else stands.model
    result = identify(
        model,
        learning,
        base=find_base_parameters(model, chosen.drive),
        method=options.method,
        undetermined=options.undetermined,
        errors=options.errors,
        block_seconds=options.block_seconds,
        threads=options.threads,
        fitted_nonlinear=chosen.fitted,
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
    result = with_repeats(
        with_findings(_with_drive_choice(result, chosen), checks, validations), learning, judging
    )
    result = _with_evidence(result, learning, judging, options.block_seconds)
    attribution = None
    if result.cause_data is not None and options.mounting == "as_described":
        attribution = attribute(result)
    tilt = None if attribution is None else attribution.tilt
    result = with_hidden_causes(
        result,
        learning,
        chosen.drive,
        tilt=tilt,
        stands=stands,
        block_seconds=options.block_seconds,
    )
    report("predict", 1.0)
    return Study(
        result,
        checks,
        training,
        validations,
        compare(result, validation=validations or training),
        cutoffs,
        attribution,
    )


def _with_evidence(
    result: IdentificationResult,
    learning: Sequence[Samples],
    judging: Sequence[Samples],
    block_seconds: float | None,
) -> IdentificationResult:
    """Return the result with the cause data, or with a warning that there is too little of
    it.
    """
    try:
        return replace(
            result,
            cause_data=gather_cause_data(
                result.model, result.base, learning, judging[:1], block_seconds=block_seconds
            ),
        )
    except IdentifiabilityError as problem:
        message = (
            f"Why CAD is off, and what differences cost in torque, is not told: {problem}. Record"
            " longer."
        )
        return replace(
            result, warnings=(*result.warnings, IdentificationWarning("causes_untold", message))
        )


def _swept(
    model: RobotModel,
    recordings: Sequence[Recording],
    chain: SignalChain,
    options: StudyOptions,
    report: Progress,
) -> CutoffSweep:
    if not recordings:
        raise UsageError(
            "a cutoff can be chosen for recordings only; these samples are filtered already"
        )
    drive = (
        options.drive
        if isinstance(options.drive, DriveSet)
        else usual_drive(model, recordings[0].torque_source)
    )
    return sweep_cutoffs(
        model, recordings, drive=drive, chain=chain, holdout=options.holdout, progress=report
    )


def _head(item: Recording | RecordingStream | Samples) -> Recording | None:
    return (
        item.head
        if isinstance(item, RecordingStream)
        else item
        if isinstance(item, Recording)
        else None
    )


def _prepared(item: Recording | RecordingStream | Samples, chain: SignalChain) -> Samples:
    if isinstance(item, RecordingStream):
        return item.prepared(chain)
    return item if isinstance(item, Samples) else prepare_samples(item, chain)


def _with_drive_choice(result: IdentificationResult, chosen: DriveChoice) -> IdentificationResult:
    """Return the result with how its drive terms were chosen, among its warnings where terms were
    added or do not pay.
    """
    spoken = [
        IdentificationWarning("drive_terms", f"{sentence[0].upper()}{sentence[1:]}.")
        for sentence in chosen.sentences
    ]
    spoken += [
        IdentificationWarning("nonlinear_parameters", warning) for warning in chosen.warnings
    ]
    return replace(
        result,
        warnings=(*result.warnings, *spoken),
        provenance=(*result.provenance, *chosen.sentences),
    )
