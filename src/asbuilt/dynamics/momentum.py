"""Generalised momentum of a robot and the gradient of its kinetic energy, and first-order lags.

With the twist `V` of a joint frame, the momentum `H` of all that the joint carries, seen from that
frame, and the axis `S`: `p = S . H` and `dT/dq = -H . (S x V)`.
"""

# mypy: allow-untyped-calls
# mypy: allow-untyped-defs

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from asbuilt.arrays import Array
from asbuilt.compilation import kernel, part
from asbuilt.description.model import RobotModel


@part
def _carry_twist_into(placement, w, v, out):
    """Write the twist (w, v) of a frame as the twist of a frame at `placement` in it."""
    x = v[0] + w[1] * placement[2, 3] - w[2] * placement[1, 3]
    y = v[1] + w[2] * placement[0, 3] - w[0] * placement[2, 3]
    z = v[2] + w[0] * placement[1, 3] - w[1] * placement[0, 3]
    for k in range(3):
        out[k] = placement[0, k] * w[0] + placement[1, k] * w[1] + placement[2, k] * w[2]
        out[3 + k] = placement[0, k] * x + placement[1, k] * y + placement[2, k] * z


@part
def _carry_momentum_out(placement, n, f, out):
    """Write the momentum (n, f) of a frame at `placement` as that about the frame it is in."""
    for k in range(3):
        out[k] = placement[k, 0] * n[0] + placement[k, 1] * n[1] + placement[k, 2] * n[2]
        out[3 + k] = placement[k, 0] * f[0] + placement[k, 1] * f[1] + placement[k, 2] * f[2]
    px = placement[0, 3]
    py = placement[1, 3]
    pz = placement[2, 3]
    out[0] += py * out[5] - pz * out[4]
    out[1] += pz * out[3] - px * out[5]
    out[2] += px * out[4] - py * out[3]


@part
def _turn(c, s, six):
    """Turn two vectors about z by the angle of cosine c and sine s."""
    for k in (0, 3):
        x = six[k]
        y = six[k + 1]
        six[k], six[k + 1] = c * x - s * y, s * x + c * y


@part
def _add_link_momentum(chi, twist, out):
    """Write moment `I w + h x v` and force `m v - h x w` of a link."""
    wx = twist[0]
    wy = twist[1]
    wz = twist[2]
    vx = twist[3]
    vy = twist[4]
    vz = twist[5]
    hx = chi[6]
    hy = chi[7]
    hz = chi[8]
    m = chi[9]
    out[0] += chi[0] * wx + chi[1] * wy + chi[2] * wz + hy * vz - hz * vy
    out[1] += chi[1] * wx + chi[3] * wy + chi[4] * wz + hz * vx - hx * vz
    out[2] += chi[2] * wx + chi[4] * wy + chi[5] * wz + hx * vy - hy * vx
    out[3] += m * vx - hy * wz + hz * wy
    out[4] += m * vy - hz * wx + hx * wz
    out[5] += m * vz - hx * wy + hy * wx


@kernel("i1 b1 f3 f3 f2 f2 f2 F2 F2")
def write_momentum(parents, revolute, before, after, chi, q, qd, p, gradient):
    """Write `p = M qd` and `C^T qd = dT/dq` (N, n) of states (N, n)."""
    samples, n = q.shape
    at_joint = np.zeros((n, 6))
    of_link = np.zeros((n, 6))
    carried = np.zeros((n, 6))
    moved = np.zeros(6)
    still = np.zeros(6)
    for k in range(samples):
        carried[:] = 0.0
        for i in range(n):
            above = still if parents[i] < 0 else of_link[parents[i]]
            twist = at_joint[i]
            _carry_twist_into(before[i], above[:3], above[3:], twist)
            if revolute[i]:
                _turn(np.cos(q[k, i]), -np.sin(q[k, i]), twist)
                twist[2] += qd[k, i]
            else:
                twist[3] += twist[1] * q[k, i]
                twist[4] -= twist[0] * q[k, i]
                twist[5] += qd[k, i]
            _carry_twist_into(after[i], twist[:3], twist[3:], of_link[i])
            _add_link_momentum(chi[i], of_link[i], carried[i])
        for i in range(n - 1, -1, -1):
            _carry_momentum_out(after[i], carried[i, :3], carried[i, 3:], moved)
            twist = at_joint[i]
            along = moved[3] * -twist[1] + moved[4] * twist[0]
            if revolute[i]:
                p[k, i] = moved[2]
                along = moved[0] * -twist[1] + moved[1] * twist[0]
                along += moved[3] * -twist[4] + moved[4] * twist[3]
                _turn(np.cos(q[k, i]), np.sin(q[k, i]), moved)
            else:
                p[k, i] = moved[5]
                moved[0] -= q[k, i] * moved[4]
                moved[1] += q[k, i] * moved[3]
            gradient[k, i] = -along
            if parents[i] >= 0:
                _carry_momentum_out(before[i], moved[:3], moved[3:], at_joint[i])
                for c in range(6):
                    carried[parents[i], c] += at_joint[i, c]


@kernel("f1 f2 f1 F2")
def write_lag(share, x, start, out):
    """Write `y_k = y_(k-1) + share_k (x_k - y_(k-1))` from `start`, for x (N, m), share (N,).

    A negative share starts again at zero.
    """
    samples, m = x.shape
    for j in range(m):
        y = start[j]
        for k in range(samples):
            y = 0.0 if share[k] < 0.0 else y + share[k] * (x[k, j] - y)
            out[k, j] = y


class Momentum:
    """Evaluate `p = M(q) qd` and `C(q, qd)^T qd` of states (N, n) that are trusted.

    `C^T qd = dM/dt qd - C qd` is the gradient of kinetic energy by position, so it is the same for
    every factor C with `dM/dt = C + C^T`. `chi` (n_links, 10) are the inertial parameters; the
    states are contiguous doubles.
    """

    def __init__(self, model: RobotModel, chi: Array) -> None:
        self._joint_map = model.joint_map
        self._mechanism = build_mechanism_arrays(model.tree)
        self._chi = np.ascontiguousarray(self._joint_map.parameters(chi))

    def __call__(self, q: Array, qd: Array) -> tuple[Array, Array]:
        """Return p and the gradient of kinetic energy, two (N, n)."""
        moved = self._joint_map.motion(q, qd)
        p = np.empty(moved.q.shape)
        gradient = np.empty(moved.q.shape)
        write_momentum(*self._mechanism, self._chi, moved.q, moved.qd, p, gradient)
        own = moved.torques(gradient)
        change = self._joint_map.derivatives(q, qd, np.zeros_like(q))
        if change is not None:  # kinetic energy also changes as the shares do
            own += np.einsum("si,sij->sj", p, change.turning)
        return moved.torques(p), own


@lru_cache(maxsize=16)
def build_mechanism_arrays(model: RobotModel) -> tuple[Any, ...]:
    """Return parents, kinds and placements of the joints as the kernel takes them."""
    return (
        np.array(model.parents, dtype=np.int64),
        np.array([joint.is_revolute for joint in model.joints]),
        np.array([joint.before for joint in model.joints], dtype=np.float64),
        np.array([joint.after for joint in model.joints], dtype=np.float64),
    )


def apply_lag(share: Array, x: Array, start: Array | None = None) -> Array:
    """Return the first-order lag of x (N, m).

    `y_k = y_(k-1) + share_k (x_k - y_(k-1))`, from `start` (m,) or 0, with shares (N,); a negative
    share starts again at 0.
    """
    out = np.empty(x.shape)
    begin = np.zeros(x.shape[1]) if start is None else np.array(start, dtype=np.float64)
    write_lag(share, np.ascontiguousarray(x), begin, out)
    return out
