"""Selection of effects: sure, worth their torque on other motion, and nearer to CAD."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace

import numpy as np

from asbuilt.arrays import Array, Indices
from asbuilt.identification.effects.gathering import At, Candidate, EffectEquations
from asbuilt.identification.effects.trials import RULES, Prior, Trial, Trials
from asbuilt.identification.statistics import exceeds


class Selection(Trials):
    """Choose effects one at a time, by trials."""

    def __init__(
        self,
        equations: EffectEquations,
        prior: Prior,
        weights: Array,
        groups: Sequence[Indices],
        applied: Collection[str],
    ) -> None:
        """Take what `Trials` takes, and the keys of effects that may become part of the model."""
        super().__init__(equations, prior, weights, groups)
        self.held = equations.robot.model.has_masses
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
        path, before, swapped = list[Trial](), list[Trial](), False
        self.given_up.clear()
        while True:
            busy = {slot for each in self.taken for slot in each.busy}
            left = [
                each
                for each in self.equations.candidates
                if each.slot not in busy
                and each.at not in self.impossible
                and each.at not in self.given_up
                and (not each.effect.of_log or self._is_shown(each))
            ]
            n, robot = len({each.at for each in left}), self.equations.robot
            sure = [each for each in self.trials(left) if each.is_sure(n, robot)]
            trials = [each for each in sure if each.is_taken(n, robot, self.held)]
            if path:
                path[-1] = _add_alternatives(path[-1], before, trials)
            if trials and len(path) < RULES.most:
                best = self._prefer(max(trials, key=lambda each: each.worth), trials)
                path.append(best)
                self.taken.append(best.candidate)
                before = trials
            elif not swapped and self._swap_forms(path):
                swapped = True
            elif weak := self._find_weakest(path):
                # What is given up may not come back, or the path would never end.
                self.given_up.add(weak.candidate.at)
                path.remove(weak)
                self.taken = [each for each in self.taken if each is not weak.candidate]
            else:
                self.unsure = sure
                return path

    def _find_weakest(self, path: Sequence[Trial]) -> Trial | None:
        """Return the least sure effect of the path that is not sure next to all others, or None.

        In a model an effect needs two standard errors, the direction that the whole log has in each
        half of it, and less error on left-out motion than without it.
        """
        weak = [
            (sureness, k)
            for k, each in enumerate(path)
            if each.candidate.effect.key in self.applied
            for sureness in (self._measure_sureness(each.candidate),)
            if sureness < RULES.two_errors or not self._is_in_halves(each.candidate)
        ]
        if weak:
            return path[min(weak)[1]]
        error = self.held_out_error(self.taken)
        for each in path:
            others = [own for own in self.taken if own is not each.candidate]
            if each.candidate.effect.key in self.applied and self.held_out_error(others) < error:
                return each
        return None

    def _measure_sureness(self, candidate: Candidate) -> float:
        """Return how many standard errors an effect is from none, next to all others.

        That a term in place of another one is zero is no question.
        """
        if candidate.replaces.size:
            return np.inf
        values, covariance = self.values_of([candidate])
        square = float(values @ np.linalg.pinv(covariance, hermitian=True) @ values)
        return float(np.sqrt(square / len(values)))

    def _is_in_halves(self, candidate: Candidate) -> bool:
        """Return whether each half of the log has an effect in the direction of the whole."""
        if candidate.replaces.size:
            return True
        whole = self.values_of([candidate])[0]
        scale = self._size[candidate.places]
        return all(
            float((half * scale) @ (whole * scale)) > 0.0
            for half in self.values_in_halves(candidate)
        )

    def _swap_forms(self, path: list[Trial]) -> bool:
        """Give effects of the path up for others of their kind that predict other motion better.

        What was worthiest when it was taken need not be so after what came later (Miller, Subset
        Selection in Regression, 2002, section 3.4). Returns whether any was.
        """
        changed = False
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
            each
            for each in self.equations.candidates
            if each.slot == own.slot
            and each.at not in self.impossible
            and (each.effect.key in self.applied) >= (own.effect.key in self.applied)
            and not each.has_trial_values
        ]
        if own.has_trial_values or len({each.at for each in alike}) < 2:
            return None
        trials = self._try_with([each for each in self.taken if each is not own], alike)
        n, robot = self.n_asked, self.equations.robot
        now = next(
            (
                each
                for each in trials
                if each.candidate.at == own.at and np.array_equal(each.candidate.places, own.places)
            ),
            None,
        )
        taken = [
            each
            for each in trials
            if each.candidate.at != own.at and each.is_taken(n, robot, self.held)
        ]
        best = max(taken, key=_predicts, default=None)
        return best if now is None else _find_better(taken, now, RULES.certain)

    @property
    def n_asked(self) -> int:
        """Number of effects and joints that are asked for."""
        return len({each.at for each in self.equations.candidates})

    def refutes_cad(self) -> bool:
        """Return whether bodies are farther from CAD than its prior lets them be.

        The evidence of a Gaussian prior grows with its weight where the distance of the fit is less
        than the number of parameters that the data determine, p - tr((A + P)^-1 P) (MacKay, Neural
        Computation 4, 1992, eq. 4.8).
        """
        inside, base = self._list_inside(self.taken), self.equations.base
        links = np.flatnonzero(base.columns[inside[inside < base.n_base]] < 10 * base.n_links)
        A, P = self._build_normal(self._total, inside)
        free = float(np.trace(np.linalg.solve(A, P)[np.ix_(links, links)]))
        distance = self._measure_distance(self._fit(self._total, inside).residual)
        return distance / self.prior.effect > len(links) - free

    def holds(self, candidate: Candidate) -> bool:
        """Return whether an effect is taken with only such others as the model can have, too.

        What is only named is not in the model by which other motion is predicted: on the dVRK MTM a
        tilt was worth its torque with a gain of 1.5 and a zero position, and alone tripled the
        error.
        """
        others = [e for e in self.taken if e is not candidate and e.effect.key in self.applied]
        trials = self._try_with(others, [candidate])
        return any(each.is_taken(self.n_asked, self.equations.robot, self.held) for each in trials)

    def _try_with(self, taken: list[Candidate], candidates: Iterable[Candidate]) -> list[Trial]:
        """Try candidates with other effects in place of the ones taken."""
        own, self.taken = self.taken, taken
        trials = self.trials(candidates)
        self.taken = own
        return trials

    def _prefer(self, best: Trial, trials: Sequence[Trial]) -> Trial:
        """Return the best form at its joint, or a look-alike where the model may not have it."""
        best = _find_best_form(best, trials)
        own = [each for each in trials if each.candidate.effect.key in self.applied]
        alike = [each for each in own if _is_alike(best, each)]
        if best in own or not alike:
            return best
        return max(alike, key=lambda each: each.worth)


def _find_best_form(best: Trial, trials: Sequence[Trial]) -> Trial:
    """Return the trial of the same kind and joint that surely predicts other motion better."""
    forms = (each for each in trials if each.candidate.slot == best.candidate.slot)
    return _find_better(forms, best, RULES.form) or best


def _find_better(trials: Iterable[Trial], present: Trial, standard_errors: float) -> Trial | None:
    """Return the trial that predicts other motion best, by so many standard errors better."""
    better = (each for each in trials if exceeds(each.relief - present.relief, standard_errors))
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
    still = {taken.candidate.at, *(each.candidate.at for each in after)}
    found: dict[At, Candidate] = {}
    for each in before:
        own = each.candidate
        margin = RULES.form if own.slot == taken.candidate.slot else 1.0
        if own.at not in still and _is_alike(taken, each, margin):
            found.setdefault(own.at, own)
    return replace(taken, alternatives=tuple(found.values()))
