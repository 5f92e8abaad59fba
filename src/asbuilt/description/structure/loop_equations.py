"""Equations of loops: their gap, its derivative by the joints, and its acceleration.

Coordinates u = (q, p) belong to motors and to passive joints; the joints of the tree are at
`A u + b`. The loops demand `phi(u) = 0`. A point x of a link moves by joint i, with axis z and
origin o, as `dx/du_i = z x (x - o)`, or z where it slides; it turns by z. The acceleration of phi
where no coordinate accelerates, `dJ/dt ud` with `J = dphi/du`, is the points' acceleration.

Rows of phi are in the axes of the last link that both sides of a loop share, which may move.
Lengths are in units of the loop's size, so that all rows are numbers of one kind.
"""

# mypy: allow-untyped-defs

from __future__ import annotations

import math

import numpy as np

from asbuilt.compilation import kernel, part
from asbuilt.description.structure.loops import CONNECT, CURVE, JOINT, POINT, SIZE, TURN, WELD


@part
def _cross(ax, ay, az, bx, by, bz):
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


@part
def _carry_acceleration(w, dw, a, tx, ty, tz):
    """Add `dw x t + w x (w x t)` to the acceleration of a point moved on by t."""
    cx, cy, cz = _cross(w[0], w[1], w[2], tx, ty, tz)
    ex, ey, ez = _cross(w[0], w[1], w[2], cx, cy, cz)
    gx, gy, gz = _cross(dw[0], dw[1], dw[2], tx, ty, tz)
    a[0] += gx + ex
    a[1] += gy + ey
    a[2] += gz + ez


@part
def _move_point(R, x, t, w, dw, a):
    """Move a point on by t of the axes R (3, 3)."""
    tx = R[0, 0] * t[0] + R[0, 1] * t[1] + R[0, 2] * t[2]
    ty = R[1, 0] * t[0] + R[1, 1] * t[1] + R[1, 2] * t[2]
    tz = R[2, 0] * t[0] + R[2, 1] * t[1] + R[2, 2] * t[2]
    # a += dw x t + w x (w x t)
    _carry_acceleration(w, dw, a, tx, ty, tz)
    x[0] += tx
    x[1] += ty
    x[2] += tz


@part
def _turn_axes(R, p, o):
    """Turn axes R by the rotation at p[o:o+9]."""
    for i in range(3):
        x = R[i, 0]
        y = R[i, 1]
        z = R[i, 2]
        for j in range(3):
            R[i, j] = x * p[o + j] + y * p[o + 3 + j] + z * p[o + 6 + j]


@part
def _walk_side(path, placements, revolute, at, rate, point, R, x, w, dw, a, axes, origins):
    """Walk from the shared link to the point of one side of a loop.

    Writes axes R and position x of the end, its angular velocity w, and dw and a, which are its
    accelerations where no joint accelerates; axis and origin of each joint on the way.
    """
    for i in range(3):
        x[i] = w[i] = dw[i] = a[i] = 0.0
        for j in range(3):
            R[i, j] = 1.0 if i == j else 0.0
    for joint in path:
        if joint < 0:
            break
        p = placements[joint]
        # In front of the joint: its axis and origin are known here.
        _move_point(R, x, p[9:12], w, dw, a)
        _turn_axes(R, p, 0)
        zx = R[0, 2]
        zy = R[1, 2]
        zz = R[2, 2]
        axes[joint, 0], axes[joint, 1], axes[joint, 2] = zx, zy, zz
        origins[joint, 0], origins[joint, 1], origins[joint, 2] = x[0], x[1], x[2]
        v = rate[joint]
        # w x v z turns the axis on the way.
        cx, cy, cz = _cross(w[0], w[1], w[2], v * zx, v * zy, v * zz)
        # dw += w x v z, w += v z
        if revolute[joint]:
            c = math.cos(at[joint])
            s = math.sin(at[joint])
            for i in range(3):
                first = R[i, 0]
                second = R[i, 1]
                R[i, 0] = first * c + second * s
                R[i, 1] = second * c - first * s
            dw[0] += cx
            dw[1] += cy
            dw[2] += cz
            w[0] += v * zx
            w[1] += v * zy
            w[2] += v * zz
        # Coriolis: a += 2 w x v z, once the sliding part has moved on.
        else:
            q = at[joint]
            _carry_acceleration(w, dw, a, q * zx, q * zy, q * zz)
            x[0] += q * zx
            x[1] += q * zy
            x[2] += q * zz
            a[0] += 2.0 * cx
            a[1] += 2.0 * cy
            a[2] += 2.0 * cz
        # Behind the joint, the link's own frame.
        _move_point(R, x, p[21:24], w, dw, a)
        _turn_axes(R, p, 12)
    _move_point(R, x, point, w, dw, a)


@part
def _add_columns(work, row, joint, x, y, z, sources, first):
    """Add the derivative of three rows by a joint of the tree to those by its coordinates."""
    for k in range(first[joint], first[joint + 1]):
        column = int(sources[k, 0])
        factor = sources[k, 1]
        work[row, column] += factor * x
        work[row + 1, column] += factor * y
        work[row + 2, column] += factor * z


@part
def _add_side(work, row, path, sign, turns, size, revolute, x, axes, origins, sources, first):
    """Add the columns of the joints of one side: `z x (x - o)` or z, and z or 0 where it welds."""
    for joint in path:
        if joint < 0:
            break
        zx, zy, zz = axes[joint]
        scale = sign / size
        if revolute[joint]:
            o = origins[joint]
            # dx/du = z x (x - o)
            cx, cy, cz = _cross(zx, zy, zz, x[0] - o[0], x[1] - o[1], x[2] - o[2])
            _add_columns(work, row, joint, scale * cx, scale * cy, scale * cz, sources, first)
            # Welds turn by the axis itself, in rad and without a size.
            if turns:
                _add_columns(work, row + 3, joint, sign * zx, sign * zy, sign * zz, sources, first)
        else:
            _add_columns(work, row, joint, scale * zx, scale * zy, scale * zz, sources, first)


@part
def _add_curve(path, given, sources, first, at, rate, work, row):
    """Write the row of a joint that is at a polynomial of another, `y = c_0 + c_1 x + ...`."""
    one = path[0, 0]
    other = path[1, 0]
    phi = work.shape[1] - 2
    bias = work.shape[1] - 1
    # A joint held at a constant has no second one.
    x, xd = (at[other], rate[other]) if other >= 0 else (0.0, 0.0)
    value = 0.0
    slope = 0.0
    bend = 0.0
    # Horner's scheme for value, slope and second derivative together.
    for power in range(4, -1, -1):
        bend = bend * x + 2.0 * slope
        slope = slope * x + value
        value = value * x + given[CURVE + power]
    for k in range(first[one], first[one + 1]):
        work[row, int(sources[k, 0])] += sources[k, 1]
    if other >= 0:
        for k in range(first[other], first[other + 1]):
            # phi = y - p(x), dJ/dt ud = -p''(x) xd^2
            work[row, int(sources[k, 0])] -= slope * sources[k, 1]
    work[row, phi] = at[one] - value
    work[row, bias] = -bend * xd * xd


@part
def assemble(mechanism, at, rate, work, room):
    """Write J, phi and dJ/dt ud, the columns of `work` in this order.

    `at` and `rate` are positions and velocities of the joints of the tree.
    """
    kinds, paths, numbers, placements, revolute, sources, first, _ = mechanism
    width = work.shape[1]
    phi = width - 2
    bias = width - 1
    n = at.size
    axes = room[: 3 * n].reshape(n, 3)
    origins = room[3 * n : 6 * n].reshape(n, 3)
    ends = room[6 * n :]
    row = 0
    for loop in range(kinds.size):
        kind = kinds[loop]
        given = numbers[loop]
        count = 3 if kind == CONNECT else 6 if kind == WELD else 1
        work[row : row + count] = 0.0
        if kind == JOINT:
            _add_curve(paths[loop], given, sources, first, at, rate, work, row)
            row += 1
            continue
        size = given[SIZE]
        for side in range(2):
            part_of = ends[24 * side : 24 * side + 24]
            R = part_of[:9].reshape(3, 3)
            x = part_of[9:12]
            w = part_of[12:15]
            dw = part_of[15:18]
            a = part_of[18:21]
            path = paths[loop, side]
            point = given[POINT + 3 * side : POINT + 3 * side + 3]
            _walk_side(path, placements, revolute, at, rate, point, R, x, w, dw, a, axes, origins)
            # Side b counts against side a.
            sign = 1.0 - 2.0 * side
            welds = kind == WELD
            _add_side(
                work, row, path, sign, welds, size, revolute, x, axes, origins, sources, first
            )
        # phi and its bias in sizes of the loop, as its columns.
        for i in range(3):
            work[row + i, phi] = (ends[9 + i] - ends[33 + i]) / size
            work[row + i, bias] = (ends[18 + i] - ends[42 + i]) / size
        if kind == WELD:
            one = ends[:9].reshape(3, 3)
            other = ends[24:33].reshape(3, 3)
            _turn_axes(one, given, TURN)
            # the rotation from the axes of b to where a wants them, as a vector of length sin
            for i in range(3):
                j = (i + 1) % 3
                k = (i + 2) % 3
                # Half the sum of cross products of the axes: the sine of the angle, along its axis.
                turn = 0.0
                for c in range(3):
                    turn += 0.5 * (one[k, c] * other[j, c] - one[j, c] * other[k, c])
                work[row + 3 + i, phi] = turn
                work[row + 3 + i, bias] = ends[15 + i] - ends[39 + i]
        row += count


@part
def expand_into_tree(mechanism, u, share, at):
    """Write the joints of the tree `A u + b`, and `A u` where `share` is 0 in place of 1."""
    sources = mechanism[5]
    first = mechanism[6]
    offset = mechanism[7]
    for joint in range(at.size):
        total = share * offset[joint]
        for k in range(first[joint], first[joint + 1]):
            total += sources[k, 1] * u[int(sources[k, 0])]
        at[joint] = total


@part
def allocate_workspace(n_tree):
    """Return the memory that `assemble` works in."""
    return np.zeros(6 * n_tree + 48)


@part
def count_equations(kinds):
    """Return the number of equations."""
    rows = 0
    for kind in kinds:
        rows += 3 if kind == CONNECT else 6 if kind == WELD else 1
    return rows


@kernel("i1 i3 f2 f2 b1 f2 i1 f1 f1 F2")
def loop_equations(
    kinds, paths, numbers, placements, revolute, sources, first, offset, u, equations
):
    """Write J, phi and dJ/dt ud = 0 at coordinates u, (rows, n_u + 2)."""
    mechanism = (kinds, paths, numbers, placements, revolute, sources, first, offset)
    n_tree = offset.size
    at = np.zeros(n_tree)
    still = np.zeros(n_tree)
    expand_into_tree(mechanism, u, 1.0, at)
    assemble(mechanism, at, still, equations, allocate_workspace(n_tree))
