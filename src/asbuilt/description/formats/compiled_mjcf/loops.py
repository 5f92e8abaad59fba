"""Equalities of a compiled MJCF that close chains: connect, weld, and curves between joints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.polynomial import Polynomial

from asbuilt.arrays import Array
from asbuilt.description.formats.compiled_mjcf.actuators import Actuators
from asbuilt.description.model import ROOT, Joint, Loop, Mimic
from asbuilt.description.rotation import (
    composed,
    inverted,
    placement,
    rotation_from_quaternion,
)

Place = tuple[str, Array]
"""A link by name, and the pose (4, 4) in it of a body or a site."""


def loops_by_equalities(
    mujoco: Any, m: Any, bodies: Mapping[int, Place], joints: Sequence[Joint]
) -> tuple[list[Loop], list[int]]:
    """Return the loops that equalities close, and the numbers of these.

    `bodies` has the link of each body.
    """
    kinds, found, used = mujoco.mjtEq, list[Loop](), list[int]()
    for k in range(m.neq):
        name = mujoco.mj_id2name(m, mujoco.mjtObj.mjOBJ_EQUALITY, k) or ""
        loop = None
        if not m.eq_active0[k]:
            continue
        if m.eq_type[k] == kinds.mjEQ_JOINT:
            loop = _curve(m, k, joints, name)
        elif (welds := m.eq_type[k] == kinds.mjEQ_WELD) or m.eq_type[k] == kinds.mjEQ_CONNECT:
            loop = _closed(mujoco, m, k, bodies, name, welds=bool(welds))
        if loop is not None:
            found.append(loop)
            used.append(k)
    return found, used


def _curve(m: Any, k: int, joints: Sequence[Joint], name: str) -> Loop | None:
    """Return `y - y0 = a_0 + a_1 (x - x0) + ...` as a loop where it is no linear coupling."""
    one, other = int(m.eq_obj1id[k]), int(m.eq_obj2id[k])
    polynomial = Polynomial(m.eq_data[k, :5])
    if other >= 0 and not np.any(m.eq_data[k, 2:5]):
        return None
    rest = [float(m.qpos0[m.jnt_qposadr[j]]) for j in (one, max(other, 0))]
    if other >= 0:
        polynomial = polynomial(Polynomial([-rest[1], 1.0]))
    terms = np.zeros(5 if other >= 0 else 1)
    known = polynomial.coef[: terms.size]
    terms[: known.size] = known
    terms[0] += rest[0]
    moved = (joints[one].name, *((joints[other].name,) if other >= 0 else ()))
    return Loop("joint", joints=moved, polynomial=tuple(terms.tolist()), name=name)


def _closed(
    mujoco: Any, m: Any, k: int, bodies: Mapping[int, Place], name: str, *, welds: bool
) -> Loop | None:
    """Return the loop of an equality between bodies or sites; None where both are one link."""
    ids, data = (int(m.eq_obj1id[k]), int(m.eq_obj2id[k])), m.eq_data[k]
    at = [np.eye(4), np.eye(4)]
    if m.eq_objtype[k] == mujoco.mjtObj.mjOBJ_SITE:
        at = [placement(rotation_from_quaternion(m.site_quat[i]), m.site_pos[i]) for i in ids]
        ids = (int(m.site_bodyid[ids[0]]), int(m.site_bodyid[ids[1]]))
    elif welds:
        # the pose of body 2 in body 1, and the point of it that is held
        pose = placement(rotation_from_quaternion(data[6:10]), data[3:6])
        at = [composed(pose, placement(translation=data[:3])), placement(translation=data[:3])]
    else:
        at = [placement(translation=data[:3]), placement(translation=data[3:6])]
    (link_a, on_a), (link_b, on_b) = (bodies[body] for body in ids)
    if link_a == link_b:
        return None
    one, other = composed(on_a, at[0]), composed(on_b, at[1])
    turned = composed(one, inverted(other))[:3, :3] if welds else np.eye(3)
    return Loop(
        "weld" if welds else "connect",
        link_a,
        one[:3, 3],
        link_b,
        other[:3, 3],
        rotation=turned,
        name=name,
    )


def with_passive_joints(
    mujoco: Any, m: Any, joints: Sequence[Joint], links: Sequence[str], loops: Sequence[Loop]
) -> list[Joint]:
    """Return the joints with those of loops that no actuator moves as passive.

    All stay as they are where the file has no actuator.
    """
    if not m.nu:
        return list(joints)
    actuators = Actuators(mujoco, m)
    driven = {k for k in range(len(joints)) if actuators.of(k)}
    inside = set[int]()
    for loop in loops:
        if loop.kind == "joint":
            names = [joint.name for joint in joints]
            inside |= {names.index(name) for name in loop.joints[:1]}
            continue
        sides = [_above(joints, links, link) for link, _ in loop.ends]
        inside |= sides[0] ^ sides[1]
    return [
        replace(joint, mimic=Mimic({}))
        if k in inside and k not in driven and joint.mimic is None
        else joint
        for k, joint in enumerate(joints)
    ]


def _above(joints: Sequence[Joint], links: Sequence[str], link: str) -> set[int]:
    """Return the joints between the root and a link."""
    at, found = links.index(link) if link in links else ROOT, set[int]()
    while at != ROOT:
        found.add(at)
        at = joints[at].parent
    return found
