"""Batched regressor of robots whose joints move by couplings `A q + b`.

By virtual work `Y = A^T Y_tree`. The screw by which coordinate k moves a link is the sum of those
of the joints above it by the shares `A[j, k]`. The recursion carries these sums instead of a screw
per joint, so that a coordinate costs as much as a joint of a tree does.
"""

# mypy: allow-untyped-defs

from __future__ import annotations

from asbuilt.dynamics.kernels.compilation import compiled
from asbuilt.dynamics.kernels.lanes import LANES, load, splat, store
from asbuilt.dynamics.kernels.recursion import (
    AFTER,
    BEFORE,
    BLOCK,
    NOTHING,
    PARENT,
    READ,
    REVOLUTE,
    STATE,
    WRITE,
    cross,
    gather_states,
    into,
    move_link,
    put,
    rest,
    scratch,
    trigonometry,
    vector,
)
from asbuilt.dynamics.kernels.rigid_body import TERMS, _columns_of_link, _link_terms

SCREW = 6
"""Rows of a screw."""


@compiled
def _move_joints(rows, coordinates, angles, matrix, offset):
    """Write `A q + b`, `A qd` and `A qdd` of a block into the rows of the joints."""
    n, m = matrix.shape
    for part in range(3):
        for i in range(n):
            row = angles + (part * n + i) * BLOCK
            for at in range(0, BLOCK, LANES):
                store(rows, row + at, splat(offset[i] if part == 0 else 0.0))
            for k in range(m):
                share, source = matrix[i, k], coordinates + (part * m + k) * BLOCK
                if share != 0.0:
                    for at in range(0, BLOCK, LANES):
                        moved = load(rows, row + at) + load(rows, source + at) * share
                        store(rows, row + at, moved)


@compiled
def _move_screws(code, p, rows, read, write, above, own, shares, angle, cosine, sine):
    """Carry the screws of the coordinates that move the parent and add the link's own joint's.

    That is `shares[k]` for coordinate k; `above[k]` and `own[k]` say which coordinates move the
    parent and the link.
    """
    before, after, revolute = code[BEFORE], code[AFTER], code[REVOLUTE]
    for k in range(shares.shape[0]):
        if not own[k]:
            continue
        o, share = (STATE + SCREW * k) * BLOCK, shares[k]
        for at in range(0, BLOCK, LANES):
            zx = zy = zz = mx = my = mz = splat(0.0)
            if above[k]:
                r = read + o + at
                zx, zy, zz = vector(rows, r)
                mx, my, mz = vector(rows, r + 3 * BLOCK)
                if before != NOTHING:
                    cx, cy, cz = cross(zx, zy, zz, p[9], p[10], p[11])
                    mx, my, mz = into(before, p, 0, mx + cx, my + cy, mz + cz)
                    zx, zy, zz = into(before, p, 0, zx, zy, zz)
                if revolute:
                    c, s = load(rows, cosine + at), load(rows, sine + at)
                    zx, zy = zx * c + zy * s, zy * c - zx * s
                    mx, my = mx * c + my * s, my * c - mx * s
                else:
                    q = load(rows, angle + at)
                    mx, my = mx + zy * q, my - zx * q
            if revolute:
                zz = zz + splat(share)
            else:
                mz = mz + splat(share)
            if after != NOTHING:
                cx, cy, cz = cross(zx, zy, zz, p[21], p[22], p[23])
                mx, my, mz = into(after, p, 12, mx + cx, my + cy, mz + cz)
                zx, zy, zz = into(after, p, 12, zx, zy, zz)
            w = write + o + at
            put(rows, w, zx, zy, zz)
            put(rows, w + 3 * BLOCK, mx, my, mz)


@compiled
def _coupled_block(
    codes, placements, n_slots, matrix, offset, moves, places, rows, out, stride, start
):
    """Run down the tree with the block of coordinates in `rows` and write the chosen columns."""
    n, m = matrix.shape
    slot = (STATE + SCREW * m) * BLOCK
    terms = n_slots * slot
    angles = terms + TERMS * BLOCK
    cosine = angles + 3 * n * BLOCK
    sine = cosine + BLOCK
    _move_joints(rows, sine + BLOCK, angles, matrix, offset)
    for i in range(n):
        code, p = codes[i], placements[i]
        read, write = code[READ] * slot, code[WRITE] * slot
        angle = angles + i * BLOCK
        rate, change = angle + n * BLOCK, angle + 2 * n * BLOCK
        if code[REVOLUTE]:
            trigonometry(rows, angle, cosine, sine)
        move_link(code, p, rows, read, write, angle, rate, change, cosine, sine)
        above, own = moves[code[PARENT] + 1], moves[i + 1]
        _move_screws(code, p, rows, read, write, above, own, matrix[i], angle, cosine, sine)
        _link_terms(rows, write, terms)
        for k in range(m):
            if own[k]:
                screw = write + (STATE + SCREW * k) * BLOCK
                _columns_of_link(rows, screw, terms, places[k, i], out, stride, start)


@compiled
def coupled_rows(
    codes,
    chain,
    placements,
    gravity,
    n_slots,
    matrix,
    offset,
    moves,
    places,
    bounds,
    q,
    qd,
    qdd,
    start,
    stop,
    out,
    stride,
):
    """Write the regressor with samples innermost, as `regressor_rows` does for a tree.

    The n joints move by `matrix @ q + offset` with the m coordinates; `moves[i + 1, k]` says
    whether coordinate k moves link i, and `moves[0]` that none moves the root; `chain` is not
    needed; `places[k, i, c]` is the row of coordinate k and parameter c of link i of the tree, or
    -1.
    """
    n, m = matrix.shape
    known = n_slots * (STATE + SCREW * m) + TERMS + 3 * n + 2
    rows = scratch(known + 3 * m)
    tail = scratch(bounds[m - 1, 1] if (stop - start) % BLOCK else 0)
    rest(rows, gravity)
    for block in range(start, stop, BLOCK):
        count = min(BLOCK, stop - block)
        gather_states(q, qd, qdd, block, count, m, rows, known)
        whole = count == BLOCK
        _coupled_block(
            codes,
            placements,
            n_slots,
            matrix,
            offset,
            moves,
            places,
            rows,
            out if whole else tail,
            stride if whole else BLOCK,
            block if whole else 0,
        )
        if not whole:
            for k in range(m):
                for row in range(bounds[k, 0], bounds[k, 1]):
                    for sample in range(count):
                        out[row * stride + block + sample] = tail[row * BLOCK + sample]
