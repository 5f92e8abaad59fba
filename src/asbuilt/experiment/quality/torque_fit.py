"""Comparison of measured torques with the model's, and the order of columns that fits best."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array, Indices, Mask
from asbuilt.description.appearance import link_solids, stretched_length
from asbuilt.description.inertia import LinkInertia
from asbuilt.description.model import ROOT, RobotModel
from asbuilt.dynamics import DriveSet, find_base_parameters, inverse_dynamics, observation_matrix
from asbuilt.dynamics.drives.torque import spring_columns
from asbuilt.experiment.quality.reductions import SmoothedMotion
from asbuilt.scaled import Scaled, find_column_space

T = TypeVar("T")

UNKNOWN_TORQUE = ("torque_flipped", "joint_torque_flipped", "torque_scale")
"""Codes of errors that mean wrong or unknown gains, for uses that look for the gains."""
COMPARED_TORQUES = (
    *UNKNOWN_TORQUE,
    *("gravity_absent", "gravity_direction", "gravity_partial"),
    *("joint_convention", "joint_torque_scale", "joints_swapped"),
    *("torque_uncorrelated", "torque_unsigned"),
)
"""Codes of findings that compare measured torques with the model's."""


def choose_decisive_change(
    logged: T, changes: Iterable[T], cost: Callable[[T], float], fall: float
) -> T | None:
    """Return the cheapest of `changes` if it costs less than `logged` by more than `fall`.

    Parameters
    ----------
    logged
        Order of columns as logged.
    changes
        Other orders, such as the orders of `list_swaps`.
    cost
        Misfit of an order.
    fall
        Difference of the costs from which the change is decisive.
    """
    costs = [(cost(change), change) for change in changes]
    # Without a change there is nothing to compare.
    best = min(costs, key=lambda pair: pair[0], default=None)
    return best[1] if best is not None and best[0] < cost(logged) - fall else None


def list_swaps(order: tuple[int, ...]) -> Iterator[tuple[int, ...]]:
    """Yield the orders with two entries swapped.

    >>> list(list_swaps((0, 1, 2)))
    [(1, 0, 2), (2, 1, 0), (0, 2, 1)]
    """
    # Each pair once.
    for i, j in combinations(range(len(order)), 2):
        yield _swapped(order, i, j)


def _swapped(order: tuple[int, ...], i: int, j: int) -> tuple[int, ...]:
    changed = list(order)
    changed[i] = order[j]
    changed[j] = order[i]
    return tuple(changed)


USUAL_FRICTION = DriveSet.parse("viscous,coulomb,offset")
"""Friction of any joint; finding base parameters takes long, so that all checks ask for these."""
BREAKAWAY = 0.02
"""Width of the smoothed sign of velocity [rad/s or m/s]."""
COUNTS = 0.02
"""Misfit below which a better fit does not count."""
CLEAR = 0.9
"""Correlation, or cosine, of measured with rigid-body torques from which sign, scale, order and
convention of a joint are clear. In recordings of seven real robots the cosine is at least 0.92 in
the right direction of gravity, and at most 0.69 in directions across it.
"""
FALL = 2.0
"""Fall of the misfit's logarithm, summed over joints, from which another order or convention is
decisive: the misfit of one joint falls to an eighth."""
EVERY_PAIR = 10
"""Joints up to which every pair of them is tried by a fit of its own; of more, those pairs that a
cheaper comparison does not exclude."""
MOST_SUSPECTS = 10
"""Pairs of joints of a larger robot that are tried by a fit of their own."""


@dataclass(frozen=True, eq=False)
class TorqueFit:
    """Compare torque columns with the model's rigid-body torques.

    `motion_of[k]` and `torque_of[k]` are the logged columns taken for joint k; all arrays are in
    the order of the joints. Measured y_k and predicted x_k are the residuals of each after a fit of
    1, qd_k and tanh(qd_k / 0.02): offset and friction are taken out of both, and so are described
    springs. `friction` are the `friction_bases`.
    """

    model: RobotModel
    q: Array
    qd: Array
    qdd: Array
    tau: Array
    friction: Array
    motion_of: tuple[int, ...]
    torque_of: tuple[int, ...]

    @classmethod
    def of(cls, model: RobotModel, motion: SmoothedMotion, scale: Array) -> TorqueFit:
        """Compare a smoothed motion, positions times `scale` (n,), in the order logged."""
        # 400 samples: more do not change a decision.
        rows = motion.thinned(400)
        order = tuple(range(model.n_joints))
        q, qd, qdd = (x[rows] * scale for x in (motion.q, motion.qd, motion.qdd))
        # The friction of the joint that moves here, so that swapped motions take theirs along.
        friction = friction_bases(qd, spring_columns(model, q))
        return cls(model, q, qd, qdd, motion.tau[rows], friction, order, order)

    def within(self, rows: slice) -> TorqueFit:
        """Return the comparison on some of the samples."""
        q, qd, qdd, tau = (x[rows] for x in (self.q, self.qd, self.qdd, self.tau))
        friction = friction_bases(qd, spring_columns(self.model, q))
        return replace(self, q=q, qd=qd, qdd=qdd, tau=tau, friction=friction)

    def halves(self) -> tuple[TorqueFit, TorqueFit]:
        """Return the comparisons on the first and on the second half of the samples."""
        middle = len(self.q) // 2
        return self.within(slice(middle)), self.within(slice(middle, None))

    def observe(self, gravity: ArrayLike) -> Array:
        """Return the columns (N, n, p) of base parameters, friction and offsets under a gravity.

        They belong to the base parameters under the description's gravity.
        """
        columns = self._columns
        samples, n = self.q.shape
        W = np.zeros((samples, n, len(columns) + n))
        W[:, :, : len(columns)] = observation_matrix(
            self.model.with_gravity(gravity),
            *(self.q, self.qd, self.qdd),
            drive=USUAL_FRICTION,
            columns=columns,
        ).reshape(samples, n, -1)
        # Coulomb friction as a smooth sign: a jump at rest would fit noise.
        W[:, range(n), range(len(columns), len(columns) + n)] = np.tanh(self.qd / BREAKAWAY)
        return W

    @property
    def _columns(self) -> Indices:
        """Columns of bodies, viscous friction and offsets of `USUAL_FRICTION`."""
        base = find_base_parameters(self.model, USUAL_FRICTION)
        (term,) = (term for term in USUAL_FRICTION.terms if term.key == "coulomb")
        coulomb = [name.startswith(tuple(term.symbols)) for name in base.names]
        return np.asarray(base.columns[~np.array(coulomb)])

    def normal_equations(self, W: Array) -> NormalEquations:
        """Return the normal equations of columns (N, n, p), torques scaled to unit variance."""
        # Columns in memory are summed pairwise: a constant torque is its mean to the last digit.
        y = np.asfortranarray(self.tau)
        y = y - y.mean(axis=0)
        # Unit variance, so that no joint decides by its size.
        spread = _replace_zeros(y.std(axis=0))
        y = y / spread
        rows = [np.ascontiguousarray(W[:, k]) for k in range(W.shape[1])]
        # A joint's torque knows the links that it carries, and its own friction, alone.
        support = tuple(np.flatnonzero(np.any(row != 0.0, axis=0)) for row in rows)
        rows = [row[:, own] for row, own in zip(rows, support, strict=True)]
        return NormalEquations(
            W.shape[2],
            support,
            tuple(row.T @ row for row in rows),
            tuple(y.T @ row for row in rows),
            np.mean(y**2, axis=0),
            spread,
            len(self.q),
        )

    def unexplained(self, W: Array) -> Array:
        """Return the share (n,) of the torques' variance that columns (N, n, p) leave."""
        return self.normal_equations(W).unexplained(tuple(range(self.model.n_joints)))

    def with_signs(self, signs: ArrayLike) -> TorqueFit:
        """Return the comparison with the torques times signs (n,)."""
        return replace(self, tau=self.tau * np.asarray(signs))

    @property
    def kinetic_sign(self) -> float:
        """Sign of the kinetic energy of the masses that fit best, 0 where halves disagree.

        `2 T = qd^T M(q) qd` is the power along `qd` of the torques that accelerate by `qd` from
        rest without gravity: linear in the masses, and positive for any that can exist.
        """
        # One sign in the whole and both halves, else none.
        signs = {np.sign(part._mean_energy()) for part in (self, *self.halves())}
        return float(signs.pop()) if len(signs) == 1 else 0.0

    def _mean_energy(self) -> float:
        """Return twice the mean kinetic energy of the masses that fit best [J]."""
        W = self.observe(self.model.gravity)
        n = self.model.n_joints
        beta = self.normal_equations(W).solve(tuple(range(n)))
        rest = np.zeros_like(self.qd)
        # qdd = qd from rest without gravity: the torque is M(q) qd.
        moved = replace(self, qd=rest, qdd=self.qd).observe(np.zeros(3))
        # The last columns are friction, and viscous friction and offsets have no part in energy.
        columns = self._columns
        bodies = columns < 10 * len(self.model.links)
        torque = moved[:, :, : len(columns)][:, :, bodies] @ beta[: len(columns)][bodies]
        return float(np.mean(np.sum(self.qd * torque, axis=1)))

    @cached_property
    def _residuals(self) -> tuple[Array, Array]:
        x = inverse_dynamics(self.model, self.q, self.qd, self.qdd, threads=1)
        return self.without_friction(x), self.without_friction(self.tau)

    def without_friction(self, torque: Array) -> Array:
        """Return torques (N, n) without what offset and friction of each joint explain."""
        # A batch of matrices wants a column each.
        columns = torque.T[:, :, None]
        rest = columns - self.friction @ (self.friction.swapaxes(1, 2) @ columns)
        return np.ascontiguousarray(rest[:, :, 0].T)

    @property
    def predicted(self) -> Array:
        """Standard deviation of the predicted torque of each joint [N m], shape (n,)."""
        return np.asarray(np.std(self._residuals[0], axis=0))

    @property
    def decides(self) -> Mask:
        """Which joints have enough predicted torque to decide anything, shape (n,)."""
        predicted = self.predicted
        # Predicted torque, relative to the largest, below which a joint decides nothing.
        # Relative to the largest: a wrist of small torques decides nothing about the arm.
        return np.asarray(predicted > 0.02 * np.max(predicted))

    @property
    def gravity(self) -> Array:
        """Standard deviation of the torque of gravity of each joint [N m], shape (n,)."""
        still = np.zeros_like(self.q)
        torque = inverse_dynamics(self.model, self.q, still, still, threads=1)
        return np.asarray(np.std(self.without_friction(torque), axis=0))

    @property
    def measured(self) -> Array:
        """Standard deviation of the measured torque of each joint [N m], shape (n,)."""
        return np.asarray(np.std(self._residuals[1], axis=0))

    @property
    def ratio(self) -> float:
        """Factor from predicted to measured torques by their size."""
        # By size alone: signs and order may still be wrong.
        return float(np.sqrt(np.sum(self.measured**2) / np.sum(self.predicted**2)))

    @property
    def correlation(self) -> Array:
        """Correlation of measured with predicted torque, joint by joint, shape (n,)."""
        x, y = self._residuals
        norms = np.linalg.norm(x, axis=0) * np.linalg.norm(y, axis=0)
        return np.asarray(np.sum(x * y, axis=0) / _replace_zeros(norms))

    def compare_correlation(self, other: TorqueFit, joints: Indices) -> tuple[float, float]:
        """Return the mean size of the correlation of joints (k,), of this fit and of another."""
        mine, its = (float(np.mean(np.abs(x.correlation[joints]))) for x in (self, other))
        return mine, its

    @property
    def gain(self) -> Array:
        """Least-squares factor from predicted to measured torque, joint by joint, shape (n,)."""
        x, y = self._residuals
        return np.asarray(np.sum(x * y, axis=0) / _replace_zeros(np.sum(x**2, axis=0)))

    @property
    def friction_correlation(self) -> Array:
        """Correlation of each joint's torque with its direction of motion, (n,)."""
        return self.correlate_friction(range(self.model.n_joints))

    def correlate_friction(self, joints: Iterable[int]) -> Array:
        """Return the correlation of some joints' torque with their direction of motion, (n,).

        The rigid-body torque of any masses is projected out of both, so CAD values do not matter;
        joints whose friction is less than a tenth of their torque get 0, and so do all others.
        """
        correlation = np.zeros(self.model.n_joints)
        asked = list(joints)
        if not asked:
            return correlation
        base = find_base_parameters(self.model, DriveSet.parse("offset"))
        observed = observation_matrix(
            self.model, self.q, self.qd, self.qdd, drive=base.drive, columns=base.columns
        )
        rows = observed.reshape(*self.q.shape, base.n_base)
        for k in asked:
            basis = find_column_space(rows[:, k])
            both = np.column_stack([np.tanh(self.qd[:, k] / BREAKAWAY), self.tau[:, k]])
            direction, rest = (both - basis @ (basis.T @ both)).T
            norm = float(np.linalg.norm(direction) * np.linalg.norm(rest))
            whole = np.linalg.norm(both[:, 1] - both[:, 1].mean())
            # A friction of less than a tenth is not told from what masses leave.
            if norm > 0 and abs(direction @ rest) / np.linalg.norm(direction) > 0.1 * whole:
                correlation[k] = direction @ rest / norm
        return correlation

    def misfit(self, sign: int) -> Array:
        """Return `|y_k - sign x_k|^2 / (|y_k|^2 + |x_k|^2)` of each joint, shape (n,)."""
        x, y = self._residuals
        scale = np.sum(x**2, axis=0) + np.sum(y**2, axis=0)
        return np.asarray(np.sum((y - sign * x) ** 2, axis=0) / _replace_zeros(scale))

    @property
    def cost(self) -> float:
        """Sum over joints of the logarithm of the misfit, for the better sign of all torques.

        Infinite where the robot has no posture at the positions.
        """
        # Positions swapped, shifted or turned may be out of reach of a closed chain.
        if not self.model.joint_map.exists(self.q).all():
            return np.inf
        # Either sign, as an order is asked before the sign.
        return min(float(np.sum(np.log(self.misfit(sign) + COUNTS))) for sign in (1, -1))

    def changes(self) -> Iterator[TorqueFit]:
        """Yield the fits with two joints swapped: their torques, their motions, or both.

        Of more than `EVERY_PAIR` joints the best swap of torques alone.
        """
        if self.model.n_joints > EVERY_PAIR:
            yield self._with_torques(self._best_swap_of_torques())
            return
        for order in map(list, list_swaps(tuple(range(self.model.n_joints)))):
            motion: dict[str, Any] = {
                **{name: getattr(self, name)[:, order] for name in ("q", "qd", "qdd")},
                "friction": self.friction[order],
                "motion_of": tuple(self.motion_of[k] for k in order),
            }
            # Torques alone, both, motions alone.
            torques = self._with_torques(order)
            yield torques
            yield replace(torques, **motion)
            yield replace(self, **motion)

    def _with_torques(self, order: Sequence[int]) -> TorqueFit:
        """Return the comparison whose joint k has the torque of joint `order[k]`."""
        order = list(order)
        torque_of = tuple(self.torque_of[k] for k in order)
        return replace(self, tau=self.tau[:, order], torque_of=torque_of)

    def _best_swap_of_torques(self) -> tuple[int, ...]:
        """Return the order with two torques swapped whose `cost` is least.

        The cost is a sum over joints, so that the misfit of every torque at every joint gives all
        swaps.
        """
        n = self.model.n_joints
        x = self._residuals[0]
        costs = np.empty((2, n, n))
        for k, basis in enumerate(self.friction):
            y = self.tau - basis @ (basis.T @ self.tau)
            size = _replace_zeros(np.sum(x[:, k] ** 2) + np.sum(y**2, axis=0))
            for sign, cost in zip((1, -1), costs, strict=True):
                misfit = np.sum((y - sign * x[:, k, None]) ** 2, axis=0) / size
                cost[k] = np.log(misfit + COUNTS)
        falls = costs.diagonal(axis1=1, axis2=2)[:, :, None] - costs
        totals = costs.trace(axis1=1, axis2=2)[:, None, None] - falls - falls.swapaxes(1, 2)
        return min(
            list_swaps(tuple(range(n))),
            key=lambda order: totals[:, *(k for k in range(n) if order[k] != k)].min(),
        )


BETTER = 0.1
"""Fall of the logarithm of the unexplained variance, mean over joints, from which any masses fit
better: 5 % of the torque error."""


def measure_any_masses(fit: TorqueFit, W: Array | None = None) -> float:
    """Return the mean logarithm of the share that any masses and friction leave unexplained.

    `W` (N, n, p) are the columns, by default those under the description's gravity.
    """
    left = fit.unexplained(fit.observe(fit.model.gravity) if W is None else W)
    # 1e-4: unexplained share below which a better fit does not count.
    return float(np.mean(np.log(left + 1e-4)))


def compare_by_any_masses(fit: TorqueFit, other: TorqueFit) -> int:
    """Return 1 if any masses fit the other log better, -1 if worse, 0 if that is not clear.

    The whole log and both halves must agree. The masses of CAD, which may be wrong, do not count.
    """
    falls = [
        measure_any_masses(one) - measure_any_masses(two)
        for one, two in zip((fit, *fit.halves()), (other, *other.halves()), strict=True)
    ]
    # Parts that contradict each other show nothing.
    if abs(falls[0]) < BETTER or min(falls) < 0.0 < max(falls):
        return 0
    return 1 if falls[0] > 0.0 else -1


def _replace_zeros(x: Array) -> Array:
    """Return sizes (n,) with 1 in place of 0, to divide by."""
    return np.where(x > 0.0, x, 1.0)


def friction_bases(qd: Array, springs: Array) -> Array:
    """Return orthonormal bases (n, N, 3 + m) of friction and of the columns of springs (n, N, m).

    Friction is 1, qd_k and tanh(qd_k / 0.02) for velocities (N, n); dependent columns are zero.
    """
    terms = np.stack([np.ones_like(qd), qd, np.tanh(qd / BREAKAWAY)], axis=-1)
    friction = np.linalg.qr(terms.swapaxes(0, 1))[0]
    if not springs.size:
        return np.asarray(friction)
    # Springs beyond friction, so that the joint basis stays orthonormal.
    rest = springs - friction @ (friction.swapaxes(1, 2) @ springs)
    bases, sizes, _ = np.linalg.svd(rest, full_matrices=False)
    whole = np.linalg.norm(springs, axis=(1, 2))[:, None]
    # Share of the columns' size below which what is left of them is rounding.
    return np.concatenate([friction, bases * (sizes > 1e-9 * whole)[:, None, :]], axis=2)


def find_best_assignment(fit: TorqueFit) -> TorqueFit:
    """Swap pairs of joints as long as the torques fit decisively better, and one joint well."""
    best = fit
    # Each round swaps one pair: a cycle of three takes two.
    for _ in range(fit.model.n_joints):
        change = choose_decisive_change(best, best.changes(), lambda fit: fit.cost, FALL)
        if change is None:
            break
        moved = [
            k
            for k in range(fit.model.n_joints)
            if (change.torque_of[k], change.motion_of[k]) != (best.torque_of[k], best.motion_of[k])
        ]
        # One of the swapped joints must show it by itself.
        if max(abs(change.correlation[moved])) < CLEAR:
            break
        best = change
    return best


@dataclass(frozen=True, slots=True)
class TorqueSwap:
    """Hold two joints (from 0) whose torques are swapped, and their mean unexplained variance.

    Both shares are fractions of the torque's variance, in the order logged and after swapping.
    """

    joints: tuple[int, int]
    as_logged: float
    swapped: float


def find_swapped_torques(fit: TorqueFit) -> TorqueSwap | None:
    """Return the swap of two torques that base parameters and friction explain decisively better.

    Each order has its own least-squares fit of base parameters, viscous and Coulomb friction and
    offsets, torques scaled to unit variance. CAD values are not used, so the wrists of an arm,
    where friction exceeds the rigid-body torque, are checked too.
    """
    samples, n = fit.q.shape
    W = fit.observe(fit.model.gravity)
    # 3: torques per parameter below which any order is explained.
    if samples * n < 3 * W.shape[2]:
        return None
    normal = fit.normal_equations(W)
    logged = tuple(range(n))
    swaps = list_swaps(logged) if n <= EVERY_PAIR else normal.suspected_swaps()
    # A sum of logarithms that falls by 4: both unexplained shares fall to an eighth.
    found = choose_decisive_change(logged, swaps, normal.cost, 4.0)
    if found is None:
        return None
    # The two joints that have moved.
    i, j = (k for k in range(n) if found[k] != k)
    before, after = (normal.unexplained(order)[[i, j]].mean() for order in (logged, found))
    return TorqueSwap((i, j), float(before), float(after))


NEGLIGIBLE = 1e-3
"""Unexplained share below which a better fit does not count."""
GAIN = 0.5
"""Factor to which the unexplained share of each torque of a swap must fall."""


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """The normal equations of each joint's rows with each joint's torque.

    Of `n_columns` parameters (p,) joint k has those of `support[k]` (s,), with `grams[k]` (s, s)
    and `sides[k]` (n, s) for torques of unit variance; `power` and `spread` (n,) are of the
    torques, scaled and as logged.
    """

    n_columns: int
    support: tuple[Indices, ...]
    grams: tuple[Array, ...]
    sides: tuple[Array, ...]
    power: Array
    spread: Array
    samples: int

    def cost(self, torque_of: tuple[int, ...]) -> float:
        """Return the sum of logarithms of the unexplained shares, if each torque moved gains."""
        logged = self._as_logged + NEGLIGIBLE
        shares = self.unexplained(torque_of) + NEGLIGIBLE
        for k, j in enumerate(torque_of):
            # A torque that is constant, or noise alone, is explained no better at another joint.
            # Each must gain, so that one good fit does not carry a bad one.
            if k != j and (self.power[j] == 0.0 or shares[k] > GAIN * logged[j]):
                return np.inf
        return float(np.sum(np.log(shares)))

    @cached_property
    def _as_logged(self) -> Array:
        return self.unexplained(tuple(range(len(self.power))))

    def solve(self, torque_of: tuple[int, ...]) -> Array:
        """Return the parameters (p,) that fit best if joint k has `torque_of[k]`."""
        # Torques are scaled by the logged column, wherever it is tried.
        scale = 1.0 / self.spread[list(torque_of)]
        side = np.zeros(self.n_columns)
        for k, (own, j) in enumerate(zip(self.support, torque_of, strict=True)):
            side[own] += scale[k] * self.sides[k][j]
        return self._weighted(scale).solve(side)

    def _weighted(self, scale: Array) -> Scaled:
        """Return the sum of the joints' matrices, rows times `scale` (n,)."""
        total = np.zeros((self.n_columns, self.n_columns))
        for own, gram, factor in zip(self.support, self.grams, scale, strict=True):
            total[np.ix_(own, own)] += factor**2 * gram
        return Scaled(total)

    def unexplained(self, torque_of: tuple[int, ...]) -> Array:
        """Return the unexplained share (n,) of the torques if joint k has `torque_of[k]`."""
        beta = self.solve(torque_of)[:, None]
        return np.concatenate(
            [self._left_at(k, np.array([j]), beta) for k, j in enumerate(torque_of)]
        )

    def _left_at(self, k: int, torques: Indices, betas: Array) -> Array:
        """Return the share (m,) of each torque that its parameters (p, m) leave at joint k."""
        own = betas[self.support[k]] / self.spread[torques]
        energy = np.sum(own * (self.grams[k] @ own - 2.0 * self.sides[k][torques].T), axis=0)
        # |y - W beta|^2 from the normal equations, per sample.
        return np.asarray(np.maximum(self.power[torques] + energy / self.samples, 0.0))

    def suspected_swaps(self) -> list[tuple[int, ...]]:
        """Return the few orders with two torques swapped that may explain both torques better.

        Each row keeps the weight of the torque logged at its joint. One factor then serves all
        pairs, and a swap is two other right sides. Torques that truly are swapped are explained up
        to their noise with any weights, so that their pair is among the best.
        """
        n = len(self.power)
        scale = 1.0 / self.spread
        weighted = self._weighted(scale)
        # What torque j at joint k adds to the solution, (p, n) for each k.
        moved = []
        for k, own in enumerate(self.support):
            side = np.zeros((self.n_columns, n))
            side[own] = self.sides[k].T * (scale[k] ** 2 * self.spread)
            moved.append(weighted.solve(side))
        logged = np.sum([moved[k][:, k] for k in range(n)], axis=0)
        shares = np.empty((n, n))
        for k in range(n):
            there = moved[k] - moved[k][:, [k]]
            back = np.stack([moved[j][:, k] - moved[j][:, j] for j in range(n)], axis=1)
            shares[k] = self._left_at(k, np.arange(n), logged[:, None] + there + back)
        # A torque much larger than its row's spoils the fit there, whichever it is: what one of the
        # two gains makes a pair suspect, and what the other seems to lose is not counted.
        falls = np.log(shares + NEGLIGIBLE) - np.log(self._as_logged + NEGLIGIBLE)
        falls = np.minimum(falls, 0.0) + np.minimum(falls.T, 0.0)
        pairs = np.argwhere(np.triu(falls < np.log(GAIN), 1)).tolist()
        best = sorted(pairs, key=lambda pair: falls[*pair])[:MOST_SUSPECTS]
        return [_swapped(tuple(range(n)), i, j) for i, j in best]


def replace_links_by_rods(model: RobotModel) -> RobotModel:
    """Return the robot with thin rods for links.

    Mass [kg] is `length * stretched_length(model)**2`, that is 1 kg/m^3.
    """
    bodies = [LinkInertia.zero() for _ in range(model.n_links)]
    for solid in link_solids(model):
        if solid.link == ROOT or solid.kind != "rod":
            continue
        span = solid.stop - solid.start
        # 1 kg/m^3 of a rod as wide as the arm is long: the mass is then the density.
        mass = solid.length * stretched_length(model) ** 2
        inertia = mass / 12.0 * (span @ span * np.eye(3) - np.outer(span, span))
        rod = LinkInertia.from_com(mass, 0.5 * (solid.start + solid.stop), inertia)
        bodies[solid.link] = bodies[solid.link] + rod
    return model.with_parameters(np.concatenate([body.parameters for body in bodies]))


def infer_density(fit: TorqueFit) -> float | None:
    """Return the density of rods [kg/m^3] whose torques are as large as the measured ones.

    None where the torques are not mostly gravity's, or unlike the torques of rods.
    """
    rods = replace(fit, model=replace_links_by_rods(fit.model))
    predicted = rods.predicted
    # The largest torque decides: there gravity is clearest.
    k = int(np.argmax(predicted))
    # Least share of gravity in the largest torque, and its least correlation with the rods' torque.
    if not predicted[k] > 0 or rods.gravity[k] < 0.8 * predicted[k]:
        return None
    if abs(rods.correlation[k]) < 0.7:
        return None
    # Torques are linear in the masses, so that their ratio is the density.
    return float(np.linalg.norm(rods.measured) / np.linalg.norm(predicted))
