"""Findings that follow from an estimate alone: excitation, errors, physical consistency."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from asbuilt.findings import Cure, Finding, join_names
from asbuilt.identification.errors.block_scatter import TELLING_GROWTH
from asbuilt.identification.errors.uncertainty import Uncertainty
from asbuilt.identification.estimators.least_squares import LARGE_CONDITION
from asbuilt.identification.estimators.methods import methods
from asbuilt.identification.information.estimate import Estimate
from asbuilt.identification.result.result import IdentifiedParameter
from asbuilt.tables import format_plus_minus

MOST_DIRECTIONS, MOST_NAMES = 6, 12


def report_estimation(
    parameters: Sequence[IdentifiedParameter],
    estimate: Estimate,
    uncertainty: Uncertainty,
    inconsistent: float | None,
    non_passive: Sequence[str],
) -> tuple[Finding, ...]:
    """Return what an estimate says of itself.

    `inconsistent` is the negative margin of links that are physically inconsistent, None if they
    are consistent or that is unknown; `non_passive` names drive parameters below zero.
    """
    return (
        *_report_determination(parameters, estimate),
        *_report_errors(estimate, uncertainty),
        *_report_consistency(parameters, inconsistent, non_passive),
        *_report_convergence(estimate),
        *estimate.findings,
    )


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
    basis, blocks = uncertainty.basis, {"errors": "blocks"}
    if basis.kind == "textbook" and basis.growth is None:
        yield Finding(
            "few_blocks",
            "warning",
            f"Only {uncertainty.n_blocks} time blocks: standard errors assume independent residuals"
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
