"""Single samples of the torque that stand out from their neighbours."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from asbuilt.arrays import Array, Indices, Mask
from asbuilt.experiment.recording import Recording, find_changed_rows

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
    # Quantiles of as many samples as decide.
    some = slice(None, None, max(1, places.size // 20_000))
    found = []
    for k in range(tau.shape[1]):  # one by one: a long log leaves no room for all of them
        x = tau[:, k] if places.size == len(tau) else tau[places, k]
        steps = np.diff(x)
        sizes = np.abs(steps)
        prominence = np.minimum(sizes[1:], sizes[:-1])
        # Above both neighbours or below both: the steps have opposite signs.
        prominence *= steps[1:] * steps[:-1] < 0.0
        low, high = np.quantile(x[some], [0.005, 0.995])
        # Own choices, tested on 25 real logs: a spike has 15 times the prominence that noise
        # reaches, and a tenth of the range of the torque;
        if not prominence.max() > 0.1 * (high - low):
            continue
        usual = np.quantile(prominence[some], 0.9)
        rows = np.flatnonzero(prominence > max(15.0 * usual, 0.1 * (high - low)))
        above = prominence[rows]
        # its neighbours are alike, and the three steps before and after it smaller, as in ringing
        # they are not.
        lone = np.abs(steps[rows + 1] + steps[rows]) < 0.5 * above
        nearby = np.clip(rows[:, None] + NEIGHBOURS, 0, len(steps) - 1)
        lone &= above > 3.0 * np.max(sizes[nearby], axis=1)
        # More than a twentieth of the samples are no outliers.
        if 0 < np.count_nonzero(lone) <= 0.05 * len(prominence):
            found.append(Spikes(k, places[rows[lone] + 1], above[lone]))
    return found


def replace_spikes(recording: Recording) -> Recording:
    """Return the recording with the mean of their neighbours in place of torques that stand out."""
    if recording.torque_source == "command" or recording.n_samples < FEWEST:
        return recording
    tau = np.array(recording.tau)
    found = find_spikes(tau, find_changed_rows(tau, recording.q))
    for spike in found:
        x = tau[:, spike.joint]
        # Interpolated over neighbours that stand out themselves.
        usual = np.setdiff1d(np.arange(len(x)), spike.rows)
        x[spike.rows] = np.interp(spike.rows, usual, x[usual])
    return replace(recording, tau=tau) if found else recording
