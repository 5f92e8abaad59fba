"""Free base: six joints without a drive that carry the first link of a robot which stands on none.

The pose of the base in the world is `(x, y, z)` and then turns about z, y and x: yaw, pitch and
roll. Such joints are ordinary ones, so that a robot with a free base is a tree as any other. The
links between them have no inertia. A planar base has x, y and yaw alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from xml.etree.ElementTree import Element, SubElement

from asbuilt.description.inertia import LinkInertia
from asbuilt.description.structure.parts import BaseKind, Joint, Link
from asbuilt.errors import DescriptionError

AXES = {
    "base_x": ("prismatic", "1 0 0"),
    "base_y": ("prismatic", "0 1 0"),
    "base_z": ("prismatic", "0 0 1"),
    "base_yaw": ("continuous", "0 0 1"),
    "base_pitch": ("continuous", "0 1 0"),
    "base_roll": ("continuous", "1 0 0"),
}
"""Joints of a free base in their order, with kind and axis."""
JOINTS_OF: dict[BaseKind, tuple[str, ...]] = {
    "fixed": (),
    "free": tuple(AXES),
    "planar": ("base_x", "base_y", "base_yaw"),
}
WORLD = "world"


def classify_base(joints: Sequence[Joint], links: Sequence[Link]) -> BaseKind:
    """Return how the base can move to which the first joints belong."""
    # Six first: a planar base has the names of three of them.
    kinds: tuple[BaseKind, ...] = ("free", "planar")
    for kind in kinds:
        names = JOINTS_OF[kind]
        between = links[: len(names) - 1]
        if tuple(joint.name for joint in joints[: len(names)]) == names and all(
            link.negligible for link in between
        ):
            return kind
    return "fixed"


def clear_base_inertias(
    robot: str, joints: Sequence[Joint], links: Sequence[Link], kind: BaseKind
) -> tuple[Link, ...]:
    """Return the links of a robot, those between the joints of its base without inertia.

    Raises `DescriptionError` where other joints come first.
    """
    names = JOINTS_OF[kind]
    if tuple(joint.name for joint in joints[: len(names)]) != names:
        raise DescriptionError(
            f"{robot}: the joints of the free base must come first, but the first joint is"
            f" {joints[0].name!r}; put the body that floats before all others"
        )
    return tuple(
        replace(link, inertia=LinkInertia.zero(), inertia_known=True, negligible=True)
        if k < len(names) - 1
        else link
        for k, link in enumerate(links)
    )


def free_urdf(root: Element, kind: BaseKind, source: str) -> None:
    """Let the joints of a base carry the root link of a URDF, in place of a floating joint.

    Raises `DescriptionError` where the root link has no mass, as one that stands still needs none.
    """
    links = {link.get("name", ""): link for link in root.findall("link")}
    for joint in root.findall("joint[@type='floating']"):
        root.remove(joint)
        parent = joint.find("parent")
        world = "" if parent is None else parent.get("link", "")
        # A world link of its own, without mass, is replaced by the base's.
        if world in links and links[world].find("inertial") is None:
            root.remove(links.pop(world))
    tops = links.keys() - {child.get("link", "") for child in root.findall("joint/child")}
    if len(tops) != 1:
        return  # the reader says what is wrong
    (top,) = tops
    if not _carries_mass(root, top):
        raise DescriptionError(
            f"{source}: the root link {top!r} has no <inertial>; a free base needs the mass of the"
            " body that floats"
        )
    above = WORLD
    # A name that no link has yet.
    while above in links:
        above = f"{above}_"
    SubElement(root, "link", name=above)
    for name, below in zip(JOINTS_OF[kind], (*JOINTS_OF[kind][:-1], top), strict=True):
        sort, axis = AXES[name]
        if below != top:
            SubElement(root, "link", name=below)
        joint = SubElement(root, "joint", name=name, type=sort)
        SubElement(joint, "parent", link=above)
        SubElement(joint, "child", link=below)
        SubElement(joint, "axis", xyz=axis)
        above = below


def free_mjcf(root: Element, kind: BaseKind, source: str) -> None:
    """Let the joints of a base take the place of the free joint of an MJCF model.

    The pose of its body then follows from the joints alone, and shapes with a name, such as feet,
    become sites. Raises `DescriptionError` unless one body has a free joint.
    """
    free = [
        (body, joint)
        for body in root.iter("body")
        for joint in [*body.findall("freejoint"), *body.findall("joint[@type='free']")]
    ]
    if len(free) != 1:
        raise DescriptionError(
            f"{source}: {len(free)} bodies have a free joint; a robot with a free base has one"
            " <freejoint/>, in its first body"
        )
    body, joint = free[0]
    place = list(body).index(joint)
    body.remove(joint)
    # The pose comes from the joints alone: a constant one would be added twice.
    for name in ("pos", "quat", "euler", "axisangle", "xyaxes", "zaxis"):
        body.attrib.pop(name, None)
    body.set("pos", "0 0 0")
    # Defaults of a class would give these joints springs or friction.
    plain = {
        "stiffness": "0",
        "damping": "0",
        "armature": "0",
        "frictionloss": "0",
        "limited": "false",
    }
    for k, name in enumerate(JOINTS_OF[kind]):
        sort, axis = AXES[name]
        sort = "slide" if sort == "prismatic" else "hinge"
        own = {"name": name, "type": sort, "axis": axis, "pos": "0 0 0", "ref": "0"}
        body.insert(place + k, Element("joint", own | plain))
    taken = {site.get("name") for site in root.iter("site")}
    for holder in list(root.iter("body")):
        for geom in holder.findall("geom[@name]"):
            if geom.get("mesh") is None and geom.get("name") not in taken:
                place_of = {"name": geom.get("name", ""), "pos": geom.get("pos", "0 0 0")}
                SubElement(holder, "site", place_of)


def _carries_mass(root: Element, top: str) -> bool:
    """Return whether a link, or one that is fixed to it, has an inertia."""
    inertial = {link.get("name") for link in root.findall("link[inertial]")}
    held = {top}
    fixed = root.findall("joint[@type='fixed']")
    # At most as many rounds as fixed joints: a chain of them passes the mass up.
    for _ in fixed:
        for joint in fixed:
            parent = joint.find("parent")
            child = joint.find("child")
            if parent is not None and child is not None and parent.get("link") in held:
                held.add(child.get("link", ""))
    return bool(held & inertial)
