"""Findings of effects."""

from __future__ import annotations

from collections.abc import Sequence

from asbuilt.dynamics.drives.selection import available_terms
from asbuilt.findings import Cure, Finding
from asbuilt.identification.effects.effect import EFFECTS
from asbuilt.identification.effects.found_effect import FoundEffect

APPLY = Cure("identify with it", {"effects": "auto"})
CORRECT = Cure("check the log, and correct it in a recording sheet")


def effect_findings(effects: Sequence[FoundEffect]) -> tuple[Finding, ...]:
    """Return a finding for each effect: a warning where something can be done about it."""
    return tuple(_finding(each) for each in effects)


def _finding(each: FoundEffect) -> Finding:
    if each.in_model:
        return Finding("effect_in_model", "info", f"In the model: {each.text}", joint=each.joint)
    effect, message = EFFECTS[each.effect], f"Not in the model: {each.text}"
    if each.effect in available_terms() and not effect.in_model:
        cure = Cure("if the robot has one, state it", {"effects": f"{each.effect}:joints=NUMBER"})
        return Finding("effect_found", "info", message, cure, joint=each.joint)
    if effect.in_model or effect.of_log:
        cure = APPLY if effect.in_model else CORRECT
        return Finding("effect_found", "warning", message, cure, joint=each.joint)
    return Finding("effect_found", "info", message, joint=each.joint)
