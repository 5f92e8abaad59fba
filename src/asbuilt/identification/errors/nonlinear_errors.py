"""Standard errors of fitted nonlinear parameters, and what they add to those of linear ones."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import BaseParameters
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.dynamics.drives.torque import drive_torque
from asbuilt.dynamics.kernels.blas import use_one_blas_thread
from asbuilt.dynamics.newton_euler import inverse_dynamics
from asbuilt.dynamics.regressor import RegressorPlan
from asbuilt.experiment.signal.samples import Samples
from asbuilt.identification.errors.uncertainty import FEWEST_BLOCKS
from asbuilt.identification.information.estimate import Estimate
from asbuilt.identification.information.rows import divide_into_blocks
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

    `covariance` (p, p) is what they add to that of the linear parameters.
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
        listed = "; ".join(f"{what} {', '.join(each)}" for what, each in parts.items())
        return f"Standard errors include those of the fitted nonlinear parameters: {listed}."


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
    C`, so its covariance grows by `G V G^T`: that of the fit with columns `[W C]` (Frisch and
    Waugh, Econometrica 1, 1933). The load of load-dependent terms is that of `model`.
    """
    nonlinear = {(place.term, place.parameter): None for place in places}
    changes, first = (
        _Changes(model, base, estimate.beta, list(nonlinear)),
        [list(nonlinear).index((place.term, place.parameter)) for place in places],
    )
    plan = RegressorPlan.of(model, base.drive, base.columns, spare_rows=1 + len(nonlinear))
    root, m = estimate.solution.inverse_root, len(places)
    r = root.shape[1]
    at = [[i for i, place in enumerate(places) if place.joint == k] for k in range(model.n_joints)]
    blocks = []
    with use_one_blas_thread():
        for part in divide_into_blocks(model, samples, block_seconds):
            gram = np.zeros((r + m + 1, r + m + 1))
            for chunk in part.chunks(plan, changes.of(part.samples)):
                for k, rows in enumerate(chunk):
                    p_k = len(plan.support[k])
                    error = rows[-1] - estimate.beta[plan.support[k]] @ rows[:p_k]
                    seen = np.vstack(
                        [
                            root[plan.support[k]].T @ rows[:p_k],
                            *(rows[None, p_k + first[i]] for i in at[k]),
                            error,
                        ]
                    )
                    where = np.ix_(*[[*range(r), *(r + i for i in at[k]), r + m]] * 2)
                    gram[where] += estimate.weights[k] ** 2 * (seen @ seen.T)
            blocks.append(gram)
    together = np.sum(blocks, axis=0)
    known, across = together[:r, :r], together[:r, r : r + m]
    own, moved = together[r : r + m, r : r + m], np.linalg.pinv(known, hermitian=True) @ across
    left = own - moved.T @ across
    # Squared part of that derivative outside all linear columns below which it is undetermined.
    determined = np.flatnonzero(np.diag(left) > 1e-9 * np.diag(own)).tolist()
    values = np.array([_read_value(base.drive, place) for place in places])
    errors = np.full(m, np.nan)
    if not determined:
        return NonlinearErrors(tuple(places), values, errors, np.zeros((base.n_base, base.n_base)))
    inverse = np.linalg.inv(left[np.ix_(determined, determined)])
    noise = np.array(
        [estimate.sigma[places[i].joint] * estimate.weights[places[i].joint] for i in determined]
    )
    V = inverse * np.outer(noise, noise)
    if not textbook and len(blocks) >= FEWEST_BLOCKS:
        scores = np.array(
            [
                gram[[r + i for i in determined], -1] - moved[:, determined].T @ gram[:r, -1]
                for gram in blocks
            ]
        )
        clustered = np.sum((scores @ inverse) ** 2, axis=0) * len(blocks) / (len(blocks) - 1)
        swell = np.sqrt(np.maximum(clustered / np.diag(V), 1.0))
        V = V * np.outer(swell, swell)
    errors[determined] = np.sqrt(np.diag(V))
    follows = root @ moved[:, determined]
    return NonlinearErrors(tuple(places), values, errors, np.asarray(follows @ V @ follows.T))


def _read_value(drive: DriveSet, place: NonlinearPlace) -> float:
    return (
        next(term for term in drive.terms if term.key == place.term)
        .at(place.joint)
        .value(place.parameter)
    )


class _Changes:
    """Hold the derivative of every joint's torque by each nonlinear parameter."""

    def __init__(
        self,
        model: RobotModel,
        base: BaseParameters,
        beta: Array,
        nonlinear: Sequence[tuple[str, str]],
    ) -> None:
        n_joints = model.n_joints
        self._loading = model if base.drive.needs_load else None
        chi = np.zeros(base.n_standard)
        chi[base.columns] = beta
        values = chi[10 * base.n_links :].reshape(n_joints, -1)
        self._moved = []
        first = 0
        places = {}
        for term in base.drive.terms:
            places[term.key] = values[:, first : first + len(term.symbols)].ravel()
            first += len(term.symbols)
        for key, name in nonlinear:
            term = next(term for term in base.drive.terms if term.key == key)
            at = np.array([term.at(k).value(name) for k in range(n_joints)])
            sides = [
                DriveSet((term.with_nonlinear({name: tuple((at * (1.0 + step)).tolist())}),))
                for step in (STEP, -STEP)
            ]
            self._moved.append((sides, places[key], 2.0 * STEP * at))

    def of(self, samples: Samples) -> Callable[[slice], list[Array]]:
        """Return what gives the changes, each (L, n), on a span of samples."""

        def on(span: slice) -> list[Array]:
            state = samples.q[span], samples.qd[span], samples.qdd[span]
            load = None if self._loading is None else inverse_dynamics(self._loading, *state)

            def torque(side: DriveSet, values: Array) -> Array:
                return drive_torque(side, values, *state, load=load)

            return [
                (torque(ahead, values) - torque(behind, values)) / step
                for (ahead, behind), values, step in self._moved
            ]

        return on
