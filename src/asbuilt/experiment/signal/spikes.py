"""Single samples of the torque that stand out from their neighbours."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from asbuilt.arrays import Array, Indices, Mask, find_true_rows
from asbuilt.experiment.recording import Recording


@dataclass(frozen=True, slots=True)
class SpikeRules:
    """Say which sample is an outlier; own choices, tested on 25 real logs.

    Parameters
    ----------
    usual
        Quantile of the prominence of all samples that noise reaches.
    times
        How many times that a spike exceeds it.
    share
        Share of the range of the torque that a spike has at least.
    alike
        Difference of its two neighbours, in prominences, at most.
    calm
        How many times that it exceeds the largest of the three steps before and after it, so that
        ringing is none.
    most
        Share of the samples beyond which they are no outliers.
    """

    usual: float = 0.9
    times: float = 15.0
    share: float = 0.1
    alike: float = 0.5
    calm: float = 3.0
    most: float = 0.05


RULES = SpikeRules()
NEIGHBOURS = np.array([-3, -2, -1, 2, 3, 4])
"""Steps next to the two of a spike, from the first of them."""
FEWEST = 20
"""Samples that differ from the one before, at least."""


@dataclass(frozen=True, slots=True, eq=False)
class Spikes:
    """Hold the rows at which the torque of a joint (from 0) stands out, and by how much."""

    joint: int
    rows: Indices
    sizes: Array


def find_spikes(tau: Array, not_repeated: Mask) -> list[Spikes]:
    """Return the spikes of torques (N, n); samples that repeat the one before do not count.

    The prominence of a sample is by how much it is above both neighbours, or below both. A spike
    has many times the prominence of noise, and neighbours that are alike.

    >>> x = np.sin(np.linspace(0.0, 6.0, 200))[:, None]
    >>> x[50] += 2.0
    >>> [each.rows.tolist() for each in find_spikes(x, np.full(200, True))]
    [[50]]
    """
    places = np.flatnonzero(not_repeated)
    if places.size < FEWEST:
        return []
    some = slice(None, None, max(1, places.size // 20_000))
    found = []
    for k in range(tau.shape[1]):  # one by one: a long log leaves no room for all of them
        x = tau[:, k] if places.size == len(tau) else tau[places, k]
        steps = np.diff(x)
        sizes = np.abs(steps)
        prominence = np.minimum(sizes[1:], sizes[:-1])
        prominence *= steps[1:] * steps[:-1] < 0.0
        low, high = np.quantile(x[some], [0.005, 0.995])
        usual = np.quantile(prominence[some], RULES.usual)
        least = max(RULES.times * usual, RULES.share * (high - low))
        rows = np.flatnonzero(prominence > least)
        above = prominence[rows]
        lone = np.abs(steps[rows + 1] + steps[rows]) < RULES.alike * above
        nearby = np.clip(rows[:, None] + NEIGHBOURS, 0, len(steps) - 1)
        lone &= above > RULES.calm * np.max(sizes[nearby], axis=1)
        if 0 < np.count_nonzero(lone) <= RULES.most * len(prominence):
            found.append(Spikes(k, places[rows[lone] + 1], above[lone]))
    return found


def without_spikes(recording: Recording) -> Recording:
    """Return the recording with the mean of their neighbours in place of torques that stand out."""
    if recording.torque_source == "command" or recording.n_samples < FEWEST:
        return recording
    tau = np.array(recording.tau)
    changed = find_true_rows(tau[1:] != tau[:-1]) | find_true_rows(
        recording.q[1:] != recording.q[:-1]
    )
    found = find_spikes(tau, np.concatenate([[True], changed]))
    if not found:
        return recording
    for each in found:
        x = tau[:, each.joint]
        usual = np.setdiff1d(np.arange(len(x)), each.rows)
        x[each.rows] = np.interp(each.rows, usual, x[usual])
    return replace(recording, tau=tau)
