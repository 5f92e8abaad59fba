"""What a model lacks although a recording shows it, and the bias that this brings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from asbuilt.arrays import Array, Indices
from asbuilt.findings import join_names
from asbuilt.identification.effects.gathering import At, Candidate, EffectEquations
from asbuilt.identification.effects.selection import Selection
from asbuilt.identification.errors.bias import OmittedBias, derive_estimate_moves, shrink_effects
from asbuilt.identification.estimators.least_squares import fit_least_squares
from asbuilt.scaled import Scaled

if TYPE_CHECKING:
    from asbuilt.identification.identify import Fit


@dataclass(frozen=True, slots=True, eq=False)
class Lacking:
    """Hold effects (m columns) that are not parameters of a model.

    `values` (m,) and `covariance` are from one fit with all that is in the model. Effects that are
    in the model as constants, such as a tilt, have the value 0: only their error counts. `names`
    (P,) name the parameters in the equations, empty where a column has none.
    """

    equations: EffectEquations
    names: tuple[str, ...]
    columns: Indices
    values: Array
    covariance: Array
    text: str

    @classmethod
    def of(
        cls, selection: Selection, out: Sequence[Candidate], removed: Mapping[At, Array]
    ) -> Lacking | None:
        """Return what is not a parameter of the model: effects taken, and those that are unsure.

        `removed` are the values of effects that the equations are without.
        """
        own = list(out)
        busy = {each.slot for each in selection.taken}
        for trial in sorted(selection.unsure, key=lambda each: -each.gain):
            slot = trial.candidate.slot
            if slot not in busy and not trial.candidate.replaces.size:
                busy.add(slot)
                own.append(trial.candidate)
        if not own:
            return None
        values, covariance = selection.values_of(own)
        ends = np.cumsum([each.places.size for each in own])
        for each, part in zip(own, np.split(values, ends[:-1]), strict=True):
            if each.at in removed:  # a part is a view of the values
                part[:] = 0.0 if _is_constant(each, selection) else removed[each.at]
        text = _word_candidates([e for e in own if not _is_constant(e, selection)], selection)
        return cls(
            selection.equations,
            _list_names(selection),
            np.concatenate([each.places for each in own]),
            values,
            covariance,
            text,
        )

    def bias(self, fit: Fit) -> OmittedBias | None:
        """Return the bias of a fit, to first order, of columns that it lacks.

        Least squares without columns C with the values c is off by `(W^T W)^-1 W^T C c` (Frisch and
        Waugh, Econometrica 1, 1933). Values are shrunk by their errors, as effects of their own
        size around zero are. Textbook errors stay.
        """
        if fit.uncertainty.basis.asked == "textbook":
            return None
        mean, spread = shrink_effects(self.values, self.covariance, np.abs(self.values))
        constant = np.ix_(self.values == 0.0, self.values == 0.0)
        spread[constant] = self.covariance[constant]  # constants in the model keep their errors
        own = derive_estimate_moves(fit.information, fit.estimate) @ self._follows(
            fit, fit.estimate.weights
        )
        plain = fit_least_squares(fit.information, weights="joint", prior=np.nan_to_num(fit.design))
        free = self._follows(fit, plain.weights)
        bias, free_bias = own @ mean, free @ mean
        covariance = np.outer(bias, bias) + own @ spread @ own.T
        return OmittedBias(
            bias=bias,
            covariance=0.5 * (covariance + covariance.T),
            free_bias=free_bias,
            free_covariance=np.outer(free_bias, free_bias) + free @ spread @ free.T,
            effects=self.text,
        )

    def _follows(self, fit: Fit, weights: Array) -> Array:
        """Return how weighted least squares moves (p, m) with the values of the columns."""
        place = {name: j for j, name in enumerate(self.names) if name}
        kept = np.array([k for k, name in enumerate(fit.base.names) if name in place])
        own = np.array([place[fit.base.names[k]] for k in kept])
        gram = self.equations.stacked(weights)[:-1, :-1]
        follows = np.zeros((fit.base.n_base, len(self.columns)))
        follows[kept] = Scaled(gram[np.ix_(own, own)]).solve(gram[np.ix_(own, self.columns)])
        return follows


def _is_constant(candidate: Candidate, selection: Selection) -> bool:
    return candidate.effect.removable and candidate.effect.key in selection.applied


def _list_names(selection: Selection) -> tuple[str, ...]:
    """Return the names of the model's parameters in the equations, and of terms added to it."""
    equations = selection.equations
    names = [*equations.base.names, *[""] * (equations.n_parameters - equations.n_base)]
    for each in selection.taken:
        if each.term is None or each.joint is None or each.effect.key not in selection.applied:
            continue
        symbols = [
            s
            for s, act in zip(each.term.symbols, each.term.at(each.joint).functions(), strict=True)
            if act
        ]
        for symbol, place in zip(symbols, each.places, strict=False):
            names[place] = f"{symbol}{each.joint + 1}"
    return tuple(names)


def _word_candidates(candidates: Sequence[Candidate], selection: Selection) -> str:
    names = selection.equations.robot.model.joint_names
    joints: dict[str, list[str]] = {}
    for each in candidates:
        own = joints.setdefault(each.effect.title, [])
        own += [] if each.joint is None else [names[each.joint]]
    return join_names(
        [f"{what} at {join_names(at, 4)}" if at else what for what, at in joints.items()]
    )
