"""Newton-Euler equations, momentum and drives of one robot as straight-line arithmetic in C."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import ROOT, RobotModel
from asbuilt.dynamics.drives.drive_set import DriveSet
from asbuilt.dynamics.drives.term import Formula
from asbuilt.writers.models.c.c_expressions import ONE, ZERO, StraightLine, Term, Vector

Matrix = tuple[Vector, ...]
NOTHING: Vector = (ZERO, ZERO, ZERO)


@dataclass(frozen=True, slots=True)
class Motion:
    """Hold angular velocity `w` and acceleration `dw`, and `a` of the origin less gravity."""

    w: Vector
    dw: Vector
    a: Vector


@dataclass(frozen=True, slots=True)
class Spatial:
    """Hold a spatial vector at the origin of a frame, in its axes (Featherstone 2008).

    Of a motion, `angular` is the angular velocity z and `linear` the velocity m; of a force or a
    momentum, `linear` is the force f and `angular` the moment n.
    """

    angular: Vector
    linear: Vector


class Mechanism:
    """Write torques and regressors of a robot from variables q, qd, qdd.

    Luh, Walker and Paul (1980); Atkeson, An and Hollerbach (1986).
    """

    def __init__(self, model: RobotModel, *, at_rest: bool = False, steady: bool = False) -> None:
        """Take joint rates, or not `at_rest`, and accelerations, or not if `steady`."""
        n = model.n_joints
        self.model = model
        self.code = StraightLine()
        self.tree = model.tree
        self.joint_map = model.constant_map("C code")
        self.q, self.qd, self.qdd = (
            [Term(1.0, f"{array}[{j}]") if taken else ZERO for j in range(n)]
            for array, taken in (
                ("q", True),
                ("qd", not at_rest),
                ("qdd", not (at_rest or steady)),
            )
        )
        self.link_q = self.of_links(self.q, self.joint_map.offset)
        self.link_qd = self.of_links(self.qd)
        self.link_qdd = self.of_links(self.qdd)
        self.cosine, self.sine = (
            [
                self.code.given(f"{function}({q.written()})", q.name) if joint.is_revolute else none
                for q, joint in zip(self.link_q, self.tree.joints, strict=True)
            ]
            for function, none in (("cos", ONE), ("sin", ZERO))
        )
        self.motions: list[Motion] = []
        for j in range(self.tree.n_joints):
            self.motions.append(self._move_link(j))

    def of_links(self, values: list[Term], offset: float | Array = 0.0) -> list[Term]:
        """Return `E values + offset` at the joints of the tree."""
        E = self.joint_map.matrix
        return [
            self.code.total(*zip(_make_vector(row), values, strict=True), (Term(float(shift)),))
            for row, shift in zip(E, np.broadcast_to(offset, len(E)), strict=True)
        ]

    def of_joints(self, torques: list[Term]) -> list[Term]:
        """Return `E^T torques` at the joints that have a drive."""
        return [*self._multiply(_make_matrix(self.joint_map.matrix.T), torques)]

    def of_tree(self, parameters: Array) -> Array:
        """Return inertial parameters (10 n_links,) in the order of the tree, (n_links, 10)."""
        return self.joint_map.parameters(parameters.reshape(-1, 10))

    def torques(self, parameters: Array) -> list[Term]:
        """Return the torque of each joint for inertial parameters of shape (10 n_links,)."""
        chi = self.of_tree(parameters)
        carried = self._carry_wrenches(lambda j: self._derive_wrench(self.motions[j], chi[j]))
        return self.of_joints(self._project_on_axes(carried))

    def momentum(self, parameters: Array, armature: Array) -> tuple[list[Term], list[Term]]:
        """Return `p = (M + A) qd` and `C^T qd` of each joint for inertial parameters (10 n,).

        With the twist V of a joint frame, the momentum H of what the joint carries and its axis S,
        `p = S . H` and `C^T qd = dT/dq = -H . (S x V)`.
        """
        twists, carried = self._derive_momenta(parameters, self.qd)
        total = self.code.total
        gradient = []
        for joint, v, h in zip(self.tree.joints, twists, carried, strict=True):
            # -H . (S x V), which for a turning axis are two cross products' z.
            turning = [(h.angular, v.angular), (h.linear, v.linear)]
            pairs = turning if joint.is_revolute else [(h.linear, v.angular)]
            gradient.append(
                total(*((a[0], b[1]) for a, b in pairs), *((-a[1], b[0]) for a, b in pairs))
            )
        momenta = [
            total((p,), *zip(_make_vector(row), self.qd, strict=True))
            for p, row in zip(self.of_joints(self._project_on_axes(carried)), armature, strict=True)
        ]
        return momenta, self.of_joints(gradient)

    def mass_matrix(self, parameters: Array, armature: Array) -> dict[tuple[int, int], Term]:
        """Return the entries (joint, joint) of `M + A`: column k is the momentum of unit rate k."""
        n = self.model.n_joints
        entries: dict[tuple[int, int], Term] = {}
        for k in range(n):
            _, carried = self._derive_momenta(
                parameters, [ONE if j == k else ZERO for j in range(n)]
            )
            momenta = self.of_joints(self._project_on_axes(carried))
            # Column k is the momentum of a unit rate; the matrix is symmetric.
            for j in range(k, n):
                entries[j, k] = entries[k, j] = self.code.sum(
                    momenta[j], Term(float(armature[j, k]))
                )
        return entries

    def _derive_momenta(
        self, parameters: Array, rates: list[Term]
    ) -> tuple[list[Spatial], list[Spatial]]:
        """Return for joint rates the twist of each joint frame, and the momentum it carries."""
        at_joint: list[Spatial] = []
        of_link: list[Spatial] = []
        for j, (joint, rate) in enumerate(zip(self.tree.joints, self.of_links(rates), strict=True)):
            above = Spatial(NOTHING, NOTHING) if joint.parent == ROOT else of_link[joint.parent]
            twist = self._carry_over(j, self._shift_motion(joint.before, above))
            z = twist.angular
            m = twist.linear
            joint_rate = (ZERO, ZERO, rate)
            at_joint.append(
                Spatial(self._add(z, joint_rate), m)
                if joint.is_revolute
                else Spatial(z, self._add(m, joint_rate))
            )
            of_link.append(self._shift_motion(joint.after, at_joint[j]))
        chi = self.of_tree(parameters)
        return at_joint, self._carry_wrenches(lambda j: self._derive_momentum(of_link[j], chi[j]))

    def _carry_wrenches(self, own: Callable[[int], Spatial]) -> list[Spatial]:
        """Return the wrench that each joint carries, in its axes, from the wrenches of links."""
        n = self.tree.n_joints
        above: list[list[Spatial]] = [[] for _ in range(n)]
        found = [Spatial(NOTHING, NOTHING)] * n
        # Leaves first: what a joint carries is whole before it is passed on.
        for j in reversed(range(n)):
            joint = self.tree.joints[j]
            parts = [own(j), *above[j]]
            force = self._add(*(part.linear for part in parts))
            moment = self._add(*(part.angular for part in parts))
            found[j] = self._leave_frame(joint.after, Spatial(moment, force))
            if joint.parent != ROOT:
                above[joint.parent].append(
                    self._leave_frame(joint.before, self._carry_back(j, found[j]))
                )
        return found

    def _project_on_axes(self, wrenches: list[Spatial]) -> list[Term]:
        """Return the part of each joint's wrench along its axis."""
        return [
            wrench.angular[2] if joint.is_revolute else wrench.linear[2]
            for joint, wrench in zip(self.tree.joints, wrenches, strict=True)
        ]

    def regressor(self, columns: list[int]) -> dict[tuple[int, int], Term]:
        """Return the nonzero entries (joint, position in `columns`) of the regressor."""
        screws = self._derive_screws()
        place = np.argsort(self.joint_map.order)
        entries = {}
        for position, column in enumerate(columns):
            link, parameter = divmod(column, 10)
            wrench = self._derive_wrench(self.motions[place[link]], np.eye(10)[parameter])
            found = [ZERO] * self.tree.n_joints
            for j, screw in screws[place[link]].items():
                pairs = zip(
                    screw.angular + screw.linear, wrench.angular + wrench.linear, strict=True
                )
                found[j] = self.code.total(*pairs)
            # Zero entries are left out: the function sets them once.
            for j, entry in enumerate(self.of_joints(found)):
                if not entry.is_zero:
                    entries[j, position] = entry
        return entries

    def _move_link(self, j: int) -> Motion:
        """Return the motion of link j of the tree, from its parent's."""
        joint = self.tree.joints[j]
        above = (
            # Minus gravity at the root stands for gravity everywhere.
            Motion(NOTHING, NOTHING, _make_vector(-self.model.gravity))
            if joint.parent == ROOT
            else self.motions[joint.parent]
        )
        total = self.code.total
        plus = self.code.sum
        at = self._enter_frame(joint.before, above)
        q = self.link_q[j]
        v = self.link_qd[j]
        dv = self.link_qdd[j]
        if joint.is_revolute:
            w, dw, a = (self._turn(j, vector) for vector in (at.w, at.dw, at.a))
            turned = Motion(
                (w[0], w[1], plus(w[2], v)),
                # dw' = dw + w x v z + dv z, w' = w + v z
                (total((dw[0],), (w[1], v)), total((dw[1],), (-w[0], v)), plus(dw[2], dv)),
                a,
            )
        else:
            swing = self._derive_swing(at)
            wx, wy, _ = at.w
            twice = Term(2.0)
            # a' = a + U q z + 2 w x v z + dv z
            coriolis = ((twice, wy, v), (-twice, wx, v), (dv,))
            turned = replace(
                at,
                a=tuple(
                    total((a,), (row[2], q), more)
                    for a, row, more in zip(at.a, swing, coriolis, strict=True)
                ),
            )
        return self._enter_frame(joint.after, turned)

    def _derive_swing(self, motion: Motion) -> Matrix:
        """Return `[dw]x + [w]x [w]x`, the acceleration of a point per its position."""
        x, y, z = motion.w
        dx, dy, dz = motion.dw
        total = self.code.total
        return (
            # U = [dw]x + w w^T - (w . w) 1, entry by entry.
            (total((-y, y), (-z, z)), total((x, y), (-dz,)), total((x, z), (dy,))),
            (total((x, y), (dz,)), total((-x, x), (-z, z)), total((y, z), (-dx,))),
            (total((x, z), (-dy,)), total((y, z), (dx,)), total((-x, x), (-y, y))),
        )

    def _enter_frame(self, placement: Array, motion: Motion) -> Motion:
        """Return the motion of a frame at `placement` in a moving frame."""
        R = placement[:3, :3]
        p = _make_vector(placement[:3, 3])
        a = motion.a
        # A frame at the origin needs no swing.
        if any(not part.is_zero for part in p):
            a = self._add(a, self._multiply(self._derive_swing(motion), p))
        return Motion(
            *(self._multiply(_make_matrix(R.T), vector) for vector in (motion.w, motion.dw, a))
        )

    def _leave_frame(self, placement: Array, wrench: Spatial) -> Spatial:
        """Return a wrench on a frame at `placement` as one on the frame that carries it."""
        R = _make_matrix(placement[:3, :3])
        p = _make_vector(placement[:3, 3])
        force = self._multiply(R, wrench.linear)
        # n' = R n + p x f'
        return Spatial(self._add(self._multiply(R, wrench.angular), self._cross(p, force)), force)

    def _carry_back(self, j: int, wrench: Spatial) -> Spatial:
        """Carry a wrench on the joint frame back over the motion of the joint."""
        if self.tree.joints[j].is_revolute:
            force = self._turn(j, wrench.linear, back=True)
            return Spatial(self._turn(j, wrench.angular, back=True), force)
        fx, fy, _ = wrench.linear
        nx, ny, nz = wrench.angular
        q = self.link_q[j]
        total = self.code.total
        # n' = n + q z x f
        return Spatial((total((nx,), (-q, fy)), total((ny,), (q, fx)), nz), wrench.linear)

    def _derive_wrench(self, motion: Motion, parameters: Array) -> Spatial:
        """Return `F = m a + U h` and `N = I dw + w x I w + h x a`, `U = [dw]x + [w]x [w]x`."""
        inertia, h, m = _read_parameters(parameters)
        force = NOTHING
        moment = self._add(
            self._multiply(inertia, motion.dw),
            self._cross(motion.w, self._multiply(inertia, motion.w)),
        )
        # U takes many operations, which nothing would use without a first moment.
        if any(not entry.is_zero for entry in h):
            force = self._multiply(self._derive_swing(motion), h)
            moment = self._add(moment, self._cross(h, motion.a))
        whole = (self.code.total((f,), (m, a)) for f, a in zip(force, motion.a, strict=True))
        return Spatial(moment, tuple(whole))

    def _derive_momentum(self, twist: Spatial, parameters: Array) -> Spatial:
        """Return force `m v + w x h` and moment `I w + h x v` of a link."""
        inertia, h, m = _read_parameters(parameters)
        w = twist.angular
        v = twist.linear
        total = self.code.total
        # Force m v + w x h, moment I w + h x v.
        turned = self._cross(w, h)
        swung = self._cross(h, v)
        force = tuple(total((m, a), (b,)) for a, b in zip(v, turned, strict=True))
        moment = tuple(
            total(*zip(row, w, strict=True), (b,)) for row, b in zip(inertia, swung, strict=True)
        )
        return Spatial(moment, force)

    def _derive_screws(self) -> list[dict[int, Spatial]]:
        """Return for each link the screws of the joints that move it."""
        screws: list[dict[int, Spatial]] = []
        axis = (ZERO, ZERO, ONE)
        for j, joint in enumerate(self.tree.joints):
            above = {} if joint.parent == ROOT else screws[joint.parent]
            moved = {
                k: self._carry_over(j, self._shift_motion(joint.before, screw))
                for k, screw in above.items()
            }
            moved[j] = Spatial(axis, NOTHING) if joint.is_revolute else Spatial(NOTHING, axis)
            screws.append({k: self._shift_motion(joint.after, screw) for k, screw in moved.items()})
        return screws

    def _shift_motion(self, placement: Array, screw: Spatial) -> Spatial:
        """Return a motion of a frame as one of the frame at `placement` in it."""
        R = _make_matrix(placement[:3, :3].T)
        p = _make_vector(placement[:3, 3])
        z = screw.angular
        m = screw.linear
        # R^T z, R^T (m + z x p)
        return Spatial(self._multiply(R, z), self._multiply(R, self._add(m, self._cross(z, p))))

    def _carry_over(self, j: int, screw: Spatial) -> Spatial:
        """Carry a motion over the motion of joint j."""
        if self.tree.joints[j].is_revolute:
            return Spatial(self._turn(j, screw.angular), self._turn(j, screw.linear))
        zx, zy, _ = screw.angular
        mx, my, mz = screw.linear
        q = self.link_q[j]
        total = self.code.total
        # m + z x q e_z
        return Spatial(screw.angular, (total((mx,), (zy, q)), total((my,), (-zx, q)), mz))

    def _turn(self, j: int, v: Vector, *, back: bool = False) -> Vector:
        """Return `Rz^T v` with the angle of joint j, or `Rz v`."""
        c = self.cosine[j]
        s = -self.sine[j] if back else self.sine[j]
        return self.code.total((c, v[0]), (s, v[1])), self.code.total((c, v[1]), (-s, v[0])), v[2]

    def _multiply(self, matrix: Matrix, v: Sequence[Term]) -> Vector:
        return tuple(self.code.total(*zip(row, v, strict=True)) for row in matrix)

    def _cross(self, u: Vector, v: Vector) -> Vector:
        total = self.code.total
        return (
            total((u[1], v[2]), (-u[2], v[1])),
            total((u[2], v[0]), (-u[0], v[2])),
            total((u[0], v[1]), (-u[1], v[0])),
        )

    def _add(self, *vectors: Vector) -> Vector:
        return tuple(self.code.sum(*parts) for parts in zip(*vectors, strict=True))


def _make_vector(values: Array) -> Vector:
    return tuple(map(Term, values.tolist()))


def _make_matrix(values: Array) -> Matrix:
    return tuple(map(_make_vector, values))


def _read_parameters(parameters: Array) -> tuple[Matrix, Vector, Term]:
    """Return inertia, first moment and mass of a link from its parameters (10,)."""
    xx, xy, xz, yy, yz, zz, *h, m = map(Term, parameters.tolist())
    return ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz)), tuple(h), m


FUNCTIONS = {
    "divide": "{0}/({1})",
    "power": "pow({0}, {1})",
    "minimum": "fmin({0}, {1})",
    "maximum": "fmax({0}, {1})",
    "abs": "fabs({0})",
    "sign": "(double)(({0} > 0.0) - ({0} < 0.0))",
    **{name: f"{name}({{0}})" for name in ("exp", "log", "sqrt", "sin", "cos", "tanh", "atan")},
}
"""Operations of formulas that are not sums or products."""


def write_formula(code: StraightLine, formula: str, values: Mapping[str, Term]) -> Term:
    """Return a formula of a drive term as C, each name replaced by its value."""
    sums: dict[str, Callable[..., Term]] = {
        # Sums and products are gathered; other functions are written as they are.
        "add": code.sum,
        "subtract": lambda a, b: code.sum(a, -b),
        "negative": Term.__neg__,
        "multiply": lambda *factors: code.total(factors),
    }

    def apply(operation: str, *operands: Term) -> Term:
        if operation in sums:
            return sums[operation](*operands)
        text = FUNCTIONS[operation].format(*(operand.written() for operand in operands))
        return code.given(text, *(operand.name for operand in operands))

    return Formula(formula).fold(Term, values.__getitem__, apply)


def list_drive_entries(
    mechanism: Mechanism, drive: DriveSet, parameters: Array
) -> list[dict[int, Term]]:
    """Return for each drive parameter, joint by joint, its column at each joint that it acts on.

    Motors that several joints turn act on all of these. `parameters` (10 n,) of the links give the
    load of terms that depend on it.
    """
    code = mechanism.code
    shares = mechanism.model.motor_shares
    loads = mechanism.torques(parameters) if drive.needs_load else [ZERO] * mechanism.model.n_joints
    entries: list[dict[int, Term]] = []
    for k, load in enumerate(loads):
        for term in drive.at(k).terms:
            # A term of the motor acts on all joints that its motor turns.
            acts_on = shares[k] if term.of_motor else np.eye(len(loads))[k]
            # Parameters keep their places: those of joints without the term have no column.
            if not term.is_at(k) or not acts_on.any():
                entries += [{} for _ in term.symbols]
                continue
            state = {"q": mechanism.q, "qd": mechanism.qd, "qdd": mechanism.qdd}
            values = {
                array: code.total(*zip(_make_vector(acts_on), motion, strict=True))
                for array, motion in state.items()
            }
            values |= {
                nonlinear.name: Term(term.value(nonlinear.name)) for nonlinear in term.nonlinear
            }
            values["load"] = load
            columns = [write_formula(code, column, values) for column in term.columns]
            entries += [
                {
                    int(j): code.total((Term(float(acts_on[j])), column))
                    for j in np.flatnonzero(acts_on)
                }
                for column in columns
            ]
    return entries


def add_drives(
    mechanism: Mechanism, torques: list[Term], drive: DriveSet, values: Array, parameters: Array
) -> list[Term]:
    """Return joint torques with the torques of drive terms of these values added."""
    with_drives = list(torques)
    for entry, value in zip(list_drive_entries(mechanism, drive, parameters), values, strict=True):
        for j, column in entry.items():
            with_drives[j] = mechanism.code.total((with_drives[j],), (Term(float(value)), column))
    return with_drives
