"""The best poses to stand still in: gravity parameters without any motion."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import minimize

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import find_base_parameters
from asbuilt.dynamics.drives.selection import NO_DRIVE, DriveSet
from asbuilt.errors import MotionError, UsageError
from asbuilt.excitation.collision.constraint import told_constraints
from asbuilt.excitation.design.interior_point import StateConstraint
from asbuilt.excitation.design.route import Roadmap, travel_through, ways_clear
from asbuilt.excitation.design.torque_limit import STANDING, TorqueLimit, WeightLimit
from asbuilt.excitation.information.criteria import DOptimality
from asbuilt.excitation.information.information import Information
from asbuilt.excitation.limits import LimitReport, MotionBounds, check_motion
from asbuilt.excitation.motions.motion import read_only
from asbuilt.excitation.motions.pacing import CHECK_RATE
from asbuilt.excitation.motions.point_to_point import PointToPointMotion
from asbuilt.excitation.state_bounds import limited_model

CANDIDATES = 2000
"""Random poses to choose among."""
EXCHANGES = 12
"""Rounds of exchange at most."""
SMALLEST_EIGENVALUE = 1e-9
"""Directions of the parameters whose information over random poses is below this fraction of the
largest are not told by gravity.
"""

BARRED = 0.2
"""Angles [rad] of a joint without any admissible pose among the candidates count as barred from
this width on.
"""

REFINEMENT_STEPS = 60
"""Steps of the climb of all poses together."""
DWELL = 1.0
"""Rest at each pose [s]."""


@dataclass(frozen=True, eq=False)
class StaticDesign:
    """Hold K poses (K, n) in the order in which they are visited, the motion through them, and what
    they tell.

    `n_parameters` is the number of combinations of base parameters that gravity tells; `log_det`,
    `condition_number` and `scaled_condition_number` refer to these, one torque reading per pose,
    noise included. The motion turns at `turns` further poses where the straight way between two is
    not clear; `collision_distance` is the smallest distance on the way [m], None where nothing was
    watched.
    """

    model: RobotModel
    poses: Array
    motion: PointToPointMotion
    n_parameters: int
    log_det: float
    condition_number: float
    scaled_condition_number: float
    travel: float
    limits: LimitReport
    turns: int
    collision_distance: float | None
    solve_seconds: float
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "poses", read_only(self.poses))


def design_static_poses(
    model: RobotModel,
    count: int,
    *,
    drive: DriveSet = NO_DRIVE,
    noise: ArrayLike = 1.0,
    fraction: float = 0.95,
    torque_fraction: float = 0.8,
    constraints: Sequence[StateConstraint] = (),
    dwell: float = DWELL,
    seed: int = 0,
) -> StaticDesign:
    """Return the D-optimal poses for the parameters that gravity tells, ordered for short travel.

    Exchange (Fedorov 1972) among random admissible poses, then a climb of all poses together within
    the limits; then a short tour through them that keeps the `constraints` on the way, too, and
    stays clear of poses in which the robot is too heavy for its drives. `drive` may hold an offset.

    Raises
    ------
    UsageError
        If there are fewer poses than needed, or the robot carries no weight.
    MotionError
        If no pose is admissible, or there is no way from one to another.
    """
    begin = time.monotonic()
    rng = np.random.default_rng([seed, 11])
    base = find_base_parameters(model, drive)
    information = Information.of(model, base, noise)
    bounds = MotionBounds.assumed(model, fraction)
    torque = torque_fraction * MotionBounds.of(model).torque
    loads: list[StateConstraint] = (
        [TorqueLimit((model,), torque)] if np.any(np.isfinite(torque)) else []
    )
    weight = [WeightLimit((model,), STANDING * torque)] if loads else []
    everywhere = rng.uniform(bounds.lower, bounds.upper, size=(CANDIDATES, model.n_joints))
    barriers = [*constraints, *(limit for limit in weight if limit.binds(everywhere))]
    pool = _admissible(barriers, everywhere)
    if len(pool) < 2:
        raise MotionError(
            f"{model.name}: no pose within the torque limits and clear of obstacles was found among"
            f" {CANDIDATES}"
        )
    pool = _unwound(model, bounds, pool)
    roadmap = Roadmap.of(pool, bounds, barriers) if barriers else None
    pool = pool if roadmap is None else roadmap.stations
    told = _told(information, pool)
    p = told.shape[1]
    if p == 0:
        raise UsageError(
            f"gravity moves no joint of {model.name} as it is mounted, so poses at rest tell"
            " nothing"
        )
    least = -(-p // model.n_joints)
    if count < max(2, least):
        raise UsageError(
            f"gravity tells {p} parameters of {model.name}; that takes at least {max(2, least)}"
            f" poses, got {count}"
        )
    poses = pool[_exchanged(_pose_rows(information, pool, told), count)]
    poses = _refined(information, told, bounds, [*constraints, *weight], barriers, poses)
    travel = travel_through(poses, roadmap, bounds, barriers, loads, dwell)
    poses, motion = travel.poses, travel.motion
    total = _information(information, told, poses)
    size = 1.0 / np.sqrt(np.diag(total))
    limited, _ = limited_model(model)
    visited = motion.at(motion.sample_times(CHECK_RATE))[0]
    distances = [
        constraint.smallest_distance(visited)
        for constraint in constraints
        if hasattr(constraint, "smallest_distance")
    ]
    return StaticDesign(
        model=model,
        poses=poses,
        motion=motion,
        n_parameters=p,
        log_det=DOptimality().value(total),
        condition_number=float(np.sqrt(np.linalg.cond(total))),
        scaled_condition_number=float(np.sqrt(np.linalg.cond(total * np.outer(size, size)))),
        travel=motion.duration - dwell * (count - 2),
        limits=check_motion(limited, motion),
        turns=travel.turns,
        collision_distance=min(distances, default=None),
        solve_seconds=time.monotonic() - begin,
        notes=told_constraints(constraints, visited),
    )


def _admissible(watch: Sequence[StateConstraint], poses: Array) -> Array:
    rest = np.zeros_like(poses)
    fine = np.ones(len(poses), dtype=bool)
    for constraint in watch:
        values = constraint.values(poses, rest, rest)
        fine &= (np.abs(values) if constraint.two_sided else values).max(axis=1) < 1
    return poses[fine]


def _pose_rows(information: Information, poses: Array, told: Array) -> Array:
    """Return the weighted rows of each pose in the coordinates that gravity tells, (N, n, p)."""
    rest = np.zeros_like(poses)
    rows = information.rows(poses, rest, rest, smooth=False)
    whole = np.zeros((len(poses), information.model.n_joints, information.n_parameters))
    plan = information.plan
    for k, (support, (first, stop)) in enumerate(
        zip(plan.support, plan.bounds.tolist(), strict=True)
    ):
        whole[:, k, support] = rows[first:stop, : len(poses)].T / information.noise[k]
    return np.asarray(whole @ told)


def _told(information: Information, poses: Array) -> Array:
    """Return an orthonormal basis (p_base, p) of the combinations of base parameters that gravity
    tells.
    """
    rows = _pose_rows(information, poses, np.eye(information.n_parameters))
    eigenvalues, vectors = np.linalg.eigh(np.einsum("ski,skj->ij", rows, rows))
    return np.asarray(
        vectors[
            :, eigenvalues > SMALLEST_EIGENVALUE * max(float(eigenvalues[-1]), np.finfo(float).tiny)
        ]
    )


def _information(information: Information, told: Array, poses: Array) -> Array:
    rows = _pose_rows(information, poses, told)
    return np.asarray(np.einsum("ski,skj->ij", rows, rows))


def _exchanged(rows: Array, count: int) -> list[int]:
    """Return the indices of a D-optimal subset: greedy, then exchanged one by one while that pays."""
    p = rows.shape[2]
    small = 1e-6 * float(np.einsum("ski,ski->", rows, rows)) / len(rows) / p * np.eye(p)

    def gains(matrix: Array) -> Array:
        added = np.eye(rows.shape[1]) + rows @ np.linalg.solve(
            matrix, np.swapaxes(rows, 1, 2).reshape(len(rows), p, -1)
        )
        return np.asarray(np.linalg.slogdet(added)[1])

    chosen: list[int] = []
    matrix = small.copy()
    for _ in range(count):
        best = int(np.argmax(gains(matrix)))
        chosen.append(best)
        matrix = matrix + rows[best].T @ rows[best]
    for _ in range(EXCHANGES):
        changed = False
        for place in range(count):
            without = matrix - rows[chosen[place]].T @ rows[chosen[place]]
            best = int(np.argmax(gains(without)))
            if best != chosen[place]:
                chosen[place], changed = best, True
            matrix = without + rows[chosen[place]].T @ rows[chosen[place]]
        if not changed:
            break
    return chosen


def _refined(
    information: Information,
    told: Array,
    bounds: MotionBounds,
    watch: Sequence[StateConstraint],
    obstacles: Sequence[StateConstraint],
    poses: Array,
) -> Array:
    """Climb all poses together within the position limits.

    Poses that become inadmissible, or leave where they can be reached, go back.
    """
    middle, half = (bounds.upper + bounds.lower) / 2, (bounds.upper - bounds.lower) / 2

    def negative(x: Array) -> tuple[float, Array]:
        q = middle + half * x.reshape(poses.shape)
        rest = np.zeros_like(q)
        value, gradient = DOptimality().value_and_gradient(_information(information, told, q))
        if not np.isfinite(value):
            return 1e12, np.zeros_like(x)
        rows = information.rows(q, rest, rest)
        slope = information.state_gradient(q, rest, rest, rows, told @ gradient @ told.T)[0]
        return -value, -(slope * half).reshape(-1)

    start = ((poses - middle) / half).reshape(-1)
    found = minimize(
        negative,
        start,
        jac=True,
        method="L-BFGS-B",
        bounds=[(-1, 1)] * start.size,
        options={"maxiter": REFINEMENT_STEPS},
    )
    moved = middle + half * found.x.reshape(poses.shape)
    for k in range(len(moved)):
        straight = (
            bool(ways_clear(np.stack([poses[k], moved[k]]), [(0, 1)], obstacles)[0])
            if obstacles
            else True
        )
        if not straight or not len(_admissible(watch, moved[k : k + 1])):
            moved[k] = poses[k]
    better = DOptimality().value(_information(information, told, moved)) >= DOptimality().value(
        _information(information, told, poses)
    )
    return moved if better else poses


def _unwound(model: RobotModel, bounds: MotionBounds, pool: Array) -> Array:
    """Return poses with whole turns added or taken off, where the limits allow it, so that joints
    stay near the middle of where they can go.

    That is opposite to angles at which none of the poses is, else the middle of the range.
    """
    angles = np.sort(np.mod(pool, 2 * np.pi), axis=0)
    gaps = np.diff(np.vstack([angles, angles[:1] + 2 * np.pi]), axis=0)
    widest = np.argmax(gaps, axis=0)
    joints = np.arange(model.n_joints)
    opposite = angles[widest, joints] + gaps[widest, joints] / 2 + np.pi
    centre = (bounds.upper + bounds.lower) / 2
    opposite -= 2 * np.pi * np.round((opposite - centre) / (2 * np.pi))
    middle = np.where(gaps[widest, joints] > BARRED, opposite, centre)
    near = pool - 2 * np.pi * np.round((pool - middle) / (2 * np.pi))
    near += 2 * np.pi * ((near < bounds.lower).astype(float) - (near > bounds.upper))
    fits = (
        (near > bounds.lower)
        & (near < bounds.upper)
        & [joint.is_revolute for joint in model.joints]
    )
    return np.where(fits, near, pool)
