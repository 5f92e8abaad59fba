"""Derivatives of joint torques by positions, velocities and accelerations, for many parameter sets.

The recursion runs in the root frame: with the joint screws S and their rates there, the derivatives
need no more than sums over the links that a joint carries. What depends on the motion alone is
found once for all sets.
"""

# mypy: allow-untyped-defs

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array
from asbuilt.compilation import kernel, part
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.batches import flatten_array, shape_joint_samples
from asbuilt.dynamics.kernels.lanes import LANES, load, splat, store
from asbuilt.dynamics.kernels.recursion import (
    BLOCK,
    DEPTH,
    PARENT,
    REVOLUTE,
    allocate_scratch,
    build_layout,
    cross,
    gather_states,
    put,
    put_six,
    read_nine,
    read_six,
    trigonometry,
    vector,
)
from asbuilt.dynamics.newton_euler import inverse_dynamics
from asbuilt.errors import UsageError

POSE, PLACE, SCREW, TURN, TURN_2, SPEED, CHANGE, MOTION = 0, 9, 12, 18, 24, 30, 36, 42
"""Rows of a link's motion: rotation and place.

Its joint's screw S, `v x S` and `a x S + v x (v x S)` with v, a of its parent; its own v and a.
"""

MASS, MOMENT, INERTIA, MOMENTUM, FLOW, WRENCH, BODY = 0, 1, 4, 10, 13, 22, 28
"""Rows of a body, summed over all that a joint carries.

Mass, first moment h, inertia I, momentum, `D = sum dm rdot r^T`, and wrench.
"""


def torque_derivatives(
    model: RobotModel,
    q: ArrayLike,
    qd: ArrayLike,
    qdd: ArrayLike,
    parameters: ArrayLike | None = None,
) -> Array:
    """Return `d tau_k / d (q_j, qd_j, qdd_j)` of the rigid bodies for each parameter set.

    Shape (n_samples, n_sets, n, n, 3), axes k, j, order.

    `q, qd, qdd` are (n_samples, n); `parameters` (n_sets, 10 n_links) are sets of parameters,
    the model's own alone where None. Raises UsageError for shapes that do not fit. Source: Singh,
    Russell and Wensing (2022), the Coriolis sums written with the first moment of the momentum, so
    that a body takes 28 numbers.
    """
    qs, qds, qdds = shape_joint_samples(model, q=q, qd=qd, qdd=qdd)
    samples, n = qs.shape
    sets = np.asarray(
        model.parameters[None] if parameters is None else parameters, dtype=np.float64
    )
    if sets.ndim != 2 or sets.shape[1] != 10 * model.n_links:
        raise UsageError(
            f"sets of parameters of {model.name} must have shape (n_sets, {10 * model.n_links}),"
            f" got {sets.shape}"
        )
    if model.tree is not model:
        joint_map = model.joint_map
        moved = joint_map.motion(qs, qds, qdds)
        state = moved.q, moved.qd, moved.qdd
        in_tree = joint_map.parameters(sets.reshape(len(sets), -1, 10)).reshape(len(sets), -1)
        of_tree = torque_derivatives(model.tree, *state, in_tree)
        G = np.broadcast_to(moved.by_sample, (samples, *moved.by_sample.shape[1:]))
        # d tau = G^T (d tau_tree) G, and the change of G below.
        found = np.einsum("aik,abijo,ajl->abklo", G, of_tree, G, optimize=True)
        if (change := joint_map.derivatives(qs, qds, qdds)) is not None:
            by_rate, by_acceleration = of_tree[..., 1], of_tree[..., 2]
            turned = np.einsum("abij,ajl->abil", by_acceleration, change.turning)
            moved_on = np.einsum("abij,ajl->abil", by_rate, change.turning)
            moved_on += np.einsum("abij,ajl->abil", by_acceleration, change.position)
            found[..., 0] += np.einsum("aik,abil->abkl", G, moved_on)
            # qdd_tree = G qdd + (G' qd) qd: by qd it counts twice.
            found[..., 1] += 2.0 * np.einsum("aik,abil->abkl", G, turned)
            for b, chi in enumerate(in_tree):
                tau = inverse_dynamics(model.tree, *state, parameters=chi)
                # tau = G^T tau_tree: by q also through G.
                found[:, b, ..., 0] += np.einsum("ai,aikl->akl", tau, change.second)
        return np.asarray(found)
    layout = build_layout(model)
    out = np.zeros((samples, len(sets), n, n, 3))
    chi = np.ascontiguousarray(sets).reshape(len(sets), n, 10)
    inputs = flatten_array(qs), flatten_array(qds), flatten_array(qdds)
    _derivatives(
        layout.codes,
        layout.chain,
        layout.placements,
        layout.gravity,
        chi,
        *inputs,
        samples,
        out.reshape(-1),
    )
    return out


@part
def _dot(ax, ay, az, bx, by, bz):
    return ax * bx + ay * by + az * bz


@part
def _turn_rotation(rows, at, p, o, to):
    """Write R P for the rotation R in nine rows and the rotation P at p[o:o+9]."""
    # Rows of R P.
    for row in range(3):
        x, y, z = vector(rows, at + 3 * row * BLOCK)
        for column in range(3):
            store(
                rows,
                to + (3 * row + column) * BLOCK,
                x * p[o + column] + y * p[o + 3 + column] + z * p[o + 6 + column],
            )


@part
def _rotate_vector(rows, at, x, y, z):
    """Return R (x, y, z) for the rotation in nine rows."""
    return (
        load(rows, at) * x + load(rows, at + BLOCK) * y + load(rows, at + 2 * BLOCK) * z,
        load(rows, at + 3 * BLOCK) * x
        + load(rows, at + 4 * BLOCK) * y
        + load(rows, at + 5 * BLOCK) * z,
        load(rows, at + 6 * BLOCK) * x
        + load(rows, at + 7 * BLOCK) * y
        + load(rows, at + 8 * BLOCK) * z,
    )


@part
def _hold_root_still(rows, gravity):
    """Let the root stand still at the origin and accelerate against free fall."""
    for at in range(0, BLOCK, LANES):
        for row in range(MOTION):
            store(rows, row * BLOCK + at, splat(0.0))
        for axis in range(3):
            store(rows, (POSE + 4 * axis) * BLOCK + at, splat(1.0))
            store(rows, (CHANGE + 3 + axis) * BLOCK + at, splat(-gravity[axis]))


@part
def _move(code, p, rows, above, own, angle, rate, change, cosine, sine):
    """Write the motion of a link from its parent's motion."""
    for at in range(0, BLOCK, LANES):
        u, r = above + at, own + at
        # Where the joint lies: p + R t.
        x, y, z = _rotate_vector(rows, u + POSE * BLOCK, splat(p[9]), splat(p[10]), splat(p[11]))
        px, py, pz = vector(rows, u + PLACE * BLOCK)
        px, py, pz = px + x, py + y, pz + z
        _turn_rotation(rows, u + POSE * BLOCK, p, np.int64(0), r + POSE * BLOCK)
        # Its axis is the third column of the rotation.
        zx, zy, zz = load(rows, r + 2 * BLOCK), load(rows, r + 5 * BLOCK), load(rows, r + 8 * BLOCK)
        if code[REVOLUTE]:
            sx, sy, sz = zx, zy, zz
            # S = (z, p x z): a unit turn moves the root's origin by p x z.
            tx, ty, tz = cross(px, py, pz, zx, zy, zz)
            c, s = load(rows, cosine + at), load(rows, sine + at)
            for row in range(3):
                o = r + (POSE + 3 * row) * BLOCK
                x, y = load(rows, o), load(rows, o + BLOCK)
                store(rows, o, x * c + y * s)
                store(rows, o + BLOCK, y * c - x * s)
        else:
            sx, sy, sz = splat(0.0), splat(0.0), splat(0.0)
            # S = (0, z)
            tx, ty, tz = zx, zy, zz
            d = load(rows, angle + at)
            px, py, pz = px + zx * d, py + zy * d, pz + zz * d
        # Behind the joint, the link's own frame.
        x, y, z = _rotate_vector(rows, r + POSE * BLOCK, splat(p[21]), splat(p[22]), splat(p[23]))
        put(rows, r + PLACE * BLOCK, px + x, py + y, pz + z)
        _turn_rotation(rows, r + POSE * BLOCK, p, np.int64(12), r + POSE * BLOCK)
        put_six(rows, r + SCREW * BLOCK, (sx, sy, sz, tx, ty, tz))

        wx, wy, wz, vx, vy, vz = read_six(rows, u + SPEED * BLOCK)
        dx, dy, dz, ax, ay, az = read_six(rows, u + CHANGE * BLOCK)
        # v x S = (w x s, w x t + v x s)
        ex, ey, ez = cross(wx, wy, wz, sx, sy, sz)
        fx, fy, fz = cross(wx, wy, wz, tx, ty, tz)
        gx, gy, gz = cross(vx, vy, vz, sx, sy, sz)
        fx, fy, fz = fx + gx, fy + gy, fz + gz
        put_six(rows, r + TURN * BLOCK, (ex, ey, ez, fx, fy, fz))
        # a x S + v x (v x S), moment part dw x s + w x e
        gx, gy, gz = cross(dx, dy, dz, sx, sy, sz)
        hx, hy, hz = cross(wx, wy, wz, ex, ey, ez)
        put(rows, r + TURN_2 * BLOCK, gx + hx, gy + hy, gz + hz)
        # its force part dw x t + a x s + w x f + v x e
        gx, gy, gz = cross(dx, dy, dz, tx, ty, tz)
        hx, hy, hz = cross(ax, ay, az, sx, sy, sz)
        gx, gy, gz = gx + hx, gy + hy, gz + hz
        hx, hy, hz = cross(wx, wy, wz, fx, fy, fz)
        gx, gy, gz = gx + hx, gy + hy, gz + hz
        hx, hy, hz = cross(vx, vy, vz, ex, ey, ez)
        put(rows, r + (TURN_2 + 3) * BLOCK, gx + hx, gy + hy, gz + hz)
        # v' = v + S qd, a' = a + S qdd + (v x S) qd
        v, a = load(rows, rate + at), load(rows, change + at)
        put(rows, r + SPEED * BLOCK, wx + sx * v, wy + sy * v, wz + sz * v)
        put(rows, r + (SPEED + 3) * BLOCK, vx + tx * v, vy + ty * v, vz + tz * v)
        put(
            rows,
            r + CHANGE * BLOCK,
            dx + sx * a + ex * v,
            dy + sy * a + ey * v,
            dz + sz * a + ez * v,
        )
        put(
            rows,
            r + (CHANGE + 3) * BLOCK,
            ax + tx * a + fx * v,
            ay + ty * a + fy * v,
            az + tz * a + fz * v,
        )


@part
def _embody(rows, motion, body, chi):
    """Write what the parameters of one link are in the root frame, and its momentum and wrench."""
    for at in range(0, BLOCK, LANES):
        r, b = motion + at, body + at
        m = chi[9]
        px, py, pz = vector(rows, r + PLACE * BLOCK)
        # R h; then g = R h + m p about the root's origin.
        cx, cy, cz = _rotate_vector(
            rows, r + POSE * BLOCK, splat(chi[6]), splat(chi[7]), splat(chi[8])
        )
        xx, xy, xz, yx, yy, yz, zx, zy, zz = read_nine(rows, r + POSE * BLOCK)
        # R I
        ix, iy, iz = (
            xx * chi[0] + xy * chi[1] + xz * chi[2],
            xx * chi[1] + xy * chi[3] + xz * chi[4],
            xx * chi[2] + xy * chi[4] + xz * chi[5],
        )
        jx, jy, jz = (
            yx * chi[0] + yy * chi[1] + yz * chi[2],
            yx * chi[1] + yy * chi[3] + yz * chi[4],
            yx * chi[2] + yy * chi[4] + yz * chi[5],
        )
        kx, ky, kz = (
            zx * chi[0] + zy * chi[1] + zz * chi[2],
            zx * chi[1] + zy * chi[3] + zz * chi[4],
            zx * chi[2] + zy * chi[4] + zz * chi[5],
        )
        gx, gy, gz = cx + px * m, cy + py * m, cz + pz * m
        # R I R^T + (p . c + p . g) 1 - p c^T - g p^T, c = R h
        same = _dot(px, py, pz, cx, cy, cz) + _dot(px, py, pz, gx, gy, gz)
        i_xx = _dot(ix, iy, iz, xx, xy, xz) + same - px * cx - gx * px
        i_xy = _dot(ix, iy, iz, yx, yy, yz) - px * cy - gx * py
        i_xz = _dot(ix, iy, iz, zx, zy, zz) - px * cz - gx * pz
        i_yy = _dot(jx, jy, jz, yx, yy, yz) + same - py * cy - gy * py
        i_yz = _dot(jx, jy, jz, zx, zy, zz) - py * cz - gy * pz
        i_zz = _dot(kx, ky, kz, zx, zy, zz) + same - pz * cz - gz * pz
        store(rows, b + MASS * BLOCK, splat(m))
        put(rows, b + MOMENT * BLOCK, gx, gy, gz)
        put_six(rows, b + INERTIA * BLOCK, (i_xx, i_xy, i_xz, i_yy, i_yz, i_zz))

        wx, wy, wz, vx, vy, vz = read_six(rows, r + SPEED * BLOCK)
        dx, dy, dz, ax, ay, az = read_six(rows, r + CHANGE * BLOCK)
        # Momentum l = m v + w x g
        lx, ly, lz = cross(wx, wy, wz, gx, gy, gz)
        lx, ly, lz = lx + vx * m, ly + vy * m, lz + vz * m
        put(rows, b + MOMENTUM * BLOCK, lx, ly, lz)
        # Second moment S = tr(I) / 2 1 - I
        half = (i_xx + i_yy + i_zz) * 0.5
        s_xx, s_yy, s_zz = half - i_xx, half - i_yy, half - i_zz
        # D = v g^T + [w] S, by columns of S
        ex, ey, ez = cross(wx, wy, wz, s_xx, -i_xy, -i_xz)
        fx, fy, fz = cross(wx, wy, wz, -i_xy, s_yy, -i_yz)
        hx, hy, hz = cross(wx, wy, wz, -i_xz, -i_yz, s_zz)
        put(rows, b + FLOW * BLOCK, vx * gx + ex, vx * gy + fx, vx * gz + hx)
        put(rows, b + (FLOW + 3) * BLOCK, vy * gx + ey, vy * gy + fy, vy * gz + hy)
        put(rows, b + (FLOW + 6) * BLOCK, vz * gx + ez, vz * gy + fz, vz * gz + hz)

        # Angular momentum k = I w + g x v
        ex, ey, ez = cross(gx, gy, gz, vx, vy, vz)
        ex = ex + wx * i_xx + wy * i_xy + wz * i_xz
        ey = ey + wx * i_xy + wy * i_yy + wz * i_yz
        ez = ez + wx * i_xz + wy * i_yz + wz * i_zz
        # n = I dw + g x a + w x k + v x l
        ex, ey, ez = cross(wx, wy, wz, ex, ey, ez)
        fx, fy, fz = cross(vx, vy, vz, lx, ly, lz)
        hx, hy, hz = cross(gx, gy, gz, ax, ay, az)
        nx = ex + fx + hx + dx * i_xx + dy * i_xy + dz * i_xz
        ny = ey + fy + hy + dx * i_xy + dy * i_yy + dz * i_yz
        nz = ez + fz + hz + dx * i_xz + dy * i_yz + dz * i_zz
        put(rows, b + WRENCH * BLOCK, nx, ny, nz)
        # f = m a + dw x g + w x l
        ex, ey, ez = cross(wx, wy, wz, lx, ly, lz)
        fx, fy, fz = cross(dx, dy, dz, gx, gy, gz)
        put(rows, b + (WRENCH + 3) * BLOCK, ex + fx + ax * m, ey + fy + ay * m, ez + fz + az * m)


@part
def _add(rows, source, target):
    for row in range(BODY):
        for at in range(row * BLOCK, (row + 1) * BLOCK, LANES):
            store(rows, target + at, load(rows, target + at) + load(rows, source + at))


@part
def _differentiate_pairs(code, chain, rows, motions, body, i, n, tile):
    """Write the derivatives between a joint and those above it.

    Three rows for each pair (k, j), of d tau_k with respect to joint j.
    """
    own = motions + i * MOTION * BLOCK
    for at in range(0, BLOCK, LANES):
        r, b = own + at, body + at
        m = load(rows, b + MASS * BLOCK)
        hx, hy, hz = vector(rows, b + MOMENT * BLOCK)
        i_xx, i_xy, i_xz, i_yy, i_yz, i_zz = read_six(rows, b + INERTIA * BLOCK)
        lx, ly, lz = vector(rows, b + MOMENTUM * BLOCK)
        xx, xy, xz, yx, yy, yz, zx, zy, zz = read_nine(rows, b + FLOW * BLOCK)
        trace = xx + yy + zz
        # Velocities come in pairs: l stands for 2 l from here on.
        lx, ly, lz = lx + lx, ly + ly, lz + lz

        # a = I S = (I s + h x t, m t + s x h)
        sx, sy, sz, tx, ty, tz = read_six(rows, r + SCREW * BLOCK)
        gx, gy, gz = cross(hx, hy, hz, tx, ty, tz)
        fx, fy, fz = cross(sx, sy, sz, hx, hy, hz)
        a0 = gx + sx * i_xx + sy * i_xy + sz * i_xz
        a1 = gy + sx * i_xy + sy * i_yy + sz * i_yz
        a2 = gz + sx * i_xz + sy * i_yz + sz * i_zz
        a3, a4, a5 = fx + m * tx, fy + m * ty, fz + m * tz

        # b = 2 (l x t + tr(D) s - D^T s)
        gx, gy, gz = cross(lx, ly, lz, tx, ty, tz)
        ex, ey, ez = (
            sx * trace - _dot(sx, sy, sz, xx, yx, zx),
            sy * trace - _dot(sx, sy, sz, xy, yy, zy),
            sz * trace - _dot(sx, sy, sz, xz, yz, zz),
        )
        b0, b1, b2 = gx + ex + ex, gy + ey + ey, gz + ez + ez

        # c = 2 (I (v x S) + tr(D) s - D s), its force 2 (m v + u x h + s x l)
        ux, uy, uz, vx, vy, vz = read_six(rows, r + TURN * BLOCK)
        gx, gy, gz = cross(hx, hy, hz, vx, vy, vz)
        fx, fy, fz = cross(ux, uy, uz, hx, hy, hz)
        ex = sx * trace - _dot(sx, sy, sz, xx, xy, xz) + gx + ux * i_xx + uy * i_xy + uz * i_xz
        ey = sy * trace - _dot(sx, sy, sz, yx, yy, yz) + gy + ux * i_xy + uy * i_yy + uz * i_yz
        ez = sz * trace - _dot(sx, sy, sz, zx, zy, zz) + gz + ux * i_xz + uy * i_yz + uz * i_zz
        c0, c1, c2 = ex + ex, ey + ey, ez + ez
        fx, fy, fz = fx + m * vx, fy + m * vy, fz + m * vz
        gx, gy, gz = cross(sx, sy, sz, lx, ly, lz)
        c3, c4, c5 = gx + fx + fx, gy + fy + fy, gz + fz + fz

        # d = 2 (u x l, tr(D) u - D u) + S x* wrench + I (a x S + v x (v x S)), u = w x s
        dx, dy, dz = cross(ux, uy, uz, lx, ly, lz)
        ex = ux * trace - _dot(ux, uy, uz, xx, xy, xz)
        ey = uy * trace - _dot(ux, uy, uz, yx, yy, yz)
        ez = uz * trace - _dot(ux, uy, uz, zx, zy, zz)
        nx, ny, nz, fx, fy, fz = read_six(rows, b + WRENCH * BLOCK)
        gx, gy, gz = cross(sx, sy, sz, fx, fy, fz)
        d3, d4, d5 = dx + gx, dy + gy, dz + gz
        gx, gy, gz = cross(sx, sy, sz, nx, ny, nz)
        d0, d1, d2 = ex + ex + gx, ey + ey + gy, ez + ez + gz
        gx, gy, gz = cross(tx, ty, tz, fx, fy, fz)
        ux, uy, uz, vx, vy, vz = read_six(rows, r + TURN_2 * BLOCK)
        ex, ey, ez = cross(hx, hy, hz, vx, vy, vz)
        fx, fy, fz = cross(ux, uy, uz, hx, hy, hz)
        d0 = d0 + gx + ex + ux * i_xx + uy * i_xy + uz * i_xz
        d1 = d1 + gy + ey + ux * i_xy + uy * i_yy + uz * i_yz
        d2 = d2 + gz + ez + ux * i_xz + uy * i_yz + uz * i_zz
        d3, d4, d5 = d3 + fx + m * vx, d4 + fy + m * vy, d5 + fz + m * vz

        # Joints above see the same sums: their own screw and its rates close each derivative.
        for depth in range(code[DEPTH] + 1):
            j = chain[depth]
            o = motions + j * MOTION * BLOCK + at
            sx, sy, sz, tx, ty, tz = read_six(rows, o + SCREW * BLOCK)
            up, down = tile + 3 * (j * n + i) * BLOCK + at, tile + 3 * (i * n + j) * BLOCK + at
            inertia = _dot(sx, sy, sz, a0, a1, a2) + _dot(tx, ty, tz, a3, a4, a5)
            if depth < code[DEPTH]:
                ux, uy, uz, vx, vy, vz = read_six(rows, o + TURN * BLOCK)
                twice = _dot(ux, uy, uz, a0, a1, a2) + _dot(vx, vy, vz, a3, a4, a5)
                by_position = _dot(ux, uy, uz, b0, b1, b2)
                ux, uy, uz, vx, vy, vz = read_six(rows, o + TURN_2 * BLOCK)
                by_position = (
                    by_position + _dot(ux, uy, uz, a0, a1, a2) + _dot(vx, vy, vz, a3, a4, a5)
                )
                # tau of the lower joint by the upper one's motion; below, the reverse.
                put(rows, down, by_position, _dot(sx, sy, sz, b0, b1, b2) + twice + twice, inertia)
            by_position = _dot(sx, sy, sz, d0, d1, d2) + _dot(tx, ty, tz, d3, d4, d5)
            by_velocity = _dot(sx, sy, sz, c0, c1, c2) + _dot(tx, ty, tz, c3, c4, c5)
            put(rows, up, by_position, by_velocity, inertia)


@kernel("i2 i2 f2 f1 f3 f1 f1 f1 i F1")
def _derivatives(codes, chain, placements, gravity, chi, q, qd, qdd, n_samples, out):
    n, n_sets = codes.shape[0], chi.shape[0]
    motions = MOTION * BLOCK
    bodies = motions + n * MOTION * BLOCK
    tile = bodies + n * BODY * BLOCK
    angles = tile + 3 * n * n * BLOCK
    turns = angles + 3 * n * BLOCK
    rows = allocate_scratch(turns // BLOCK + 2)
    _hold_root_still(rows, gravity)
    rows[tile:angles] = 0.0
    for block in range(0, n_samples, BLOCK):
        count = min(BLOCK, n_samples - block)
        gather_states(q, qd, qdd, block, count, n, rows, angles // BLOCK)
        for i in range(n):
            above, own, angle = (
                (codes[i, PARENT] + 1) * MOTION * BLOCK,
                motions + i * MOTION * BLOCK,
                angles + i * BLOCK,
            )
            if codes[i, REVOLUTE]:
                trigonometry(rows, angle, turns, turns + BLOCK)
            _move(
                codes[i],
                placements[i],
                rows,
                above,
                own,
                angle,
                angle + n * BLOCK,
                angle + 2 * n * BLOCK,
                turns,
                turns + BLOCK,
            )
        # The motion is the same for all sets of parameters.
        for one in range(n_sets):
            for i in range(n):
                _embody(rows, motions + i * MOTION * BLOCK, bodies + i * BODY * BLOCK, chi[one, i])
            # Leaves first: a body is the sum of all that its joint carries.
            for i in range(n - 1, -1, -1):
                body = bodies + i * BODY * BLOCK
                _differentiate_pairs(codes[i], chain[i], rows, motions, body, i, n, tile)
                if codes[i, PARENT] >= 0:
                    _add(rows, body, bodies + codes[i, PARENT] * BODY * BLOCK)
            for sample in range(count):
                first = ((block + sample) * n_sets + one) * n * n * 3
                for place in range(3 * n * n):
                    out[first + place] = rows[tile + place * BLOCK + sample]
