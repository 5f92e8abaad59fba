"""Descriptions of robots with legs, from public figures: like a Go2, a Solo12 and a G1.

A leg is stated once, and the others are its mirror images. Legs of the Go2 and arms of the G1 are
those of the bundled robots; the rest is after unitree_go2/go2.xml and unitree_g1/g1.xml of the
MuJoCo Menagerie (Unitree Robotics and Google DeepMind, BSD-3-Clause), and after solo12.urdf of the
Open Dynamic Robot Initiative (Grimminger et al., RA-L 5, 2020; BSD-3-Clause).
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement, fromstring, tostring

import numpy as np

from asbuilt.description.load import load_robot
from asbuilt.description.model import RobotModel
from asbuilt.writers.models.urdf import format_urdf


@dataclass(frozen=True, slots=True)
class Body:
    """A body on a turning joint; `mirrored` are its axes that another side turns round.

    `turn` is its pitch at zero [rad], `inertia` about the centre of mass Ixx Iyy Izz Ixy Ixz Iyz.
    """

    name: str
    place: tuple[float, float, float]
    axis: str
    mass: float
    com: tuple[float, float, float]
    inertia: tuple[float, ...]
    turn: float = 0.0

    def mirrored(self, x: int, y: int) -> Body:
        """Return the body of a leg whose x, or y, runs the other way (-1)."""
        signs = x, y, 1
        products = x * y, x, y
        return replace(
            self,
            place=tuple(s * each for s, each in zip(signs, self.place, strict=True)),
            com=tuple(s * each for s, each in zip(signs, self.com, strict=True)),
            inertia=(
                *self.inertia[:3],
                *(s * each for s, each in zip(products, self.inertia[3:], strict=True)),
            ),
        )


SOLO_TRUNK = 1.25124, (-8.3e-4, 0, -6e-4), (2.6622e-3, 1.38851e-2, 1.60537e-2, -3.68e-5, -1.7e-5, 0)
SOLO_LEG = (
    Body(
        "HAA",
        (0.2141, 0.0875, 0),
        "1 0 0",
        0.14196,
        (-0.094073, -0.004389, 0),
        (2.802e-5, 3.8264e-4, 3.805e-4, 3.687e-5, 0, 0),
    ),
    Body(
        "HFE",
        (-0.0195, 0.014, 0),
        "0 1 0",
        0.147373,
        (0, 0.017676, -0.078382),
        (4.154e-4, 4.1637e-4, 2.982e-5, 0, 0, -4.589e-5),
    ),
    Body(
        "KFE",
        (0, 0.03745, -0.16),
        "0 1 0",
        0.023183,
        (0, 0.007767, -0.070039),
        (8.508e-5, 8.58e-5, 1.39e-6, 0, 0, -2e-6),
    ),
)
GO2_TRUNK = (
    6.921,
    (0.021112, 0, -0.005366),
    (0.02448, 0.09808, 0.107, 1.217e-4, 1.485e-3, -3.12e-5),
)
G1_PELVIS = 2.86, (0, 0, -0.07605), (0.007914, 0.006984, 0.00594, 0, 1.6e-6, 0)
G1_TORSO = Body(
    "torso",
    (0, 0, 0),
    "0 0 1",
    7.52036,
    (0.001878, 0.002295, 0.208747),
    (0.1285, 0.1117, 0.03507, -1.016e-4, 1.192e-3, 9.541e-4),
)
G1_LEG = (
    Body(
        "hip_pitch",
        (0, 0.06445, -0.1027),
        "0 1 0",
        1.299,
        (0.001962, 0.049392, -0.000941),
        (1.387e-3, 9.059e-4, 9.196e-4, -1.63e-5, -1e-6, -4.24e-5),
        -0.34907,
    ),
    Body(
        "hip_roll",
        (0, 0.0523, 0),
        "1 0 0",
        1.446,
        (0.024757, -0.001036, -0.086323),
        (2.27e-3, 2.304e-3, 1.6e-3, -3.7e-6, -3.789e-4, -1.8e-5),
    ),
    Body(
        "hip_yaw",
        (0.01966, -0.001214, -0.1241),
        "0 0 1",
        2.052,
        (-0.053554, -0.011477, -0.14067),
        (8.726e-3, 1.137e-2, 4.279e-3, -4.402e-4, -3.668e-3, -6.654e-4),
    ),
    Body(
        "knee",
        (-0.078292, -0.001734, -0.177225),
        "0 1 0",
        2.252,
        (0.005505, 0.006534, -0.116629),
        (1.244e-2, 1.267e-2, 1.986e-3, 5.35e-5, -4.376e-4, -6.825e-4),
        0.50960,
    ),
    Body(
        "ankle_pitch",
        (0, 0.004069, -0.30007),
        "0 1 0",
        0.074,
        (-0.007269, 0, 0.011137),
        (8.4e-6, 1.89e-5, 1.26e-5, 0, -2.9e-6, 0),
        -0.16053,
    ),
    Body(
        "ankle_roll",
        (0, 0, -0.017558),
        "1 0 0",
        0.391,
        (0.024762, 2e-5, -0.012526),
        (1.552e-4, 1.066e-3, 1.098e-3, -1e-7, 7.51e-5, 1e-7),
    ),
)
SIDES = {"FL": (1, 1), "FR": (1, -1), "HL": (-1, 1), "HR": (-1, -1)}
SOLE = ((-0.06, 0.035), (-0.06, -0.035), (0.13, 0.035), (0.13, -0.035))
"""Corners of a sole [m] by its ankle, 15 mm wider to each side than the G1's."""


@dataclass(frozen=True, slots=True)
class Legged:
    """A robot with legs as it is driven and logged.

    `feet` are links on the ground, `radius` [m] that of their balls, or `sole` the height [m] of
    the ankle above flat soles. `rest` are the joints of a leg as it stands, `kp` and `kd` the
    gains of the joints, `armature` and `viscous` what they have, `noise` [N m] of the torque.
    """

    build: Callable[[], Element]
    feet: tuple[str, ...]
    rest: dict[str, float]
    kp: float
    kd: float
    armature: float
    viscous: float
    noise: float
    radius: float = 0.0
    sole: float = 0.0

    @property
    def contacts(self) -> str:
        kind = "flat" if self.sole else f"{self.radius}"
        return ",".join(f"{foot}:{kind}" for foot in self.feet)

    def model(self) -> RobotModel:
        """Return the robot as described, with armature and viscous friction."""
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder, "robot.urdf")
            file.write_text(tostring(self.build(), encoding="unicode"))
            model = load_robot(file, base="free", contacts=self.contacts)
        joints = list(model.joints)
        for k in range(model.n_floating, len(joints)):
            drive = type(joints[k].drive)(armature=self.armature, viscous=self.viscous)
            joints[k] = replace(joints[k], drive=drive)
        return replace(model, joints=tuple(joints))


def _solo() -> Element:
    robot = Element("robot", name="like-solo12")
    _inertial(SubElement(robot, "link", name="trunk"), *SOLO_TRUNK)
    for side, signs in SIDES.items():
        last = _chain(robot, "trunk", side, [each.mirrored(*signs) for each in SOLO_LEG])
        _fixed(robot, last, f"{side}_FOOT", (0.0, 0.009 * signs[1], -0.16))
    return robot


def _go2() -> Element:
    robot = fromstring(format_urdf(load_robot("go2")))
    _inertial(_link(robot, "trunk"), *GO2_TRUNK)
    return robot


def _g1() -> Element:
    robot = fromstring(format_urdf(load_robot("g1-arms")))
    _link(robot, "torso").set("name", "torso_link")
    for joint in robot.findall("joint"):
        parent, child = joint.find("parent"), joint.find("child")
        if parent is not None and parent.get("link") == "torso":
            parent.set("link", "torso_link")
        if child is not None and "wrist" in child.get("link", ""):
            joint.set("type", "fixed")
    pelvis = Element("link", name="pelvis")
    robot.insert(0, pelvis)
    _inertial(pelvis, *G1_PELVIS)
    robot.remove(_link(robot, "torso_link"))
    _chain(robot, "pelvis", "", [G1_TORSO])
    for side, y in (("l", 1), ("r", -1)):
        _chain(robot, "pelvis", side, [each.mirrored(1, y) for each in G1_LEG])
    return robot


def _link(robot: Element, name: str) -> Element:
    return next(each for each in robot.findall("link") if each.get("name") == name)


def _chain(robot: Element, parent: str, side: str, bodies: list[Body]) -> str:
    """Add bodies one after another, and return the name of the last."""
    for body in bodies:
        name = "_".join(filter(None, (side, body.name)))
        link = SubElement(robot, "link", name=f"{name}_link")
        _inertial(link, body.mass, body.com, body.inertia)
        joint = SubElement(robot, "joint", name=name, type="continuous")
        SubElement(joint, "origin", xyz=_text(body.place), rpy=f"0 {body.turn} 0")
        SubElement(joint, "parent", link=parent)
        SubElement(joint, "child", link=f"{name}_link")
        SubElement(joint, "axis", xyz=body.axis)
        parent = f"{name}_link"
    return parent


def _fixed(robot: Element, parent: str, name: str, place: tuple[float, ...]) -> None:
    SubElement(robot, "link", name=name)
    joint = SubElement(robot, "joint", name=f"{name}_fixed", type="fixed")
    SubElement(joint, "origin", xyz=_text(place))
    SubElement(joint, "parent", link=parent)
    SubElement(joint, "child", link=name)


def _inertial(
    link: Element, mass: float, com: tuple[float, ...], inertia: tuple[float, ...]
) -> None:
    own = SubElement(link, "inertial")
    SubElement(own, "origin", xyz=_text(com))
    SubElement(own, "mass", value=str(mass))
    names = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    SubElement(own, "inertia", {name: str(x) for name, x in zip(names, inertia, strict=True)})


def _text(values: tuple[float, ...]) -> str:
    return " ".join(map(str, values))


LEGGED = {
    "solo12": Legged(
        _solo,
        tuple(f"{side}_FOOT" for side in SIDES),
        {"HFE": 0.8, "KFE": -1.6},
        kp=10.0,
        kd=0.2,
        armature=3.6e-4,
        viscous=0.01,
        noise=0.01,
        radius=0.016,
    ),
    "go2": Legged(
        _go2,
        ("FL_foot", "FR_foot", "RL_foot", "RR_foot"),
        {"thigh": 0.8, "calf": -1.6},
        kp=150.0,
        kd=4.0,
        armature=0.01,
        viscous=0.1,
        noise=0.1,
        radius=0.022,
    ),
    "g1": Legged(
        _g1,
        ("l_ankle_roll_link", "r_ankle_roll_link"),
        {"hip_pitch": -0.5, "knee": 1.0, "ankle_pitch": -0.5, "shoulder_pitch": 0.2, "elbow": 0.5},
        kp=3000.0,
        kd=40.0,
        armature=0.03,
        viscous=0.3,
        noise=0.2,
        sole=0.03,
    ),
}
"""Robots by name. The hind legs of the Solo12 bend the other way."""


def standing(legged: Legged, names: tuple[str, ...]) -> np.ndarray:
    """Return the positions of joints (n,) in which a robot stands."""
    found = np.zeros(len(names))
    for k, name in enumerate(names):
        for part, angle in legged.rest.items():
            if part in name:
                found[k] = angle * (-1.0 if name.startswith("H") else 1.0)
    return found
