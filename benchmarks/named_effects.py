"""The effects that a study names: its `effects` or, where they are no such list, its findings."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import fields
from typing import Any

import numpy as np

from asbuilt.workflow.study import Study
from asbuilt.workflow.study_options import StudyOptions
from effect_score import Effect

APPLIED = "effects" in {each.name for each in fields(StudyOptions)}
"""Whether studies look for effects by `StudyOptions.effects`."""
AT_A_JOINT = {
    "zero_position_wrong": "zero",
    "joint_gain_wrong": "gain",
    "torque_does_not_follow": "gain",
    "joint_torque_scale": "gain",
    "friction_drifts": "warming",
    "torque_drifts": "drift",
    "torque_saturates": "saturation",
}
OF_THE_ROBOT = {"clock_wrong": "clock", "rate_wrong": "clock", "torque_delayed": "delay"}
DEGREES = re.compile(r"([+-]?[\d.]+)(?: \+- [\d.]+ deg)? about ([xy])")


def named_effects(study: Study) -> tuple[Effect, ...]:
    """Return what a study names."""
    found = tuple(map(_effect, study.effects)) if APPLIED else ()
    known = {each.name for each in found}
    further = (each for each in _from_findings(study) if each.name not in known)
    return tuple(dict.fromkeys((*found, *further)))


def _field(each: Any, name: str, otherwise: Any = None) -> Any:
    return (
        each.get(name, otherwise) if isinstance(each, Mapping) else getattr(each, name, otherwise)
    )


def _effect(each: Any) -> Effect:
    alternatives = tuple(map(_alternative, _field(each, "alternatives", ()) or ()))
    about = (
        _about_axes(_field(each, "text", "") or "") if _field(each, "effect") == "tilt" else None
    )
    estimate, error = (_plain(_field(each, name)) for name in ("estimate", "std_error"))
    return Effect(
        _field(each, "effect"),
        _field(each, "joint"),
        about or estimate,
        error,
        _field(each, "unit", "") or "",
        alternatives,
    )


def _plain(value: Any) -> Any:
    """Return a number, or a tuple of numbers."""
    if value is None or isinstance(value, int | float):
        return value
    numbers = np.ravel(np.asarray(value, dtype=np.float64)).tolist()
    return numbers[0] if len(numbers) == 1 else tuple(numbers)


def _about_axes(text: str) -> tuple[float, float] | None:
    """Return the degrees about x and y that a sentence on a tilt gives."""
    turned = {axis: float(value) for value, axis in DEGREES.findall(text)}
    return (turned.get("x", 0.0), turned.get("y", 0.0)) if turned else None


def _alternative(each: Any) -> tuple[str, str | None]:
    """Return effect and joint of an alternative: an effect, a pair, or text (`zero at j2`)."""
    if isinstance(each, str):
        effect, _, joint = each.partition(" at ")
        return effect, joint or None
    if isinstance(each, tuple):
        return each[0], each[1] if len(each) > 1 else None
    return _field(each, "effect"), _field(each, "joint")


def _from_findings(study: Study) -> Iterator[Effect]:
    names = study.result.joint_names
    for each in study.findings:
        if each.code in AT_A_JOINT:  # at further joints they are information
            yield Effect(AT_A_JOINT[each.code], each.joint)
        elif each.severity == "info":
            continue
        elif each.code in OF_THE_ROBOT:
            yield Effect(OF_THE_ROBOT[each.code])
        elif each.code == "base_tilt":
            yield Effect("tilt", estimate=_about_axes(each.message))
        elif each.code == "spring_suspected":
            drive = each.cure.settings.get("drive", "") if each.cure else ""
            for joints in re.findall(r"spring:joints=([\d/]+)", drive):
                yield from (Effect("spring", names[int(k) - 1]) for k in joints.split("/"))
    for each in () if APPLIED else study.effects:
        yield Effect("tilt" if each.effect == "base tilt" else each.effect, each.joint)
