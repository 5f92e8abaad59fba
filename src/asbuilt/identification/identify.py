"""Identification of base parameters from prepared samples."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from asbuilt.arrays import Array, Indices
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import BaseParameters, find_base_parameters
from asbuilt.dynamics.drives.drive_set import NO_DRIVE, DriveSet
from asbuilt.errors import UsageError
from asbuilt.experiment.signal.samples import Samples
from asbuilt.findings import Finding
from asbuilt.identification.bodies.cad_prior import design_values
from asbuilt.identification.drives.nonlinear_parameters import (
    NonlinearErrors,
    NonlinearFit,
    NonlinearPlace,
    estimate_nonlinear_errors,
    fit_nonlinear,
)
from asbuilt.identification.estimators.least_squares import (
    estimate_wls,
    fit_least_squares,
    refuse_few_rows,
)
from asbuilt.identification.estimators.methods import methods
from asbuilt.identification.information.estimate import Estimate, EstimationData, Undetermined
from asbuilt.identification.information.rows import KeptRows
from asbuilt.identification.information.square_root_information import (
    SquareRootInformation,
    accumulate_stream,
)
from asbuilt.identification.result.as_built_parameters import as_built_parameters
from asbuilt.identification.result.estimate_to_result import conclude
from asbuilt.identification.result.result import IdentificationResult
from asbuilt.identification.result.torque_prediction import (
    TorqueMetrics,
    TorqueTally,
    predict_torque,
    set_link_parameters,
)
from asbuilt.identification.uncertainty.bias import OmittedBias
from asbuilt.identification.uncertainty.delay_errors import DelayErrors, estimate_delay_errors
from asbuilt.identification.uncertainty.error_kinds import ERROR_KINDS, ErrorKind
from asbuilt.identification.uncertainty.uncertainty import (
    Uncertainty,
    estimate_block_uncertainty,
    estimate_bootstrap_uncertainty,
    estimate_textbook_uncertainty,
    redraw,
)

if TYPE_CHECKING:
    from asbuilt.identification.uncertainty.pose_noise import MeanScores, PoseNoise

# Say when friction that depends on load has settled: own choice, tested on virtual robots.
#
# `LOAD_MOST` fits are made; `LOAD_CONVERGENCE` is the fraction by which a fit must lower some
# joint's squared error for another one to follow.

LOAD_MOST = 6
LOAD_CONVERGENCE = 1e-4

NOISE_TAKEN_AWAY = "What noise of the pose lends the parameters was taken away."


class FitErrors(NamedTuple):
    """Hold the errors of a fit: of its parameters, and what else adds to them, with notes."""

    uncertainty: Uncertainty
    nonlinear: NonlinearErrors | None = None
    delay: DelayErrors | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """Hold base parameters estimated from samples, before anything is predicted from them.

    `errors` are found when they are first asked for. `of_kind` gives the fit of another kind to the
    same equations, if the estimator chose among some and has kept what it compared.
    """

    model: RobotModel
    information: SquareRootInformation
    estimate: Estimate
    errors: Callable[[], FitErrors]
    design: Array
    rate: float
    provenance: tuple[str, ...]
    findings: tuple[Finding, ...]
    omitted: OmittedBias | None = None
    of_kind: Callable[[str], Fit] | None = None
    derived: dict[Any, Any] = field(default_factory=dict, init=False)
    """What results of it remember: any change of the fit begins anew."""

    @property
    def base(self) -> BaseParameters:
        """The base parameters."""
        return self.information.base

    @property
    def uncertainty(self) -> Uncertainty:
        """The errors of the parameters by the fit alone."""
        return self.errors().uncertainty

    def with_errors(self, **changed: Any) -> Fit:
        """Return the fit with other errors, by the names of `FitErrors`."""
        return replace(self, errors=partial(self.errors()._replace, **changed))

    def alone(self) -> Fit:
        """Return the fit without what other kinds would need, which takes memory."""
        found = replace(self, of_kind=None, estimate=replace(self.estimate, of_kind=None))
        # The values and their errors are the same.
        found.derived.update(self.derived)
        return found

    def with_bias(self, omitted: OmittedBias | None) -> Fit:
        """Return the fit with the bias by effects that the model lacks: errors alone change."""
        if omitted is self.omitted:
            return self
        found = replace(self, omitted=omitted)
        # The exported robot has the values of the fit, whatever their bias.
        exported = {key: kept for key, kept in self.derived.items() if as_built_parameters in key}
        found.derived.update(exported)
        return found

    def without(self, sources: Collection[str], undetermined: Undetermined) -> Array | None:
        """Return the base parameters (p,) without some recordings, from the block factors alone.

        What the estimator chose, such as its weight of CAD or the weights of rows, is held fixed.
        None for an estimator that needs the samples again.

        Raises
        ------
        IdentifiabilityError
            If too little is left.
        """
        own = self.estimate.information or self.information
        method = self.estimate.method
        kept = own.select([b for b, block in enumerate(own.blocks) if block.source not in sources])
        refuse_few_rows(kept)
        if self.estimate.refit is not None:
            return self.estimate.refit(kept.stacked(self.estimate.weights))
        if methods.find(method).needs == "information":
            data = EstimationData(self.model, kept, None, self.design, undetermined)
            return methods.find(method).estimate(data).beta
        if self.estimate.information is None:
            return None
        weights = self.estimate.weights
        return fit_least_squares(kept, weights=weights, prior=self.design).beta

    def next_to_omitted(self, places: Indices) -> tuple[Array, Array]:
        """Return parameters (m,) next to effects that the model lacks, and their covariance (m, m).

        The result's own values have the bias by those effects, and its square in their errors.
        """
        values = self.estimate.beta[places]
        errors = self.errors()
        added = (errors.nonlinear, errors.delay, self.omitted)
        further = [each.covariance for each in added if each is not None]
        covariance = sum(further, errors.uncertainty.covariance)[np.ix_(places, places)]
        if self.omitted is None:
            return values, covariance
        bias = self.omitted.bias[places]
        return values - bias, covariance - np.outer(bias, bias)

    @property
    def delay_shift(self) -> Array | None:
        """What the estimated delays would move parameters by if not applied, (p,)."""
        delay = self.errors().delay
        return None if delay is None else delay.shift

    def metrics(self, samples: Sequence[Samples]) -> tuple[TorqueMetrics, TorqueMetrics]:
        """Return the torque metrics of all samples together, as built and of the CAD values."""
        source = ", ".join(self.information.sources)

        def measure(beta: Array) -> TorqueMetrics:
            tally = TorqueTally(self.model.joint_names)
            for batch in samples:
                prediction = predict_torque(self.model, self.base, beta, batch)
                tally.add(prediction.measured, prediction.predicted)
            return tally.metrics(source)

        return measure(self.estimate.beta), measure(np.nan_to_num(self.design, nan=0.0))

    def concluded(
        self,
        train: TorqueMetrics | None = None,
        cad: TorqueMetrics | None = None,
        notes: Sequence[str] = (),
        **further: Any,
    ) -> IdentificationResult:
        """Return the result with torque metrics, notes and `further` arguments of `conclude`."""
        errors = self.errors()
        return conclude(
            self.model,
            self.information,
            self.estimate,
            rate=self.rate,
            train=train,
            cad=cad,
            provenance=self.provenance,
            uncertainty=errors.uncertainty,
            nonlinear=errors.nonlinear,
            delayed=errors.delay,
            omitted=self.omitted,
            notes=(*errors.notes, *notes),
            findings=self.findings,
            **further,
        ).remembering(self.derived)


def identify_samples(
    model: RobotModel,
    samples: Samples | Sequence[Samples],
    *,
    drive: DriveSet = NO_DRIVE,
    method: str = "wls",
    base: BaseParameters | None = None,
    undetermined: Undetermined = "toward_prior",
    errors: ErrorKind = "blocks",
    block_seconds: float | None = None,
    threads: int | None = None,
    fitted_nonlinear: Sequence[NonlinearPlace] = (),
) -> IdentificationResult:
    """Identify the base parameters of a robot from the samples of one or more recordings.

    Parameters
    ----------
    model
        The robot by design.
    samples
        Prepared samples, of one recording or several.
    drive
        Drive terms. Nonlinear parameters that are not stated are fitted first.
    method
        Name of an estimator of `methods`, such as `"wls"` with a weight for each joint.
    base
        Base parameters, in place of `drive`, with every nonlinear parameter stated.
    undetermined
        Directions that the samples do not excite keep their CAD values, or are refused.
    errors
        Standard errors from time blocks by formula, from time blocks drawn with replacement
        (`"bootstrap"`, the choices of the estimator held fixed), or as if residuals were
        independent (`"textbook"`).
    block_seconds
        Length of the time blocks [s]; None: 5 s, less in short recordings.
    threads
        Threads of the kernels; None: all cores if that pays.
    fitted_nonlinear
        Those nonlinear parameters of `base` that were fitted to these samples, so that standard
        errors allow for it.

    Returns
    -------
    IdentificationResult
        Estimates with standard errors, CAD values, and torque metrics on the samples.

    Raises
    ------
    IdentifiabilityError
        If there are too few samples, or some direction is not excited and refused.
    UsageError
        If no samples are given, or there is no such estimator or kind of errors.
    """
    batches = list(samples) if isinstance(samples, Sequence) else [samples]
    fit = fit_samples(
        model,
        batches,
        drive=drive,
        method=method,
        base=base,
        undetermined=undetermined,
        errors=errors,
        block_seconds=block_seconds,
        threads=threads,
        fitted_nonlinear=fitted_nonlinear,
    )
    return fit.concluded(*fit.metrics(batches))


def fit_samples(
    model: RobotModel,
    samples: Sequence[Samples],
    *,
    drive: DriveSet = NO_DRIVE,
    method: str = "wls",
    base: BaseParameters | None = None,
    undetermined: Undetermined = "toward_prior",
    errors: ErrorKind = "blocks",
    block_seconds: float | None = None,
    threads: int | None = None,
    fitted_nonlinear: Sequence[NonlinearPlace] = (),
    expected: MeanScores | None = None,
    kept: KeptRows | None = None,
    kind: str = "",
) -> Fit:
    """Estimate base parameters and their errors; arguments as for `identify_samples`.

    Scores that are expected of the true parameters are taken away (`expected`). Rows are shared
    with others by `kept`. An estimator that chooses among kinds of fits makes `kind` alone.
    """
    if errors not in ERROR_KINDS:
        raise UsageError(f"errors {errors!r} is not one of {', '.join(ERROR_KINDS)}")
    if not samples:
        raise UsageError(f"no samples are given to identify {model.name} from; give at least one")
    estimator = methods.find(method)
    kept = kept or KeptRows()
    fitted: NonlinearFit | None = None
    if base is None and not drive.is_linear:
        fitted = fit_nonlinear(model, drive, samples)
        drive = fitted.drive
        fitted_nonlinear = fitted.places
    base = base or find_base_parameters(model, drive)
    design = design_values(model, base)

    def accumulate(loading: RobotModel) -> SquareRootInformation:
        return accumulate_stream(
            loading, base, samples, block_seconds=block_seconds, threads=threads, kept=kept
        )

    seen = accumulate(model)
    of_pose: PoseNoise | None = None
    if expected is None and any(any(sample.pose_noise) for sample in samples):
        from asbuilt.identification.uncertainty.pose_noise import (  # noqa: PLC0415 - light start
            expect_pose_noise,
        )

        of_pose = expect_pose_noise(model, base, samples, seen)
        expected = of_pose.scores
        of_pose = of_pose if expected is not None else None

    def reduce(seen: SquareRootInformation, loading: RobotModel | None = None) -> EstimationData:
        less = () if expected is None else expected.torques(seen)
        return EstimationData(
            model,
            seen.less(less) if less else seen,
            samples,
            design,
            undetermined,
            block_seconds,
            loading=loading,
            less=less,
            kept=kept,
            kind=kind,
        )

    data = reduce(seen)
    if base.drive.needs_load:
        data = _settle_own_load(data, lambda loading: reduce(accumulate(loading), loading))
    conclusion = _Conclusion(
        data, design, samples, errors, method, fitted_nonlinear, of_pose, fitted
    )
    return conclusion.of(estimator.estimate(data))


@dataclass(frozen=True, slots=True, eq=False)
class _Conclusion:
    """Conclude estimates from one set of equations: what else a fit holds is derived from them."""

    data: EstimationData
    design: Array
    samples: Sequence[Samples]
    errors: ErrorKind
    method: str
    fitted_nonlinear: Sequence[NonlinearPlace]
    of_pose: PoseNoise | None
    fitted: NonlinearFit | None

    def of(self, estimate: Estimate) -> Fit:
        """Return the fit of an estimate."""
        model = self.data.model
        own = self.fitted
        first = self.samples[0]
        of_kind = estimate.of_kind
        # Errors need neither rows that are kept nor other kinds of fits.
        lean = replace(self, data=replace(self.data, kept=None))
        provenance = tuple(dict.fromkeys(line for each in self.samples for line in each.provenance))
        return Fit(
            model=model,
            information=self.data.information,
            estimate=estimate,
            errors=cache(partial(lean.find_errors, replace(estimate, of_kind=None))),
            design=self.design,
            rate=first.parallel.output_rate if first.parallel else first.rate,
            provenance=provenance + (own.sentences(model.joint_names) if own else ()),
            findings=own.findings(model.joint_names) if own else (),
            of_kind=None if of_kind is None else lambda kind: self.of(of_kind(kind)),
        )

    def find_errors(self, estimate: Estimate) -> FitErrors:
        """Return the errors of an estimate."""
        nonlinear = self._estimate_nonlinear_errors(estimate)
        delay = estimate_delay_errors(
            self._find_loading(estimate),
            self.data.base,
            estimate,
            self.samples,
            textbook=self.errors == "textbook",
            block_seconds=self.data.block_seconds,
        )
        sentences = () if nonlinear is None else (nonlinear.sentence(self.data.model.joint_names),)
        taken_away = () if self.of_pose is None else (NOISE_TAKEN_AWAY,)
        uncertainty = self._estimate_uncertainty(estimate)
        return FitErrors(uncertainty, nonlinear, delay, (*sentences, *taken_away))

    def _find_loading(self, estimate: Estimate) -> RobotModel:
        """Return the robot whose torque loads friction."""
        data = self.data
        if not data.base.drive.needs_load:
            return data.model
        return set_link_parameters(data.model, data.base, estimate.beta)

    def _estimate_nonlinear_errors(self, estimate: Estimate) -> NonlinearErrors | None:
        if not self.fitted_nonlinear:
            return None
        return estimate_nonlinear_errors(
            self._find_loading(estimate),
            self.data.base,
            estimate,
            self.samples,
            self.fitted_nonlinear,
            textbook=self.errors == "textbook",
            block_seconds=self.data.block_seconds,
        )

    def _estimate_uncertainty(self, estimate: Estimate) -> Uncertainty:
        information = self.data.information
        found = _estimate_uncertainty(
            information, estimate, self.errors, automatic=self.method == "auto"
        )
        if self.of_pose is None or self.of_pose.scores is None:
            return found
        grown = found.covariance * np.outer(self.of_pose.growth, self.of_pose.growth)
        grown += self.of_pose.scores.doubt(information, estimate)
        return replace(found, covariance=grown)


def _estimate_uncertainty(
    information: SquareRootInformation, estimate: Estimate, errors: ErrorKind, *, automatic: bool
) -> Uncertainty:
    information = estimate.information or information
    if errors == "textbook":
        return estimate_textbook_uncertainty(information, estimate)
    if errors == "blocks":
        return estimate_block_uncertainty(information, estimate)
    uncertainty = estimate_bootstrap_uncertainty(
        information, estimate, redraw(information, estimate)
    )
    held = (
        *([f"the choice of {estimate.method}"] if automatic else []),
        *uncertainty.basis.held_fixed,
        *(["the load on friction"] if information.base.drive.needs_load else []),
    )
    return replace(uncertainty, basis=replace(uncertainty.basis, held_fixed=held))


def _settle_own_load(
    data: EstimationData, reduce: Callable[[RobotModel], EstimationData]
) -> EstimationData:
    """Repeat least squares until friction depends on the load that they find, not on CAD's load.

    The load at the samples of the log is what they measured, whatever the masses behind it: an
    estimator that chooses among masses has nothing to add.
    """
    beta = estimate_wls(data).beta
    least = data.information.residual_energy(beta)
    for _ in range(LOAD_MOST):
        data = reduce(set_link_parameters(data.model, data.base, beta))
        beta = estimate_wls(data).beta
        energy = data.information.residual_energy(beta)
        if np.all(energy > (1.0 - LOAD_CONVERGENCE) * least):
            break
        least = np.minimum(energy, least)
    return data
