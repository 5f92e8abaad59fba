"""Effects by which a robot changes, and directions of a type that a day of motion determines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from asbuilt.apps.fleet.drift.columns import GAIN, Day, FleetColumns, sum_days
from asbuilt.arrays import Array
from asbuilt.identification import LINKS, TILT, locate_drive_parameters
from asbuilt.scaled import Scaled

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
