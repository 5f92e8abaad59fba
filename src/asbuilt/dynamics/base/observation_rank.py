"""The numeric rank of an observation matrix at random states.

The second road to the number of base parameters.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import ROOT, RobotModel
from asbuilt.dynamics.drives.drive_set import DriveSet
from asbuilt.dynamics.drives.torque import drive_columns
from asbuilt.dynamics.kinematics import draw_postures

ABSENT_COLUMN = 1e-12
"""A column smaller than this, relative to the largest, is rounding noise and counts as zero before
columns are scaled.
"""

RANK_TOLERANCE = 1e-11
"""Relative singular values of the column-scaled matrix below this count as zero."""

ROWS_PER_COLUMN = 2.0
"""Rows of the matrix for each of its columns.

With one for each, chance could make it look singular.
"""
FEWEST_STATES = 12
"""Random states for a robot of few joints and columns."""
DRAWN = 16
"""Random states are drawn so many at a time: drives of a few terms more use the same."""
ROBOTS_KEPT = 4
"""Robots whose link columns are remembered."""
SEED = 20151


@dataclass(frozen=True, eq=False)
class ObservationRank:
    """Hold the `rank` of a random observation matrix and its `singular_values`.

    The latter are of the scaled columns, relative to the largest.
    """

    rank: int
    singular_values: Array


def observation_rank(model: RobotModel, drive: DriveSet) -> ObservationRank:
    """Return the rank of the column-scaled observation matrix at random states.

    The states are the same at every call.

    The matrix comes from Kane's equations in root axes, `tau_k = sum_i (partial velocities of link
    i) . (inertia forces of link i)`, so that it shares neither the recursion nor the compiled
    kernels of the regressor. A load that drive terms depend on comes from random parameters.
    """
    n = model.n_joints
    first = 10 * model.n_links
    n_columns = first + drive.columns_per_joint * n
    samples = max(FEWEST_STATES, int(np.ceil(ROWS_PER_COLUMN * n_columns / n)))
    *state, rigid = _evaluate_links(model, DRAWN * -(-samples // DRAWN))
    q, qd, qdd = (part[:samples] for part in state)
    rigid = rigid[:, :samples]
    Y = np.zeros((n, samples, n_columns))
    Y[:, :, :first] = rigid
    load = None
    if drive.needs_load:
        parameters = np.random.default_rng(SEED).uniform(0.5, 1.5, (n, first))
        pairs = zip(rigid, parameters, strict=True)
        load = np.stack([rows @ chi for rows, chi in pairs], axis=1)
    drive = DriveSet(tuple(term.typical() for term in drive.terms))
    shares = model.motor_shares
    of_motor = drive.of_motor
    for k in range(n):
        own = slice(first + drive.columns_per_joint * k, first + drive.columns_per_joint * (k + 1))
        columns = drive_columns(drive, k, q, qd, qdd, load=load, shares=shares).T
        for j in range(n):
            Y[j, :, own] = columns * np.where(of_motor, shares[k, j], float(j == k))
    stacked = Y.reshape(n * samples, n_columns)
    sizes = np.linalg.norm(stacked, axis=0)
    present = sizes > ABSENT_COLUMN * sizes.max()
    singular_values = np.linalg.svd(stacked[:, present] / sizes[present], compute_uv=False)
    singular_values /= singular_values[0]
    return ObservationRank(int(np.sum(singular_values > RANK_TOLERANCE)), singular_values)


@lru_cache(maxsize=ROBOTS_KEPT)
def _evaluate_links(model: RobotModel, samples: int) -> tuple[Array, Array, Array, Array]:
    """Return random q, qd and qdd (samples, n), and the columns of the links at these.

    They are (n, samples, 10 n_links), remembered: drives are tried by the dozen.
    """
    n = model.n_joints
    rng = np.random.default_rng(SEED)
    q = draw_postures(model, rng, samples)
    qd = rng.normal(scale=2.0, size=(samples, n))
    qdd = rng.normal(scale=4.0, size=(samples, n))
    rigid = np.zeros((n, samples, 10 * model.n_links))
    if model.tree is model:
        _fill_rigid_body_columns(model, q, qd, qdd, rigid)
    else:
        of_tree = np.zeros((model.n_links, samples, 10 * model.n_links))
        moved = model.joint_map.motion(q, qd, qdd)
        _fill_rigid_body_columns(model.tree, moved.q, moved.qd, moved.qdd, of_tree)
        order = np.argsort(model.joint_map.order)
        by_link = of_tree.reshape(model.n_links, samples, -1, 10)[:, :, order]
        shares = np.broadcast_to(moved.by_sample, (samples, *moved.by_sample.shape[1:]))
        rigid[...] = np.einsum("sik,isc->ksc", shares, by_link.reshape(of_tree.shape))
    rigid[:, :, find_negligible_columns(model)] = 0.0
    for array in (q, qd, qdd, rigid):
        array.setflags(write=False)
    return q, qd, qdd, rigid


def find_negligible_columns(model: RobotModel) -> list[int]:
    """Return the columns of links that are declared to have no inertia worth a parameter."""
    return [10 * i + j for i, link in enumerate(model.links) if link.negligible for j in range(10)]


def _fill_rigid_body_columns(
    model: RobotModel, q: Array, qd: Array, qdd: Array, out: Array
) -> None:
    """Fill `out` (n, n_samples, 10 n) by Kane's equations."""
    samples, n = q.shape
    still = np.zeros((samples, 3))
    ahead = (
        np.broadcast_to(np.eye(3), (samples, 3, 3)),
        still,
        still,
        still,
        np.broadcast_to(-model.gravity, (samples, 3)),
    )
    states = {ROOT: ahead}
    axes = np.zeros((n, samples, 3))
    points = np.zeros((n, samples, 3))
    revolute = np.array([joint.is_revolute for joint in model.joints])
    for i, joint in enumerate(model.joints):
        R, p, w, dw, a = states[joint.parent]
        arm = R @ joint.before[:3, 3]
        R = R @ joint.before[:3, :3]
        p = p + arm
        a = a + _cross(dw, arm) + _cross(w, _cross(w, arm))
        z = R[:, :, 2]
        axes[i] = z
        points[i] = p
        rate = qd[:, i, None]
        acceleration = qdd[:, i, None]
        if joint.is_revolute:
            turn = np.zeros((samples, 3, 3))
            turn[:, 0, 0] = turn[:, 1, 1] = np.cos(q[:, i])
            turn[:, 1, 0] = np.sin(q[:, i])
            turn[:, 0, 1] = -turn[:, 1, 0]
            turn[:, 2, 2] = 1.0
            R = R @ turn
            dw = dw + _cross(w, rate * z) + acceleration * z
            w = w + rate * z
        else:
            slid = q[:, i, None] * z
            p = p + slid
            a = (
                a
                + _cross(dw, slid)
                + _cross(w, _cross(w, slid))
                + 2.0 * _cross(w, rate * z)
                + acceleration * z
            )
        arm = R @ joint.after[:3, 3]
        R = R @ joint.after[:3, :3]
        p = p + arm
        a = a + _cross(dw, arm) + _cross(w, _cross(w, arm))
        states[i] = (R, p, w, dw, a)
        body = _evaluate_inertia_forces(
            *(np.einsum("sij,si->sj", R, vector) for vector in (w, dw, a))
        )
        chain = np.array(model.ancestors(i))
        turns = revolute[chain, None, None]
        angular = np.where(turns, axes[chain], 0.0)
        linear = np.where(turns, _cross(axes[chain], p - points[chain]), axes[chain])
        partial = np.concatenate(
            [np.swapaxes(angular, 0, 1) @ R, np.swapaxes(linear, 0, 1) @ R], axis=2
        )
        out[chain, :, 10 * i : 10 * i + 10] = np.swapaxes(partial @ body, 0, 1)


def _evaluate_inertia_forces(w: Array, dw: Array, a: Array) -> Array:
    """Return moment about the origin and force of a link, linear in its ten parameters.

    Shape (n_samples, 6, 10), in link axes.

    `moment = I dw + w x I w + h x a`, `force = m a + dw x h + w x (w x h)`.
    """
    body = np.zeros((len(w), 6, 10))
    for column, (i, j) in enumerate(((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))):
        tensor = np.zeros((3, 3))
        tensor[i, j] = tensor[j, i] = 1.0
        body[:, :3, column] = dw @ tensor + _cross(w, w @ tensor)
    for k, unit in enumerate(np.eye(3)):
        body[:, :3, 6 + k] = _cross(np.broadcast_to(unit, a.shape), a)
        body[:, 3:, 6 + k] = _cross(dw, np.broadcast_to(unit, a.shape)) + _cross(
            w, _cross(w, np.broadcast_to(unit, a.shape))
        )
    body[:, 3:, 9] = a
    return body


def _cross(u: Array, v: Array) -> Array:
    """Return the cross product over the last axis.

    `numpy.cross` is several times slower on small arrays.
    """
    x = u[..., 0]
    y = u[..., 1]
    z = u[..., 2]
    a = v[..., 0]
    b = v[..., 1]
    c = v[..., 2]
    return np.stack([y * c - z * b, z * a - x * c, x * b - y * a], axis=-1)
