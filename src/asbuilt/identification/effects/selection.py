"""Selection of effects: sure, worth their torque, nearer to CAD; and what a model still lacks."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import block_diag

from asbuilt.arrays import Array, Indices
from asbuilt.findings import join_names
from asbuilt.identification.effects.effect import Described
from asbuilt.identification.effects.gathering import EFFECT_COLUMNS, At, Candidate
from asbuilt.identification.effects.trials import RULES, Prior, Trial, Trials
from asbuilt.identification.estimators.least_squares import fit_least_squares
from asbuilt.identification.information.equations import BlockRows
from asbuilt.identification.uncertainty.bias import (
    OmittedBias,
    derive_estimate_moves,
    shrink_effects,
)
from asbuilt.scaled import Scaled
from asbuilt.statistics import exceeds

if TYPE_CHECKING:
    from asbuilt.identification.identify import Fit


class Selection(Trials):
    """Choose effects one at a time, by trials."""

    def __init__(
        self,
        rows: BlockRows,
        candidates: Sequence[Candidate],
        robot: Described,
        prior: Prior,
        weights: Array,
        groups: Sequence[Indices],
        applied: Collection[str],
    ) -> None:
        """Take what `Trials` takes, the robot, and the keys of effects that models may have."""
        super().__init__(rows, candidates, prior, weights, groups)
        self.robot = robot
        self.held = robot.model.has_masses
        """Whether CAD holds the bodies."""
        self.applied = applied
        self.impossible: Collection[At] = ()
        """Effects that turned out to have no size that robots have."""
        self.given_up = set[At]()
        """Effects that were taken, and are not sure next to all others."""
        self.unsure: list[Trial] = []
        """Effects that are sure, but do not lower the error on other motion."""

    def run(self) -> list[Trial]:
        """Take effects one at a time, the most worthy first, and drop what later ones replace."""
        path = list[Trial]()
        before = list[Trial]()
        swapped = False
        self.given_up.clear()
        while True:
            busy = {slot for candidate in self.taken for slot in candidate.busy}
            left = [
                candidate
                for candidate in self.candidates
                if candidate.slot not in busy
                # Bodies that CAD lacks imitate an error of the log: the data alone must show one.
                and candidate.at not in self.impossible
                and candidate.at not in self.given_up
                and (not candidate.effect.of_log or self._is_shown(candidate))
            ]
            # Forms and trial values of an effect at a joint count as one question.
            n = len({candidate.at for candidate in left})
            robot = self.robot
            sure = [trial for trial in self.trials(left) if trial.is_sure(n, robot)]
            trials = [trial for trial in sure if trial.is_taken(n, robot, self.held)]
            # Only now it shows which others the last effect has made needless.
            if path:
                path[-1] = _add_alternatives(path[-1], before, trials)
            if trials and len(path) < RULES.most:
                best = self._prefer(max(trials, key=lambda each: each.worth), trials)
                path.append(best)
                self.taken.append(best.candidate)
                before = trials
            # Once: a second exchange could undo the first without end. After one, other effects
            # can be worth their torque that were not before.
            elif not swapped and self._swap_forms(path):
                swapped = True
            elif weak := self._find_weakest(path):
                # What is given up may not come back, or the path would never end.
                self.given_up.add(weak.candidate.at)
                path.remove(weak)
                self.taken = [
                    candidate for candidate in self.taken if candidate is not weak.candidate
                ]
            else:
                self.unsure = sure
                return path

    def _find_weakest(self, path: Sequence[Trial]) -> Trial | None:
        """Return the least sure effect of the path that is not sure next to all others, or None.

        In a model an effect needs two standard errors, a better explanation of each half of the
        log, and less error on left-out motion than without it.
        """
        weak = [
            (sureness, k)
            for k, trial in enumerate(path)
            if trial.candidate.effect.key in self.applied
            for sureness in (self._measure_sureness(trial.candidate),)
            if sureness < RULES.two_errors or not self._is_in_halves(trial.candidate)
        ]
        if weak:
            return path[min(weak)[1]]
        error = self.held_out_error(self.taken)
        for trial in path:
            others = [taken for taken in self.taken if taken is not trial.candidate]
            if trial.candidate.effect.key in self.applied and self.held_out_error(others) < error:
                return trial
        return None

    def _measure_sureness(self, candidate: Candidate) -> float:
        """Return how many standard errors an effect is from none, next to all others.

        That a term in place of another one is zero is no question.
        """
        if candidate.replaces.size:
            return np.inf
        values, covariance = self.values_of([candidate])
        return float(np.sqrt(Scaled(covariance).square(values) / len(values)))

    def _is_in_halves(self, candidate: Candidate) -> bool:
        """Return whether each half of the log is explained better with an effect as it is."""
        if candidate.replaces.size:
            return True
        return all(gain > 0.0 for gain in self.gains_in_halves(candidate))

    def _swap_forms(self, path: list[Trial]) -> bool:
        """Give effects of the path up for others of their kind that predict other motion better.

        What was worthiest when it was taken need not be so after what came later (Miller, Subset
        Selection in Regression, 2002, section 3.4). Returns whether any was.
        """
        changed = False
        # Each is asked next to what the others have become, not to what they were.
        for k, old in enumerate(path):
            best = self._find_best_of_kind(old.candidate)
            if best is not None:
                self.taken = [best.candidate if e is old.candidate else e for e in self.taken]
                path[k] = replace(best, alternatives=old.alternatives)
                changed = True
        return changed

    def _find_best_of_kind(self, own: Candidate) -> Trial | None:
        """Return what of an effect's kind predicts other motion best and surely better, or None."""
        alike = [
            candidate
            for candidate in self.candidates
            if candidate.slot == own.slot
            and candidate.at not in self.impossible
            # What is in the model gives way only to what may be in it, too.
            and (candidate.effect.key in self.applied) >= (own.effect.key in self.applied)
            # Values on a grid are not fitted: their errors on other motion do not compare.
            and not candidate.has_trial_values
        ]
        if own.has_trial_values or len({candidate.at for candidate in alike}) < 2:
            return None
        trials = self._try_with(
            [candidate for candidate in self.taken if candidate is not own], alike
        )
        n = self.n_asked
        robot = self.robot
        now = next(
            (
                trial
                for trial in trials
                if trial.candidate.at == own.at
                and np.array_equal(trial.candidate.places, own.places)
            ),
            None,
        )
        taken = [
            trial
            for trial in trials
            if trial.candidate.at != own.at and trial.is_taken(n, robot, self.held)
        ]
        best = max(taken, key=_predicts, default=None)
        # Without a trial of its own the present form has no gain next to the others.
        return best if now is None else _find_better(taken, now, RULES.certain)

    @property
    def n_asked(self) -> int:
        """Number of effects and joints that are asked for."""
        return len({candidate.at for candidate in self.candidates})

    def refutes_cad(self) -> bool:
        """Return whether bodies are farther from CAD than its prior lets them be.

        The evidence of a Gaussian prior grows with its weight where the distance of the fit is less
        than the number of parameters that the data determine, p - tr((A + P)^-1 P) (MacKay, Neural
        Computation 4, 1992, eq. 4.8).
        """
        inside = self._list_inside(self.taken)
        base = self.robot.base
        # Standard parameters below 10 n_links are of bodies, the rest of drives.
        links = np.flatnonzero(base.columns[inside[inside < base.n_base]] < 10 * base.n_links)
        A, P = self._build_normal(self._total, inside)
        # tr((A + P)^-1 P) counts the parameters that the prior rather than the data determines.
        free = float(np.trace(np.linalg.solve(A, P)[np.ix_(links, links)]))
        distance = float(self._measure_distance(self._fit(inside).start))
        return distance / self.prior.effect > len(links) - free

    def holds(self, candidate: Candidate) -> bool:
        """Return whether an effect is taken with only such others as the model can have, too.

        What is only named is not in the model by which other motion is predicted: on the dVRK MTM a
        tilt was worth its torque with a gain of 1.5 and a zero position, and alone tripled the
        error.
        """
        others = [e for e in self.taken if e is not candidate and e.effect.key in self.applied]
        trials = self._try_with(others, [candidate])
        return any(trial.is_taken(self.n_asked, self.robot, self.held) for trial in trials)

    def _try_with(self, taken: list[Candidate], candidates: Iterable[Candidate]) -> list[Trial]:
        """Try candidates with other effects in place of the ones taken."""
        # Trials are against `taken`: it is set for the call and put back.
        before = self.taken
        self.taken = taken
        trials = self.trials(candidates)
        self.taken = before
        return trials

    def _prefer(self, best: Trial, trials: Sequence[Trial]) -> Trial:
        """Return the best form at its joint, or a look-alike where the model may not have it."""
        best = _find_best_form(best, trials)
        own = [trial for trial in trials if trial.candidate.effect.key in self.applied]
        alike = [trial for trial in own if _is_alike(best, trial)]
        # A named look-alike is preferred as the model can have it, though it is worth less.
        if best in own or not alike:
            return best
        return max(alike, key=lambda each: each.worth)


def _find_best_form(best: Trial, trials: Sequence[Trial]) -> Trial:
    """Return the trial of the same kind and joint that surely predicts other motion better."""
    forms = (trial for trial in trials if trial.candidate.slot == best.candidate.slot)
    return _find_better(forms, best, RULES.form) or best


def _find_better(trials: Iterable[Trial], present: Trial, standard_errors: float) -> Trial | None:
    """Return the trial that predicts other motion best, by so many standard errors better."""
    better = (trial for trial in trials if exceeds(trial.relief - present.relief, standard_errors))
    return max(better, key=_predicts, default=None)


def _predicts(trial: Trial) -> float:
    """Return how much a trial lowers the logarithm of the squared error on other motion."""
    return float(trial.relief.mean())


def _is_alike(taken: Trial, other: Trial, standard_errors: float = 1.0) -> bool:
    """Return whether another effect predicts other motion as well, for half the worth.

    As well: within so many standard errors of the paired differences.
    """
    lag = taken.relief - other.relief
    return not exceeds(lag, standard_errors) and other.worth > RULES.alike * taken.worth


def _add_alternatives(taken: Trial, before: Sequence[Trial], after: Sequence[Trial]) -> Trial:
    """Return a trial with the look-alikes among those that were taken `before` and not `after`.

    Another form at the same joint is one unless it predicts worse by as much as chooses a form.
    """
    # What is sure still is not explained by the effect taken.
    still = {taken.candidate.at, *(trial.candidate.at for trial in after)}
    alike: dict[At, Candidate] = {}
    for trial in before:
        candidate = trial.candidate
        margin = RULES.form if candidate.slot == taken.candidate.slot else 1.0
        if candidate.at not in still and _is_alike(taken, trial, margin):
            alike.setdefault(candidate.at, candidate)
    return replace(taken, alternatives=tuple(alike.values()))


@dataclass(frozen=True, slots=True, eq=False)
class Lacking:
    """Hold effects (m columns) that are not parameters of a model.

    `values` (m,) and `covariance` are from one fit with all that is in the model, `sizes` (m,) what
    they usually are. Effects that are in the model as constants, such as a tilt, have the value 0:
    only their error counts. `names` (P,) name the parameters in the rows, empty where a column
    has none.
    """

    rows: BlockRows
    names: tuple[str, ...]
    columns: Indices
    values: Array
    covariance: Array
    sizes: Array
    text: str

    @classmethod
    def of(
        cls, selection: Selection, out: Sequence[Candidate], removed: Mapping[At, Array]
    ) -> Lacking | None:
        """Return what is not a parameter of the model: effects taken, and those that are unsure.

        And those that any robot may have, such as a tilt too small or too much like something else
        to be taken.

        `removed` are the values of effects that the rows are without.
        """
        candidates = list(out)
        busy = {candidate.slot for candidate in selection.taken}
        # Of a kind at a joint the one with the largest gain comes first, and keeps the others out.
        for trial in sorted(selection.unsure, key=lambda each: -each.gain):
            slot = trial.candidate.slot
            # What replaces a term of the model is no column that is lacking.
            if slot not in busy and not trial.candidate.replaces.size:
                busy.add(slot)
                candidates.append(trial.candidate)
        doubted = [
            selection.acting(candidate)
            for candidate in selection.candidates
            if candidate.effect.usual and candidate.slot not in busy
        ]
        doubted = [candidate for candidate in doubted if candidate.places.size]
        if not (candidates or doubted):
            return None
        parts = [_estimate_values(candidates, selection, removed)] if candidates else []
        parts += [_estimate_doubt(candidate, selection) for candidate in doubted]
        named = [e for e in candidates if not _is_constant(e, selection)]
        of_doubted = parts[len(parts) - len(doubted) :]
        named += [
            candidate
            for candidate, (_, covariance, _) in zip(doubted, of_doubted, strict=True)
            if _is_wide(candidate, covariance)
        ]
        names = _list_names(selection)
        columns = np.concatenate([candidate.places for candidate in (*candidates, *doubted)])
        named_columns = np.flatnonzero([bool(name) for name in names])
        return cls(
            # Of all effects that were tried few are asked again: all take most of the memory.
            selection.rows.among(np.union1d(named_columns, columns)),
            names,
            columns,
            np.concatenate([values for values, _, _ in parts]),
            block_diag(*(covariance for _, covariance, _ in parts)),
            np.concatenate([sizes for _, _, sizes in parts]),
            _word_candidates(named, selection),
        )

    def bias(self, fit: Fit) -> OmittedBias | None:
        """Return the bias of a fit, to first order, of columns that it lacks.

        Least squares without columns C with the values c is off by `(W^T W)^-1 W^T C c` (Frisch and
        Waugh, Econometrica 1, 1933). Values are shrunk by their errors, as effects of their own
        size around zero are. Textbook errors stay.
        """
        if fit.uncertainty.basis.asked == "textbook":
            return None
        # An effect within its error shrinks to zero.
        mean, spread = shrink_effects(self.values, self.covariance, self.sizes)
        constant = np.ix_(self.values == 0.0, self.values == 0.0)
        spread[constant] = self.covariance[constant]  # constants in the model keep their errors
        moves = derive_estimate_moves(fit.information, fit.estimate) @ self._follows(
            fit,
            fit.estimate.weights,
        )
        # The same estimate without CAD, for errors that do not count on it.
        plain = fit_least_squares(fit.information, weights="joint", prior=np.nan_to_num(fit.design))
        free = self._follows(fit, plain.weights)
        bias = moves @ mean
        free_bias = free @ mean
        # What the mean moves is a bias of unknown sign to the user: it widens the error as its
        # square.
        covariance = np.outer(bias, bias) + moves @ spread @ moves.T
        return OmittedBias(
            bias=bias,
            # Rounding leaves the product slightly off symmetry, which later Cholesky factors
            # refuse.
            covariance=0.5 * (covariance + covariance.T),
            free_bias=free_bias,
            free_covariance=np.outer(free_bias, free_bias) + free @ spread @ free.T,
            effects=self.text,
        )

    def _follows(self, fit: Fit, weights: Array) -> Array:
        """Return how weighted least squares moves (p, m) with the values of the columns."""
        place = {name: j for j, name in enumerate(self.names) if name}
        # Parameters of the fit that the rows of the search do not have cannot follow.
        kept = np.array([k for k, name in enumerate(fit.base.names) if name in place])
        places = np.array([place[fit.base.names[k]] for k in kept])
        follows = np.zeros((fit.base.n_base, len(self.columns)))
        # (W^T W)^-1 W^T C, Frisch and Waugh.
        follows[kept] = Scaled(self.rows.inner(weights, places, places)).solve(
            self.rows.inner(weights, places, self.columns)
        )
        return follows


def _estimate_values(
    candidates: Sequence[Candidate], selection: Selection, removed: Mapping[At, Array]
) -> tuple[Array, Array, Array]:
    """Return values of effects, covariance, and the largest scale that each value supports."""
    values, covariance = selection.values_of(candidates)
    ends = np.cumsum([candidate.places.size for candidate in candidates])
    for candidate, part in zip(candidates, np.split(values, ends[:-1]), strict=True):
        if candidate.at in removed:  # a part is a view of the values
            part[:] = 0.0 if _is_constant(candidate, selection) else removed[candidate.at]
    return values, covariance, np.abs(values)


def _estimate_doubt(candidate: Candidate, selection: Selection) -> tuple[Array, Array, Array]:
    """Return what data say of an effect that any robot may have: values, covariance, usual size.

    CAD says nothing of it, since bodies off CAD imitate it. Without data it is within its usual
    size of none.
    """
    usual = np.full(candidate.places.size, candidate.effect.usual)
    if not selection.shows(candidate):
        return np.zeros_like(usual), np.diag(usual**2), usual
    values, covariance = selection.values_by_data([candidate])
    return values, covariance, usual


def _is_wide(candidate: Candidate, covariance: Array) -> bool:
    """Return whether an effect may be larger than matters, for all that the data say."""
    return bool(np.max(np.diag(covariance)) > candidate.effect.least**2)


def _is_constant(candidate: Candidate, selection: Selection) -> bool:
    return candidate.effect.removable and candidate.effect.key in selection.applied


def _list_names(selection: Selection) -> tuple[str, ...]:
    """Return the names of the model's parameters in the rows, and of terms added to it."""
    names = [*selection.robot.base.names, *[""] * selection.rows.groups[EFFECT_COLUMNS]]
    for candidate in selection.taken:
        if (
            candidate.term is None
            or candidate.joint is None
            or candidate.effect.key not in selection.applied
        ):
            continue
        symbols = [
            s
            for s, act in zip(
                candidate.term.symbols, candidate.term.at(candidate.joint).functions(), strict=True
            )
            # Parameters that do not act have no place.
            if act
        ]
        for symbol, place in zip(symbols, candidate.places, strict=False):
            names[place] = f"{symbol}{candidate.joint + 1}"
    return tuple(names)


def _word_candidates(candidates: Sequence[Candidate], selection: Selection) -> str:
    names = selection.robot.model.joint_names
    joints: dict[str, list[str]] = {}
    for candidate in candidates:
        located = joints.setdefault(candidate.effect.title, [])
        located += [] if candidate.joint is None else [names[candidate.joint]]
    return join_names(
        [f"{what} at {join_names(at, 4)}" if at else what for what, at in joints.items()]
    )
