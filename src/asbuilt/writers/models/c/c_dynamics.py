"""Newton-Euler equations, momentum and drives of one robot as straight-line arithmetic in C."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import ROOT, Joint, RobotModel
from asbuilt.dynamics.drives.formula import Formula
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.writers.models.c.c_expressions import ONE, ZERO, StraightLine, Term, Vector

Matrix = tuple[Vector, Vector, Vector]
NOTHING: Vector = (ZERO, ZERO, ZERO)


@dataclass(frozen=True, slots=True)
class Motion:
    """Hold angular velocity `w` and acceleration `dw`, and `a` of the origin less gravity."""

    w: Vector
    dw: Vector
    a: Vector


@dataclass(frozen=True, slots=True)
class Screw:
    """Hold angular velocity `z` and velocity `m` of the origin of a frame, in its axes."""

    z: Vector
    m: Vector


@dataclass(frozen=True, slots=True)
class Wrench:
    """Hold force and moment about the origin of a frame, in its axes."""

    force: Vector
    moment: Vector


class Mechanism:
    """Write torques and regressors of a robot from variables q, qd, qdd.

    Luh, Walker and Paul (1980); Atkeson, An and Hollerbach (1986).
    """

    def __init__(self, model: RobotModel, *, at_rest: bool = False, steady: bool = False) -> None:
        """Take joint rates, or not `at_rest`, and accelerations, or not if `steady`."""
        self.model, self.code = model, StraightLine()
        self.tree, self.coupling = model.tree, model.constant_coupling("C code")
        n = model.n_joints
        self.q = [Term(1.0, f"q[{j}]") for j in range(n)]
        self.qd = [ZERO if at_rest else Term(1.0, f"qd[{j}]") for j in range(n)]
        still = at_rest or steady
        self.qdd = [ZERO if still else Term(1.0, f"qdd[{j}]") for j in range(n)]
        self.link_q, self.link_qd, self.link_qdd = self.q, self.qd, self.qdd
        if self.coupling is not None:
            self.link_q = self.of_links(self.q, self.coupling.offset)
            self.link_qd, self.link_qdd = self.of_links(self.qd), self.of_links(self.qdd)
        turning = [joint.is_revolute for joint in self.tree.joints]
        self.cosine, self.sine = (
            [
                (self.code.given(f"{function}({angle.written()})", angle.name) if turns else still)
                for angle, turns in zip(self.link_q, turning, strict=True)
            ]
            for function, still in (("cos", ONE), ("sin", ZERO))
        )
        self.motions: list[Motion] = []
        for j, joint in enumerate(self.tree.joints):
            self.motions.append(self._moved(j, joint))

    def of_links(self, rates: list[Term], offset: Array | None = None) -> list[Term]:
        """Return `E rates + offset` at the joints of the tree; `rates` themselves without E."""
        if self.coupling is None:
            return rates
        found = []
        for i, row in enumerate(self.coupling.matrix):
            products: list[tuple[Term, ...]] = [
                (Term(float(row[k])), rates[k]) for k in np.flatnonzero(row)
            ]
            if offset is not None and offset[i]:
                products.append((Term(float(offset[i])),))
            found.append(self.code.total(*products) if products else ZERO)
        return found

    def of_joints(self, torques: list[Term]) -> list[Term]:
        """Return `E^T torques` at the joints that have a drive."""
        if self.coupling is None:
            return torques
        return [
            self.code.total(*((Term(float(column[i])), torques[i]) for i in np.flatnonzero(column)))
            for column in self.coupling.matrix.T
        ]

    def of_tree(self, parameters: Array) -> Array:
        """Return inertial parameters (10 n_links,) in the order of the tree."""
        if self.coupling is None:
            return parameters
        return self.coupling.parameters(parameters.reshape(-1, 10)).reshape(-1)

    def torques(self, parameters: Array) -> list[Term]:
        """Return the torque of each joint for inertial parameters of shape (10 n_links,)."""
        chi = self.of_tree(parameters).reshape(-1, 10)
        carried = self._carried(lambda j: self._inertial(self.motions[j], chi[j]))
        return self.of_joints(self._along(carried))

    def momentum(self, parameters: Array, armature: Array) -> tuple[list[Term], list[Term]]:
        """Return `p = (M + A) qd` and `C^T qd` of each joint for inertial parameters (10 n,).

        With the twist V of a joint frame, the momentum H of what the joint carries and its axis S,
        `p = S . H` and `C^T qd = dT/dq = -H . (S x V)`.
        """
        twists, carried = self._momenta(parameters, self.qd)
        total = self.code.total
        rotors = [
            [(Term(float(a)), rate) for a, rate in zip(row, self.qd, strict=True) if a]
            for row in armature
        ]
        gradient = []
        for joint, v, h in zip(self.tree.joints, twists, carried, strict=True):
            turning = [(h.moment, v.z), (h.force, v.m)]
            pairs = turning if joint.is_revolute else [(h.force, v.z)]
            gradient.append(
                total(*((a[0], b[1]) for a, b in pairs), *((-a[1], b[0]) for a, b in pairs))
            )
        momenta = self.of_joints(self._along(carried))
        whole = [total((p,), *extra) for p, extra in zip(momenta, rotors, strict=True)]
        return whole, self.of_joints(gradient)

    def mass_matrix(self, parameters: Array, armature: Array) -> dict[tuple[int, int], Term]:
        """Return the entries (joint, joint) of `M + A`: column k is the momentum of unit rate k."""
        n = self.model.n_joints
        entries: dict[tuple[int, int], Term] = {}
        for k in range(n):
            _, carried = self._momenta(parameters, [ONE if j == k else ZERO for j in range(n)])
            momenta = self.of_joints(self._along(carried))
            for j in range(k, n):
                total = self.code.sum(momenta[j], Term(float(armature[j, k])))
                entries[j, k] = entries[k, j] = total
        return entries

    def _momenta(self, parameters: Array, rates: list[Term]) -> tuple[list[Screw], list[Wrench]]:
        """Return for joint rates the twist of each joint frame, and the momentum it carries."""
        at_joint: list[Screw] = []
        of_link: list[Screw] = []
        for j, (joint, rate) in enumerate(zip(self.tree.joints, self.of_links(rates), strict=True)):
            above = Screw(NOTHING, NOTHING) if joint.parent == ROOT else of_link[joint.parent]
            own: Vector = (ZERO, ZERO, rate)
            twist = self._over(j, self._through(joint.before, above))
            at_joint.append(
                Screw(self._added(twist.z, own), twist.m)
                if joint.is_revolute
                else Screw(twist.z, self._added(twist.m, own))
            )
            of_link.append(self._through(joint.after, at_joint[j]))
        chi = self.of_tree(parameters).reshape(-1, 10)
        return at_joint, self._carried(lambda j: self._momentum(of_link[j], chi[j]))

    def _carried(self, own: Callable[[int], Wrench]) -> list[Wrench]:
        """Return the wrench that each joint carries, in its axes, from the wrenches of links."""
        n = self.tree.n_joints
        above: list[list[Wrench]] = [[] for _ in range(n)]
        found = [Wrench(NOTHING, NOTHING)] * n
        for j in reversed(range(n)):
            joint, parts = self.tree.joints[j], [own(j), *above[j]]
            force = self._added(*(each.force for each in parts))
            moment = self._added(*(each.moment for each in parts))
            found[j] = self._out(joint.after, Wrench(force, moment))
            if joint.parent != ROOT:
                above[joint.parent].append(self._out(joint.before, self._unturned(j, found[j])))
        return found

    def _along(self, wrenches: list[Wrench]) -> list[Term]:
        """Return the part of each joint's wrench along its axis."""
        return [
            wrench.moment[2] if joint.is_revolute else wrench.force[2]
            for joint, wrench in zip(self.tree.joints, wrenches, strict=True)
        ]

    def regressor(self, columns: list[int]) -> dict[tuple[int, int], Term]:
        """Return the nonzero entries (joint, position in `columns`) of the regressor."""
        screws = self._screws()
        entries = {}
        for position, column in enumerate(columns):
            link, parameter = divmod(column, 10)
            if self.coupling is not None:
                link = int(np.argsort(self.coupling.order)[link])
            wrench = self._inertial(self.motions[link], np.eye(10)[parameter])
            found = [ZERO] * self.tree.n_joints
            for j, screw in screws[link].items():
                pairs = zip(screw.z + screw.m, wrench.moment + wrench.force, strict=True)
                found[j] = self.code.total(*pairs)
            for j, entry in enumerate(self.of_joints(found)):
                if not entry.is_zero:
                    entries[j, position] = entry
        return entries

    def _moved(self, j: int, joint: Joint) -> Motion:
        above = (
            Motion(NOTHING, NOTHING, _make_vector(-self.model.gravity))
            if joint.parent == ROOT
            else self.motions[joint.parent]
        )
        total, plus = self.code.total, self.code.sum
        at = self._into(joint.before, above)
        q, v, dv = self.link_q[j], self.link_qd[j], self.link_qdd[j]
        c, s = self.cosine[j], self.sine[j]
        if joint.is_revolute:
            w, dw, a = (self._turned(c, s, vector) for vector in (at.w, at.dw, at.a))
            turned = Motion(
                (w[0], w[1], plus(w[2], v)),
                (total((dw[0],), (w[1], v)), total((dw[1],), (-w[0], v)), plus(dw[2], dv)),
                a,
            )
        else:
            swing = self._swing(at)
            wx, wy, _ = at.w
            twice = Term(2.0)
            turned = Motion(
                at.w,
                at.dw,
                (
                    total((at.a[0],), (swing[0][2], q), (twice, wy, v)),
                    total((at.a[1],), (swing[1][2], q), (-twice, wx, v)),
                    total((at.a[2],), (swing[2][2], q), (dv,)),
                ),
            )
        return self._into(joint.after, turned)

    def _swing(self, motion: Motion) -> Matrix:
        """Return `[dw]x + [w]x [w]x`, the acceleration of a point per its position."""
        (x, y, z), (dx, dy, dz), total = motion.w, motion.dw, self.code.total
        return (
            (total((-y, y), (-z, z)), total((x, y), (-dz,)), total((x, z), (dy,))),
            (total((x, y), (dz,)), total((-x, x), (-z, z)), total((y, z), (-dx,))),
            (total((x, z), (-dy,)), total((y, z), (dx,)), total((-x, x), (-y, y))),
        )

    def _into(self, placement: Array, motion: Motion) -> Motion:
        """Return the motion of a frame at `placement` in a moving frame."""
        R, p = placement[:3, :3], _make_vector(placement[:3, 3])
        a = motion.a
        if any(not part.is_zero for part in p):
            a = self._added(a, self._times(self._swing(motion), p))
        return Motion(
            *(self._times(_make_matrix(R.T), vector) for vector in (motion.w, motion.dw, a))
        )

    def _out(self, placement: Array, wrench: Wrench) -> Wrench:
        """Return a wrench on a frame at `placement` as one on the frame that carries it."""
        R, p = _make_matrix(placement[:3, :3]), _make_vector(placement[:3, 3])
        force = self._times(R, wrench.force)
        return Wrench(force, self._added(self._times(R, wrench.moment), self._cross(p, force)))

    def _unturned(self, j: int, wrench: Wrench) -> Wrench:
        """Carry a wrench on the joint frame back over the motion of the joint."""
        if self.tree.joints[j].is_revolute:
            c, s = self.cosine[j], -self.sine[j]
            return Wrench(self._turned(c, s, wrench.force), self._turned(c, s, wrench.moment))
        fx, fy, _ = wrench.force
        nx, ny, nz = wrench.moment
        q, total = self.link_q[j], self.code.total
        return Wrench(wrench.force, (total((nx,), (-q, fy)), total((ny,), (q, fx)), nz))

    def _inertial(self, motion: Motion, parameters: Array) -> Wrench:
        """Return `F = m a + U h` and `N = I dw + w x I w + h x a`, `U = [dw]x + [w]x [w]x`."""
        xx, xy, xz, yy, yz, zz, *h, m = map(Term, parameters.tolist())
        inertia: Matrix = ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))
        moment_of_mass: Vector = (h[0], h[1], h[2])
        force, moment = NOTHING, NOTHING
        if any(not entry.is_zero for entry in (xx, xy, xz, yy, yz, zz)):
            moment = self._added(
                self._times(inertia, motion.dw),
                self._cross(motion.w, self._times(inertia, motion.w)),
            )
        if any(not entry.is_zero for entry in moment_of_mass):
            force = self._times(self._swing(motion), moment_of_mass)
            moment = self._added(moment, self._cross(moment_of_mass, motion.a))
        fx, fy, fz = (
            self.code.total((part,), (m, a)) for part, a in zip(force, motion.a, strict=True)
        )
        return Wrench((fx, fy, fz), moment)

    def _momentum(self, twist: Screw, parameters: Array) -> Wrench:
        """Return force `m v + w x h` and moment `I w + h x v` of a link."""
        xx, xy, xz, yy, yz, zz, *h, m = map(Term, parameters.tolist())
        first: Vector = (h[0], h[1], h[2])
        turned, swung = self._cross(twist.z, first), self._cross(first, twist.m)
        rows, total = ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz)), self.code.total
        fx, fy, fz = (total((m, v), (t,)) for v, t in zip(twist.m, turned, strict=True))
        nx, ny, nz = (
            total(*zip(row, twist.z, strict=True), (s,)) for row, s in zip(rows, swung, strict=True)
        )
        return Wrench((fx, fy, fz), (nx, ny, nz))

    def _screws(self) -> list[dict[int, Screw]]:
        """Return for each link the screws of the joints that move it."""
        screws: list[dict[int, Screw]] = []
        for j, joint in enumerate(self.tree.joints):
            above = {} if joint.parent == ROOT else screws[joint.parent]
            axis: Vector = (ZERO, ZERO, ONE)
            moved = {
                k: self._over(j, self._through(joint.before, screw)) for k, screw in above.items()
            }
            moved[j] = Screw(axis, NOTHING) if joint.is_revolute else Screw(NOTHING, axis)
            screws.append({k: self._through(joint.after, screw) for k, screw in moved.items()})
        return screws

    def _through(self, placement: Array, screw: Screw) -> Screw:
        R, p = _make_matrix(placement[:3, :3].T), _make_vector(placement[:3, 3])
        return Screw(
            self._times(R, screw.z), self._times(R, self._added(screw.m, self._cross(screw.z, p)))
        )

    def _over(self, j: int, screw: Screw) -> Screw:
        if self.tree.joints[j].is_revolute:
            c, s = self.cosine[j], self.sine[j]
            return Screw(self._turned(c, s, screw.z), self._turned(c, s, screw.m))
        (zx, zy, _), (mx, my, mz), q, total = screw.z, screw.m, self.link_q[j], self.code.total
        return Screw(screw.z, (total((mx,), (zy, q)), total((my,), (-zx, q)), mz))

    def _turned(self, c: Term, s: Term, v: Vector) -> Vector:
        """Return `Rz^T v`."""
        return self.code.total((c, v[0]), (s, v[1])), self.code.total((c, v[1]), (-s, v[0])), v[2]

    def _times(self, matrix: Matrix, v: Vector) -> Vector:
        x, y, z = (self.code.total(*zip(row, v, strict=True)) for row in matrix)
        return x, y, z

    def _cross(self, u: Vector, v: Vector) -> Vector:
        total = self.code.total
        return (
            total((u[1], v[2]), (-u[2], v[1])),
            total((u[2], v[0]), (-u[0], v[2])),
            total((u[0], v[1]), (-u[1], v[0])),
        )

    def _added(self, *vectors: Vector) -> Vector:
        x, y, z = (self.code.sum(*parts) for parts in zip(*vectors, strict=True))
        return x, y, z


def _make_vector(values: Array) -> Vector:
    x, y, z = map(Term, values.tolist())
    return x, y, z


def _make_matrix(values: Array) -> Matrix:
    x, y, z = (_make_vector(row) for row in values)
    return x, y, z


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

    def apply(operation: str, *operands: Term) -> Term:
        match operation:
            case "add":
                return code.sum(*operands)
            case "subtract":
                return code.sum(operands[0], -operands[1])
            case "negative":
                return -operands[0]
            case "multiply":
                return code.total(operands)
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
    code, shares = mechanism.code, mechanism.model.motor_shares
    loads = mechanism.torques(parameters) if drive.needs_load else [ZERO] * mechanism.model.n_joints
    entries: list[dict[int, Term]] = []
    for k, load in enumerate(loads):
        for term in drive.at(k).terms:
            acts_on = shares[k] if term.of_motor else np.eye(len(loads))[k]
            if not term.is_at(k) or not acts_on.any():
                entries += [{} for _ in term.symbols]
                continue
            state = {"q": mechanism.q, "qd": mechanism.qd, "qdd": mechanism.qdd}
            values = {
                array: code.sum(
                    *[
                        Term(float(share) * term.factor, term.name)
                        for share, term in zip(acts_on, terms, strict=True)
                    ]
                )
                for array, terms in state.items()
            }
            values |= {
                name: Term(term.value(name)) for name in (each.name for each in term.nonlinear)
            }
            columns = [
                write_formula(code, column, {**values, "load": load}) for column in term.columns
            ]
            entries += [
                {
                    int(j): code.total((Term(float(acts_on[j])), column))
                    for j in np.flatnonzero(acts_on)
                }
                for column in columns
            ]
    return entries


def with_drives(
    mechanism: Mechanism, torques: list[Term], drive: DriveSet, values: Array, parameters: Array
) -> list[Term]:
    """Return joint torques with the torques of drive terms of these values added."""
    found = list(torques)
    for entry, value in zip(list_drive_entries(mechanism, drive, parameters), values, strict=True):
        for j, column in entry.items():
            found[j] = mechanism.code.total((found[j],), (Term(float(value)), column))
    return found
