"""Reactions: forces at contacts that nobody measured, and equations of motion without them.

With the Jacobian J of the points in contact, `tau = Y chi - J^T f`. The projection
`P = 1 - J^+ J` has `P J^T = 0`, so that `P tau = P Y chi` whatever the forces are (Khorshidi et
al., 2025; Mistry, Buchli and Schaal, 2010). P is symmetric and `P P = P`: it changes no noise that
is the same in all equations but takes its part along the contacts, and every row stays with its
joint.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from asbuilt.arrays import Array, Indices
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.kernels.joint_space import orthonormalise_rows, project
from asbuilt.dynamics.kinematics import link_jacobians, link_poses

SAMPLES_AT_ONCE = 2048
"""Samples whose Jacobians are held at once."""
DEPENDENT = 1e-9
"""Part of a contact's row outside all rows before it, below which it adds no direction."""


def contact_jacobians(model: RobotModel, q: Array) -> tuple[Array, ...]:
    """Return the Jacobian of each contact at positions q (N, n), in axes of the world.

    Shape (N, 3, n), or (N, 6, n) with the angular velocity last if it is flat.
    """
    jacobians = link_jacobians(model, q)
    poses = link_poses(model, q)
    found = []
    for contact in model.contacts:
        link, placement = model.placed(contact.frame)
        turn = poses[:, link, :3, :3]
        J = jacobians[:, link]
        swung = np.cross(np.swapaxes(J[:, :3], 1, 2), placement[:3, 3])
        point = J[:, 3:] + np.swapaxes(swung, 1, 2)
        linear = turn @ point
        angular = turn @ J[:, :3]
        below = np.cross(np.swapaxes(angular, 1, 2), [0.0, 0.0, -(contact.radius or 0.0)])
        linear = linear + np.swapaxes(below, 1, 2)
        found.append(np.concatenate([linear, angular], axis=1) if contact.flat else linear)
    return tuple(found)


def contact_basis(
    model: RobotModel, q: Array, contact: Array, noise: Sequence[float] = ()
) -> Array:
    """Return orthonormal rows that span the torques `J^T f`, shape (m, n, N).

    `contact` (N, n_contacts) is above 0 where a contact is closed; rows of others are zero. Where
    equations are divided by the `noise` (n,) of each, so is J.
    """
    scale = np.asarray(noise) if noise else np.ones(model.n_joints)
    closed = [
        J / scale * (contact[:, k] > 0.0)[:, None, None]
        for k, J in enumerate(contact_jacobians(model, q))
    ]
    basis = np.ascontiguousarray(np.concatenate(closed, axis=1).transpose(1, 2, 0))
    orthonormalise_rows(basis, DEPENDENT)
    return basis


@dataclass(frozen=True, slots=True, eq=False)
class Reactions:
    """Hold where and when forces act that nobody measured; by default none do.

    Whoever makes equations of samples projects them by this, and need not know what a robot stands
    on: without reactions everything stays as it is.

    Parameters
    ----------
    contact
        Which contacts are closed, above 0, at each sample, (N, n_contacts); None: nothing acts.
    noise
        Noise (n,) of the equation of each joint, in whose units a projection loses nothing (Aitken,
        1935); empty: the same for all.
    """

    contact: Array | None = None
    noise: tuple[float, ...] = ()

    def __bool__(self) -> bool:
        return self.contact is not None

    @property
    def n_samples(self) -> int | None:
        """Number of samples at which it is known; None: nothing acts, ever."""
        return None if self.contact is None else len(self.contact)

    def at(self, samples: slice | Indices) -> Reactions:
        """Return those of some samples."""
        return self if self.contact is None else replace(self, contact=self.contact[samples])

    def in_units_of(self, noise: tuple[float, ...]) -> Reactions:
        """Return them with other noise of the equations."""
        return replace(self, noise=noise)

    def basis(self, model: RobotModel, q: Array) -> Array:
        """Return orthonormal rows (m, n, N) that span the torques of what acts at q (N, n)."""
        if self.contact is None:
            return np.empty((0, model.n_joints, len(q)))
        return contact_basis(model, q, self.contact, self.noise)

    def project_rows(
        self, model: RobotModel, q: Array, rows: Sequence[Array], buffer: Array
    ) -> None:
        """Take reactions out of the rows of all joints at positions q (N, n), in place.

        `rows` are views of the `buffer` of a `RegressorPlan`, (p + spare, at least N) of a joint.
        """
        if self.contact is None:
            return
        for own, noise in zip(rows, self.noise, strict=False):
            np.divide(own, noise, out=own)
        project(self.basis(model, q), buffer, len(q))

    def project_torque(self, model: RobotModel, q: Array, tau: Array) -> Array:
        """Return torques (N, n) less the part that reactions explain: `P tau`.

        With the noise of the equations they are divided by it, as in `contact_basis`.
        """
        if self.contact is None:
            return tau
        tau = tau / np.asarray(self.noise) if self.noise else tau
        found = np.empty(tau.shape)
        for start in range(0, len(q), SAMPLES_AT_ONCE):
            span = slice(start, start + SAMPLES_AT_ONCE)
            # A copy: the transpose of one sample is the sample itself, and rows are projected in
            # place.
            rows = np.array(tau[span].T, order="C")
            basis = self.at(span).basis(model, q[span])
            project(basis, rows, rows.shape[1])
            found[span] = rows.T
        return found
