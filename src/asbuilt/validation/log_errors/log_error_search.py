"""Search of the errors of one log: columns chosen one at a time, values by Gauss-Newton steps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import BaseParameters
from asbuilt.dynamics.kernels.blas import one_blas_thread
from asbuilt.dynamics.regressor import RegressorPlan
from asbuilt.errors import IdentifiabilityError
from asbuilt.identification.errors.uncertainty import FEWEST_BLOCKS
from asbuilt.identification.information.rows import sample_blocks
from asbuilt.identification.result.torque_prediction import predict_torque
from asbuilt.validation.generalisation.effect_evidence import plain_fit
from asbuilt.validation.log_errors.correction import PER_JOINT, Correction
from asbuilt.validation.log_errors.error_columns import (
    Candidate,
    ErrorColumns,
    Kind,
    largest_torques,
)
from asbuilt.validation.log_errors.forward_selection import BlockEquations, Chosen
from asbuilt.validation.log_errors.log_error_bounds import (
    ABOUT,
    BOUNDS,
    CLOCK_FACTORS,
    IN_TORQUES,
    NAMED,
    PRISMATIC_ZERO,
    Bounds,
)

if TYPE_CHECKING:
    from asbuilt.experiment.signal.samples import Samples

MOST = 6
"""Columns chosen, of the log and of the model together."""
ROUNDS, SETTLED = 12, 1e-3
"""Gauss-Newton steps, and the step at which they have settled."""
AS_MUCH = 0.5
"""Share of the residual, over that of the error chosen, by which another one may be meant."""


@dataclass(frozen=True, slots=True)
class LogError:
    """Hold an error of a log: value and standard error as `Candidate` says, and its share.

    `share` is what it takes away from the squared torque residual. `instead` are other joints whose
    error of this kind would explain about as much.
    """

    kind: Kind
    joint: str | None
    value: float
    std_error: float
    share: float
    instead: tuple[str, ...] = ()


class LogErrorSearch:
    """Search the errors of a log."""

    def __init__(
        self,
        model: RobotModel,
        base: BaseParameters,
        values: Array,
        training: Sequence[Samples],
        seconds: float | None,
        tilted: bool = False,
    ) -> None:
        """Take the model, the values (p,) of its base parameters, samples, and length of blocks.

        The fits of a `tilted` robot have the tilt too: it was estimated beside the log's errors.
        """
        self.model, self.base, self.training, self.seconds = model, base, training, seconds
        self._largest = largest_torques(training)
        self._first = self._equations(Correction.nothing(len(self._largest)), values)
        self._given = tuple(
            j for j, each in enumerate(self._first[0].candidates) if tilted and each.kind == "tilt"
        )

    def matters(self, error: LogError) -> bool:
        """Return whether an error of the log is large enough to name."""
        own = self._candidate(error)
        bounds = self._bounds(own)
        in_torques = own.kind in IN_TORQUES and own.joint is not None
        size = float(self._largest[own.joint]) if in_torques else 1.0
        return bounds is not None and abs(error.value) >= bounds.matters * size

    def pace(self) -> LogError | None:
        """Return the error of a clock that is off by about one of some factors, if one is."""
        whole = self._first[1].residual
        own = Candidate("clock", None)
        nothing = Correction.nothing(len(self._largest))
        left = {
            factor: self._residual(replace(nothing, clock=factor).of) for factor in CLOCK_FACTORS
        }
        best = min(left, key=lambda factor: left[factor])
        if left[best] > (1.0 - NAMED) * whole:
            return None
        (error,) = self._refined([(own, 0.0)], replace(nothing, clock=best)) or (None,)
        if error is None or abs(np.log((1.0 + error.value) / best)) > np.log(ABOUT):
            return None
        if not self._admits_clock(error.value):
            return None
        after = self._residual(replace(nothing, clock=1.0 + error.value).of)
        return replace(error, share=1.0 - after / whole)

    @property
    def clock_unseen(self) -> float:
        """Error of the clock below which it would not be named."""
        columns, equations = self._first
        return equations.smallest_seen(columns.candidates.index(Candidate("clock", None)), NAMED)

    def unseen(self, kind: Kind) -> Array:
        """Return the error of a kind of each joint below which it would not be named, (n,).

        Infinite where other parameters take its place, zero where it changes no torque.
        """
        columns, equations = self._first
        found = np.zeros(self.model.n_joints)
        for j, each in enumerate(columns.candidates):
            if each.kind == kind and each.joint is not None and equations.acts(j):
                size, bounds = equations.smallest_seen(j, NAMED), self._bounds(each)
                if bounds is not None:
                    size = max(size, bounds.matters) if size <= bounds.highest else np.inf
                found[each.joint] = size
        return found

    @cached_property
    def _picked(self) -> tuple[Chosen, ...]:
        return self._selected()

    def _selected(self, without: Kind | None = None) -> tuple[Chosen, ...]:
        """Return the plausible columns chosen one at a time, those of a kind left out."""
        columns, equations = self._first

        def admitted(each: Chosen) -> bool:
            candidate = columns.candidates[each.column]
            return candidate.kind != without and self._is_plausible(candidate, each)

        return equations.selected(MOST, admitted, self._given)

    @property
    def tilt_is_first(self) -> bool:
        """Whether a base tilt is chosen before any error of the log."""
        candidates = self._first[0].candidates
        kinds = (candidates[each.column].kind for each in self._picked)
        return next((kind for kind in kinds if kind == "tilt" or kind in BOUNDS), None) == "tilt"

    @property
    def largest_share(self) -> float:
        """Share of the squared residual that the first column chosen takes away."""
        return max((each.share for each in self._picked), default=0.0)

    def chosen(self) -> list[LogError]:
        """Return the errors chosen one at a time, with their values by Gauss-Newton steps.

        If a clock is chosen first and its value then is none that clocks have, others are.
        """
        picked = self._picked
        found = self._settled(picked)
        if not found and picked and self._first[0].candidates[picked[0].column].kind == "clock":
            found = self._settled(self._selected(without="clock"))
        return found

    def _settled(self, picked: Sequence[Chosen]) -> list[LogError]:
        """Return the errors of chosen columns, with their values by Gauss-Newton steps."""
        candidates = self._first[0].candidates
        if not any(
            candidates[each.column].kind in BOUNDS and each.share >= NAMED for each in picked
        ):
            return []
        found = self._refined(
            [(candidates[each.column], each.share) for each in picked],
            Correction.nothing(len(self._largest)),
            [each.column for each in picked],
        )
        return [
            replace(each, instead=self._instead(self._candidate(each)))
            for each in found
            if self._is_plausible(self._candidate(each), each)
        ]

    def _instead(self, own: Candidate) -> tuple[str, ...]:
        """Return the other joints whose error of this kind would explain about as much."""
        if own.kind not in PER_JOINT:
            return ()
        columns, equations = self._first
        shares = equations.shares_alone(self._given)
        least = AS_MUCH * shares[columns.candidates.index(own)]
        return tuple(
            self.model.joint_names[each.joint]
            for each, share in zip(columns.candidates, shares, strict=True)
            if each.joint is not None and each.kind == own.kind and each != own and share >= least
        )

    def _refined(
        self,
        picked: Sequence[tuple[Candidate, float]],
        taken: Correction,
        columns: Sequence[int] = (0,),
    ) -> list[LogError]:
        """Return errors with the values at which nothing more is to be taken out."""
        if not picked:
            return []
        if picked[0][0].kind == "clock":
            picked, columns = picked[:1], columns[:1]
        for _ in range(ROUNDS):
            solved = {
                each.column: each
                for each in self._equations(taken, None)[1].together(columns, self._given)
            }
            steps = []
            for (own, _), column in zip(picked, columns, strict=True):
                if column in solved:
                    taken, step = taken.taking(own, solved[column].value)
                    steps.append(step)
            if max(map(abs, steps), default=0.0) < SETTLED:
                return [
                    self._named(own, taken.value(own), solved[column], share)
                    for (own, share), column in zip(picked, columns, strict=True)
                    if column in solved
                ]
        return []

    def _named(self, own: Candidate, value: float | None, solved: Chosen, share: float) -> LogError:
        joint = None if own.joint is None else self.model.joint_names[own.joint]
        factor = 1.0 if value is None or own.kind not in ("clock", "scale") else 1.0 + value
        return LogError(
            own.kind,
            joint,
            solved.value if value is None else value,
            abs(factor) * solved.std_error,
            share,
        )

    def _candidate(self, error: LogError) -> Candidate:
        names = self.model.joint_names
        return Candidate(error.kind, None if error.joint is None else names.index(error.joint))

    def _bounds(self, candidate: Candidate) -> Bounds | None:
        """Return the bounds of a candidate; None for what the model may lack."""
        if candidate.kind == "zero" and candidate.joint is not None:
            revolute = self.model.joints[candidate.joint].is_revolute
            return BOUNDS["zero"] if revolute else PRISMATIC_ZERO
        return BOUNDS.get(candidate.kind)

    def _is_plausible(self, candidate: Candidate, found: Chosen | LogError) -> bool:
        """Return whether a robot in use can have this value; what a model lacks has no bounds."""
        bounds = self._bounds(candidate)
        if candidate.kind == "clock" and not self._admits_clock(found.value):
            return False
        return bounds is None or bounds.hold(found.value, found.std_error)

    def _admits_clock(self, value: float) -> bool:
        """Return whether logged velocities, which do not follow the clock, admit its error."""
        return all(abs(value) <= samples.clock_bound for samples in self.training)

    def _residual(self, change: Callable[[Samples], Samples]) -> float:
        """Return the squared residual of a fit to changed samples, weighted as the first fit."""
        training = [change(samples) for samples in self.training]
        estimate = plain_fit(self.model, self.base, training, self.seconds)
        prediction = [
            predict_torque(self.model, self.base, estimate.beta, samples) for samples in training
        ]
        return float(sum(np.sum((each.error * self._weights) ** 2) for each in prediction))

    def _equations(
        self, taken: Correction, values: Array | None
    ) -> tuple[ErrorColumns, BlockEquations]:
        """Return candidates about values (None: those of the fit), and their normal equations."""
        model, base = self.model, self.base
        training = [taken.of(samples) for samples in self.training]
        estimate = plain_fit(self.model, self.base, training, self.seconds)
        columns = ErrorColumns(
            model, base, estimate.beta if values is None else values, self._largest
        )
        m = len(columns.candidates)
        plan = RegressorPlan.of(model, base.drive, base.columns, spare_rows=m + 1)
        root = estimate.solution.inverse_root
        r = root.shape[1]
        if values is not None:
            self._weights = np.asarray(estimate.weights)
        parts: list[tuple[Array, Array, float]] = []
        with one_blas_thread():
            for part in sample_blocks(model, training, self.seconds):
                beside = partial(columns.evaluate, part.samples)
                gram, score, square = np.zeros((r + m, r + m)), np.zeros(r + m), 0.0
                for chunk in part.chunks(plan, beside):
                    for k, rows in enumerate(chunk):
                        support, weight = plan.support[k], estimate.weights[k]
                        known = rows[: -m - 1]
                        e = weight * (rows[-1] - estimate.beta[support] @ known)
                        x = weight * np.vstack([root[support].T @ known, rows[-m - 1 : -1]])
                        gram += x @ x.T
                        score += x @ e
                        square += float(e @ e)
                parts.append((gram, score, square))
        if len(parts) < FEWEST_BLOCKS:
            raise IdentifiabilityError(
                f"{len(parts)} time blocks of {model.name} are too few for standard errors"
            )
        grams, scores, squares = map(np.array, zip(*parts, strict=True))
        return columns, BlockEquations(grams, scores, squares, r)
