"""The adjoint of the regressor.

Derivatives of any weighted sum of its entries with respect to positions, velocities and
accelerations.

Forward, the recursion of `recursion` with every link's state kept; backward, the transpose of each
step, leaves first. The cost is some three times the regressor's, whatever the number of
joints, for all derivatives at once.
"""

# mypy: allow-untyped-defs

from __future__ import annotations

import numpy as np

from asbuilt.arrays import Array
from asbuilt.compilation import kernel, part
from asbuilt.dynamics.batches import flatten_array, inertial_parameters
from asbuilt.dynamics.kernels.lanes import LANES, load, splat, store
from asbuilt.dynamics.kernels.recursion import (
    AFTER,
    BEFORE,
    BLOCK,
    DEPTH,
    NOTHING,
    PARENT,
    REVOLUTE,
    STATE,
    add,
    allocate_scratch,
    build_layout,
    carry_wrench,
    cross,
    gather,
    gather_states,
    move_link,
    move_screws,
    put,
    read_nine,
    read_six,
    rest,
    rotate_out_of,
    trigonometry,
    vector,
)
from asbuilt.dynamics.newton_euler import inverse_dynamics
from asbuilt.dynamics.regressor import RegressorPlan
from asbuilt.errors import UsageError


def regressor_adjoint(
    plan: RegressorPlan,
    q: Array,
    qd: Array,
    qdd: Array,
    weights: Array,
    loads: Array | None = None,
    parameters: Array | None = None,
) -> tuple[Array, Array, Array]:
    """Return the derivatives of a weighted sum of regressor and torques by q, qd and qdd.

    The sum is `f = sum_skc G[s, k, c] Y[s, k, c] + sum_sk l[s, k] tau[s, k]`; each derivative has
    shape (N, n).

    `weights` holds G in the layout that `plan.evaluate` writes Y in: one row per joint and chosen
    column, samples innermost, contiguous (plan.n_rows, at least N); rows of drive columns and spare
    rows are not looked at. `loads` (N, n) are the weights l of the torques tau of rigid bodies with
    the standard `parameters` (10 n_links,). Raises UsageError for shapes that do not fit.
    """
    n = plan.model.n_joints
    states = plan.checked_inputs(q, qd, qdd)
    n_samples = states[0].shape[0]
    if weights.ndim != 2 or weights.shape[0] < plan.n_rows or weights.shape[1] < n_samples:
        raise UsageError(
            f"weights must have at least {plan.n_rows} rows and {n_samples} columns, got"
            f" {weights.shape}; use plan.buffer(n_samples)"
        )
    lam = np.zeros((0, n)) if loads is None else np.ascontiguousarray(loads, dtype=np.float64)
    if loads is not None and lam.shape != (n_samples, n):
        raise UsageError(
            f"loads must have shape ({n_samples}, {n}), one per sample and joint, got {lam.shape}"
        )
    chi = (
        np.zeros((plan.model.n_links, 10))
        if parameters is None
        else inertial_parameters(plan.model, parameters)
    )
    if plan.tree is not None:
        tree = plan.tree
        joint_map = tree.joint_map
        moved = joint_map.motion(*states)
        chi = joint_map.parameters(chi).reshape(-1)
        # tau = G^T tau_tree, so that weights go to the tree through G.
        motion, G = (moved.q, moved.qd, moved.qdd), moved.by_sample
        parts = regressor_adjoint(
            tree.plan,
            *motion,
            tree.weights(weights, moved.shares, n_samples),
            None if loads is None else np.einsum("sik,sk->si", G, lam),
            chi,
        )
        position, rate, acceleration = (moved.torques(part) for part in parts)
        if (change := joint_map.derivatives(*states)) is not None:
            by_share = tree.torn(weights, tree.evaluated(*motion), n_samples)
            if loads is not None:
                tau = inverse_dynamics(tree.plan.model, *motion, parameters=chi)
                by_share += tau[:, :, None] * lam[:, None]
            # Second derivatives of the map act by the torque of the tree itself.
            position += np.einsum("sik,sikj->sj", by_share, change.second)
            # qd_tree = G qd: its change with q is G' qd, here `turning`.
            position += np.einsum("si,sij->sj", parts[1], change.turning)
            position += np.einsum("si,sij->sj", parts[2], change.position)
            rate += 2.0 * np.einsum("si,sij->sj", parts[2], change.turning)
        return position, rate, acceleration
    layout = build_layout(plan.model)
    out = tuple(np.empty((n_samples, n)) for _ in range(3))
    _adjoint(
        layout.codes,
        layout.chain,
        layout.placements,
        layout.gravity,
        plan.places,
        flatten_array(weights),
        weights.shape[1],
        flatten_array(lam),
        chi,
        *(flatten_array(array) for array in states),
        n_samples,
        *(array.reshape(-1) for array in out),
    )
    return out[0], out[1], out[2]


@part
def _clear(rows, start, count):
    for row in range(count):
        for at in range(0, BLOCK, LANES):
            store(rows, start + row * BLOCK + at, splat(0.0))


@part
def _add_own_terms(rows, state, screw, state_bar, screw_bar, parameters):
    """Add the adjoints of `z . moment + m . force` of a link with ten rows of parameters.

    They belong to its state and to one screw.
    """
    for at in range(0, BLOCK, LANES):
        r = state + at
        wx, wy, wz, dx, dy, dz, ax, ay, az = read_nine(rows, r)
        p = parameters + at
        ixx, ixy, ixz, iyy, iyz, izz, hx, hy, hz = read_nine(rows, p)
        mass = load(rows, p + 9 * BLOCK)
        s = screw + at
        zx, zy, zz, mx, my, mz = read_six(rows, s)

        # l = I w
        lx, ly, lz = (
            wx * ixx + wy * ixy + wz * ixz,
            wx * ixy + wy * iyy + wz * iyz,
            wx * ixz + wy * iyz + wz * izz,
        )
        wh, ww, mh, mw = (
            wx * hx + wy * hy + wz * hz,
            wx * wx + wy * wy + wz * wz,
            mx * hx + my * hy + mz * hz,
            mx * wx + my * wy + mz * wz,
        )
        # w x I w
        gx, gy, gz = cross(wx, wy, wz, lx, ly, lz)
        # h x a
        ex, ey, ez = cross(hx, hy, hz, ax, ay, az)
        # by z: I dw + w x I w + h x a
        b = screw_bar + at
        vx, vy, vz = vector(rows, b)
        vx = vx + dx * ixx + dy * ixy + dz * ixz + gx + ex
        vy = vy + dx * ixy + dy * iyy + dz * iyz + gy + ey
        vz = vz + dx * ixz + dy * iyz + dz * izz + gz + ez
        put(rows, b, vx, vy, vz)
        # by m: mass a + dw x h + w (w . h) - h (w . w)
        cx, cy, cz = cross(dx, dy, dz, hx, hy, hz)
        vx, vy, vz = vector(rows, b + 3 * BLOCK)
        vx = vx + mass * ax + cx + wx * wh - hx * ww
        vy = vy + mass * ay + cy + wy * wh - hy * ww
        vz = vz + mass * az + cz + wz * wh - hz * ww
        put(rows, b + 3 * BLOCK, vx, vy, vz)

        b = state_bar + at
        # by w: I w x z + I (z x w) + m (w . h) + h (m . w) - 2 w (m . h)
        cx, cy, cz = cross(lx, ly, lz, zx, zy, zz)
        ux, uy, uz = cross(zx, zy, zz, wx, wy, wz)
        two = mh + mh
        vx = cx + ux * ixx + uy * ixy + uz * ixz + mx * wh + hx * mw - wx * two
        vy = cy + ux * ixy + uy * iyy + uz * iyz + my * wh + hy * mw - wy * two
        vz = cz + ux * ixz + uy * iyz + uz * izz + mz * wh + hz * mw - wz * two
        add(rows, b, vx, vy, vz)
        # by dw: I z + h x m
        cx, cy, cz = cross(hx, hy, hz, mx, my, mz)
        vx, vy, vz = vector(rows, b + 3 * BLOCK)
        vx = vx + zx * ixx + zy * ixy + zz * ixz + cx
        vy = vy + zx * ixy + zy * iyy + zz * iyz + cy
        vz = vz + zx * ixz + zy * iyz + zz * izz + cz
        put(rows, b + 3 * BLOCK, vx, vy, vz)
        # by a: z x h + mass m
        cx, cy, cz = cross(zx, zy, zz, hx, hy, hz)
        vx, vy, vz = vector(rows, b + 6 * BLOCK)
        put(rows, b + 6 * BLOCK, vx + mass * mx + cx, vy + mass * my + cy, vz + mass * mz + cz)


@part
def _differentiate_spin(bx, by, bz, wx, wy, wz, tx, ty, tz):
    """Return the derivative of b . (w x (w x t)) with respect to w."""
    wt, bw, bt = (
        wx * tx + wy * ty + wz * tz,
        bx * wx + by * wy + bz * wz,
        bx * tx + by * ty + bz * tz,
    )
    return (
        bx * wt + tx * bw - (bt + bt) * wx,
        by * wt + ty * bw - (bt + bt) * wy,
        bz * wt + tz * bw - (bt + bt) * wz,
    )


@part
def _carry_state_back(code, p, rows, state, above, state_bar, above_bar, angle, cosine, sine, bars):
    """Carry the adjoint of w, dw, a of a link to its parent.

    The adjoints of its joint start in three rows: q, qd, qdd.
    """
    after, before = code[AFTER], code[BEFORE]
    for at in range(0, BLOCK, LANES):
        r = state + at
        wx, wy, wz, dx, dy, dz, ax, ay, az = read_nine(rows, r)
        b = state_bar + at
        ox, oy, oz, ex, ey, ez, fx, fy, fz = read_nine(rows, b)
        # The state in front of the placement: the steps forward, undone.
        if after != NOTHING:
            tx, ty, tz = splat(p[21]), splat(p[22]), splat(p[23])
            wx, wy, wz = rotate_out_of(after, p, 12, wx, wy, wz)
            dx, dy, dz = rotate_out_of(after, p, 12, dx, dy, dz)
            ax, ay, az = rotate_out_of(after, p, 12, ax, ay, az)
            gx, gy, gz = cross(dx, dy, dz, tx, ty, tz)
            cx, cy, cz = cross(wx, wy, wz, tx, ty, tz)
            cx, cy, cz = cross(wx, wy, wz, cx, cy, cz)
            # a = R a' - dw x t - w x (w x t)
            ax, ay, az = ax - gx - cx, ay - gy - cy, az - gz - cz
            # The adjoint goes back by the transpose, which of R^T is R.
            ox, oy, oz = rotate_out_of(after, p, 12, ox, oy, oz)
            ex, ey, ez = rotate_out_of(after, p, 12, ex, ey, ez)
            fx, fy, fz = rotate_out_of(after, p, 12, fx, fy, fz)
            # dw x t in a: its transpose adds t x f to the adjoint of dw.
            cx, cy, cz = cross(tx, ty, tz, fx, fy, fz)
            ex, ey, ez = ex + cx, ey + cy, ez + cz
            cx, cy, cz = _differentiate_spin(fx, fy, fz, wx, wy, wz, tx, ty, tz)
            ox, oy, oz = ox + cx, oy + cy, oz + cz
        v = load(rows, angle + bars[3] + at)
        if code[REVOLUTE]:
            c, s = load(rows, cosine + at), load(rows, sine + at)
            # By v: w + v z gives oz, dw + w x v z gives e . (w x z).
            store(rows, bars[1] + at, oz + ex * wy - ey * wx)
            # By dv: dw + dv z.
            store(rows, bars[2] + at, ez)
            # dw in turned axes before the joint's rate entered it.
            px, py = dx - wy * v, dy + wx * v
            # w x v z: its transpose on e.
            ox, oy = ox - v * ey, oy + v * ex
            # By q: Rz^T x changes by (y, -x, 0), for all three vectors.
            store(rows, bars[0] + at, ox * wy - oy * wx + ex * py - ey * px + fx * ay - fy * ax)
            # Back by Rz.
            ox, oy = ox * c - oy * s, oy * c + ox * s
            ex, ey = ex * c - ey * s, ey * c + ex * s
            fx, fy = fx * c - fy * s, fy * c + fx * s
        else:
            q = load(rows, angle + at)
            # By dv: a + dv z.
            store(rows, bars[2] + at, fz)
            # By v: f . (2 w x z).
            turn = fx * wy - fy * wx
            store(rows, bars[1] + at, turn + turn)
            # By q: f . (dw x z + w x (w x z)).
            fw, ww = fx * wx + fy * wy + fz * wz, wx * wx + wy * wy + wz * wz
            store(rows, bars[0] + at, fx * dy - fy * dx + fw * wz - fz * ww)
            # dw x q z: its transpose q z x f.
            ex, ey = ex - q * fy, ey + q * fx
            v2 = v + v
            # w x (w x q z) and 2 w x v z, by w.
            cx, cy, cz = _differentiate_spin(fx, fy, fz, wx, wy, wz, splat(0.0), splat(0.0), q)
            ox, oy, oz = ox - v2 * fy + cx, oy + v2 * fx + cy, oz + cz
        # The root does not move: nobody asks for its adjoint.
        if code[PARENT] >= 0:
            if before != NOTHING:
                tx, ty, tz = splat(p[9]), splat(p[10]), splat(p[11])
                ox, oy, oz = rotate_out_of(before, p, 0, ox, oy, oz)
                ex, ey, ez = rotate_out_of(before, p, 0, ex, ey, ez)
                fx, fy, fz = rotate_out_of(before, p, 0, fx, fy, fz)
                cx, cy, cz = cross(tx, ty, tz, fx, fy, fz)
                ex, ey, ez = ex + cx, ey + cy, ez + cz
                wx, wy, wz = vector(rows, above + at)
                cx, cy, cz = _differentiate_spin(fx, fy, fz, wx, wy, wz, tx, ty, tz)
                ox, oy, oz = ox + cx, oy + cy, oz + cz
            b = above_bar + at
            add(rows, b, ox, oy, oz)
            add(rows, b + 3 * BLOCK, ex, ey, ez)
            add(rows, b + 6 * BLOCK, fx, fy, fz)


@part
def _carry_screws_back(code, p, rows, state, state_bar, above_bar, angle, cosine, sine, bar):
    """Carry the adjoints of the screws of the joints above to the parent link.

    Adds to the adjoint of q of the link's joint.
    """
    after, before = code[AFTER], code[BEFORE]
    for d in range(code[DEPTH]):
        o = (STATE + 6 * d) * BLOCK
        for at in range(0, BLOCK, LANES):
            r, b = state + o + at, state_bar + o + at
            zx, zy, zz, mx, my, mz = read_six(rows, r)
            ux, uy, uz, nx, ny, nz = read_six(rows, b)
            if after != NOTHING:
                tx, ty, tz = splat(p[21]), splat(p[22]), splat(p[23])
                zx, zy, zz = rotate_out_of(after, p, 12, zx, zy, zz)
                mx, my, mz = rotate_out_of(after, p, 12, mx, my, mz)
                # m in front of the placement: m - z x t.
                cx, cy, cz = cross(zx, zy, zz, tx, ty, tz)
                mx, my, mz = mx - cx, my - cy, mz - cz
                # Adjoints of a screw go back as a wrench does: that of m a force, that of z a
                # moment.
                nx, ny, nz, ux, uy, uz = carry_wrench(after, p, 12, (nx, ny, nz, ux, uy, uz))
            if code[REVOLUTE]:
                c, s = load(rows, cosine + at), load(rows, sine + at)
                # By q: Rz^T x changes by (y, -x, 0), for both vectors.
                store(rows, bar + at, load(rows, bar + at) + ux * zy - uy * zx + nx * my - ny * mx)
                ux, uy = ux * c - uy * s, uy * c + ux * s
                nx, ny = nx * c - ny * s, ny * c + nx * s
            else:
                q = load(rows, angle + at)
                # By q: m + z x q e_z.
                store(rows, bar + at, load(rows, bar + at) + nx * zy - ny * zx)
                # z x q e_z: its transpose on the adjoint of m.
                ux, uy = ux - q * ny, uy + q * nx
            if before != NOTHING:
                nx, ny, nz, ux, uy, uz = carry_wrench(before, p, 0, (nx, ny, nz, ux, uy, uz))
            b = above_bar + o + at
            add(rows, b, ux, uy, uz)
            add(rows, b + 3 * BLOCK, nx, ny, nz)


@kernel("i2 i2 f2 f1 i3 f1 i f1 f2 f1 f1 f1 i F1 F1 F1")
def _adjoint(
    codes,
    chain,
    placements,
    gravity,
    places,
    weights,
    stride,
    loads,
    chi,
    q,
    qd,
    qdd,
    n_samples,
    q_bar,
    qd_bar,
    qdd_bar,
):
    n = codes.shape[0]
    slot = (STATE + 6 * n) * BLOCK
    bars = (n + 1) * slot
    angles = 2 * (n + 1) * slot
    turns = angles + 3 * n * BLOCK
    given = turns + 2 * n * BLOCK
    lam = given + 10 * BLOCK
    found = lam + n * BLOCK
    rows = allocate_scratch(found // BLOCK + 3 * n)
    rest(rows, gravity)
    # Loads weigh the torque Y chi, so that the weights of entries grow by lam chi.
    loaded = loads.size > 0
    for block in range(0, n_samples, BLOCK):
        count = min(BLOCK, n_samples - block)
        gather_states(q, qd, qdd, block, count, n, rows, angles // BLOCK)
        if loaded:
            gather(loads, block, count, n, rows, lam // BLOCK)
        for i in range(n):
            # Slot 0 is the root's, so that link i has slot i + 1.
            read, write, angle, turn = (
                (codes[i, PARENT] + 1) * slot,
                (i + 1) * slot,
                angles + i * BLOCK,
                turns + 2 * i * BLOCK,
            )
            if codes[i, REVOLUTE]:
                trigonometry(rows, angle, turn, turn + BLOCK)
            move_link(
                codes[i],
                placements[i],
                rows,
                read,
                write,
                angle,
                angle + n * BLOCK,
                angle + 2 * n * BLOCK,
                turn,
                turn + BLOCK,
            )
            move_screws(codes[i], placements[i], rows, read, write, angle, turn, turn + BLOCK)
        # Children add to the adjoint of their parent.
        _clear(rows, bars, (n + 1) * (STATE + 6 * n))
        # Leaves first: a link's adjoint is whole before it goes to the parent.
        for i in range(n - 1, -1, -1):
            state, state_bar, angle, turn = (
                (i + 1) * slot,
                bars + (i + 1) * slot,
                angles + i * BLOCK,
                turns + 2 * i * BLOCK,
            )
            for d in range(codes[i, DEPTH] + 1):
                k = chain[i, d]
                for c in range(10):
                    row = places[k, i, c]
                    for at in range(0, BLOCK, LANES):
                        if loaded:
                            store(
                                rows,
                                given + c * BLOCK + at,
                                load(rows, lam + k * BLOCK + at) * chi[i, c],
                            )
                        else:
                            store(rows, given + c * BLOCK + at, splat(0.0))
                    if row >= 0:
                        # Samples that fill the block up have no weight.
                        for sample in range(count):
                            rows[given + c * BLOCK + sample] += weights[
                                row * stride + block + sample
                            ]
                o = (STATE + 6 * d) * BLOCK
                _add_own_terms(rows, state, state + o, state_bar, state_bar + o, given)
            above = codes[i, PARENT] + 1
            one = found + i * BLOCK
            place = one, one + n * BLOCK, one + 2 * n * BLOCK, n * BLOCK
            _carry_state_back(
                codes[i],
                placements[i],
                rows,
                state,
                above * slot,
                state_bar,
                bars + above * slot,
                angle,
                turn,
                turn + BLOCK,
                place,
            )
            _carry_screws_back(
                codes[i],
                placements[i],
                rows,
                state,
                state_bar,
                bars + above * slot,
                angle,
                turn,
                turn + BLOCK,
                place[0],
            )
        for sample in range(count):
            for i in range(n):
                o = (block + sample) * n + i
                q_bar[o] = rows[found + i * BLOCK + sample]
                qd_bar[o] = rows[found + (n + i) * BLOCK + sample]
                qdd_bar[o] = rows[found + (2 * n + i) * BLOCK + sample]
