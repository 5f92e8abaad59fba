"""Effects that are parameters of a model, with the values that were identified."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from asbuilt.identification.effects.effect import EFFECTS
from asbuilt.identification.effects.families.drive_terms import DriveEffect
from asbuilt.identification.effects.found_effect import FoundEffect, describe_found_effect

if TYPE_CHECKING:
    from asbuilt.identification.result.result import IdentificationResult


def as_identified(found: FoundEffect, result: IdentificationResult) -> FoundEffect:
    """Return an effect with value and error of the result, if it is a parameter of its model.

    So that tables of effects and of parameters have one number.
    """
    effect = EFFECTS.get(found.effect)
    if not (found.in_model and isinstance(effect, DriveEffect)) or found.joint is None:
        return found
    k, names = result.joint_names.index(found.joint), result.base.names
    own = [names.index(f"{s}{k + 1}") for s in effect.term.symbols if f"{s}{k + 1}" in names]
    if not own:
        return found
    values, covariance = result.estimates[own], result.covariance[np.ix_(own, own)]
    revolute = result.model.joints[k].is_revolute
    size, error, _ = effect.size(values, covariance, revolute=revolute)
    text = effect.size_text(values, covariance, revolute=revolute)
    before, after = found.error_before, found.error_after
    text = describe_found_effect(effect.title, found.joint, text, before, after)
    return replace(found, estimate=size, std_error=error, text=text)
