"""A robot as MJCF, the XML that MuJoCo compiles: one body per link, its frame the link's frame."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import numpy as np
from numpy.polynomial import Polynomial

from asbuilt.arrays import Array
from asbuilt.codec import format_numbers
from asbuilt.description.appearance import Solid, link_solids, stretched_length
from asbuilt.description.inertia import LinkInertia
from asbuilt.description.model import ROOT, Joint, Loop, RobotModel
from asbuilt.description.rotation import quaternion_from_rotation
from asbuilt.description.structure.springs import spring_ends
from asbuilt.errors import InertiaError

FEATHER = 1e-14
"""Mass [kg] and inertia [kg m^2] written for a massless link, for MuJoCo refuses bodies that have
none.
"""
BALANCER_RADII = (0.1, 0.2)
"""Distances [m] of the ends of a balancer from its axis; only their product has an effect."""
PALETTE = ("0.90 0.49 0.13 1", "0.86 0.87 0.88 1")
"""Colours of housings and rods."""


def format_mjcf(model: RobotModel, *, actuators: bool = True, shapes: bool = True) -> str:
    """Return the robot as an MJCF document.

    Placements and inertias keep full precision, so MuJoCo's torques equal the model's.

    The body frame is the link frame: with the joint at `before motion(q) after`, the body stands at
    `before after`, and the joint's axis and anchor in it are `R_after^T z` and `-R_after^T
    p_after`. Armature, viscous and Coulomb friction become armature, damping and frictionloss;
    an offset has no place in MJCF and is left out. Springs are the joint's, or spatial tendons.
    Joints that follow one other do so by an equality, those that follow several by a fixed
    tendon of constant length. Loops become equalities, and the reference posture of the joints
    is one at which they are closed. `actuators` adds a torque motor per joint, `shapes` rods
    and housings that neither weigh nor collide.

    Raises
    ------
    InertiaError
        If a link has an inertia that no rigid body has, which MuJoCo refuses.

    Examples
    --------
    >>> from asbuilt.description.load import bundled_robot
    >>> from asbuilt.description.formats.mjcf import read_mjcf
    >>> read_mjcf(format_mjcf(bundled_robot("ur10e"))).n_joints
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
    SubElement(
        root, "option", gravity=format_numbers(model.gravity), integrator="RK4", timestep="0.001"
    )
    if shapes:
        _add_scene(root, stretched_length(model))
    bodies = {ROOT: SubElement(root, "worldbody")}
    at = reference_posture(model)
    for k in model.link_order:
        bodies[k] = _add_body(bodies[model.parents[k]], model, k, float(at[k]))
    for frame in model.frames:
        SubElement(
            bodies[frame.link],
            "site",
            {"name": frame.name, **_describe_pose(frame.placement), "size": "0.005"},
        )
    if shapes:
        for solid in link_solids(model):
            _add_geom(bodies[solid.link], solid)
    _add_equalities(root, model, at)
    _add_springs(root, model, bodies)
    if actuators:
        motors = SubElement(root, "actuator")
        for joint in model.joints:
            torque = joint.limits.torque
            limit = {"ctrlrange": format_numbers([-torque, torque])} if np.isfinite(torque) else {}
            SubElement(motors, "motor", {"name": joint.name, "joint": joint.name, **limit})
    indent(root)
    return tostring(root, encoding="unicode") + "\n"


def reference_posture(model: RobotModel) -> Array:
    """Return where the joints of all links are in the reference posture of the file (n_links,).

    That is zero, or the first posture at which loops are closed.
    """
    closure = model.closure
    if closure is None:
        return np.zeros(model.n_links)
    return model.link_positions(closure.home[: model.n_joints])


def _add_equalities(root: Element, model: RobotModel, at: Array) -> None:
    tendons = Element("tendon")
    equality = Element("equality")
    rest = {joint.name: float(q) for joint, q in zip(model.moving_joints, at, strict=True)}
    for joint in model.followers:
        assert joint.mimic is not None
        factors = joint.mimic.factors
        offset = joint.mimic.offset
        if len(factors) == 1:
            ((other, factor),) = factors.items()
            _add_polynomial(equality, (joint.name, other), (offset, factor), rest)
        elif factors:
            name = f"coupling of {joint.name}"
            tendon = SubElement(tendons, "fixed", name=name)
            terms = {joint.name: 1.0} | {k: -f for k, f in factors.items()}
            for other, factor in terms.items():
                SubElement(tendon, "joint", joint=other, coef=format_numbers([factor]))
            offset -= sum(factor * rest[k] for k, factor in terms.items())
            follows = [offset, 0.0, 0.0, 0.0, 0.0]
            SubElement(equality, "tendon", tendon1=name, polycoef=format_numbers(follows))
    for loop in model.loops:
        _add_loop(equality, model, loop, rest)
    root.extend(each for each in (tendons, equality) if len(each))


def _add_springs(root: Element, model: RobotModel, bodies: Mapping[int, Element]) -> None:
    """Add springs between two links as spatial tendons; cylinders are springs that push.

    A cylinder is a spring of stiffness `Pc rate` and free length `length + 1 / rate`.
    """
    tendons = next(root.iter("tendon"), Element("tendon"))
    written = len(tendons)
    for k, joint in enumerate(model.joints):
        for key, numbers in joint.drive.terms.items():
            is_ideal = key == "balancer" and numbers.get("harmonics", 1.0) <= 1.0
            spring = _convert_to_spring(numbers) if is_ideal else numbers
            rate, free = _read_tendon_spring(key, spring)
            if not rate:
                continue
            ends = spring_ends(joint, spring)
            name = f"{key} at {joint.name}"
            tendon = Element(
                "spatial",
                name=name,
                stiffness=format_numbers([rate]),
                springlength=format_numbers([free]),
            )
            for side, body, point in zip("ab", (joint.parent, k), ends, strict=True):
                site = {"name": f"{name} {side}", "pos": format_numbers(point), "size": "0.005"}
                SubElement(bodies[body], "site", site)
                SubElement(tendon, "site", site=site["name"])
            tendons.append(tendon)
    if len(tendons) and not written:
        root.append(tendons)


def _read_tendon_spring(key: str, numbers: Mapping[str, float]) -> tuple[float, float]:
    """Return stiffness [N/m] and free length [m] of a drive term; no stiffness if it has none."""
    if key in ("extension_spring", "balancer"):
        return numbers.get("Ke", 0.0), numbers.get("length", 0.0)
    growth = numbers.get("rate", 0.0) if key == "cylinder" else 0.0
    stiffness = numbers.get("Pc", 0.0) * growth
    return stiffness, numbers["length"] + 1.0 / growth if stiffness else 0.0


def _convert_to_spring(numbers: Mapping[str, float]) -> dict[str, float]:
    """Return the spring without free length whose torque is `Bs sin(q) + Bc cos(q)`.

    `Ke inner outer sin(q + angle)`; its ends never meet, since they are at different radii.
    """
    sine = numbers.get("Bs", 0.0)
    cosine = numbers.get("Bc", 0.0)
    inner, outer = BALANCER_RADII
    return {
        "Ke": math.hypot(sine, cosine) / (inner * outer),
        "angle": math.atan2(cosine, sine),
        "inner": inner,
        "outer": outer,
        "length": 0.0,
    }


def _add_polynomial(
    equality: Element, joints: Sequence[str], polynomial: Sequence[float], rest: Mapping[str, float]
) -> None:
    """Add `y = c_0 + c_1 x + ...`, which MJCF states by distances from the reference posture."""
    moved = Polynomial(polynomial)
    if len(joints) > 1:
        moved = moved(Polynomial([rest[joints[1]], 1.0]))
    terms = np.zeros(5)
    terms[: len(moved.coef)] = moved.coef
    terms[0] -= rest[joints[0]]
    names = {f"joint{k + 1}": name for k, name in enumerate(joints)}
    SubElement(equality, "joint", {**names, "polycoef": format_numbers(terms)})


def _add_loop(equality: Element, model: RobotModel, loop: Loop, rest: Mapping[str, float]) -> None:
    name = {"name": loop.name} if loop.name else {}
    if loop.kind == "joint":
        at = {joint.name_in_tree: joint.name for joint in model.moving_joints}
        joints = [at.get(joint, joint) for joint in loop.joints]
        _add_polynomial(equality, joints, loop.polynomial, rest)
        return
    ends = [model.place_of(link, point) for link, point in loop.ends]
    if ends[0][0] == ROOT or (loop.kind == "weld" and ends[1][0] != ROOT):
        ends.reverse()  # body2 may be left out, the anchor of a weld is in it
    (one, anchor), (other, point) = ends
    links = {"body1": model.links[one].name}
    if other != ROOT:
        links["body2"] = model.links[other].name
    if loop.kind == "weld":
        anchor = point
    SubElement(equality, loop.kind, {**name, **links, "anchor": format_numbers(anchor)})


def _add_body(parent: Element, model: RobotModel, k: int, at: float) -> Element:
    joint = model.moving_joints[k]
    link = model.links[k]
    pose = joint.before @ joint.moved(at) @ joint.after if at else joint.before @ joint.after
    body = SubElement(parent, "body", {"name": link.name, **_describe_pose(pose)})
    _add_inertial(body, link.inertia, f"{model.name}: link {link.name!r}")
    rest = {"ref": format_numbers([at])} if at else {}
    SubElement(body, "joint", {"name": joint.name, **_describe_joint(joint), **rest})
    return body


def _describe_joint(joint: Joint) -> dict[str, str]:
    R = joint.after[:3, :3]
    p = joint.after[:3, 3]
    fields = {
        "type": "hinge" if joint.is_revolute else "slide",
        "axis": format_numbers(R[2]),
        "pos": format_numbers(-R.T @ p),
    }
    limits = joint.limits
    drive = joint.drive
    if (
        joint.kind != "continuous"
        and np.isfinite(limits.lower)
        and np.isfinite(limits.upper)
        and limits.lower < limits.upper
    ):
        fields["range"] = format_numbers([limits.lower, limits.upper])
    if np.isfinite(limits.torque):
        fields["actuatorfrcrange"] = format_numbers([-limits.torque, limits.torque])
    for name, value in (
        ("armature", drive.armature),
        ("damping", drive.viscous),
        ("frictionloss", drive.coulomb),
    ):
        if value is not None and value != 0.0:
            fields[name] = format_numbers([value])
    if stiffness := (spring := drive.terms.get("spring", {})).get("Ks"):
        fields.update(
            stiffness=format_numbers([stiffness]),
            springref=format_numbers([spring.get("rest", 0.0)]),
        )
    return fields


def _add_inertial(body: Element, inertia: LinkInertia, what: str) -> None:
    reason = inertia.inconsistency()
    if reason is not None:
        raise InertiaError(
            f"{what} cannot be written as MJCF, whose bodies must be possible: {reason}"
        )
    if inertia.mass <= FEATHER:
        SubElement(
            body,
            "inertial",
            pos="0 0 0",
            mass=repr(FEATHER),
            diaginertia=format_numbers([FEATHER] * 3),
        )
        return
    moments, axes = inertia.principal_axes
    moments = np.maximum(moments, FEATHER)
    moments[0] = max(moments[0], moments[2] - moments[1])
    pose = {
        "pos": format_numbers(inertia.com),
        "quat": format_numbers(quaternion_from_rotation(axes)),
    }
    SubElement(
        body,
        "inertial",
        {**pose, "mass": repr(inertia.mass), "diaginertia": format_numbers(moments)},
    )


def _add_scene(root: Element, reach: float) -> None:
    SubElement(SubElement(root, "visual"), "global", offwidth="1920", offheight="1440")
    SubElement(
        root,
        "statistic",
        extent=format_numbers([reach]),
        center=format_numbers([0.0, 0.0, 0.4 * reach]),
    )


def _add_geom(body: Element, solid: Solid) -> None:
    rod = solid.kind == "rod"
    ends = format_numbers([*solid.start, *solid.stop])
    SubElement(
        body,
        "geom",
        {
            "type": "capsule" if rod else "cylinder",
            "fromto": ends,
            "size": format_numbers([solid.radius]),
            "rgba": PALETTE[rod],
        },
        contype="0",
        conaffinity="0",
        group="1",
        mass="0",
    )


def _describe_pose(placement: Array) -> dict[str, str]:
    fields = {"pos": format_numbers(placement[:3, 3])}
    if not np.array_equal(placement[:3, :3], np.eye(3)):
        fields["quat"] = format_numbers(quaternion_from_rotation(placement[:3, :3]))
    return fields
