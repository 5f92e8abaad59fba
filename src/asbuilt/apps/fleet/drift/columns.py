"""Equations of a robot's logs day by day, and the columns in which it may change."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime

import numpy as np

from asbuilt.apps.fleet.ledger.entry import Entry
from asbuilt.apps.fleet.ledger.settings import TypeSettings
from asbuilt.arrays import Array, Indices
from asbuilt.dynamics import BaseParameters
from asbuilt.identification import MODEL, TILT, Equations
from asbuilt.validation import torque_units

TILTS = 2
GAIN = "gain"
"""Group of the columns of torque gains, and the effect that changes them."""
UNDETERMINED = 1e-9
"""Weight, in the mean information of a column, of what keeps an undetermined direction."""


@dataclass(frozen=True, slots=True, eq=False)
class Day:
    """Hold the equations of the logs of a day, in base parameters and two base tilts.

    Parameters
    ----------
    date, last
        When the first and the last log began.
    n_logs
        Number of logs.
    equations
        Their equations, as one block.
    covariates
        Means of temperatures that were logged.
    """

    date: datetime
    last: datetime
    n_logs: int
    equations: Equations
    covariates: Mapping[str, float]

    @property
    def n_samples(self) -> int:
        """Number of samples."""
        return self.equations.blocks[0].n_samples


def make_day(entry: Entry) -> Day:
    """Return a log as a day of its own; without torques of tilts it says nothing of them."""
    whole = entry.whole
    grams = []
    for k, factors in enumerate(whole.factors):
        s = factors.shape[-1] - 1
        gram = np.zeros((s + TILTS + 1,) * 2)
        # The torque is the last column here, where the ledger has that of tilts after it.
        own = [*range(s), s + TILTS]
        gram[np.ix_(own, own)] = factors[0].T @ factors[0]
        if entry.tilt:
            order = [*own, *range(s, s + TILTS)]
            gram[order, s : s + TILTS] = entry.tilt[k]
            gram[s : s + TILTS, order] = entry.tilt[k].T
        grams.append(gram[None])
    p = whole.base.n_base
    equations = Equations(
        {MODEL: p, TILT: TILTS},
        tuple(np.append(own, p + np.arange(TILTS)) for own in whole.support),
        tuple(grams),
        whole.blocks,
        np.full((whole.n_joints, 1), float(whole.n_samples)),
    )
    means = {
        name: float(np.nanmean(values))
        for name, values in entry.covariates.items()
        if np.isfinite(values).any()
    }
    return Day(entry.date, entry.date, 1, equations, means)


def merge_by_day(logs: Iterable[Day]) -> tuple[Day, ...]:
    """Merge the logs of each day (UTC), in order of time."""
    groups: dict[str, list[Day]] = {}
    for log in sorted(logs, key=lambda day: day.date):
        groups.setdefault(f"{log.date.astimezone(UTC):%Y-%m-%d}", []).append(log)
    return tuple(_merge_days(group) for group in groups.values())


def _merge_days(group: Sequence[Day]) -> Day:
    if len(group) == 1:
        return group[0]
    names = set.intersection(*(set(day.covariates) for day in group))
    total = sum(day.n_samples for day in group)
    means = {
        name: sum(day.covariates[name] * day.n_samples for day in group) / total for name in names
    }
    return Day(
        group[0].date,
        group[-1].last,
        sum(day.n_logs for day in group),
        sum_days(group),
        means,
    )


@dataclass(frozen=True, eq=False)
class FleetColumns:
    """Describe the columns of a robot type: p base parameters, n torque gains, two base tilts.

    A change x (p + n + 2,) of them changes the torque of joint k by `W_k x_W + tau_k x_gain,k +
    T_k x_tilt`, to first order (`about`).

    Parameters
    ----------
    base
        The base parameters.
    support
        Base parameters of each joint's columns.
    joint_names, joint_units
        Names of the joints, and N m or N.
    tool_link
        Link that carries a payload, counted from 0.
    """

    base: BaseParameters
    support: tuple[Indices, ...]
    joint_names: tuple[str, ...]
    joint_units: tuple[str, ...]
    tool_link: int

    @classmethod
    def of(cls, settings: TypeSettings) -> FleetColumns:
        """Return the columns of a type of a ledger."""
        model = settings.model
        support = tuple(settings.plan.support)
        return cls(settings.base, support, model.joint_names, torque_units(model), model.tool_link)

    @property
    def n_joints(self) -> int:
        """Number of joints n."""
        return len(self.support)

    @property
    def size(self) -> int:
        """Number of columns, p + n + 2."""
        return self.base.n_base + self.n_joints + TILTS

    def about(self, equations: Equations, beta: Array) -> Equations:
        """Return equations of the error about the parameters beta, with gains as columns.

        The error is `tau_k - W_k beta`. A gain changes the torque of its joint by `W_k beta`: what
        the model explains of it, to first order.
        """
        p = self.base.n_base
        n = self.n_joints
        grams = []
        for own, gram in zip(self.support, equations.grams, strict=True):
            s = len(own)
            L = np.zeros((s + TILTS + 1, s + 1 + TILTS + 1))
            L[:s, :s] = np.eye(s)
            L[:s, s] = beta[own]
            L[s:-1, s + 1 : -1] = np.eye(TILTS)
            L[:s, -1] = -beta[own]
            L[-1, -1] = 1.0
            grams.append(L.T @ gram @ L)
        tilts = p + n + np.arange(TILTS)
        return replace(
            equations,
            groups={MODEL: p, GAIN: n, TILT: TILTS},
            support=tuple(
                np.concatenate([own, [p + k], tilts]) for k, own in enumerate(self.support)
            ),
            grams=tuple(grams),
        )

    def fit(self, equations: Equations, weights: Array, toward: Array) -> Array:
        """Return the base parameters by weighted least squares, undetermined ones `toward`."""
        p = self.base.n_base
        gram = equations.stacked(weights)
        A = gram[:p, :p]
        size = np.sqrt(np.where(np.diag(A) > 0.0, np.diag(A), 1.0))
        A = A / np.outer(size, size) + UNDETERMINED * np.eye(p)
        b = gram[:p, -1] / size + UNDETERMINED * toward * size
        return np.asarray(np.linalg.solve(A, b) / size)

    def residual_energy(self, equations: Equations, beta: Array) -> Array:
        """Return `|tau_k - W_k beta|^2` of every joint, (n,)."""
        return equations.energy(np.append(beta, np.zeros(TILTS)))


def sum_days(days: Sequence[Day]) -> Equations:
    """Return the equations of several days together."""
    first, *others = (day.equations for day in days)
    return first.merge(*others).together()
