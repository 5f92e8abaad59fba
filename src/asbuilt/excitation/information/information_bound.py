"""Upper bound on the information per sample, and how near to it a recorded motion comes.

The bound is the D-optimal design over all states (Kiefer and Wolfowitz 1960).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from asbuilt.arrays import Array, read_only
from asbuilt.description.model import RobotModel
from asbuilt.dynamics import BaseParameters, DriveSet, find_base_parameters
from asbuilt.dynamics.kernels.blas import use_one_blas_thread
from asbuilt.errors import MotionError, UsageError
from asbuilt.excitation.information.information import (
    DOptimality,
    Information,
    draw_states,
    mean_information,
)
from asbuilt.excitation.limits import MotionBounds
from asbuilt.excitation.state_constraint import TorqueLimit
from asbuilt.findings import Cure
from asbuilt.scaled import Scaled

States = tuple[Array, Array, Array]

ROUNDS = 14
"""Most rounds of a bound for a design."""
BATCHES = 20
"""Batches of random states after which a robot counts as too heavy for its drives."""


@dataclass(frozen=True)
class BoundSearch:
    """Configure the search for the bound.

    | field | meaning and source |
    |---|---|
    | `pool`, `trials` | states in the pool at the start; random states added in a round |
    | `refined`, `climbs` | states per round that are climbed from, and steps of a climb |
    | `weight_steps` | most steps in which the weights of a pool converge |
    | `kept_weight` | relative weight below which a state is dropped |
    | `gap` | gap per parameter `log(d_max / p)` below which the bound is tight enough |
    """

    pool: int = 1500
    trials: int = 6000
    refined: int = 192
    climbs: int = 12
    weight_steps: int = 60
    kept_weight: float = 1e-6
    gap: float = 0.02

    @classmethod
    def of(cls, information: Information) -> BoundSearch:
        """Return the search for a robot of this size."""
        work = sum(len(support) ** 2 for support in information.plan.support)
        slow = information.model.joint_map.work > 0
        return SMALL if slow or work > WHOLE_SEARCH else SEARCH


SEARCH = BoundSearch()
SMALL = BoundSearch(pool=300, trials=300, refined=64, climbs=4, weight_steps=3)
"""For large robots. Climbing finds there what random states do not, and weights that converge on a
pool are soon obsolete: for 30 joints in a chain `upper` is as tight as after the whole search, in a
tenth of its time, and the standard errors of its design are half again as large."""
WHOLE_SEARCH = 60_000
"""Products of parameters of a state, summed over joints, up to which the search is made whole: some
14 joints in a chain, 25 of a robot with limbs. Time grows with this and not with the joints."""


@dataclass(frozen=True, eq=False, repr=False)
class InformationBound:
    """Bound on the information per sample; no motion reaches it.

    `log_det` belongs to the best distribution over states found, `upper` exceeds the value of every
    distribution.

    By the equivalence theorem of Kiefer and Wolfowitz (1960), `log det M* <= log det M + p
    log(max_x d(x) / p)` with `d(x) = tr(M^-1 Y(x)^T S^-1 Y(x))` for any design M and every state x
    within the bounds. `upper` is the right side with the maximum over all states that were
    evaluated: random ones and those reached from them by climbing d. It is exact for
    these, and a (very likely tight) estimate for the continuum between. States are independent
    here, while a motion cannot be at its highest speed and acceleration in both directions at once.
    """

    information: Array
    log_det: float
    upper: float
    support: States
    weights: Array

    def __repr__(self) -> str:
        return f"InformationBound(log_det={self.log_det:.2f}, upper={self.upper:.2f})"

    def efficiency(self, mean_information: Array) -> float:
        """Return `exp((log det M - upper) / p)` of a motion's mean information per sample.

        It is below 1 for states within the bounds.
        """
        sign, value = np.linalg.slogdet(mean_information)
        return float(np.exp((value - self.upper) / len(mean_information))) if sign > 0 else 0.0


def information_bound(
    model: RobotModel,
    information: Information,
    bounds: MotionBounds,
    *,
    torque: Array | None = None,
    seed: int = 0,
    rounds: int = ROUNDS,
    cancelled: Callable[[], bool] = lambda: False,
) -> InformationBound:
    """Return the bound over the states within `bounds` whose torque stays within `torque` (n,).

    Multiplicative weights (Silvey, Titterington & Torsney 1978) on a pool of states, to which those
    with the largest d are added after climbing d within the limits, until the gap closes. At least
    one round is made; the bound is looser if `cancelled` ends the search. Raises `MotionError`
    where random states within `torque` do not determine all parameters.
    """
    rng = np.random.default_rng([seed, 7])
    search = BoundSearch.of(information)
    limit = (
        None if torque is None or not np.any(np.isfinite(torque)) else TorqueLimit((model,), torque)
    )
    pool = _draw_pool(search, information, bounds, limit, rng)
    weights = np.full(len(pool[0]), 1.0 / len(pool[0]))
    p = information.n_parameters
    best_upper = np.inf
    mean = np.eye(p)
    for _ in range(rounds):
        weights, mean = _optimise_weights(search, information, pool, weights)
        keep = weights > search.kept_weight / len(weights)
        pool = _select_states(pool, keep)
        weights = weights[keep] / weights[keep].sum()
        log_det, inverse = DOptimality().value_and_gradient(mean)
        trials = _shrink_to_limit(limit, draw_states(bounds, search.trials, rng, extreme=0.8))
        worth = variance(information, inverse, trials)
        top = _select_states(trials, np.argsort(-worth)[: search.refined])
        heavy = _select_states(pool, np.argsort(-weights)[: search.refined])
        climbed = _climb_states(
            search, information, inverse, bounds, limit, _join_states(top, heavy)
        )
        worth_climbed = variance(information, inverse, climbed)
        highest = max(
            float(worth.max(initial=0.0)),
            float(worth_climbed.max()),
            float(variance(information, inverse, pool).max()),
        )
        best_upper = min(best_upper, log_det + p * max(0.0, float(np.log(highest / p))))
        if np.log(highest / p) < search.gap or cancelled():
            break
        new = _select_states(climbed, np.argsort(-worth_climbed)[: search.refined // 2])
        pool = _join_states(pool, new)
        weights = np.concatenate([0.9 * weights, np.full(len(new[0]), 0.1 / len(new[0]))])
    log_det = DOptimality().value(mean)
    return InformationBound(mean, log_det, max(best_upper, log_det), pool, weights)


def _draw_pool(
    search: BoundSearch,
    information: Information,
    bounds: MotionBounds,
    limit: TorqueLimit | None,
    rng: np.random.Generator,
) -> States:
    """Return random states within the limits that determine all parameters.

    Raises `MotionError` where there are none: most postures are too heavy for weak drives.
    """
    nowhere = np.zeros((0, bounds.lower.size))
    pool: States = (nowhere, nowhere, nowhere)
    for _ in range(BATCHES):
        drawn = draw_states(bounds, search.pool, rng, extreme=0.7)
        pool = _join_states(pool, _shrink_to_limit(limit, drawn))
        enough = pool[0].size >= information.n_parameters
        if enough and np.isfinite(DOptimality().value(mean_information(information, *pool))):
            return pool
    raise MotionError(
        f"{information.model.name}: of {BATCHES * search.pool} random states {len(pool[0])} keep"
        " the torque limits, too few to determine all base parameters",
        cure=Cure("allow a larger share of the torque, or correct torque limits and masses"),
    )


def variance(information: Information, inverse: Array, states: States) -> Array:
    """Return `d(x) = tr(M^-1 Y^T S^-1 Y)` of every state (N,), from M^-1."""
    count = len(states[0])
    rows = information.rows(*states, smooth=False)
    total = np.zeros(count)
    for support, own, sigma in information.joints:
        w = rows[own, :count]
        total += np.einsum("is,is->s", w, inverse[np.ix_(support, support)] @ w) / sigma**2
    return total


def _optimise_weights(
    search: BoundSearch, information: Information, pool: States, weights: Array
) -> tuple[Array, Array]:
    """Return weights that maximise log det of `sum_i w_i M(x_i)`, by w_i <- w_i d_i / p, and it."""
    count = len(pool[0])
    p = information.n_parameters
    rows = information.rows(*pool, smooth=False)
    parts = [(support, rows[own, :count] / sigma) for support, own, sigma in information.joints]
    mean = np.zeros((p, p))
    for _ in range(search.weight_steps):
        mean = np.zeros((p, p))
        share = np.sqrt(weights)
        for support, w in parts:
            weighted = w * share
            # A product with itself takes half of the work of another.
            mean[np.ix_(support, support)] += weighted @ weighted.T
        value, inverse = DOptimality().value_and_gradient(mean)
        if not np.isfinite(value):
            inverse = Scaled(mean).pseudo_inverse
        worth = np.zeros(count)
        for support, w in parts:
            worth += np.einsum("is,is->s", w, inverse[np.ix_(support, support)] @ w)
        if worth.max() < p * (1 + search.gap / 4):
            break
        weights = weights * worth / p
        weights /= weights.sum()
    return weights, mean


def _climb_states(
    search: BoundSearch,
    information: Information,
    inverse: Array,
    bounds: MotionBounds,
    limit: TorqueLimit | None,
    states: States,
) -> States:
    """Return states of larger d, reached by steps along its gradient within the limits."""
    centre = (bounds.upper + bounds.lower) / 2
    halves = ((bounds.upper - bounds.lower) / 2, bounds.velocity, bounds.acceleration)
    middles = (centre, np.zeros_like(centre), np.zeros_like(centre))
    current = states
    worth = variance(information, inverse, states)
    length = np.full((len(worth), 1), 0.3)
    for _ in range(search.climbs):
        rows = information.rows(*current)
        slopes = information.state_gradient(*current, rows, inverse)
        # In units of the limits: d is nearly convex in qd and qdd, which go to a corner.
        steps = [slope * half for slope, half in zip(slopes, halves, strict=True)]
        size = np.sqrt(sum((step**2).sum(axis=1, keepdims=True) for step in steps)) + 1e-300
        moved = [
            middle
            + np.clip((x - middle) / half + length * np.sqrt(step.shape[1]) * step / size, -1, 1)
            * half
            for x, step, middle, half in zip(current, steps, middles, halves, strict=True)
        ]
        trial = (moved[0], moved[1], moved[2])
        better = variance(information, inverse, trial)
        pays = better > worth
        if limit is not None:
            pays &= np.abs(limit.values(*trial)).max(axis=1) <= 1
        current = tuple(
            np.where(pays[:, None], new, old) for new, old in zip(trial, current, strict=True)
        )  # type: ignore[assignment]
        worth = np.where(pays, better, worth)
        length = np.where(pays[:, None], np.minimum(1.3 * length, 2.0), 0.4 * length)
    return current


def _shrink_to_limit(limit: TorqueLimit | None, states: States) -> States:
    if limit is None:
        return states
    q, qd, qdd = states
    for _ in range(6):
        over = np.abs(limit.values(q, qd, qdd)).max(axis=1) > 1
        if not np.any(over):
            break
        qd = np.where(over[:, None], 0.8 * qd, qd)
        qdd = np.where(over[:, None], 0.6 * qdd, qdd)
    return _select_states((q, qd, qdd), np.abs(limit.values(q, qd, qdd)).max(axis=1) <= 1)


def _select_states(states: States, which: NDArray[np.bool_] | NDArray[np.intp]) -> States:
    return states[0][which], states[1][which], states[2][which]


def _join_states(first: States, second: States) -> States:
    q, qd, qdd = (np.vstack(pair) for pair in zip(first, second, strict=True))
    return q, qd, qdd


Limits = tuple[tuple[float, ...], ...]
"""Lower, upper, velocity, acceleration and torque limits of the joints."""


class JointStates(Protocol):
    """Joint states `q`, `qd`, `qdd` (N, n), such as the samples of a recording."""

    @property
    def q(self) -> Array:
        """Positions."""

    @property
    def qd(self) -> Array:
        """Velocities."""

    @property
    def qdd(self) -> Array:
        """Accelerations."""


@dataclass(frozen=True, eq=False, repr=False)
class InformationEfficiency:
    """Information of a motion per sample relative to an upper bound that no motion reaches.

    The bound is the best distribution over the states within the limits, which are widened to hold
    every state of the motion: otherwise noise of the accelerations, or a wrong limit, would count
    as information beyond the bound. `d_efficiency` is `exp((log det M - log det M_bound) / p)`, 0
    if a parameter remains undetermined, never above 1. `by_parameter` (p,) is the variance of each
    base parameter at the bound over the motion's; it may exceed 1 for some. `beyond` (n,) is
    the largest factor by which each joint exceeds its limits, 1 within them.
    """

    base: BaseParameters
    d_efficiency: float
    by_parameter: Array
    beyond: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "by_parameter", read_only(self.by_parameter))
        object.__setattr__(self, "beyond", read_only(self.beyond))

    def __repr__(self) -> str:
        return f"InformationEfficiency({self.base.robot!r}, d_efficiency={self.d_efficiency:.3f})"

    @property
    def owners(self) -> NDArray[np.intp]:
        """Joint, counted from 0, of the link or drive of each base parameter (p,)."""
        columns = self.base.columns
        per = self.base.drive.columns_per_joint
        links = 10 * self.base.n_links
        moved_by = np.array(self.base.link_joints)
        return np.where(
            columns < links,
            moved_by[np.minimum(columns, links - 1) // 10],
            (columns - links) // max(per, 1),
        )

    @property
    def worst(self) -> tuple[int | None, ...]:
        """Worst determined base parameter of each joint, None for a joint without any."""
        own = [np.flatnonzero(self.owners == k) for k in range(self.base.n_joints)]
        return tuple(
            int(places[np.argmin(self.by_parameter[places])]) if places.size else None
            for places in own
        )

    @property
    def by_joint(self) -> Array:
        """Efficiency of the worst determined parameter of each joint (n,), NaN without any.

        It is small if the joint moved too little or correlated with others.
        """
        return np.array([np.nan if k is None else self.by_parameter[k] for k in self.worst])


def information_efficiency(
    model: RobotModel, drive: DriveSet, samples: JointStates
) -> InformationEfficiency:
    """Return the information efficiency of recorded states, for equal noise in all joints.

    Limits that the description lacks come from `MotionBounds.assumed`; all are widened to the
    states recorded. Long recordings are thinned evenly. Raises `UsageError` without samples.
    """
    # Most samples of a recording that are used; of longer ones every second, third, ...
    step = max(1, -(-len(samples.q) // 20000))
    q, qd, qdd = (
        np.ascontiguousarray(x[::step], dtype=np.float64)
        for x in (samples.q, samples.qd, samples.qdd)
    )
    if not len(q):
        raise UsageError("the recording has no samples")
    widened, beyond = _widen_limits(model, q, qd, qdd)
    base, bound = _find_bound(model, drive, widened)
    mean = mean_information(Information.of(model, base), q, qd, qdd)
    best = np.diag(np.linalg.inv(bound.information))
    own = Scaled(mean)
    # What the motion does not determine has no variance to compare with.
    by_parameter = np.zeros_like(best)
    np.divide(best, own.inverse_diagonal, out=by_parameter, where=own.determined)
    return InformationEfficiency(
        base,
        min(bound.efficiency(mean), 1.0) if own.rank == len(mean) else 0.0,
        by_parameter,
        beyond,
    )


def _widen_limits(model: RobotModel, q: Array, qd: Array, qdd: Array) -> tuple[Limits, Array]:
    """Return limits that hold all states, and by what factor each joint exceeds its own (n,).

    The factor is rounded up to a digit, so that like recordings share a bound.
    """
    limits = MotionBounds.assumed(model)
    fast = np.abs(qd).max(axis=0)
    steep = np.abs(qdd).max(axis=0)
    beyond = np.maximum(np.maximum(fast / limits.velocity, steep / limits.acceleration), 1.0)
    lower = np.minimum(limits.lower, q.min(axis=0))
    upper = np.maximum(limits.upper, q.max(axis=0))
    velocity, acceleration = (
        limit * np.where(top > limit, np.ceil(10.0 * top / limit) / 10.0, 1.0)
        for limit, top in ((limits.velocity, fast), (limits.acceleration, steep))
    )
    torque = MotionBounds.of(model).torque
    share = 1.0
    if np.any(np.isfinite(torque)):
        share = max(float(np.abs(TorqueLimit((model,), torque).values(q, qd, qdd)).max()), 1.0)
    arrays = (lower, upper, velocity, acceleration, torque * np.ceil(10.0 * share) / 10.0)
    return tuple(tuple(array.tolist()) for array in arrays), beyond


@lru_cache(maxsize=8)
def _find_bound(
    model: RobotModel, drive: DriveSet, widened: Limits
) -> tuple[BaseParameters, InformationBound]:
    base = find_base_parameters(model, drive)
    lower, upper, velocity, acceleration, torque = (np.array(limit) for limit in widened)
    limits = replace(
        MotionBounds.assumed(model),
        lower=lower,
        upper=upper,
        velocity=velocity,
        acceleration=acceleration,
    )
    with use_one_blas_thread():
        # Rounds of the bound for a recording, accurate to a few per cent.
        return base, information_bound(
            model, Information.of(model, base), limits, torque=torque, rounds=3
        )
