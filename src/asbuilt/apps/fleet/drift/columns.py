"""Equations of a robot's logs day by day, and the effects and directions in which it may change."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime

import numpy as np

from asbuilt.apps.fleet.ledger.entry import Entry
from asbuilt.apps.fleet.ledger.settings import TypeSettings
from asbuilt.arrays import Array, Indices
from asbuilt.dynamics import BaseParameters
from asbuilt.identification import LINKS, MODEL, TILT, Equations, locate_drive_parameters
from asbuilt.scaled import Scaled
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


PAYLOAD = "payload"
"""Key of an effect of a robot, as in `EFFECTS`."""


@dataclass(frozen=True, slots=True, eq=False)
class Source:
    """Describe an effect that can change.

    Parameters
    ----------
    effect, joint
        Its key, and the joint from 0; None for an effect of the whole robot.
    design
        The change of the columns by a unit of each of its m parameters, (size, m).
    """

    effect: str
    joint: int | None
    design: Array


def list_sources(columns: FleetColumns) -> tuple[Source, ...]:
    """Return the effects that can change in a robot type; without those that its columns lack."""
    n = columns.n_joints
    base = columns.base
    unit = np.eye(columns.size)
    found = [
        Source(effect, k, unit[:, places])
        for k in range(n)
        for effect, places in locate_drive_parameters(base, k).items()
    ]
    found += [Source(GAIN, k, unit[:, [base.n_base + k]]) for k in range(n)]
    K = unit[:, : base.n_base] @ base.regrouping[:, 10 * columns.tool_link :][:, :10]
    links = np.flatnonzero(base.columns < 10 * base.n_links)
    return (
        *found,
        Source(PAYLOAD, None, K),
        Source(TILT, None, unit[:, -2:]),
        Source(LINKS, None, unit[:, links]),
    )


# Sizes of changes that robots usually undergo; they choose directions, and bias nothing.
#
# Shares of friction and armature, a gain, a tilt [rad], and inertia [kg m^2], first moments [kg m]
# and mass [kg] of a payload. Offsets and mass distributions are changed by `USUAL_CHANGES_OTHERS`,
# and all at most by `USUAL_CHANGES_MOST`, in standard errors of a day of the change alone.

USUAL_CHANGES_FRICTION = 0.3
USUAL_CHANGES_ARMATURE = 0.1
USUAL_CHANGES_GAIN = 0.05
USUAL_CHANGES_TILT = 0.005
USUAL_CHANGES_PAYLOAD = (0.005, 0.05, 0.5)
USUAL_CHANGES_OTHERS = 3.0
USUAL_CHANGES_MOST = 12.0


def derive_usual_changes(columns: FleetColumns, information: Array, beta: Array) -> Array:
    """Return the changes of effects of usual size, (size, number of changes).

    `information` is what a day gives about the parameters beta.
    """
    found = []
    payload = np.repeat(USUAL_CHANGES_PAYLOAD, (6, 3, 1))
    for source in list_sources(columns):
        places = np.argmax(np.abs(source.design), axis=0)
        clear = np.sqrt(np.einsum("im,ij,jm->m", source.design, information, source.design))
        clear = np.where(clear > 0.0, clear, np.inf)
        present = np.abs(beta[np.minimum(places, len(beta) - 1)])
        sizes = {
            "friction": USUAL_CHANGES_FRICTION * present,
            "armature": USUAL_CHANGES_ARMATURE * present,
            GAIN: np.full(len(places), USUAL_CHANGES_GAIN),
            TILT: np.full(len(places), USUAL_CHANGES_TILT),
            PAYLOAD: payload,
        }
        size = sizes.get(source.effect, USUAL_CHANGES_OTHERS / clear)
        found.append(source.design * np.minimum(size, USUAL_CHANGES_MOST / clear))
    return np.hstack(found)


# Say which directions are kept; own choices, on virtual fleets of two types.
#
# `DIRECTION_WEAKEST` is the least size of a usual change along a direction in standard errors of a
# day; `DIRECTION_MOST` directions; `DIRECTION_DAYS_EACH` is the least number of days of the fleet
# for each; `DIRECTION_DAYS_OF_NOISE` of each robot give the noise.

DIRECTION_WEAKEST = 1.0
DIRECTION_MOST = 32
DIRECTION_DAYS_EACH = 4.0
DIRECTION_ITERATIONS = 4
DIRECTION_DAYS_OF_NOISE = 4


@dataclass(frozen=True, eq=False)
class Directions:
    """Hold r directions in the columns of a robot type, scaled to a mean information of 1 a day.

    Parameters
    ----------
    columns
        The columns of the type.
    weights
        Factors of the rows of each joint (n,): 1 / noise.
    basis
        The directions, (size, r).
    beta
        Base parameters of the type, toward which undetermined directions are resolved (p,).
    """

    columns: FleetColumns
    weights: Array
    basis: Array
    beta: Array

    @property
    def count(self) -> int:
        """Number of directions r."""
        return int(self.basis.shape[1])

    def reference(self, days: Sequence[Day]) -> Array:
        """Return the base parameters of a robot by all its days."""
        return self.columns.fit(sum_days(days), self.weights, self.beta)

    def scores(self, days: Sequence[Day], beta: Array) -> tuple[Array, Array]:
        """Return information (d, r, r) and score (d, r) of each day about a robot's parameters."""
        grams = np.array(
            [self.columns.about(day.equations, beta).stacked(self.weights) for day in days]
        )
        Q = self.basis
        return Q.T @ grams[:, :-1, :-1] @ Q, grams[:, :-1, -1] @ Q


def find_directions(columns: FleetColumns, robots: Sequence[Sequence[Day]]) -> Directions:
    """Return the directions in which the days of some robots of a type have information.

    They are those along which usual changes of the sources are largest in standard errors of a
    day: with the mean information J of a day and changes F, the principal axes of `J^1/2 F`, scaled
    to `Q^T J Q = 1`. The noise of a joint is the
    median over days of its RMS residual about a fit of that day alone.
    """
    totals = [sum_days(days) for days in robots]
    samples = np.array([sum(day.n_samples for day in days) for days in robots], dtype=float)
    zero = np.zeros(columns.base.n_base)
    own = list[Array]()
    energies = np.array([columns.residual_energy(total, zero) for total in totals])
    rms = np.median(np.sqrt(energies / samples[:, None]), axis=0)
    weights = 1.0 / np.maximum(rms, 1e-300)
    floor = 1e-9 / float(weights.min())
    for _ in range(DIRECTION_ITERATIONS):
        own = [columns.fit(total, weights, zero) for total in totals]
        weights = 1.0 / np.maximum(_estimate_noise(columns, robots, weights, own), floor)
    beta = np.median(own, axis=0)
    n_days = sum(len(days) for days in robots)
    J = np.zeros((columns.size, columns.size))
    for total, values in zip(totals, own, strict=True):
        J += columns.about(total, values).stacked(weights)[:-1, :-1] / n_days
    J += 1e-12 * np.diag(np.diag(J))
    changes = derive_usual_changes(columns, J, beta)
    _, sizes, right = np.linalg.svd(Scaled(J).root @ changes, full_matrices=False)
    most = min(DIRECTION_MOST, max(3, int(n_days / DIRECTION_DAYS_EACH)))
    kept = np.flatnonzero(sizes >= min(DIRECTION_WEAKEST, sizes[0]))[:most]
    return Directions(columns, weights, changes @ right[kept].T / sizes[kept], beta)


def _estimate_noise(
    columns: FleetColumns,
    robots: Sequence[Sequence[Day]],
    weights: Array,
    betas: Sequence[Array],
) -> Array:
    """Return the median RMS residual of each joint about fits of single days, (n,)."""
    found = []
    spent = columns.base.n_base / columns.n_joints
    for days, toward in zip(robots, betas, strict=True):
        for day in days[:: max(1, len(days) // DIRECTION_DAYS_OF_NOISE)]:
            own = columns.fit(day.equations, weights, toward)
            freedom = max(day.n_samples - spent, 0.1 * day.n_samples)
            found.append(np.sqrt(columns.residual_energy(day.equations, own) / freedom))
    return np.asarray(np.median(found, axis=0))
