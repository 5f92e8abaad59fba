"""What the signal chain makes of a motion that the model explains exactly: a replay of recordings.

Velocities and accelerations are derivatives of filtered positions, and the torque of a command
contains the positions too. So noise of the positions is in the regressor and in the torque alike,
and dry friction changes sign between two samples. Neither averages out: with `e = tau - W beta` of
the true robot, the mean of `W^T e` is not zero. It is measured on a recording that the robot as
identified would have made under the same command, sampled at the same times with the same noise,
where `e` is known (indirect inference: Gourieroux, Monfort & Renault, J. Applied Econometrics 8,
1993).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from asbuilt.arrays import Array, Indices, find_finite_rows
from asbuilt.description.model import RobotModel
from asbuilt.dynamics import BaseParameters, PositionServo
from asbuilt.errors import RecordingError
from asbuilt.experiment import Recording, SignalChain
from asbuilt.experiment.command.torque import drive_by_command
from asbuilt.experiment.signal.band_choice import power_density
from asbuilt.experiment.signal.resampling import GAP
from asbuilt.identification.information.equations import Equations
from asbuilt.identification.servo.servo_rows import (
    CommandedMotion,
    block_weights,
    reduce_servo_recordings,
    sum_clusters,
)
from asbuilt.identification.trajectories.sensitivity import Trajectories
from asbuilt.identification.trajectories.simulated_robot import DriveSignal, SimulatedRobot
from asbuilt.identification.trajectories.windows import Windows
from asbuilt.identification.uncertainty.pose_noise import MeanScores

# Settings of a replay: own choices.

REPLAY_STEP = 1e-3  # Longest step of the simulation [s]
# Steps after which the simulation begins again from the state that it reached
REPLAY_STEPS_AT_ONCE = 20_000
REPLAY_SAMPLES = 32_000  # Samples to replay in all, with noise and with its negative
# Most pairs of noise and its negative: what is linear in the noise, and so has no mean, cancels
REPLAY_MOST_PAIRS = 4
REPLAY_WINDOW = 256  # Samples of a window of the spectra from which the noise follows
REPLAY_ABOVE = 0.4  # Share of half the sampling rate above which positions are noise


@dataclass(frozen=True, slots=True, eq=False)
class Replay:
    """Hold what replayed recordings leave in the scores `[W_k, qd, du/dt]^T e_k` of each joint.

    `scores` are their means over samples; `weighted` (p_k + 2,) the means with blocks weighted as
    in `find_scale`. `draws` (D, p_k + 2) are the weighted sums over clusters of blocks of what the
    noise of `copies` copies changes, as many for each.
    """

    scores: MeanScores
    weighted: tuple[Array, ...]
    draws: tuple[Array, ...]
    copies: int

    @property
    def sees_noise(self) -> bool:
        """Whether the copies differ by noise alone, so that their variance shows the noise."""
        return min(len(draws) for draws in self.draws) > 0

    def variance(self, along: Sequence[Array]) -> float:
        """Return the variance by noise of `sum_k along_k @ scores_k`, scores weighted."""
        moves = sum(draws @ x for draws, x in zip(self.draws, along, strict=True))
        return float(np.sum(np.square(moves))) / max(self.copies - 1, 1)


def replay(
    model: RobotModel,
    base: BaseParameters,
    recordings: Sequence[Recording],
    servo: PositionServo,
    chain: SignalChain,
    parameters: Array,
    holdout: str | None = None,
    *,
    roughly: bool = False,
) -> Replay | None:
    """Replay recordings by a robot and return what does not average out.

    None if the robot diverges under the command, or rests, or has a free base, whose fall and
    balance over a whole recording no simulation repeats. The columns are `[W_k, qd, du/dt]`.

    Parameters
    ----------
    model, base
        The robot and its base parameters.
    recordings
        Recordings with the servo that each had; of these its limits count.
    servo
        The servo, its gains and delay known.
    chain
        The signal chain, its cutoff settled.
    parameters
        Standard parameters of the robot to replay, (n_standard,).
    holdout
        A rule of `hold_out`: what to leave out.
    roughly
        With one pair of noise and its negative alone.
    """
    # What nothing drives falls otherwise after a second: no replay stays near the recording.
    if len(model.driven_joints) < model.n_joints:
        return None
    total = sum(recording.n_samples for recording in recordings)
    pairs = 1 if roughly else min(max(round(REPLAY_SAMPLES / (2 * total)), 1), REPLAY_MOST_PAIRS)
    # A fixed seed: the same recordings have the same errors.
    rng = np.random.default_rng(0)
    beta = base.values(parameters)
    copies: list[list[_Copy]] = []
    for recording in recordings:
        had = recording.servo
        acting = servo
        if had is not None:
            acting = replace(
                servo, goal_acceleration=had.goal_acceleration, goal_speed=had.goal_speed
            )
        clean = replay_recording(model, base, recording, acting, parameters)
        if clean is None:
            return None
        driven = [
            drive_by_command(noisy, acting) for noisy in _add_noise(recording, clean, pairs, rng)
        ]
        late = servo.delay or 0.0
        try:
            rows = [
                reduce_servo_recordings(
                    [CommandedMotion(model, base, motion, chain, holdout)], [motion], late
                )
                for motion in driven
            ]
        except RecordingError:
            return None
        copies.append([_Copy.of(reduced, beta, servo) for reduced in rows])
    every = [copy for pair in copies for copy in pair]
    names = tuple(
        tuple(base.names[j] for j in every[0].rows.in_model(k))
        for k in range(every[0].rows.n_joints)
    )
    joints = range(model.n_joints)
    return Replay(
        MeanScores(names, tuple(_average_scores(every, k, weighted=False) for k in joints)),
        tuple(_average_scores(every, k, weighted=True) for k in joints),
        tuple(np.concatenate([_measure_noise_changes(pair, k) for pair in copies]) for k in joints),
        2 * pairs,
    )


def replay_recording(
    model: RobotModel,
    base: BaseParameters,
    recording: Recording,
    servo: PositionServo,
    parameters: Array,
) -> Array | None:
    """Return the positions (N, n) of a robot under the command of a recording; None if it diverges.

    The first-order errors of its steps are undone.
    """
    links = parameters[: 10 * model.n_links]
    values = parameters[10 * model.n_links :].reshape(model.n_joints, -1)
    robot = SimulatedRobot(model, base.drive, values, servo).centred(REPLAY_STEP)
    driving = DriveSignal.of(recording, "command")
    engine = Trajectories(model, base)
    out = np.full(recording.q.shape, np.nan)
    runs = _split_segments(recording)
    for number, rows in enumerate(runs):
        # A log begins at rest; after a gap the robot moves already.
        step = recording.t[rows[1]] - recording.t[rows[0]]
        # Speeds by one difference: a better one needs the filter whose effect is measured.
        speed = (recording.q[rows[1]] - recording.q[rows[0]]) / step if number else 0.0
        state = recording.q[rows[:1]], np.full((1, model.n_joints), speed)
        t = recording.t[rows]
        for fine, q in _simulate_spans(engine, robot, driving, t, state, links):
            if not np.all(np.isfinite(q)):
                return None
            # The simulation has its own steps; the log samples it at its own times.
            at = rows[(t >= fine[0]) & (t <= fine[-1])]
            for k in range(model.n_joints):
                out[at, k] = np.interp(recording.t[at], fine, q[:, k])
    return out if runs else None


def _simulate_spans(
    engine: Trajectories,
    robot: SimulatedRobot,
    driving: DriveSignal,
    t: Array,
    state: tuple[Array, Array],
    links: Array,
) -> Iterator[tuple[Array, Array]]:
    """Yield times (L,) and simulated positions (L, n) from a state (q, qd) on, a span at a time."""
    q, v = state
    total = int(np.ceil((t[-1] - t[0]) / REPLAY_STEP)) + 1
    for done in range(0, total, REPLAY_STEPS_AT_ONCE):
        steps = min(REPLAY_STEPS_AT_ONCE, total - done)
        start = float(t[0]) + done * REPLAY_STEP
        windows = Windows(
            "replay",
            steps * REPLAY_STEP,
            1.0 / REPLAY_STEP,
            np.array([start]),
            np.broadcast_to(q[:, None], (1, steps + 1, q.shape[1])),
            q,
            v,
            driving,
            longest_step=REPLAY_STEP,
        )
        motion = engine.simulate(robot, windows, links)
        yield np.asarray(start + REPLAY_STEP * np.arange(steps + 1)), np.asarray(motion.q[0])
        # The state is handed on, so that the spans are one motion.
        q = motion.q[:, -1]
        v = motion.v[:, -1]


def _split_segments(recording: Recording) -> list[Indices]:
    """Return the rows with positions, apart where the log has gaps; runs of two rows and more."""
    rows = np.flatnonzero(find_finite_rows(recording.t, recording.q))
    steps = np.diff(recording.t[rows])
    if not steps.size:
        return []
    parts = np.split(rows, np.flatnonzero(steps > GAP * np.median(steps)) + 1)
    return [part for part in parts if part.size > 1]


def estimate_position_noise(recording: Recording) -> Array:
    """Return the standard deviation of white noise of the positions [rad or m], (n,).

    Examples
    --------
    >>> t = np.arange(4000) / 100.0
    >>> noise = 1e-3 * np.random.default_rng(0).standard_normal((4000, 1))
    >>> q = np.sin(2.0 * np.pi * t)[:, None] + noise
    >>> estimate_position_noise(Recording(t=t, q=q, tau=q)).round(4).tolist()
    [0.001]
    """
    runs = [rows for rows in _split_segments(recording) if rows.size >= REPLAY_WINDOW]
    if not runs:
        return np.zeros(recording.q.shape[1])
    # At a sampling rate of 2 the density of white noise over [0, 1] is its variance.
    spectra = [power_density(recording.q[rows], 2.0, REPLAY_WINDOW) for rows in runs]
    # High frequencies, where no robot moves: what is left there is noise.
    high = np.fft.rfftfreq(REPLAY_WINDOW, 0.5) > REPLAY_ABOVE
    parts = [np.mean(density[high], axis=0) for density in spectra]
    weights = [rows.size for rows in runs]
    return np.sqrt(np.average(parts, axis=0, weights=weights))


def _add_noise(
    recording: Recording, clean: Array, pairs: int, rng: np.random.Generator
) -> Iterator[Recording]:
    """Yield the recording with clean positions and noise of either sign."""
    noise = estimate_position_noise(recording)
    for _ in range(pairs):
        added = noise * rng.standard_normal(clean.shape)
        # Either sign: what is linear in the noise cancels in their mean.
        for sign in (1.0, -1.0):
            yield replace(recording, q=clean + sign * added, qd=None, qdd=None, extra={})


@dataclass(frozen=True, slots=True, eq=False)
class _Copy:
    """Hold the scores of each joint's blocks (B, p_k + 2) of a replayed recording.

    `weights` (n, B) belong to the blocks.
    """

    rows: Equations
    scores: tuple[Array, ...]
    weights: Array

    @classmethod
    def of(cls, rows: Equations, beta: Array, servo: PositionServo) -> _Copy:
        """Return the scores `[W_k, qd, du/dt]^T e_k` of the robot with these base parameters."""
        scores = []
        weights = []
        for k in range(rows.n_joints):
            support = rows.in_model(k)
            # e = kp (u - q) - kd qd - W beta as a combination of the rows.
            e = np.concatenate([-beta[support], [-servo.kd[k], 0.0, servo.kp[k]]])
            scores.append((rows.grams[k] @ e)[:, :-1])
            weights.append(block_weights(rows, k, e))
        return cls(rows, tuple(scores), np.array(weights))


def _average_scores(copies: Sequence[_Copy], k: int, *, weighted: bool) -> Array:
    """Return the mean score of a joint over the samples of all copies (p_k + 2,)."""
    weights = [c.weights[k] if weighted else np.ones(c.rows.n_blocks) for c in copies]
    total = sum(float(w @ copy.rows.lengths) for w, copy in zip(weights, copies, strict=True))
    parts = [w @ copy.scores[k] for w, copy in zip(weights, copies, strict=True)]
    return np.asarray(np.sum(parts, axis=0) / max(total, 1e-300))


def _measure_noise_changes(copies: Sequence[_Copy], k: int) -> Array:
    """Return what noise changes in the weighted scores of a joint's clusters of blocks.

    Empty if the copies have other blocks each, since some rest where others move.
    """
    # Blocks that differ cannot be compared one by one.
    if len({copy.rows.n_blocks for copy in copies}) > 1:
        return np.zeros((0, copies[0].scores[k].shape[1]))
    sums = np.array([sum_clusters(c.weights[k][:, None] * c.scores[k], c.rows) for c in copies])
    return np.concatenate(sums - sums.mean(axis=0))
