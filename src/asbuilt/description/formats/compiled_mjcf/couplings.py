"""Equalities of a compiled MJCF that couple joints linearly: between joints and fixed tendons."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import Joint, Mimic

Equation = tuple[dict[int, float], float]
"""Factors c by joint and a number d: `sum_j c_j q_j = d`, the joint that may follow first."""


def coupled_by_equalities(
    mujoco: Any, compiled: Any, joints: Sequence[Joint], loops: Collection[int] = ()
) -> tuple[list[Joint], int]:
    """Return the joints with those that follow others, and the number of equalities left out.

    Those of `loops` are neither.

    By an equality of joints the first one follows; by one of tendons the first of its joints that
    has no actuator and follows none yet.
    """
    found, left_out = list(joints), 0
    for k in sorted({*range(compiled.neq)} - {*loops}):
        equation = _equation(mujoco, compiled, k)
        at = None if equation is None else _follower(mujoco, compiled, found, k, equation[0])
        if equation is None or at is None:
            left_out += 1
            continue
        factors, value = equation
        own = factors.pop(at)
        mimic = Mimic({found[j].name: -c / own for j, c in factors.items()}, value / own)
        found[at] = replace(found[at], mimic=mimic)
    return found, left_out


def _equation(mujoco: Any, m: Any, k: int) -> Equation | None:
    """Return an equality `y - y0 = a + b (x - x0)` as an equation of joints, if it is linear."""
    kinds, one, other = mujoco.mjtEq, int(m.eq_obj1id[k]), int(m.eq_obj2id[k])
    if not m.eq_active0[k] or np.any(m.eq_data[k, 2:5]):
        return None
    if m.eq_type[k] == kinds.mjEQ_JOINT and other >= 0:
        sides = [{one: 1.0}, {other: 1.0}]
    elif m.eq_type[k] == kinds.mjEQ_TENDON:
        sides = [_fixed_tendon(mujoco, m, t) if t >= 0 else {} for t in (one, other)]
    else:
        return None
    if not sides[0] or (other >= 0 and not sides[1]):
        return None
    factors = dict(sides[0])
    for j, c in sides[1].items():
        factors[j] = factors.get(j, 0.0) - float(m.eq_data[k, 1]) * c
    rest: Array = m.qpos0[m.jnt_qposadr]
    return factors, float(m.eq_data[k, 0]) + sum(c * float(rest[j]) for j, c in factors.items())


def _fixed_tendon(mujoco: Any, m: Any, tendon: int) -> dict[int, float]:
    """Return the factors of a fixed tendon by joint, none for a spatial one."""
    wraps = range(int(m.tendon_adr[tendon]), int(m.tendon_adr[tendon] + m.tendon_num[tendon]))
    if any(m.wrap_type[w] != mujoco.mjtWrap.mjWRAP_JOINT for w in wraps):
        return {}
    return {int(m.wrap_objid[w]): float(m.wrap_prm[w]) for w in wraps}


def _follower(
    mujoco: Any, m: Any, joints: Sequence[Joint], k: int, factors: dict[int, float]
) -> int | None:
    """Return the joint that follows the others of an equation, None where none can."""
    driven = {
        int(m.actuator_trnid[a, 0])
        for a in range(m.nu)
        if m.actuator_trntype[a] == mujoco.mjtTrn.mjTRN_JOINT
    }
    by_joints = m.eq_type[k] == mujoco.mjtEq.mjEQ_JOINT
    free = [
        j
        for j in ([int(m.eq_obj1id[k])] if by_joints else factors)
        if factors[j]
        and joints[j].mimic is None
        and not any(joints[j].name in _sources(joints, other) for other in factors if other != j)
    ]
    return next((j for j in free if j not in driven), free[0] if free else None)


def _sources(joints: Sequence[Joint], index: int) -> set[str]:
    """Return the names of a joint and of all that it follows."""
    by_name = {joint.name: k for k, joint in enumerate(joints)}
    found, waiting = set[str](), [index]
    while waiting:
        joint = joints[waiting.pop()]
        found.add(joint.name)
        waiting += [by_name[name] for name in (joint.mimic.factors if joint.mimic else ())]
    return found
