"""Standard errors of fitted nonlinear parameters, and what they add to errors of linear ones."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics import BaseParameters, DriveSet, drive_torque, inverse_dynamics
from asbuilt.dynamics.kernels.blas import use_one_blas_thread
from asbuilt.dynamics.regressor import RegressorPlan
from asbuilt.experiment.signal.samples import Samples
from asbuilt.identification.information.estimate import Estimate
from asbuilt.identification.information.rows import divide_into_blocks
from asbuilt.identification.result.torque_prediction import expand_parameters
from asbuilt.identification.uncertainty.uncertainty import FEWEST_BLOCKS
from asbuilt.scaled import Scaled
from asbuilt.tables import round_with_error

STEP = 1e-3
"""Relative step of a nonlinear parameter for the derivative of the torque."""


@dataclass(frozen=True, slots=True)
class NonlinearPlace:
    """A nonlinear parameter at a joint (counted from 0), such as the velocity of stribeck."""

    term: str
    parameter: str
    joint: int


@dataclass(frozen=True, slots=True, eq=False)
class NonlinearErrors:
    """Hold values and standard errors (m,) of fitted nonlinear parameters, NaN if undetermined.

    `covariance` (p, p) is what they add to the covariance of the linear parameters.
    """

    places: tuple[NonlinearPlace, ...]
    values: Array
    std_errors: Array
    covariance: Array

    def sentence(self, joint_names: Sequence[str]) -> str:
        """Return a note with value and standard error of each nonlinear parameter."""
        parts: dict[str, list[str]] = {}
        for place, value, error in zip(self.places, self.values, self.std_errors, strict=True):
            shown = (
                " +- ".join(round_with_error(value, error))
                if np.isfinite(error)
                else f"{value:.3g} (undetermined)"
            )
            parts.setdefault(f"{place.parameter} of {place.term}", []).append(
                f"{joint_names[place.joint]} {shown}"
            )
        listed = "; ".join(f"{what} {', '.join(values)}" for what, values in parts.items())
        return f"Standard errors include errors of the fitted nonlinear parameters: {listed}."


@use_one_blas_thread()
def estimate_nonlinear_errors(
    model: RobotModel,
    base: BaseParameters,
    estimate: Estimate,
    samples: Sequence[Samples],
    places: Sequence[NonlinearPlace],
    *,
    textbook: bool = False,
    block_seconds: float | None = None,
) -> NonlinearErrors:
    """Return the errors of nonlinear parameters fitted with an estimate, to first order.

    With `C` the change of the weighted torque per parameter, `W` the weighted columns and `C' = C -
    W (W^T W)^-1 W^T C`, their covariance is `V = (C'^T C')^-1`, each error at least that from time
    blocks (`sum_b (C'^T e)_b^2`) unless `textbook`. The estimate follows by `G = -(W^T W)^-1 W^T
    C`, so its covariance grows by `G V G^T`, as in the fit with columns `[W C]` (Frisch and
    Waugh, Econometrica 1, 1933). Load-dependent terms have the load of `model`.
    """
    names = [(place.term, place.parameter) for place in places]
    nonlinear = list(dict.fromkeys(names))
    changes = _derive_changes(model, base, estimate.beta, nonlinear)
    first = [nonlinear.index(name) for name in names]
    plan = RegressorPlan.of(model, base.drive, base.columns, spare_rows=1 + len(nonlinear))
    root = estimate.solution.inverse_root
    m = len(places)
    r = root.shape[1]
    at = [[i for i, place in enumerate(places) if place.joint == k] for k in range(model.n_joints)]
    blocks = []
    for part in divide_into_blocks(model, samples, block_seconds):
        gram = np.zeros((r + m + 1, r + m + 1))
        for chunk in part.chunks(plan, partial(changes, part.samples)):
            for k, rows in enumerate(chunk):
                p_k = len(plan.support[k])
                error = rows[-1] - estimate.beta[plan.support[k]] @ rows[:p_k]
                seen = np.vstack(
                    [
                        root[plan.support[k]].T @ rows[:p_k],
                        # Only the parameters of this joint have a column here.
                        *(rows[None, p_k + first[i]] for i in at[k]),
                        error,
                    ]
                )
                where = np.ix_(*[[*range(r), *(r + i for i in at[k]), r + m]] * 2)
                gram[where] += estimate.weights[k] ** 2 * (seen @ seen.T)
        blocks.append(gram)
    together = np.sum(blocks, axis=0)
    known = together[:r, :r]
    across = together[:r, r : r + m]
    alone = together[r : r + m, r : r + m]
    moved = Scaled(known).solve(across)
    left = alone - moved.T @ across
    # Squared part of that derivative outside all linear columns below which it is undetermined.
    determined = np.flatnonzero(np.diag(left) > 1e-9 * np.diag(alone)).tolist()
    terms = {term.key: term for term in base.drive.terms}
    values = np.array([terms[p.term].at(p.joint).value(p.parameter) for p in places])
    errors = np.full(m, np.nan)
    if not determined:
        return NonlinearErrors(tuple(places), values, errors, np.zeros((base.n_base, base.n_base)))
    inverse = np.linalg.inv(left[np.ix_(determined, determined)])
    # Residual variance of the joint in the weighted rows: 1 where weights are 1 / sigma.
    noise = np.array(
        [estimate.sigma[places[i].joint] * estimate.weights[places[i].joint] for i in determined]
    )
    V = inverse * np.outer(noise, noise)
    if not textbook and len(blocks) >= FEWEST_BLOCKS:
        # Scores about the columns projected off the linear ones, as the residual is orthogonal to
        # both.
        own_rows = [r + i for i in determined]
        scores = np.array(
            [gram[own_rows, -1] - moved[:, determined].T @ gram[:r, -1] for gram in blocks]
        )
        clustered = np.sum((scores @ inverse) ** 2, axis=0) * len(blocks) / (len(blocks) - 1)
        swell = np.sqrt(np.maximum(clustered / np.diag(V), 1.0))
        V = V * np.outer(swell, swell)
    errors[determined] = np.sqrt(np.diag(V))
    follows = root @ moved[:, determined]
    return NonlinearErrors(tuple(places), values, errors, np.asarray(follows @ V @ follows.T))


def _derive_changes(
    model: RobotModel, base: BaseParameters, beta: Array, nonlinear: Sequence[tuple[str, str]]
) -> Callable[[Samples, slice], list[Array]]:
    """Return a function that gives the derivatives of every joint's torque on a span of samples.

    They are by each nonlinear parameter, (L, n) each.
    """
    n = model.n_joints
    values = expand_parameters(base, beta)[10 * base.n_links :].reshape(n, -1)
    of_terms = np.split(values, np.cumsum([len(term.symbols) for term in base.drive.terms]), axis=1)
    terms = {term.key: term for term in base.drive.terms}
    linear = dict(zip(terms, of_terms, strict=False))
    moved = []
    for key, name in nonlinear:
        term = terms[key]
        at = np.array([term.at(k).value(name) for k in range(n)])
        # Relative steps, as a velocity or a width has no other scale.
        sides = [
            DriveSet((term.with_nonlinear({name: tuple((at * (1.0 + step)).tolist())}),))
            for step in (STEP, -STEP)
        ]
        moved.append((sides, linear[key].ravel(), 2.0 * STEP * at))

    def changes(samples: Samples, span: slice) -> list[Array]:
        state = samples.q[span], samples.qd[span], samples.qdd[span]
        load = inverse_dynamics(model, *state) if base.drive.needs_load else None
        return [
            (
                drive_torque(ahead, theta, *state, load=load)
                - drive_torque(behind, theta, *state, load=load)
            )
            / step
            for (ahead, behind), theta, step in moved
        ]

    return changes
