"""One pass over the samples: rows of the model and of all effects it may lack."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from asbuilt.arrays import Array, Indices
from asbuilt.dynamics import BaseParameters, DriveTerm
from asbuilt.dynamics.kernels.blas import use_one_blas_thread
from asbuilt.dynamics.regressor import RegressorPlan
from asbuilt.experiment.signal.samples import Samples
from asbuilt.identification.effects.effect import Described, Effect, Motion, Variant, find_places
from asbuilt.identification.information.equations import MODEL, BlockRows
from asbuilt.identification.information.rows import (
    ROWS,
    KeptRows,
    SampleBlock,
    TimeBlock,
    divide_into_blocks,
)
from asbuilt.identification.information.triangular import shorten_columns, stack_blocks

MOST_EVALUATED = 100e6
"""Memory [bytes] of the columns of effects that are evaluated at once."""
EFFECT_COLUMNS = "effects"
"""Group of the columns of all candidates."""
At = tuple[str, int | None]
"""Key of an effect and the joint that it acts at (from 0; None: the whole robot)."""


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """Name an effect at a joint (from 0; None: of the whole robot) and its parameters.

    `places` are its positions among all parameters, the model's first; `replaces` are positions of
    the model's parameters in whose place it comes.
    """

    effect: Effect
    joint: int | None
    places: Indices
    term: DriveTerm | None = None
    replaces: Indices = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    @property
    def at(self) -> At:
        """Key and joint, the same for every trial value of a nonlinear parameter."""
        return self.effect.key, self.joint

    @property
    def slot(self) -> tuple[str, int | None]:
        """Kind and joint, of which a model has one effect."""
        return self.effect.kind, self.joint

    @property
    def busy(self) -> set[tuple[str, int | None]]:
        """Kinds and joints that nothing else is asked for once it is taken."""
        # What a motor shared with the joint before leaves shows at both.
        near = () if self.joint is None else (self.joint, self.joint - 1)
        return {self.slot, *((kind, k) for kind in self.effect.imitators for k in near)}

    @property
    def has_trial_values(self) -> bool:
        """Whether it has nonlinear parameters whose values are not fitted yet."""
        return self.term is not None and any(parameter.fitted for parameter in self.term.nonlinear)


def gather_rows(
    robot: Described,
    samples: Iterable[Samples],
    effects: Iterable[Effect],
    block_seconds: float,
    kept: KeptRows | None = None,
) -> tuple[BlockRows, tuple[Candidate, ...]]:
    """Return the rows of a model and of effects by time block, in one pass over samples.

    Candidates of the effects are returned, too: where each has its columns.

    Parameters
    ----------
    robot
        The robot; nonlinear effects are linearised about its values.
    samples
        Samples of one or more recordings.
    effects
        The effects.
    block_seconds
        Length of a time block [s].
    kept
        Rows of the model that are kept for others who ask for the same ones.
    """
    base = robot.base
    variants = [variant for effect in effects for variant in effect.variants(robot)]
    variants.sort(key=lambda each: not each.local)  # local columns first
    candidates, slots, size = _place_candidates(variants, robot.model.n_joints, base)
    plan = RegressorPlan.of(robot.model, base.drive, base.columns, spare_rows=slots.shape[1] + 1)
    support = [np.concatenate(both) for both in zip(plan.support, slots, strict=True)]
    # Slots of each joint, and the torque: one spare row more, after all columns of effects.
    there = [np.append(np.flatnonzero(s >= 0), len(s)) for s in support]
    found: list[list[Array]] = [[] for _ in there]
    times: list[TimeBlock] = []
    columns = _Columns(robot, variants)
    with use_one_blas_thread():
        for part in divide_into_blocks(robot.model, samples, block_seconds, kept):
            rows = part.rows(plan, partial(columns, part))
            # Slots that a joint does not have hold zeros, and go before the blocks are kept.
            for of_joint, own, kept_slots in zip(found, rows, there, strict=True):
                of_joint.append(shorten_columns(own[kept_slots]))
            times.append(part.time)
    # Blocks of a joint go once they are stacked: all of both would take twice the memory.
    stacked = [stack_blocks(found.pop(0)) for _ in there]
    gathered = BlockRows(
        {MODEL: base.n_base, EFFECT_COLUMNS: size - base.n_base},
        tuple(s[s >= 0] for s in support),
        tuple(stacked),
        tuple(times),
    )
    return gathered, tuple(candidates)


def _place_candidates(
    variants: Sequence[Variant], n: int, base: BaseParameters
) -> tuple[list[Candidate], Indices, int]:
    """Return candidates, the parameter in each slot of each joint (-1: none), and the number."""
    # Slots, not parameters, are columns of the regressor: a local variant fills one for all joints.
    parameters = np.full((n, sum(variant.n_columns for variant in variants)), -1)
    candidates = list[Candidate]()
    first = 0
    size = base.n_base
    for variant in variants:
        slots = slice(first, first + variant.n_columns)
        first = slots.stop
        for k in variant.joints if variant.local else (variant.joint,):
            # Numbers follow the order of candidates, the model's own first.
            places = np.arange(size, size + variant.n_columns)
            size += variant.n_columns
            parameters[k if variant.local else slice(None), slots] = places
            # Only what acts at a joint stands for a simpler term there.
            simpler = variant.term.stands_for if variant.local and variant.term else None
            replaced = find_places(base, simpler, k or 0)
            candidates.append(Candidate(variant.effect, k, places, variant.term, replaced))
    return candidates, parameters, size


class _Columns:
    """Evaluate the columns of variants on spans of samples, one after another.

    Columns of single instants are evaluated for many samples at once, as blocks are short.
    """

    def __init__(self, robot: Described, variants: Sequence[Variant]) -> None:
        self._robot = robot
        self._variants = variants
        self._samples: Samples | None = None
        self._start = self._stop = 0

    def __call__(self, part: SampleBlock, span: slice) -> list[Array]:
        """Return the columns of all variants, (L, n) each, on a span of the block's samples."""
        ahead = self._samples is part.samples and self._start <= span.start
        if not ahead or span.stop > self._stop:
            self._evaluate(part, span)
        inside = slice(span.start - self._start, span.stop - self._start)
        motion = self._motion.within(inside)
        return [
            column
            for variant, columns in zip(self._variants, self._columns, strict=True)
            for column in (
                variant.effect.columns(variant, motion)
                # Columns that depend on a span's neighbours are evaluated on the span itself.
                if columns is None
                else (values[inside] for values in columns)
            )
        ]

    def _evaluate(self, part: SampleBlock, span: slice) -> None:
        """Evaluate what depends on single instants, from the start of a span on."""
        samples = self._samples = part.samples
        self._start = span.start
        # Blocks are short: a call for more samples than one block needs saves calls.
        size = 8.0 * samples.n_joints * sum(variant.n_columns for variant in self._variants)
        most = min(2 * ROWS.samples_at_once, int(MOST_EVALUATED / max(size, 1.0)))
        self._stop = max(span.stop, min(span.start + most, part.stop))
        held = slice(self._start, self._stop)
        # A recording of one sample has no length.
        length = max(float(samples.t[-1] - samples.t[0]), 1e-9)
        elapsed = (samples.t[held] - samples.t[0]) / length - 0.5
        state = samples.q[held], samples.qd[held], samples.qdd[held]
        self._motion = Motion(self._robot, samples.rate, *state, elapsed)
        self._columns = [
            None if variant.effect.by_span else variant.effect.columns(variant, self._motion)
            for variant in self._variants
        ]
