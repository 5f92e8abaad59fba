"""The joint torques, linear in the standard parameters."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from asbuilt.description.model import ROOT, RobotModel
from asbuilt.dynamics.drives.selection import NO_DRIVE, DriveSet
from asbuilt.dynamics.parameters import parameter_count
from asbuilt.errors import UsageError

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


def _hat(v: Array) -> Array:
    zero = np.zeros_like(v[..., 0])
    return np.stack([zero, -v[..., 2], v[..., 1], v[..., 2], zero, -v[..., 0], -v[..., 1], v[..., 0], zero], axis=-1).reshape(*v.shape, 3)


def _dot_inertia(v: Array) -> Array:
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    zero = np.zeros_like(x)
    return np.stack([x, y, z, zero, zero, zero, zero, x, zero, y, z, zero, zero, zero, x, zero, y, z], axis=-1).reshape(*x.shape, 3, 6)


def _rigid_columns(model: RobotModel, q: Array, qd: Array, qdd: Array) -> Array:
    geometry, n, samples = model.geometry, model.n_joints, q.shape[0]
    out = np.zeros((samples, n, 10 * n))
    w, dw, acc = (np.zeros((n, samples, 3)) for _ in range(3))
    screws: list[dict[int, tuple[Array, Array]]] = []
    for i in range(n):
        p = int(geometry.parent[i])
        rotation = np.broadcast_to(np.eye(3), (samples, 3, 3)).copy()
        slide = np.zeros((samples, 3))
        if geometry.revolute[i]:
            c, s = np.cos(q[:, i]), np.sin(q[:, i])
            rotation[:, 0, 0], rotation[:, 0, 1], rotation[:, 1, 0], rotation[:, 1, 1] = c, -s, s, c
        else:
            slide[:, 2] = q[:, i]
        br, bt, ar, at = (
            geometry.before_rotation[i],
            geometry.before_translation[i],
            geometry.after_rotation[i],
            geometry.after_translation[i],
        )
        to_joint = br @ rotation
        r = to_joint @ ar
        t = bt + slide @ br.T + to_joint @ at
        turn = np.array([0.0, 0.0, 1.0])
        z_joint = ar.T @ turn
        m_joint = ar.T @ np.cross(turn, at)
        pw = w[p] if p != ROOT else np.zeros((samples, 3))
        pdw = dw[p] if p != ROOT else np.zeros((samples, 3))
        pacc = acc[p] if p != ROOT else np.broadcast_to(-geometry.gravity, (samples, 3))
        back = np.swapaxes(r, 1, 2)

        def turned(v: Array, back: Array = back) -> Array:
            return np.einsum("sij,sj->si", back, v)

        wi, dwi = turned(pw), turned(pdw)
        ai = turned(pacc + np.cross(pdw, t) + np.cross(pw, np.cross(pw, t)))
        if geometry.revolute[i]:
            dwi = dwi + np.cross(wi, z_joint * qd[:, i : i + 1]) + z_joint * qdd[:, i : i + 1]
            arm = ar.T @ at
            full = wi + z_joint * qd[:, i : i + 1]
            before_dw = turned(pdw)
            ai = ai + np.cross(dwi - before_dw, arm) + np.cross(full, np.cross(full, arm)) - np.cross(wi, np.cross(wi, arm))
            wi = full
            own = (np.broadcast_to(z_joint, (samples, 3)), np.broadcast_to(m_joint, (samples, 3)))
        else:
            ai = ai + 2 * np.cross(wi, z_joint * qd[:, i : i + 1]) + z_joint * qdd[:, i : i + 1]
            own = (np.zeros((samples, 3)), np.broadcast_to(z_joint, (samples, 3)))
        w[i], dw[i], acc[i] = wi, dwi, ai
        chain = {} if p == ROOT else {k: (turned(z), turned(m + np.cross(z, t))) for k, (z, m) in screws[p].items()}
        chain[i] = own
        screws.append(chain)
        wx = _hat(wi)
        force = np.concatenate([np.zeros((samples, 3, 6)), _hat(dwi) + wx @ wx, ai[:, :, None]], axis=2)
        moment = np.concatenate([_dot_inertia(dwi) + wx @ _dot_inertia(wi), -_hat(ai), np.zeros((samples, 3, 1))], axis=2)
        for k, (z, m) in chain.items():
            out[:, k, 10 * i : 10 * i + 10] = np.einsum("si,sij->sj", z, moment) + np.einsum("si,sij->sj", m, force)
    return out


def _samples(model: RobotModel, **given: ArrayLike) -> tuple[Array, ...]:
    arrays = []
    for name, value in given.items():
        array = np.atleast_2d(np.asarray(value, dtype=np.float64))
        if array.ndim != 2 or array.shape[1] != model.n_joints:
            raise UsageError(
                f"{name} must have shape ({model.n_joints},) or (n_samples, {model.n_joints}) for {model.name}, got {np.shape(value)}"
            )
        arrays.append(array)
    return tuple(arrays)


def joint_support(model: RobotModel, drive: DriveSet, columns: ArrayLike) -> list[Indices]:
    """Return for each joint the positions in `columns` that can be non-zero in its row: links it carries, its own drive."""
    chosen = np.asarray(columns, dtype=np.int64)
    n = model.n_joints
    carried = np.zeros((n, n), dtype=bool)
    for i in range(n):
        carried[list(model.ancestors(i)), i] = True
    mask = np.concatenate([np.repeat(carried, 10, axis=1), np.repeat(np.eye(n, dtype=bool), drive.columns_per_joint, axis=1)], axis=1)
    return [np.flatnonzero(mask[k, chosen]) for k in range(n)]


def observation_matrix(
    model: RobotModel, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike, *, drive: DriveSet = NO_DRIVE, columns: ArrayLike | None = None
) -> Array:
    """Stack the regressors of all samples, sample-major: shape (n_samples n_joints, n_columns)."""
    qs, qds, qdds = _samples(model, q=q, qd=qd, qdd=qdd)
    n, samples = model.n_joints, qs.shape[0]
    out = np.zeros((samples, n, parameter_count(model, drive)))
    out[:, :, : 10 * n] = _rigid_columns(model, qs, qds, qdds)
    per = drive.columns_per_joint
    for k in range(n):
        start = 10 * n + per * k
        out[:, k, start : start + per] = drive.evaluate(qs[:, k], qds[:, k], qdds[:, k]).T
    stacked = out.reshape(samples * n, -1)
    return stacked if columns is None else stacked[:, np.asarray(columns, dtype=np.int64)]


def regressor(model: RobotModel, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike, drive: DriveSet = NO_DRIVE) -> Array:
    """Return Y of one sample, shape (n_joints, n_standard), with `tau = Y chi`."""
    return observation_matrix(model, q, qd, qdd, drive=drive)


def joint_observations(model: RobotModel, drive: DriveSet, columns: ArrayLike, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike) -> list[Array]:
    """Return the rows of each joint without structural zeros: shape (n_support_k, n_samples) for joint k."""
    chosen = np.asarray(columns, dtype=np.int64)
    matrix = observation_matrix(model, q, qd, qdd, drive=drive, columns=chosen).reshape(-1, model.n_joints, chosen.size)
    return [np.ascontiguousarray(matrix[:, k, support].T) for k, support in enumerate(joint_support(model, drive, chosen))]
