"""MJCF as MuJoCo takes it: files put in place, and its actuators, couplings and loops compiled."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from types import ModuleType
from typing import Any, Literal
from xml.etree.ElementTree import Element

import numpy as np
from numpy.polynomial import Polynomial

from asbuilt.arrays import Array, Indices, Mask
from asbuilt.description.formats.xml import LARGEST_DESCRIPTION, parse_xml
from asbuilt.description.model import ROOT, Joint, Loop, Mimic
from asbuilt.description.rotation import (
    compose_placements,
    invert_placement,
    placement,
    rotation_from_quaternion,
)
from asbuilt.description.structure.parts import ancestors
from asbuilt.errors import DescriptionError
from asbuilt.untrusted import read_bytes


@contextmanager
def collect_warnings(mujoco: ModuleType) -> Iterator[list[str]]:
    """Collect MuJoCo's warnings, which would otherwise go to the terminal and to a log file."""
    warnings: list[str] = []
    previous = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(warnings.append)
    try:
        yield warnings
    finally:
        mujoco.set_mju_user_warning(previous)


@dataclass(frozen=True)
class Actuators:
    """Read the actuators of a compiled `model` by joint; `mujoco` is the module."""

    mujoco: ModuleType
    model: Any

    @cached_property
    def joints(self) -> Indices:
        """Joint on which each actuator acts, -1 where it acts on something else."""
        kinds = self.mujoco.mjtTrn
        # Alike but for balls.
        own = (int(kinds.mjTRN_JOINT), int(kinds.mjTRN_JOINTINPARENT))
        at_joints = np.isin(self.model.actuator_trntype, own)
        return np.where(at_joints, self.model.actuator_trnid[:, 0], -1)

    @cached_property
    def gear(self) -> Array:
        """Turns of each actuator per turn of its joint."""
        return np.array(self.model.actuator_gear[:, 0])

    @cached_property
    def constant(self) -> Array:
        """Part of the force of each actuator that depends on nothing."""
        affine = self.model.actuator_biastype == self.mujoco.mjtBias.mjBIAS_AFFINE
        return np.where(affine, self.model.actuator_biasprm[:, 0], 0.0)

    @cached_property
    def is_motor(self) -> Mask:
        """Whether the torque of each actuator is its control times a factor, and a constant."""
        m = self.model
        kinds = self.mujoco.mjtBias
        affine = m.actuator_biastype == kinds.mjBIAS_AFFINE
        constant = affine & ~np.any(m.actuator_biasprm[:, 1:3], axis=1)
        found: Mask = self._has_fixed_gain & ((m.actuator_biastype == kinds.mjBIAS_NONE) | constant)
        return found

    @cached_property
    def is_servo(self) -> Mask:
        """Whether each actuator controls the position of its joint."""
        m = self.model
        gain = m.actuator_gainprm[:, 0]
        affine = m.actuator_biastype == self.mujoco.mjtBias.mjBIAS_AFFINE
        opposed = (gain > 0.0) & (m.actuator_biasprm[:, 1] == -gain)
        found: Mask = self._has_fixed_gain & affine & opposed
        return found

    @property
    def _has_fixed_gain(self) -> Mask:
        fixed: Mask = self.model.actuator_gaintype == self.mujoco.mjtGain.mjGAIN_FIXED
        return fixed

    @property
    def is_read(self) -> Mask:
        """Whether each actuator is a motor or a servo of a joint."""
        return (self.joints >= 0) & (self.is_motor | self.is_servo)

    def of(self, joint: int) -> list[int]:
        """Return the actuators that act on a joint."""
        return np.flatnonzero(self.joints == joint).tolist()

    def torque_limit(self, joint: int) -> float:
        """Return the largest torque [N m or N] of the actuators of a joint, infinite without.

        It is limited by the range of their force and, of motors, of their control.
        """
        m = self.model
        limits = [np.inf]
        for k in self.of(joint):
            gear = abs(float(self.gear[k]))
            if m.actuator_forcelimited[k]:
                limits.append(self._read_force_limit(k) * gear)
            if m.actuator_ctrllimited[k] and self.is_motor[k]:
                most = float(np.abs(m.actuator_ctrlrange[k]).max())
                limits.append(abs(float(m.actuator_gainprm[k, 0])) * most * gear)
        return min(limits)

    def _read_force_limit(self, actuator: int) -> float:
        """Return the largest force of an actuator.

        MuJoCo limits the whole force, its constant and the servo's part together. A range about
        the constant, as exports write it, limits what acts beside the constant.
        """
        low, high = self.model.actuator_forcerange[actuator]
        constant = self.constant[actuator]
        if constant != 0.0 and np.isclose(0.5 * (low + high), constant, rtol=1e-9, atol=1e-9):
            return 0.5 * float(high - low)
        return float(max(abs(low), abs(high)))

    def own(self, joint: int, quantity: Literal["armature", "damping"]) -> float:
        """Return armature or damping of the actuators of a joint, on its side of the gear."""
        # Actuators of older versions of MuJoCo have none.
        values = getattr(self.model, f"actuator_{quantity}", np.zeros(len(self.gear)))
        return float(sum(np.ravel(values[k])[0] * self.gear[k] ** 2 for k in self.of(joint)))

    def gains(self, joint: int) -> tuple[float | None, float | None]:
        """Return kp and kd of the position servo of a joint, on its side of the gear."""
        servo = next((k for k in self.of(joint) if self.is_servo[k]), None)
        if servo is None:
            return None, None
        by_gear = float(self.gear[servo]) ** 2
        stiffness = float(self.model.actuator_gainprm[servo, 0])
        return stiffness * by_gear, float(-self.model.actuator_biasprm[servo, 2]) * by_gear

    def offset(self, joint: int) -> float | None:
        """Return the torque that the drive of a joint lacks at rest, None if there is none."""
        held = [k for k in self.of(joint) if self.is_read[k]]
        return -sum(float(self.constant[k]) * float(self.gear[k]) for k in held) or None

    def notes(self) -> Iterator[str]:
        """Yield what a robot model does not hold of the actuators."""
        m = self.model
        # Other versions of MuJoCo have no such actuator.
        dc_motor = getattr(self.mujoco.mjtBias, "mjBIAS_DCMOTOR", None)
        direct = (self.joints >= 0) & (m.actuator_biastype == dc_motor)
        late = self.is_read & (m.actuator_dyntype != self.mujoco.mjtDyn.mjDYN_NONE)
        for some, note in (
            (~self.is_read & ~direct, "left out; motors and position actuators of joints are read"),
            (late, "taken to act at once; their dynamics are left out"),
        ):
            if some.any():
                yield f"the actuators {self._join_names(np.flatnonzero(some).tolist())} are {note}"
        for k in np.flatnonzero(direct).tolist():
            yield (
                f"of the dcmotor {self._join_names([k])} armature, damping and limit of torque are"
                f" read; left out: {', '.join(self._list_unread(k))}"
            )
        for joint in range(m.njnt):
            several = [k for k in self.of(joint) if self.is_read[k]]
            if len(several) > 1:
                yield (
                    f"the actuators {self._join_names(several)} act on one joint: the gains of the"
                    " first servo and the least limit count"
                )

    def _list_unread(self, actuator: int) -> list[str]:
        """Return what a model does not hold of a dcmotor, by MuJoCo's compiled parameters."""
        gain = self.model.actuator_gainprm[actuator]
        bias = self.model.actuator_biasprm[actuator]
        dynamics = self.model.actuator_dynprm[actuator]
        there = {
            "winding inductance": dynamics[0] > 0.0,
            f"cogging of {bias[0]:.3g} N m": bias[0] != 0.0,
            f"LuGre friction (Coulomb {bias[3]:.3g}, static {bias[4]:.3g} N m)": dynamics[5] > 0.0,
            "heating": gain[2] != 0.0,
            "its controller": np.any(gain[4:7] != 0.0),
        }
        return ["voltage and back-EMF", *(what for what, is_there in there.items() if is_there)]

    def _join_names(self, actuators: Iterable[int]) -> str:
        return ", ".join(self.model.actuator(k).name or f"actuator_{k}" for k in actuators)


Equation = tuple[dict[int, float], float]
"""Factors c by joint and a number d: `sum_j c_j q_j = d`, the joint that may follow first."""


def couple_by_equalities(
    mujoco: Any, compiled: Any, joints: Sequence[Joint], loops: Collection[int] = ()
) -> tuple[list[Joint], int]:
    """Return the joints with those that follow others, and the number of equalities left out.

    Equalities in `loops` are neither applied nor counted.

    By an equality of joints the first one follows; by one of tendons the first of its joints that
    has no actuator and follows none yet.
    """
    found = list(joints)
    left_out = 0
    for k in sorted({*range(compiled.neq)} - {*loops}):
        equation = _read_equation(mujoco, compiled, k)
        at = None if equation is None else _find_follower(mujoco, compiled, found, k, equation[0])
        if equation is None or at is None:
            left_out += 1
            continue
        factors, value = equation
        own = factors.pop(at)
        mimic = Mimic({found[j].name: -c / own for j, c in factors.items()}, value / own)
        found[at] = replace(found[at], mimic=mimic)
    return found, left_out


def _read_equation(mujoco: Any, m: Any, k: int) -> Equation | None:
    """Return an equality `y - y0 = a + b (x - x0)` as an equation of joints, if it is linear."""
    kinds = mujoco.mjtEq
    one = int(m.eq_obj1id[k])
    other = int(m.eq_obj2id[k])
    if not m.eq_active0[k] or np.any(m.eq_data[k, 2:5]):
        return None
    if m.eq_type[k] == kinds.mjEQ_JOINT and other >= 0:
        sides = [{one: 1.0}, {other: 1.0}]
    elif m.eq_type[k] == kinds.mjEQ_TENDON:
        sides = [_read_fixed_tendon(mujoco, m, t) if t >= 0 else {} for t in (one, other)]
    else:
        return None
    if not sides[0] or (other >= 0 and not sides[1]):
        return None
    factors = dict(sides[0])
    for j, c in sides[1].items():
        factors[j] = factors.get(j, 0.0) - float(m.eq_data[k, 1]) * c
    rest: Array = m.qpos0[m.jnt_qposadr]
    return factors, float(m.eq_data[k, 0]) + sum(c * float(rest[j]) for j, c in factors.items())


def _read_fixed_tendon(mujoco: Any, m: Any, tendon: int) -> dict[int, float]:
    """Return the factors of a fixed tendon by joint, none for a spatial one."""
    wraps = range(int(m.tendon_adr[tendon]), int(m.tendon_adr[tendon] + m.tendon_num[tendon]))
    if any(m.wrap_type[w] != mujoco.mjtWrap.mjWRAP_JOINT for w in wraps):
        return {}
    return {int(m.wrap_objid[w]): float(m.wrap_prm[w]) for w in wraps}


def _find_follower(
    mujoco: Any, m: Any, joints: Sequence[Joint], k: int, factors: dict[int, float]
) -> int | None:
    """Return the joint that follows the others of an equation, None where none can."""
    driven = Actuators(mujoco, m).joints
    by_joints = m.eq_type[k] == mujoco.mjtEq.mjEQ_JOINT
    free = [
        j
        for j in ([int(m.eq_obj1id[k])] if by_joints else factors)
        if factors[j]
        and joints[j].mimic is None
        and not any(
            joints[j].name in _list_sources(joints, other) for other in factors if other != j
        )
    ]
    return next((j for j in free if j not in driven), free[0] if free else None)


def _list_sources(joints: Sequence[Joint], index: int) -> set[str]:
    """Return the names of a joint and of all that it follows."""
    by_name = {joint.name: k for k, joint in enumerate(joints)}
    found = set[str]()
    waiting = [index]
    while waiting:
        joint = joints[waiting.pop()]
        found.add(joint.name)
        waiting += [by_name[name] for name in (joint.mimic.factors if joint.mimic else ())]
    return found


Place = tuple[str, Array]
"""A link by name, and the pose (4, 4) in it of a body or a site."""


def find_loops_by_equalities(
    mujoco: Any, m: Any, bodies: Mapping[int, Place], joints: Sequence[Joint]
) -> tuple[list[Loop], list[int]]:
    """Return the loops that equalities close, and the numbers of these.

    `bodies` has the link of each body.
    """
    kinds = mujoco.mjtEq
    found = list[Loop]()
    used = list[int]()
    for k in range(m.neq):
        name = m.equality(k).name
        loop = None
        if not m.eq_active0[k]:
            continue
        if m.eq_type[k] == kinds.mjEQ_JOINT:
            loop = _read_curve_loop(m, k, joints, name)
        elif (welds := m.eq_type[k] == kinds.mjEQ_WELD) or m.eq_type[k] == kinds.mjEQ_CONNECT:
            loop = _read_body_loop(mujoco, m, k, bodies, name, welds=bool(welds))
        if loop is not None:
            found.append(loop)
            used.append(k)
    return found, used


def _read_curve_loop(m: Any, k: int, joints: Sequence[Joint], name: str) -> Loop | None:
    """Return `y - y0 = a_0 + a_1 (x - x0) + ...` as a loop where it is no linear coupling."""
    one = int(m.eq_obj1id[k])
    other = int(m.eq_obj2id[k])
    polynomial = Polynomial(m.eq_data[k, :5])
    if other >= 0 and not np.any(m.eq_data[k, 2:5]):
        return None
    rest = [float(m.qpos0[m.jnt_qposadr[j]]) for j in (one, max(other, 0))]
    if other >= 0:
        polynomial = polynomial(Polynomial([-rest[1], 1.0]))
    terms = np.zeros(5 if other >= 0 else 1)
    known = polynomial.coef[: terms.size]
    terms[: known.size] = known
    terms[0] += rest[0]
    moved = (joints[one].name, *((joints[other].name,) if other >= 0 else ()))
    return Loop("joint", joints=moved, polynomial=tuple(terms.tolist()), name=name)


def _read_body_loop(
    mujoco: Any, m: Any, k: int, bodies: Mapping[int, Place], name: str, *, welds: bool
) -> Loop | None:
    """Return the loop of an equality between bodies or sites; None where both are one link."""
    ids = (int(m.eq_obj1id[k]), int(m.eq_obj2id[k]))
    data = m.eq_data[k]
    at = [np.eye(4), np.eye(4)]
    if m.eq_objtype[k] == mujoco.mjtObj.mjOBJ_SITE:
        at = [placement(rotation_from_quaternion(m.site_quat[i]), m.site_pos[i]) for i in ids]
        ids = (int(m.site_bodyid[ids[0]]), int(m.site_bodyid[ids[1]]))
    elif welds:
        # the pose of body 2 in body 1, and the point of it that is held
        pose = placement(rotation_from_quaternion(data[6:10]), data[3:6])
        at = [
            compose_placements(pose, placement(translation=data[:3])),
            placement(translation=data[:3]),
        ]
    else:
        at = [placement(translation=data[:3]), placement(translation=data[3:6])]
    (link_a, on_a), (link_b, on_b) = (bodies[body] for body in ids)
    if link_a == link_b:
        return None
    one = compose_placements(on_a, at[0])
    other = compose_placements(on_b, at[1])
    turned = compose_placements(one, invert_placement(other))[:3, :3] if welds else np.eye(3)
    return Loop(
        "weld" if welds else "connect",
        link_a,
        one[:3, 3],
        link_b,
        other[:3, 3],
        rotation=turned,
        name=name,
    )


def with_passive_joints(
    mujoco: Any, m: Any, joints: Sequence[Joint], links: Sequence[str], loops: Sequence[Loop]
) -> list[Joint]:
    """Return the joints; joints in loops that no actuator moves become passive.

    All stay as they are where the file has no actuator.
    """
    if not m.nu:
        return list(joints)
    driven = Actuators(mujoco, m).joints
    inside = set[int]()
    for loop in loops:
        if loop.kind == "joint":
            inside |= {k for k, joint in enumerate(joints) if joint.name == loop.joints[0]}
            continue
        one, other = (
            {*ancestors(joints, links.index(link) if link in links else ROOT)}
            for link, _ in loop.ends
        )
        inside |= one ^ other
    return [
        replace(joint, mimic=Mimic({}))
        if k in inside and k not in driven and joint.mimic is None
        else joint
        for k, joint in enumerate(joints)
    ]


SUFFIXES = (".xml", ".mjcf")
"""Suffixes of files that an MJCF file may include."""


DEEPEST_INCLUDE = 16
"""Files that include one another; scenes include a robot, and robots a gripper."""


def insert_includes(root: Element, source: str) -> None:
    """Replace each `<include>` by what stands below the outermost element of its file.

    A file may be included once (MuJoCo XML reference, include). It lies in the folder of `source`
    or below: a description from elsewhere may not read other files of this computer.

    Raises
    ------
    DescriptionError
        For a file outside the folder, one that cannot be read, one that is included twice, or
        where `source` is a text without a folder.
    """
    first = next(root.iter("include"), None)
    if first is None:
        return
    place = Path(source)
    if not place.is_file():
        raise DescriptionError(
            f"{source}: the text includes {first.get('file')!r} and has no folder to find it in;"
            " give the path of the file, or save the whole model as one file"
            " (mujoco.mj_saveLastXML)"
        )
    folder = place.parent.resolve()
    _Inclusion(source, folder, {place.resolve()}).insert(root, folder)


@dataclass
class _Inclusion:
    """Files included so far by the description `source` in `folder`, and their bytes."""

    source: str
    folder: Path
    seen: set[Path]
    size: int = 0

    def insert(self, element: Element, beside: Path, depth: int = 0) -> None:
        """Expand the includes below an element of a file that lies in the folder `beside`."""
        children: list[Element] = []
        for child in element:
            if child.tag == "include":
                children += self.read(child, beside, depth + 1)
            else:
                self.insert(child, beside, depth)
                children.append(child)
        element[:] = children

    def read(self, include: Element, beside: Path, depth: int) -> list[Element]:
        """Return the elements that an include stands for."""
        path = self.find(include.get("file", ""), beside)
        if path in self.seen or depth > DEEPEST_INCLUDE:
            raise DescriptionError(
                f"{self.source}: {path.name} is included again; a file may be included once"
            )
        self.seen.add(path)
        content = read_bytes(path, "included file", DescriptionError, LARGEST_DESCRIPTION)
        self.size += len(content)
        if self.size > LARGEST_DESCRIPTION:
            raise DescriptionError(
                f"{self.source}: its included files have more than {LARGEST_DESCRIPTION} bytes"
            )
        root = parse_xml(content, str(path))
        self.insert(root, path.parent, depth)
        return [*root]

    def find(self, name: str, beside: Path) -> Path:
        """Return an included file, which lies in the folder of the description."""
        # MuJoCo starts from the folder of the first file; older files from that of their own.
        possible = [(place / name).resolve() for place in (self.folder, beside)]
        path = next((each for each in possible if each.is_file()), possible[0])
        if not path.is_relative_to(self.folder) or path.suffix.lower() not in SUFFIXES:
            raise DescriptionError(
                f"{self.source}: it includes {name!r}, which is no .xml or .mjcf file in the folder"
                " of the description; copy it there, or save the whole model as one file"
                " (mujoco.mj_saveLastXML)"
            )
        if not path.is_file():
            raise DescriptionError(f"{self.source}: it includes {name!r}, which does not exist")
        return path
