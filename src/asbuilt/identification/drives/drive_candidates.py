"""Candidate drive terms with trial values of nonlinear parameters, as columns of a regressor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from asbuilt.arrays import Array, Indices
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import BaseParameters
from asbuilt.dynamics.drives.selection import DriveSet, available_terms
from asbuilt.dynamics.drives.term import DriveTerm, NonlinearParameter
from asbuilt.dynamics.regressor import RegressorPlan
from asbuilt.identification.drives.nonlinear_parameters import credible_range, thinned

if TYPE_CHECKING:
    from asbuilt.experiment.signal.samples import Samples

Placed = tuple[int, int]
"""A joint (from 0) and the index of its candidate."""
Choice = tuple[Placed, ...]

POINTS = 8
"""Trial values of a nonlinear parameter, ends of the credible range included."""
RIDGE = 1e-9
"""Added to the diagonal of normal equations of unit columns, against collinear columns."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """A term with its nonlinear parameter per joint, `at_bound` at an end of its range."""

    term: DriveTerm
    at_bound: bool

    @property
    def key(self) -> str:
        """Key of the term."""
        return self.term.key


def candidates(
    model: RobotModel, start: DriveSet, source: str, samples: Sequence[Samples]
) -> tuple[Candidate, ...]:
    """Return the candidates beside `start` for torques of this source."""
    found = []
    speeds = [np.abs(each.qd) for each in samples]
    for term in available_terms().values():
        if source not in term.tried_for or term.key in start.keys:
            continue
        if not term.free_nonlinear:
            found.append(Candidate(term, False))
        for parameter in term.free_nonlinear:
            for j, values in enumerate(_spread(model, parameter, speeds)):
                found.append(
                    Candidate(
                        term.with_nonlinear({parameter.name: tuple(values.tolist())}),
                        j in (0, POINTS - 1),
                    )
                )
    return tuple(found)


def _spread(model: RobotModel, parameter: NonlinearParameter, speeds: Sequence[Array]) -> Array:
    """Return values (POINTS, n) in equal ratios over the credible range."""
    lowest, highest = credible_range(model, parameter, speeds)
    return np.asarray(np.geomspace(np.maximum(lowest, 1e-9), np.maximum(highest, 1e-9), POINTS))


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """Hold squared errors per held-out sample (folds, n) and the fitted parameters (folds, P)."""

    held_out: Array
    parameters: Array


class CandidateColumns:
    """Hold normal equations of `[W_k | candidates of joint k | tau_k]` by joint and time block.

    One pass over the samples serves any choice of candidates, training and held-out blocks. The
    vector of P parameters has the p of `base`, then those of the candidates joint by joint;
    `drive_places` has the positions of each joint's drive parameters among the first. `weights`
    (n,) multiply the rows of each joint. The load of load-dependent terms is that of `model`.
    Normal equations square the condition number, which must be small.
    """

    def __init__(
        self,
        model: RobotModel,
        base: BaseParameters,
        tried: Sequence[Candidate],
        samples: Sequence[Samples],
        weights: Array,
    ) -> None:
        self.model, self.base, self.tried = model, base, tuple(tried)
        n, links = model.n_joints, 10 * model.n_links
        plans = [RegressorPlan.of(model, base.drive, base.columns, spare_rows=1)]
        for each in tried:
            own = n * len(each.term.symbols)
            plans.append(
                RegressorPlan.of(
                    model, DriveSet((each.term,)), np.arange(links, links + own), spare_rows=1
                )
            )
        first = np.cumsum([0, *(len(each.term.symbols) for each in tried)])
        extra, p = int(first[-1]), base.n_base
        self.n_parameters = p + n * extra
        self._places = {
            (k, c): np.arange(first[c], first[c + 1]) + p + k * extra
            for k in range(n)
            for c in range(len(tried))
        }
        self._positions = [
            np.concatenate([support, p + k * extra + np.arange(extra), [self.n_parameters]])
            for k, support in enumerate(plans[0].support)
        ]
        self._weights = weights
        self.drive_places = [_drive_places(base, k) for k in range(n)]
        grams: list[list[Array]] = []
        counts = []
        for part in thinned(model, samples):
            block = [np.zeros((len(positions), len(positions))) for positions in self._positions]
            for base_rows, *extra_rows in zip(*(part.chunks(plan) for plan in plans), strict=True):
                for k in range(n):
                    rows = np.vstack(
                        [
                            base_rows[k][:-1],
                            *(each[k][:-1] for each in extra_rows),
                            base_rows[k][-1:],
                        ]
                    )
                    block[k] += rows @ rows.T
            grams.append(block)
            counts.append(part.n_outputs)
        self._grams = [np.array([block[k] for block in grams]) for k in range(n)]
        self.counts = np.array(counts)

    @property
    def blocks(self) -> Indices:
        """The time blocks, counted from 0."""
        return np.arange(len(self.counts))

    def own_places(self, placed: Placed) -> Indices:
        """Return the positions of a candidate's parameters at a joint."""
        return self._places[placed]

    def fitted(self, choice: Choice, blocks: Indices) -> Array:
        """Return the parameters (P,) fitted to these blocks, zero for those outside the choice."""
        return self.solved(self.normal_equations(self.summed(blocks)), self.indices(choice))

    def squared_error(self, parameters: Array, blocks: Indices) -> Array:
        """Return the squared error per sample of each joint on these blocks, shape (n,)."""
        return self.error_energy(self.summed(blocks), parameters) / int(self.counts[blocks].sum())

    def summed(self, blocks: Indices) -> list[Array]:
        """Return the normal equations of each joint over these blocks."""
        return [gram[blocks].sum(axis=0) for gram in self._grams]

    def normal_equations(self, grams: Sequence[Array]) -> Array:
        """Return those of all joints together, weighted, (P + 1, P + 1)."""
        total = np.zeros((self.n_parameters + 1, self.n_parameters + 1))
        for positions, gram, weight in zip(self._positions, grams, self._weights, strict=True):
            total[np.ix_(positions, positions)] += weight**2 * gram
        return total

    def indices(self, choice: Choice) -> Indices:
        """Return the parameters of a choice; candidates replace their simpler terms."""
        kept = np.ones(self.base.n_base, dtype=bool)
        for k, c in choice:
            for term, places in self.drive_places[k]:
                if term.key == self.tried[c].term.stands_for:
                    kept[places] = False
        return np.concatenate([np.flatnonzero(kept), *(self._places[placed] for placed in choice)])

    def solved(self, total: Array, indices: Indices) -> Array:
        """Return the solution (P,) of normal equations, zero outside `indices`."""
        matrix = total[np.ix_(indices, indices)]
        sizes = np.sqrt(np.diag(matrix))
        sizes[sizes == 0.0] = 1.0
        solution = np.linalg.solve(
            matrix / np.outer(sizes, sizes) + RIDGE * np.eye(len(indices)),
            total[indices, -1] / sizes,
        )
        parameters = np.zeros(self.n_parameters)
        parameters[indices] = solution / sizes
        return parameters

    def error_energy(self, grams: Sequence[Array], parameters: Array) -> Array:
        """Return the squared error of each joint, (n,), at least the rounding of its torque's."""
        left = np.append(-parameters, 1.0)
        errors = [
            left[positions] @ gram @ left[positions]
            for positions, gram in zip(self._positions, grams, strict=True)
        ]
        rounding = [
            np.finfo(np.float64).eps * gram[-1, -1] + np.finfo(np.float64).tiny for gram in grams
        ]
        return np.maximum(errors, rounding)


def _drive_places(base: BaseParameters, joint: int) -> list[tuple[DriveTerm, Indices]]:
    """Return the drive terms of a joint with the positions of their base parameters."""
    found = []
    for term in base.drive.terms:
        names = [f"{symbol}{joint + 1}" for symbol in term.symbols]
        found.append(
            (
                term,
                np.array(
                    [base.names.index(name) for name in names if name in base.names], dtype=np.int64
                ),
            )
        )
    return found


class Folds:
    """Hold folds of neighbouring blocks, each held out in turn."""

    def __init__(self, columns: CandidateColumns, blocks: Indices, n_folds: int) -> None:
        self._columns = columns
        self.folds = [
            fold for fold in np.array_split(blocks, min(n_folds, len(blocks))) if len(fold)
        ]
        self._training = [
            columns.normal_equations(columns.summed(np.setdiff1d(blocks, fold)))
            for fold in self.folds
        ]
        self._held = [columns.summed(fold) for fold in self.folds]
        self._counts = [int(columns.counts[fold].sum()) for fold in self.folds]
        self._known: dict[Choice, Fit] = {}

    def fit(self, choice: Choice) -> Fit:
        """Return the fit of a choice for each fold."""
        key = tuple(sorted(choice))
        if key not in self._known:
            columns = self._columns
            indices = columns.indices(key)
            fitted = [columns.solved(total, indices) for total in self._training]
            errors = [
                columns.error_energy(held, parameters) / count
                for held, parameters, count in zip(self._held, fitted, self._counts, strict=True)
            ]
            self._known[key] = Fit(np.array(errors), np.array(fitted))
        return self._known[key]


def chosen_drive(
    start: DriveSet, tried: Sequence[Candidate], choice: Choice, n_joints: int
) -> DriveSet:
    """Return the drive set of a choice, with simpler terms at joints without the chosen ones."""
    drive = start
    for key in dict.fromkeys(tried[c].key for _, c in choice):
        at = {k: tried[c].term for k, c in choice if tried[c].key == key}
        term = next(iter(at.values()))
        parameters = {
            parameter.name: tuple(
                float(f"{at[k].at(k).value(parameter.name):.4g}") if k in at else parameter.default
                for k in range(n_joints)
            )
            for parameter in available_terms()[key].free_nonlinear
        }
        everywhere = len(at) == n_joints
        drive = drive.with_term(
            replace(
                term.with_nonlinear(parameters),
                joints=None if everywhere else tuple(sorted(k + 1 for k in at)),
            )
        )
        simple = next((each for each in drive.terms if each.key == term.stands_for), None)
        if simple is not None:
            left = tuple(k + 1 for k in range(n_joints) if simple.is_at(k) and k not in at)
            drive = drive.without(simple.key)
            drive = drive.with_term(replace(simple, joints=left)) if left else drive
    return drive
