"""Batched regressor and inverse dynamics.

One set of compiled functions for every robot, samples innermost.

Sample-major arrays come in and go out flat; a call works on samples start ... stop - 1, so that
threads share one array.
"""

# mypy: allow-untyped-defs

from __future__ import annotations

from asbuilt.compilation import kernel, part
from asbuilt.dynamics.kernels.lanes import LANES, load, load_every, splat, store
from asbuilt.dynamics.kernels.recursion import (
    AFTER,
    BEFORE,
    BLOCK,
    PARENT,
    READ,
    REVOLUTE,
    STATE,
    WRITE,
    add,
    allocate_scratch,
    carry_screw,
    carry_screw_rows,
    carry_wrench,
    find_wrench,
    gather,
    gather_states,
    move_link,
    put,
    put_six,
    read_nine,
    read_six,
    rest,
    slide_wrench,
    trigonometry,
    turn_wrench,
    vector,
)

TERMS = 21
"""Rows that `_write_link_terms` writes."""
FORCE = 6
"""Rows of a force and a moment."""
SCREW = 6
"""Rows of a screw."""


@part
def _write_link_terms(rows, state, terms):
    """Write the 21 products of w, dw and a that the ten columns of a link are made of."""
    for at in range(0, BLOCK, LANES):
        r, t = state + at, terms + at
        wx, wy, wz, dx, dy, dz = read_six(rows, r)
        xx, yy, zz, xy, xz, yz = wx * wx, wy * wy, wz * wz, wx * wy, wx * wz, wy * wz
        put(rows, t, dx, dy, dz)
        put(rows, t + 3 * BLOCK, yz, xz, xy)
        put(rows, t + 6 * BLOCK, dx + yz, dx - yz, dy + xz)
        put(rows, t + 9 * BLOCK, dy - xz, dz + xy, dz - xy)
        put(rows, t + 12 * BLOCK, yy - zz, zz - xx, xx - yy)
        put(rows, t + 15 * BLOCK, yy + zz, xx + zz, xx + yy)
        ax, ay, az = vector(rows, r + 6 * BLOCK)
        put(rows, t + 18 * BLOCK, ax, ay, az)


@part
def _locate_row(row, stride, start):
    return row * stride + start if row >= 0 else row


@part
def _write_link_columns(rows, screw, terms, places, out, stride, start):
    """Write z . (moment) + m .

    (force) per unit of each parameter, for one joint and one link, where `places` names a row of
    `out`.

    force = mass a + dw x h + w x (w x h), moment = I dw + w x I w + h x a, with h the first moment
    (Atkeson, An and Hollerbach, 1986).
    """
    # A row of -1 stays negative, and the entry is not written.
    o0, o1, o2 = (
        _locate_row(places[0], stride, start),
        _locate_row(places[1], stride, start),
        _locate_row(places[2], stride, start),
    )
    o3, o4, o5 = (
        _locate_row(places[3], stride, start),
        _locate_row(places[4], stride, start),
        _locate_row(places[5], stride, start),
    )
    o6, o7, o8 = (
        _locate_row(places[6], stride, start),
        _locate_row(places[7], stride, start),
        _locate_row(places[8], stride, start),
    )
    o9 = _locate_row(places[9], stride, start)
    for at in range(0, BLOCK, LANES):
        r, t = screw + at, terms + at
        zx, zy, zz, mx, my, mz = read_six(rows, r)
        # Ixx: z . (dx, wx wz, -wx wy)
        if o0 >= 0:
            xx = (
                zx * load(rows, t) + zy * load(rows, t + 4 * BLOCK) - zz * load(rows, t + 5 * BLOCK)
            )
            store(out, o0 + at, xx)
        # Ixy: z . (dy - wx wz, dx + wy wz, wx^2 - wy^2)
        if o1 >= 0:
            xy = (
                zx * load(rows, t + 9 * BLOCK)
                + zy * load(rows, t + 6 * BLOCK)
                + zz * load(rows, t + 14 * BLOCK)
            )
            store(out, o1 + at, xy)
        # Ixz: z . (dz + wx wy, wz^2 - wx^2, dx - wy wz)
        if o2 >= 0:
            xz = (
                zx * load(rows, t + 10 * BLOCK)
                + zy * load(rows, t + 13 * BLOCK)
                + zz * load(rows, t + 7 * BLOCK)
            )
            store(out, o2 + at, xz)
        # Iyy: z . (-wy wz, dy, wx wy)
        if o3 >= 0:
            yy = (
                zy * load(rows, t + BLOCK)
                + zz * load(rows, t + 5 * BLOCK)
                - zx * load(rows, t + 3 * BLOCK)
            )
            store(out, o3 + at, yy)
        # Iyz: z . (wy^2 - wz^2, dz - wx wy, dy + wx wz)
        if o4 >= 0:
            yz = (
                zx * load(rows, t + 12 * BLOCK)
                + zy * load(rows, t + 11 * BLOCK)
                + zz * load(rows, t + 8 * BLOCK)
            )
            store(out, o4 + at, yz)
        # Izz: z . (wy wz, -wx wz, dz)
        if o5 >= 0:
            izz = (
                zx * load(rows, t + 3 * BLOCK)
                - zy * load(rows, t + 4 * BLOCK)
                + zz * load(rows, t + 2 * BLOCK)
            )
            store(out, o5 + at, izz)
        ax, ay, az = vector(rows, t + 18 * BLOCK)
        # hx: m . (-(wy^2 + wz^2), wx wy + dz, wx wz - dy) + z . (0, -az, ay)
        if o6 >= 0:
            hx = (
                my * load(rows, t + 10 * BLOCK)
                - mx * load(rows, t + 15 * BLOCK)
                - mz * load(rows, t + 9 * BLOCK)
            )
            store(out, o6 + at, hx + zz * ay - zy * az)
        # hy: m . (wx wy - dz, -(wx^2 + wz^2), wy wz + dx) + z . (az, 0, -ax)
        if o7 >= 0:
            hy = (
                mz * load(rows, t + 6 * BLOCK)
                - my * load(rows, t + 16 * BLOCK)
                - mx * load(rows, t + 11 * BLOCK)
            )
            store(out, o7 + at, hy + zx * az - zz * ax)
        # hz: m . (wx wz + dy, wy wz - dx, -(wx^2 + wy^2)) + z . (-ay, ax, 0)
        if o8 >= 0:
            hz = (
                mx * load(rows, t + 8 * BLOCK)
                - my * load(rows, t + 7 * BLOCK)
                - mz * load(rows, t + 17 * BLOCK)
            )
            store(out, o8 + at, hz + zy * ax - zx * ay)
        # mass: m . a
        if o9 >= 0:
            store(out, o9 + at, mx * ax + my * ay + mz * az)


@part
def _write_tile(tile, bounds, columns, block, count, out, width):
    """Write the rows of a block to `out`, sample-major if `columns` are given."""
    if columns.size:
        _write_samples(tile, bounds, columns, block, count, out, width)
        return
    for k in range(bounds.shape[0]):
        for row in range(bounds[k, 0], bounds[k, 1]):
            for sample in range(count):
                out[row * width + block + sample] = tile[row * BLOCK + sample]


@part
def _write_samples(tile, bounds, columns, block, count, out, width):
    """Write the rows of a block sample-major, neighbouring columns by the vector."""
    n = bounds.shape[0]
    for k in range(n):
        # Columns increase, so that eight are neighbours if the last is seven further.
        row = bounds[k, 0]
        while row < bounds[k, 1]:
            neighbours = (
                row + LANES <= bounds[k, 1] and columns[row + LANES - 1] - columns[row] == LANES - 1
            )
            o = (block * n + k) * width + columns[row]
            for sample in range(count):
                if neighbours:
                    eight = load_every(tile, row * BLOCK + sample, BLOCK)
                    store(out, o + sample * n * width, eight)
                else:
                    out[o + sample * n * width] = tile[row * BLOCK + sample]
            row += LANES if neighbours else 1


@part
def _gather_shares(shares, start, count, size, rows, row):
    """Turn the shares of each sample, or the shares common to all, into `size` rows of a block."""
    if shares.size > size:
        gather(shares, start, count, size, rows, row)
        return
    for j in range(size):
        for at in range(0, BLOCK, LANES):
            store(rows, (row + j) * BLOCK + at, splat(shares[j]))


@part
def _move_screws(code, p, rows, read, write, above, own, shares, angle, cosine, sine):
    """Carry the screws of the coordinates that move the parent and add the link's own joint's.

    That is row `shares + k` for coordinate k; `above[k]` and `own[k]` say which coordinates move
    the parent and the link.
    """
    for k in range(own.size):
        if not own[k]:
            continue
        o = (STATE + SCREW * k) * BLOCK
        for at in range(0, BLOCK, LANES):
            # Coordinates that do not move the parent start with this joint.
            zx = zy = zz = mx = my = mz = splat(0.0)
            if above[k]:
                zx, zy, zz, mx, my, mz = carry_screw_rows(
                    code, p, rows, read + o + at, angle + at, cosine + at, sine + at
                )
            # A coordinate moves this joint by its share of G.
            share = load(rows, (shares + k) * BLOCK + at)
            if code[REVOLUTE]:
                zz = zz + share
            else:
                mz = mz + share
            screw = zx, zy, zz, mx, my, mz
            put_six(rows, write + o + at, carry_screw(code[AFTER], p, 12, screw))


@part
def _write_block(codes, placements, n_slots, moves, places, rows, out, stride, start):
    """Run down the tree with the block of motion in `rows` and write the chosen columns.

    They go into rows of `out` from position `start`.
    """
    n, m = codes.shape[0], moves.shape[1]
    slot = (STATE + SCREW * m) * BLOCK
    terms = n_slots * slot
    angles = terms + TERMS * BLOCK
    cosine = angles + 3 * n * BLOCK
    sine = cosine + BLOCK
    shares = sine // BLOCK + 1
    for i in range(n):
        code, p = codes[i], placements[i]
        read, write = code[READ] * slot, code[WRITE] * slot
        angle = angles + i * BLOCK
        rate, change = angle + n * BLOCK, angle + 2 * n * BLOCK
        if code[REVOLUTE]:
            trigonometry(rows, angle, cosine, sine)
        move_link(code, p, rows, read, write, angle, rate, change, cosine, sine)
        above, own = moves[code[PARENT] + 1], moves[i + 1]
        _move_screws(code, p, rows, read, write, above, own, shares + i * m, angle, cosine, sine)
        _write_link_terms(rows, write, terms)
        for k in range(m):
            if own[k]:
                screw = write + (STATE + SCREW * k) * BLOCK
                _write_link_columns(rows, screw, terms, places[k, i], out, stride, start)


@kernel("i2 f2 f1 i f1 b2 i3 i2 i1 f1 f1 f1 i i F1 i", usual=True)
def regressor(
    codes,
    placements,
    gravity,
    n_slots,
    shares,
    moves,
    places,
    bounds,
    columns,
    q,
    qd,
    qdd,
    start,
    stop,
    out,
    width,
):
    """Write the regressor with samples innermost, or sample-major if `columns` are given.

    By virtual work `Y = G^T Y_tree`, G = 1 for a tree. The screw by which coordinate k moves a link
    is the sum of the joint screws above it times the shares `G[j, k]`; the recursion carries these
    sums instead of a screw per joint. Motion concerns the n joints; `shares` are G (n, m) in a row,
    or one after the other for all samples; `moves[i + 1, k]` says whether coordinate k moves link
    i, and `moves[0]` that none moves the root.

    `places[k, i, c]` is the row for coordinate k and parameter c of link i of the tree, or -1;
    `bounds[k]` are the first row of coordinate k and the row after its last. Without `columns`
    there is one row of `out`, `width` numbers long, per coordinate and chosen parameter. With them,
    `columns[row]` is written of row m sample + k of `out`, and the rest left; `columns` increases
    within a coordinate, so that neighbours can be moved by the vector.
    """
    n, m = codes.shape[0], moves.shape[1]
    by_sample = columns.size > 0
    angles = n_slots * (STATE + SCREW * m) + TERMS
    known = angles + 3 * n + 2
    rows = allocate_scratch(known + n * m)
    tile = allocate_scratch(bounds[m - 1, 1] if by_sample or (stop - start) % BLOCK else 0)
    tile[:] = 0.0  # rows that the structure makes zero are not written
    rest(rows, gravity)
    for block in range(start, stop, BLOCK):
        count = min(BLOCK, stop - block)
        gather_states(q, qd, qdd, block, count, n, rows, angles)
        # Shares common to all samples are laid out once.
        if block == start or shares.size > n * m:
            _gather_shares(shares, block, count, n * m, rows, known)
        at_once = count == BLOCK and not by_sample
        # one call, which is inlined and compiled once
        target, stride, first = (out, width, block) if at_once else (tile, BLOCK, 0)
        _write_block(codes, placements, n_slots, moves, places, rows, target, stride, first)
        if not at_once:
            _write_tile(tile, bounds, columns, block, count, out, width)


@part
def _write_wrench(rows, state, force, chi):
    """Write the wrench that the motion of a link requires, in link axes."""
    for at in range(0, BLOCK, LANES):
        put_six(rows, force + at, find_wrench(chi, 0, read_nine(rows, state + at)))


@part
def _hand_down(code, p, rows, force, parent_force, angle, cosine, sine, torque):
    """Write the joint torque of a link's wrench and add the wrench to the parent link's wrench."""
    for at in range(0, BLOCK, LANES):
        # In front of the placement z is the axis: z . n turns, z . f slides.
        f = carry_wrench(code[AFTER], p, 12, read_six(rows, force + at))
        store(rows, torque + at, f[5] if code[REVOLUTE] else f[2])
        if code[PARENT] >= 0:
            if code[REVOLUTE]:
                f = turn_wrench(load(rows, cosine + at), load(rows, sine + at), f)
            else:
                f = slide_wrench(load(rows, angle + at), f)
            f = carry_wrench(code[BEFORE], p, 0, f)
            add(rows, parent_force + at, f[0], f[1], f[2])
            add(rows, parent_force + at + 3 * BLOCK, f[3], f[4], f[5])


@kernel("i2 f2 f1 f2 f1 f1 f1 i i F1", usual=True)
def newton_euler(codes, placements, gravity, chi, q, qd, qdd, start, stop, out):
    """Write joint torques, sample-major, by the recursion of Luh, Walker and Paul (1980).

    `chi` (n, 10).
    """
    n = codes.shape[0]
    state = STATE * BLOCK
    forces = (n + 1) * state
    angles = forces + n * FORCE * BLOCK
    turns = angles + 3 * n * BLOCK
    torques = turns + 2 * n * BLOCK
    rows = allocate_scratch(torques // BLOCK + n)
    rest(rows, gravity)
    for block in range(start, stop, BLOCK):
        count = min(BLOCK, stop - block)
        gather_states(q, qd, qdd, block, count, n, rows, angles // BLOCK)
        for i in range(n):
            angle, cosine = angles + i * BLOCK, turns + 2 * i * BLOCK
            if codes[i, REVOLUTE]:
                trigonometry(rows, angle, cosine, cosine + BLOCK)
            read, write = (codes[i, PARENT] + 1) * state, (i + 1) * state
            rate, change = angle + n * BLOCK, angle + 2 * n * BLOCK
            move_link(
                codes[i],
                placements[i],
                rows,
                read,
                write,
                angle,
                rate,
                change,
                cosine,
                cosine + BLOCK,
            )
            _write_wrench(rows, write, forces + i * FORCE * BLOCK, chi[i])
        # Leaves first: a wrench is whole before it goes to the parent.
        for i in range(n - 1, -1, -1):
            angle, cosine = angles + i * BLOCK, turns + 2 * i * BLOCK
            force, parent_force = (
                forces + i * FORCE * BLOCK,
                forces + codes[i, PARENT] * FORCE * BLOCK,
            )
            _hand_down(
                codes[i],
                placements[i],
                rows,
                force,
                parent_force,
                angle,
                cosine,
                cosine + BLOCK,
                torques + i * BLOCK,
            )
        for sample in range(count):
            for i in range(n):
                out[(block + sample) * n + i] = rows[torques + i * BLOCK + sample]
