"""A robot as MJCF, the XML that MuJoCo compiles: one body per link, its frame the link's frame."""

from __future__ import annotations

from xml.etree.ElementTree import Element, SubElement, indent, tostring

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array
from asbuilt.description.appearance import Solid, link_solids, stretched_length
from asbuilt.description.inertia import LinkInertia
from asbuilt.description.model import ROOT, Joint, RobotModel
from asbuilt.description.rotation import quaternion_from_rotation
from asbuilt.errors import InertiaError

FEATHER = 1e-14
"""Mass [kg] and inertia [kg m^2] written for a massless link, for MuJoCo refuses bodies that have
none.
"""
PALETTE = ("0.90 0.49 0.13 1", "0.86 0.87 0.88 1")
"""Colours of housings and rods."""


def mjcf_text(model: RobotModel, *, actuators: bool = True, shapes: bool = True) -> str:
    """Return the robot as an MJCF document.

    Placements and inertias keep full precision, so MuJoCo's torques are those of the model.

    The body frame is the link frame: with the joint at `before motion(q) after`, the body stands at
    `before after`, and the joint's axis and anchor in it are `R_after^T z` and `-R_after^T
    p_after`. Armature, viscous and Coulomb friction become armature, damping and frictionloss; an
    offset has no place in MJCF and is left out. Joints that follow one other do so by an equality,
    those that follow several by a fixed tendon of constant length. `actuators` adds a torque motor
    per joint, `shapes` rods and housings that neither weigh nor collide.

    Raises
    ------
    InertiaError
        If a link has an inertia that no rigid body has, which MuJoCo refuses.

    Examples
    --------
    >>> from asbuilt.description.catalogue import bundled_robot
    >>> from asbuilt.description.formats.mjcf import read_mjcf
    >>> read_mjcf(mjcf_text(bundled_robot("ur10e"))).n_joints
    6
    """
    model = model.with_rotors
    root = Element("mujoco", model=model.name)
    SubElement(
        root,
        "compiler",
        angle="radian",
        autolimits="true",
        inertiafromgeom="false",
        balanceinertia="false",
    )
    SubElement(root, "option", gravity=_numbers(model.gravity), integrator="RK4", timestep="0.001")
    if shapes:
        _scene(root, stretched_length(model))
    world = SubElement(root, "worldbody")
    bodies = {ROOT: world}
    for k in model.link_order:
        bodies[k] = _body(bodies[model.parents[k]], model, k)
    for frame in model.frames:
        SubElement(
            bodies[frame.link],
            "site",
            {"name": frame.name, **_pose(frame.placement), "size": "0.005"},
        )
    if shapes:
        for solid in link_solids(model):
            _geom(bodies[solid.link], solid)
    _add_couplings(root, model)
    if actuators:
        motors = SubElement(root, "actuator")
        for joint in model.joints:
            torque = joint.limits.torque
            limit = {"ctrlrange": _numbers([-torque, torque])} if np.isfinite(torque) else {}
            SubElement(motors, "motor", {"name": joint.name, "joint": joint.name, **limit})
    indent(root)
    return tostring(root, encoding="unicode") + "\n"


def _add_couplings(root: Element, model: RobotModel) -> None:
    tendons, equality = Element("tendon"), Element("equality")
    for joint in model.followers:
        assert joint.mimic is not None
        factors, offset = joint.mimic.factors, joint.mimic.offset
        if len(factors) == 1:
            ((other, factor),) = factors.items()
            names = {"joint1": joint.name, "joint2": other}
            follows = [offset, factor, 0.0, 0.0, 0.0]
            SubElement(equality, "joint", {**names, "polycoef": _numbers(follows)})
            continue
        name = f"coupling of {joint.name}"
        tendon = SubElement(tendons, "fixed", name=name)
        for other, factor in ((joint.name, 1.0), *((k, -f) for k, f in factors.items())):
            SubElement(tendon, "joint", joint=other, coef=_numbers([factor]))
        follows = [offset, 0.0, 0.0, 0.0, 0.0]
        SubElement(equality, "tendon", tendon1=name, polycoef=_numbers(follows))
    root.extend(each for each in (tendons, equality) if len(each))


def _body(parent: Element, model: RobotModel, k: int) -> Element:
    joint, link = model.moving_joints[k], model.links[k]
    body = SubElement(parent, "body", {"name": link.name, **_pose(joint.before @ joint.after)})
    _inertial(body, link.inertia, f"{model.name}: link {link.name!r}")
    SubElement(body, "joint", {"name": joint.name, **_joint(joint)})
    return body


def _joint(joint: Joint) -> dict[str, str]:
    R, p = joint.after[:3, :3], joint.after[:3, 3]
    fields = {
        "type": "hinge" if joint.is_revolute else "slide",
        "axis": _numbers(R[2]),
        "pos": _numbers(-R.T @ p),
    }
    limits, drive = joint.limits, joint.drive
    if (
        joint.kind != "continuous"
        and np.isfinite(limits.lower)
        and np.isfinite(limits.upper)
        and limits.lower < limits.upper
    ):
        fields["range"] = _numbers([limits.lower, limits.upper])
    if np.isfinite(limits.torque):
        fields["actuatorfrcrange"] = _numbers([-limits.torque, limits.torque])
    for name, value in (
        ("armature", drive.armature),
        ("damping", drive.viscous),
        ("frictionloss", drive.coulomb),
    ):
        if value is not None and value != 0.0:
            fields[name] = _numbers([value])
    return fields


def _inertial(body: Element, inertia: LinkInertia, what: str) -> None:
    reason = inertia.inconsistency()
    if reason is not None:
        raise InertiaError(
            f"{what} cannot be written as MJCF, whose bodies must be possible: {reason}"
        )
    if inertia.mass <= FEATHER:
        SubElement(
            body, "inertial", pos="0 0 0", mass=repr(FEATHER), diaginertia=_numbers([FEATHER] * 3)
        )
        return
    moments, axes = np.linalg.eigh(inertia.inertia_about_com)
    if np.linalg.det(axes) < 0:
        axes[:, 0] *= -1.0
    moments = np.maximum(moments, FEATHER)
    moments[0] = max(moments[0], moments[2] - moments[1])
    pose = {"pos": _numbers(inertia.com), "quat": _numbers(quaternion_from_rotation(axes))}
    SubElement(
        body, "inertial", {**pose, "mass": repr(inertia.mass), "diaginertia": _numbers(moments)}
    )


def _scene(root: Element, reach: float) -> None:
    visual = SubElement(root, "visual")
    SubElement(visual, "global", offwidth="1920", offheight="1440")
    SubElement(
        root, "statistic", extent=_numbers([reach]), center=_numbers([0.0, 0.0, 0.4 * reach])
    )


def _geom(body: Element, solid: Solid) -> None:
    rod = solid.kind == "rod"
    ends = _numbers([*solid.start, *solid.stop])
    SubElement(
        body,
        "geom",
        {
            "type": "capsule" if rod else "cylinder",
            "fromto": ends,
            "size": _numbers([solid.radius]),
            "rgba": PALETTE[rod],
        },
        contype="0",
        conaffinity="0",
        group="1",
        mass="0",
    )


def _pose(placement: Array) -> dict[str, str]:
    fields = {"pos": _numbers(placement[:3, 3])}
    if not np.array_equal(placement[:3, :3], np.eye(3)):
        fields["quat"] = _numbers(quaternion_from_rotation(placement[:3, :3]))
    return fields


def _numbers(values: ArrayLike) -> str:
    return " ".join(repr(float(value) + 0.0) for value in np.ravel(values))
