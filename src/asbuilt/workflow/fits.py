"""Fits of a study: without what is held out, at once or in turn, for the verdict; and the last."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics import DriveSet, find_base_parameters
from asbuilt.errors import IdentifiabilityError, UsageError
from asbuilt.experiment.signal.samples import Samples
from asbuilt.identification.calibration.encoders import (
    EncoderPair,
    identify_encoders,
    refer_to_links,
    with_friction_errors,
)
from asbuilt.identification.drives.drive_choice import (
    DriveChoice,
    list_drive_effects,
    select_stated_drive,
    settle_nonlinear,
)
from asbuilt.identification.effects.effect import EFFECTS
from asbuilt.identification.effects.effect_findings import is_sure, list_term_places
from asbuilt.identification.effects.families.drive_terms import drop_terms, takes_place_of_simpler
from asbuilt.identification.effects.families.tilt import Tilt
from asbuilt.identification.effects.plateaus import Plateau, drop_plateaus, find_plateaus
from asbuilt.identification.effects.search import Effects, find_effects
from asbuilt.identification.identify import Fit, fit_samples
from asbuilt.identification.information.rows import KeptRows
from asbuilt.identification.result.feasible import list_open
from asbuilt.validation.prediction import Validation, predict_both, predict_friction_torque
from asbuilt.workflow.prepare import Prepared, Progress
from asbuilt.workflow.study_options import StudyOptions
from asbuilt.workflow.tested_choice import LeftOut
from asbuilt.workflow.torque_source import TorqueOrigin

if TYPE_CHECKING:
    from asbuilt.workflow.refinement import Refined
    from asbuilt.workflow.rollout import SimulatedParts

ADDED = (
    "Stribeck friction was added since the simulated motion calls for it; simulators whose dry"
    " friction is one number are served better by a fit without it: state the drive terms"
)


@dataclass(frozen=True, slots=True, eq=False)
class Fits:
    """Hold the fits of a study and what was chosen for them.

    Attributes
    ----------
    model
        The robot, its gravity as estimated if that was asked for.
    prepared
        The samples; not divided if that had left too little to fit.
    final, validated
        The fit whose values are the result, and the fit that validation data are predicted by; one
        and the same unless the final one has seen what was held out.
    left_out
        Where whole recordings are left out in turn, the base parameters (m, p) without each; None
        otherwise.
    choice
        The drive terms, chosen on what the final fit uses.
    effects
        What the recordings show and the description lacks.
    plateaus
        Torques that saturate.
    source
        Where the torques come from.
    refined
        The refinement, if any.
    encoders
        What lies between two encoders of joints that have them.
    """

    model: RobotModel
    prepared: Prepared
    final: Fit
    validated: Fit
    choice: DriveChoice
    effects: Effects
    plateaus: tuple[Plateau, ...]
    source: TorqueOrigin
    refined: Refined | None
    encoders: tuple[EncoderPair, ...] = ()
    left_out: Array | None = None

    @property
    def samples(self) -> tuple[Samples, ...]:
        """The samples of the final fit."""
        return self.prepared.whole or self.prepared.training

    @property
    def refitted(self) -> bool:
        """Whether the final fit is of more data than the one that is validated."""
        return self.final is not self.validated


def fit_study(
    model: RobotModel,
    prepared: Prepared,
    options: StudyOptions,
    source: TorqueOrigin,
    parts: SimulatedParts | None,
    report: Progress,
) -> Fits:
    """Find the effects that the description lacks, and fit.

    What was held out by default is not if the rest is too short to fit.

    Parameters
    ----------
    model
        The robot.
    prepared
        The samples.
    options
        How to identify.
    source
        Where the torques come from.
    parts
        What a refinement simulates; None without one.
    report
        Called with the name of a step and the fraction done.
    """

    def fitted(prepared: Prepared) -> Fits:
        return _fit_all(model, prepared, options, source, parts, report)

    fits = _fit_divided_or_whole(fitted, prepared)
    if all(samples.encoder is None for samples in fits.samples):
        return fits
    pairs = _identify_encoders(fits, fits.samples)
    if not any(pair.determined for pair in pairs):
        return replace(fits, encoders=pairs)
    # Links that move by their own encoder are other samples, with effects of their own.
    stiff = _fit_divided_or_whole(fitted, _move_to_link(prepared, pairs, fits.final))
    # Stiff drives must predict better: a second encoder may be the worse one.
    if _measure_squared_error(stiff) >= _measure_squared_error(fits):
        return replace(fits, encoders=pairs)
    # Compliance is told from the samples as they were, whose encoders still differ.
    return replace(stiff, encoders=_identify_encoders(stiff, fits.samples))


def _fit_divided_or_whole(fitted: Callable[[Prepared], Fits], prepared: Prepared) -> Fits:
    """Fit without what was held out by default, if that leaves enough."""
    if prepared.whole or prepared.motions:
        try:
            return fitted(prepared)
        except IdentifiabilityError:
            # Nothing is held out then, since what is left would determine nothing.
            training = prepared.whole or prepared.training
            prepared = replace(
                prepared, training=training, held_out=(), whole=(), motions=(), holdout=None
            )
    return fitted(prepared)


def _measure_squared_error(fits: Fits) -> float:
    """Return the mean squared relative error on what was held out, else on what was fitted."""
    predicted = predict_held_out(fits) or predict_samples(fits.validated, fits.prepared.training)
    return float(
        np.mean([prediction.metrics_as_built.relative_error**2 for prediction in predicted])
    )


def _identify_encoders(fits: Fits, samples: Sequence[Samples]) -> tuple[EncoderPair, ...]:
    """Return what lies between two encoders, by the friction that was identified."""
    fit = fits.final
    samples = [batch.compact() for batch in samples]
    taken = [_predict_friction(fit, batch) for batch in samples]
    pairs = identify_encoders(samples, [joint.is_revolute for joint in fit.model.joints], taken)
    errors = np.sqrt(np.diag(fit.uncertainty.covariance))
    named = dict(zip(fit.base.names, errors.tolist(), strict=True))
    numbers = [fit.model.joint_names.index(pair.joint) + 1 for pair in pairs]
    viscous, dry = (
        # Friction by direction or without: the larger error of either counts.
        [max(named.get(f"{symbol}{k}", 0.0) for symbol in symbols) for k in numbers]
        for symbols in (("Fv",), ("Fc", "Fct"))
    )
    return with_friction_errors(pairs, viscous, dry)


def _predict_friction(fit: Fit, samples: Samples) -> Array:
    """Return the friction of the drives as a fit has it, (N, n)."""
    return predict_friction_torque(fit.model, fit.base, fit.estimate.beta, samples)


def _move_to_link(prepared: Prepared, pairs: Sequence[EncoderPair], fit: Fit) -> Prepared:
    """Return samples of the robot with stiff drives."""

    def moved(samples: Sequence[Samples]) -> tuple[Samples, ...]:
        return tuple(
            refer_to_links(batch, pairs, partial(_predict_friction, fit)) for batch in samples
        )

    return replace(
        prepared,
        training=moved(prepared.training),
        held_out=moved(prepared.held_out),
        validation=moved(prepared.validation),
        others=tuple(map(moved, prepared.others)),
        whole=moved(prepared.whole),
    )


def _fit_all(
    model: RobotModel,
    prepared: Prepared,
    options: StudyOptions,
    source: TorqueOrigin,
    parts: SimulatedParts | None,
    report: Progress,
) -> Fits:
    # Effects are sought in what the final fit uses, so that holding out changes no value.
    used = prepared.whole or prepared.training
    # Rows are the same in search and fit: they are kept between both.
    kept = KeptRows()
    model, choice, effects, flat = _add_effects(model, prepared, options, kept)

    fitter = _Fitter(model, options, source, kept)
    if options.refine is None or parts is None:
        settled = _settle_fits(fitter, prepared, choice, effects)
        left_out = _leave_out(
            settled.final,
            prepared,
            options,
            lambda others: fitter.fit(others, settled.choice, settled.kind),
        )
        return Fits(
            model,
            prepared,
            settled.final,
            settled.validated,
            settled.choice,
            settled.effects,
            flat,
            source,
            None,
            left_out=left_out,
        )
    from asbuilt.workflow.refinement import refine_study  # noqa: PLC0415 - light start

    final, source, refined, drive = refine_study(
        lambda drive: fitter.fit(used, choice, drive=drive),
        choice.drive,
        parts,
        source,
        options.rollout,
        report,
        # Terms that are stated are not chosen among.
        choose=not isinstance(options.drive, DriveSet),
    )
    if drive is not choice.drive:
        choice = replace(choice, drive=drive, sentences=(*choice.sentences, ADDED))
    known = [(delay.source, delay.digest) for delay in prepared.delay]
    prepared = source.with_delays(prepared, known)
    # Fits of other kinds would be those before the refinement.
    final = _with_omitted_bias(final.alone(), effects)
    return Fits(model, prepared, final, final, choice, effects, flat, source, refined)


@dataclass(frozen=True, slots=True, eq=False)
class _Fitter:
    """Fit samples as a study asks for it; its fits share the rows that are `kept`."""

    model: RobotModel
    options: StudyOptions
    source: TorqueOrigin
    kept: KeptRows

    def fit(
        self,
        samples: Sequence[Samples],
        choice: DriveChoice,
        kind: str = "",
        drive: DriveSet | None = None,
        known: Fit | None = None,
    ) -> Fit:
        """Return the fit with the drive terms of a choice, or with others, by a kind of fit.

        A fit of the same samples and terms that is `known` has computed what its other kinds need.
        """
        if known is not None and known.of_kind is not None:
            fit = known.of_kind(kind)
        else:
            terms = choice.drive if drive is None else drive
            options = self.options
            fit = fit_samples(
                self.model,
                samples,
                base=find_base_parameters(self.model, terms),
                method=options.method,
                undetermined=options.undetermined,
                errors=options.errors,
                block_seconds=options.block_seconds,
                threads=options.threads,
                fitted_nonlinear=[place for place in choice.fitted if place.is_of(terms)],
                expected=self.source.expected,
                kept=self.kept,
                kind=kind,
            )
        provenance = (*fit.provenance, *choice.sentences)
        return self.source.with_errors(replace(fit, provenance=provenance))


@dataclass(frozen=True, slots=True, eq=False)
class _Settled:
    """Hold the final fit, the one that is validated, and the effects and kind of fit they have."""

    final: Fit
    validated: Fit
    choice: DriveChoice
    effects: Effects
    kind: str


def _settle_fits(
    fitter: _Fitter,
    prepared: Prepared,
    choice: DriveChoice,
    effects: Effects,
) -> _Settled:
    """Fit, and drop the effects that the fits do not bear out.

    An effect goes if the final fit is not sure of it, if what was left out is predicted better
    without it, or if nothing shows it. One that goes can take another with it: asked until every
    effect that is left stays.
    """
    kind = ""
    needed = set[tuple[str, str]]()
    final: Fit | None = None
    validated: Fit | None = None
    measured = fitter.source.is_measured
    while True:
        final = _with_omitted_bias(
            fitter.fit(prepared.whole or prepared.training, choice, kind, known=final), effects
        )
        needless = _list_unsure(final, effects)
        if not needless:
            # A second fit only where the final one sees what validation is to predict.
            if prepared.whole:
                validated = fitter.fit(prepared.training, choice, kind, known=validated)
            else:
                validated = final
            # Torques that were computed cannot test.
            test = LeftOut.of(validated, prepared) if measured else None
            needless = set() if test is None else test.list_harmful(effects.found)
            # Once: what was left out decides between kinds of fits, and then has decided.
            if not (needless or kind or test is None):
                kind = test.find_better_kind()
                if kind:
                    continue
            if not needless and measured:
                # Like is compared with like, and one kind of fit takes less time than all.
                own = kind or validated.estimate.kind
                refit = partial(fitter.fit, prepared.training, choice, own)
                find_test = partial(_find_test, validated, prepared, test)
                needless = _find_unshown(final, effects, needed, find_test, refit)
            if not needless:
                alone = final.alone()
                other = alone if validated is final else validated.alone()
                return _Settled(alone, other, choice, effects, kind)
        effects = effects.without(needless)
        choice = choice.without(needless, final.model.joint_names)
        final = None
        validated = None


def _with_omitted_bias(fit: Fit, effects: Effects) -> Fit:
    """Return a fit whose errors have the bias by effects that the model lacks."""
    lacking = effects.lacking
    return fit if lacking is None else replace(fit, omitted=lacking.bias(fit))


def _list_unsure(fit: Fit, effects: Effects) -> set[tuple[str, str]]:
    """Return key and joint of effects that a fit of everything leaves under two standard errors.

    The search is sure of them next to bodies near CAD; the final fit may hold bodies less. Values
    are next to all others, those that the model lacks too.
    """
    tested = list_term_places(effects.found, fit.base, fit.model.joint_names)
    return {
        (effect.effect, str(effect.joint))
        for effect, places in tested
        if not is_sure(*fit.next_to_omitted(places))
    }


def _find_unshown(
    final: Fit,
    effects: Effects,
    needed: set[tuple[str, str]],
    find_test: Callable[[], LeftOut | None],
    refit: Callable[[DriveSet], Fit],
) -> set[tuple[str, str]]:
    """Return key and joint of an effect that nothing shows, the last one found first; else none.

    Shown is an effect without which what was left out is predicted worse. It is asked of those that
    are zero in some consistent bodies near the estimate, and of terms in place of simpler ones.
    `needed` were shown before; `refit` fits with other drive terms. `find_test` returns None where
    too little is left out: then a term that may be zero leaves its place to the simpler one, and
    what has no simpler one stays, since the search is sure of it next to bodies near CAD. On ten
    seconds of a KR300 its balancer is such an effect, and without it another motion is predicted by
    a third worse.
    """
    names = final.model.joint_names
    in_drive = [effect for effect in effects.found if effect.effect in final.base.drive.keys]
    open_ones = list(list_open(final.concluded(), in_drive)) if in_drive else []
    asked = [
        effect
        for effect in reversed(in_drive)
        if (effect.effect, str(effect.joint)) not in needed
        and (effect in open_ones or takes_place_of_simpler(effect))
    ]
    test = find_test() if asked else None
    for effect in asked:
        place = (effect.effect, str(effect.joint))
        if test is None:
            unshown = effect in open_ones and takes_place_of_simpler(effect)
        else:
            without = refit(drop_terms(final.base.drive, {place}, names))
            unshown = bool(test.measure_gain_over(without).mean() <= 0.0)
        if unshown:
            return {place}
        needed.add(place)
    return set()


def _find_test(fit: Fit, prepared: Prepared, test: LeftOut | None) -> LeftOut | None:
    """Return the test by other motion, else by what repeats the motion fitted, or None."""
    return test or LeftOut.of(fit, prepared, even_repeated=True)


def _leave_out(
    final: Fit,
    prepared: Prepared,
    options: StudyOptions,
    fit_others: Callable[[Sequence[Samples]], Fit],
) -> Array | None:
    """Return the base parameters (m, p) without each recording, and others of its motion."""
    if not prepared.motions:
        return None
    rows = np.zeros((len(prepared.training), len(final.estimate.beta)))
    for motion in prepared.motions:
        left = {prepared.training[number].source for number in motion}
        beta = final.without(left, options.undetermined)
        # Without these rows the factor is at hand for most estimators; others fit again.
        if beta is None:
            others = [batch for batch in prepared.training if batch.source not in left]
            beta = fit_others(others).estimate.beta
        rows[list(motion)] = beta
    return rows


def _add_effects(
    model: RobotModel, prepared: Prepared, options: StudyOptions, kept: KeptRows
) -> tuple[RobotModel, DriveChoice, Effects, tuple[Plateau, ...]]:
    """Return the robot with the effects that are wanted, its drive terms, and what was found.

    They are chosen on what the final fit uses, so that holding out by default changes no value; the
    part that an explicit rule holds out is not used.
    """
    wanted = options.wanted_effects
    samples = prepared.whole or prepared.training
    drive = select_stated_drive(model, samples, options.drive)
    for term in wanted.drive.terms:
        drive = drive.with_term(term)
    effects = Effects(model, drive)
    flat = tuple[Plateau, ...]()
    stated = {Tilt.key} if options.mounting == "estimate" or wanted.tilt else set()
    if stated and model.mixes_joints:
        raise UsageError(f"{model.name} has a free base: the log has its tilt, state none")
    # A command's torque is computed: what a log could lack is sought only if asked for.
    open_to_all = not samples[0].has_computed_torque or isinstance(options.drive, str)
    if not model.mixes_joints and (open_to_all or stated):
        flat = (
            find_plateaus(model, drive, samples, options.block_seconds, kept) if open_to_all else ()
        )
        effects = find_effects(
            model,
            drive,
            # Saturated torques would pass for effects of their own.
            drop_plateaus(samples, flat),
            keys=None if open_to_all else stated,
            applied=_list_open_effects(model, options) | stated,
            stated=stated,
            kept=kept,
        ).beside_plateaus({model.joint_names[plateau.joint] for plateau in flat})
    choice = settle_nonlinear(effects.model, samples, effects.drive)
    choice = replace(choice, fitted=(*effects.fitted, *choice.fitted))
    return effects.model, choice, effects, flat


def _list_open_effects(model: RobotModel, options: StudyOptions) -> set[str]:
    """Return the keys of the effects that may become part of the model.

    Drive terms that are stated, by the user or the description, leave no others open.
    """
    every = options.wanted_effects.choice == "auto"
    keys = set(EFFECTS if every else list_drive_effects())
    # A description with usual terms states them as a user does.
    stated = isinstance(options.drive, DriveSet) or (model.usual_drive and not options.drive)
    if stated or not (every or options.drive):
        keys -= set(list_drive_effects(by_construction=True))
    return keys


def predict_held_out(fits: Fits) -> tuple[Validation, ...]:
    """Predict what was held out by values that have not seen it, then other recordings."""
    held = fits.prepared.held_out
    others = fits.prepared.validation
    if fits.left_out is None:
        return predict_samples(fits.validated, (*held, *others))
    fit = fits.final
    left_out = tuple(
        predict_both(fit.model, fit.base, beta, fit.design, held_out)
        for beta, held_out in zip(fits.left_out, held, strict=True)
    )
    return (*left_out, *predict_samples(fit, others))


def predict_samples(fit: Fit, samples: Sequence[Samples]) -> tuple[Validation, ...]:
    """Predict samples by a fit, and by CAD."""
    return tuple(
        predict_both(fit.model, fit.base, fit.estimate.beta, fit.design, batch) for batch in samples
    )
