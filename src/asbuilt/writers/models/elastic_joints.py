"""MJCF of a robot with elastic drives: a joint for the motor and one for the link."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from xml.etree.ElementTree import Element, TreeBuilder, XMLParser, fromstring, indent, tostring

from asbuilt.errors import UsageError
from asbuilt.findings import Cure
from asbuilt.identification.calibration.encoders import EncoderPair
from asbuilt.identification.result.result import IdentificationResult

KEPT = ("type", "axis", "pos")


def with_rotors_described(result: IdentificationResult) -> IdentificationResult:
    """Return a result whose description has the rotors that two encoders show.

    Where a rotor is one parameter with its link, it is then taken from the link's inertia.

    Raises
    ------
    UsageError
        If no stiffness is determined, or joints of the robot are coupled or in loops.
    """
    rotors = {each.joint: each.rotor for each in result.encoders if each.stiffness is not None}
    if not rotors:
        raise UsageError(
            f"the result of {result.robot} has no stiffness of a joint, by which it would be"
            " elastic",
            cure=Cure(
                "identify from a log with positions of motors and links, q_motor_*, q_link_*"
            ),
        )
    if result.model.coupling is not None:
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


def elastic_mjcf(text: str, pairs: Sequence[EncoderPair]) -> str:
    """Return MJCF in which each of the joints moves its motor, and a further one its link.

    The further joint, `NAME link`, is about the same axis and is the twist of the drive: its spring
    has stiffness and damping, its position is that of the link less that of the motor.

    Raises
    ------
    UsageError
        If a motor has no inertia, without which MuJoCo cannot simulate it.
    """
    root = fromstring(text, XMLParser(target=TreeBuilder(insert_comments=True)))
    elastic = {each.joint: each for each in pairs if each.stiffness is not None}
    for body in [*root.iter("body")]:
        for joint in body.findall("joint"):
            pair = elastic.get(joint.get("name", ""))
            if pair is None:
                continue
            if not float(joint.get("armature", "0")) > 0.0:
                raise UsageError(
                    f"the motor of {pair.joint} has no inertia; elastic joints need the armature of"
                    " their motors",
                    cure=Cure("identify it: drive terms with armature, torque of the motor"),
                )
            twist = Element("joint", {key: joint.get(key, "") for key in KEPT})
            stiffness, damping = pair.stiffness or (0.0, 0.0), pair.damping or (0.0, 0.0)
            twist.attrib.update(
                name=f"{pair.joint} link", stiffness=repr(stiffness[0]), damping=repr(damping[0])
            )
            body.insert(list(body).index(joint) + 1, twist)
    indent(root)
    return tostring(root, encoding="unicode") + "\n"
