"""What a study says: result, predictions and findings, and how they follow from fits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from typing import TYPE_CHECKING, Any

from asbuilt.arrays import Array
from asbuilt.codec import make_plain, restore_dataclass
from asbuilt.description.structure.locking import report_locks
from asbuilt.errors import IdentifiabilityError, ResultError
from asbuilt.experiment import RecordingCheck
from asbuilt.findings import Cure, Finding
from asbuilt.identification import Determination, FoundEffect, IdentificationResult, determination
from asbuilt.identification.bodies.known_masses import describe_known_masses
from asbuilt.identification.effects.effect import EFFECTS
from asbuilt.identification.effects.effect_findings import (
    as_by_encoders,
    as_identified,
    describe_stated,
    report_effects,
    report_springs_alike,
)
from asbuilt.identification.effects.plateaus import report_plateaus
from asbuilt.identification.identify import Fit
from asbuilt.identification.information.cause_data import CauseData, gather_cause_data
from asbuilt.identification.result.determination import report_springs
from asbuilt.identification.result.feasible import bound_effects
from asbuilt.identification.result.stored_document import parse_stored_document
from asbuilt.identification.result.summary import Summary, summarise
from asbuilt.identification.result.torque_prediction import TorqueMetrics, TorqueTally
from asbuilt.identification.uncertainty.bias import (
    OmittedBias,
    doubt_driving_friction,
    report_position_noise,
)
from asbuilt.statistics import USUAL_ALPHA
from asbuilt.tables import Table, format_share
from asbuilt.validation import (
    Attribution,
    Comparison,
    Rollout,
    Validation,
    Verdict,
    attribute,
    compare,
    recording_name,
    study_verdict,
)
from asbuilt.validation.attribution.attribute import can_attribute
from asbuilt.validation.carried_load import find_carried_load
from asbuilt.validation.generalisation.cad_verdict import report_cad_verdicts, report_causes
from asbuilt.validation.generalisation.consolidation import consolidate_findings
from asbuilt.validation.generalisation.coverage import (
    check_coverage,
    check_left_out,
    check_repetitions,
)
from asbuilt.validation.generalisation.generalisation import (
    check_validations,
    measure_error_shares,
    report_nameless,
    report_unexplained,
)
from asbuilt.validation.rollout.rollout import tabulate_joint_errors
from asbuilt.validation.verdicts.model_errors import (
    ModelErrors,
    choose_decisive_rollout,
    with_exported,
)
from asbuilt.workflow.cutoff_sweep import CutoffSweep
from asbuilt.workflow.delays import report_delays
from asbuilt.workflow.fits import Fits, predict_held_out, predict_samples
from asbuilt.workflow.study_options import StudyOptions

if TYPE_CHECKING:
    import polars as pl

    from asbuilt.identification.result.legs import FootMoments
    from asbuilt.workflow.refinement import Refined

GAINS_ASSUMED = Finding(
    "gains_assumed",
    "info",
    "Torques come from currents, whose gains count as exact: if the torque per ampere of a joint is"
    " 3 % off, so are its parameters, beyond the standard errors",
    Cure("identify the gains with a payload of known mass", call="find_gains"),
)


@dataclass(frozen=True, eq=False, repr=False)
class Study:
    """Hold a result with all that is reported of it.

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
    stored_verdict
        The verdict that was stored with a study; None: it follows from the rest.

    A study that is read from a file has the result, the findings and the verdict alone.
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
    stored_verdict: Verdict | None = None

    def __repr__(self) -> str:
        codes = ", ".join(finding.code for finding in self.findings) or "none"
        return f"<Study: {self.result!r}; findings: {codes}>"

    def _repr_html_(self) -> str:
        return self.summary()._repr_html_()

    def summary(self) -> Summary:
        """Summarise result and findings as text, HTML or CSV.

        The errors of the joints are those that decide: of torque, or of simulated motion.
        """
        found = summarise(self.result, findings=self.findings, verdict=self.verdict.text)
        simulated = choose_decisive_rollout(self.rollouts)
        if self.verdict.measure == "torque" or simulated is None:
            return replace(found, joints=_name_model(found.joints, self.verdict.error))
        return replace(found, joints=tabulate_joint_errors(self.result.model, simulated))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the base parameters, in the order of every array of them."""
        return self.result.names

    @property
    def effects(self) -> tuple[FoundEffect, ...]:
        """What the recordings show and the description lacks, in the model or named only."""
        return self.result.effects

    @property
    def params(self) -> Array:
        """Estimates of the base parameters, shape (p,)."""
        return self.result.params

    @property
    def bse(self) -> Array:
        """Standard errors of the base parameters, shape (p,)."""
        return self.result.bse

    @property
    def tvalues(self) -> Array:
        """Estimates in standard errors, shape (p,)."""
        return self.result.tvalues

    def conf_int(self, alpha: float = USUAL_ALPHA) -> Array:
        """Return confidence intervals, shape (p, 2): `IdentificationResult.conf_int`."""
        return self.result.conf_int(alpha)

    def to_frame(self, alpha: float = USUAL_ALPHA) -> pl.DataFrame:
        """Return a polars frame with a row per base parameter: `IdentificationResult.to_frame`."""
        return self.result.to_frame(alpha)

    def predict(self, recording: Any, qd: Any = None, qdd: Any = None) -> Any:
        """Predict the torque of a recording or of states: `IdentificationResult.predict`."""
        return self.result.predict(recording, qd, qdd)

    def plot(self, kind: str = "torque", of: Any = None, axes: Any = None) -> Array:
        """Draw a figure: `IdentificationResult.plot`, of what was held out if anything was.

        A study that was read from a file holds no recording: give one as `of`.
        """
        # What was held out, else what was used.
        shown = (*self.validations, *self.training, None)[0] if of is None else of
        return self.result.plot(kind, shown, axes)

    @cached_property
    def comparison(self) -> Comparison:
        """CAD compared with as built."""
        return compare(self.result, validation=(self.validations or self.training) or None)

    @cached_property
    def verdict(self) -> Verdict:
        """Whether to use the model, in a sentence with its number."""
        return self.stored_verdict or study_verdict(
            self.result, self.findings, self.validations, self.rollouts
        )

    @cached_property
    def determination(self) -> Determination:
        """What the recordings determine, and which further motion would help."""
        return determination(self.result)

    def to_json(self) -> str:
        """Return result and findings as JSON that `from_json` reads back to the last bit."""
        return self.result.to_json(
            warnings=[{"code": finding.code, "message": finding.text} for finding in self.findings],
            study={"findings": make_plain(self.findings), "verdict": make_plain(self.verdict)},
        )

    @classmethod
    def from_json(cls, text: str) -> Study:
        """Read a stored study, or a stored result as one.

        Raises
        ------
        ResultError
            If the text is not a stored result, or is damaged.
        """
        result = IdentificationResult.from_json(text)
        whole = parse_stored_document(text)
        if "study" not in whole:
            return cls(result, result.findings)
        try:
            found = tuple(restore_dataclass(Finding, item) for item in whole["study"]["findings"])
            verdict = whole["study"].get("verdict")
            verdict = None if verdict is None else restore_dataclass(Verdict, verdict)
        except (KeyError, TypeError, ValueError, AttributeError) as problem:
            raise ResultError(
                f"findings or verdict of the stored result are damaged: {type(problem).__name__}"
                f" {problem}",
                cure=Cure("identify again"),
            ) from problem
        return cls(result, found, stored_verdict=verdict)


def _name_model(joints: Table, error: ModelErrors) -> Table:
    """Return the errors of joints with whose they are, where the verdict's is of another model."""
    fitted = format_share(error.as_built)
    exported = format_share(error.exported)
    if error.as_built is None or error.exported is None or fitted == exported:
        return joints
    whose = f"as fitted {fitted}, as exported (the verdict's) {exported}"
    return replace(joints, title=f"{joints.title}; {whose}")


def conclude_study(
    fits: Fits,
    options: StudyOptions,
    cutoffs: CutoffSweep | None,
    further: Sequence[Finding] = (),
) -> Study:
    """Make a result of fits, predict with them, and report findings.

    Parameters
    ----------
    fits
        The fits.
    options
        How the study identifies.
    cutoffs
        How the cutoff was chosen, if it was swept.
    further
        Findings of other steps.
    """
    prepared = fits.prepared
    held = (*prepared.held_out, *prepared.validation)
    trained = predict_samples(fits.final, fits.samples)
    validations = predict_held_out(fits)
    cause_data, too_short = _build_cause_data(fits, options.block_seconds)
    train, train_cad = _merge_metrics(fits, trained)
    # As in the verdict, the recording that is predicted worst decides.
    decisive = max(
        validations, key=lambda validation: validation.metrics_as_built.relative_error, default=None
    )
    named = tuple(
        effect for effect in fits.effects.found if options.wanted_effects.named or effect.in_model
    )
    # Bias by effects that are not in the model widens the errors of the result.
    feet = _find_foot_moments(fits)
    of_feet = None if feet is None else feet.omitted(fits.final.information, fits.final.estimate)
    lacking = (fits.final.omitted, _doubt_friction(fits.final), of_feet)
    biases = [bias for bias in lacking if bias is not None]
    omitted = reduce(OmittedBias.with_further, biases) if biases else None
    result = fits.final.with_bias(omitted).concluded(
        train=train,
        cad=train_cad if decisive is None else decisive.metrics_cad,
        validation=[validation.metrics_as_built for validation in validations],
        cause_data=cause_data,
        chain=prepared.chain,
        holdout=prepared.holdout,
        digests=prepared.digests,
        delay=prepared.delay,
        notes=(
            *describe_known_masses(fits.model),
            *(() if cutoffs is None else (f"Cutoff: {cutoffs.why}",)),
            *fits.source.sentences(fits.model),
        ),
        **fits.source.of_result,
        encoders=fits.encoders,
        # Values that have not seen what was held out are stored, for later validation on it.
        trained=fits.validated.estimate.beta if fits.refitted else fits.left_out,
    )
    effects = (
        *(as_identified(effect, fits.final, result) for effect in named),
        *describe_stated(options.wanted_effects.drive, fits.final, result),
    )
    bounded = bound_effects(result, effects)
    result = result.with_effects(tuple(as_by_encoders(effect, result) for effect in bounded))
    attribution = attribute(result) if can_attribute(result) else None
    if attribution and options.wanted_effects.named:
        result = result.with_effects((*result.effects, *attribution.bodies))
    validations = tuple(
        with_exported(result.without_recording(number), prediction, samples)
        if number < len(prepared.held_out)
        else with_exported(
            result.of_training,
            replace(prediction, load=find_carried_load(result.of_training, samples)),
            samples,
        )
        for number, (prediction, samples) in enumerate(zip(validations, held, strict=True))
    )
    findings = (
        *result.findings,
        *(
            Finding("drive_terms", "info", f"{sentence[0].upper()}{sentence[1:]}")
            for sentence in fits.choice.sentences
        ),
        *fits.choice.findings,
        *(
            replace(finding, message=f"{recording_name(check.source)}: {finding.message}")
            for check in prepared.checks
            for finding in check.warnings
        ),
        *report_locks(fits.model),
        *report_delays(result, prepared.delay, fits.final.delay_shift),
        *further,
        *_report_validation(fits, train, validations, further),
        *(
            check_left_out(prepared.training, prepared.motions)
            if prepared.motions
            else check_repetitions(prepared.training, held)
        ),
        *([] if prepared.validation else check_coverage(fits.model, prepared.training)),
        *too_short,
        *report_unexplained(trained),
        *report_nameless(trained, fits.samples),
        *_report_model(fits, result, attribution, options),
        *report_cad_verdicts(validations),
        *report_springs(result),
    )
    if fits.model.mixes_joints:
        from asbuilt.identification.result.legs import (  # noqa: PLC0415 - light start
            with_leg_findings,
        )

        of_moments = () if feet is None else (feet.finding,)
        findings = (*with_leg_findings(findings, result, fits.samples), *of_moments)
    # An effect that is in the model needs no finding that it is missing.
    modelled = {(effect.effect, effect.joint) for effect in result.effects if effect.in_model}
    findings = tuple(
        finding for finding in findings if (finding.effect, finding.joint) not in modelled
    )
    # What was validated decides which joint's error matters, training only without it.
    metrics = (*validations, *trained)[0].metrics_as_built
    shares = dict(zip(metrics.joint_names, measure_error_shares(metrics).tolist(), strict=True))
    return Study(
        result,
        consolidate_findings(findings, shares),
        prepared.checks,
        trained,
        validations,
        cutoffs,
        attribution,
        refined=fits.refined,
    )


def _doubt_friction(fit: Fit) -> OmittedBias | None:
    """Return what friction that depends on load may hide; nothing where errors are textbook's."""
    if fit.uncertainty.basis.asked == "textbook":
        return None
    return doubt_driving_friction(fit.information, fit.estimate)


def _find_foot_moments(fits: Fits) -> FootMoments | None:
    if not fits.model.mixes_joints:
        return None
    from asbuilt.identification.result.legs import (  # noqa: PLC0415 - light start
        find_foot_moments,
    )

    final = fits.final
    return find_foot_moments(fits.model, final.information, final.estimate, fits.samples)


def _report_validation(
    fits: Fits,
    train: TorqueMetrics,
    validations: Sequence[Validation],
    further: Sequence[Finding],
) -> tuple[Finding, ...]:
    """Return findings on validation errors, compared with the training error of the same fit."""
    if not validations and any(finding.code == "nothing_held_out" for finding in further):
        return ()
    # Training errors of the same fit: the final one has seen what is validated.
    of_training = fits.validated.metrics(fits.prepared.training)[0] if fits.refitted else train
    return check_validations(of_training, validations, refitted=fits.refitted)


def _report_model(
    fits: Fits,
    result: IdentificationResult,
    attribution: Attribution | None,
    options: StudyOptions,
) -> tuple[Finding, ...]:
    """Return what the samples say against the model: effects and causes that it lacks."""
    prepared = fits.prepared
    named = options.wanted_effects.named
    shown = [effect for effect in fits.effects.found if named or EFFECTS[effect.effect].of_log]
    return (
        *report_plateaus(fits.model, fits.plateaus),
        # Errors of the log are reported even where no effects are wanted.
        *report_effects(replace(fits.effects, found=tuple(shown))),
        *report_springs_alike(result),
        *([GAINS_ASSUMED] if any(s.torque_source == "current" for s in fits.samples) else []),
        *report_position_noise(
            result,
            fits.samples,
            [check.position_noise for check in prepared.checks],
            prepared.chain.cutoff if prepared.chain else None,
        ),
        *fits.source.findings(fits.model, fits.choice.drive),
        *(fits.refined.findings() if fits.refined else ()),
        # Without CAD masses there is nothing that could have caused a difference.
        *(report_causes(attribution, fits.model) if fits.model.has_masses else ()),
    )


def _merge_metrics(
    fits: Fits, predictions: Sequence[Validation]
) -> tuple[TorqueMetrics, TorqueMetrics]:
    """Return the metrics of several predictions together, as built and by CAD."""
    as_built, by_cad = (TorqueTally(fits.model.joint_names) for _ in range(2))
    for prediction in predictions:
        as_built.add(prediction.measured, prediction.predicted)
        by_cad.add(prediction.measured, prediction.predicted_cad)
    source = ", ".join(fits.final.information.sources)
    return as_built.metrics(source), by_cad.metrics(source)


def _build_cause_data(
    fits: Fits, block_seconds: float | None
) -> tuple[CauseData | None, tuple[Finding, ...]]:
    """Return what causes are weighed by, or a finding that the recordings are too short for it."""
    prepared = fits.prepared
    held = (*prepared.held_out, *prepared.validation)
    # The first motion that is left out tests the causes that the others show.
    first = prepared.motions[0] if prepared.motions else ()
    used = [samples for number, samples in enumerate(prepared.training) if number not in first]
    try:
        return gather_cause_data(
            fits.model,
            fits.final.base,
            used,
            held[:1],
            block_seconds=block_seconds,
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
