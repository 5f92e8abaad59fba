"""Torque and mass matrix of one sample, with the least work per call.

A robot comes as two flat arrays: `codes`, 7 per link as in its `Layout`, then the drive program,
rows of operation, joint and constant; and `numbers`, per link its placements (24) and inertial
parameters (10), then gravity (3), then the constants of the program, then `work_size(n)` numbers
for intermediate results. The functions return False, with `out` unspecified, unless every input has
n finite values. They keep the interpreter lock, since calls for one robot share its work space.
"""

# mypy: allow-untyped-defs

from __future__ import annotations

import math

import numpy as np

from asbuilt.compilation import kernel, part
from asbuilt.dynamics.kernels.operations import STACK
from asbuilt.dynamics.kernels.recursion import (
    AFTER,
    BEFORE,
    GENERAL,
    NOTHING,
    PARENT,
    REVOLUTE,
    carry_motion,
    carry_wrench,
    cross,
    find_wrench,
    rotate_into,
    rotate_out_of,
    slide_motion,
    slide_wrench,
    turn_motion,
    turn_wrench,
)
from asbuilt.dynamics.kernels.stack_machine import run

PER_LINK = 34
"""Numbers of a link: placements and inertial parameters."""
CHI = 24
"""Place of the inertial parameters among them."""
CODES = 7
"""Codes of a link."""
STATE, WRENCH = 9, 6
"""Numbers per link of the recursion: w, dw, a; force, moment."""
WORK_PER_LINK, MORE_WORK = 30, 12 + STACK
"""Numbers of the work space."""


def work_size(n: int) -> int:
    """Return the size of the work space for n joints."""
    return WORK_PER_LINK * n + MORE_WORK


@part
def _is_finite(n, q, qd, qdd):
    if q.size != n or qd.size != n or qdd.size != n:
        return False
    total = 0.0
    for k in range(n):
        # 0 times infinity or NaN is NaN, so that one comparison checks all.
        total += 0.0 * (q[k] + qd[k] + qdd[k])
    return total == 0.0


@part
def _write_cosines_and_sines(n, q, cosines, sines):
    """Write cosines and sines of all positions.

    Not by `sine_cosine`: after a single 512-bit instruction some processors run slower for a while.
    """
    for k in range(n):
        cosines[k], sines[k] = math.cos(q[k]), math.sin(q[k])


@kernel("i1 F1 a1 a1 a1 F1", nogil=False)
def torque(codes, numbers, q, qd, qdd, out):
    """Write the joint torques of rigid bodies and drives (Luh, Walker and Paul, 1980)."""
    n = out.size
    if not _is_finite(n, q, qd, qdd):
        return False
    work = numbers[numbers.size - WORK_PER_LINK * n - MORE_WORK :]
    cosines, sines, states = work, work[n:], work[2 * n :]
    wrenches = states[STATE * n :]
    _write_cosines_and_sines(n, q, cosines, sines)
    g = PER_LINK * n
    # Gravity as an acceleration of the root against free fall.
    root = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -numbers[g], -numbers[g + 1], -numbers[g + 2])
    for i in range(n):
        o, x = PER_LINK * i, root
        if codes[CODES * i + PARENT] >= 0:
            r = STATE * codes[CODES * i + PARENT]
            x = (
                states[r],
                states[r + 1],
                states[r + 2],
                states[r + 3],
                states[r + 4],
                states[r + 5],
                states[r + 6],
                states[r + 7],
                states[r + 8],
            )
        x = carry_motion(codes[CODES * i + BEFORE], numbers, o, x)
        if codes[CODES * i + REVOLUTE]:
            x = turn_motion(cosines[i], sines[i], qd[i], qdd[i], x)
        else:
            x = slide_motion(q[i], qd[i], qdd[i], x)
        x = carry_motion(codes[CODES * i + AFTER], numbers, o + 12, x)
        for k in range(STATE):
            states[STATE * i + k] = x[k]
        f = find_wrench(numbers, o + CHI, x)
        for k in range(WRENCH):
            wrenches[WRENCH * i + k] = f[k]
    # Leaves first: a wrench is whole before it goes to the parent.
    for i in range(n - 1, -1, -1):
        o, r = PER_LINK * i, WRENCH * i
        f = (
            wrenches[r],
            wrenches[r + 1],
            wrenches[r + 2],
            wrenches[r + 3],
            wrenches[r + 4],
            wrenches[r + 5],
        )
        f = carry_wrench(codes[CODES * i + AFTER], numbers, o + 12, f)
        out[i] = f[5] if codes[CODES * i + REVOLUTE] else f[2]
        if codes[CODES * i + PARENT] >= 0:
            if codes[CODES * i + REVOLUTE]:
                f = turn_wrench(cosines[i], sines[i], f)
            else:
                f = slide_wrench(q[i], f)
            f = carry_wrench(codes[CODES * i + BEFORE], numbers, o, f)
            r = WRENCH * codes[CODES * i + PARENT]
            for k in range(WRENCH):
                wrenches[r + k] += f[k]
    if codes.size > CODES * n:
        loads, stack = wrenches[WRENCH * n :], wrenches[(WRENCH + 1) * n :]
        # Friction by load has the rigid torque, before drives add theirs.
        for k in range(n):
            loads[k] = out[k]
        run(codes, CODES * n, numbers, g + 3, q, qd, qdd, loads, stack, out)
    return True


@part
def _turn_parameters(p, o, b, at):
    """Return parameters b[at:at+10] in axes turned by R = p[o:o+9]: `R I R^T`, `R h`, m."""
    general = np.int64(GENERAL)
    # Rows of R I, then of R I R^T, whose upper triangle is enough.
    ax, ay, az = rotate_out_of(general, p, o, b[at], b[at + 1], b[at + 2])
    bx, by, bz = rotate_out_of(general, p, o, b[at + 1], b[at + 3], b[at + 4])
    cx, cy, cz = rotate_out_of(general, p, o, b[at + 2], b[at + 4], b[at + 5])
    xx, xy, xz = rotate_out_of(general, p, o, ax, bx, cx)
    _, yy, yz = rotate_out_of(general, p, o, ay, by, cy)
    _, _, zz = rotate_out_of(general, p, o, az, bz, cz)
    hx, hy, hz = rotate_out_of(general, p, o, b[at + 6], b[at + 7], b[at + 8])
    return xx, xy, xz, yy, yz, zz, hx, hy, hz, b[at + 9]


@part
def _shift_parameters(x, y, z, b):
    """Return inertial parameters about an origin from which the old one lies at t = (x, y, z).

    `I + 2 (h . t) 1 - h t^T - t h^T + m (|t|^2 1 - t t^T)` and `h + m t`.
    """
    # u = h + m t / 2 joins the terms of h and of m.
    m, ux, uy, uz = b[9], b[6] + 0.5 * b[9] * x, b[7] + 0.5 * b[9] * y, b[8] + 0.5 * b[9] * z
    return (
        b[0] + 2.0 * (uy * y + uz * z),
        b[1] - ux * y - uy * x,
        b[2] - ux * z - uz * x,
        b[3] + 2.0 * (ux * x + uz * z),
        b[4] - uy * z - uz * y,
        b[5] + 2.0 * (ux * x + uy * y),
        b[6] + m * x,
        b[7] + m * y,
        b[8] + m * z,
        m,
    )


@part
def _place(code, i, p, o, q, c, s, parent, frames, f, screw):
    """Write rotation and origin of a link in the root frame and the screw (z, m) of its joint."""
    for k in range(3):
        r = parent + 3 * k
        x, y, z, at = frames[r], frames[r + 1], frames[r + 2], frames[parent + 9 + k]
        if code[i + BEFORE] != NOTHING:
            at += x * p[o + 9] + y * p[o + 10] + z * p[o + 11]
            x, y, z = rotate_into(code[i + BEFORE], p, o, x, y, z)
        # The axis in the root frame, and where the joint lies.
        screw[k], screw[3 + k] = z, at
        if code[i + REVOLUTE]:
            x, y = x * c + y * s, y * c - x * s
        else:
            at += z * q
        if code[i + AFTER] != NOTHING:
            at += x * p[o + 21] + y * p[o + 22] + z * p[o + 23]
            x, y, z = rotate_into(code[i + AFTER], p, o + 12, x, y, z)
        frames[f + 3 * k], frames[f + 3 * k + 1], frames[f + 3 * k + 2] = x, y, z
        frames[f + 9 + k] = at
    zx, zy, zz = screw[0], screw[1], screw[2]
    if code[i + REVOLUTE]:
        # A unit turn about z moves the root's origin by p x z.
        screw[3], screw[4], screw[5] = cross(screw[3], screw[4], screw[5], zx, zy, zz)
    else:
        screw[0] = screw[1] = screw[2] = 0.0
        screw[3], screw[4], screw[5] = zx, zy, zz


@kernel("i1 F1 a1 F2", nogil=False)
def mass_matrix(codes, numbers, q, out):
    """Write `M_ij = s_i . I_j s_j` into zeros, I_j the bodies moved by joint j, i above j.

    Screws and composite inertias are those about the root origin (Walker and Orin, 1982).
    """
    n = out.shape[0]
    if not _is_finite(n, q, q, q):
        return False
    work = numbers[numbers.size - WORK_PER_LINK * n - MORE_WORK :]
    cosines, sines, frames = work, work[n:], work[2 * n :]
    bodies, screws = frames[12 * n + 12 :], frames[22 * n + 12 :]
    _write_cosines_and_sines(n, q, cosines, sines)
    for k in range(12):
        # Rotation 1 and translation 0 of the root.
        frames[k] = 1.0 if k % 4 == 0 and k < 9 else 0.0
    for i in range(n):
        o, f = PER_LINK * i, 12 * i + 12
        above, c, s = 12 * codes[CODES * i + PARENT] + 12, cosines[i], sines[i]
        _place(codes, CODES * i, numbers, o, q[i], c, s, above, frames, f, screws[6 * i :])
        b = _turn_parameters(frames, f, numbers, o + CHI)
        b = _shift_parameters(frames[f + 9], frames[f + 10], frames[f + 11], b)
        for k in range(10):
            bodies[10 * i + k] = b[k]
    # Leaves first: a body holds all that its joint moves when its turn comes.
    for i in range(n - 1, -1, -1):
        b, z = bodies[10 * i :], screws[6 * i :]
        # (n, f) = I s: f = mass m + z x h, n = I z + h x m
        fx, fy, fz = cross(z[0], z[1], z[2], b[6], b[7], b[8])
        nx, ny, nz = cross(b[6], b[7], b[8], z[3], z[4], z[5])
        fx, fy, fz = fx + b[9] * z[3], fy + b[9] * z[4], fz + b[9] * z[5]
        nx += b[0] * z[0] + b[1] * z[1] + b[2] * z[2]
        ny += b[1] * z[0] + b[3] * z[1] + b[4] * z[2]
        nz += b[2] * z[0] + b[4] * z[1] + b[5] * z[2]
        j = i
        # Joints further up see the same momentum: the inertia is about the root's origin.
        while j >= 0:
            z = screws[6 * j :]
            moment = z[0] * nx + z[1] * ny + z[2] * nz
            out[i, j] = out[j, i] = moment + z[3] * fx + z[4] * fy + z[5] * fz
            j = codes[CODES * j + PARENT]
        parent = codes[CODES * i + PARENT]
        if parent >= 0:
            for k in range(10):
                bodies[10 * parent + k] += b[k]
    return True
