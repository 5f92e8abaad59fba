"""Where on its axis the frame of a joint sits.

A free choice, made so that lengths stay out of local conditions.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.lengths import added_symbols, length_values, rotated_symbols
from asbuilt.description.model import RobotModel, Symbols
from asbuilt.description.rotation import placement

NUMBER = ""
"""The symbol that stands for 1, so that a plain length is a sum of symbols, too."""

LENGTH_TOLERANCE = 1e-12
"""Symbols must stand for the lengths of a placement to this [m]."""


def symbolic_translation(
    transform: Array, symbols: Symbols | None, lengths: Mapping[str, float]
) -> Symbols:
    """Return the symbols of a placement's translation, or its numbers.

    The latter where it has no symbols or their values differ.
    """
    translation = transform[:3, 3]
    if (
        symbols is not None
        and np.abs(length_values(symbols, {**lengths, NUMBER: 1.0}) - translation).max()
        < LENGTH_TOLERANCE
    ):
        return symbols
    return tuple(((float(value), NUMBER),) if value else () for value in translation)


def nearest_origins(model: RobotModel) -> RobotModel:
    """Return the same robot with every joint frame slid along its axis.

    Each goes to the point nearest the origin of the parent link.

    The motion commutes with a translation along its axis: `before (1, z d) motion(q) after = before
    motion(q) (1, z d) after`.
    """
    values = {**model.lengths, NUMBER: 1.0}
    joints = []
    for joint in model.joints:
        z = joint.before[:3, 2]
        before = symbolic_translation(joint.before, joint.before_symbols, model.lengths)
        after = symbolic_translation(joint.after, joint.after_symbols, model.lengths)
        before_slid = added_symbols(before, rotated_symbols(-np.outer(z, z), before))
        after_slid = added_symbols(after, rotated_symbols(np.vstack([np.zeros((2, 3)), z]), before))
        joints.append(
            replace(
                joint,
                before=placement(joint.before[:3, :3], length_values(before_slid, values)),
                after=placement(joint.after[:3, :3], length_values(after_slid, values)),
                before_symbols=before_slid,
                after_symbols=after_slid,
            )
        )
    return replace(model, joints=tuple(joints))


def same_build(model: RobotModel, lengths: Mapping[str, float]) -> RobotModel:
    """Return the robot with other values for the symbols of its joints."""
    values = {**lengths, NUMBER: 1.0}
    joints = []
    for joint in model.joints:
        before, after = (
            placement(
                transform[:3, :3],
                length_values(symbolic_translation(transform, symbols, model.lengths), values),
            )
            for transform, symbols in (
                (joint.before, joint.before_symbols),
                (joint.after, joint.after_symbols),
            )
        )
        joints.append(replace(joint, before=before, after=after))
    return replace(model, joints=tuple(joints), lengths=dict(lengths))
