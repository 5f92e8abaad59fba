"""Windows of a recording in which its motion is simulated: what drives it, and the ground under it.

Each foot stands on a floor of its own, level and as high as the foot stood in the log about that
time, so that steps, slopes and errors of the leg's lengths lift or drop no foot. The simulation
decides when a foot touches, how it rolls, and when it leaves: contacts that followed the flags of
the log would take from the measurement what a rollout predicts, and could pull.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array, Indices
from asbuilt.description import quaternion_from_rotation
from asbuilt.description.model import RobotModel
from asbuilt.description.structure.free_base import AXES
from asbuilt.dynamics.kinematics import link_poses
from asbuilt.errors import RecordingError, UsageError
from asbuilt.experiment import Recording, Samples
from asbuilt.experiment.virtual.physics import FRICTION_TIME
from asbuilt.findings import Cure
from asbuilt.identification.trajectories.simulated_robot import (
    DriveSignal,
    choose_driving_signal,
    select_finite,
)

FEWEST = 3
"""Fewest samples of a window: the state at its start and two to compare."""


@dataclass(frozen=True, slots=True, eq=False)
class Windows:
    """Hold W windows of L samples of n joints, one after another.

    Attributes
    ----------
    source
        Name of the recording.
    horizon
        Length of a window [s].
    rate
        Sampling rate [Hz].
    starts
        Time of the first sample of each window [s], shape (W,).
    q
        Measured positions, unfiltered, shape (W, L, n).
    start_q, start_qd
        Measured state at the start, filtered, shape (W, n).
    signal
        What drives the simulation.
    ground
        What is under the feet; None if nothing is.
    longest_step
        Longest step of the simulation [s].
    """

    source: str
    horizon: float
    rate: float
    starts: Array
    q: Array
    start_q: Array
    start_qd: Array
    signal: DriveSignal
    ground: Ground | None = None
    # Longest step of a simulation [s]; a period of the log is divided into equal steps.
    longest_step: float = 1e-3

    @property
    def n_windows(self) -> int:
        """Number of windows."""
        return len(self.starts)

    @property
    def n_samples(self) -> int:
        """Number of samples in each window, the first included."""
        return int(self.q.shape[1])

    @property
    def times(self) -> Array:
        """Times of the samples since the start of the window [s], shape (L,)."""
        return np.arange(self.n_samples) / self.rate

    @property
    def divisions(self) -> int:
        """Number of simulation steps per sample."""
        return max(1, math.ceil(1.0 / (self.rate * self.longest_step) - 1e-9))

    @property
    def step(self) -> float:
        """Step of the simulation [s]."""
        return 1.0 / (self.rate * self.divisions)

    @property
    def n_steps(self) -> int:
        """Number of simulation steps of a window."""
        return self.divisions * (self.n_samples - 1)

    def some(self, part: slice | Indices) -> Windows:
        """Return some of the windows."""
        return replace(
            self,
            starts=self.starts[part],
            q=self.q[part],
            start_q=self.start_q[part],
            start_qd=self.start_qd[part],
            ground=self.ground and replace(self.ground, heights=self.ground.heights[part]),
        )

    def inputs(self, delay: float = 0.0, lead: ArrayLike = 0.0) -> Array:
        """Return the mean of the delayed signal over each simulation step, (W, n_steps, n).

        A lead [s], one or (n,), adds the rate of the means times itself.
        """
        if not np.any(lead):
            return self.signal.means(self.starts, self.n_steps, self.step, delay)
        means = self._from_one_before(delay)
        return np.asarray(means[:, 1:] + np.asarray(lead) * (np.diff(means, axis=1) / self.step))

    def rates(self, delay: float) -> Array:
        """Return the rate of the delayed signal from step to step, shape (W, n_steps, n)."""
        return np.asarray(np.diff(self._from_one_before(delay), axis=1) / self.step)

    def _from_one_before(self, delay: float) -> Array:
        """Return the mean of the delayed signal over a step before the first, and over each."""
        return self.signal.means(self.starts - self.step, self.n_steps + 1, self.step, delay)

    def slopes(self, delay: float, lead: ArrayLike = 0.0) -> Array:
        """Return the derivative of `inputs` of a held signal by the delay, (W, n_steps, n)."""
        here = (self.starts, self.n_steps, self.step)
        slopes = self.signal.slopes(*here, delay)
        if not np.any(lead):
            return slopes
        before = self.signal.slopes(*here, delay + self.step)
        return np.asarray(slopes + np.asarray(lead) * (slopes - before) / self.step)


def cut_windows(
    recording: Recording,
    samples: Samples,
    horizon: float,
    signal: DriveSignal | None = None,
    model: RobotModel | None = None,
) -> Windows:
    """Cut the segments of samples into windows, one after another; what is left over is dropped.

    Parameters
    ----------
    recording
        The recording as logged.
    samples
        Its filtered motion, as far as it may be simulated.
    horizon
        Length of a window [s].
    signal
        What drives the simulation; None: `choose_driving_signal`.
    model
        The robot, whose feet the log shows to stand on a ground; None: there is none.

    Raises
    ------
    UsageError
        If the horizon is shorter than three samples.
    RecordingError
        If no segment is as long as the horizon.
    """
    length = round(horizon * samples.rate) if np.isfinite(horizon) else 0
    if length < FEWEST:
        raise UsageError(
            f"a rollout of {horizon:g} s has {max(length, 0)} samples at {samples.rate:.4g} Hz; it"
            f" needs {FEWEST}",
            value=horizon,
            lower=FEWEST / samples.rate,
        )
    first = [
        start for begin, end in samples.segments for start in range(begin, end - length + 1, length)
    ]
    if not first:
        longest = max((b - a) / samples.rate for a, b in samples.segments)
        raise RecordingError(
            f"{samples.source}: no segment is as long as a rollout of {horizon:g} s; the longest"
            f" lasts {longest:.3g} s",
            cure=Cure("give a shorter horizon, or hold out longer blocks"),
            file=samples.source,
            value=longest,
            lower=horizon,
        )
    at = np.array(first)[:, None] + np.arange(length)
    return Windows(
        samples.source,
        horizon,
        samples.rate,
        samples.t[first],
        _interpolate_positions(recording, samples.t)[at],
        samples.q[first],
        samples.qd[first],
        signal or choose_driving_signal(recording),
        None if model is None else measure_ground(model, recording, samples.t[first], horizon),
    )


def _interpolate_positions(recording: Recording, t: Array) -> Array:
    """Return the logged positions at times (N,), interpolated, shape (N, n)."""
    times, q = select_finite(recording.t, recording.q)
    return np.stack([np.interp(t, times, x) for x in q.T], axis=1)


# Say how a floor and the feet on it are simulated: own choices.
#
# A floor is as stiff as what stops a joint by dry friction, since the heights of feet that stand
# hold how far the real one gives way, and its coefficient of friction is `GROUND_FRICTION`. A foot
# that is a point is a ball of the radius `GROUND_POINT` [m]. A sole, whose size no log states and
# whose moments no limit, stands on balls at `GROUND_SOLE` [m] to all sides.

GROUND_FRICTION = 1.0
GROUND_POINT = 1e-3
GROUND_SOLE = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """Hold what W windows have under K contacts.

    `heights` (W, K) [m] are how high the frames of contacts are that stand, along the vertical;
    `normals` (K, 3) the vertical in axes of the links that stand.
    """

    heights: Array
    normals: Array

    def places(self, model: RobotModel) -> Array:
        """Return where the floors are, shape (W, K, 3)."""
        below = self.heights - [_choose_radius(contact.radius) for contact in model.contacts]
        return np.asarray(below[..., None] * find_vertical(model))


def find_vertical(model: RobotModel) -> Array:
    """Return the upward unit vector (3,) in axes of the world."""
    return np.asarray(-model.gravity / max(float(np.linalg.norm(model.gravity)), 1e-9))


def measure_ground(
    model: RobotModel, recording: Recording, starts: Array, horizon: float
) -> Ground | None:
    """Return the ground in windows (W,) of a length [s]; None where nothing touches it.

    A foot that never stands has none within reach. Raises `UsageError` where the base moves in a
    plane, which carries the robot in place of its feet.
    """
    if not model.contacts or recording.contact is None:
        return None
    if model.n_floating != len(AXES):
        raise UsageError(
            f"the base of {model.name} moves in a plane, where no weight presses its contacts on"
            " the ground, so that a rollout cannot simulate them",
            cure=Cure("let the base float, or leave the rollout out"),
        )
    usable = np.all(np.isfinite(recording.q), axis=1) & np.isfinite(recording.t)
    t = recording.t[usable]
    up = find_vertical(model)
    poses = link_poses(model, recording.q[usable])
    closed = recording.contact[usable] > 0.5
    heights = np.empty((len(starts), len(model.contacts)))
    normals = []
    for k, contact in enumerate(model.contacts):
        link, placement = model.placed(contact.frame)
        stands = closed[:, k]
        z = (poses[:, link] @ placement)[:, :3, 3] @ up
        turned = np.einsum("sji,j->si", poses[stands, link, :3, :3], up).sum(axis=0)
        normals.append(turned / np.linalg.norm(turned) if stands.any() else up)
        for w, start in enumerate(starts):
            away = np.abs(t[stands] - start - 0.5 * horizon)
            near = away <= max(horizon, float(np.min(away, initial=np.inf)) + 0.5 * horizon)
            heights[w, k] = np.median(z[stands][near]) if stands.any() else np.min(z) - 1e3
    return Ground(heights, np.array(normals))


def add_ground(mujoco: Any, spec: Any, model: RobotModel, ground: Ground, step: float) -> None:
    """Add balls at the contacts, and a floor that can be moved under each, to a MuJoCo `MjSpec`.

    The simulation takes steps of `step` [s].
    """
    stiff = [max(FRICTION_TIME, 2.0 * step), 1.0]
    level = quaternion_from_rotation(_complete_axes(find_vertical(model)))
    for contact, normal in zip(model.contacts, ground.normals, strict=True):
        link, placement = model.placed(contact.frame)
        name = f"ground of {contact.frame}"
        size = _choose_radius(contact.radius)
        floor = spec.worldbody.add_body(name=name, mocap=True)
        shape = {"contype": 0, "conaffinity": 0, "mass": 0.0}
        floor.add_geom(
            name=name, type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], quat=level, **shape
        )
        across = GROUND_SOLE * _complete_axes(normal)[:, :2].T
        corners = [*across, *-across] if contact.flat else [np.zeros(3)]
        for number, corner in enumerate(corners):
            ball = f"{contact.frame} {number}"
            spec.body(model.link_names[link]).add_geom(
                name=ball,
                type=mujoco.mjtGeom.mjGEOM_SPHERE,
                pos=placement[:3, 3] + corner,
                size=[size, 0, 0],
                **shape,
            )
            spec.add_pair(
                name=ball,
                geomname1=name,
                geomname2=ball,
                condim=3,
                solref=stiff,
                friction=[GROUND_FRICTION, GROUND_FRICTION, 0.0, 0.0, 0.0],
            )


def _choose_radius(radius: float | None) -> float:
    return max(radius or 0.0, GROUND_POINT)


def _complete_axes(z: Array) -> Array:
    """Return a rotation (3, 3) whose last column is a unit vector."""
    x = np.cross(np.eye(3)[int(np.argmin(np.abs(z)))], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)
