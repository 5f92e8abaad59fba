"""What a reader of the report must know first.

How well the model predicts, whether it can be, what is determined and what differs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from asbuilt.identification.bodies.consistency import non_passive_drives
from asbuilt.identification.result.metrics import TorqueMetrics
from asbuilt.identification.result.result import IdentificationResult
from asbuilt.tables import share, significant
from asbuilt.validation.comparison.comparison import Comparison, recording_name

Mood = Literal["good", "bad", "neutral"]


@dataclass(frozen=True, slots=True)
class Finding:
    """One statement of the verdict: a figure, what it is, and a sentence in plain words."""

    mood: Mood
    figure: str
    label: str
    sentence: str


def verdict(result: IdentificationResult, comparison: Comparison) -> tuple[Finding, ...]:
    """Return what a reader must know first, each with its sentence."""
    return (
        _prediction(result, comparison),
        _consistency(result),
        _determination(result),
        _difference(comparison),
    )


def _prediction(result: IdentificationResult, comparison: Comparison) -> Finding:
    cad, built = comparison.torque[0]
    error = share(built.relative_error)
    weak = _weakest_joint(built)
    source = recording_name(built.source)
    if not result.validation:
        return Finding(
            "neutral",
            error,
            "torque error, on the data fitted",
            f"No recording was held out, so {error} is the error on the data used for fitting and"
            f" says little about other motion.{weak}",
        )
    if cad is None or not cad.relative_error > 0:
        return Finding(
            "neutral",
            error,
            "torque error, held out",
            f"The error on {source} is {error} of the measured torque.{weak}",
        )
    factor = cad.relative_error / built.relative_error if built.relative_error > 0 else math.inf
    against = f"{share(cad.relative_error)} by design"
    if factor >= 1.0:
        sentence = (
            f"On {source}, not used for fitting, the torque error falls from {against} to {error}"
            f" as built: {significant(factor, 2)} times smaller."
        )
        return Finding("good", error, f"torque error held out, against {against}", sentence + weak)
    sentence = (
        f"On {source}, not used for fitting, the identified model predicts WORSE than the design:"
        f" {error} against {against}."
    )
    return Finding(
        "bad",
        error,
        f"torque error held out, against {against}",
        sentence + " Do not use it as it is; see the warnings." + weak,
    )


def _weakest_joint(metrics: TorqueMetrics) -> str:
    relative = metrics.relative_error_per_joint
    if not np.any(np.isfinite(relative)):
        return ""
    worst = int(np.nanargmax(relative))
    return (
        f" Joint {metrics.joint_names[worst]} is predicted worst: its error is"
        f" {share(float(relative[worst]), 0)} of its own torque."
    )


def _consistency(result: IdentificationResult) -> Finding:
    if result.physically_consistent is None:
        return Finding(
            "neutral",
            "not checked",
            "physical consistency",
            "Whether rigid bodies can have these parameters was not checked.",
        )
    if result.physically_consistent:
        return Finding(
            "good",
            "consistent",
            "physically",
            "Rigid bodies with these parameters exist, so a simulator can use the model.",
        )
    pushing = ", ".join(non_passive_drives(result.base, result.estimates))
    who = (
        f"Drives would push: {pushing} {'are' if ',' in pushing else 'is'} below zero"
        if pushing
        else "NO rigid bodies have these parameters"
    )
    sentence = (
        f"{who}. Torques are predicted well enough, but a simulator may become unstable. Fit with"
        " consistency imposed."
    )
    return Finding("bad", "inconsistent", "physically", sentence)


def _determination(result: IdentificationResult) -> Finding:
    figure, lost = f"{result.rank} of {result.n_base}", result.n_base - result.rank
    poor = sum(parameter.poorly_determined for parameter in result.parameters)
    if lost <= 0 and poor == 0:
        return Finding(
            "good", figure, "parameters determined", "This recording excites every base parameter."
        )
    if lost <= 0:
        sentence = (
            f"This recording excites every base parameter, {poor} of them poorly: their errors are"
            " large beside their values."
        )
        return Finding("neutral", figure, f"parameters determined, {poor} poorly", sentence)
    sentence = (
        f"This recording leaves {lost} combination{'s' if lost > 1 else ''} of parameters"
        " undetermined; they lean on the design values."
    )
    return Finding("bad", figure, "parameters determined", sentence)


def _difference(comparison: Comparison) -> Finding:
    figure = f"{comparison.n_differing} of {comparison.n_compared}"
    sentence = (
        f"{comparison.n_differing} of the {comparison.n_compared} parameters that have a design"
        f" value and are determined differ from it ({comparison.rule()})."
    )
    return Finding("neutral", figure, "parameters differ from the design", sentence)
