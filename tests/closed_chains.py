"""Robots with closed chains, as robot files; lengths in m, masses of round numbers."""

from __future__ import annotations

from asbuilt.description import RobotModel, bundled_robot
from asbuilt.description.formats.toml import robot_from_toml


def body(mass: float, com: tuple[float, float, float]) -> str:
    size = 0.01 * mass
    return (
        f"mass = {mass}\ncom = {list(com)}\ninertia_about_com = {{ Ixx = {size}, Iyy ="
        f" {1.4 * size}, Izz = {1.8 * size}, Ixy = {0.1 * size} }}\n"
    )


def link(name, parent, axis, xyz, mass=0.0, com=(0.0, 0.0, 0.0), kind="revolute", limits=""):
    lines = [
        "[[links]]",
        f'name = "{name}"\njoint = "{name}_joint"\nkind = "{kind}"\nparent = "{parent}"',
        f"axis = {list(axis)}\norigin = {{ xyz = {list(xyz)} }}",
        f"limits = {{ {limits} }}" if limits else "",
        body(mass, com) if mass else "negligible = true",
    ]
    return "\n".join(line for line in lines if line) + "\n\n"


def loop(link_a, point_a, link_b, point_b, kind="connect"):
    return (
        f'[[loops]]\nkind = "{kind}"\nlink_a = "{link_a}"\npoint_a = {list(point_a)}\n'
        f'link_b = "{link_b}"\npoint_b = {list(point_b)}\n\n'
    )


def head(name, passive=(), posture=None):
    joints = ", ".join(f'"{each}_joint"' for each in passive)
    at = ", ".join(f"{key}_joint = {value}" for key, value in (posture or {}).items())
    return f'name = "{name}"\npassive = [{joints}]\nposture = {{ {at} }}\n\n'


Y = (0, 1, 0)


def palletizer() -> str:
    """Two motors at the shoulder, the second through a rod; three rods keep the wrist level."""
    passive = ("upper", "rod", "lower_guide", "triangle", "upper_guide", "wrist")
    return (
        head("palletizer", passive, {"upper": 0.3, "lever": 0.3, "rod": -0.3})
        + link("column", "root", (0, 0, 1), (0, 0, 0.5), 40, (0.1, 0, 0.1), limits="torque = 900")
        + link("lower", "column", Y, (0.2, 0, 0), 20, (0, 0.01, 0.3),
               limits="lower = -0.5, upper = 0.8, torque = 900")
        + link("upper", "lower", Y, (0, 0, 0.6), 12, (0.3, 0.01, 0.02))
        + link("lever", "column", Y, (0.2, 0, 0), 4, (-0.1, 0, 0),
               limits="lower = -0.5, upper = 0.6, torque = 900")
        + link("rod", "lever", Y, (-0.2, 0, 0), 2, (0, 0.02, 0.3))
        + link("lower_guide", "column", Y, (0.1, 0, 0.1), 1.5, (0, 0.02, 0.3))
        + link("triangle", "lower", Y, (0, 0, 0.6), 2.5, (0, 0.02, 0.05))
        + link("upper_guide", "triangle", Y, (0.1, 0, 0.1), 1.2, (0.3, 0.02, 0))
        + link("wrist", "upper", Y, (0.7, 0, 0), 3, (0.1, 0, 0.03))
        + loop("rod", (0, 0, 0.6), "upper", (-0.2, 0, 0))
        + loop("lower_guide", (0, 0, 0.6), "triangle", (-0.1, 0, 0.1))
        + loop("upper_guide", (0.7, 0, 0), "wrist", (0.1, 0, 0.1))
    )  # fmt: skip


def delta() -> str:
    """Three arms in directions of 120 degrees move a platform that does not turn."""
    import math

    passive = ["x", "y", "platform"]
    text, loops = "", ""
    for k in range(3):
        c, s = math.cos(2 * math.pi * k / 3), math.sin(2 * math.pi * k / 3)
        arm, swing, rod = f"arm_{k}", f"swing_{k}", f"rod_{k}"
        passive += [swing, rod]
        at = [0.2 * c, 0.2 * s, 0.0]
        frame = f"rpy = [0, 0, {2 * math.pi * k / 3}]"
        text += link(arm, "root", Y, at, 0.5, (0.12, 0.01, 0),
                     limits="lower = -0.3, upper = 0.7, torque = 40").replace(
            f"xyz = {at}", f"xyz = {at}, {frame}")  # fmt: skip
        text += link(swing, arm, Y, (0.3, 0, 0))
        text += link(rod, swing, (1, 0, 0), (0, 0, 0), 0.2, (0.01, 0, -0.3))
        loops += loop(rod, (0, 0, -0.6), "platform", (0.06 * c, 0.06 * s, 0.0))
    text += link("x", "root", (1, 0, 0), (0, 0, 0), kind="prismatic")
    text += link("y", "x", (0, 1, 0), (0, 0, 0), kind="prismatic")
    text += link("platform", "y", (0, 0, 1), (0, 0, -0.5), 0.8, (0, 0, 0.02), kind="prismatic")
    guess = {f"arm_{k}": 0.2 for k in range(3)} | {f"swing_{k}": 0.4 for k in range(3)}
    return head("delta", passive, guess) + text + loops


def piston() -> str:
    """A cylinder that turns on the ground pushes a lever."""
    return (
        head("piston", ("lever", "cylinder"), {"lever": -0.4, "cylinder": 0.8, "piston": 0.1})
        + link("lever", "root", Y, (0, 0, 0.5), 10, (0.5, 0.02, 0.02))
        + link("cylinder", "root", Y, (0.1, 0, 0), 4, (0.02, 0.01, 0.15))
        + link("piston", "cylinder", (0, 0, 1), (0, 0, 0.4), 2, (0, 0, -0.1), kind="prismatic",
               limits="lower = 0.0, upper = 0.25, velocity = 0.5, torque = 3000")
        + loop("piston", (0, 0, 0.1), "lever", (0.4, 0, 0))
    )  # fmt: skip


def ankle() -> str:
    """Two cranks on the shin tilt the foot about two axes by rods with universal joints."""
    passive = ["pitch", "foot"]
    text, loops = "", ""
    for side, y in (("left", 0.04), ("right", -0.04)):
        crank, swing, rod = f"{side}_crank", f"{side}_swing", f"{side}_rod"
        passive += [swing, rod]
        text += link(crank, "root", Y, (0, y, 0.3 if side == "left" else 0.25), 0.2, (-0.02, 0, 0),
                     limits="lower = -0.5, upper = 0.5, torque = 60")  # fmt: skip
        text += link(swing, crank, Y, (-0.05, 0, 0))
        length = 0.3 if side == "left" else 0.25
        text += link(rod, swing, (1, 0, 0), (0, 0, 0), 0.1, (0, 0, -0.5 * length))
        loops += loop(rod, (0, 0, -length), "foot", (-0.05, y, 0.0))
    text += link("pitch", "root", Y, (0, 0, 0))
    text += link("foot", "pitch", (1, 0, 0), (0, 0, 0), 1.2, (0.04, 0.003, -0.03))
    return head("ankle", passive) + text + loops


TEXTS = {"palletizer": palletizer, "delta": delta, "piston": piston, "ankle": ankle}
NAMES = ("four-bar", *TEXTS)


def robot_with_loops(name: str) -> RobotModel:
    """Return one of the robots."""
    return bundled_robot(name) if name == "four-bar" else robot_from_toml(TEXTS[name]())
