"""What a robot's logs of one day hold about its parameters: inner products of their columns."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING

import numpy as np

from asbuilt.arrays import Array

if TYPE_CHECKING:
    from asbuilt.workflow.fleet.ledger.entry import Entry


@dataclass(frozen=True, slots=True, eq=False)
class Day:
    """Hold the information of the logs of a day.

    Parameters
    ----------
    date, last
        When the first and the last log began.
    n_logs, n_samples
        Number of logs and of samples.
    grams
        `X_k^T X_k` of each joint k, X_k its columns of base parameters, the torque, and the torques
        of two base tilts where the ledger has them, (p_k + 1, p_k + 1) or (p_k + 3, p_k + 3).
    covariates
        Means of temperatures that were logged.
    """

    date: datetime
    last: datetime
    n_logs: int
    n_samples: int
    grams: tuple[Array, ...]
    covariates: Mapping[str, float]


def day_of(entry: Entry) -> Day:
    """Return a log as a day of its own."""
    grams = []
    for k, factors in enumerate(entry.whole.factors):
        R = factors[0]
        gram = R.T @ R
        if entry.tilt:
            q, products = len(gram), entry.tilt[k]
            wider = np.empty((q + 2, q + 2))
            wider[:q, :q] = gram
            wider[:, q:] = products
            wider[q:, :q] = products[:q].T
            gram = wider
        grams.append(gram)
    means = {
        name: float(np.nanmean(values))
        for name, values in entry.covariates.items()
        if np.isfinite(values).any()
    }
    return Day(entry.date, entry.date, 1, entry.whole.n_samples, tuple(grams), means)


def by_day(logs: Iterable[Day]) -> tuple[Day, ...]:
    """Merge the logs of each day (UTC), in order of time."""
    groups: dict[str, list[Day]] = {}
    for each in sorted(logs, key=lambda day: day.date):
        groups.setdefault(f"{each.date.astimezone(UTC):%Y-%m-%d}", []).append(each)
    return tuple(_together(group) for group in groups.values())


def _together(group: Sequence[Day]) -> Day:
    if len(group) == 1:
        return group[0]
    grams = []
    for parts in zip(*(day.grams for day in group), strict=True):
        size = min(len(part) for part in parts)
        grams.append(np.sum([part[:size, :size] for part in parts], axis=0))
    names = set.intersection(*(set(day.covariates) for day in group))
    total = sum(day.n_samples for day in group)
    means = {
        name: sum(day.covariates[name] * day.n_samples for day in group) / total for name in names
    }
    return Day(
        group[0].date,
        group[-1].last,
        sum(day.n_logs for day in group),
        total,
        tuple(grams),
        means,
    )
