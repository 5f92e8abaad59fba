"""What the batched kernels share.

A robot's geometry in flat arrays, and the step from one link to the next, for a block of samples
or a single one.

A block of `BLOCK` samples travels down the tree in scratch memory that fits the first-level cache,
one row per quantity. Each link has a slot of rows there: angular velocity w, angular acceleration
dw and acceleration a of its origin less gravity, in link axes, then one screw (z, m) per joint
above it: the angular velocity and the velocity of the link origin that a unit rate of that joint
causes. All positions in scratch memory are counted in doubles.
"""

# mypy: allow-untyped-defs

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from asbuilt.arrays import Array, Indices
from asbuilt.compilation import part
from asbuilt.description.model import ROOT, Geometry, RobotModel
from asbuilt.dynamics.kernels.lanes import (
    LANES,
    LARGEST_ANGLE,
    exceeds,
    load,
    load_every,
    sine_cosine,
    splat,
    store,
)
from asbuilt.errors import DescriptionError

BLOCK = 32
"""Samples per block; a multiple of LANES."""

NOTHING, ABOUT_X, GENERAL = 0, 1, 2
"""Kinds of placement: none at all; a turn about x, if any, with any translation; any other."""
PARENT, READ, WRITE, DEPTH, REVOLUTE, BEFORE, AFTER = range(7)
"""Columns of `Layout.codes`."""
STATE = 9
"""Rows of w, dw and a."""


@dataclass(frozen=True, eq=False)
class Layout:
    """Hold a robot's geometry as the kernels take it, in read-only arrays.

    `codes` (n, 7): parent, slot read, slot written, depth, whether revolute, kind of placement
    before and after (NOTHING, ABOUT_X, GENERAL). Slot 0 is the root's; a last child takes over the
    slot of its parent. `chain[i, d]` is the joint at depth d above link i. `placements` (n, 24):
    rotation and translation before, then after.
    """

    codes: Indices
    chain: Indices
    placements: Array
    gravity: Array
    n_slots: int

    def __post_init__(self) -> None:
        for array in (self.codes, self.chain, self.placements, self.gravity):
            array.setflags(write=False)

    @classmethod
    def of(cls, geometry: Geometry) -> Layout:
        """Lay out the arrays of a robot."""
        n = geometry.parent.size
        codes, chain = np.zeros((n, 7), dtype=np.int64), np.full((n, n), ROOT, dtype=np.int64)
        # The last child of each parent overwrites those before it in the dictionary.
        last_child = {int(parent): i for i, parent in enumerate(geometry.parent) if parent != ROOT}
        n_slots = 1
        for i, parent in enumerate(geometry.parent.tolist()):
            read, depth = (
                (0, 0)
                if parent == ROOT
                else (int(codes[parent, WRITE]), int(codes[parent, DEPTH]) + 1)
            )
            # The parent's state is not needed after its last child, which takes the slot.
            if last_child.get(parent) == i:
                write = read
            else:
                write, n_slots = n_slots, n_slots + 1
            sides = (
                (geometry.before_rotation[i], geometry.before_translation[i]),
                (geometry.after_rotation[i], geometry.after_translation[i]),
            )
            codes[i] = (
                parent,
                read,
                write,
                depth,
                geometry.revolute[i],
                *(_classify_placement(*side) for side in sides),
            )
            if parent != ROOT:
                # Depth counts joints, so that chains of parent and link agree up to the link.
                chain[i, :depth] = chain[parent, :depth]
            chain[i, depth] = i
        parts = (
            geometry.before_rotation,
            geometry.before_translation,
            geometry.after_rotation,
            geometry.after_translation,
        )
        placements = np.concatenate([part.reshape(n, -1) for part in parts], axis=1)
        return cls(codes, chain, placements, np.array(geometry.gravity), n_slots)


@lru_cache(maxsize=16)
def build_layout(model: RobotModel) -> Layout:
    """Return the layout of a robot, remembered for the robots used last.

    Raises `DescriptionError` for a robot with joints that follow others: its `tree` has a layout.
    """
    if model.tree is not model:
        names = ", ".join(j.name_in_tree for j in model.moving_joints if j.mimic is not None)
        raise DescriptionError(
            f"{model.name}: joints that follow others ({names}) are not supported here; lock the"
            " joints that they follow"
        )
    return Layout.of(model.geometry)


def _classify_placement(rotation: Array, translation: Array) -> int:
    # A turn about x leaves first row and column exactly those of the identity.
    if rotation[0, 0] != 1.0 or np.any(rotation[0, 1:]) or np.any(rotation[1:, 0]):
        return GENERAL
    return ABOUT_X if np.any(translation) or np.any(rotation != np.eye(3)) else NOTHING


@part
def allocate_scratch(blocks):
    """Return uninitialised rows of one block each, aligned to a cache line."""
    memory = np.empty(blocks * BLOCK + LANES)
    # As many doubles further as the next multiple of a vector's size.
    first = (-(memory.ctypes.data // 8)) % LANES
    return memory[first : first + blocks * BLOCK]


@part
def gather(source, start, count, n, rows, row):
    """Turn `count` samples of a sample-major array into n rows of a block.

    The last sample fills the rest.
    """
    for j in range(n):
        at = start * n + j
        if count == BLOCK:
            for sample in range(0, BLOCK, LANES):
                store(rows, (row + j) * BLOCK + sample, load_every(source, at + sample * n, n))
        else:
            for sample in range(BLOCK):
                rows[(row + j) * BLOCK + sample] = source[at + min(sample, count - 1) * n]


@part
def gather_states(q, qd, qdd, start, count, n, rows, row):
    """Turn `count` samples of the joints' motion into 3 n rows of a block.

    Positions, then rates, then accelerations.
    """
    gather(q, start, count, n, rows, row)
    gather(qd, start, count, n, rows, row + n)
    gather(qdd, start, count, n, rows, row + 2 * n)


@part
def trigonometry(rows, angle, cosine, sine):
    """Write cosine and sine of a row."""
    for at in range(0, BLOCK, LANES):
        x = load(rows, angle + at)
        s, c = sine_cosine(x)
        store(rows, sine + at, s)
        store(rows, cosine + at, c)
        # Rare: angles of thousands of turns are reduced one by one by the library.
        if exceeds(x, LARGEST_ANGLE):
            for sample in range(at, at + LANES):
                if abs(rows[angle + sample]) > LARGEST_ANGLE:
                    rows[sine + sample] = math.sin(rows[angle + sample])
                    rows[cosine + sample] = math.cos(rows[angle + sample])


@part
def vector(rows, at):
    """Return the x, y and z of a vector whose three rows start at `at`."""
    return load(rows, at), load(rows, at + BLOCK), load(rows, at + 2 * BLOCK)


@part
def put(rows, at, x, y, z):
    """Write a vector into three rows; the reverse of `vector`."""
    store(rows, at, x)
    store(rows, at + BLOCK, y)
    store(rows, at + 2 * BLOCK, z)


@part
def add(rows, at, x, y, z):
    """Add a vector to the one in three rows."""
    put(rows, at, load(rows, at) + x, load(rows, at + BLOCK) + y, load(rows, at + 2 * BLOCK) + z)


@part
def cross(ax, ay, az, bx, by, bz):
    """Return a x b."""
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


@part
def rotate_into(kind, p, o, x, y, z):
    """Return R^T v for the rotation at p[o:o+9]."""
    if kind == ABOUT_X:
        return x, y * p[o + 4] + z * p[o + 7], z * p[o + 8] + y * p[o + 5]
    return (
        x * p[o] + y * p[o + 3] + z * p[o + 6],
        x * p[o + 1] + y * p[o + 4] + z * p[o + 7],
        x * p[o + 2] + y * p[o + 5] + z * p[o + 8],
    )


@part
def rotate_out_of(kind, p, o, x, y, z):
    """Return R v for the rotation at p[o:o+9]."""
    if kind == ABOUT_X:
        return x, y * p[o + 4] + z * p[o + 5], z * p[o + 8] + y * p[o + 7]
    return (
        x * p[o] + y * p[o + 1] + z * p[o + 2],
        x * p[o + 3] + y * p[o + 4] + z * p[o + 5],
        x * p[o + 6] + y * p[o + 7] + z * p[o + 8],
    )


@part
def accelerate_point(wx, wy, wz, dx, dy, dz, ax, ay, az, tx, ty, tz):
    """Return a + dw x t + w x (w x t)."""
    cx, cy, cz = cross(wx, wy, wz, tx, ty, tz)
    ex, ey, ez = cross(wx, wy, wz, cx, cy, cz)
    gx, gy, gz = cross(dx, dy, dz, tx, ty, tz)
    return ax + gx + ex, ay + gy + ey, az + gz + ez


@part
def carry_motion(kind, p, o, x):
    """Return w, dw, a of a body that moves by x, at the frame at p[o:o+12] in it, in its axes.

    `a' = R^T (a + dw x t + w x (w x t))`, `w' = R^T w`, `dw' = R^T dw`; as all parts that carry
    something, of one sample in doubles or of eight in a vector.
    """
    if kind == NOTHING:
        return x
    wx, wy, wz, dx, dy, dz, ax, ay, az = x
    # a + dw x t + w x (w x t), at the frame's origin.
    ax, ay, az = accelerate_point(
        wx, wy, wz, dx, dy, dz, ax, ay, az, p[o + 9], p[o + 10], p[o + 11]
    )
    return (
        rotate_into(kind, p, o, wx, wy, wz)
        + rotate_into(kind, p, o, dx, dy, dz)
        + rotate_into(kind, p, o, ax, ay, az)
    )


@part
def turn_motion(c, s, v, dv, x):
    """Return w, dw, a behind a joint that has turned about z by an angle of cosine c and sine s.

    In turned axes `w' = w + v z`, `dw' = dw + w x v z + dv z`. Callers ask whether a joint turns or
    slides where they read rows: a product in another branch than its sum is rounded before it.
    """
    wx, wy, wz, dx, dy, dz, ax, ay, az = x
    # Rz^T of each vector.
    wx, wy = wx * c + wy * s, wy * c - wx * s
    dx, dy = dx * c + dy * s, dy * c - dx * s
    ax, ay = ax * c + ay * s, ay * c - ax * s
    # w x v z = v (wy, -wx, 0)
    return wx, wy, wz + v, dx + wy * v, dy - wx * v, dz + dv, ax, ay, az


@part
def slide_motion(q, v, dv, x):
    """Return w, dw, a behind a joint that has slid along z by q.

    `a' = a + dw x q z + w x (w x q z) + 2 w x v z + dv z`.
    """
    wx, wy, wz, dx, dy, dz, ax, ay, az = x
    # a + dw x q z + w x (w x q z)
    ax, ay, az = accelerate_point(wx, wy, wz, dx, dy, dz, ax, ay, az, 0.0, 0.0, q)
    # 2 w x v z = 2 v (wy, -wx, 0)
    v2 = v + v
    return wx, wy, wz, dx, dy, dz, ax + wy * v2, ay - wx * v2, az + dv


@part
def find_wrench(p, o, x):
    """Return force and moment about its origin that motion x of the link p[o:o+10] requires.

    `f = m a + dw x h + w x (w x h)`, `n = I dw + w x I w + h x a` (Newton and Euler).
    """
    wx, wy, wz, dx, dy, dz, ax, ay, az = x
    hx, hy, hz, m = p[o + 6], p[o + 7], p[o + 8], p[o + 9]
    # f = m a + dw x h + w x (w x h): a point at h whose origin accelerates by m a.
    f = accelerate_point(wx, wy, wz, dx, dy, dz, ax * m, ay * m, az * m, hx, hy, hz)
    # l = I w
    lx = wx * p[o] + wy * p[o + 1] + wz * p[o + 2]
    ly = wx * p[o + 1] + wy * p[o + 3] + wz * p[o + 4]
    lz = wx * p[o + 2] + wy * p[o + 4] + wz * p[o + 5]
    # w x I w
    gx, gy, gz = cross(wx, wy, wz, lx, ly, lz)
    # h x a
    ex, ey, ez = cross(hx, hy, hz, ax, ay, az)
    # n = I dw + w x I w + h x a
    return (
        *f,
        dx * p[o] + dy * p[o + 1] + dz * p[o + 2] + gx + ex,
        dx * p[o + 1] + dy * p[o + 3] + dz * p[o + 4] + gy + ey,
        dx * p[o + 2] + dy * p[o + 4] + dz * p[o + 5] + gz + ez,
    )


@part
def carry_wrench(kind, p, o, f):
    """Return a wrench at the frame at p[o:o+12] at its parent: `f' = R f`, `n' = R n + t x f'`."""
    if kind == NOTHING:
        return f
    # f' = R f, n' = R n + t x f'
    fx, fy, fz = rotate_out_of(kind, p, o, f[0], f[1], f[2])
    nx, ny, nz = rotate_out_of(kind, p, o, f[3], f[4], f[5])
    cx, cy, cz = cross(p[o + 9], p[o + 10], p[o + 11], fx, fy, fz)
    return fx, fy, fz, nx + cx, ny + cy, nz + cz


@part
def turn_wrench(c, s, f):
    """Return a wrench behind a joint that has turned as in front of it."""
    fx, fy, fz, nx, ny, nz = f
    return fx * c - fy * s, fy * c + fx * s, fz, nx * c - ny * s, ny * c + nx * s, nz


@part
def slide_wrench(q, f):
    """Return a wrench behind a joint that has slid as in front of it."""
    # n' = n + q z x f
    fx, fy, fz, nx, ny, nz = f
    return fx, fy, fz, nx - fy * q, ny + fx * q, nz


@part
def carry_screw(kind, p, o, screw):
    """Return a screw (z, m) at the frame at p[o:o+12], in its axes: `R^T z`, `R^T (m + z x t)`."""
    if kind == NOTHING:
        return screw
    # R^T (m + z x t)
    zx, zy, zz, mx, my, mz = screw
    cx, cy, cz = cross(zx, zy, zz, p[o + 9], p[o + 10], p[o + 11])
    # m before z: the order decides which product the compiler joins with which sum
    mx, my, mz = rotate_into(kind, p, o, mx + cx, my + cy, mz + cz)
    zx, zy, zz = rotate_into(kind, p, o, zx, zy, zz)
    return zx, zy, zz, mx, my, mz


@part
def rest(rows, gravity):
    """Fill slot 0: the root stands still and accelerates against free fall."""
    for at in range(0, BLOCK, LANES):
        for j in range(6):
            store(rows, j * BLOCK + at, splat(0.0))
        # Free fall is an acceleration: its negative at the root stands for gravity everywhere.
        for j in range(3):
            store(rows, (6 + j) * BLOCK + at, splat(-gravity[j]))


@part
def read_six(rows, at):
    """Return the six rows at `at` of two vectors, as of a screw (z, m) or a wrench (f, n)."""
    return vector(rows, at) + vector(rows, at + 3 * BLOCK)


@part
def read_nine(rows, at):
    """Return the nine rows at `at` of three vectors, as of a motion (w, dw, a)."""
    return read_six(rows, at) + vector(rows, at + 6 * BLOCK)


@part
def put_six(rows, at, screw):
    """Write the first two vectors of a tuple into six rows; the reverse of `read_six`."""
    put(rows, at, screw[0], screw[1], screw[2])
    put(rows, at + 3 * BLOCK, screw[3], screw[4], screw[5])


@part
def move_link(code, p, rows, read, write, angle, rate, change, cosine, sine):
    """Carry w, dw, a from the parent's slot to the link's; positions in `rows` are of doubles."""
    for at in range(0, BLOCK, LANES):
        x = carry_motion(code[BEFORE], p, 0, read_nine(rows, read + at))
        v, dv = load(rows, rate + at), load(rows, change + at)
        if code[REVOLUTE]:
            x = turn_motion(load(rows, cosine + at), load(rows, sine + at), v, dv, x)
        else:
            x = slide_motion(load(rows, angle + at), v, dv, x)
        x = carry_motion(code[AFTER], p, 12, x)
        put_six(rows, write + at, x)
        put(rows, write + at + 6 * BLOCK, x[6], x[7], x[8])


@part
def carry_screw_rows(code, p, rows, read, angle, cosine, sine):
    """Return a screw of the parent link in the axes behind the joint of a link."""
    zx, zy, zz, mx, my, mz = carry_screw(code[BEFORE], p, 0, read_six(rows, read))
    if code[REVOLUTE]:
        c, s = load(rows, cosine), load(rows, sine)
        # Rz^T z, Rz^T m
        return zx * c + zy * s, zy * c - zx * s, zz, mx * c + my * s, my * c - mx * s, mz
    q = load(rows, angle)
    # m + z x q e_z
    return zx, zy, zz, mx + zy * q, my - zx * q, mz


@part
def move_screws(code, p, rows, read, write, angle, cosine, sine):
    """Carry the screws of all joints above to the link's slot and add its own joint's screw."""
    none, one = splat(0.0), splat(1.0)
    for d in range(code[DEPTH] + 1):
        o = (STATE + 6 * d) * BLOCK
        for at in range(0, BLOCK, LANES):
            if d < code[DEPTH]:
                screw = carry_screw_rows(
                    code, p, rows, read + o + at, angle + at, cosine + at, sine + at
                )
            # A unit rate turns about z, or moves along it.
            elif code[REVOLUTE]:
                screw = none, none, one, none, none, none
            else:
                screw = none, none, none, none, none, one
            put_six(rows, write + o + at, carry_screw(code[AFTER], p, 12, screw))
