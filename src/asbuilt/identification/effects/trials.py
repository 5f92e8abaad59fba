"""Trials of effects: what each would change in a fit toward CAD, and on held-out motion.

Four tests ask whether an effect is sure, each of another fit, later ones of fits that are nearer to
the result:

| test | of | sure if |
|---|---|---|
| `Trial.is_sure` | a candidate, next to what is taken so far | no chance over all candidates |
| `Selection._measure_sureness` | an effect that was taken, next to all others | two errors |
| `_Search._is_sure` | one that is stated and taken out of the robot | chi-square of its values |
| `effect_findings.is_sure` | a drive term in the final fit, with its bodies | two errors |
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.linalg import lapack
from scipy.special import chdtrc, fdtrc

from asbuilt.arrays import Array, Indices
from asbuilt.identification.effects.effect import Described
from asbuilt.identification.effects.gathering import At, Candidate
from asbuilt.identification.information.equations import MODEL, BlockRows, Products, Squares
from asbuilt.statistics import estimate_mean_error


@dataclass(frozen=True, slots=True)
class SelectionRules:
    """Say when an effect is taken."""

    level: float = 0.05
    """Probability that chance takes any, over all candidates (Bonferroni)."""
    certain: float = 1.0
    """Standard errors over groups of different motion by which the held-out error must fall."""
    unheld: float = 2.0
    """The same where the description has no masses, or masses that the data refute: then nothing
    but the data holds the bodies, and this fit's will not be the model's."""
    form: float = 2.0
    """Standard errors by which another form, such as a spring between points for a torsion spring,
    must predict other motion better than the one that lowers the cost most for its columns."""
    worth: float = 0.02
    """Share of the squared torque error on other motion that an effect must take away: 1 % of the
    torque error."""
    sure: float = 2.0
    """Fall of the cost for each column, in half squares of independent standard errors: two."""
    two_errors: float = 2.0
    """Standard errors next to all others below which an effect is not in a model."""
    felt: float = 1e-3
    """Share of the torque of some joint below which nothing is worth a term: models of arms are
    not more exact."""
    named: float = 0.06
    """Fall of the logarithm of the squared error on other motion, mean over joints, from which on
    an effect of the whole robot that the model has not is named: 3 % of the torque error."""
    imitated: float = 10.0
    """Fall of the cost, in its unit, that bodies nearer to CAD must be worth where the held-out
    error does not fall: they imitated the effect. 4.5 standard errors."""
    alike: float = 0.5
    """Share of the worth from which on another effect is a look-alike."""
    shown: float = 1e-3
    """Squared part of a column outside all others below which a log does not show an effect."""
    separate: float = 1e-6
    """Squared part of a column outside all others below which it has no trial."""
    acting: float = 1e-18
    """Squared length of a column, in the largest of its effect, below which it does not act on this
    robot: columns of other effects and of bodies have other units."""
    most: int = 20
    """Effects taken."""
    ridge: float = 1e-9
    """Added to the unit diagonal of parameters without a prior."""


RULES = SelectionRules()
NONE = np.zeros(0, dtype=np.int64)
"""No columns."""


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """Hold the mean (p,) and information (p, p) of the model's own parameters by CAD.

    `effect` is the number of samples that count as one, by which costs are divided.
    """

    mean: Array
    information: Array
    effect: float


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """Hold what a candidate would do in addition to what is taken.

    `values` (m,) and `covariance` are of its parameters, by the scatter of time blocks, `p_value`
    tests that all are zero. `relief` (groups,) is the logarithm of the fall of the squared
    error on each held-out group. `gain` is the fall of the cost in half squares of independent
    standard errors, by the logarithm of its ratio; `nearer` how much nearer to CAD bodies come, in
    the same unit; `felt` its share in the torque of the joint where it is largest.
    `alternatives` would explain as much, and are needless next to it. `errors` are the held-out
    errors without and with it.
    """

    candidate: Candidate
    values: Array
    covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))
    p_value: float = 0.0
    relief: Array = field(default_factory=lambda: np.zeros(0))
    gain: float = 0.0
    nearer: float = 0.0
    felt: float = 0.0
    alternatives: tuple[Candidate, ...] = ()
    errors: tuple[float, float] = (0.0, 0.0)

    @property
    def relief_error(self) -> float:
        """Standard error of the mean relief."""
        return estimate_mean_error(self.relief)

    @property
    def chance(self) -> float:
        """Probability of such a fall of the cost by chance."""
        return float(chdtrc(len(self.values), 2.0 * self.gain))

    @property
    def worth(self) -> float:
        """Fall of the cost less what as many columns take away by chance."""
        return evaluate_worth(self.gain, len(self.values))

    def is_sure(self, n_candidates: int, robot: Described) -> bool:
        """Return whether the effect is no chance, is felt, and has a size that robots have."""
        sure = self.p_value * n_candidates <= RULES.level and self.felt >= RULES.felt
        own = self.candidate
        return sure and own.effect.is_possible(self.values, own.joint, robot)

    def is_taken(self, n_candidates: int, robot: Described, held: bool) -> bool:
        """Return whether the effect is sure, and lowers the error on other motion or is imitated.

        Imitated: physically consistent bodies come nearer to CAD by more than chance, and other
        motion is predicted no worse. Where CAD does not hold the bodies, that is no reason.
        """
        if not self.is_sure(n_candidates, robot):
            return False
        mean = float(self.relief.mean())
        error = self.relief_error
        certain = RULES.certain if held else RULES.unheld
        predicts = mean > certain * error and mean > RULES.worth
        imitated = held and self.nearer > RULES.imitated and mean > -error
        return predicts or imitated


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """Hold a fit without some columns (c,): parameters, and how a unit of each column moves them.

    The parameters `inside` (i,) have `values` (i,), from which a unit of a column takes `moves`
    (i, c). `across` (c, i) are products of the columns with those inside, `torque` (c,) with the
    torque. `inverse` (i, r) are columns of the inverse normal matrix, of parameters that something
    `replaces` (r,).
    """

    squares: Squares | Products
    n_columns: int
    inside: Indices
    columns: Indices
    replaces: Indices
    values: Array
    moves: Array
    across: Array
    torque: Array
    inverse: Array

    def beside(self, candidate: Candidate) -> _Fit:
        """Return the fit without what a candidate replaces, and its columns alone."""
        c = np.searchsorted(self.columns, candidate.places)
        moves = self.moves[:, c]
        values = self.values
        r = np.flatnonzero(np.isin(self.replaces, candidate.replaces))
        if r.size:
            # What holds parameters at zero moves the others by columns of the inverse.
            gone = np.isin(self.inside, self.replaces[r])
            inverse = self.inverse[:, r]
            both = np.column_stack([moves, values])
            both -= inverse @ np.linalg.solve(inverse[gone], both[gone])
            both[gone] = 0.0
            moves = both[:, :-1]
            values = both[:, -1]
        return replace(
            self,
            columns=candidate.places,
            replaces=NONE,
            values=values,
            moves=moves,
            across=self.across[c],
            torque=self.torque[c],
            inverse=self.inverse[:, :0],
        )

    @property
    def schur(self) -> Array:
        """The Schur complement (c, c) of the columns given the parameters inside."""
        return self.squares.at(self.columns, self.columns) - self.across @ self.moves

    @property
    def score(self) -> Array:
        """Products (c,) of the columns with the residual."""
        return self.torque - self.across @ self.values

    def residual(self, d: Array) -> Array:
        """Return the coefficients (P + 1,) of the residual when the columns have values d.

        They are minus all values, and one for the torque.
        """
        found = np.zeros(self.n_columns)
        found[self.inside] = self.moves @ d - self.values
        found[self.columns] = -d
        found[-1] = 1.0
        return found

    @property
    def start(self) -> Array:
        """The coefficients (P + 1,) of the residual without the columns."""
        return self.residual(np.zeros(len(self.columns)))

    def changes(self) -> Array:
        """Return the change (c, P + 1) of these coefficients by a unit of each column."""
        found = np.zeros((len(self.columns), self.n_columns))
        found[:, self.inside] = self.moves.T
        found[np.arange(len(self.columns)), self.columns] = -1.0
        return found


class Trials:
    """Fit a model with effects toward CAD on groups of time blocks, and try further effects.

    The cost is `sum_k w_k^2 |tau_k - W_k beta - E_k x|^2 + (beta - beta_0)^T P (beta - beta_0)`,
    the quadratic form of a fit toward CAD; effects have no prior but a ridge for collinear columns.
    """

    def __init__(
        self,
        rows: BlockRows,
        candidates: Sequence[Candidate],
        prior: Prior,
        weights: Array,
        groups: Sequence[Indices],
    ) -> None:
        """Take rows, candidates, prior, weights of the joints (n,), and groups of blocks."""
        self.rows = rows
        self.candidates = candidates
        self.prior = prior
        self.weights = weights
        self.n_base = rows.groups[MODEL]
        self._groups = groups
        # A fit is the coefficients (-values, 1) of its residual: every square is a form in this
        # matrix.
        self._total = rows.squares(weights)
        length = self._total.diagonal
        self._size = np.sqrt(length)
        self._acts = length > RULES.acting * _find_largest(candidates, length)
        self._n_samples = max(rows.n_samples, 1)
        rms = np.sqrt(_sum_torques(rows) / self._n_samples)
        # A joint without torque would divide by zero; below rounding of the others it has none.
        tiny = np.finfo(np.float64).tiny
        least = max(float(rms.max(initial=0.0)) * np.finfo(np.float64).eps, tiny)
        self._rms = np.maximum(rms, least)
        self._factored: dict[bytes, tuple[Array, Array]] = {}
        self.taken: list[Candidate] = []

    # What only trials ask is derived by the first one: a search settles values without any.

    @cached_property
    def _torque(self) -> Array:
        """Squared torque of each held-out group and joint."""
        return np.array([_sum_torques(self.rows, group) for group in self._groups])

    @cached_property
    def _apart(self) -> Array:
        """Squared part of each column outside the model's own, in its length, (P,)."""
        model = self._list_inside(())
        every = np.arange(self.rows.n_columns)
        # Unit columns, so that the tolerance is a share.
        size = np.sqrt(np.maximum(self._total.diagonal[:-1], np.finfo(np.float64).tiny))
        across = self._total.at(model, every) / np.outer(size[model], size)
        inverse = np.linalg.pinv(across[:, model], rcond=RULES.separate, hermitian=True)
        # Schur complement of a unit column: 1 - g^T G^+ g.
        return np.asarray(1.0 - np.einsum("ij,ij->j", across, inverse @ across))

    def _is_shown(self, candidate: Candidate, least: float = RULES.shown) -> bool:
        """Return whether data alone can show an effect: bodies off CAD are no error of the log."""
        return bool(np.all(self._apart[self.acting(candidate).places] >= least))

    def shows(self, candidate: Candidate) -> bool:
        """Return whether data have a value for each parameter of an effect, however unsure."""
        return self._is_shown(candidate, RULES.separate)

    def own(self, at: At) -> Candidate:
        """Return the effect at a joint that is taken."""
        return next(candidate for candidate in self.taken if candidate.at == at)

    def every_place(self, candidate: Candidate) -> Indices:
        """Return the positions of all parameters of a candidate, whether they act or not."""
        return next(equation for equation in self.candidates if equation.at == candidate.at).places

    def candidate(self, at: At) -> Candidate:
        """Return the first candidate of an effect at a joint, with what acts of it."""
        return self.acting(next(candidate for candidate in self.candidates if candidate.at == at))

    def acting(self, candidate: Candidate) -> Candidate:
        """Return a candidate with the parameters of it that act on this robot."""
        return replace(candidate, places=candidate.places[self._acts[candidate.places]])

    def held_out_error(self, taken: Sequence[Candidate]) -> float:
        """Return the relative torque error with these effects, the geometric mean of groups.

        So a group that the others hardly determine counts no more than others.
        """
        error, torque = (
            squares.sum(axis=1)
            for squares in (self._leave_out(self._list_inside(taken)), self._torque)
        )
        # Exact fits of simulations have no logarithm.
        there = torque > 0.0
        least = float(np.finfo(np.float64).eps) ** 2
        squares = np.maximum(error[there] / torque[there], least)
        return float(np.exp(0.5 * np.mean(np.log(squares)))) if squares.size else 0.0

    def values(self) -> Array:
        """Return all parameters (P,) of the fit to everything, zero for what is not taken."""
        return -self._fit(self._list_inside(self.taken)).start[:-1]

    def values_of(self, candidates: Sequence[Candidate]) -> tuple[Array, Array]:
        """Return values of candidates next to all others taken, and their covariance.

        The covariance is that by the scatter of time blocks.
        """
        others = [
            other for other in self.taken if all(other is not candidate for candidate in candidates)
        ]
        places = np.concatenate([candidate.places for candidate in candidates])
        fit = self._fit(self._list_inside(others), places)
        d = np.asarray(np.linalg.solve(fit.schur, fit.score))
        # Scores of a block are its columns times its residual; they sum to zero at the fit.
        (left,) = self._score_blocks([fit], fit.residual(d)[None])
        return d, _estimate_scatter(fit.schur, left, d)[0]

    def values_by_data(self, candidates: Sequence[Candidate]) -> tuple[Array, Array]:
        """Return what `values_of` does, of a fit that does not know CAD."""
        with_cad = self.prior
        self.prior = replace(with_cad, information=np.zeros_like(with_cad.information))
        self._factored.clear()
        found = self.values_of(candidates)
        self.prior = with_cad
        self._factored.clear()
        return found

    def gains_in_halves(self, candidate: Candidate) -> list[float]:
        """Return the fall of the cost by a candidate's values on each half of the blocks.

        All others are fitted to that half. Values x with score s and Schur complement S there lower
        its cost by `2 s^T x - x^T S x`; what a half does not determine counts neither way.
        """
        others = [taken for taken in self.taken if taken is not candidate]
        inside = self._list_inside(others)
        x = self.values_of([candidate])[0]
        halves = np.array_split(np.arange(self.rows.n_blocks), 2)
        found = []
        for other in reversed(halves):
            fit = self._fit_without(other, inside, candidate.places)
            found.append(float(2.0 * fit.score @ x - x @ fit.schur @ x))
        return found

    def smallest_seen(self, candidate: Candidate) -> float:
        """Return the value from which on one parameter would be sure, infinite if none would."""
        acting = self.acting(candidate)
        if not acting.places.size:
            return 0.0
        # Bodies take the place of a column that lies within the model's: no size would show.
        if not self._is_shown(acting):
            return np.inf
        fit = self._fit(self._list_inside(self.taken), acting.places)
        n = int(np.sum(self.weights > 0.0))
        # A fall of `named` in the mean of n logarithms is n times that at the one joint it acts at.
        of_joint = float(self._measure_error(fit.start)) / n
        felt = of_joint * np.expm1(n * RULES.named)
        # A value x lowers the cost by S x^2, S the Schur complement: what of the two needs more.
        least = max(2.0 * self.prior.effect * RULES.imitated, felt)
        return float(np.sqrt(least / fit.schur[0, 0]))

    def torque_of(self, trial: Trial) -> float:
        """Return the RMS torque of a trial at its joint, of all joints together without one."""
        return float(np.linalg.norm(self._measure_torques(trial.candidate, trial.values)))

    def _measure_torques(self, candidate: Candidate, values: Array) -> Array:
        """Return the RMS torque (n,) of a candidate with these values."""
        energy = np.zeros(self.rows.n_joints)
        acting = self.rows.places[:, candidate.places] >= 0
        for k in np.flatnonzero(acting.any(axis=1)).tolist():
            torque = self.rows.product(k, candidate.places, values)
            energy[k] = np.einsum("bm,bm->", torque, torque)
        return np.sqrt(energy / self._n_samples)

    def trials(self, candidates: Iterable[Candidate]) -> list[Trial]:
        """Try each candidate alone with what is taken; what it replaces is left out then.

        Those that do not lower the cost surely have no trial.
        """
        # Parameters inside change with every effect taken: older factors are of no use.
        self._factored.clear()
        gaining = self._find_gaining(candidates)
        if not gaining:
            return []
        asked = [candidate for candidate, _ in gaining]
        whole = self._fit(*self._list_asked(asked))
        fits = [whole.beside(candidate) for candidate in asked]
        values = [np.asarray(np.linalg.solve(fit.schur, fit.score)) for fit in fits]
        residuals = np.array([fit.residual(d) for fit, d in zip(fits, values, strict=True)])
        scores = self._score_blocks(fits, residuals)
        nearer = self._measure_distance(whole.start) - self._measure_distance(residuals)
        # Half squares of independent standard errors, the unit of the gain.
        nearer /= 2.0 * self.prior.effect
        reliefs = self._measure_reliefs(asked)
        concluded = map(self._conclude, asked, [gain for _, gain in gaining], fits, values, scores)
        return [
            replace(trial, relief=relief, nearer=near)
            for trial, relief, near in zip(concluded, reliefs, nearer.tolist(), strict=True)
        ]

    def _list_inside(self, taken: Sequence[Candidate]) -> Indices:
        left = np.setdiff1d(
            np.arange(self.n_base),
            np.concatenate([np.zeros(0), *(c.replaces for c in taken)]),
        )
        return np.concatenate([left, *(candidate.places for candidate in taken)]).astype(np.int64)

    def _fit(self, inside: Indices, columns: Indices = NONE, replaces: Indices = NONE) -> _Fit:
        """Fit the parameters inside to all blocks."""
        key = inside.tobytes()
        if key not in self._factored:
            self._factored[key] = self._factor(self._total, inside)
        return self._ask(self._total, inside, columns, replaces, self._factored[key])

    def _fit_without(
        self, blocks: Indices, inside: Indices, columns: Indices = NONE, replaces: Indices = NONE
    ) -> _Fit:
        """Fit the parameters inside to all blocks but some: their products less those of these."""
        every = np.union1d(np.append(inside, self.rows.n_columns), columns)
        own = self.rows.inner(self.weights, every, every, blocks)
        rest = Products(every, self._total.at(every, every) - own)
        return self._ask(rest, inside, columns, replaces, self._factor(rest, inside))

    def _factor(self, squares: Squares | Products, inside: Indices) -> tuple[Array, Array]:
        """Return the factor of the normal equations of the parameters inside, and their values."""
        root, failed = lapack.dpotrf(self._build_normal(squares, inside)[0], overwrite_a=True)
        if failed:
            raise np.linalg.LinAlgError("normal equations of effects are singular")
        # The right side is W^T tau + P beta_0.
        b = squares.at(inside, np.array([self.rows.n_columns]))[:, 0]
        model = inside < self.n_base
        b[model] += (self.prior.information @ self.prior.mean)[inside[model]]
        return root, lapack.dpotrs(root, b)[0]

    def _ask(
        self,
        squares: Squares | Products,
        inside: Indices,
        columns: Indices,
        replaces: Indices,
        factored: tuple[Array, Array],
    ) -> _Fit:
        """Return a fit with what columns would change."""
        root, values = factored
        across = squares.at(columns, inside)
        right = np.hstack([across.T, np.equal.outer(inside, replaces)])
        moves, inverse = np.hsplit(
            lapack.dpotrs(root, right)[0] if right.size else right, [len(columns)]
        )
        torque = squares.at(columns, np.array([self.rows.n_columns]))[:, 0]
        n = self.rows.n_columns + 1
        return _Fit(squares, n, inside, columns, replaces, values, moves, across, torque, inverse)

    def _list_asked(self, candidates: Sequence[Candidate]) -> tuple[Indices, Indices, Indices]:
        """Return parameters inside, and all columns that candidates have and replace."""
        inside = self._list_inside(self.taken)
        columns = np.unique(np.concatenate([candidate.places for candidate in candidates]))
        replaced = np.concatenate([candidate.replaces for candidate in candidates])
        return inside, columns, np.intersect1d(replaced, inside)

    def _build_normal(self, squares: Squares | Products, inside: Indices) -> tuple[Array, Array]:
        """Return the normal matrix of the parameters inside, and the prior's part of it."""
        A = squares.at(inside, inside)
        prior = np.zeros_like(A)
        model = inside[inside < self.n_base]
        # The model's come first.
        of_model = (slice(len(model)),) * 2
        prior[of_model] = self.prior.information[np.ix_(model, model)]
        A[of_model] += prior[of_model]
        # On the diagonal relative to it, so that units do not matter; prior-free columns stay
        # regular.
        A[np.diag_indices_from(A)] *= 1.0 + RULES.ridge
        return A, prior

    def _leave_out(self, inside: Indices) -> Array:
        """Return the squared error of each joint on each held-out group (groups, n)."""
        fits = ((self._fit_without(group, inside), group) for group in self._groups)
        return np.array([self._measure_squares(fit.start[None], group)[0] for fit, group in fits])

    def _measure_squares(self, residuals: Array, blocks: Indices) -> Array:
        """Return the squared error (m, n) of each joint by residuals (m, P + 1) on some blocks."""
        found = np.empty((len(residuals), self.rows.n_joints))
        for k, rows in enumerate(self.rows.rows):
            error = rows[blocks].reshape(-1, rows.shape[-1]) @ self._at_joint(residuals, k)
            found[:, k] = np.einsum("im,im->m", error, error)
        return found

    def _at_joint(self, coefficients: Array, k: int) -> Array:
        """Return what a joint's rows are multiplied by, of coefficients (m, P + 1) of all."""
        return coefficients[:, np.append(self.rows.support[k], self.rows.n_columns)].T

    def _score_blocks(self, fits: Sequence[_Fit], residuals: Array) -> list[Array]:
        """Return the scores (B, c) of each block's columns of fits with residuals (m, P + 1)."""
        changes = np.vstack([fit.changes() for fit in fits])
        owner = np.repeat(np.arange(len(fits)), [len(fit.columns) for fit in fits])
        scores = np.zeros((self.rows.n_blocks, len(owner)))
        for k, (rows, weight) in enumerate(zip(self.rows.rows, self.weights, strict=True)):
            flat = weight * rows.reshape(-1, rows.shape[-1])
            moved = (flat @ self._at_joint(changes, k)).reshape(*rows.shape[:2], -1)
            error = (flat @ self._at_joint(residuals, k)).reshape(*rows.shape[:2], -1)
            scores -= np.einsum("bmc,bmc->bc", moved, error[..., owner])
        return np.split(scores, np.flatnonzero(np.diff(owner)) + 1, axis=1)

    def _measure_error(self, residuals: Array) -> Array:
        """Return the weighted squared errors (...) of residuals (..., P + 1)."""
        there = np.flatnonzero(np.any(residuals.reshape(-1, residuals.shape[-1]), axis=0))
        x = residuals[..., there]
        return np.asarray(np.sum((x @ self._total.at(there, there)) * x, axis=-1))

    def _measure_distance(self, residuals: Array) -> Array:
        """Return the squared distances (...) from CAD of the values in residuals (..., P + 1)."""
        # The residual holds minus the values.
        away = -residuals[..., : self.n_base] - self.prior.mean
        return np.asarray(np.sum((away @ self.prior.information) * away, axis=-1))

    def _measure_cost(self, residuals: Array) -> Array:
        """Return the costs (...) of residuals (..., P + 1)."""
        return self._measure_error(residuals) + self._measure_distance(residuals)

    def _conclude(
        self,
        candidate: Candidate,
        gain: float,
        fit: _Fit,
        d: Array,
        scores: Array,
    ) -> Trial:
        """Return the trial of a candidate with values d, and scores (B, c) of the blocks there."""
        # Their scatter is the covariance of the values.
        covariance, p_value = _estimate_scatter(fit.schur, scores, d)
        felt = float(np.max(self._measure_torques(candidate, d) / self._rms))
        if len(candidate.replaces):
            # That a term in place of another one is zero is no question: its gain is one. And
            # nearly all of its torque is the torque of what it replaces.
            p_value = float(chdtrc(max(len(d) - len(candidate.replaces), 0) + 1, 2.0 * gain))
            fall = 2.0 * self.prior.effect * max(gain, 0.0)
            felt = float(np.sqrt(fall / self._total.diagonal[-1]))
        return Trial(candidate, d, covariance, p_value, gain=gain, felt=felt)

    def _measure_reliefs(self, candidates: Sequence[Candidate]) -> Array:
        """Return the logarithm of the fall of the squared error on each group, (m, groups)."""
        asked = self._list_asked(candidates)
        reliefs = []
        for group, torque in zip(self._groups, self._torque, strict=True):
            fit = self._fit_without(group, *asked)
            parts = (fit.beside(candidate) for candidate in candidates)
            # The values refit with the training equations: the held-out group only judges them.
            residuals = [fit.start, *(part.residual(self._damp(part)) for part in parts)]
            # Exact torques of a simulation leave squares of 0, of which the ratio would be
            # undefined.
            floor = np.finfo(np.float64).eps * torque + np.finfo(np.float64).tiny
            error = np.maximum(self._measure_squares(np.array(residuals), group), floor)
            # Joints without weight are not in the fit, so that they say nothing about it.
            ratio = (error[0] / error[1:])[:, self.weights > 0.0]
            reliefs.append(np.log(ratio).mean(axis=1))
        return np.array(reliefs).T

    def _damp(self, fit: _Fit) -> Array:
        """Return the values (c,) of columns by a ridge, for those that a group alone shows."""
        ridge = RULES.ridge * np.diag(self._size[fit.columns] ** 2)
        return np.asarray(np.linalg.solve(fit.schur + ridge, fit.score))

    def _find_gaining(self, candidates: Iterable[Candidate]) -> list[tuple[Candidate, float]]:
        """Return the candidates that lower the cost surely, with their gain.

        Without what they replace the cost is another one; a column with score s and Schur
        complement S lowers it by `s^T S^-1 s`.
        """
        acting = [candidate for candidate in map(self.acting, candidates) if candidate.places.size]
        if not acting:
            return []
        whole = self._fit(*self._list_asked(acting))
        cost = float(self._measure_cost(whole.start))
        fits = [whole.beside(candidate) for candidate in acting]
        # What is lost without the parameters replaced, before the new columns win it back.
        lost = np.zeros(len(acting))
        replacing = [k for k, candidate in enumerate(acting) if candidate.replaces.size]
        if replacing:
            lost[replacing] = (
                self._measure_cost(np.array([fits[k].start for k in replacing])) - cost
            )
        gaining = []
        for candidate, fit, loss in zip(acting, fits, lost.tolist(), strict=True):
            schur = fit.schur
            scale = self._size[candidate.places]
            # A column within the others up to rounding would have any value.
            if np.linalg.eigvalsh(schur / np.outer(scale, scale))[0] < RULES.separate:
                continue
            fall = float(fit.score @ np.linalg.solve(schur, fit.score)) - loss
            # The logarithm: what an effect explains is no noise of the fit with it.
            left = max(1.0 - fall / cost, np.finfo(np.float64).eps) if cost > 0.0 else 1.0
            gain = -0.5 * cost / self.prior.effect * float(np.log(left))
            # Chance takes half a square for each column; twice that is asked here, Bonferroni
            # later.
            if gain >= RULES.sure * len(candidate.places):
                gaining.append((candidate, gain))
        return gaining


def _find_largest(candidates: Iterable[Candidate], length: Array) -> Array:
    """Return the largest squared length (P + 1,) of the columns of each one's effect."""
    largest = np.zeros_like(length)
    of_effects: dict[str, list[Indices]] = {}
    for candidate in candidates:
        of_effects.setdefault(candidate.effect.key, []).append(candidate.places)
    for places in map(np.concatenate, of_effects.values()):
        largest[places] = length[places].max(initial=0.0)
    return largest


def evaluate_worth(gain: float, n_columns: int) -> float:
    """Return a fall of the cost less what as many columns take away by chance."""
    return gain - n_columns * float(np.log(max(gain, 1.0)))


def _estimate_scatter(own: Array, left: Array, d: Array) -> tuple[Array, float]:
    """Return the covariance by scores of blocks (B, m), and the p value of all values being 0.

    Hotelling's T^2 of m values with B - 1 degrees of freedom.
    """
    B, m = left.shape
    # Sandwich: the inverse, the scatter of the scores, the inverse; B / (B - 1) for their mean.
    inverse = np.linalg.inv(own)
    covariance = inverse @ (left.T @ left * B / max(B - 1, 1)) @ inverse
    try:
        square = float(d @ np.linalg.solve(covariance, d))
    # More columns than blocks leave a singular scatter, that tells nothing.
    except np.linalg.LinAlgError:
        return covariance, 1.0
    # F = T^2 (B - m) / (m (B - 1)).
    freedom = max(B - m, 1)
    return covariance, float(fdtrc(m, freedom, max(square, 0.0) * freedom / (m * max(B - 1, 1))))


def _sum_torques(rows: BlockRows, blocks: Indices | None = None) -> Array:
    """Return the squared torque of each joint (n,) in all blocks or some."""
    torques = [own[..., -1] if blocks is None else own[blocks, :, -1] for own in rows.rows]
    return np.array([np.einsum("bm,bm->", torque, torque) for torque in torques])
