"""Commanded motion reduced to Gram matrices of each joint and time block."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from asbuilt.arrays import Array, Indices
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import BaseParameters
from asbuilt.dynamics.kernels.blas import one_blas_thread
from asbuilt.dynamics.regressor import RegressorPlan
from asbuilt.experiment.command.saturation import outside_saturation
from asbuilt.experiment.command.servo_torque import command_rate, held_command, logged_velocity
from asbuilt.experiment.command.slow_motion import moving_faster
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.signal.hold_out import hold_out
from asbuilt.experiment.signal.preparation import prepare_samples
from asbuilt.experiment.signal.signal_chain import SignalChain
from asbuilt.identification.information.rows import TimeBlock, sample_blocks

if TYPE_CHECKING:
    from asbuilt.experiment.signal.samples import Samples

BESIDE = 3
"""Further rows of a joint: velocity, rate of the command and control error."""
FEWEST = 5
"""Rows of a joint in a block below which it says nothing of the residual."""
BLOCK = 1.0
"""Length of a time block [s], short enough to leave out contact and little else."""
TRACE = 1e-13
"""Increase per sample that is added to each signal, so that no row counts as a repeated one."""


@dataclass(frozen=True, slots=True, eq=False)
class ServoRows:
    """Hold Gram matrices of the rows `[W_k, qd, du/dt, u - q]` of each joint and time block.

    `grams[k]` has shape (B, p_k + 3, p_k + 3) for B blocks, with p_k = `support[k].size`;
    `counts` (n, B) are the rows that count.
    """

    support: tuple[Indices, ...]
    grams: tuple[Array, ...]
    counts: Array
    times: tuple[TimeBlock, ...]

    def total(self, joint: int, weight: Array | None = None) -> Array:
        """Return the sum of the Gram matrices of a joint over all blocks, weighted (B,)."""
        return np.asarray(
            np.tensordot(
                np.ones(len(self.times)) if weight is None else weight, self.grams[joint], 1
            )
        )

    def variances(self, joint: int, residual: Array) -> Array:
        """Return the mean square in each block of a combination of the rows (B,), NaN if few."""
        energy = np.einsum("i,bij,j->b", residual, self.grams[joint], residual)
        count = self.counts[joint]
        return np.where(count >= FEWEST, np.maximum(energy, 0.0) / np.maximum(count, 1), np.nan)


def servo_rows(
    model: RobotModel,
    base: BaseParameters,
    recordings: Sequence[Recording],
    chain: SignalChain,
    delay: float,
    holdout: str | None = None,
    beside: Sequence[Sequence[Samples]] | None = None,
) -> ServoRows:
    """Reduce recordings whose command acts after `delay` [s], without what is held out.

    `beside` are the samples of velocities and rates of the command, by recording, if they were
    made before: `slow_channels`.
    """
    plan = RegressorPlan.of(model, base.drive, base.columns, spare_rows=BESIDE)
    grams: list[list[Array]] = []
    times, counts = [], []
    with one_blas_thread():
        for number, recording in enumerate(recordings):
            slow = slow_channels(recording, chain, delay) if beside is None else beside[number]
            parts = [*slow, _control_error(recording, chain, delay)]
            if holdout is not None:
                parts = [hold_out(each, holdout)[0] for each in parts]
            for block in sample_blocks(model, [parts[-1]], BLOCK):
                sums, count = None, np.zeros(model.n_joints)
                for chunk in block.chunks(plan, _beside(parts[:-1])):
                    own = [rows @ rows.T for rows in chunk]
                    count += [np.count_nonzero(np.any(rows != 0.0, axis=0)) for rows in chunk]
                    sums = own if sums is None else [a + b for a, b in zip(sums, own, strict=True)]
                if sums is not None:
                    grams.append(sums)
                    counts.append(count)
                    times.append(replace(block.time, source=recording.source))
    joints = tuple(np.array(own) for own in zip(*grams, strict=True))
    return ServoRows(plan.support, joints, np.transpose(counts), tuple(times))


def slow_channels(recording: Recording, chain: SignalChain, delay: float) -> list[Samples]:
    """Return samples whose torques are the velocity and the rate of the command."""
    signals = (logged_velocity(recording), command_rate(recording, delay))
    return [_with_signal(recording, chain, each) for each in signals]


def _control_error(recording: Recording, chain: SignalChain, delay: float) -> Samples:
    """Return samples whose torques are the control error."""
    error = held_command(recording, delay) - recording.q
    if recording.servo is not None:
        error = recording.servo.acting(error)
    found = _with_signal(recording, chain, error)
    return moving_faster(found, recording, chain.cutoff or np.inf)


def _with_signal(recording: Recording, chain: SignalChain, signal: Array) -> Samples:
    """Return samples with a signal (N, n) in place of the torque."""
    trace = TRACE * np.arange(recording.n_samples)[:, None]
    samples = prepare_samples(replace(recording, tau=signal + trace), chain)
    return outside_saturation(samples, recording)


def _beside(parts: Sequence[Samples]) -> Callable[[slice], list[Array]]:
    """Return what gives the signals of samples on a span."""
    return lambda span: [each.tau[span] for each in parts]
