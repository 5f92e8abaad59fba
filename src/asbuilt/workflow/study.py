"""Identification as a whole: prepare, identify, validate, compare with CAD."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path

from asbuilt.codec import plain, restored
from asbuilt.description.load import load_robot
from asbuilt.description.locking import lock_findings
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import find_base_parameters
from asbuilt.dynamics.drives.defaults import usual_drive
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.errors import IdentifiabilityError, ResultError, UsageError
from asbuilt.experiment.logs.recordings import RecordingLike, fitted_recordings
from asbuilt.experiment.quality.checks import RecordingCheck
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.signal.samples import Samples
from asbuilt.experiment.signal.signal_chain import SignalChain
from asbuilt.findings import Cure, Finding, ranked
from asbuilt.identification.bodies.known_masses import known_mass_notes
from asbuilt.identification.calibration.mounting import Mounting, find_mounting
from asbuilt.identification.drives.drive_choice import DriveChoice, settle_drive
from asbuilt.identification.errors.position_noise_bias import position_noise_findings
from asbuilt.identification.identify import Fit, fit_samples
from asbuilt.identification.information.cause_data import CauseData, gather_cause_data
from asbuilt.identification.result.as_built_parameters import mass_findings
from asbuilt.identification.result.determination import Determination, determination
from asbuilt.identification.result.metrics import TorqueMetrics, TorqueTally
from asbuilt.identification.result.result import IdentificationResult, stored_document
from asbuilt.identification.result.summary import Summary, summarise
from asbuilt.identification.servo.servo_estimate import ServoEstimate
from asbuilt.validation.attribution.attribution import Attribution, attribute
from asbuilt.validation.comparison.comparison import Comparison, compare, recording_name
from asbuilt.validation.generalisation.cad_verdict import cad_verdict_findings, cause_findings
from asbuilt.validation.generalisation.consolidation import consolidated
from asbuilt.validation.generalisation.effect_bias import with_effects
from asbuilt.validation.generalisation.generalisation import (
    repetition_findings,
    validation_findings,
)
from asbuilt.validation.generalisation.hidden_causes import hidden_cause_findings
from asbuilt.validation.generalisation.missing_effects import (
    MissingEffect,
    confirmed_effects,
    missing_effect_findings,
)
from asbuilt.validation.prediction import Validation, predict_both
from asbuilt.validation.rollout.rollout import Rollout, rollout_findings
from asbuilt.workflow.cutoff_sweep import CutoffSweep, sweep_cutoffs
from asbuilt.workflow.delays import Delays, delay_findings
from asbuilt.workflow.final_fit import fitted_to_everything
from asbuilt.workflow.options import BLOCKS, StudyOptions
from asbuilt.workflow.prepare import AUTOMATIC, Prepared, Progress, divided, prepare
from asbuilt.workflow.servo import (
    explained,
    servo_delays,
    servo_findings,
    servo_notes,
    settle_servo,
)
from asbuilt.workflow.simulation.refinement import (
    Refined,
    judged,
    refine_study,
    refinement_findings,
)
from asbuilt.workflow.simulation.rollout import (
    Simulated,
    held_out_parts,
    simulated_rollouts,
    trained_parts,
)


@dataclass(frozen=True, eq=False, repr=False)
class Study:
    """Hold a result with all that is said of it.

    Attributes
    ----------
    result
        The identified robot.
    findings
        What is wrong, or worth knowing, errors first.
    checks
        The checks of the recordings.
    training
        Predictions of the training data.
    validations
        Predictions of what was held out, then of the other recordings.
    cutoffs
        How the cutoff was chosen, if it was swept.
    attribution
        Which causes explain the error of CAD; None if the recordings are too short.
    rollouts
        Simulations of what was held out and of the other recordings, one per length of windows.
    refined
        How the refinement by trajectories went; None without one.
    effects
        Effects that the model lacks and the recordings show; standard errors include their bias.

    A study that is read from a file has the result and the findings alone.
    """

    result: IdentificationResult
    findings: tuple[Finding, ...]
    checks: tuple[RecordingCheck, ...] = ()
    training: tuple[Validation, ...] = ()
    validations: tuple[Validation, ...] = ()
    cutoffs: CutoffSweep | None = None
    attribution: Attribution | None = None
    rollouts: tuple[Rollout, ...] = ()
    refined: Refined | None = None
    effects: tuple[MissingEffect, ...] = ()

    def __repr__(self) -> str:
        codes = ", ".join(finding.code for finding in self.findings) or "none"
        return f"<Study: {self.result!r}; findings: {codes}>"

    def _repr_html_(self) -> str:
        return self.summary.as_html()

    @cached_property
    def summary(self) -> Summary:
        """Result and findings as text, HTML or CSV."""
        return summarise(self.result, findings=self.findings)

    @cached_property
    def comparison(self) -> Comparison:
        """CAD beside as built."""
        return compare(self.result, validation=(self.validations or self.training) or None)

    @cached_property
    def determination(self) -> Determination:
        """What the recordings determine, and which further motion would help."""
        return determination(self.result)

    def to_json(self) -> str:
        """Return result and findings as JSON that `from_json` reads back to the last bit."""
        said = [{"code": each.code, "message": each.text} for each in self.findings]
        return self.result.to_json(warnings=said, study={"findings": plain(self.findings)})

    @classmethod
    def from_json(cls, text: str) -> Study:
        """Read a stored study, or a stored result as one.

        Raises
        ------
        ResultError
            If the text is not a stored result, or is damaged.
        """
        result, whole = IdentificationResult.from_json(text), stored_document(text)
        if "study" not in whole:
            return cls(result, result.findings)
        try:
            found = tuple(restored(Finding, item) for item in whole["study"]["findings"])
        except (KeyError, TypeError, ValueError, AttributeError) as problem:
            raise ResultError(
                f"the findings of the stored result are damaged: {type(problem).__name__}"
                f" {problem}",
                cure=Cure("identify again"),
            ) from problem
        return cls(result, found)


def identify(
    robot: RobotModel | str | Path,
    recordings: RecordingLike | Sequence[RecordingLike],
    *,
    validation: RecordingLike | Sequence[RecordingLike] = (),
    options: StudyOptions | None = None,
    progress: Progress | None = None,
) -> Study:
    """Identify a robot from recordings and validate the result.

    Parameters
    ----------
    robot
        A robot, the name of a bundled one, or the path of a description.
    recordings
        One recording or several: paths, data frames, dictionaries of arrays, `Recording`,
        `RecordingStream`, or `Samples` already prepared.
    validation
        Recordings to validate on, beside what `options.holdout` holds out.
    options
        How to identify; None: the defaults.
    progress
        Called with the name of a step and the fraction done.

    Returns
    -------
    Study
        The result, its predictions and findings.

    Raises
    ------
    RecordingError
        If a check finds an error in a recording, or filters leave nothing of it.
    IdentifiabilityError
        If the recordings are too short.
    UsageError
        If no recording is given or an option is wrong.

    Examples
    --------
    >>> from asbuilt import load_robot, simulate_recording, identify, StudyOptions
    >>> from asbuilt.excitation.motions.random_motion import random_fourier
    >>> model = load_robot("two-link")
    >>> motion = random_fourier(model, rng=1, duration=10.0)
    >>> log = simulate_recording(model, motion, rng=1)
    >>> study = identify(model, log, options=StudyOptions(holdout="last:0.3", method="wls"))
    >>> study.result.rank == study.result.n_base
    True
    """
    options = options or StudyOptions()
    report = progress or (lambda what, fraction: None)
    model = robot if isinstance(robot, RobotModel) else load_robot(robot)
    model, (trained, others) = fitted_recordings(model, (recordings, validation))
    model = options.with_known_masses(model)
    trained, others, servo, options = settle_servo(model, trained, others, options)
    if options.rollout and options.holdout is None and not others:
        raise UsageError(
            "a rollout needs a recording, or a part of one, that the model is not fitted to",
            cure=Cure("hold out a part, or give another recording", settings={"holdout": BLOCKS}),
        )
    sweeps: list[CutoffSweep] = []

    def settle(chain: SignalChain, heads: Sequence[Recording]) -> SignalChain:
        sweeps.append(_swept(model, heads, chain, options, report))
        return replace(chain, cutoff=sweeps[0].chosen, parallel_cutoff=None)

    prepared = prepare(
        model,
        trained,
        validation=others,
        chain=options.chain,
        holdout=options.holdout,
        checked=options.checked,
        tolerated=(),
        settle=settle if options.sweep_cutoff else None,
        estimate_delay=servo is None,
        progress=report,
    )
    prepared = explained(prepared, trained, servo)
    if servo is not None:
        prepared = replace(prepared, delay=servo_delays(servo, trained, prepared.digests))
    report("identify", 0.0)
    parts = trained_parts(trained, prepared.chain, prepared.holdout) if options.refine else ()
    settled = sweeps[0] if sweeps else None
    study = _concluded(model, prepared, options, settled, servo, report, parts)
    if options.rollout or options.refine:
        report("roll out", 0.0)
        held = held_out_parts(trained, others, prepared.chain, prepared.holdout)
        if study.refined is not None:
            study = replace(study, refined=judged(study.result, study.refined, held or parts))
        rollouts = simulated_rollouts(study.result, held, options.rollout)
        findings = ranked((*study.findings, *rollout_findings(rollouts)))
        study = replace(study, rollouts=rollouts, findings=findings)
    if options.holdout != AUTOMATIC or options.refine or not _held_out(prepared):
        return study
    late = Delays(prepared.chain or SignalChain(), () if servo else prepared.delay)
    everything = replace(prepared, training=divided(trained, late.chain, None, late)[0])
    whole = explained(everything, trained, servo).training
    final = fitted_to_everything(study.result, study.findings, whole, options, study.effects)
    return replace(study, **final)


def _held_out(prepared: Prepared) -> bool:
    return prepared.holdout is not None and prepared.chain is not None


def _concluded(
    model: RobotModel,
    prepared: Prepared,
    options: StudyOptions,
    cutoffs: CutoffSweep | None,
    servo: ServoEstimate | None,
    report: Progress,
    parts: Sequence[Simulated] = (),
) -> Study:
    """Identify from prepared samples and say what is to be said."""
    training, held = prepared.training, (*prepared.held_out, *prepared.validation)
    choice = settle_drive(model, training, options.drive)
    mounting = (
        find_mounting(model, training, drive=choice.drive, block_seconds=options.block_seconds)
        if options.mounting == "estimate"
        else None
    )
    model = model if mounting is None else mounting.model
    fit = fit_samples(
        model,
        training,
        base=find_base_parameters(model, choice.drive),
        method=options.method,
        undetermined=options.undetermined,
        errors=options.errors,
        block_seconds=options.block_seconds,
        threads=options.threads,
        fitted_nonlinear=choice.fitted,
    )
    fit = replace(fit, provenance=(*fit.provenance, *choice.sentences))
    refined = None
    if options.refine is not None:
        fit, servo, refined = refine_study(fit, parts, servo, options.rollout, report)
    report("predict", 0.0)
    trained, validations = (
        tuple(
            predict_both(model, fit.base, fit.estimate.beta, fit.design, samples)
            for samples in group
        )
        for group in (training, held)
    )
    cause_data, too_short = _cause_data(fit, prepared, options.block_seconds)
    train, train_cad = _together(fit, trained)
    conclude = partial(
        Fit.concluded,
        train=train,
        cad=validations[0].metrics_cad if validations else train_cad,
        validation=[each.metrics_as_built for each in validations],
        cause_data=cause_data,
        chain=prepared.chain,
        holdout=prepared.holdout,
        digests=prepared.digests,
        delay=prepared.delay,
        notes=(
            *known_mass_notes(model),
            *_notes(mounting, cutoffs),
            *servo_notes(model, servo),
        ),
        servo=None if servo is None else servo.servo,
        servo_errors=None if servo is None else servo.errors,
        corrected=() if mounting is None else ("mounting",),
    )
    result = conclude(fit)
    effects = confirmed_effects(result, training, block_seconds=options.block_seconds)
    fit = with_effects(fit, training, effects, block_seconds=options.block_seconds)
    result = result if fit.omitted is None else conclude(fit)
    report("compare", 0.0)
    attribution = None if cause_data is None else attribute(result)
    findings = (
        *result.findings,
        *_drive_findings(choice),
        *_check_findings(prepared.checks),
        *lock_findings(model.locked_joints),
        *delay_findings(result, prepared.delay, fit.delay_shift),
        *validation_findings(result.train, validations),
        *repetition_findings(training, held),
        *too_short,
        *hidden_cause_findings(
            result,
            training,
            choice.drive,
            tilt=None if attribution is None else attribution.tilt,
            mounting=mounting,
            block_seconds=options.block_seconds,
        ),
        *_gain_findings(training),
        *position_noise_findings(
            result,
            training,
            [check.position_noise for check in prepared.checks],
            prepared.chain.cutoff if prepared.chain else None,
        ),
        *servo_findings(model, servo, choice.drive),
        *refinement_findings(refined),
        *cause_findings(attribution),
        *missing_effect_findings(result, effects, counted=fit.omitted is not None),
        *cad_verdict_findings(validations),
        *mass_findings(result),
    )
    report("compare", 1.0)
    return Study(
        result,
        consolidated(findings),
        prepared.checks,
        trained,
        validations,
        cutoffs,
        attribution,
        refined=refined,
        effects=effects,
    )


def _together(fit: Fit, predictions: Sequence[Validation]) -> tuple[TorqueMetrics, TorqueMetrics]:
    """Return the metrics of several predictions together, as built and by CAD."""
    as_built, by_cad = (TorqueTally(fit.model.joint_names) for _ in range(2))
    for each in predictions:
        as_built.add(each.measured, each.predicted)
        by_cad.add(each.measured, each.predicted_cad)
    source = ", ".join(fit.information.sources)
    return as_built.metrics(source), by_cad.metrics(source)


def _cause_data(
    fit: Fit, prepared: Prepared, block_seconds: float | None
) -> tuple[CauseData | None, tuple[Finding, ...]]:
    """Return what causes are weighed by, or a finding that the recordings are too short for it."""
    held = (*prepared.held_out, *prepared.validation)
    try:
        return gather_cause_data(
            fit.model, fit.base, prepared.training, held[:1], block_seconds=block_seconds
        ), ()
    except IdentifiabilityError as problem:
        return None, (
            Finding(
                "causes_undetermined",
                "warning",
                f"Causes of CAD errors, and their cost in torque, are undetermined: {problem}",
                Cure("record longer"),
            ),
        )


def _notes(mounting: Mounting | None, cutoffs: CutoffSweep | None) -> tuple[str, ...]:
    return (
        *(() if mounting is None else (mounting.sentence,)),
        *(() if cutoffs is None else (f"Cutoff: {cutoffs.why}",)),
    )


def _drive_findings(choice: DriveChoice) -> tuple[Finding, ...]:
    said = (
        Finding("drive_terms", "info", f"{sentence[0].upper()}{sentence[1:]}")
        for sentence in choice.sentences
    )
    return (*said, *choice.findings)


def _check_findings(checks: Sequence[RecordingCheck]) -> tuple[Finding, ...]:
    return tuple(
        replace(finding, message=f"{recording_name(check.source)}: {finding.message}")
        for check in checks
        for finding in check.warnings
    )


def _gain_findings(training: Sequence[Samples]) -> tuple[Finding, ...]:
    if all(samples.torque_source != "current" for samples in training):
        return ()
    return (
        Finding(
            "gains_assumed",
            "info",
            "Torques come from currents, whose gains count as exact: if the torque per ampere of a"
            " joint is 3 % off, so are its parameters, beyond the standard errors",
            Cure("identify the gains with a payload of known mass", call="find_gains"),
        ),
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
        model,
        recordings,
        drive=drive,
        method=options.method,
        chain=chain,
        holdout=options.holdout,
        progress=report,
    )
