"""Commanded motion reduced to Gram matrices of each joint and time block."""

from __future__ import annotations

from collections.abc import Sequence
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
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.signal.hold_out import hold_out
from asbuilt.experiment.signal.preparation import prepare_samples
from asbuilt.experiment.signal.signal_chain import SignalChain
from asbuilt.identification.information.rows import TimeBlock, sample_blocks

if TYPE_CHECKING:
    from asbuilt.experiment.signal.samples import Samples

BESIDE = 3
"""Further rows of a joint: velocity, rate of the command and control error."""
BLOCK = 1.0
"""Length of a time block [s], short enough to leave out contact and little else."""
TRACE = 1e-13
"""Increase per sample that is added to each signal, so that no row counts as a repeated one."""


@dataclass(frozen=True, slots=True, eq=False)
class ServoRows:
    """Hold Gram matrices of the rows `[W_k, qd, du/dt, u - q]` of each joint and time block.

    `grams[k]` has shape (B, p_k + 3, p_k + 3) for B blocks, with p_k = `support[k].size`.
    """

    support: tuple[Indices, ...]
    grams: tuple[Array, ...]
    times: tuple[TimeBlock, ...]

    @property
    def counts(self) -> Array:
        """Rows of each block, shape (B,)."""
        return np.array([each.n_samples for each in self.times], dtype=np.float64)

    def total(self, joint: int, weight: Array | None = None) -> Array:
        """Return the sum of the Gram matrices of a joint over all blocks, weighted (B,)."""
        return np.asarray(
            np.tensordot(
                np.ones(len(self.times)) if weight is None else weight, self.grams[joint], 1
            )
        )

    def energies(self, joint: int, coefficients: Array) -> Array:
        """Return the sum of squares in each block of a combination of the rows, shape (B,)."""
        return np.einsum("i,bij,j->b", coefficients, self.grams[joint], coefficients)


def servo_rows(
    model: RobotModel,
    base: BaseParameters,
    recordings: Sequence[Recording],
    chain: SignalChain,
    delay: float,
    holdout: str | None = None,
) -> ServoRows:
    """Reduce recordings whose command acts after `delay` [s], without what is held out."""
    plan = RegressorPlan.of(model, base.drive, base.columns, spare_rows=BESIDE)
    grams: list[list[Array]] = []
    times = []
    with one_blas_thread():
        for recording in recordings:
            parts = _channels(recording, chain, delay)
            if holdout is not None:
                parts = [hold_out(each, holdout)[0] for each in parts]
            for block in sample_blocks(model, [parts[-1]], BLOCK):
                sums = None
                for chunk in block.chunks(
                    plan, lambda span, parts=parts: [each.tau[span] for each in parts[:-1]]
                ):
                    own = [rows @ rows.T for rows in chunk]
                    sums = own if sums is None else [a + b for a, b in zip(sums, own, strict=True)]
                if sums is not None:
                    grams.append(sums)
                    times.append(replace(block.time, source=recording.source))
    joints = tuple(np.array(own) for own in zip(*grams, strict=True))
    return ServoRows(plan.support, joints, tuple(times))


def _channels(recording: Recording, chain: SignalChain, delay: float) -> list[Samples]:
    """Return samples whose torques are velocity, rate of the command, and control error."""
    trace = TRACE * np.arange(recording.n_samples)[:, None]
    signals = (
        logged_velocity(recording),
        command_rate(recording, delay),
        held_command(recording, delay) - recording.q,
    )
    return [
        outside_saturation(prepare_samples(replace(recording, tau=each + trace), chain), recording)
        for each in signals
    ]
