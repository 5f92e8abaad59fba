"""From samples to a result: the one call that this room exists for."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import BaseParameters, find_base_parameters
from asbuilt.dynamics.drives.selection import NO_DRIVE, DriveSet
from asbuilt.dynamics.parameters import parameter_values
from asbuilt.errors import IdentifiabilityError, UsageError
from asbuilt.identification.bodies.consistency import (
    consistency_margin,
    margin_is_consistent,
    non_passive_drives,
)
from asbuilt.identification.drives.nonlinear_parameters import fit_nonlinear
from asbuilt.identification.errors.bootstrap import bootstrap_uncertainty, redraw
from asbuilt.identification.errors.error_basis import ERROR_KINDS, TELLING_GROWTH, ErrorKind
from asbuilt.identification.errors.nonlinear_errors import (
    NonlinearErrors,
    NonlinearPlace,
    nonlinear_errors,
)
from asbuilt.identification.errors.uncertainty import (
    Uncertainty,
    block_uncertainty,
    textbook_uncertainty,
)
from asbuilt.identification.estimators.least_squares import LARGE_CONDITION, Estimate
from asbuilt.identification.estimators.methods import methods
from asbuilt.identification.information.estimation_data import EstimationData, Undetermined
from asbuilt.identification.information.square_root_information import (
    SquareRootInformation,
    accumulate_stream,
)
from asbuilt.identification.result.free_values import free_values
from asbuilt.identification.result.metrics import TorqueMetrics, TorqueTally
from asbuilt.identification.result.result import (
    IdentificationResult,
    IdentificationWarning,
    IdentifiedParameter,
)
from asbuilt.identification.result.torque_prediction import carrying, predict_torque
from asbuilt.tables import plus_minus

if TYPE_CHECKING:
    from asbuilt.experiment.signal.samples import Samples


POOR_RELATIVE_ERROR = 0.5
"""A standard error of this fraction of the larger of estimate and CAD value is poor,"""
POOR_TORQUE = 0.05
"""if the torque it stands for is this fraction of the residual.

Below, the parameter hardly matters in this motion.
"""
LOAD_ITERATIONS = 6
LOAD_CONVERGENCE = 1e-4
"""Friction that depends on load is settled where renewing the load lowers no joint's squared error
by more than this fraction.
"""


def identify(
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

    Nonlinear parameters of `drive` that are not stated are fitted first. `base` saves finding the base parameters
    again, its drive terms with every nonlinear parameter stated; `fitted_nonlinear` are those of them that were
    fitted to these samples, so that standard errors count what they leave open. `method` names an
    estimator of `methods`, such as `"wls"` for a weight per joint. Directions that the samples do
    not excite keep their CAD values, with a warning, or are refused (`undetermined="refuse"`).
    `errors` says how standard errors are judged: `"blocks"` by formula from time blocks,
    `"bootstrap"` by drawing them, all choices of the estimator held fixed, `"textbook"` as if
    residuals were independent.

    Raises
    ------
    IdentifiabilityError
        If there are too few samples, or some direction is not excited and refused.
    """
    if errors not in ERROR_KINDS:
        raise UsageError(f"there are no errors {errors!r}; there are {', '.join(ERROR_KINDS)}")
    batches = list(samples) if isinstance(samples, Sequence) else [samples]
    if not batches:
        raise UsageError(
            f"no samples are given to identify {model.name} from; pass at least one prepared"
            " recording"
        )
    estimator = methods.find(method)
    fit = fit_nonlinear(model, drive, batches) if base is None and not drive.is_linear else None
    if fit is not None:
        drive, fitted_nonlinear = fit.drive, fit.places
    found = base if base is not None else find_base_parameters(model, drive)
    information = accumulate_stream(
        model, found, batches, block_seconds=block_seconds, threads=threads
    )
    cad = design_values(model, found)
    estimate = estimator.estimate(
        EstimationData(model, information, batches, cad, undetermined, block_seconds)
    )
    if found.drive.needs_load:
        information, estimate = _with_own_load(
            model,
            information,
            estimate,
            batches,
            lambda seen, loading: estimator.estimate(
                EstimationData(
                    model, seen, batches, cad, undetermined, block_seconds, loading=loading
                )
            ),
            block_seconds,
            threads,
        )
    uncertainty = _judged(
        estimate.information or information, estimate, errors, automatic=method == "auto"
    )
    nonlinear = None
    if fitted_nonlinear:
        loading = carrying(model, found, estimate.beta) if found.drive.needs_load else model
        nonlinear = nonlinear_errors(
            loading,
            found,
            estimate,
            batches,
            fitted_nonlinear,
            textbook=errors == "textbook",
            block_seconds=block_seconds,
        )
        estimate = replace(estimate, notes=(*estimate.notes, nonlinear.sentence(model.joint_names)))
    source = ", ".join(information.sources)
    measured = []
    for beta in (estimate.beta, np.nan_to_num(cad, nan=0.0)):
        tally = TorqueTally(model.joint_names)
        for batch in batches:
            prediction = predict_torque(model, found, beta, batch)
            tally.add(prediction.measured, prediction.predicted)
        measured.append(tally.metrics(source))
    first = batches[0]
    result = conclude(
        model,
        information,
        estimate,
        rate=first.parallel.output_rate if first.parallel else first.rate,
        train=measured[0],
        cad=measured[1],
        provenance=tuple(dict.fromkeys(line for batch in batches for line in batch.provenance)),
        uncertainty=uncertainty,
        nonlinear=nonlinear,
    )
    if fit is None:
        return result
    spoken = (
        IdentificationWarning("nonlinear_parameters", warning)
        for warning in fit.warnings(model.joint_names)
    )
    return replace(
        result,
        warnings=(*result.warnings, *spoken),
        provenance=(*result.provenance, *fit.sentences(model.joint_names)),
    )


def _judged(
    information: SquareRootInformation, estimate: Estimate, errors: ErrorKind, *, automatic: bool
) -> Uncertainty:
    if errors == "textbook":
        return textbook_uncertainty(information, estimate)
    if errors == "blocks":
        return block_uncertainty(information, estimate)
    uncertainty = bootstrap_uncertainty(information, estimate, redraw(information, estimate))
    held = list(uncertainty.basis.held_fixed)
    if automatic:
        held.insert(0, f"the choice of {estimate.method}")
    if information.base.drive.needs_load:
        held.append("the load on friction")
    return replace(uncertainty, basis=replace(uncertainty.basis, held_fixed=tuple(held)))


def _with_own_load(
    model: RobotModel,
    information: SquareRootInformation,
    estimate: Estimate,
    batches: Sequence[Samples],
    estimated: Callable[[SquareRootInformation, RobotModel], Estimate],
    block_seconds: float | None,
    threads: int | None,
) -> tuple[SquareRootInformation, Estimate]:
    """Repeat until the load that friction depends on is that of the estimate itself, not that of
    the description.
    """
    base = information.base
    for _ in range(LOAD_ITERATIONS):
        loading = carrying(model, base, estimate.beta)
        information = accumulate_stream(
            loading, base, batches, block_seconds=block_seconds, threads=threads
        )
        renewed = estimated(information, loading)
        step = information.residual_energy(renewed.beta) / np.maximum(
            information.residual_energy(estimate.beta), np.finfo(np.float64).tiny
        )
        estimate = renewed
        if np.all(step > 1.0 - LOAD_CONVERGENCE):
            break
    return information, estimate


def conclude(
    model: RobotModel,
    information: SquareRootInformation,
    estimate: Estimate,
    *,
    rate: float,
    train: TorqueMetrics | None = None,
    cad: TorqueMetrics | None = None,
    provenance: tuple[str, ...] = (),
    uncertainty: Uncertainty | None = None,
    nonlinear: NonlinearErrors | None = None,
) -> IdentificationResult:
    """Make a result of an estimate.

    Errors, with those of `nonlinear` fitted along, physical consistency, verdicts.

    Without `train` and `cad` both come from the information alone, as for recordings larger than
    memory; the largest error is then unknown.
    """
    base, design = information.base, design_values(model, information.base)
    uncertainty = uncertainty or block_uncertainty(estimate.information or information, estimate)
    if nonlinear is not None:
        uncertainty = replace(uncertainty, covariance=uncertainty.covariance + nonlinear.covariance)
    poor = _poorly_determined(information, estimate, uncertainty, design)
    dropped = (
        np.zeros(base.n_base, dtype=np.bool_) if estimate.dropped is None else estimate.dropped
    )
    std_errors, textbook = (
        np.where(dropped, np.nan, each) for each in (uncertainty.std_errors, estimate.std_errors)
    )
    parameters = tuple(
        IdentifiedParameter(
            id=int(base.ids[j]),
            name=base.names[j],
            expression=base.expressions[j],
            symbolic=base.symbolic[j],
            unit=base.units[j],
            cad=float(design[j]),
            estimate=float(estimate.beta[j]),
            std_error=float(std_errors[j]),
            textbook_std_error=float(textbook[j]),
            determined=bool(estimate.determined[j]),
            poorly_determined=bool(poor[j]),
            dropped=bool(dropped[j]),
        )
        for j in range(base.n_base)
    )
    try:
        margin: float | None = consistency_margin(base, estimate.beta)
    except IdentifiabilityError:
        margin = None
    non_passive = non_passive_drives(base, estimate.beta)
    return IdentificationResult(
        model=model,
        base=base,
        method=estimate.method,
        sources=information.sources,
        n_samples=information.n_samples,
        rate=rate,
        duration=information.n_samples / rate,
        parameters=parameters,
        covariance=uncertainty.covariance,
        textbook_covariance=estimate.covariance,
        sigma=estimate.sigma,
        effective_samples=uncertainty.effective_samples,
        rank=estimate.rank,
        singular_values=estimate.solution.singular_values,
        condition_number=estimate.solution.condition_number,
        scaled_condition_number=estimate.solution.scaled_condition_number,
        undetermined=estimate.undetermined,
        train=train if train is not None else information_metrics(information, estimate.beta),
        validation=(),
        cad=(
            cad
            if cad is not None
            else information_metrics(information, np.nan_to_num(design, nan=0.0))
        ),
        physically_consistent=(
            None
            if margin is None
            else margin_is_consistent(margin, estimate.beta) and not non_passive
        ),
        consistency_margin=margin,
        warnings=_warnings(parameters, estimate, uncertainty, margin, non_passive),
        provenance=provenance,
        notes=estimate.notes,
        errors=uncertainty.basis,
        free=(
            None
            if estimate.method == "wls"
            else free_values(
                information, design, None if nonlinear is None else nonlinear.covariance
            )
        ),
    )


def design_values(model: RobotModel, base: BaseParameters) -> Array:
    """Return the base parameters by design, shape (p,).

    NaN where the description is silent on something they contain.

    A drive value on which it is silent, or that it states for a simulator's sake, adds nothing to
    sums with links and is NaN by itself.
    """
    chi, links = parameter_values(model, base.drive), 10 * model.n_joints
    for i, link in enumerate(model.links):
        if not link.inertia_known:
            chi[10 * i : 10 * i + 10] = np.nan
    silent = np.zeros(len(chi), dtype=bool)
    silent[links:] = np.isnan(chi[links:]) if model.drives_by_design else True
    values = base.values(np.where(silent, 0.0, chi))
    values[silent[base.columns]] = np.nan
    return values


def information_metrics(information: SquareRootInformation, beta: Array) -> TorqueMetrics:
    """Return the torque metrics of beta on the data behind the information.

    `max_abs` is NaN, which sums of squares do not tell.
    """
    n = information.n_samples
    error, energy = information.residual_energy(beta), information.torque_energy
    spread = energy - information.torque_sum.sum(axis=0) ** 2 / n
    with np.errstate(divide="ignore", invalid="ignore"):
        return TorqueMetrics(
            source=", ".join(information.sources),
            joint_names=information.joint_names,
            n_samples=n,
            rms=np.sqrt(error / n),
            max_abs=np.full(information.n_joints, np.nan),
            r_squared=np.where(spread > 1e-12 * energy, 1.0 - error / spread, np.nan),
            relative_error=float(np.sqrt(error.sum() / energy.sum())),
            relative_error_per_joint=np.sqrt(error / energy),
        )


def _poorly_determined(
    information: SquareRootInformation, estimate: Estimate, uncertainty: Uncertainty, design: Array
) -> NDArray[np.bool_]:
    error = uncertainty.std_errors
    size = np.fmax(np.abs(estimate.beta), np.abs(design))
    column = np.linalg.norm(
        information.stacked(1.0 / np.maximum(estimate.sigma, np.finfo(np.float64).tiny))[:, :-1],
        axis=0,
    )
    torque = error * column / np.sqrt(information.n_samples)
    return np.asarray((error > POOR_RELATIVE_ERROR * size) & (torque > POOR_TORQUE))


def _warnings(
    parameters: tuple[IdentifiedParameter, ...],
    estimate: Estimate,
    uncertainty: Uncertainty,
    margin: float | None,
    non_passive: tuple[str, ...],
) -> tuple[IdentificationWarning, ...]:
    found: list[tuple[str, str]] = []
    if estimate.undetermined:
        listed = "; ".join(estimate.undetermined[:6]) + (
            f"; and {len(estimate.undetermined) - 6} more" if len(estimate.undetermined) > 6 else ""
        )
        found.append(
            (
                "not_excited",
                (
                    f"Not excited by this recording, kept at CAD: {listed}. Move these joints more, or"
                    " leave out drive terms."
                ),
            )
        )
    poor = [parameter.name for parameter in parameters if parameter.poorly_determined]
    if poor:
        listed = ", ".join(poor[:12]) + (f" and {len(poor) - 12} more" if len(poor) > 12 else "")
        found.append(
            (
                "poorly_determined",
                (
                    f"Poorly determined (error beyond half the value): {listed}. Lengthen or enrich the"
                    " motion, or fix them."
                ),
            )
        )
    condition = estimate.solution.scaled_condition_number
    if LARGE_CONDITION < condition < np.inf:
        found.append(
            (
                "ill_conditioned",
                (
                    f"Scaled condition number {condition:.3g}, above {LARGE_CONDITION:g}: small faults"
                    " of the model move these values much."
                ),
            )
        )
    basis = uncertainty.basis
    if (
        basis.kind == "textbook"
        and basis.asked == "textbook"
        and basis.growth is not None
        and basis.growth >= TELLING_GROWTH
    ):
        found.append(
            (
                "textbook_errors",
                (
                    "Standard errors are the textbook's, as asked, and too small: judged from time"
                    f" block to time block they are {basis.growth:.2g} times as large (median), since"
                    " neighbouring residuals are alike. Use --errors blocks."
                ),
            )
        )
    if basis.kind == "bootstrap" and methods[estimate.method].regularised:
        found.append(
            (
                "bootstrap_of_regularised_fit",
                (
                    "Fits pulled to CAD all lean the same way, which their scatter does not show:"
                    " bootstrap errors are too small where CAD is off. Errors by formula (--errors"
                    " blocks) count in what CAD leaves open."
                ),
            )
        )
    elif basis.kind == "bootstrap" and estimate.refit is not None:
        found.append(
            (
                "bootstrap_near_bounds",
                (
                    "Fits that bounds of real bodies hold scatter little near a bound: bootstrap errors"
                    " are right over all parameters, but may be too small for single ones that lie on a"
                    " bound or trade with such. Errors by formula (--errors blocks) are not, and rather"
                    " too large."
                ),
            )
        )
    if basis.kind == "textbook" and basis.growth is None:
        found.append(
            (
                "few_blocks",
                (
                    f"Only {uncertainty.n_blocks} time blocks: standard errors take residuals as"
                    " independent and are too small. Record longer."
                ),
            )
        )
    if margin is not None and not margin_is_consistent(margin, estimate.beta):
        found.append(
            (
                "inconsistent",
                (
                    "No real bodies have these parameters: best attainable smallest eigenvalue"
                    f" {margin:.3g} (below 0). Predictions hold, simulators may not run."
                ),
            )
        )
    if non_passive:
        listed = ", ".join(
            f"{p.name} {plus_minus(p.estimate, p.std_error)}"
            for p in parameters
            if p.name in non_passive
        )
        found.append(
            (
                "non_passive_drives",
                (
                    f"Below zero, where no passive drive is: {listed}. Files for other software are not"
                    " written with these. Impose it (--method consistent), or leave out drive terms"
                    " that the recording does not tell."
                ),
            )
        )
    if not estimate.converged:
        why = (
            "a joint may have next to no noise"
            if estimate.method == "wls"
            else "compare with --method wls"
        )
        found.append(
            (
                "not_converged",
                (
                    f"The weights of {estimate.method} had not settled after {estimate.iterations}"
                    f" iterations; {why}."
                ),
            )
        )
    found += [(each.code, f"{each.message}. {each.cure}.") for each in estimate.findings]
    return tuple(IdentificationWarning(code, message) for code, message in found)
