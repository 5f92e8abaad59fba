"""Joints of a base that can move in model files: MJCF has one free joint, URDF a root link."""

from __future__ import annotations

from xml.etree.ElementTree import Element

from asbuilt.description.model import RobotModel


def release_base(root: Element, model: RobotModel) -> None:
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


def drop_base_joints(root: Element, model: RobotModel) -> None:
    """Take the joints of a free base out, with the links between, so that it is the root link."""
    if not model.n_floating:
        return
    # The base's own link is the last of the chain: it stays, as the root.
    count = model.n_floating
    links = {model.root_link, *model.link_names[: count - 1]}
    # Frames marked on links that go would hang in the air.
    gone = {f"{name}_frame" for name in links}
    for element in [*root.findall("link"), *root.findall("joint")]:
        child = element.find("child")
        below = "" if child is None else child.get("link", "")
        base_joint = element.tag == "joint" and element.get("name") in model.joint_names[:count]
        if (
            base_joint
            or below in gone
            or (element.tag == "link" and element.get("name") in links | gone)
        ):
            root.remove(element)
