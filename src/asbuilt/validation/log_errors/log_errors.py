"""Errors of a log that its residual shows: clock, zero positions, gains, and what drifts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import BaseParameters, find_base_parameters
from asbuilt.dynamics.kernels.blas import one_blas_thread
from asbuilt.dynamics.regressor import RegressorPlan
from asbuilt.errors import AsbuiltError, IdentifiabilityError, UsageError
from asbuilt.identification.calibration.mounting import Mounting, find_mounting
from asbuilt.identification.errors.uncertainty import FEWEST_BLOCKS
from asbuilt.identification.information.rows import sample_blocks
from asbuilt.identification.result.torque_prediction import predict_torque
from asbuilt.validation.generalisation.effect_evidence import plain_fit
from asbuilt.validation.log_errors.error_columns import (
    Candidate,
    ErrorColumns,
    Kind,
    largest_torques,
    progress,
)
from asbuilt.validation.log_errors.forward_selection import BlockEquations, Chosen

if TYPE_CHECKING:
    from asbuilt.experiment.signal.samples import Samples
    from asbuilt.identification.result.result import IdentificationResult

MOST = 6
"""Columns chosen, of the log and of the model together."""
SEARCHED = 20_000
"""Samples that are searched."""
SPAN = 10.0
"""Length [s] of the parts that are searched of longer recordings."""
ROUNDS, SETTLED = 12, 1e-3
"""Gauss-Newton steps, and the step at which they have settled."""
CLOCK_FACTORS = (0.1, 0.5, 2.0, 10.0)
"""Factors about which a clock is looked for that is off by more than what is first order."""
LARGEST_STEP = 0.5
"""Largest step of the logarithm of the clock's rate."""
PER_JOINT = ("zero", "scale", "drift")
"""Kinds of errors that are taken out of the log of one joint."""
DEAD = -0.8
"""Scale below which a torque cannot be divided by it."""


@dataclass(frozen=True, slots=True)
class Bounds:
    """Say between which values an error is plausible, and from which size on it matters."""

    lowest: float
    highest: float
    matters: float


BOUNDS: dict[Kind, Bounds] = {
    "clock": Bounds(-np.inf, np.inf, 0.01),
    "zero": Bounds(-np.deg2rad(20.0), np.deg2rad(20.0), np.deg2rad(0.3)),
    "scale": Bounds(-1.15, 1.0, 0.03),
    "nonlinear": Bounds(-0.8, 0.0, 0.05),
    "drift": Bounds(-np.inf, np.inf, 0.02),
    "warming": Bounds(-1.5, 1.5, 0.05),
    "spring": Bounds(0.0, np.inf, 0.02),
}
"""Own choices: what a robot in use can have; `drift` and `spring` in largest torques of a joint."""
IN_TORQUES = ("drift", "spring")
NAMED = 0.05
"""Share of the squared residual from which on an error is named."""
PRISMATIC_ZERO = Bounds(-0.05, 0.05, 1e-3)


@dataclass(frozen=True, slots=True)
class LogError:
    """Hold an error of a log: value and standard error as `Candidate` says, and its share.

    `share` is what it takes away from the squared torque residual.
    """

    kind: Kind
    joint: str | None
    value: float
    std_error: float
    share: float


@dataclass(frozen=True, slots=True)
class Sought:
    """Hold what a search found: `errors`, the largest share first, and what it cannot find.

    Errors of the clock below `clock_unseen` (a share of its rate) would explain less of the
    residual than what is named; infinite where other parameters take the place of any clock.
    """

    errors: tuple[LogError, ...] = ()
    clock_unseen: float = 0.0


def log_errors(
    result: IdentificationResult,
    training: Sequence[Samples],
    *,
    mounting: Mounting | None = None,
    block_seconds: float | None = None,
) -> tuple[LogError, ...]:
    """Return the errors that `sought_errors` finds."""
    return sought_errors(result, training, mounting=mounting, block_seconds=block_seconds).errors


def sought_errors(
    result: IdentificationResult,
    training: Sequence[Samples],
    *,
    mounting: Mounting | None = None,
    block_seconds: float | None = None,
) -> Sought:
    """Search the residual of a result for errors of the log.

    Columns of all candidates are added to the weighted least squares fit one at a time
    (`BlockEquations.selected`). Their values are then found by Gauss-Newton steps, each about the
    log with the errors so far taken out. A clock that explains most is named alone, for then the
    other columns were those of wrong velocities; one that is off by a factor is looked for at
    some factors, and has to explain more than any other candidate. A base tilt that is chosen
    first is estimated, and errors of the log are sought on the tilted robot: its column is that
    of CAD's masses to first order, and what it leaves resembles wrong gains.

    Parameters
    ----------
    result
        The result; candidates are linearised about its values.
    training
        The samples it was identified from.
    mounting
        The mounting, if it has been estimated; otherwise it is where a tilt is chosen first.
    block_seconds
        Length of the time blocks of standard errors [s].

    Samples that cannot be fitted again show none, nor do fewer time blocks than standard errors
    need.
    """
    if not training:
        return Sought()
    searched = _thinned(training)
    try:
        search = _Search(result.model, result.base, result.estimates, searched, block_seconds)
        if search.tilt_is_first:
            search = _tilted(search, mounting) or search
        return Sought(_found(search), search.clock_unseen)
    except (AsbuiltError, np.linalg.LinAlgError):
        return Sought()


def _tilted(search: _Search, mounting: Mounting | None) -> _Search | None:
    """Return the search on the robot with its base tilt; None if no tilt is significant."""
    model, drive, seconds = search.model, search.base.drive, search.seconds
    if mounting is None:
        try:
            mounting = find_mounting(model, search.training, drive=drive, block_seconds=seconds)
        except (IdentifiabilityError, UsageError):
            return None
    if not mounting.is_tilted:
        return None
    base = find_base_parameters(mounting.model, drive)
    values = plain_fit(mounting.model, base, search.training, seconds).beta
    return _Search(mounting.model, base, values, search.training, seconds, tilted=True)


def _found(search: _Search) -> tuple[LogError, ...]:
    """Return the errors that a search finds and that matter."""
    pace = search.pace()
    if pace is not None and pace.share > search.largest_share:
        return (pace,)
    found = search.chosen()
    if found and found[0].kind == "clock":
        return (found[0],) if search.matters(found[0]) else ()
    curved = {each.joint for each in found if each.kind == "nonlinear"}
    return tuple(
        each
        for each in found
        if each.kind not in ("clock", "tilt", "drive")
        and each.share >= NAMED
        and not (each.kind == "scale" and each.joint in curved)
        and search.matters(each)
    )


@dataclass(frozen=True, slots=True)
class _Corrected:
    """Hold what is taken out of a log: clock, zero positions, scales and drifts, (n,) each."""

    zero: Array
    scale: Array
    drift: Array
    clock: float = 1.0

    @classmethod
    def nothing(cls, n: int) -> _Corrected:
        return cls(np.zeros(n), np.zeros(n), np.zeros(n))

    def taking(self, candidate: Candidate, step: float) -> tuple[_Corrected, float]:
        """Return this with more taken out, and the step taken, 0 for what stays in the fit."""
        if candidate.kind == "clock":
            step = float(np.clip(step, -LARGEST_STEP, LARGEST_STEP))
            return replace(self, clock=self.clock * float(np.exp(step))), step
        if candidate.kind not in PER_JOINT or candidate.joint is None:
            return self, 0.0
        if candidate.kind == "scale" and step < DEAD:
            return self, 0.0
        held = np.array(getattr(self, candidate.kind))
        held[candidate.joint] += step * (
            1.0 + held[candidate.joint] if candidate.kind == "scale" else 1.0
        )
        changed: dict[str, Any] = {candidate.kind: held}
        return replace(self, **changed), 0.0 if candidate.kind == "drift" else step

    def value(self, candidate: Candidate) -> float | None:
        """Return what was taken out by a candidate; None for what stays in the fit."""
        if candidate.kind == "clock":
            return self.clock - 1.0
        if candidate.kind not in PER_JOINT or candidate.joint is None:
            return None
        held = getattr(self, candidate.kind)
        dead = candidate.kind == "scale" and held[candidate.joint] == 0.0
        return None if dead else float(held[candidate.joint])

    def of(self, samples: Samples) -> Samples:
        """Return samples without these errors."""
        tau = samples.tau - self.drift * progress(samples.t, samples.t)[:, None]
        return replace(
            samples,
            q=samples.q - self.zero,
            qd=samples.qd * self.clock,
            qdd=samples.qdd * self.clock**2,
            tau=tau / (1.0 + self.scale),
        )


class _Search:
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
        self._first = self._equations(_Corrected.nothing(len(self._largest)), values)
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
        nothing = _Corrected.nothing(len(self._largest))
        left = {
            factor: self._residual(replace(nothing, clock=factor).of) for factor in CLOCK_FACTORS
        }
        best = min(left, key=lambda factor: left[factor])
        if left[best] > (1.0 - NAMED) * whole:
            return None
        (error,) = self._refined([(own, 0.0)], replace(nothing, clock=best)) or (None,)
        if error is None:
            return None
        after = self._residual(replace(nothing, clock=1.0 + error.value).of)
        return replace(error, share=1.0 - after / whole)

    @property
    def clock_unseen(self) -> float:
        """Error of the clock below which it would not be named."""
        columns, equations = self._first
        return equations.smallest_seen(columns.candidates.index(Candidate("clock", None)), NAMED)

    @cached_property
    def _picked(self) -> tuple[Chosen, ...]:
        columns, equations = self._first
        return equations.selected(
            MOST,
            lambda column, value: self._is_plausible(columns.candidates[column], value),
            self._given,
        )

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
        """Return the errors chosen one at a time, with their values by Gauss-Newton steps."""
        candidates, picked = self._first[0].candidates, self._picked
        if not any(
            candidates[each.column].kind in BOUNDS and each.share >= NAMED for each in picked
        ):
            return []
        found = self._refined(
            [(candidates[each.column], each.share) for each in picked],
            _Corrected.nothing(len(self._largest)),
            [each.column for each in picked],
        )
        return [each for each in found if self._is_plausible(self._candidate(each), each.value)]

    def _refined(
        self,
        picked: Sequence[tuple[Candidate, float]],
        taken: _Corrected,
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

    def _is_plausible(self, candidate: Candidate, value: float) -> bool:
        """Return whether a robot in use can have this value; what a model lacks has no bounds."""
        bounds = self._bounds(candidate)
        return bounds is None or bounds.lowest <= value <= bounds.highest

    def _residual(self, change: Callable[[Samples], Samples]) -> float:
        """Return the squared residual of a fit to changed samples, weighted as the first fit."""
        training = [change(samples) for samples in self.training]
        estimate = plain_fit(self.model, self.base, training, self.seconds)
        prediction = [
            predict_torque(self.model, self.base, estimate.beta, samples) for samples in training
        ]
        return float(sum(np.sum((each.error * self._weights) ** 2) for each in prediction))

    def _equations(
        self, taken: _Corrected, values: Array | None
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


def _thinned(training: Sequence[Samples]) -> list[Samples]:
    """Return parts of all recordings with at most about `SEARCHED` samples together."""
    n_samples = sum(samples.n_samples for samples in training)
    every = -(-n_samples // SEARCHED)
    if every <= 1:
        return list(training)
    return [
        samples.select((samples.t - samples.t[0]) // SPAN % every == 0.0) for samples in training
    ]
