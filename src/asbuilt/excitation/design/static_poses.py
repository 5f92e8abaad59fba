"""Static poses that determine the gravity parameters."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from asbuilt.arrays import Array, read_only
from asbuilt.description import RobotModel, load_robot
from asbuilt.dynamics.base.base_parameters import find_base_parameters
from asbuilt.dynamics.drives.drive_set import NO_DRIVE, DriveSet
from asbuilt.errors import MotionError, UsageError
from asbuilt.excitation.collision.constraint import build_constraints
from asbuilt.excitation.design.design_options import DesignOptions
from asbuilt.excitation.design.route import Roadmap, plan_route, segments_free
from asbuilt.excitation.information.information import DOptimality, Information
from asbuilt.excitation.limits import (
    LimitReport,
    MotionBounds,
    check_motion,
    complete_limits,
)
from asbuilt.excitation.motions.point_to_point import (
    CHECK_RATE,
    PointToPointMotion,
    find_violations,
)
from asbuilt.excitation.state_constraint import (
    STANDING,
    StateConstraint,
    TorqueLimit,
    WeightLimit,
    smallest_distance,
)
from asbuilt.scaled import Scaled

MOST_POSES = 1_000
"""Most static poses; each is held for seconds."""


# Configure the search for poses.

STATIC_CANDIDATES = 2000  # Random poses to choose among
STATIC_EXCHANGES = 12  # Most rounds of exchange; few suffice (Fedorov 1972)
STATIC_SMALLEST_EIGENVALUE = 1e-9  # Relative information below which gravity does not determine it
STATIC_GAP = 0.2  # Width of angles without a candidate that counts as barred [rad]
STATIC_REFINEMENT_STEPS = 60  # Steps of the climb of all poses together
STATIC_DWELL = 1.0  # Rest at each pose [s]


@dataclass(frozen=True, eq=False, repr=False)
class StaticDesign:
    """Poses (K, n) in the order of the visit, the motion through them, and their information.

    `n_parameters` is the number of combinations of base parameters that gravity determines;
    `log_det`, `condition_number` and `scaled_condition_number` refer to these, one torque reading
    per pose, noise included. `route_time` is the duration without rests [s], `turns` the number of
    turning poses where a straight segment is not free, `collision_distance` the smallest distance
    on the route [m], None if unchecked.
    """

    model: RobotModel
    poses: Array
    motion: PointToPointMotion
    n_parameters: int
    log_det: float
    condition_number: float
    scaled_condition_number: float
    route_time: float
    limits: LimitReport
    turns: int
    collision_distance: float | None
    solve_seconds: float
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "poses", read_only(self.poses))

    def __repr__(self) -> str:
        return (
            f"StaticDesign({self.model.name!r}, poses={len(self.poses)},"
            f" n_parameters={self.n_parameters}, log_det={self.log_det:.2f})"
        )


def design_static_poses(
    robot: RobotModel | str | os.PathLike[str],
    count: int,
    options: DesignOptions | None = None,
    *,
    drive: DriveSet = NO_DRIVE,
    constraints: Sequence[StateConstraint] = (),
    dwell: float = STATIC_DWELL,
) -> StaticDesign:
    """Return the D-optimal poses for the parameters that gravity determines.

    Exchange (Fedorov 1972) among random poses within the state bounds, then a climb of all poses
    together, then a short route through them that avoids obstacles and poses in which the robot is
    too heavy for its drives.

    Parameters
    ----------
    robot
        Robot, name of a bundled robot, or path of a description.
    count
        Number of poses.
    options
        Noise, fractions of the limits, collision, tool box and seed are used.
    drive
        Drive terms that act at rest, such as an offset.
    constraints
        Constraints in addition to the options'.
    dwell
        Rest at each pose [s].

    Raises
    ------
    UsageError
        If there are fewer poses than needed, or gravity moves no joint.
    MotionError
        If no pose is within the state bounds, or no route connects the poses.

    Examples
    --------
    >>> design_static_poses("two-link", 3).n_parameters
    2
    """
    model = load_robot(robot)
    asked = options or DesignOptions()
    constraints = (
        *build_constraints(
            model, collision=asked.collision, tool_box=asked.tool_box, tool_frame=asked.tool_frame
        ),
        *constraints,
    )
    begin = time.monotonic()
    rng = np.random.default_rng([asked.seed, 11])
    base = find_base_parameters(model, drive)
    information = Information.of(model, base, asked.noise)
    bounds = MotionBounds.assumed(model, asked.fraction)
    torque = asked.torque_fraction * MotionBounds.of(model).torque
    loads: list[StateConstraint] = (
        [TorqueLimit((model,), torque)] if np.any(np.isfinite(torque)) else []
    )
    weight = [WeightLimit((model,), STANDING * torque)] if loads else []
    everywhere = rng.uniform(bounds.lower, bounds.upper, size=(STATIC_CANDIDATES, model.n_joints))
    # Where the drives cannot hold the robot no pose is safe to rest at.
    barriers = [*constraints, *(limit for limit in weight if limit.binds(everywhere))]
    pool = everywhere[~find_violations(barriers, everywhere)]
    if len(pool) < 2:
        raise MotionError(
            f"{model.name}: none of {STATIC_CANDIDATES} random poses keeps the torque limits and is"
            " free of collisions"
        )
    pool = _unwind_turns(model, bounds, pool)
    # Only poses that can be reached from each other are candidates.
    roadmap = Roadmap.of(pool, bounds, barriers) if barriers else None
    pool = pool if roadmap is None else roadmap.nodes
    kept = _find_determined(information, pool)
    p = kept.shape[1]
    if p == 0:
        raise UsageError(
            f"gravity moves no joint of {model.name} as it is mounted, so poses at rest determine"
            " no parameter"
        )
    # Each pose reads n torques.
    least = -(-p // model.n_joints)
    if count > MOST_POSES:
        raise UsageError(f"at most {MOST_POSES} static poses are designed, got {count}")
    if count < max(2, least):
        raise UsageError(
            f"got {count} poses; gravity determines {p} parameters of {model.name}, which takes at"
            f" least {max(2, least)}"
        )
    poses = pool[_select_optimal_subset(_weight_pose_rows(information, pool, kept), count)]
    poses = _refine_poses(information, kept, bounds, [*constraints, *weight], barriers, poses)
    poses, motion, turns = plan_route(poses, roadmap, bounds, barriers, loads, dwell)
    total = _sum_information(information, kept, poses)
    limited, _ = complete_limits(model)
    states = motion.at(motion.sample_times(CHECK_RATE))
    return StaticDesign(
        model=model,
        poses=poses,
        motion=motion,
        n_parameters=p,
        log_det=DOptimality().value(total),
        condition_number=float(np.sqrt(np.linalg.cond(total))),
        scaled_condition_number=float(np.sqrt(Scaled(total).condition)),
        # Ends are rests of the whole motion, not of the route.
        route_time=motion.duration - dwell * (count - 2),
        limits=check_motion(limited, motion),
        turns=turns,
        collision_distance=smallest_distance(constraints, states[0]),
        solve_seconds=time.monotonic() - begin,
        notes=tuple(note for constraint in constraints for note in constraint.notes(*states)),
    )


def _weight_pose_rows(information: Information, poses: Array, kept: Array) -> Array:
    """Return the weighted rows of each pose in the coordinates `kept`, (N, n, p)."""
    rest = np.zeros_like(poses)
    # Exact columns: at rest a smooth friction would be zero anyway.
    rows = information.rows(poses, rest, rest, smooth=False)
    whole = np.zeros((len(poses), information.model.n_joints, information.n_parameters))
    for k, (support, own, sigma) in enumerate(information.joints):
        whole[:, k, support] = rows[own, : len(poses)].T / sigma
    return np.asarray(whole @ kept)


def _find_determined(information: Information, poses: Array) -> Array:
    """Return an orthonormal basis (p_base, p) of the combinations that gravity determines."""
    everything = np.eye(information.n_parameters)
    eigenvalues, vectors = np.linalg.eigh(_sum_information(information, everything, poses))
    largest = max(float(eigenvalues[-1]), np.finfo(float).tiny)
    # Combinations below that share move no torque.
    return np.asarray(vectors[:, eigenvalues > STATIC_SMALLEST_EIGENVALUE * largest])


def _sum_information(information: Information, kept: Array, poses: Array) -> Array:
    """Return the information of poses (K, n) in the coordinates `kept`, (p, p)."""
    rest = np.zeros_like(poses)
    rows = information.rows(poses, rest, rest, smooth=False)
    return np.asarray(kept.T @ information.matrix(rows, len(poses)) @ kept)


def _select_optimal_subset(rows: Array, count: int) -> list[int]:
    """Return the indices of a D-optimal subset: greedy, then improved one by one."""
    p = rows.shape[2]
    # Regular from the first pose on, when the information has less than full rank.
    small = 1e-6 * float(np.einsum("ski,ski->", rows, rows)) / len(rows) / p * np.eye(p)

    def gains(matrix: Array) -> Array:
        # det(A + Y^T Y) = det(A) det(1 + Y A^-1 Y^T): small determinants for all candidates.
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
    for _ in range(STATIC_EXCHANGES):
        changed = False
        for place in range(count):
            # Each pose in turn against the rest: what adds most takes its place.
            without = matrix - rows[chosen[place]].T @ rows[chosen[place]]
            best = int(np.argmax(gains(without)))
            if best != chosen[place]:
                chosen[place] = best
                changed = True
            matrix = without + rows[chosen[place]].T @ rows[chosen[place]]
        if not changed:
            break
    return chosen


def _refine_poses(
    information: Information,
    kept: Array,
    bounds: MotionBounds,
    constraints: Sequence[StateConstraint],
    obstacles: Sequence[StateConstraint],
    poses: Array,
) -> Array:
    """Climb all poses together; poses that violate a constraint or become unreachable go back."""
    middle = (bounds.upper + bounds.lower) / 2
    half = (bounds.upper - bounds.lower) / 2

    # In units of half the range, in which all joints compare.
    def negative(x: Array) -> tuple[float, Array]:
        q = middle + half * x.reshape(poses.shape)
        rest = np.zeros_like(q)
        value, gradient = DOptimality().value_and_gradient(_sum_information(information, kept, q))
        if not np.isfinite(value):
            # An undetermined combination of poses must lose against any other.
            return 1e12, np.zeros_like(x)
        rows = information.rows(q, rest, rest)
        slope = information.state_gradient(q, rest, rest, rows, kept @ gradient @ kept.T)[0]
        return -value, -(slope * half).reshape(-1)

    start = ((poses - middle) / half).reshape(-1)
    climbed = minimize(
        negative,
        start,
        jac=True,
        method="L-BFGS-B",
        bounds=[(-1, 1)] * start.size,
        options={"maxiter": STATIC_REFINEMENT_STEPS},
    )
    moved = middle + half * climbed.x.reshape(poses.shape)
    for k in range(len(moved)):
        # A pose that moved must still be reachable from where it was.
        straight = (
            bool(segments_free(np.stack([poses[k], moved[k]]), [(0, 1)], obstacles)[0])
            if obstacles
            else True
        )
        if not straight or find_violations(constraints, moved[k : k + 1])[0]:
            moved[k] = poses[k]
    # Poses that went back can leave the rest worse than the start.
    better = DOptimality().value(_sum_information(information, kept, moved)) >= DOptimality().value(
        _sum_information(information, kept, poses)
    )
    return moved if better else poses


def _unwind_turns(model: RobotModel, bounds: MotionBounds, pool: Array) -> Array:
    """Return poses with whole turns added, so that joints stay near the middle of their range.

    The middle is opposite to angles at which there is no pose, else the centre of the range.
    """
    # Gaps between the angles that occur, the one across zero included.
    angles = np.sort(np.mod(pool, 2 * np.pi), axis=0)
    gaps = np.diff(np.vstack([angles, angles[:1] + 2 * np.pi]), axis=0)
    widest = np.argmax(gaps, axis=0)
    joints = np.arange(model.n_joints)
    opposite = angles[widest, joints] + gaps[widest, joints] / 2 + np.pi
    centre = (bounds.upper + bounds.lower) / 2
    opposite -= 2 * np.pi * np.round((opposite - centre) / (2 * np.pi))
    middle = np.where(gaps[widest, joints] > STATIC_GAP, opposite, centre)
    near = pool - 2 * np.pi * np.round((pool - middle) / (2 * np.pi))
    # Whole turns into the range, where there are any.
    near += 2 * np.pi * ((near < bounds.lower).astype(float) - (near > bounds.upper))
    fits = (
        (near > bounds.lower)
        & (near < bounds.upper)
        & [joint.is_revolute for joint in model.joints]
    )
    return np.where(fits, near, pool)
