"""Drive terms that MJCF has no place for, as a callback of MuJoCo in Python."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from asbuilt.description.model import Joint, RobotModel
from asbuilt.dynamics import DriveTerm, available_terms
from asbuilt.dynamics.drives.formula import FUNCTIONS
from asbuilt.writers.files import atomic_write
from asbuilt.writers.models.physical import make_friction_plain

TEXT = '''"""Drive terms of {robot} as built that MJCF has no place for: {terms}.

    model = mujoco.MjModel.from_xml_path("{mjcf}")
    {module}.attach(model)

There the nearest friction and bias stand for them. attach() sets the identified ones, and
adds the terms to the simulations of one model; mujoco.set_mjcb_passive(None) ends it. Friction is
friction loss of the joints, so that they stick, and acts one step later. The load of a joint is the
torque of the links at the acceleration of the step before.
"""

import mujoco
import numpy as np

JOINTS = {joints}
DAMPING = {damping}  # N m s/rad, or N s/m
FRICTION = {friction}  # N m or N
BIAS = {bias}  # N m or N


def attach(model):
    """Give the joints of a model their terms."""
    at = [model.joint(name).qposadr[0] for name in JOINTS]
    dof = [model.joint(name).dofadr[0] for name in JOINTS]
    actuators = [model.actuator(name).id for name in JOINTS]
    model.dof_damping[dof] = DAMPING
    model.dof_solref[dof], model.dof_solimp[dof] = {solref}, {solimp}
    model.actuator_biastype[actuators] = mujoco.mjtBias.mjBIAS_AFFINE
    model.actuator_biasprm[actuators, 0] = BIAS
    torque = np.zeros(model.nv)

    def act(m, d):
        q, qd = d.qpos[at], d.qvel[dof]
        way = np.where(qd < 0.0, -1.0, 1.0)
        mujoco.mj_rne(m, d, 1, torque)
        load = torque[dof]
        friction = np.array(FRICTION)
{lines}
        m.dof_frictionloss[dof] = np.maximum(friction, 0.0)

    mujoco.set_mjcb_passive(act)
'''
SIGN = "sign(qd)"
OPPOSING = (SIGN, "tanh(qd")
"""What a column has that is friction: of the sign of the velocity, and not small beside it."""
NUMPY = {name: function.__name__ for name, function in FUNCTIONS.items()}


def write_passive(
    path: str | os.PathLike[str],
    robot: RobotModel,
    replaced: Mapping[str, Sequence[str]],
    mjcf: str | os.PathLike[str],
    friction: Mapping[str, str],
) -> Path:
    """Write the terms `replaced` of a robot in the file `mjcf`, whose joints have the drives.

    `robot` has the terms and its plain ones as identified; `friction` are the attributes of dry
    friction that the file writes.
    """
    named = {name for names in replaced.values() for name in names}
    joints = [joint for joint in robot.joints if joint.name in named]
    lines = [
        line
        for key in (*replaced, "smooth_coulomb")
        for line in _write_term(available_terms()[key], joints)
    ]
    joints = [_without_smooth_friction(joint) for joint in joints]
    text = TEXT.format(
        robot=robot.name,
        terms=", ".join(replaced),
        mjcf=Path(mjcf).name,
        module=Path(path).stem,
        joints=_write_list([joint.name for joint in joints]),
        damping=_write_list([joint.drive.viscous or 0.0 for joint in joints]),
        friction=_write_list([joint.drive.coulomb or 0.0 for joint in joints]),
        bias=_write_list([-(joint.drive.offset or 0.0) for joint in joints]),
        lines="\n".join(f"        {line}" for line in lines),
        solref=", ".join(friction["solreffriction"].split()).join("[]"),
        solimp=", ".join(friction["solimpfriction"].split()).join("[]"),
    )
    return atomic_write(path, text)


def _without_smooth_friction(joint: Joint) -> Joint:
    """Return a joint with plain Coulomb friction, less the smooth friction that is a line."""
    terms = {key: value for key, value in joint.drive.terms.items() if key != "smooth_coulomb"}
    return replace(joint, drive=make_friction_plain(replace(joint.drive, terms=terms)))


def _write_term(term: DriveTerm, joints: Sequence[Joint]) -> Iterator[str]:
    """Yield a statement for each column of a term; columns that oppose motion are friction."""
    having = [joint.drive.terms.get(term.key, {}) for joint in joints]
    named = {
        each.name: _write_array([numbers.get(each.name, each.default) for numbers in having])
        for each in term.nonlinear
    }
    for symbol, column in zip(term.symbols, term.columns, strict=True):
        values = [numbers.get(symbol, 0.0) for numbers in having]
        if not any(values):
            continue
        formula = _write_formula(column, named)
        size = _write_array(values)
        if any(part in column for part in OPPOSING):
            yield f"friction += {size} * ({formula}) * way  # {term.key} {symbol}"
        else:
            yield f"d.qfrc_passive[dof] -= {size} * ({formula})  # {term.key} {symbol}"


def _write_formula(column: str, named: Mapping[str, str]) -> str:
    """Return a formula in NumPy, with the way of motion, which is never 0, for its sign."""
    written = column.replace(SIGN, "way").replace("qdd", "d.qacc[dof]")
    for name, function in NUMPY.items():
        written = re.sub(rf"\b{name}\(", f"np.{function}(", written)
    for name, values in named.items():
        written = re.sub(rf"\b{name}\b", values, written)
    return written


def _write_array(values: Sequence[float]) -> str:
    """Return one number for all joints, or an array."""
    alike = len(set(values)) == 1
    return _write_number(values[0]) if alike else f"np.array({_write_list(values)})"


def _write_list(values: Sequence[float] | Sequence[str]) -> str:
    texts = (repr(value) if isinstance(value, str) else _write_number(value) for value in values)
    return f"[{', '.join(texts)}]"


def _write_number(value: float) -> str:
    return f"{value:.12g}"
