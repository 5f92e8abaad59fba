"""Commanded motion reduced to Gram matrices of each joint and time block, fits and errors."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import groupby

import numpy as np

from asbuilt.arrays import Array, Indices, Mask
from asbuilt.codec import store_as
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import BaseParameters
from asbuilt.dynamics.kernels.blas import use_one_blas_thread
from asbuilt.dynamics.regressor import RegressorPlan
from asbuilt.errors import RecordingError
from asbuilt.experiment import Recording, Samples, SignalChain, hold_out
from asbuilt.experiment.command.torque import (
    CommandCurve,
    differentiate_logged_positions,
    drop_saturated,
    drop_slow_rows,
    hold_command,
)
from asbuilt.experiment.signal.preparation import MotionFilters, PreparedMotion
from asbuilt.findings import Cure
from asbuilt.identification.information.equations import MODEL, Equations
from asbuilt.identification.information.rows import SampleBlock, TimeBlock, divide_into_blocks
from asbuilt.scaled import Scaled

FEWEST_ROWS = 5
"""Rows of a joint in a block below which its residual does not count."""
BLOCK_SECONDS = 1.0
"""Length of a time block [s], short enough to leave out a collision and little else."""
BLOCKS_AT_ONCE = 8
"""Time blocks whose rows are made at once."""
MOST_HELD = 50e6
"""Memory [bytes] of the rows of a recording that are kept; more are made again each time."""
VELOCITY = "velocity"
RATE = "rate"
"""Groups of the columns of joint velocities, and of rates of the command."""


@dataclass(frozen=True, slots=True, eq=False)
class _Run:
    """Hold neighbouring time blocks with the rows `[W_k, qd]` (p_k + 1, m) of each joint.

    `spans[b]` are the columns of block b, `grams[b][k]` the products of its rows, `counts` (B, n)
    the rows that count.
    """

    whole: SampleBlock
    blocks: tuple[SampleBlock, ...]
    spans: tuple[slice, ...]
    rows: tuple[Array, ...]
    grams: tuple[tuple[Array, ...], ...]
    counts: Array


@dataclass(frozen=True, eq=False)
class CommandedMotion:
    """Reduce a recording under any servo and delay; what depends on neither is made once.

    Parameters
    ----------
    model, base
        The robot and its base parameters.
    recording
        The recording; of its servo, the torque limits count.
    chain
        The signal chain, its cutoff settled.
    holdout
        A rule of `hold_out`: what to leave out.
    filters
        What filters the motion, once for all who share it.
    noise
        Noise (n,) of the equations, of a robot on which reactions act.
    """

    model: RobotModel
    base: BaseParameters
    recording: Recording
    chain: SignalChain
    holdout: str | None = None
    filters: MotionFilters = field(default_factory=MotionFilters)
    noise: tuple[float, ...] = ()

    @cached_property
    def support(self) -> tuple[Indices, ...]:
        """Base parameters of each joint's columns."""
        return self._plan.support

    def rate(self, recording: Recording, delay: float) -> Samples:
        """Return samples whose torques are the rate of what the servo of a recording follows."""
        return self._filter(self._gains[0] * hold_command(recording, delay, self._curve, 1))

    def grams(
        self, recording: Recording, delay: float, rate: Samples | None = None
    ) -> Iterator[tuple[TimeBlock, tuple[Array, ...], Array]]:
        """Yield time blocks, Gram matrices of each joint's rows, and how many rows count (n,).

        `recording` has the motion, and any servo; its command acts after `delay` [s]. A `rate` that
        was made before takes the place of its own.
        """
        error = hold_command(recording, delay, self._curve) - recording.q
        if recording.servo is not None:
            error = recording.servo.acting(error)
        both = (rate or self.rate(recording, delay), self._filter(self._gains[0] * error))
        for run in self._list_runs():
            signals = np.stack([run.whole.filtered(samples.tau.__getitem__) for samples in both])
            for b, (block, span) in enumerate(zip(run.blocks, run.spans, strict=True)):
                joined = tuple(
                    _join_gram(gram, rows[:, span], signals[:, k, span])
                    for k, (gram, rows) in enumerate(zip(run.grams[b], run.rows, strict=True))
                )
                yield replace(block.time, source=recording.source), joined, run.counts[b]

    @cached_property
    def _plan(self) -> RegressorPlan:
        return RegressorPlan.of(self.model, self.base.drive, self.base.columns, spare_rows=1)

    @cached_property
    def _gains(self) -> Array:
        """Stiffness and damping (2, n) by which signals are multiplied before the projection.

        An unknown stiffness, the same for all joints, multiplies them as well afterwards.
        """
        servo = self.recording.servo
        if servo is None or not self.model.has_reactions:
            return np.ones((2, self.model.n_joints))
        return np.stack([np.nan_to_num(servo.kp, nan=1.0), np.nan_to_num(servo.kd)])

    @cached_property
    def _curve(self) -> CommandCurve | None:
        return CommandCurve.of(self.recording)

    @cached_property
    def motion(self) -> PreparedMotion:
        """The filtered motion, with velocities in place of the torque."""
        # NaN where no command is known, so that these samples go through the filter as gaps.
        finite = 0.0 * hold_command(replace(self.recording, servo=None), curve=self._curve)
        speed = self._gains[1] * differentiate_logged_positions(self.recording)
        return self.filters.prepare(replace(self.recording, tau=speed + finite), self.chain)

    # Unprojected: damping acts on velocities alone.
    @cached_property
    def _velocity(self) -> Samples:
        """Samples whose torques are velocities; rows count where their direction is known."""
        found = self._divide(self.motion.samples())
        return drop_slow_rows(found, self.recording, self.chain.cutoff or np.inf)

    def _filter(self, signal: Array) -> Samples:
        """Return samples with a signal (N, n) in place of the torque, less reactions."""
        found = self._divide(self.motion.with_torque(signal).samples())
        return replace(found, tau=found.reactions.project_torque(self.model, found.q, found.tau))

    def _divide(self, samples: Samples) -> Samples:
        """Return samples without those at a torque limit, and without those held out."""
        reactions = samples.reactions.in_units_of(self.noise)
        kept = drop_saturated(replace(samples, reactions=reactions), self.recording)
        return kept if self.holdout is None else hold_out(kept, self.holdout)[0]

    def _list_runs(self) -> Iterable[_Run]:
        return self._kept or map(self._reduce_run, self._blocks)

    @cached_property
    def _blocks(self) -> tuple[tuple[SampleBlock, ...], ...]:
        """Neighbouring time blocks of a segment, `BLOCKS_AT_ONCE` at a time."""
        every = divide_into_blocks(self.model, [self._velocity], BLOCK_SECONDS)
        # Blocks of a segment share their start; over a gap no rows are made together.
        segments = [tuple(same) for _, same in groupby(every, key=lambda block: block.start)]
        return tuple(
            blocks[first : first + BLOCKS_AT_ONCE]
            for blocks in segments
            for first in range(0, len(blocks), BLOCKS_AT_ONCE)
        )

    @cached_property
    def _kept(self) -> tuple[_Run, ...] | None:
        """The rows of all blocks; None if they are too many to keep."""
        outputs = sum(block.n_outputs for blocks in self._blocks for block in blocks)
        rows = sum(support.size + 1 for support in self.support)
        # Eight bytes a number.
        few = 8.0 * outputs * rows <= MOST_HELD
        return tuple(map(self._reduce_run, self._blocks)) if few else None

    def _reduce_run(self, blocks: tuple[SampleBlock, ...]) -> _Run:
        whole = replace(blocks[0], last=blocks[-1].last)
        rows = whole.rows(self._plan)
        spans = tuple(
            slice(block.first - whole.first, block.last - whole.first) for block in blocks
        )
        grams = tuple(
            tuple(joint_rows[:, at] @ joint_rows[:, at].T for joint_rows in rows) for at in spans
        )
        counts = [
            [np.count_nonzero(np.any(joint_rows[:, at] != 0.0, axis=0)) for joint_rows in rows]
            for at in spans
        ]
        return _Run(whole, blocks, spans, rows, grams, np.array(counts))


def reduce_servo_recordings(
    motions: Sequence[CommandedMotion],
    recordings: Sequence[Recording],
    delay: float,
    rates: Sequence[Samples | None] | None = None,
) -> Equations:
    """Reduce recordings whose command acts after `delay` [s] to rows `[W_k, qd, du/dt, u - q]`.

    Where reactions are projected away, so they are from the signals, each times its gain: rows
    `[P W, P kd qd, P kp du/dt, P kp (u - q)]`.

    `motions` belong to the recordings, each of which has the servo that it is to have. `rates` are
    rates of the command that were made before, by recording. Raises `RecordingError` if no motion
    is left.
    """
    with use_one_blas_thread():
        blocks = [
            block
            for motion, recording, rate in zip(
                motions, recordings, rates or (None,) * len(motions), strict=True
            )
            for block in motion.grams(recording, delay, rate)
        ]
    if not blocks:
        raise RecordingError(
            f"{recordings[0].source}: no motion under the command is left for the servo",
            cure=Cure("record longer, or hold out less"),
            file=recordings[0].source,
        )
    times, grams, counts = zip(*blocks, strict=True)
    joints = tuple(np.array(gram) for gram in zip(*grams, strict=True))
    plan = motions[0].support
    p = motions[0].base.n_base
    n = len(plan)
    return Equations(
        {MODEL: p, VELOCITY: n, RATE: n},
        # A joint has its own velocity and its own command alone.
        tuple(np.append(own, [p + k, p + n + k]) for k, own in enumerate(plan)),
        joints,
        times,
        np.transpose(counts).astype(np.float64),
    )


def _join_gram(gram: Array, rows: Array, signals: Array) -> Array:
    """Return the Gram matrix (p + 2, p + 2) of rows (p, m), whose own is given, and signals."""
    p = len(gram)
    joined = np.empty((p + len(signals), p + len(signals)))
    joined[:p, :p] = gram
    joined[p:, :p] = signals @ rows.T
    joined[:p, p:] = joined[p:, :p].T
    joined[p:, p:] = signals @ signals.T
    return joined


CLUSTER = 5
"""Blocks together within which residuals are taken to be correlated."""


def fit_robust_residual(rows: Equations, k: int, used: Mask | None = None) -> Array:
    """Return the residual of a joint's fit to the blocks `used`, as a combination of its rows."""
    counting = np.ones(rows.n_blocks) if used is None else used.astype(np.float64)
    weight = counting
    # 4: passes of the robust weights, own choice.
    for _ in range(4):
        gram = rows.of_joint(k, weight)
        x = Scaled(gram[:-1, :-1]).solve(gram[:-1, -1])
        weight = counting * block_weights(rows, k, np.append(-x, 1.0))
    return np.append(-x, 1.0)


def usual_variances(rows: Equations, joints: Indices) -> Array:
    """Return the median mean square of the residuals of each joint over blocks (n,), else 1."""
    usual = np.ones(rows.n_joints)
    for k in joints.tolist():
        variances = block_variances(rows, k, fit_robust_residual(rows, k))
        if np.any(np.isfinite(variances)):
            # Exact simulations have residuals of zero, of which no ratio exists.
            usual[k] = max(float(np.nanmedian(variances)), 1e-300)
    return usual


REFINEMENT = 4
"""Intervals into which a refinement divides each side of the best value so far."""


def refine_minimum(
    costs: Callable[[float], Array], best: float, ratio: float, tolerance: float
) -> float:
    """Return the positive value of least cost within a ratio of the best that was tried.

    Grids of the logarithm, each around the best of the one before, until their step is below the
    tolerance. A goal that a limit delays is a rough function of the limit; an interpolation of it
    would end elsewhere by the last digit of the recording.
    """
    width = float(np.log(ratio))
    # Nearest first: of equal costs the value that was tried stays.
    places = sorted(range(-REFINEMENT, REFINEMENT + 1), key=abs)
    while width > tolerance:
        step = width / REFINEMENT
        grid = (best * np.exp(step * np.array(places))).tolist()
        best = min(grid, key=lambda value: float(np.sum(costs(value))))
        width = step
    return best


def logarithmic_error(costs: Callable[[float], Array], value: float, rows: Equations) -> float:
    """Return the standard error of the logarithm of a value, from the scores of the blocks.

    `costs` returns the costs of the blocks, (B,) or (joints, B).
    """
    step = 0.05
    # Differences by the logarithm of the value: the error is relative.
    up, here, down = (
        np.atleast_2d(costs(float(value * np.exp(s * step)))).sum(axis=0) for s in (1.0, 0.0, -1.0)
    )
    scores = sum_clusters((up - down) / (2.0 * step), rows)
    curvature = float(np.sum(up + down - 2.0 * here)) / step**2
    # Sandwich: scatter of the scores over the curvature of the cost.
    return float(np.sqrt(np.sum(scores**2)) / curvature) if curvature > 0.0 else float("inf")


def block_energies(rows: Equations, k: int, residual: Array) -> Array:
    """Return the square in each block of a combination of joint k's rows (B,).

    It is not known to be smaller than what rounding leaves of it: where rows excite little, large
    coefficients cancel, and a square of zero would have all of the weight.
    """
    size = np.abs(residual)
    rounding = np.finfo(float).eps * np.einsum("i,bij,j->b", size, np.abs(rows.grams[k]), size)
    return np.asarray(np.maximum(rows.energies(k, residual), rounding))


def block_variances(rows: Equations, k: int, residual: Array) -> Array:
    """Return the mean square in each block of a combination of joint k's rows (B,), NaN if few."""
    count = rows.counts[k]
    # The mean of few rows is mostly their fit.
    many = count >= FEWEST_ROWS
    return np.where(many, block_energies(rows, k, residual) / np.maximum(count, 1), np.nan)


def block_weights(rows: Equations, k: int, residual: Array) -> Array:
    """Return `1 / (1 + r / median(r))` with the residual variance r of a joint in each block."""
    left = block_variances(rows, k, residual)
    if np.all(np.isnan(left)):
        return np.ones(left.size)
    # A block of too few rows weighs as the median one does: 1 / (1 + 1).
    return np.nan_to_num(1.0 / (1.0 + left / max(float(np.nanmedian(left)), 1e-300)), nan=0.5)


def sum_clusters(scores: Array, rows: Equations) -> Array:
    """Return the sums of scores (B, ...) over neighbouring blocks, `CLUSTER` at a time."""
    sources = np.array([block.source for block in rows.blocks])
    # A cluster ends with its recording: residuals of two are not correlated.
    firsts = [k for k in range(len(scores)) if k % CLUSTER == 0 or sources[k] != sources[k - 1]]
    return np.add.reduceat(scores, firsts)


@dataclass(frozen=True, slots=True, kw_only=True)
class ServoErrors:
    """Hold what is known of the errors of a servo.

    Parameters
    ----------
    kp
        Standard errors of the stiffness (n,), 0 where it was given, infinite where nothing
        determines it.
    delay
        Standard error of the delay [s], 0 where it was given.
    lead
        Standard error of the lead [s], 0 where it was given or none was searched.
    goal_acceleration
        Standard error of the limit of the goal's acceleration [rad/s^2 or m/s^2], 0 where it was
        given or not found in every recording.
    goal_sought
        Whether the limit of each joint was searched in the recordings.
    deadband
        Standard error of the deadband [rad or m], 0 where it was given or none was found.
    shared
        Whether one stiffness was fitted to all joints.
    scale
        What gives the stiffness of each joint its scale: gravity or inertia of CAD, or "given".
    kd_unknown
        Whether the damping of each joint is unknown and part of its viscous friction.
    """

    kp: tuple[float, ...] = field(default=(), metadata=store_as(missing=np.inf))
    delay: float = 0.0
    lead: float = 0.0
    goal_acceleration: float = 0.0
    goal_sought: tuple[bool, ...] = ()
    deadband: float = 0.0
    shared: bool = False
    scale: tuple[str, ...] = ()
    kd_unknown: tuple[bool, ...] = ()

    @property
    def condition(self) -> str:
        """What estimates take as given of the servo, in a sentence; empty if its gains were given.

        Its torque is known up to its stiffness, which CAD gives a scale if nothing else does:
        bodies of another scale, with a stiffness of that scale, move alike.
        """
        if all(source == "given" for source in self.scale):
            return ""
        return (
            "The stiffness of the servo is not given and takes its scale from CAD: all masses,"
            " inertias and armatures may be larger or smaller by one common factor as well."
        )
