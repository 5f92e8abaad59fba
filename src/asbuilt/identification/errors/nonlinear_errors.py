"""What fitted shapes leave open.

How well a recording tells a Stribeck velocity or an exponent, and what that adds to the errors of
everything linear.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import BaseParameters
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.dynamics.drives.torque import drive_torque
from asbuilt.dynamics.kernels.blas import one_blas_thread
from asbuilt.dynamics.regressor import RegressorPlan
from asbuilt.identification.errors.uncertainty import FEWEST_BLOCKS
from asbuilt.identification.estimators.least_squares import Estimate
from asbuilt.identification.information.rows import stretches
from asbuilt.tables import rounded

if TYPE_CHECKING:
    from asbuilt.experiment.signal.samples import Samples


STEP = 1e-3
"""Part of a shape's value by which it is moved to see what that does to the torque."""
ALONE = 1e-9
"""What is left of that beside all linear columns, relative to its size (squared), below which the
shape is not told.
"""


@dataclass(frozen=True, slots=True)
class ShapePlace:
    """A shape at a joint (counted from 0), such as the velocity of stribeck."""

    term: str
    shape: str
    joint: int


@dataclass(frozen=True, slots=True, eq=False)
class ShapeErrors:
    """Hold the values and standard errors (m,) of fitted shapes, and what these add to the
    covariance (p, p) of the linear parameters; NaN where a shape is not told.
    """

    places: tuple[ShapePlace, ...]
    values: Array
    std_errors: Array
    covariance: Array

    def sentence(self, joint_names: Sequence[str]) -> str:
        """Say how well each shape is told."""
        parts: dict[str, list[str]] = {}
        for place, value, error in zip(self.places, self.values, self.std_errors, strict=True):
            shown = (
                " +- ".join(rounded(value, error))
                if np.isfinite(error)
                else f"{value:.3g} (not told)"
            )
            parts.setdefault(f"{place.shape} of {place.term}", []).append(
                f"{joint_names[place.joint]} {shown}"
            )
        listed = "; ".join(f"{what} {', '.join(each)}" for what, each in parts.items())
        return f"Standard errors count what the shapes, fitted along, leave open: {listed}."


def shape_errors(
    model: RobotModel,
    base: BaseParameters,
    estimate: Estimate,
    samples: Sequence[Samples],
    places: Sequence[ShapePlace],
    *,
    textbook: bool = False,
    block_seconds: float | None = None,
) -> ShapeErrors:
    """Judge shapes that were fitted along with an estimate, to first order.

    With `C` the change of the weighted torque per shape, `W` the weighted columns and `C' = C - W
    (W^T W)^-1 W^T C`, shapes have the covariance `V = (C'^T C')^-1`, each error grown to what time
    blocks say (`sum_b (C'^T e)_b^2`), unless those of a `textbook` are asked for. The estimate
    follows a shape by `G = -(W^T W)^-1 W^T C`, so its covariance grows by `G V G^T`: that of the
    fit with columns `[W C]` (Frisch and Waugh, Econometrica 1, 1933).
    """
    shaped = {(place.term, place.shape): None for place in places}
    changes, first = (
        _Changes(base, estimate.beta, list(shaped), model.n_joints),
        [list(shaped).index((place.term, place.shape)) for place in places],
    )
    plan = RegressorPlan.of(model, base.drive, base.columns, spare_rows=1 + len(shaped))
    root, m = estimate.solution.inverse_root, len(places)
    r = root.shape[1]
    at = [[i for i, place in enumerate(places) if place.joint == k] for k in range(model.n_joints)]
    blocks = []
    with one_blas_thread():
        for stretch in stretches(model, samples, block_seconds):
            gram = np.zeros((r + m + 1, r + m + 1))
            for piece in stretch.pieces(plan, changes.of(stretch.samples)):
                for k, rows in enumerate(piece):
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
    told = np.flatnonzero(np.diag(left) > ALONE * np.diag(own)).tolist()
    values = np.array([_value(base.drive, place) for place in places])
    errors = np.full(m, np.nan)
    if not told:
        return ShapeErrors(tuple(places), values, errors, np.zeros((base.n_base, base.n_base)))
    inverse = np.linalg.inv(left[np.ix_(told, told)])
    noise = np.array(
        [estimate.sigma[places[i].joint] * estimate.weights[places[i].joint] for i in told]
    )
    V = inverse * np.outer(noise, noise)
    if not textbook and len(blocks) >= FEWEST_BLOCKS:
        scores = np.array(
            [gram[[r + i for i in told], -1] - moved[:, told].T @ gram[:r, -1] for gram in blocks]
        )
        clustered = np.sum((scores @ inverse) ** 2, axis=0) * len(blocks) / (len(blocks) - 1)
        swell = np.sqrt(np.maximum(clustered / np.diag(V), 1.0))
        V = V * np.outer(swell, swell)
    errors[told] = np.sqrt(np.diag(V))
    follows = root @ moved[:, told]
    return ShapeErrors(tuple(places), values, errors, np.asarray(follows @ V @ follows.T))


def _value(drive: DriveSet, place: ShapePlace) -> float:
    return (
        next(term for term in drive.terms if term.key == place.term)
        .at(place.joint)
        .value(place.shape)
    )


class _Changes:
    """What moving each shape by one unit does to the torque of every joint, to first order."""

    def __init__(
        self, base: BaseParameters, beta: Array, shaped: Sequence[tuple[str, str]], n_joints: int
    ) -> None:
        chi = np.zeros(base.n_standard)
        chi[base.columns] = beta
        values = chi[10 * n_joints :].reshape(n_joints, -1)
        self._moved = []
        first = 0
        places = {}
        for term in base.drive.terms:
            places[term.key] = values[:, first : first + len(term.letters)].ravel()
            first += len(term.letters)
        for key, name in shaped:
            term = next(term for term in base.drive.terms if term.key == key)
            at = np.array([term.at(k).value(name) for k in range(n_joints)])
            sides = [
                DriveSet((term.with_shapes({name: tuple((at * (1.0 + step)).tolist())}),))
                for step in (STEP, -STEP)
            ]
            self._moved.append((sides, places[key], 2.0 * STEP * at))

    def of(self, samples: Samples) -> Callable[[slice], list[Array]]:
        """Return what gives the changes, each (L, n), on a span of samples."""

        def on(span: slice) -> list[Array]:
            state = samples.q[span], samples.qd[span], samples.qdd[span]
            return [
                (drive_torque(ahead, values, *state) - drive_torque(behind, values, *state)) / step
                for (ahead, behind), values, step in self._moved
            ]

        return on
