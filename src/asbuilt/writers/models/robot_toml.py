"""A robot as a robot file in TOML."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import tomli_w

from asbuilt.arrays import Array
from asbuilt.description.formats.mjcf_text import reference_posture
from asbuilt.description.inertia import LinkInertia
from asbuilt.description.lengths import length_values
from asbuilt.description.model import (
    PLAIN_TERMS,
    ROOT,
    Joint,
    Link,
    Loop,
    Mimic,
    RobotModel,
    Symbols,
)
from asbuilt.writers.files import atomic_write

_TENSOR = ("Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz")
_LIMITS = ("lower", "upper", "velocity", "acceleration", "jerk", "torque")


def robot_toml(model: RobotModel) -> str:
    """Return a robot file: rotation matrices, inertias about link origins, full precision."""
    passive = [joint.name for joint in model.followers if joint.is_passive]
    head = [
        f"name = {_text(model.name)}",
        f"citation = {_text(model.citation)}" if model.citation else "",
        f"notes = {_texts(model.notes)}" if model.notes else "",
        f"usual_drive = {_text(model.usual_drive)}" if model.usual_drive else "",
        f"gravity = {_numbers(model.gravity)}",
        f"root_link = {_text(model.root_link)}",
        f"lengths = {_table(model.lengths)}" if model.lengths else "",
        "" if model.drives_by_design else "drives_by_design = false",
        f"passive = {_texts(passive)}" if passive else "",
        f"posture = {_table(_posture(model))}" if model.loops else "",
    ]
    blocks = ["\n".join(line for line in head if line)]
    blocks += [_link_table(model, model.moving_joints[k], model.links[k]) for k in _order(model)]
    moved = [(joint, joint.mimic) for joint in model.moving_joints if joint.mimic is not None]
    moved = [(joint, mimic) for joint, mimic in moved if not joint.is_passive]
    blocks += [_motor_table(joint) for joint, _ in moved if joint.has_motor]
    blocks += [_coupling_table(joint, mimic) for joint, mimic in moved]
    blocks += [_loop_table(loop) for loop in model.loops]
    if model.motor_coupling is not None:
        for k, (name, row) in enumerate(zip(model.joint_names, model.motor_coupling, strict=True)):
            if np.array_equal(row, np.eye(model.n_joints)[k]):
                continue
            turns = ", ".join(
                f"{_key(other)} = {_float(share)}"
                for other, share in zip(model.joint_names, row, strict=True)
                if share
            )
            blocks.append(f"[[couplings]]\nmotor = {_text(name)}\nturns = {{{turns}}}")
    for frame in model.frames:
        place = _placement_fields(frame.placement, None, model)
        blocks.append(
            "\n".join(
                [
                    "[[frames]]",
                    f"name = {_text(frame.name)}",
                    f"link = {_text(_link_name(model, frame.link))}",
                    *place,
                ]
            )
        )
    return "\n\n".join(blocks) + "\n"


def write_robot_toml(path: str | os.PathLike[str], model: RobotModel) -> Path:
    """Write a robot file that `load_robot` reads back to the same torques."""
    return atomic_write(path, robot_toml(model))


def _order(model: RobotModel) -> Sequence[int]:
    """Return links with parents first, driven ones and followers each in their own order.

    So that both are numbered in the same way when the file is read. Where no such order is, the
    one of the tree is returned.
    """
    ways, order = [[*range(model.n_joints)], [*range(model.n_joints, model.n_links)]], list[int]()
    while any(ways):
        ready = [way for way in reversed(ways) if way and model.parents[way[0]] in (ROOT, *order)]
        if not ready:
            return model.link_order
        order.append(ready[0].pop(0))
    return order


def _link_table(model: RobotModel, joint: Joint, link: Link) -> str:
    lines = [
        "[[links]]",
        f"name = {_text(link.name)}",
        f"joint = {_text(joint.name_in_tree)}",
        f"kind = {_text(joint.kind)}",
        f"parent = {_text(_link_name(model, joint.parent))}",
        f"origin = {{{', '.join(_placement_fields(joint.before, joint.before_symbols, model))}}}",
    ]
    if not np.array_equal(joint.after, np.eye(4)) or joint.after_symbols is not None:
        lines.append(
            f"after = {{{', '.join(_placement_fields(joint.after, joint.after_symbols, model))}}}"
        )
    whole = (
        np.sum([inertia.parameters for _, inertia in link.parts], axis=0) if link.parts else None
    )
    by_parts = whole is not None and np.array_equal(whole, link.inertia.parameters)
    if link.negligible:
        lines.append("negligible = true")
    if link.inertia_known and not by_parts:
        lines += _inertia_fields(link.inertia)
    if joint.mimic is None or not joint.has_motor:
        lines += _drive_fields(joint)
    if by_parts:
        for name, inertia in link.parts:
            lines += ["", "[[links.parts]]", f"name = {_text(name)}", *_inertia_fields(inertia)]
    return "\n".join(lines)


def _motor_table(joint: Joint) -> str:
    return "\n".join(["[[motors]]", f"name = {_text(joint.name)}", *_drive_fields(joint)])


def _coupling_table(joint: Joint, mimic: Mimic) -> str:
    lines = ["[[couplings]]", f"{_key(joint.name_in_tree)} = {_table(mimic.factors)}"]
    return "\n".join([*lines, *([f"offset = {_float(mimic.offset)}"] if mimic.offset else [])])


def _posture(model: RobotModel) -> dict[str, float]:
    """Return where all joints are at the posture from which assembly modes are kept."""
    at = reference_posture(model)
    return {joint.name_in_tree: float(q) for joint, q in zip(model.moving_joints, at, strict=True)}


def _loop_table(loop: Loop) -> str:
    lines = ["[[loops]]"]
    lines += [f"name = {_text(loop.name)}"] if loop.name else []
    lines.append(f"kind = {_text(loop.kind)}")
    if loop.kind == "joint":
        lines.append(f"joints = {_texts(loop.joints)}")
        return "\n".join([*lines, f"polynomial = {_numbers(np.array(loop.polynomial))}"])
    for side, (link, point) in zip("ab", loop.ends, strict=True):
        lines += [f"link_{side} = {_text(link)}", f"point_{side} = {_numbers(point)}"]
    if not np.array_equal(loop.rotation, np.eye(3)):
        lines.append(f"rotation = [{', '.join(_numbers(row) for row in loop.rotation)}]")
    return "\n".join(lines)


def _drive_fields(joint: Joint) -> list[str]:
    """Return limits and drive of a joint or a motor."""
    lines = []
    limits = [
        f"{name} = {_float(value)}"
        for name in _LIMITS
        if math.isfinite(value := getattr(joint.limits, name))
    ]
    if limits:
        lines.append(f"limits = {{{', '.join(limits)}}}")
    fields = [
        f"{name} = {_float(value)}"
        for name in (*PLAIN_TERMS, "gear_ratio", "kp", "kd")
        if (value := getattr(joint.drive, name)) is not None
    ]
    if joint.drive.terms:
        terms = [f"{key} = {_table(numbers)}" for key, numbers in joint.drive.terms.items()]
        fields.append(f"terms = {{{', '.join(terms)}}}")
    if fields:
        lines.append(f"drive = {{{', '.join(fields)}}}")
    return lines


def _inertia_fields(inertia: LinkInertia) -> list[str]:
    tensor = ", ".join(
        f"{name} = {_float(value)}"
        for name, value in zip(_TENSOR, inertia.parameters[:6], strict=True)
    )
    return [
        f"mass = {_float(inertia.mass)}",
        f"first_moment = {_numbers(inertia.first_moment)}",
        f"inertia_about_origin = {{{tensor}}}",
    ]


def _placement_fields(placement: Array, symbols: Symbols | None, model: RobotModel) -> list[str]:
    p, R = placement[:3, 3], placement[:3, :3]
    fields = []
    # Largest difference [m] of a length from its symbols, which are written in its place.
    if symbols is not None and np.max(np.abs(length_values(symbols, model.lengths) - p)) <= 1e-12:
        fields.append(
            "xyz ="
            f" [{', '.join(_text(_length_sum(terms)) if terms else '0.0' for terms in symbols)}]"
        )
    elif np.any(p != 0.0):
        fields.append(f"xyz = {_numbers(p)}")
    if not np.array_equal(R, np.eye(3)):
        fields.append(f"rotation = [{', '.join(_numbers(row) for row in R)}]")
    return fields


def _length_sum(terms: Sequence[tuple[float, str]]) -> str:
    text = " ".join(
        f"{'-' if factor < 0 else '+'} "
        + ("" if abs(factor) == 1.0 else f"{abs(factor)!r}*")
        + symbol
        for factor, symbol in terms
    )
    return text[2:] if text.startswith("+ ") else "-" + text[2:]


def _link_name(model: RobotModel, index: int) -> str:
    return model.root_link if index == ROOT else model.links[index].name


def _float(value: float) -> str:
    return repr(float(value) + 0.0)


def _numbers(values: Array) -> str:
    return f"[{', '.join(_float(value) for value in values)}]"


def _text(value: str) -> str:
    return tomli_w.dumps({"x": value})[4:].rstrip("\n")


def _texts(values: Sequence[str]) -> str:
    return f"[{', '.join(_text(value) for value in values)}]"


def _table(numbers: Mapping[str, float]) -> str:
    return f"{{{', '.join(f'{_key(name)} = {_float(value)}' for name, value in numbers.items())}}}"


def _key(name: str) -> str:
    return (
        name if name.replace("_", "").replace("-", "").isalnum() and name.isascii() else _text(name)
    )
