"""Poses, path of the tip and extent of a motion or of a recording, for pictures."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array
from asbuilt.description import ROOT, RobotModel, Solid, link_solids
from asbuilt.dynamics.kinematics import link_poses
from asbuilt.errors import MotionError, UsageError
from asbuilt.excitation import Motion, MotionBounds, SplineMotion
from asbuilt.experiment import Recording, RecordingStream, head_of

FEWEST_POSES = 6


@dataclass(frozen=True, slots=True, eq=False)
class MotionView:
    """Poses of a motion and the scene around them.

    `t` (N,), `q` (N, n), `poses` (N, n, 4, 4) in the root frame, `path` (m, 3) of the tip [m].

    `up` is the direction against gravity, `floor` the height of the ground along it, `centre` and
    `radius` a ball that encloses every pose.
    """

    t: Array
    q: Array
    poses: Array
    path: Array
    solids: tuple[Solid, ...]
    up: Array
    floor: float
    centre: Array
    radius: float

    @classmethod
    def of(
        cls, model: RobotModel, t: ArrayLike, q: ArrayLike, *, path: ArrayLike | None = None
    ) -> MotionView:
        """Build from times (N,) and joint positions (N, n).

        `path` (m, n) are the positions of a finer path, by default q.
        """
        times = np.atleast_1d(np.asarray(t, dtype=np.float64))
        positions = np.atleast_2d(np.asarray(q, dtype=np.float64))
        if positions.shape != (times.size, model.n_joints) or not np.all(np.isfinite(positions)):
            raise UsageError(
                f"a view of {model.name} needs finite positions of shape ({times.size},"
                f" {model.n_joints}), got {positions.shape}"
            )
        poses = link_poses(model, positions)
        along = poses if path is None else link_poses(model, np.asarray(path))
        solids = link_solids(model)
        strength = np.linalg.norm(model.gravity)
        up = -model.gravity / strength if strength > 0 else np.array([0.0, 0.0, 1.0])
        ends = np.concatenate(
            [np.zeros((1, 3)), *(end for solid in solids for end in place_ends(solid, along))]
        )
        thickest = max(solid.radius for solid in solids)
        low = ends.min(axis=0) - thickest
        high = ends.max(axis=0) + thickest
        floor = min(0.0, float(np.min(ends @ up)) - thickest)
        last, place = _find_tip(model)
        traced = along[:, last]
        return cls(
            t=times,
            q=positions,
            poses=poses,
            path=traced[:, :3, :3] @ place + traced[:, :3, 3],
            solids=solids,
            up=up,
            floor=0.0 if floor > -0.6 * thickest - thickest else floor,
            centre=0.5 * (low + high),
            radius=0.5 * float(np.linalg.norm(high - low)),
        )

    @classmethod
    def of_motion(
        cls, model: RobotModel, motion: Motion | None, *, most: int = 200, rate: float = 25.0
    ) -> MotionView:
        """Build from a motion, at `rate` [Hz] or as many frames as `most`.

        Without a motion the robot rests near the middle of its ranges.
        """
        if motion is None:
            return cls.of(model, [0.0], choose_resting_pose(model)[None])
        t = np.linspace(
            0.0, motion.duration, int(np.clip(np.ceil(motion.duration * rate), 2, most))
        )
        # 1000: most points of the drawn path of the tip.
        fine = np.linspace(0.0, motion.duration, int(np.clip(40 * motion.duration, 200, 1000)))
        return cls.of(model, t, motion.derivative(t, 0), path=motion.derivative(fine, 0))

    @property
    def stand(self) -> tuple[Solid, ...]:
        """Base plate on the floor, and column up to the robot if there is one."""
        thickest = max(solid.radius for solid in self.solids)
        foot = self.floor * self.up
        plate = Solid(ROOT, "housing", foot, foot + 0.25 * thickest * self.up, 2 * thickest)
        column = Solid(ROOT, "housing", foot, np.zeros(3), 1.15 * thickest)
        return (plate, column) if self.floor < 0.0 else (plate,)

    def first(self) -> MotionView:
        """Return the same view with its first frame alone."""
        return replace(self, t=self.t[:1], q=self.q[:1], poses=self.poses[:1])


def choose_resting_pose(model: RobotModel) -> Array:
    """Return the zero position, bent and moved into the joints' ranges, shape (n,).

    Bent, no two axes hide each other.
    """
    bounds = MotionBounds.assumed(model)
    bend = [
        0.35 * (-1) ** k if k and joint.is_revolute else 0.0 for k, joint in enumerate(model.joints)
    ]
    margin = 0.1 * (bounds.upper - bounds.lower)
    return np.asarray(np.clip(bend, bounds.lower + margin, bounds.upper - margin))


def motion_of_recording(recording: Recording | RecordingStream) -> SplineMotion:
    """Return the motion through the positions of a recording, of the beginning of a long one.

    Raises `MotionError` if there are fewer than 6 samples without gaps.
    """
    head = head_of(recording)
    valid = np.all(np.isfinite(head.q), axis=1) & np.isfinite(head.t)
    t = head.t[valid]
    q = head.q[valid]
    if len(t) < FEWEST_POSES:
        raise MotionError(f"{head.source} has {len(t)} valid positions; at least 6 can be played")
    # 25 poses per second, the eye sees no more; motions beyond two minutes have larger steps.
    wanted = max(FEWEST_POSES, min(3000, int(25.0 * (t[-1] - t[0]))))
    chosen = np.unique(np.linspace(0, len(t) - 1, wanted).round().astype(int))
    return SplineMotion.through(q[chosen], t[chosen] - t[0], degree=3, ends="natural")


def place_ends(solid: Solid, poses: Array) -> list[Array]:
    """Return both ends (N, 3) of a body at poses (N, n, 4, 4) of the links; (1, 3) of the base."""
    if solid.link == ROOT:
        return [solid.start[None], solid.stop[None]]
    pose = poses[:, solid.link]
    return [pose[:, :3, :3] @ end + pose[:, :3, 3] for end in (solid.start, solid.stop)]


def _find_tip(model: RobotModel) -> tuple[int, Array]:
    """Return the link of the tool and the point whose path is drawn: a frame, or its origin."""
    last = model.tool_link
    on_it = [frame.placement[:3, 3] for frame in model.frames if frame.link == last]
    return last, np.asarray([np.zeros(3), *on_it][-1])
