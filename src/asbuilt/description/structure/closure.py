"""Closed chains: `q_tree = f(q)` of motors by the equations of loops, and `G = df/dq`."""

# mypy: allow-untyped-calls

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache, wraps
from typing import ClassVar, Concatenate, TypeVar

import numpy as np

from asbuilt.arrays import Array, Indices, Mask, read_only
from asbuilt.description.structure.closure_kernel import (
    FARTHEST,
    SEARCH,
    SINGULAR,
    STRIDE,
    close_loops,
    move_tree,
)
from asbuilt.description.structure.couplings import derive_linear_part
from asbuilt.description.structure.joint_map import JointMap, ShareDerivatives, TreeMotion
from asbuilt.description.structure.locking import choose_usual_position
from asbuilt.description.structure.loop_equations import loop_equations
from asbuilt.description.structure.loops import (
    JOINT,
    ROWS,
    SIZE,
    Loop,
    LoopNumbers,
    number_loops,
)
from asbuilt.description.structure.parts import ROOT, Joint
from asbuilt.description.structure.robot import RobotParts
from asbuilt.errors import DescriptionError, MotionError
from asbuilt.findings import Cure, join_names

CLOSED = 1e-4
"""Largest gap of a loop at the first posture, in its size or rad: numbers of four digits."""
KEPT = 10.0
"""Factor by which the gap may grow from there."""
ROUNDING = 1e-9
"""Gap that rounding may leave, and share of a motor's motion that tears a loop."""
EXAMPLES = 16
"""Postures about the first from which it follows which motors move which joints."""
NEAR = 0.3
"""How far they are from it [rad, or share of a loop's size]."""
SEEN = 1e-6
"""Singular values below this share of the derivative of the loops count as none."""
DIFFERENCE = 1e-5
"""Half width of central differences [rad, or share of a loop's size]: cube root of rounding."""
UNMOVED = 1e-9
"""Share below which a motor does not move a joint."""
SEED = 26
TRIALS = 20
"""Batches of random postures after which a mechanism counts as one without room to move."""
REGULAR = 0.02
"""Distance to a singular posture from which on rates of passive joints are of usual size."""
REMEMBERED = 4
"""Batches of states whose motion is remembered: torques, columns of parameters and the derivatives
of both are asked for at the same states."""
LARGEST_REMEMBERED = 1 << 20
"""Size of a batch of states beyond which it is not remembered, for memory [bytes]."""


@dataclass(frozen=True, eq=False)
class Postures:
    """Hold how well loops close at N positions of the motors.

    `gap` (N,) is the largest distance [m] (angle [rad] for joints) that stays open, `closed` (N,)
    whether that is within tolerance, and `distance` (N,) the smallest singular value of the
    derivative by passive joints, relative to the largest: 0 at a singular posture.
    """

    gap: Array
    closed: Mask
    distance: Array


Found = TypeVar("Found")


def _remember(
    method: Callable[Concatenate[Closure, ...], Found],
) -> Callable[Concatenate[Closure, ...], Found]:
    """Let a method of arrays (N, n_joints) remember what it found for the last ones."""

    @lru_cache(maxsize=REMEMBERED)
    def find(closure: Closure, *states: bytes) -> Found:
        return method(closure, *(np.frombuffer(x).reshape(-1, closure.n_joints) for x in states))

    @wraps(method)
    def remembered(closure: Closure, *states: Array) -> Found:
        arrays = [np.ascontiguousarray(x, dtype=np.float64) for x in states]
        if sum(x.nbytes for x in arrays) > LARGEST_REMEMBERED:
            return method(closure, *arrays)
        return find(closure, *(x.tobytes() for x in arrays))

    return remembered


@dataclass(frozen=True, eq=False)
class Closure(JointMap):
    """Say how motors move the joints of all links where loops place some of them.

    The joints of the tree, links in `order`, are at `linear @ (q, p) + offset` for motors q and
    passive joints p, which the loops place. `home` (n + n_passive,) is the posture from which
    assembly modes are kept. `of_links` (n_links, n_joints) are typical sizes of G by link, 0 where
    a motor does not move a joint.
    """

    robot: str
    loops: tuple[Loop, ...]
    names: tuple[str, ...]
    order: Indices
    linear: Array
    offset: Array
    numbers: LoopNumbers
    arrays: tuple[Array | Indices, ...]
    scale: Array
    home: Array
    tolerance: float
    of_links: Array

    # Every state is a solution of the loops' equations.
    work: ClassVar[int] = 1500

    @property
    def n_joints(self) -> int:
        """Number of motors."""
        return int(self.of_links.shape[1])

    def motion(self, q: Array, qd: Array | None = None, qdd: Array | None = None) -> TreeMotion:
        """Return the motion of the joints of the tree for motors (N, n); rates not given are zero.

        Raises `MotionError` where the loops do not close, or a posture is singular.
        """
        still = np.zeros_like(q)
        return self._follow(q, still if qd is None else qd, still if qdd is None else qdd)

    @_remember
    def _follow(self, q: Array, qd: Array, qdd: Array) -> TreeMotion:
        postures, quality = self._close(q)
        failed = np.flatnonzero(quality[:, 2] == 0.0)
        if failed.size:
            raise self._make_error(q, int(failed[0]), failed.size, quality[failed[0], 1])
        return self._move(postures, qd, qdd)

    @_remember
    def derivatives(self, q: Array, qd: Array, qdd: Array) -> ShareDerivatives:
        """Return derivatives of `motion` at states (N, n).

        `qdd_tree - G qdd` is a quadratic form of velocities with the second derivatives of f as its
        matrix, so that these are exact differences of it. The third ones are central differences.
        """
        n = self.n_joints
        postures, _ = self._close(q)
        still = np.zeros_like(q)
        units = np.repeat(np.eye(n)[:, None], len(q), axis=1)
        # Polarisation: f(e_j + e_k) - f(e_j) - f(e_k) is twice the mixed derivative.
        singles = [self._move(postures, unit, still) for unit in units]
        alone = [motion.qdd for motion in singles]
        # du/dq, as joints of the tree are at A u + b.
        tangents = np.linalg.pinv(self.linear) @ singles[0].shares
        second = np.empty((*alone[0].shape, n, n))
        for j in range(n):
            second[..., j, j] = alone[j]
            for k in range(j):
                both = self._move(postures, units[j] + units[k], still).qdd
                second[..., j, k] = second[..., k, j] = 0.5 * (both - alone[j] - alone[k])
        position = np.empty((*alone[0].shape, n))
        for j, step in enumerate(DIFFERENCE * self.scale[:n]):
            # Third derivatives have no closed form here; half width is the cube root of rounding.
            # What the loops open along the tangent is the same on both sides.
            ahead, behind = (
                self._move(postures + by * tangents[..., j], qd, qdd).qdd for by in (step, -step)
            )
            position[..., j] = (ahead - behind) / (2.0 * step)
        return ShareDerivatives(second, np.einsum("sijk,sk->sij", second, qd), position)

    @property
    def first_posture(self) -> Array:  # type: ignore[override]
        """Positions of the motors (n_joints,) at the posture of the description."""
        return self.home[: self.n_joints]

    def exists(self, q: Array) -> Mask:
        """Return at which positions of the motors (N, n_joints) the loops close."""
        return self.postures(q).closed

    def draw(self, lower: Array, upper: Array, rng: np.random.Generator, count: int) -> Array:
        """Return positions at which the loops close, away from singular postures.

        Limits of a motor often reach farther. Raises `DescriptionError` where there are none.
        """
        home = self.first_posture
        reach = np.pi * self.scale[: self.n_joints]
        lower = np.maximum(lower, home - reach)
        upper = np.minimum(upper, home + reach)
        found = np.empty((0, self.n_joints))
        for trial in range(TRIALS):
            # Nearer to the first posture, the longer it takes.
            width = 1.0 - trial / TRIALS
            q = home + width * (rng.uniform(lower, upper, (count, self.n_joints)) - home)
            at = self.postures(q)
            found = np.vstack([found, q[at.closed & (at.distance > REGULAR)]])
            if len(found) >= count:
                return found[:count]
        raise DescriptionError(
            f"{self.robot}: of {TRIALS * count} random postures of the motors the loops close at"
            f" {len(found)}; give limits within which they do"
        )

    def postures(self, q: Array) -> Postures:
        """Return how well the loops close at positions of the motors (N, n)."""
        postures, quality = self._close(q)
        closed = quality[:, 2] > 0.0
        gap = quality[:, 0].copy()
        distance = np.zeros(len(q))
        n = self.n_joints
        for k in np.flatnonzero(closed):
            # The smallest singular value, in units in which angles and lengths compare.
            equations = self.equations(postures[k])
            gap[k] = max(self.gaps(equations))
            # The last columns are phi and the bias; the first n are of motors.
            sizes = np.linalg.svd(equations[:, n:-2] * self.scale[n:], compute_uv=False)
            distance[k] = sizes[-1] / sizes[0]
        return Postures(gap, closed, distance)

    def equations(self, u: Array) -> Array:
        """Return J and phi (rows, n_u + 2) at coordinates u, the last column zero."""
        found = np.zeros((sum(ROWS[kind] for kind in self.numbers.kinds.tolist()), u.size + 2))
        loop_equations(*self.arrays, np.ascontiguousarray(u), found)
        return found

    def gaps(self, equations: Array) -> list[float]:
        """Return the gap of each loop [m, rad for joints]."""
        gaps = []
        row = 0
        for kind, given in zip(self.numbers.kinds.tolist(), self.numbers.numbers, strict=True):
            count = ROWS[kind]
            size = 1.0 if kind == JOINT else float(given[SIZE])
            gaps.append(size * float(np.abs(equations[row : row + count, -2]).max()))
            row += count
        return gaps

    def moves_loops(self, motor: int) -> bool:
        """Return whether a motor moves a joint that loops place."""
        loops = set(self.order[self.numbers.joints].tolist())
        return bool(np.any(self.of_links[sorted(loops), motor]))

    @_remember
    def _close(self, q: Array) -> tuple[Array, Array]:
        """Return postures (N, n_u) and quality (N, 3) of motors (N, n), as of `close_loops`."""
        order = _choose_order(q / self.scale[: self.n_joints])
        postures, quality = (part[np.argsort(order)] for part in _run(self, q[order]))
        return read_only(postures), read_only(quality)

    def _move(self, postures: Array, qd: Array, qdd: Array) -> TreeMotion:
        """Return the motion of the joints of the tree in closed postures (N, n_u)."""
        samples = len(postures)
        n_tree = len(self.linear)
        q_tree, rates, accelerations = (np.empty((samples, n_tree)) for _ in range(3))
        shares = np.empty((samples, n_tree, self.n_joints))
        move_tree(*self.arrays, postures, qd, qdd, q_tree, rates, accelerations, shares)
        for array in (q_tree, rates, accelerations, shares):
            array.setflags(write=False)
        return TreeMotion(q_tree, rates, accelerations, shares)

    def _make_error(self, q: Array, sample: int, count: int, pivot: float) -> MotionError:
        """Return the error for a posture that does not close."""
        moving = [k for k in range(self.n_joints) if self.moves_loops(k)]
        at = join_names([f"{self.names[k]} = {q[sample, k]:.6g}" for k in moving], len(moving))
        what = (
            "is singular: motors do not place all passive joints"
            if pivot <= SINGULAR
            else "closes no loop: out of reach, or beyond a singular posture"
        )
        more = f", and {count - 1} more" if count > 1 else ""
        return MotionError(
            f"{self.robot}: the posture at {at} (sample {sample}{more}) {what}",
            cure=Cure(
                "keep the motors where the loops close (limits), or correct zero positions, points"
                " of the loops and the posture of the description"
            ),
            sample=sample,
            joint=self.names[moving[0]],
        )


def _run(closure: Closure, q: Array, *, search: bool = False) -> tuple[Array, Array]:
    """Return postures (N, n_u) and quality (N, 3) of motors (N, n), as of `close_loops`."""
    u = closure.home
    postures = np.empty((len(q), u.size))
    quality = np.empty((len(q), 3))
    close_loops(*closure.arrays, closure.scale, u, closure.tolerance, search, q, postures, quality)
    return postures, quality


def _choose_order(q: Array) -> Indices:
    """Return an order of positions (N, n) in which they follow each other closely.

    As given where they are a motion; random ones are sorted by the motor that goes farthest.
    """
    given = np.arange(len(q))
    steps = np.abs(np.diff(q, axis=0))
    way = float(steps.max(axis=1).sum())
    if way <= STRIDE * len(q):
        return given
    by_motor = np.argsort(q[:, np.argmax(steps.sum(axis=0))], kind="stable")
    sorted_way = float(np.abs(np.diff(q[by_motor], axis=0)).max(axis=1).sum())
    return by_motor if sorted_way < way else given


def derive_closure(model: RobotParts) -> Closure:
    """Return how motors move the joints of all links of a robot through its loops.

    They are closed at its posture, roughly, joints that it does not name being where they usually
    are. Raises `DescriptionError` where the loops do not close, leave a passive joint free, or are
    torn by a motor.
    """
    n = model.n_joints
    found = _open(model)
    # The first posture is a guess: Newton may go far, and nothing is within a tolerance yet.
    (home,), quality = _run(found, found.home[None, :n].copy(), search=True)
    _check_closed(found, home, quality[0])
    # Numbers of a description are rounded: their own gap, and some more, is closed.
    found = replace(found, home=home, tolerance=max(ROUNDING, KEPT * float(quality[0, 0])))
    return _derive_typical_shares(found)


def _open(model: RobotParts) -> Closure:
    """Return a closure that has not been closed yet, at the posture of the description."""
    robot = model.name
    n = model.n_joints
    every = model.moving_joints
    posture = model.posture
    order, linear, offset = derive_linear_part(model)
    place = {int(link): k for k, link in enumerate(order)} | {ROOT: ROOT}
    tree, _, _ = model.in_tree_order()
    in_tree = {name: (place[link], pose) for name, (link, pose) in model.places.items()}
    numbers = number_loops(robot, model.loops, tree, in_tree)
    coordinates = [*every[:n], *(joint for joint in every[n:] if joint.is_passive)]
    known = {joint.name for joint in every} | {joint.name_in_tree for joint in every}
    if unknown := sorted(posture.keys() - known):
        raise DescriptionError(
            f"{robot}: the posture names joint {unknown[0]!r}, which does not exist; the joints are"
            f" {', '.join(joint.name for joint in every)}"
        )
    home = np.array(
        [
            posture.get(
                joint.name, posture.get(joint.name_in_tree, choose_usual_position(joint.limits))
            )
            for joint in coordinates
        ]
    )
    # Lengths count in sizes of the largest loop.
    sizes = np.where(numbers.kinds == JOINT, 0.0, numbers.numbers[:, SIZE])
    size = float(sizes.max(initial=0.0)) or 1.0
    scale = np.array([1.0 if joint.is_revolute else size for joint in coordinates])
    # Sparse rows of A: where each joint's coordinates begin.
    first = np.concatenate([[0], np.cumsum(np.count_nonzero(linear, axis=1))]).astype(np.int64)
    at, column = np.nonzero(linear)
    sources = np.column_stack([column.astype(np.float64), linear[at, column]])
    arrays = (
        numbers.kinds,
        numbers.paths,
        numbers.numbers,
        np.array(
            [
                np.concatenate([side[part].ravel() for side in (joint.before, joint.after)
                                for part in (np.s_[:3, :3], np.s_[:3, 3])])
                for joint in tree
            ]
        ),
        np.array([joint.is_revolute for joint in tree]),
        sources,
        first,
        offset,
    )  # fmt: skip
    # Kernels share these arrays between threads.
    for array in (*arrays, order, linear, scale):
        array.setflags(write=False)
    return Closure(
        robot,
        model.loops,
        tuple(joint.name for joint in coordinates),
        order,
        linear,
        offset,
        numbers,
        arrays,
        scale,
        home,
        np.inf,
        np.zeros((len(tree), n)),
    )


def _check_closed(found: Closure, u: Array, quality: Array) -> None:
    """Raise `DescriptionError` where the loops stay open, or leave a passive joint free."""
    n = found.n_joints
    robot = found.robot
    equations = found.equations(u)
    gaps = found.gaps(equations)
    # Gaps that are not finite come from a walk that left the loop.
    if np.abs(equations[:, -2]).max() > CLOSED or not np.isfinite(gaps).all():
        worst = int(np.argmax(gaps))
        kind = found.numbers.kinds[worst]
        gap = f"{gaps[worst]:.3g} rad" if kind == JOINT else f"{1e3 * gaps[worst]:.3g} mm"
        raise DescriptionError(
            f"{robot}: the {found.loops[worst]} does not close: a gap of {gap} stays at the first"
            f" posture ({_format_posture(found, u)}); check lengths and points, or give a posture"
            " nearer to a closed one",
            gap=gaps[worst],
        )
    if quality[2] > 0.0:
        return
    # Away from the first posture, which may be singular by accident.
    away = u + np.random.default_rng(SEED).uniform(-NEAR, NEAR, u.size) * found.scale
    sizes, free = _find_free_directions(found.equations(away)[:, n:-2] * found.scale[n:])
    if sizes:
        names = [found.names[n + k] for k in free]
        raise DescriptionError(
            f"{robot}: the loops leave passive joints free ({join_names(names, len(names))}): the"
            f" chains have {sizes} freedom{'s' if sizes > 1 else ''} more than motors; name a joint"
            " of them that has a motor, or another loop"
        )
    raise DescriptionError(
        f"{robot}: the first posture ({_format_posture(found, u)}) is singular: there the motors"
        " do not place all passive joints; give a posture away from it"
    )


def _find_free_directions(J: Array) -> tuple[int, list[int]]:
    """Return the number of directions that J does not see, and the columns that take part."""
    _, sizes, rows = np.linalg.svd(J)
    # Rows beyond the rank span what J does not see.
    null = rows[int(np.sum(sizes > ROUNDING * sizes.max(initial=0.0))) :]
    return len(null), np.flatnonzero(np.abs(null).max(axis=0, initial=0.0) > SEEN).tolist()


def _format_posture(found: Closure, u: Array) -> str:
    return ", ".join(f"{name} = {value:.4g}" for name, value in zip(found.names, u, strict=True))


def _derive_typical_shares(found: Closure) -> Closure:
    """Return the closure with typical sizes of G, from postures about the first.

    Raises `DescriptionError` where a motor tears the loops.
    """
    n = found.n_joints
    rng = np.random.default_rng(SEED)
    around = rng.uniform(-NEAR, NEAR, (EXAMPLES, n)) * found.scale[:n]
    q = np.vstack([found.home[:n], found.home[:n] + around])
    postures, quality = found._close(q)
    good = quality[:, 2] > 0.0
    if np.count_nonzero(good) < 2:
        # A mechanism with little room closes only next to the first posture.
        small = 1e-3 * around
        postures, quality = found._close(found.home[:n] + small)
        good = quality[:, 2] > 0.0
    _check_motors(found)
    still = np.zeros((np.count_nonzero(good), n))
    examples = found._move(postures[good], still, still).shares
    shares = np.sqrt(np.mean(examples**2, axis=0))
    # Constant shares are kept to the last digit, so that linear couplings stay exact.
    shares = np.where(np.ptp(examples, axis=0) < UNMOVED, examples[0], shares)
    shares[np.abs(shares) < UNMOVED] = 0.0
    return replace(found, of_links=read_only(shares[np.argsort(found.order)]))


def _check_motors(found: Closure) -> None:
    """Raise `DescriptionError` where the loops do not let motors move one by one."""
    n = found.n_joints
    J = found.equations(found.home)[:, :-2] * found.scale
    # Passive joints follow by least squares; what is left is torn.
    moves = -np.linalg.lstsq(J[:, n:], J[:, :n], rcond=None)[0]
    torn = np.linalg.norm(J[:, :n] + J[:, n:] @ moves, axis=0)
    at = np.flatnonzero(torn > SEEN * float(np.linalg.norm(J, axis=0).max()))
    if at.size:
        names = [found.names[k] for k in at]
        raise DescriptionError(
            f"{found.robot}: the loops do not let {join_names(names, len(names))} move: more motors"
            " than the chains have freedoms; name the joints that have no motor as passive"
        )


def find_passive_joints(model: RobotParts) -> list[str]:
    """Return joints of loops that have no motor, where the description does not name them.

    As many as the loops place: joints without limits of torque and drive first, then those far from
    the root, as long as the loops determine them.
    """
    found = _open(model)
    joints = model.joints
    u = found.home.copy()
    # No joint is known to be passive yet, so that all may move.
    for _ in range(SEARCH):  # Newton with the least motion of all joints
        equations = found.equations(u)
        step = np.linalg.lstsq(equations[:, :-2] * found.scale, equations[:, -2], rcond=1e-8)[0]
        # Short steps keep the assembly mode of the description.
        u -= found.scale * step * min(1.0, FARTHEST / max(float(np.abs(step).max()), ROUNDING))
    J = found.equations(u)[:, :-2] * found.scale
    rank = int(np.linalg.matrix_rank(J, tol=SEEN * np.linalg.norm(J)))
    depth = {int(link): k for k, link in enumerate(found.order)}
    chosen: list[int] = []
    # Undriven ones first, then those far from the root.
    for k in sorted(range(len(joints)), key=lambda k: (_is_driven(joints[k]), -depth[k])):
        taken = J[:, [*chosen, k]]
        # Only a joint that adds to the rank is determined with those before.
        if len(chosen) < rank and np.linalg.matrix_rank(taken, tol=SEEN) == len(chosen) + 1:
            chosen.append(k)
    return [joints[k].name for k in sorted(chosen)]


def _is_driven(joint: Joint) -> bool:
    """Return whether the description gives a joint a drive."""
    drive = joint.drive
    stated = drive.gear_ratio is not None or drive.kp is not None or bool(drive.armature)
    return stated or bool(np.isfinite(joint.limits.torque))
