"""From an estimate to a result: errors, physical consistency, verdicts, and its findings."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.findings import Cure, Finding, join_names
from asbuilt.identification.bodies.cad_prior import design_values
from asbuilt.identification.bodies.consistency import (
    decide_consistency,
    non_passive_drives,
)
from asbuilt.identification.drives.nonlinear_parameters import NonlinearErrors
from asbuilt.identification.estimators.least_squares import LARGE_CONDITION
from asbuilt.identification.estimators.methods import methods
from asbuilt.identification.information.estimate import Estimate
from asbuilt.identification.information.square_root_information import SquareRootInformation
from asbuilt.identification.result.result import IdentificationResult, IdentifiedParameter
from asbuilt.identification.result.torque_prediction import TorqueMetrics
from asbuilt.identification.uncertainty.bias import OmittedBias
from asbuilt.identification.uncertainty.block_scatter import TELLING_GROWTH
from asbuilt.identification.uncertainty.delay_errors import DelayErrors
from asbuilt.identification.uncertainty.uncertainty import (
    Uncertainty,
    estimate_block_uncertainty,
    fit_free_values,
)
from asbuilt.tables import format_plus_minus

POOR_RELATIVE_ERROR = 0.5
"""Standard error, relative to the larger of estimate and CAD value, above which a parameter is
determined hardly: at two standard errors its sign is in doubt. Own choice."""
POOR_TORQUE = 0.05
"""Torque that such an error stands for, relative to the residual, above which the parameter is
poorly determined; below, its error is negligible for this motion. Own choice."""


MOST_DIRECTIONS = 6
MOST_NAMES = 12


def conclude(
    model: RobotModel,
    information: SquareRootInformation,
    estimate: Estimate,
    *,
    rate: float,
    train: TorqueMetrics | None = None,
    cad: TorqueMetrics | None = None,
    uncertainty: Uncertainty | None = None,
    nonlinear: NonlinearErrors | None = None,
    delayed: DelayErrors | None = None,
    omitted: OmittedBias | None = None,
    validation: Sequence[TorqueMetrics] = (),
    notes: Sequence[str] = (),
    findings: Sequence[Finding] = (),
    **further: Any,
) -> IdentificationResult:
    """Make a result of an estimate.

    Parameters
    ----------
    model, information, estimate
        The robot, the square-root information of its recordings, and what was estimated.
    rate
        Rate of the samples used [Hz].
    train, cad
        Torque metrics as built and of the CAD values; None: from the information alone, which
        does not know the largest error.
    uncertainty
        Standard errors; None: from time blocks.
    nonlinear
        Errors of nonlinear parameters fitted along.
    delayed
        Errors of delays of the torque.
    omitted
        Bias by effects that the model lacks.
    validation
        Torque metrics on validation data.
    notes, findings
        What else the result says.
    further
        Other fields of the result: `provenance`, `chain`, `holdout`, `digests`, `cause_data`.
    """
    base = information.base
    design = design_values(model, information.base)
    uncertainty = uncertainty or estimate_block_uncertainty(
        estimate.information or information, estimate
    )
    errors = [each.covariance for each in (nonlinear, delayed) if each is not None]
    free_errors = list(errors)
    if omitted is not None:
        errors.append(omitted.covariance)
        free_errors.append(omitted.free_covariance)
        notes = (*notes, *filter(None, [omitted.sentence]))
    if errors:
        uncertainty = uncertainty.with_further(
            np.sum(errors, axis=0), None if omitted is None else omitted.bias
        )
    parameters = _list_parameters(information, estimate, uncertainty, design)
    margin, consistent = decide_consistency(base, estimate.beta)
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
        train=train or measure_errors_by_information(information, estimate.beta),
        validation=tuple(validation),
        cad=cad or measure_errors_by_information(information, np.nan_to_num(design, nan=0.0)),
        physically_consistent=None if consistent is None else consistent and not non_passive,
        consistency_margin=margin,
        findings=(
            *_report_determination(parameters, estimate),
            *_report_errors(estimate, uncertainty),
            *_report_consistency(parameters, margin if consistent is False else None, non_passive),
            *_report_convergence(estimate),
            *estimate.findings,
            *findings,
        ),
        notes=(*estimate.notes, *notes),
        errors=uncertainty.basis,
        scatter=uncertainty.scatter,
        bias=None if omitted is None else omitted.covariance,
        free=(
            None
            if estimate.method == "wls"
            else fit_free_values(
                information,
                design,
                np.sum(free_errors, axis=0) if free_errors else None,
                None if omitted is None else omitted.free_bias,
            )
        ),
        **({"provenance": ()} | further),
    )


def measure_errors_by_information(information: SquareRootInformation, beta: Array) -> TorqueMetrics:
    """Return the torque metrics of beta on the data behind the information; `max_abs` is NaN."""
    energy = information.torque_energy
    spread = energy - information.torque_sum.sum(axis=0) ** 2 / information.n_samples
    return TorqueMetrics.of_sums(
        ", ".join(information.sources),
        information.joint_names,
        information.n_samples,
        error=information.residual_energy(beta),
        energy=energy,
        spread=spread,
        # Their difference keeps half of the digits.
        constant=~(spread > 1e-12 * energy),
        max_abs=np.full(information.n_joints, np.nan),
    )


def _list_parameters(
    information: SquareRootInformation, estimate: Estimate, uncertainty: Uncertainty, design: Array
) -> tuple[IdentifiedParameter, ...]:
    base = information.base
    poor = _find_poorly_determined(information, estimate, uncertainty, design)
    dropped = (
        np.zeros(base.n_base, dtype=np.bool_) if estimate.dropped is None else estimate.dropped
    )
    std_errors, textbook = (
        np.where(dropped, np.nan, each) for each in (uncertainty.std_errors, estimate.std_errors)
    )
    return tuple(
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


def _find_poorly_determined(
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


def _report_determination(
    parameters: Sequence[IdentifiedParameter], estimate: Estimate
) -> Iterator[Finding]:
    if estimate.undetermined:
        yield Finding(
            "not_excited",
            "warning",
            "Not excited by this recording, kept at CAD:"
            f" {join_names(estimate.undetermined, MOST_DIRECTIONS)}",
            Cure("move these joints more, or leave out drive terms"),
        )
    poor = [parameter.name for parameter in parameters if parameter.poorly_determined]
    if poor:
        yield Finding(
            "poorly_determined",
            "info",
            f"{len(poor)} parameters have standard errors above half their value:"
            f" {join_names(poor, MOST_NAMES)}",
            Cure("record longer, enrich the motion, or leave out drive terms"),
        )
    condition = estimate.solution.scaled_condition_number
    if LARGE_CONDITION < condition < np.inf:
        yield Finding(
            "ill_conditioned",
            "warning",
            f"The scaled condition number is {condition:.3g}, above {LARGE_CONDITION:g}: small"
            " model errors change these values much",
            Cure("enrich the motion"),
        )


def _report_errors(estimate: Estimate, uncertainty: Uncertainty) -> Iterator[Finding]:
    basis = uncertainty.basis
    blocks = {"errors": "blocks"}
    if basis.kind == "textbook" and basis.growth is None:
        yield Finding(
            "few_blocks",
            "warning",
            f"Only {basis.n_blocks} time blocks: standard errors assume independent residuals"
            " and are too small",
            Cure("record longer"),
        )
    elif (
        basis.kind == basis.asked == "textbook"
        and basis.growth is not None
        and basis.growth >= TELLING_GROWTH
    ):
        yield Finding(
            "textbook_errors",
            "warning",
            "Textbook standard errors are too small, since residuals are correlated: errors from"
            f" time blocks are {basis.growth:.2g} times as large (median)",
            Cure("estimate errors from time blocks", blocks),
        )
    if basis.kind != "bootstrap":
        return
    if estimate.method in methods and methods[estimate.method].regularised:
        yield Finding(
            "bootstrap_of_regularised",
            "warning",
            "Bootstrap errors leave out the bias of a fit regularised toward CAD, so they are too"
            " small if CAD is off",
            Cure("estimate errors by formula, which allow for it", blocks),
        )
    elif estimate.refit is not None:
        yield Finding(
            "bootstrap_near_bounds",
            "warning",
            "Bootstrap errors of single parameters near a bound of physical consistency may be too"
            " small, though not over all parameters",
            Cure("estimate errors by formula, which are rather too large", blocks),
        )


def _report_consistency(
    parameters: Sequence[IdentifiedParameter],
    inconsistent: float | None,
    non_passive: Sequence[str],
) -> Iterator[Finding]:
    """Report links and drives that no robot has.

    `inconsistent` is the negative margin of links that are physically inconsistent, None if they
    are consistent or that is unknown; `non_passive` names drive parameters below zero.
    """
    consistent = {"method": "consistent"}
    if inconsistent is not None:
        yield Finding(
            "inconsistent",
            "warning",
            "The links are physically inconsistent: the best attainable smallest eigenvalue is"
            f" {inconsistent:.3g}, below 0. Predictions hold, simulators may fail",
            Cure("impose physical consistency", consistent),
        )
    if non_passive:
        listed = [
            f"{parameter.name} {format_plus_minus(parameter.estimate, parameter.std_error)}"
            for parameter in parameters
            if parameter.name in non_passive
        ]
        yield Finding(
            "non_passive_drives",
            "warning",
            f"Negative friction or armature: {', '.join(listed)}. Other software gets no file of"
            " such a robot",
            Cure(
                "impose physical consistency, or leave out drive terms that are not determined",
                consistent,
            ),
        )


def _report_convergence(estimate: Estimate) -> Iterator[Finding]:
    if not estimate.converged:
        cure = (
            Cure("check that no joint is free of noise")
            if estimate.method == "wls"
            else Cure("compare with weighted least squares", {"method": "wls"})
        )
        yield Finding(
            "not_converged",
            "warning",
            f"The weights of {estimate.method} had not converged after"
            f" {estimate.iterations} iterations",
            cure,
        )
