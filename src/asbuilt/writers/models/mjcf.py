"""A robot as an MJCF file of its own, and drive terms without a place in it as a callback."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from xml.etree.ElementTree import (
    Comment,
    Element,
    SubElement,
    TreeBuilder,
    XMLParser,
    fromstring,
    indent,
    tostring,
)

import numpy as np

from asbuilt.description.formats.mjcf_text import format_mjcf
from asbuilt.description.model import PLAIN_TERMS, Joint, RobotModel
from asbuilt.dynamics import DriveTerm, available_terms
from asbuilt.dynamics.drives.term import FUNCTIONS
from asbuilt.errors import UsageError
from asbuilt.findings import Cure
from asbuilt.identification import EncoderPair, IdentificationResult
from asbuilt.writers.models.control import add_position_actuator
from asbuilt.writers.models.physical import (
    convert_to_plain_friction,
    make_friction_plain,
    note_left_out_drives,
    refuse_inconsistent,
)
from asbuilt.writers.models.xml_spans import comment_text
from asbuilt.writing import atomic_write

STIFF_FRICTION = {"solreffriction": "0.002 1", "solimpfriction": "0.9999 0.9999 0.001 0.5 2"}
"""Reference (two steps of 1 ms) and impedance (the hardest) of dry friction at small speeds."""
CARRIED = frozenset(
    (
        *("spring", "extension_spring", "cylinder"),
        *("motor_armature", "motor_viscous", "motor_coulomb"),
    )
)
"""Drive terms that MJCF holds, in addition to plain ones and friction written as plain."""
WRITTEN_AS_PLAIN = frozenset(("asymmetric_coulomb", "smooth_coulomb"))


def mjcf_holds(key: str, numbers: Mapping[str, float]) -> bool:
    """Return whether MJCF holds a drive term with these numbers.

    A balancer of one harmonic is a spring without free length; a cylinder of constant force has
    no stiffness.
    """
    if key == "balancer":
        return numbers.get("harmonics", 1.0) <= 1.0
    if key == "cylinder":
        return bool(numbers.get("rate"))
    return key in CARRIED or key in PLAIN_TERMS or key in WRITTEN_AS_PLAIN


def export_mjcf(model: RobotModel) -> str:
    """Return the robot as MJCF, with what MJCF cannot hold in comments.

    Armature, viscous and dry friction are the joint's; asymmetric dry friction is symmetric
    friction and an offset, smooth friction a dry one; a torsion spring is the joint's
    stiffness, a spring or cylinder between two links a spatial tendon with stiffness; a motor
    that several joints turn is a fixed tendon with damping, dry friction and armature; an
    offset is the bias of the joint's actuator, whose control is the torque that the drive has
    to exert. A joint whose drive has gains gets a position actuator with them, its control the
    position to go to, and the integrator treats its damping implicitly.
    MuJoCo's dry friction grows with speed and acceleration up to its full size; where the joint
    moves faster than `|qdd|` times a millisecond, inverse dynamics holds all of it.

    Raises
    ------
    InertiaError
        If the model is physically inconsistent.
    """
    refuse_inconsistent(model)
    plain = convert_to_plain_friction(model)
    root = fromstring(format_mjcf(plain))
    elements = {element.get("name"): element for element in root.iter("joint")}
    for joint in plain.joints:
        # Other joints keep MuJoCo's default, which costs nothing.
        if joint.drive.coulomb:
            elements[joint.name].attrib.update(
                STIFF_FRICTION, frictionloss=repr(joint.drive.coulomb)
            )
    for motor, joint in zip([*root.iter("motor")], plain.joints, strict=True):
        if joint.drive.kp is not None:
            add_position_actuator(motor, elements[joint.name], joint)
        # Without gains an offset is a bias of the actuator.
        elif offset := joint.drive.offset:
            motor.tag = "general"
            motor.attrib.update(biastype="affine", biasprm=f"{-offset!r} 0 0")
    # The damping of such actuators would make explicit steps unstable.
    if any(joint.drive.kp is not None for joint in plain.joints):
        next(root.iter("option")).attrib["integrator"] = "implicitfast"
    _add_motors(root, model)
    _release_base(root, model)
    for place, note in enumerate((*model.notes, *note_mjcf_limits(model))):
        root.insert(place, Comment(comment_text(note)))
    indent(root)
    return tostring(root, encoding="unicode") + "\n"


def _add_motors(root: Element, model: RobotModel) -> None:
    """Add a fixed tendon, of length `s = T q`, for every motor that several joints turn."""
    tendons = next(root.iter("tendon"), Element("tendon"))
    written = len(tendons)
    for joint, shares in zip(model.joints, model.motor_shares, strict=True):
        armature, viscous, coulomb = (
            joint.drive.terms.get(f"motor_{what}", {}).get(symbol, 0.0)
            for what, symbol in (("armature", "Iam"), ("viscous", "Fvm"), ("coulomb", "Fcm"))
        )
        if not shares.any() or not any((armature, viscous, coulomb)):
            continue
        tendon = SubElement(
            tendons,
            "fixed",
            {
                "name": f"motor of {joint.name}",
                "armature": repr(armature),
                "damping": repr(viscous),
            },
        )
        if coulomb:
            tendon.attrib.update(STIFF_FRICTION, frictionloss=repr(coulomb))
        for k in np.flatnonzero(shares):
            SubElement(tendon, "joint", joint=model.joints[k].name, coef=repr(float(shares[k])))
    # Tendons come before actuators, which may name them.
    if len(tendons) and not written:
        root.insert(list(root).index(next(root.iter("actuator"))), tendons)


def _release_base(root: Element, model: RobotModel) -> None:
    """Take the actuators of the base's joints out, and make one free joint of six of them."""
    if not model.n_floating:
        return
    names = set(model.joint_names[: model.n_floating])
    for actuators in root.iter("actuator"):
        for actuator in [actuator for actuator in actuators if actuator.get("joint") in names]:
            actuators.remove(actuator)
    # A planar base keeps its three joints.
    if model.n_floating != 6:
        return
    bodies = {body.get("name"): body for body in root.iter("body")}
    first, base = (bodies[model.link_names[k]] for k in (0, model.n_floating - 1))
    world = next(element for element in root.iter("worldbody"))
    for joint in base.findall("joint"):
        base.remove(joint)
    # The pose of a free body is its state.
    for placed in ("pos", "quat"):
        base.attrib.pop(placed, None)
    base.insert(0, Element("freejoint", name="base"))
    world.insert(list(world).index(first), base)
    world.remove(first)


def note_mjcf_limits(model: RobotModel) -> tuple[str, ...]:
    """Return notes on what changes torques and has no, or an unexpected, place in MJCF."""
    plain = convert_to_plain_friction(model)
    offsets = [
        f"{joint.name} {joint.drive.offset:.6g}" for joint in plain.joints if joint.drive.offset
    ]
    constant = [
        f"{joint.name} {numbers['Pc']:.6g}"
        for joint in plain.joints
        # A constant force has no stiffness that a tendon could hold.
        if (numbers := joint.drive.terms.get("cylinder", {})).get("Pc") and not numbers.get("rate")
    ]
    balancers = [joint.drive.terms.get("balancer", {}) for joint in plain.joints]
    held = all(mjcf_holds("balancer", numbers) for numbers in balancers)
    carried = CARRIED | {"balancer"} if held else CARRIED
    cases = {
        "the offsets of the drives are the bias of the actuators, which mj_inverse leaves out"
        f" (Fo [N m, or N for prismatic joints]: {', '.join(offsets)})": bool(offsets),
        "cylinders of constant force are left out, for a tendon has a force by its stiffness alone"
        f" (Pc [N]: {', '.join(constant)})": bool(constant),
        "smooth Coulomb friction is written as dry friction: equal torques if a joint moves faster"
        " than its width": any("smooth_coulomb" in joint.drive.terms for joint in model.joints),
    }
    return (
        *(note for note, holds in cases.items() if holds),
        *note_left_out_drives(plain, carried, "MJCF"),
    )


def write_mjcf(
    path: str | os.PathLike[str], model: RobotModel, elastic: Sequence[EncoderPair] = ()
) -> tuple[Path, tuple[str, ...]]:
    """Write the robot for MuJoCo, its `elastic` joints as two each.

    Returns the path and notes on what the file cannot hold.
    """
    text = export_mjcf(model)
    text = add_elastic_joints(text, elastic) if elastic else text
    return atomic_write(path, text), note_mjcf_limits(model)


def describe_rotors(result: IdentificationResult) -> IdentificationResult:
    """Return a result whose description has the rotors that two encoders show.

    Where a rotor is one parameter with its link, it is then taken from the link's inertia.

    Raises
    ------
    UsageError
        If no stiffness is determined, or joints of the robot are coupled or in loops.
    """
    rotors = {pair.joint: pair.rotor for pair in result.encoders if pair.stiffness is not None}
    if not rotors:
        raise UsageError(
            f"the result of {result.robot} has no stiffness of a joint, by which it would be"
            " elastic",
            cure=Cure(
                "identify from a log with positions of motors and links, q_motor_*, q_link_*"
            ),
        )
    if result.model.tree is not result.model:
        raise UsageError(
            f"joints of {result.robot} are coupled or in loops; elastic joints are written for"
            " robots whose motors move one joint each"
        )
    joints = tuple(
        replace(joint, drive=replace(joint.drive, armature=rotors[joint.name]))
        if rotors.get(joint.name) is not None
        else joint
        for joint in result.model.joints
    )
    return replace(result, model=replace(result.model, joints=joints))


def add_elastic_joints(text: str, pairs: Sequence[EncoderPair]) -> str:
    """Return MJCF in which each of the joints moves its motor, and a further one its link.

    The further joint, `NAME link`, is about the same axis and is the twist of the drive: its spring
    has stiffness and damping, its position is the link's less the motor's.

    Raises
    ------
    UsageError
        If a motor has no inertia, without which MuJoCo cannot simulate it.
    """
    root = fromstring(text, XMLParser(target=TreeBuilder(insert_comments=True)))
    elastic = {pair.joint: pair for pair in pairs if pair.stiffness is not None}
    for body in [*root.iter("body")]:
        for joint in body.findall("joint"):
            pair = elastic.get(joint.get("name", ""))
            if pair is None:
                continue
            # Without inertia of its own a motor behind a spring has no motion.
            if not float(joint.get("armature", "0")) > 0.0:
                raise UsageError(
                    f"the motor of {pair.joint} has no inertia; elastic joints need the armature of"
                    " their motors",
                    cure=Cure("identify it: drive terms with armature, torque of the motor"),
                )
            twist = Element("joint", {key: joint.get(key, "") for key in ("type", "axis", "pos")})
            stiffness = pair.stiffness or (0.0, 0.0)
            damping = pair.damping or (0.0, 0.0)
            twist.attrib.update(
                name=f"{pair.joint} link", stiffness=repr(stiffness[0]), damping=repr(damping[0])
            )
            # Behind the motor's joint, as MuJoCo applies joints in order.
            body.insert(list(body).index(joint) + 1, twist)
    indent(root)
    return tostring(root, encoding="unicode") + "\n"


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
) -> Path:
    """Write the terms `replaced` of a robot in the file `mjcf`, whose joints have the drives.

    `robot` has the terms and its plain ones as identified.
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
        solref=", ".join(STIFF_FRICTION["solreffriction"].split()).join("[]"),
        solimp=", ".join(STIFF_FRICTION["solimpfriction"].split()).join("[]"),
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
        parameter.name: _write_array(
            [numbers.get(parameter.name, parameter.default) for numbers in having]
        )
        for parameter in term.nonlinear
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
