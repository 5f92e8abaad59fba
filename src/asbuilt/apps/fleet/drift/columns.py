"""Inner products of a robot's logs day by day, and the columns in which it may change."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np
from scipy.linalg import block_diag

from asbuilt.apps.fleet.ledger.entry import Entry
from asbuilt.apps.fleet.ledger.settings import TypeSettings
from asbuilt.arrays import Array, Indices
from asbuilt.dynamics import BaseParameters
from asbuilt.validation import torque_units

TILTS = 2
UNDETERMINED = 1e-9
"""Weight, in the mean information of a column, of what keeps an undetermined direction."""


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


def make_day(entry: Entry) -> Day:
    """Return a log as a day of its own."""
    grams = []
    for k, factors in enumerate(entry.whole.factors):
        gram = factors[0].T @ factors[0]
        if entry.tilt:
            above, below = np.split(entry.tilt[k], [len(gram)])
            gram = np.block([[gram, above], [above.T, below]])
        grams.append(gram)
    means = {
        name: float(np.nanmean(values))
        for name, values in entry.covariates.items()
        if np.isfinite(values).any()
    }
    return Day(entry.date, entry.date, 1, entry.whole.n_samples, tuple(grams), means)


def merge_by_day(logs: Iterable[Day]) -> tuple[Day, ...]:
    """Merge the logs of each day (UTC), in order of time."""
    groups: dict[str, list[Day]] = {}
    for each in sorted(logs, key=lambda day: day.date):
        groups.setdefault(f"{each.date.astimezone(UTC):%Y-%m-%d}", []).append(each)
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
        total,
        sum_days(group),
        means,
    )


@dataclass(frozen=True, eq=False)
class FleetColumns:
    """Describe the columns of a robot type: p base parameters, n torque gains, two base tilts.

    A change x (p + n + 2,) of them changes the torque of joint k by `W_k x_W + tau_k x_gain,k +
    T_k x_tilt`, to first order.

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

    def map_to(self, joint: int, beta: Array, rows: int) -> Array:
        """Return L with `[columns | error] = [W_k | tau_k | T_k] L` about the parameters beta.

        The error is `tau_k - W_k beta`, last; L has shape (rows, size + 1), rows p_k + 1, or p_k +
        3 with tilts.
        """
        places = self.support[joint]
        m = len(places)
        p = self.base.n_base
        L = np.zeros((rows, self.size + 1))
        L[np.arange(m), places] = 1.0
        L[:m, p + joint] = beta[places]
        L[:m, -1] = -beta[places]
        L[m, -1] = 1.0
        L[m + 1 :, p + self.n_joints : -1] = np.eye(rows - m - 1, TILTS)
        return L

    def information(
        self,
        grams: Sequence[Array],
        beta: Array,
        weights: Array,
        basis: Array | None = None,
    ) -> Array:
        """Return the Gram matrix of all joints' weighted columns (times `basis`) and the error."""
        wider = block_diag(np.eye(self.size) if basis is None else basis, np.eye(1))
        total = np.zeros((wider.shape[1], wider.shape[1]))
        for k, gram in enumerate(grams):
            L = self.map_to(k, beta, len(gram)) @ wider
            total += weights[k] ** 2 * (L.T @ gram @ L)
        return total

    def energies(self, grams: Sequence[Array], x: Array, beta: Array) -> Array:
        """Return the sum of squares of a torque at each joint, (n,).

        It is the torque of a change x (size,); a last element of x adds that multiple of the error
        about beta.
        """
        found = np.empty(self.n_joints)
        for k, gram in enumerate(grams):
            y = self.map_to(k, beta, len(gram))[:, : len(x)] @ x
            found[k] = max(float(y @ gram @ y), 0.0)
        return found

    def fit(self, grams: Sequence[Array], weights: Array, toward: Array) -> Array:
        """Return the base parameters by weighted least squares, undetermined ones `toward`."""
        p = self.base.n_base
        A = np.zeros((p, p))
        b = np.zeros(p)
        for k, gram in enumerate(grams):
            places = self.support[k]
            w = weights[k] ** 2
            m = len(places)
            A[np.ix_(places, places)] += w * gram[:m, :m]
            b[places] += w * gram[:m, m]
        size = np.sqrt(np.where(np.diag(A) > 0.0, np.diag(A), 1.0))
        A = A / np.outer(size, size) + UNDETERMINED * np.eye(p)
        return np.asarray(np.linalg.solve(A, b / size + UNDETERMINED * toward * size) / size)

    def residual_energy(self, grams: Sequence[Array], beta: Array) -> Array:
        """Return `|tau_k - W_k beta|^2` of every joint, (n,)."""
        return self.energies(grams, np.append(np.zeros(self.size), 1.0), beta)


def sum_days(days: Sequence[Day]) -> tuple[Array, ...]:
    """Return the Gram matrices of several days together."""
    found = []
    for parts in zip(*(day.grams for day in days), strict=True):
        size = min(map(len, parts))
        found.append(np.sum([part[:size, :size] for part in parts], axis=0))
    return tuple(found)
