"""Which source explains a change, how large it is, and the torque that it makes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Array
from asbuilt.tables import significant
from asbuilt.workflow.fleet.drift.columns import summed
from asbuilt.workflow.fleet.drift.days import Day
from asbuilt.workflow.fleet.drift.directions import Directions
from asbuilt.workflow.fleet.drift.sources import PAYLOAD_SIZE, Source, sources_of
from asbuilt.workflow.fleet.drift.variation import Variation

MOST_SOURCES = 3
WORTH_NAMING = 0.05
"""Share of a change's statistic from which a further source is named."""
SPECIAL = 0.7
"""Share of the statistic of the mass distribution that a special source has at least."""
WEAKEST = 1e-8
"""Eigenvalue of scaled information, relative to the largest, below which nothing is determined."""


@dataclass(frozen=True, slots=True)
class SourceChange:
    """Hold a source of a change.

    Parameters
    ----------
    source
        Key of `CAUSES`: friction, offset, armature, gain, payload, mounting (base tilt), links.
    joint
        Number of the joint from 1, for sources of a joint.
    estimate, std_error, unit
        Its size: friction and gain in percent, payload in kg, tilt in degrees; None for others.
    torque
        RMS torque that it makes at the joint that feels it most.
    torque_unit, felt_at
        N m or N, and the name of that joint.
    text
        The sentence.
    """

    source: str
    joint: int | None
    estimate: float | None
    std_error: float | None
    unit: str | None
    torque: float
    torque_unit: str
    felt_at: str
    text: str


@dataclass(frozen=True, slots=True, eq=False)
class _Stepping:
    """Normal equations of a mean in the directions and a step in all columns."""

    information: Array
    score: Array
    mean_step: Array
    mean: Array
    mean_score: Array

    def gain(self, design: Array) -> tuple[float, Array, Array]:
        """Return the statistic of a step along a design, its parameters and their covariance."""
        A, b, C = self.information, self.score, self.mean_step
        inverse = np.linalg.pinv(self.mean, hermitian=True)
        N = design.T @ (A - C.T @ inverse @ C) @ design
        u = design.T @ (b - C.T @ inverse @ self.mean_score)
        size = np.sqrt(np.maximum(np.diag(N), 1e-300))
        values, axes = np.linalg.eigh(N / np.outer(size, size))
        kept = values > WEAKEST * max(values[-1], 1e-300)
        root = axes[:, kept] / np.sqrt(values[kept])
        covariance = (root @ root.T) / np.outer(size, size)
        found = covariance @ u
        return float(u @ found), found, covariance


def explain_change(
    directions: Directions,
    variation: Variation,
    days: Sequence[Day],
    place: int,
    inflation: float,
) -> tuple[SourceChange, ...]:
    """Return the sources of a step of a robot at a day, the most important first.

    Each source alone is fitted to the step by generalised least squares beside the robot's mean,
    with the variation from day to day in the covariance; the best by the statistic less four
    times its parameters, scaled by what no source explains, is taken, then a further one
    beside it as long as that adds much.
    """
    columns = directions.columns
    beta = directions.columns.fit(
        summed(days[: max(place, 1)]), directions.weights, directions.beta
    )
    step = _stepping(directions, variation.covariance, days, place, beta)
    sources = sources_of(columns)
    whole, _, _ = step.gain(np.eye(columns.size))
    taken: list[Source] = []
    reached = 0.0
    while len(taken) < MOST_SOURCES:
        tried = []
        for source in sources:
            if any(_overlap(source, other) for other in taken):
                continue
            design = np.hstack([*(each.design for each in taken), source.design])
            tried.append((step.gain(design)[0], source))
        if not tried:
            break
        spread = max(inflation, (whole - max(g for g, _ in tried)) / columns.size, 1e-300)
        best = _best(tried, spread)
        more = best[0] - reached
        if taken and (
            more < WORTH_NAMING * whole or more < (12.0 + 4.0 * best[1].design.shape[1]) * spread
        ):
            break
        taken.append(best[1])
        reached = best[0]
    design = np.hstack([each.design for each in taken])
    _, found, covariance = step.gain(design)
    grams, n = summed(days), sum(day.n_samples for day in days)
    start, said = 0, []
    for source in taken:
        part = slice(start, start + source.design.shape[1])
        start = part.stop
        x = source.design @ found[part]
        rms = np.sqrt(columns.energies(grams, x, beta) / n)
        spread_here = source.design @ covariance[part, part] @ source.design.T * inflation
        said.append(_change(directions, source, x, spread_here, rms, beta, grams, found[part]))
    return tuple(sorted(said, key=lambda each: -each.torque))


def _best(tried: Sequence[tuple[float, Source]], spread: float) -> tuple[float, Source]:
    """Return the best source; the mass distribution, which contains others, as a last resort."""
    special = [each for each in tried if each[1].cause != "links"]
    best = max(special or tried, key=lambda each: each[0] - 4.0 * each[1].design.shape[1] * spread)
    general = [each for each in tried if each[1].cause == "links"]
    return general[0] if general and best[0] < SPECIAL * general[0][0] else best


def _overlap(source: Source, other: Source) -> bool:
    """Return whether two sources are one, or one contains the other."""
    general = {"links", "payload"}
    return (source.cause == other.cause and source.joint == other.joint) or (
        source.cause in general and other.cause in general
    )


def _stepping(
    directions: Directions, V: Array, days: Sequence[Day], place: int, beta: Array
) -> _Stepping:
    columns, Q, w = directions.columns, directions.basis, directions.weights
    size, r = columns.size, directions.count
    A, b = np.zeros((size, size)), np.zeros(size)
    C, D, d = np.zeros((r, size)), np.zeros((r, r)), np.zeros(r)
    ridge = 1e-9 * max(float(np.trace(V)) / r, 1.0) * np.eye(r)
    inverse = np.linalg.inv(V + ridge)
    for t, day in enumerate(days):
        gram = columns.information(day.grams, beta, w)
        J, s = gram[:-1, :-1], gram[:-1, -1]
        JQ = J @ Q
        reduced = np.linalg.solve(inverse + Q.T @ JQ, np.column_stack([JQ.T, Q.T @ s]))
        P, score = J - JQ @ reduced[:, :-1], s - JQ @ reduced[:, -1]
        D += Q.T @ P @ Q
        d += Q.T @ score
        if t >= place:
            A += P
            b += score
            C += Q.T @ P
    return _Stepping(A, b, C, D, d)


def _change(
    directions: Directions,
    source: Source,
    x: Array,
    covariance: Array,
    rms: Array,
    beta: Array,
    grams: Sequence[Array],
    found: Array,
) -> SourceChange:
    columns = directions.columns
    at = int(np.argmax(rms))
    joint = None if source.joint is None else source.joint + 1
    estimate: float | None = None
    error: float | None = None
    unit: str | None = None
    text = f"{source.title} changed"
    if source.joint is not None:
        text = f"{source.title} of {columns.joint_names[source.joint]}"
    if source.cause == "gain" and source.joint is not None:
        estimate, unit = 100.0 * float(found[0]), "%"
        error = 100.0 * float(
            np.sqrt(covariance[columns.gains, columns.gains].diagonal()[source.joint])
        )
        text += f" {estimate:+.2g} %"
    elif source.cause == "friction" and source.joint is not None:
        estimate, error = _share(directions, source, x, covariance, beta, grams)
        unit = "%"
        text += f" {estimate:+.2g} %"
    elif source.cause == "payload":
        place = source.design.shape[1] - 1
        estimate, unit = float(found[place] * PAYLOAD_SIZE[9]), "kg"
        root = np.linalg.lstsq(source.design, np.eye(columns.size), rcond=None)[0]
        error = float(np.sqrt(max((root @ covariance @ root.T)[place, place], 0.0))) * 10.0
        text = f"{source.title} {estimate:+.2g} kg at the flange"
    elif source.cause == "mounting":
        estimate, unit = float(np.degrees(np.linalg.norm(found))), "deg"
        tilt = covariance[-2:, -2:]
        along = found / max(float(np.linalg.norm(found)), 1e-300)
        error = float(np.degrees(np.sqrt(along @ tilt @ along)))
        text = f"{source.title} by {estimate:.2g} degrees"
    felt = columns.joint_units[at]
    text += f", {significant(float(rms[at]))} {felt} RMS at {columns.joint_names[at]}"
    return SourceChange(
        source.cause,
        joint,
        estimate,
        error,
        unit,
        float(rms[at]),
        felt,
        columns.joint_names[at],
        text,
    )


def _share(
    directions: Directions,
    source: Source,
    x: Array,
    covariance: Array,
    beta: Array,
    grams: Sequence[Array],
) -> tuple[float, float]:
    """Return the change of friction torque in percent of the friction before, and its error."""
    k = int(source.joint or 0)
    columns = directions.columns
    places = np.flatnonzero(source.design.any(axis=1))
    local = [int(np.flatnonzero(columns.support[k] == j)[0]) for j in places]
    G = grams[k][np.ix_(local, local)]
    before = beta[places]
    energy = max(float(before @ G @ before), 1e-300)
    row = before @ G / energy
    error = float(np.sqrt(max(float(row @ covariance[np.ix_(places, places)] @ row), 0.0)))
    return 100.0 * float(row @ x[places]), 100.0 * error
