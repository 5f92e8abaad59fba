"""Which effects explain a change, how large they are, and the torque that they make."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from asbuilt.apps.fleet.drift.columns import (
    PAYLOAD,
    Day,
    Directions,
    FleetColumns,
    Source,
    list_sources,
    sum_days,
)
from asbuilt.apps.fleet.drift.variation import Variation
from asbuilt.arrays import Array
from asbuilt.identification import (
    EFFECTS,
    LINKS,
    Equations,
    FoundEffect,
    evaluate_worth,
    name_group,
)
from asbuilt.scaled import Scaled
from asbuilt.tables import format_plus_minus, round_significant

# Say how many effects of a change are named.
#
# What the worth of two effects differs by less than `CHANGE_SAME` of it is rounding. Chance takes
# any but the first with probability `CHANGE_LEVEL`, over all candidates, and an effect explains
# `CHANGE_NAMED` of the change at least.

CHANGE_MOST = 3
CHANGE_SAME = 1e-6
CHANGE_LEVEL = 0.05
CHANGE_NAMED = 0.06


OF_A_DIFFERENCE = 1e-8
"""Eigenvalue of scaled information, relative to the largest, that counts here: what the directions
of usual variation explain was subtracted, which leaves less digits than `Scaled` relies on."""


@dataclass(frozen=True, slots=True, eq=False)
class _Stepping:
    """Normal equations of a step in all columns, the mean in the directions eliminated."""

    information: Array
    score: Array

    def fit(self, design: Array) -> tuple[float, Array, Array, int]:
        """Return the statistic of a step along a design, its parameters, covariance and rank."""
        N = design.T @ self.information @ design
        u = design.T @ self.score
        scaled = Scaled(N)
        kept = scaled.values > OF_A_DIFFERENCE * scaled.values.max(initial=0.0)
        root = scaled.axes[:, kept] / np.sqrt(scaled.values[kept]) / scaled.size[:, None]
        covariance = root @ root.T
        found = covariance @ u
        return float(u @ found), found, covariance, int(np.count_nonzero(kept))


def explain_change(
    directions: Directions,
    variation: Variation,
    days: Sequence[Day],
    place: int,
    inflation: float,
) -> tuple[FoundEffect, ...]:
    """Return the effects in a step of a robot at a day, the most important first.

    Each effect alone is fitted to the step by generalised least squares, together with the robot's
    mean and the variation from day to day in the covariance. The rule of a search for effects takes
    the most worthy, then further ones in addition that are no chance and much of the change.
    """
    columns = directions.columns
    beta = columns.fit(sum_days(days[: max(place, 1)]), directions.weights, directions.beta)
    step = _accumulate_stepping(directions, variation.covariance, days, place, beta)
    taken = _select_effects(step, list_sources(columns), inflation)
    _, found, covariance, _ = step.fit(np.hstack([source.design for source in taken]))
    after = columns.about(sum_days(days[place:]), beta)
    all_days = columns.about(sum_days(days), beta)
    torque = columns.residual_energy(sum_days(days[place:]), np.zeros(columns.base.n_base)).sum()
    n = sum(day.n_samples for day in days)
    effects = []
    edges = np.cumsum([0, *(source.design.shape[1] for source in taken)])
    x = np.zeros(columns.size)
    for source, part in zip(taken, map(slice, edges, edges[1:]), strict=True):
        own = source.design @ found[part]
        rms = np.sqrt(all_days.energy(own, torque=0.0) / n)
        errors = tuple(
            float(np.sqrt(after.energy(explained).sum() / torque)) if torque > 0.0 else 0.0
            for explained in (x, x + own)
        )
        x = x + own
        spread = inflation * covariance[part, part]
        size = _word_size(source, found[part], spread, columns, beta, all_days)
        effects.append(_make_effect(source, size, rms, errors, columns))
    return tuple(sorted(effects, key=lambda effect: -effect.torque))


def _select_effects(step: _Stepping, sources: Sequence[Source], inflation: float) -> list[Source]:
    """Return the effects that are taken, in order; residuals of the best scale the statistics."""
    whole, _, _, _ = step.fit(np.eye(len(step.score)))
    taken: list[Source] = []
    reached = 0.0
    rank = 0
    while len(taken) < CHANGE_MOST:
        left = [source for source in sources if not any(_has_overlap(source, own) for own in taken)]
        fits = [step.fit(np.hstack([e.design for e in (*taken, source)])) for source in left]
        gains = np.array([fit[0] for fit in fits]) - reached
        ranks = [fit[3] - rank for fit in fits]
        spread = max(inflation, (whole - reached - gains.max()) / len(step.score))
        worth = [
            evaluate_worth(0.5 * g / spread, m) for g, m in zip(gains.tolist(), ranks, strict=True)
        ]
        # Of effects that explain the same, as links and a payload of few joints do, the first.
        best = int(np.flatnonzero(np.array(worth) >= max(worth) - CHANGE_SAME * abs(max(worth)))[0])
        chance = float(chdtrc(max(ranks[best], 1), max(gains[best], 0.0) / spread)) * len(left)
        if taken and (chance > CHANGE_LEVEL or gains[best] < CHANGE_NAMED * whole):
            break
        taken.append(left[best])
        reached = fits[best][0]
        rank = fits[best][3]
    return taken


def _has_overlap(source: Source, other: Source) -> bool:
    """Return whether two effects are one, or one contains the other."""
    same = source.effect == other.effect and source.joint == other.joint
    return same or {source.effect, other.effect} == {LINKS, PAYLOAD}


def _accumulate_stepping(
    directions: Directions, V: Array, days: Sequence[Day], place: int, beta: Array
) -> _Stepping:
    columns = directions.columns
    Q = directions.basis
    w = directions.weights
    size = columns.size
    r = directions.count
    A = np.zeros((size, size))
    b = np.zeros(size)
    C = np.zeros((r, size))
    D = np.zeros((r, r))
    d = np.zeros(r)
    ridge = 1e-9 * max(float(np.trace(V)) / r, 1.0) * np.eye(r)
    inverse = np.linalg.inv(V + ridge)
    for t, day in enumerate(days):
        gram = columns.about(day.equations, beta).stacked(w)
        J = gram[:-1, :-1]
        s = gram[:-1, -1]
        JQ = J @ Q
        reduced = np.linalg.solve(inverse + Q.T @ JQ, np.column_stack([JQ.T, Q.T @ s]))
        P = J - JQ @ reduced[:, :-1]
        score = s - JQ @ reduced[:, -1]
        D += Q.T @ P @ Q
        d += Q.T @ score
        if t >= place:
            A += P
            b += score
            C += Q.T @ P
    across = C.T @ Scaled(D).pseudo_inverse
    return _Stepping(A - across @ C, b - across @ d)


def _make_effect(
    source: Source,
    size: tuple[float, float, str, str],
    rms: Array,
    errors: Sequence[float],
    columns: FleetColumns,
) -> FoundEffect:
    """Return an effect with the RMS torque (n,) that it makes, and the errors around it."""
    at = int(np.argmax(rms))
    joint = None if source.joint is None else columns.joint_names[source.joint]
    where = f"{name_group(source.effect)}{f' of {joint}' if joint else ''} {size[3]}".rstrip()
    return FoundEffect(
        effect=source.effect,
        joint=joint,
        estimate=size[0],
        std_error=size[1],
        unit=size[2],
        in_model=False,
        torque=float(rms[at]),
        error_before=errors[0],
        error_after=errors[1],
        alternatives=(),
        text=(
            f"{where}, {round_significant(float(rms[at]))} {columns.joint_units[at]} RMS at"
            f" {columns.joint_names[at]}"
        ),
    )


def _word_size(
    source: Source,
    values: Array,
    covariance: Array,
    columns: FleetColumns,
    beta: Array,
    days: Equations,
) -> tuple[float, float, str, str]:
    """Return size, standard error, unit and text of an effect: of friction the share of before."""
    k = source.joint
    if source.effect == LINKS:
        return np.nan, np.nan, "", "changed"
    if source.effect in EFFECTS:
        family = EFFECTS[source.effect]
        revolute = k is None or columns.joint_units[k] == "N m"
        size, error, unit = family.size(values, covariance, revolute=revolute)
        text = family.text_of(size, error, revolute=revolute)
    else:
        size, error, unit = _measure_torque_share(source, values, covariance, columns, beta, days)
        text = f"{format_plus_minus(size, error)} {unit}"
    return size, error, unit, f"+{text}" if size > 0.0 else text


def _measure_torque_share(
    source: Source,
    values: Array,
    covariance: Array,
    columns: FleetColumns,
    beta: Array,
    days: Equations,
) -> tuple[float, float, str]:
    """Return the change of the torque of a drive, in percent of that before, and its error."""
    places = np.flatnonzero(source.design.any(axis=1))
    k = source.joint or 0
    if len(places) == 1:
        return float(values[0]), float(np.sqrt(covariance[0, 0])), columns.base.units[places[0]]
    local = np.array([np.flatnonzero(days.support[k] == j)[0] for j in places])
    row = beta[places] @ days.of_joints[k][np.ix_(local, local)]
    row = 100.0 * row / max(float(row @ beta[places]), 1e-300)
    return float(row @ values), float(np.sqrt(max(row @ covariance @ row, 0.0))), "%"
