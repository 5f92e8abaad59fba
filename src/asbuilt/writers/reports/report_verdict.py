"""Cards of a report: prediction, consistency, determination and differences at a glance."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from asbuilt.identification.bodies.consistency import non_passive_drives
from asbuilt.identification.result.determination import Determination
from asbuilt.identification.result.metrics import TorqueMetrics
from asbuilt.identification.result.result import IdentificationResult
from asbuilt.tables import share, significant
from asbuilt.validation.comparison.comparison import Comparison, recording_name
from asbuilt.workflow.study import Study

Mood = Literal["good", "bad", "neutral"]


@dataclass(frozen=True, slots=True)
class Card:
    """Hold one statement: a number, its label, and a sentence."""

    mood: Mood
    figure: str
    label: str
    sentence: str = ""


def verdict(study: Study) -> tuple[Card, ...]:
    """Return the cards of a study."""
    said = study.summary().verdict
    error = share(study.result.train.relative_error)
    refused = (Card("bad", error, "training error", said),) if said else ()
    return (
        *refused,
        prediction_card(study.result, study.comparison),
        consistency_card(study.result),
        determination_card(study.determination),
        difference_card(study.comparison),
    )


def prediction_card(result: IdentificationResult, comparison: Comparison) -> Card:
    """Return how well torque is predicted, on validation data if there are any."""
    cad, built = comparison.torque[0]
    error, source = share(built.relative_error), recording_name(built.source)
    weak = _weakest_joint(built)
    if not result.validation:
        return Card(
            "neutral",
            error,
            "torque error on the training data",
            f"No recording was held out: {error} is the torque error on the training data, and the"
            f" error on other motions is unknown.{weak}",
        )
    if cad is None or not cad.relative_error > 0:
        return Card(
            "neutral",
            error,
            "torque error held out",
            f"The torque error on {source} is {error}.{weak}",
        )
    factor = cad.relative_error / built.relative_error if built.relative_error > 0 else math.inf
    by_cad = share(cad.relative_error)
    label = f"torque error held out, CAD {by_cad}"
    if factor >= 1.0:
        return Card(
            "good",
            error,
            label,
            f"On {source} the torque error is {error} as built and {by_cad} by CAD:"
            f" {significant(factor, 2)} times smaller.{weak}",
        )
    return Card(
        "bad",
        error,
        label,
        f"On {source} the identified model predicts WORSE than CAD: {error} against {by_cad}."
        f" Do not use it before the findings below are resolved.{weak}",
    )


def _weakest_joint(metrics: TorqueMetrics) -> str:
    relative = metrics.relative_error_per_joint
    if not np.any(np.isfinite(relative)):
        return ""
    worst = int(np.nanargmax(relative))
    return (
        f" The largest relative error is {share(float(relative[worst]), 0)} at joint"
        f" {metrics.joint_names[worst]}."
    )


def consistency_card(result: IdentificationResult) -> Card:
    """Return whether physically consistent links and passive drives have the parameters."""
    if result.physically_consistent is None:
        return Card("neutral", "not checked", "physical consistency", "Consistency is not checked.")
    if result.physically_consistent:
        return Card(
            "good",
            "consistent",
            "physically",
            "The parameters are physically consistent, so simulators can use the model.",
        )
    negative = ", ".join(non_passive_drives(result.base, result.estimates))
    what = f"Friction or armature is NEGATIVE: {negative}" if negative else "The parameters are NOT"
    return Card(
        "bad",
        "inconsistent",
        "physically",
        f"{what}{'' if negative else ' physically consistent'}. Predictions hold, but a simulator"
        " may become unstable; fit with consistency imposed.",
    )


def determination_card(found: Determination) -> Card:
    """Return how many parameters the recordings determine to half their value."""
    classes = (found.well, found.fairly, found.hardly, found.not_at_all, found.dropped)
    good, total = len(found.well) + len(found.fairly), sum(map(len, classes))
    mood: Mood = "bad" if found.not_at_all else "good" if good == total else "neutral"
    parts = [
        f"{len(found.hardly)} have a standard error above half their value" if found.hardly else "",
        f"{len(found.not_at_all)} are undetermined and regularised toward CAD"
        if found.not_at_all
        else "",
        f"{len(found.dropped)} were dropped" if found.dropped else "",
    ]
    rest = ", ".join(part for part in parts if part)
    return Card(
        mood,
        f"{good} of {total}",
        "parameters determined to 50 % or better",
        f"The recordings determine {good} of {total} parameters to 50 % or better"
        f"{f'; {rest}' if rest else ''}.",
    )


def difference_card(comparison: Comparison) -> Card:
    """Return how many parameters differ from CAD."""
    matter = comparison.n_mattering
    verb = "matters" if matter == 1 else "matter"
    return Card(
        "neutral",
        f"{comparison.n_differing} of {comparison.n_compared}",
        "parameters differ from CAD"
        + ("" if matter is None else f", {matter} {verb} to the torque"),
        f"{comparison.n_differing} of {comparison.n_compared} determined parameters with a CAD"
        f" value differ from it ({comparison.rule()}).",
    )
