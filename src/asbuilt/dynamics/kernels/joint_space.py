"""Batched mass and Coriolis matrices, and rows less what reactions explain.

The inertia of every link seen through the screws of the joints above it.

Sample-major arrays come in and go out flat; a call works on samples start ... stop - 1.
"""

# mypy: allow-untyped-defs

from __future__ import annotations

import numpy as np

from asbuilt.compilation import kernel, part
from asbuilt.dynamics.kernels.lanes import LANES, load, splat, store
from asbuilt.dynamics.kernels.recursion import (
    BLOCK,
    DEPTH,
    READ,
    REVOLUTE,
    STATE,
    WRITE,
    allocate_scratch,
    cross,
    gather,
    move_screws,
    read_six,
    trigonometry,
)


@part
def _multiply_inertia(chi, zx, zy, zz, mx, my, mz):
    """Return moment I z + h x m and force mass m - h x z of a screw."""
    hx, hy, hz, mass = chi[6], chi[7], chi[8], chi[9]
    # n = I z + h x m
    nx = zx * chi[0] + zy * chi[1] + zz * chi[2] + mz * hy - my * hz
    ny = zx * chi[1] + zy * chi[3] + zz * chi[4] + mx * hz - mz * hx
    nz = zx * chi[2] + zy * chi[4] + zz * chi[5] + my * hx - mx * hy
    # f = mass m + z x h
    return (
        nx,
        ny,
        nz,
        mx * mass + zy * hz - zz * hy,
        my * mass + zz * hx - zx * hz,
        mz * mass + zx * hy - zy * hx,
    )


@part
def _add_to_column(rows, screws, joints, upto, column, matrix, nx, ny, nz, fx, fy, fz):
    """Add z_k . n + m_k . f to rows k of a column, for the joints at depth 0 ... upto."""
    for k in range(upto + 1):
        zx, zy, zz, mx, my, mz = read_six(rows, screws + 6 * k * BLOCK)
        place = matrix + (joints[k] * joints.size + column) * BLOCK
        store(
            rows,
            place,
            load(rows, place) + (zx * nx + zy * ny + zz * nz) + (mx * fx + my * fy + mz * fz),
        )


@part
def _add_mass(depth, rows, screws, chi, joints, matrix):
    # (n, f) = I_i s_j, the momentum of the link per rate of joint j.
    """Add a link's share s_k^T I s_j, upper triangle."""
    for at in range(0, BLOCK, LANES):
        for j in range(depth + 1):
            zx, zy, zz, mx, my, mz = read_six(rows, screws + 6 * j * BLOCK + at)
            nx, ny, nz, fx, fy, fz = _multiply_inertia(chi, zx, zy, zz, mx, my, mz)
            _add_to_column(
                rows, screws + at, joints, j, joints[j], matrix + at, nx, ny, nz, fx, fy, fz
            )


@part
def _add_coriolis(depth, rows, screws, rates, chi, joints, matrix):
    """Add a link's share s_k^T (I ds_j/dt + B s_j).

    With u what the joints below j add to the twist of the link, ds_j/dt = -u x s_j, for a screw of
    the parts above seen from the link.
    """
    for at in range(0, BLOCK, LANES):
        # Twist (w, v) of the link: the sum of its screws times their rates.
        wx = wy = wz = vx = vy = vz = splat(0.0)
        for j in range(depth + 1):
            zx, zy, zz, mx, my, mz = read_six(rows, screws + 6 * j * BLOCK + at)
            rate = load(rows, rates + joints[j] * BLOCK + at)
            wx, wy, wz = wx + zx * rate, wy + zy * rate, wz + zz * rate
            vx, vy, vz = vx + mx * rate, vy + my * rate, vz + mz * rate
        # Its momentum (l, p) = I (w, v).
        lx, ly, lz, px, py, pz = _multiply_inertia(chi, wx, wy, wz, vx, vy, vz)
        # From the link up: (w, v) is now u, what the joints below j add.
        wx = wy = wz = vx = vy = vz = splat(0.0)
        for j in range(depth, -1, -1):
            zx, zy, zz, mx, my, mz = read_six(rows, screws + 6 * j * BLOCK + at)
            # ds_j/dt = s_j x u = (z x w, m x w + z x v)
            ax, ay, az = cross(zx, zy, zz, wx, wy, wz)
            bx, by, bz = cross(mx, my, mz, wx, wy, wz)
            cx, cy, cz = cross(zx, zy, zz, vx, vy, vz)
            # I ds_j/dt
            nx, ny, nz, fx, fy, fz = _multiply_inertia(chi, ax, ay, az, bx + cx, by + cy, bz + cz)
            # + s_j x* (l, p) = (z x l + m x p, z x p), which is B s_j
            ax, ay, az = cross(zx, zy, zz, lx, ly, lz)
            bx, by, bz = cross(mx, my, mz, px, py, pz)
            cx, cy, cz = cross(zx, zy, zz, px, py, pz)
            nx, ny, nz, fx, fy, fz = (
                nx + ax + bx,
                ny + ay + by,
                nz + az + bz,
                fx + cx,
                fy + cy,
                fz + cz,
            )
            _add_to_column(
                rows, screws + at, joints, depth, joints[j], matrix + at, nx, ny, nz, fx, fy, fz
            )
            # Joint j is below all that follow.
            rate = load(rows, rates + joints[j] * BLOCK + at)
            wx, wy, wz = wx + zx * rate, wy + zy * rate, wz + zz * rate
            vx, vy, vz = vx + mx * rate, vy + my * rate, vz + mz * rate


@kernel("i2 i2 f2 i f2 f1 f1 b i i F1")
def joint_space_matrices(codes, chain, placements, n_slots, chi, q, qd, coriolis, start, stop, out):
    """Write `sum_i J_i^T I_i J_i` sample-major, or with `coriolis` its Coriolis factor.

    That is `sum_i J_i^T (I_i dJ_i/dt + B_i J_i)`.
    """
    n = codes.shape[0]
    slot = (STATE + 6 * n) * BLOCK
    angles = n_slots * slot
    rates = angles + n * BLOCK
    cosine = rates + n * BLOCK
    sine = cosine + BLOCK
    matrix = sine + BLOCK
    rows = allocate_scratch(matrix // BLOCK + n * n)
    for block in range(start, stop, BLOCK):
        count = min(BLOCK, stop - block)
        gather(q, block, count, n, rows, angles // BLOCK)
        gather(qd, block, count, n, rows, rates // BLOCK)
        # Links add their shares, so that the sums start at zero.
        for at in range(matrix, matrix + n * n * BLOCK, LANES):
            store(rows, at, splat(0.0))
        for i in range(n):
            code, angle = codes[i], angles + i * BLOCK
            read, write = code[READ] * slot, code[WRITE] * slot
            if code[REVOLUTE]:
                trigonometry(rows, angle, cosine, sine)
            move_screws(code, placements[i], rows, read, write, angle, cosine, sine)
            if coriolis:
                _add_coriolis(
                    code[DEPTH], rows, write + STATE * BLOCK, rates, chi[i], chain[i], matrix
                )
            else:
                _add_mass(code[DEPTH], rows, write + STATE * BLOCK, chi[i], chain[i], matrix)
        for sample in range(count):
            for k in range(n):
                for j in range(n):
                    # The mass matrix is symmetric, and only its upper triangle was summed.
                    place = k * n + j if coriolis or k <= j else j * n + k
                    out[((block + sample) * n + k) * n + j] = rows[matrix + place * BLOCK + sample]


@kernel("F3 f")
def orthonormalise_rows(J, tolerance):
    """Make the rows of J (m, n, N) orthonormal, sample by sample, by Gram and Schmidt, twice.

    Rows that depend on those before them, to `tolerance` of their length, become zero.
    """
    m, n, samples = J.shape
    for s in range(samples):
        for i in range(m):
            before = 0.0
            for j in range(n):
                before += J[i, j, s] ** 2
            # Twice is enough: the first pass loses orthogonality where rows nearly depend on each
            # other.
            for _ in range(2):
                for k in range(i):
                    along = 0.0
                    for j in range(n):
                        along += J[k, j, s] * J[i, j, s]
                    for j in range(n):
                        J[i, j, s] -= along * J[k, j, s]
            left = 0.0
            for j in range(n):
                left += J[i, j, s] ** 2
            scale = 0.0
            # Next to nothing is left of a row that depends on those before.
            if left > tolerance**2 * before:
                scale = 1.0 / left**0.5
            for j in range(n):
                J[i, j, s] *= scale


@kernel("f3 F2 i")
def project(basis, rows, count):
    """Take from `rows` (n per, N) their part along the basis (m, n, N): `x - Q^T Q x`.

    Row `j per + c` is column c in the equation of joint j, over `count` samples.
    """
    m, n, _ = basis.shape
    per = rows.shape[0] // n
    along = np.zeros(BLOCK)
    # By blocks, so that `along` and the rows stay in the cache.
    for start in range(0, count, BLOCK):
        width = min(BLOCK, count - start)
        for i in range(m):
            for c in range(per):
                along[:] = 0.0
                for j in range(n):
                    for s in range(width):
                        along[s] += basis[i, j, start + s] * rows[j * per + c, start + s]
                for j in range(n):
                    for s in range(width):
                        rows[j * per + c, start + s] -= along[s] * basis[i, j, start + s]
