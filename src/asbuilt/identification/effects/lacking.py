"""What a model lacks although a recording shows it, and the bias that this brings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import block_diag

from asbuilt.arrays import Array, Indices
from asbuilt.findings import join_names
from asbuilt.identification.effects.gathering import EFFECTS, At, Candidate
from asbuilt.identification.effects.selection import Selection
from asbuilt.identification.estimators.least_squares import fit_least_squares
from asbuilt.identification.information.equations import Equations
from asbuilt.identification.uncertainty.bias import (
    OmittedBias,
    derive_estimate_moves,
    shrink_effects,
)
from asbuilt.scaled import Scaled

if TYPE_CHECKING:
    from asbuilt.identification.identify import Fit


@dataclass(frozen=True, slots=True, eq=False)
class Lacking:
    """Hold effects (m columns) that are not parameters of a model.

    `values` (m,) and `covariance` are from one fit with all that is in the model, `sizes` (m,) what
    they usually are. Effects that are in the model as constants, such as a tilt, have the value 0:
    only their error counts. `names` (P,) name the parameters in the equations, empty where a column
    has none.
    """

    equations: Equations
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

        `removed` are the values of effects that the equations are without.
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
        return cls(
            selection.equations,
            _list_names(selection),
            np.concatenate([candidate.places for candidate in (*candidates, *doubted)]),
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
            # The same estimate without CAD, for errors that do not count on it.
        )
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
        # Parameters of the fit that the equations of the search do not have cannot follow.
        kept = np.array([k for k, name in enumerate(fit.base.names) if name in place])
        places = np.array([place[fit.base.names[k]] for k in kept])
        gram = self.equations.stacked(weights)[:-1, :-1]
        follows = np.zeros((fit.base.n_base, len(self.columns)))
        # (W^T W)^-1 W^T C, Frisch and Waugh.
        follows[kept] = Scaled(gram[np.ix_(places, places)]).solve(
            gram[np.ix_(places, self.columns)]
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
    """Return the names of the model's parameters in the equations, and of terms added to it."""
    names = [*selection.robot.base.names, *[""] * selection.equations.groups[EFFECTS]]
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
