"""A robot as a robot file in TOML."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from asbuilt.arrays import Array
from asbuilt.codec import format_toml, format_toml_key
from asbuilt.description.formats.mjcf_text import reference_posture
from asbuilt.description.inertia import PARAMETER_NAMES, LinkInertia
from asbuilt.description.lengths import evaluate_lengths
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
from asbuilt.writing import atomic_write

_LIMITS = ("lower", "upper", "velocity", "acceleration", "jerk", "torque")


def format_robot_toml(model: RobotModel) -> str:
    """Return a robot file: rotation matrices, inertias about link origins, full precision."""
    head = {
        "name": model.name,
        "citation": model.citation or None,
        "notes": model.notes or None,
        "usual_drive": model.usual_drive or None,
        "gravity": model.gravity,
        "root_link": model.root_link,
        "lengths": model.lengths or None,
        # True is what a reader assumes: only the other is written.
        "drives_by_design": None if model.drives_by_design else False,
        "passive": [joint.name for joint in model.followers if joint.is_passive] or None,
        # Only loops have several assembly modes to choose from.
        "posture": _find_posture(model) if model.loops else None,
    }
    # Passive joints have no factors: the loops move them.
    moved = [joint for joint in model.moving_joints if joint.mimic and not joint.is_passive]
    links = ((model.moving_joints[k], model.links[k]) for k in _order_links(model))
    blocks = [
        _write_fields(head),
        *(block for joint, link in links for block in _write_link_blocks(model, joint, link)),
        *(
            _write_block("motors", {"name": joint.name, **_list_drive_fields(joint)})
            # A follower with a motor of its own has its drive there, since its link block has none.
            for joint in moved
            if joint.has_motor
        ),
        *map(_write_coupling_block, moved),
        *map(_write_loop_block, model.loops),
        *_write_motor_blocks(model),
        *(
            _write_block(
                "frames",
                {
                    "name": frame.name,
                    "link": _name_link(model, frame.link),
                    **_list_placement_fields(frame.placement, None, model),
                },
            )
            for frame in model.frames
        ),
    ]
    return "\n\n".join(blocks) + "\n"


def write_robot_toml(path: str | os.PathLike[str], model: RobotModel) -> Path:
    """Write a robot file that `load_robot` reads back to the same torques."""
    return atomic_write(path, format_robot_toml(model))


def _order_links(model: RobotModel) -> Sequence[int]:
    """Return links with parents first, driven ones and followers each in their own order.

    So that both are numbered in the same way when the file is read. Where no such order is, the
    one of the tree is returned.
    """
    ways = [[*range(model.n_joints)], [*range(model.n_joints, model.n_links)]]
    order = list[int]()
    while any(ways):
        ready = [way for way in reversed(ways) if way and model.parents[way[0]] in (ROOT, *order)]
        if not ready:
            return model.link_order
        order.append(ready[0].pop(0))
    return order


def _write_link_blocks(model: RobotModel, joint: Joint, link: Link) -> list[str]:
    """Return the block of a link, and the blocks of its parts where it has any."""
    parts = [inertia.parameters for _, inertia in link.parts]
    # Parts that no longer add up to the link are of CAD, and not as built.
    by_parts = bool(parts) and np.array_equal(np.sum(parts, axis=0), link.inertia.parameters)
    after = _list_placement_fields(joint.after, joint.after_symbols, model)
    # Most joints have no displacement behind them.
    placed = not np.array_equal(joint.after, np.eye(4)) or joint.after_symbols is not None
    fields = {
        "name": link.name,
        "joint": joint.name_in_tree,
        "kind": joint.kind,
        "parent": _name_link(model, joint.parent),
        "origin": _list_placement_fields(joint.before, joint.before_symbols, model),
        "after": after if placed else None,
        "negligible": link.negligible or None,
        **(_list_inertia_fields(link.inertia) if link.inertia_known and not by_parts else {}),
        **(_list_drive_fields(joint) if joint.mimic is None or not joint.has_motor else {}),
        # A mimic with a motor has its drive in its block of motors.
    }
    return [
        _write_block("links", fields),
        *(
            _write_block("links.parts", {"name": name, **_list_inertia_fields(inertia)})
            for name, inertia in (link.parts if by_parts else ())
        ),
    ]


def _write_coupling_block(joint: Joint) -> str:
    mimic = joint.mimic or Mimic({})
    return _write_block(
        "couplings", {joint.name_in_tree: mimic.factors, "offset": mimic.offset or None}
    )


def _write_motor_blocks(model: RobotModel) -> list[str]:
    """Return a block for each motor that turns another joint than its own, or several."""
    n = model.n_joints
    names = model.joint_names
    # A motor that turns its own joint by one is the usual case, and needs no block.
    shares = np.eye(n) if model.motor_coupling is None else model.motor_coupling
    return [
        _write_block(
            "couplings",
            {
                "motor": name,
                "turns": {other: share for other, share in zip(names, row, strict=True) if share},
            },
        )
        for name, row, own in zip(names, shares, np.eye(n), strict=True)
        if not np.array_equal(row, own)
    ]


def _find_posture(model: RobotModel) -> dict[str, float]:
    """Return where all joints are at the posture from which assembly modes are kept."""
    return {
        joint.name_in_tree: float(q)
        for joint, q in zip(model.moving_joints, reference_posture(model), strict=True)
    }


def _write_loop_block(loop: Loop) -> str:
    head = {"name": loop.name or None, "kind": loop.kind}
    if loop.kind == "joint":
        return _write_block("loops", {**head, "joints": loop.joints, "polynomial": loop.polynomial})
    ends = {
        f"{what}_{side}": value
        for side, end in zip("ab", loop.ends, strict=True)
        for what, value in zip(("link", "point"), end, strict=True)
    }
    # Only a loop that holds frames together has a rotation to write.
    rotation = None if np.array_equal(loop.rotation, np.eye(3)) else loop.rotation
    return _write_block("loops", {**head, **ends, "rotation": rotation})


def _list_drive_fields(joint: Joint) -> dict[str, Any]:
    """Return limits and drive of a joint or a motor."""
    limits = {
        # An infinite limit is none.
        name: value
        for name in _LIMITS
        if math.isfinite(value := getattr(joint.limits, name))
    }
    drive = {
        name: value
        for name in (*PLAIN_TERMS, "gear_ratio", "kp", "kd")
        if (value := getattr(joint.drive, name)) is not None
    } | ({"terms": joint.drive.terms} if joint.drive.terms else {})
    return {"limits": limits or None, "drive": drive or None}


def _list_inertia_fields(inertia: LinkInertia) -> dict[str, Any]:
    return {
        "mass": inertia.mass,
        "first_moment": inertia.first_moment,
        # About the origin of the link, as identified: parameters stay linear and exact.
        "inertia_about_origin": dict(zip(PARAMETER_NAMES[:6], inertia.parameters[:6], strict=True)),
    }


def _list_placement_fields(
    placement: Array, symbols: Symbols | None, model: RobotModel
) -> dict[str, Any]:
    p = placement[:3, 3]
    R = placement[:3, :3]
    xyz: Any = p if np.any(p != 0.0) else None
    # Largest difference [m] of a length from its symbols, which are written in its place.
    if (
        symbols is not None
        # Symbols are kept only where they still give the number.
        and np.max(np.abs(evaluate_lengths(symbols, model.lengths) - p)) <= 1e-12
    ):
        xyz = [_write_length_sum(terms) if terms else 0.0 for terms in symbols]
    return {"xyz": xyz, "rotation": None if np.array_equal(R, np.eye(3)) else R}


def _write_length_sum(terms: Sequence[tuple[float, str]]) -> str:
    text = " ".join(
        f"{'-' if factor < 0 else '+'} "
        + ("" if abs(factor) == 1.0 else f"{abs(factor)!r}*")
        + symbol
        for factor, symbol in terms
    )
    # A first term without sign reads as one would write it.
    return text[2:] if text.startswith("+ ") else "-" + text[2:]


def _name_link(model: RobotModel, index: int) -> str:
    return model.root_link if index == ROOT else model.links[index].name


def _write_block(name: str, fields: Mapping[str, Any]) -> str:
    return f"[[{name}]]\n{_write_fields(fields)}"


def _write_fields(fields: Mapping[str, Any]) -> str:
    """Return a line for each field that is there."""
    return "\n".join(
        f"{format_toml_key(name)} = {format_toml(_drop_absent(value))}"
        for name, value in fields.items()
        if value is not None
    )


def _drop_absent(value: Any) -> Any:
    """Return a table without the fields that are not there."""
    if not isinstance(value, Mapping):
        return value
    return {name: _drop_absent(part) for name, part in value.items() if part is not None}
