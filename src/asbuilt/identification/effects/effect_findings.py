"""Findings of effects."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from asbuilt.findings import Cure, Finding, join_names
from asbuilt.identification.effects.effect import EFFECTS
from asbuilt.identification.effects.found_effect import FoundEffect
from asbuilt.identification.effects.search import Effects

APPLY = Cure("identify with it", {"effects": "auto"})


def report_effects(effects: Effects) -> tuple[Finding, ...]:
    """Return what can be done about effects, and what the log would not show."""
    if effects.problem:
        return (
            Finding(
                "effects_not_sought",
                "warning",
                f"Whether something acts that the description lacks was not asked:"
                f" {effects.problem}",
                Cure("record longer, and several motions"),
            ),
        )
    return (*_report_effects(effects), *_report_unseen(effects))


def _report_effects(effects: Effects) -> Iterator[Finding]:
    """Yield what can be done about effects that are not in the model."""
    for each in effects.found:
        effect = EFFECTS[each.effect]
        if each.in_model:
            continue
        message = f"Not in the model: {each.text}"
        said = (
            Finding("effect_found", "warning", message, APPLY, joint=each.joint)
            if effect.in_model
            else effect.finding(each, effects.model)
        )
        if said is not None:
            yield replace(said, torque=_measure_share(each))


def _measure_share(each: FoundEffect) -> float:
    """Return the share of the squared torque error that an effect takes away."""
    kept = each.error_after / each.error_before if each.error_before > 0.0 else 1.0
    return max(0.0, 1.0 - kept**2)


def _report_unseen(effects: Effects) -> Iterator[Finding]:
    """Say which errors of the log, larger than any log should hide, this one does not show."""
    named = {(each.effect, each.joint) for each in effects.found}
    for key, each in EFFECTS.items():
        rows = [
            (size, joint)
            for (own, joint), size in effects.unseen.items()
            if own == key and size > each.shown and (key, _name_joint(effects, joint)) not in named
        ]
        if rows:
            yield each.unseen(_word_sizes(effects, key, rows))


def _word_sizes(effects: Effects, key: str, rows: list[tuple[float, int | None]]) -> str:
    """Return the sizes by joint as text, those of any size last."""
    sized, never = list[str](), list[str]()
    for size, joint in rows:
        at = "" if joint is None else f" at {_name_joint(effects, joint)}"
        if size >= EFFECTS[key].farthest:
            never.append(at.removeprefix(" at "))
            continue
        revolute = joint is None or effects.model.joints[joint].is_revolute
        text = EFFECTS[key].text_of(size, None, revolute=revolute)
        sized.append(f"below {text}{at}")
    if never:
        sized.append("of any size" + (f" at {join_names(never)}" if any(never) else ""))
    return join_names(sized)


def _name_joint(effects: Effects, joint: int | None) -> str | None:
    return None if joint is None else effects.model.joint_names[joint]
