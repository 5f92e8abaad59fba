"""What a rollout is compared with: repetitions of a command, and the command without physics."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.spatial import KDTree

from asbuilt.arrays import Array
from asbuilt.identification.calibration.delay import RULES

if TYPE_CHECKING:
    from asbuilt.identification.trajectories.windows import Windows


# Say when two windows have the same command: own choices.
#
# At every one of `REPETITION_POINTS` times of the window each joint's command must agree within
# `REPETITION_TOLERANCE` of its range in all windows, and the command must move by
# `REPETITION_MOVING` of it.

REPETITION_POINTS = 8
REPETITION_TOLERANCE = 2e-3
REPETITION_MOVING = 0.02


ROUNDING = 1e-3
"""Share of a period by which times of samples and commands differ by rounding."""


def pair_repeated_windows(windows: Sequence[Windows]) -> tuple[list[Array], list[Array]] | None:
    """Return the positions of pairs of windows with the same command; None if there are none.

    Recordings whose windows have another number of samples than most are left out. Two lists of
    one array (pairs, L, n).
    """
    if any(window.signal.kind != "command" for window in windows):
        return None
    lengths = [window.n_samples for window in windows]
    usual = max(lengths, key=lengths.count)
    windows = [window for window in windows if window.n_samples == usual]
    commands = _stack_commands(windows)
    q = np.concatenate([window.q for window in windows])
    size = np.ptp(commands, axis=(0, 1))
    if len(q) < 2 or not np.any(size > 0.0):
        return None
    # Joints without commands that move never differ.
    scaled = commands / np.where(size > 0.0, size, np.inf)
    # Rests repeat by themselves, and say nothing.
    moves = np.ptp(scaled, axis=1).max(axis=1) > REPETITION_MOVING
    places = np.flatnonzero(moves)
    # A few times are enough to tell commands apart.
    at = np.linspace(0, scaled.shape[1] - 1, REPETITION_POINTS).astype(int)
    if len(places) < 2:
        return None
    tree = KDTree(scaled[places][:, at].reshape(len(places), -1))
    pairs = tree.query_pairs(REPETITION_TOLERANCE, p=np.inf, output_type="ndarray")
    if not len(pairs):
        return None
    first = places[pairs[:, 0]]
    second = places[pairs[:, 1]]
    return [q[first]], [q[second]]


def _stack_commands(windows: Sequence[Windows]) -> Array:
    """Return the command at the samples of all windows, shape (W, L, n)."""
    parts = []
    for window in windows:
        # Times that agree up to rounding take the command of the same sample.
        times = window.starts[:, None] + window.times + ROUNDING / window.rate
        at = np.searchsorted(window.signal.t, times, side="right") - 1
        parts.append(window.signal.values[np.clip(at, 0, len(window.signal.t) - 1)])
    return np.concatenate(parts)


def delay_command(windows: Windows) -> Array | None:
    """Return the motion of the command from the measured position, shape (W, L, n).

    It is delayed by the time that fits the windows best. None if torques drive.
    """
    if windows.signal.kind != "command":
        return None
    times = windows.starts[:, None] + windows.times

    def delayed(delay: float) -> Array:
        command = np.stack(
            [np.interp(times - delay, windows.signal.t, u) for u in windows.signal.values.T],
            axis=-1,
        )
        # From the measured start on: only the motion of the command counts.
        return np.asarray(command - command[:, :1] + windows.start_q[:, None])

    found = minimize_scalar(
        lambda delay: float(np.mean((delayed(delay) - windows.q)[:, 1:] ** 2)),
        bounds=(0.0, RULES.farthest),
        method="bounded",
    )
    return delayed(float(found.x))
