"""Robots with closed chains by Pinocchio: passive joints from the motors, torques by virtual work.

Joints x of the tree of bodies are placed by the motors q such that points of two links coincide,
`r(x) = p_a(x) - p_b(x) = 0`, by Newton's method from the posture before. With the Jacobian J of r,
split into motors and passive joints, `G = dx/dq` solves `J G = 0`, accelerations solve
`J xdd = -dJ/dt xd`, and a torque of the tree acts on the motors by `G^T`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from adapter import Facts
from pinocchio_regressor import tree_regressor
from plain import Motion
from regression import Regression

Array = Any
CLOSED = 1e-10
"""Distance [m] of the points of a loop that is closed."""
STEPS = 60
"""Steps of Newton's method; four do between samples of a motion."""
LARGEST = 0.3
"""Largest step of a joint [rad or m], so that a search keeps to the side on which it begins."""


class TreeStates(NamedTuple):
    """Motion of the joints of the tree, each (N, n_tree), and G (N, n_tree, n)."""

    x: Array
    xd: Array
    xdd: Array
    shares: Array


class ClosedChains:
    """The tree of a robot, its loops, and the motion of all joints by that of its motors."""

    def __init__(self, facts: Facts) -> None:
        assert facts.loops is not None
        self.model = pin.buildModelFromUrdf(facts.urdf)
        self.model.gravity.linear = np.array(facts.gravity)
        self.joints = facts.tree_joints
        names = list(self.model.names)[1:]
        self.rows = [names.index(each) for each in facts.tree_joints]
        self.motors = [facts.tree_joints.index(each) for each in facts.joints]
        self.passive = [k for k in range(len(self.rows)) if k not in self.motors]
        self.posture = np.array([facts.loops["posture"].get(each, 0.0) for each in self.joints])
        self.ends = [
            (self._frame(*loop["a"]), self._frame(*loop["b"])) for loop in facts.loops["points"]
        ]
        self.data = self.model.createData()

    def _frame(self, link: str, point: list[float]) -> int:
        body = self.model.frames[self.model.getFrameId(link)]
        place = body.placement * pin.SE3(np.eye(3), np.array(point))
        name = f"end_{len(self.model.frames)}"
        kind = pin.FrameType.OP_FRAME
        return self.model.addFrame(pin.Frame(name, body.parentJoint, place, kind))

    def configuration(self, x: Array) -> Array:
        """Return Pinocchio's configuration: joints without limits by cosine and sine."""
        q = np.empty(self.model.nq)
        for k, row in enumerate(self.rows):
            joint = self.model.joints[row + 1]
            own = [np.cos(x[k]), np.sin(x[k])] if joint.nq == 2 else [x[k]]
            q[joint.idx_q : joint.idx_q + joint.nq] = own
        return q

    def _gap(self, x: Array) -> tuple[Array, Array]:
        """Return r (3 loops,) and J (3 loops, n_tree)."""
        pin.computeJointJacobians(self.model, self.data, self.configuration(x))
        pin.updateFramePlacements(self.model, self.data)
        ends = [[self.data.oMf[each].translation for each in pair] for pair in self.ends]
        J = [self._jacobian(a) - self._jacobian(b) for a, b in self.ends]
        return np.concatenate([a - b for a, b in ends]), np.vstack(J)

    def _jacobian(self, frame: int) -> Array:
        kind = pin.LOCAL_WORLD_ALIGNED
        return pin.getFrameJacobian(self.model, self.data, frame, kind)[:3, self.rows]

    def _drift(self, x: Array, xd: Array) -> Array:
        """Return `dJ/dt xd`: the acceleration of r where no joint accelerates."""
        qd = np.zeros(self.model.nv)
        qd[self.rows] = xd
        still = np.zeros_like(qd)
        pin.forwardKinematics(self.model, self.data, self.configuration(x), qd, still)
        kind = pin.LOCAL_WORLD_ALIGNED
        ends = [
            [pin.getFrameClassicalAcceleration(self.model, self.data, each, kind).linear
             for each in pair]
            for pair in self.ends
        ]  # fmt: skip
        return np.concatenate([a - b for a, b in ends])

    def closed(self, q: Array, start: Array) -> tuple[Array, Array]:
        """Return all joints with the motors at q (n,), near a posture, and J there."""
        x = np.array(start)
        x[self.motors] = q
        for _ in range(STEPS):
            gap, J = self._gap(x)
            if np.abs(gap).max() < CLOSED:
                return x, J
            step = _least(J[:, self.passive], gap)
            x[self.passive] -= step * min(1.0, LARGEST / np.abs(step).max())
        raise ValueError(f"the loops do not close at {np.round(q, 3).tolist()}")

    def motion(self, q: Array, qd: Array, qdd: Array) -> TreeStates:
        """Return the motion of all joints for one of the motors (N, n) each."""
        N, n = len(q), len(self.rows)
        states = TreeStates(*(np.zeros((N, n)) for _ in range(3)), np.zeros((N, n, q.shape[1])))
        at, G, before = self.posture, states.shares[0], q[0]
        for i in range(N):
            at, J = self.closed(q[i], at + G @ (q[i] - before))
            own, rest = J[:, self.motors], J[:, self.passive]
            G = states.shares[i]
            G[self.motors] = np.eye(q.shape[1])
            G[self.passive] = -_least(rest, own)
            states.x[i], states.xd[i], states.xdd[i] = at, G @ qd[i], G @ qdd[i]
            drift = self._drift(at, states.xd[i])
            states.xdd[i, self.passive] -= _least(rest, drift)
            before = q[i]
        return states

    def torque(self, q: Array, qd: Array, qdd: Array) -> Array:
        """Return the torque (N, n) of the bodies of the description at the motors."""
        states = self.motion(q, qd, qdd)
        found = np.empty(q.shape)
        rate, change = np.zeros(self.model.nv), np.zeros(self.model.nv)
        for i, x in enumerate(states.x):
            rate[self.rows], change[self.rows] = states.xd[i], states.xdd[i]
            tau = pin.rnea(self.model, self.data, self.configuration(x), rate, change)
            found[i] = states.shares[i].T @ tau[self.rows]
        return found


class Closed(Regression):
    """Regressor of a robot with closed chains, `G^T Y(x)`."""

    def bodies(self, motion: Motion) -> Array:
        """Return the columns of the links (N, n, 10 n_links)."""
        states = ClosedChains(self.facts).motion(motion.q, motion.qd, motion.qdd)
        columns = self.tree(states.x, states.xd, states.xdd)
        return np.einsum("tij,tip->tjp", states.shares, columns)


def regression_of(facts: Facts) -> Regression:
    """Return the regression of an arm by Pinocchio."""
    kind = Regression if facts.loops is None else Closed
    return kind(facts, tree_regressor(facts))


def _least(J: Array, b: Array) -> Array:
    """Return the least-squares solution of `J x = b`, J of full column rank."""
    return np.linalg.solve(J.T @ J, J.T @ b)
