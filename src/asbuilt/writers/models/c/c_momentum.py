"""Mass matrix, generalised momentum and its gradient as straight-line arithmetic in C."""

from __future__ import annotations

from dataclasses import dataclass

from asbuilt.arrays import Array
from asbuilt.description.model import ROOT
from asbuilt.writers.models.c.c_dynamics import Mechanism, Wrench
from asbuilt.writers.models.c.c_expressions import ONE, ZERO, Term, Vector

NOTHING: Vector = (ZERO, ZERO, ZERO)


@dataclass(frozen=True, slots=True)
class Twist:
    """Hold angular velocity `w` and velocity `v` of the origin of a frame, in its axes."""

    w: Vector
    v: Vector


def momentum_terms(
    mechanism: Mechanism, parameters: Array, armature: Array
) -> tuple[list[Term], list[Term]]:
    """Return `p = (M + A) qd` and `C^T qd` of each joint for inertial parameters (10 n,).

    With the twist V of a joint frame, the momentum H of what the joint carries and its axis S,
    `p = S . H` and `C^T qd = dT/dq = -H . (S x V)`.
    """
    momenta, gradient = _carried(mechanism, parameters, mechanism.qd)
    code, qd = mechanism.code, mechanism.qd
    rotors = [
        [(Term(float(a)), rate) for a, rate in zip(row, qd, strict=True) if a] for row in armature
    ]
    return [code.total((p,), *extra) for p, extra in zip(momenta, rotors, strict=True)], gradient


def mass_matrix_terms(
    mechanism: Mechanism, parameters: Array, armature: Array
) -> dict[tuple[int, int], Term]:
    """Return the entries (joint, joint) of `M + A`: column k is the momentum of unit rate k."""
    n = mechanism.model.n_joints
    entries: dict[tuple[int, int], Term] = {}
    for k in range(n):
        momenta, _ = _carried(mechanism, parameters, [ONE if j == k else ZERO for j in range(n)])
        for j in range(k, n):
            total = mechanism.code.sum(momenta[j], Term(float(armature[j, k])))
            entries[j, k] = entries[k, j] = total
    return entries


def _carried(
    mechanism: Mechanism, parameters: Array, rates: list[Term]
) -> tuple[list[Term], list[Term]]:
    model, code = mechanism.tree, mechanism.code
    n, parameters = model.n_joints, mechanism.of_tree(parameters)
    rates = mechanism.of_links(rates)
    at_joint: list[Twist] = []
    of_link: list[Twist] = []
    for j, joint in enumerate(model.joints):
        above = Twist(NOTHING, NOTHING) if joint.parent == ROOT else of_link[joint.parent]
        at_joint.append(_moved(mechanism, j, _into(mechanism, joint.before, above), rates[j]))
        of_link.append(_into(mechanism, joint.after, at_joint[j]))
    carried: list[list[Wrench]] = [[] for _ in range(n)]
    momenta, gradient = [ZERO] * n, [ZERO] * n
    for j in reversed(range(n)):
        joint = model.joints[j]
        own = _momentum(mechanism, of_link[j], parameters[10 * j : 10 * j + 10])
        whole = Wrench(
            mechanism._added(own.force, *(w.force for w in carried[j])),
            mechanism._added(own.moment, *(w.moment for w in carried[j])),
        )
        h, twist = mechanism._out(joint.after, whole), at_joint[j]
        if joint.is_revolute:
            momenta[j] = h.moment[2]
            pairs = [(h.moment, twist.w), (h.force, twist.v)]
        else:
            momenta[j] = h.force[2]
            pairs = [(h.force, twist.w)]
        gradient[j] = code.total(
            *((each[0], other[1]) for each, other in pairs),
            *((-each[1], other[0]) for each, other in pairs),
        )
        if joint.parent != ROOT:
            carried[joint.parent].append(mechanism._out(joint.before, mechanism._unturned(j, h)))
    return mechanism.of_joints(momenta), mechanism.of_joints(gradient)


def _into(mechanism: Mechanism, placement: Array, twist: Twist) -> Twist:
    """Return the twist of a frame at `placement` in a moving frame."""
    R = placement[:3, :3].T
    x, y, z = (Term(float(value)) for value in placement[:3, 3])
    rows = [tuple(Term(float(value)) for value in row) for row in R]
    moved = mechanism._added(twist.v, mechanism._cross(twist.w, (x, y, z)))
    total = mechanism.code.total
    w, v = (
        tuple(total(*zip(row, vector, strict=True)) for row in rows) for vector in (twist.w, moved)
    )
    return Twist((w[0], w[1], w[2]), (v[0], v[1], v[2]))


def _moved(mechanism: Mechanism, j: int, at: Twist, rate: Term) -> Twist:
    """Return the twist beyond joint j, in its axes."""
    code = mechanism.code
    if mechanism.tree.joints[j].is_revolute:
        c, s = mechanism.cosine[j], mechanism.sine[j]
        w, v = mechanism._turned(c, s, at.w), mechanism._turned(c, s, at.v)
        return Twist((w[0], w[1], code.sum(w[2], rate)), v)
    q, (x, y, _), (vx, vy, vz) = mechanism.link_q[j], at.w, at.v
    return Twist(at.w, (code.total((vx,), (y, q)), code.total((vy,), (-x, q)), code.sum(vz, rate)))


def _momentum(mechanism: Mechanism, twist: Twist, parameters: Array) -> Wrench:
    """Return force `m v + w x h` and moment `I w + h x v` of a link."""
    xx, xy, xz, yy, yz, zz, hx, hy, hz, m = (Term(float(value)) for value in parameters)
    h, total = (hx, hy, hz), mechanism.code.total
    turned = mechanism._cross(twist.w, h)
    swung = mechanism._cross(h, twist.v)
    force = tuple(total((m, v), (t,)) for v, t in zip(twist.v, turned, strict=True))
    rows = ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))
    moment = tuple(
        total(*zip(row, twist.w, strict=True), (s,)) for row, s in zip(rows, swung, strict=True)
    )
    return Wrench((force[0], force[1], force[2]), (moment[0], moment[1], moment[2]))
