"""A robot with a free base by Pinocchio: its regressor, and what no force of a contact touches.

States are those of Pinocchio's free flyer: `q` (N, 7 + n) with position, quaternion x y z w and
joints, `qd` and `qdd` (N, 6 + n) with the rates of the base in its own axes. Forces at closed
contacts, which nobody measured, leave with `P = 1 - J^+ J` (Mistry, Buchli and Schaal, ICRA 2010).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
from adapter import Facts
from pinocchio_regressor import FROM_PINOCCHIO
from plain import Motion, closed_contacts, low_pass
from regression import Regression

Array = Any
BASE = 6
"""Velocities of the base."""


def flyer_model(facts: Facts) -> Any:
    """Return Pinocchio's model with a free base, joints in the order of the logs."""
    model = pin.buildModelFromUrdf(facts.urdf, pin.JointModelFreeFlyer())
    model.gravity.linear = np.array(facts.gravity)
    if list(model.names)[2:] != facts.joints:
        raise NotImplementedError("joints in another order than that of the description")
    return model


def described(facts: Facts) -> Array:
    """Return the parameters (n_links, 10) of the description, the base first."""
    inertias = list(flyer_model(facts).inertias)[1:]
    return np.array([each.toDynamicParameters()[FROM_PINOCCHIO] for each in inertias])


def projections(facts: Facts, q: Array, contact: Array) -> Array:
    """Return P (N, 6 + n, 6 + n) for the contacts that are closed."""
    model = flyer_model(facts)
    data, found = model.createData(), np.empty((len(q), model.nv, model.nv))
    frames = [model.getFrameId(name) for name in facts.contacts]
    radius = facts.settings.get("radius", 0.0)
    for i, (place, closed) in enumerate(zip(q, contact, strict=True)):
        J = contact_rows(model, data, place, frames, closed, radius)
        found[i] = np.eye(model.nv) - np.linalg.pinv(J) @ J
    return found


def contact_rows(
    model: Any, data: Any, q: Array, frames: list[int], closed: Array, radius: float
) -> Array:
    """Return the Jacobian rows (m, 6 + n) of the points on the ground, zeros if none."""
    pin.computeJointJacobians(model, data, q)
    pin.updateFramePlacements(model, data)
    rows = [
        at_ground(pin.getFrameJacobian(model, data, frame, pin.LOCAL_WORLD_ALIGNED), radius)
        for frame, on in zip(frames, closed, strict=True)
        if on > 0.0
    ]
    return np.vstack(rows) if rows else np.zeros((1, model.nv))


def at_ground(J: Array, radius: float) -> Array:
    """Return the Jacobian (3, n) of the point `radius` [m] below a frame, by `v + w x p`."""
    return J[:3] + np.cross(J[3:], [0.0, 0.0, -radius], axisa=0).T


class Flyer(Regression):
    """Regressor of a robot with a free base, less the forces of its contacts."""

    def __init__(self, facts: Facts) -> None:
        super().__init__(facts, _regressor(facts))

    def drive_columns(self, motion: Motion) -> Array:
        """Return the columns of the drives, below rows of zeros for the base."""
        n = self.n_joints
        joints = [None if x is None else x[:, -n:] for x in motion[1:4]]
        own = super().drive_columns(Motion(motion.t, *joints))
        return np.concatenate([np.zeros((len(own), BASE, own.shape[2])), own], axis=1)

    def stacked(self, motions: list[Motion]) -> tuple[Array, Array]:
        """Return projected W and tau after the same low-pass, coordinate by coordinate."""
        W, tau, facts = [], [], self.facts
        for motion, log in zip(motions, facts.logs(), strict=True):
            contact = closed_contacts(log["contact"], facts.rate, facts.cutoff)
            P = projections(facts, motion.q, contact)
            columns = P @ np.concatenate([self.bodies(motion), self.drive_columns(motion)], axis=2)
            torque = np.einsum("tij,tj->ti", P[:, :, BASE:], motion.tau)
            rows = motion.inner(facts.edge)
            for x, found in ((columns, W), (torque, tau)):
                smooth = low_pass(x.reshape(len(x), -1), facts.rate, facts.cutoff)
                found.append(smooth.reshape(x.shape)[rows])
        p = W[0].shape[2]
        return np.concatenate(W).transpose(1, 0, 2).reshape(-1, p), np.concatenate(tau).T.ravel()

    def weights(self, W: Array, tau: Array) -> Array:
        """Return ones: a projected row is no longer that of one joint."""
        return np.ones(len(tau))


def _regressor(facts: Facts) -> Any:
    model = flyer_model(facts)
    data = model.createData()
    columns = np.concatenate([10 * k + FROM_PINOCCHIO for k in range(model.njoints - 1)])

    def regressor(q: Array, qd: Array, qdd: Array) -> Array:
        found = np.empty((len(q), model.nv, len(columns)))
        for i in range(len(q)):
            found[i] = pin.computeJointTorqueRegressor(model, data, q[i], qd[i], qdd[i])[:, columns]
        return found

    return regressor
