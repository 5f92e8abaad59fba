"""Square-root information: one triangular factor per joint and time block of a recording."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array, Indices, Mask
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import BaseParameters
from asbuilt.dynamics.batches import choose_threads
from asbuilt.dynamics.kernels.blas import use_one_blas_thread
from asbuilt.dynamics.regressor import RegressorPlan
from asbuilt.errors import IdentifiabilityError, ResultError
from asbuilt.executor import count_cores
from asbuilt.experiment.signal.samples import Samples
from asbuilt.findings import Cure
from asbuilt.identification.information.rows import (
    FurtherColumns,
    KeptRows,
    RowBlock,
    SampleBlock,
    TimeBlock,
    divide_into_blocks,
)
from asbuilt.identification.information.triangular import (
    ROWS_AT_ONCE,
    GrowingFactor,
    is_triangular,
    shorten_columns,
    shorten_rows,
    stack_blocks,
    stack_factors,
)

MOST_KNOWN = 2**26
"""Bytes of the factors that are kept for further questions with the same weights."""
MOST_BLOCKS = 128
"""Half the number of blocks at which neighbours are merged, which bounds memory."""


@dataclass(frozen=True, eq=False)
class SquareRootInformation:
    """Hold factors R of `[W_k | tau_k]` for every joint k and time block b.

    `R^T R = [W_k | tau_k]^T [W_k | tau_k]`. Joint k depends only on the base parameters
    `support[k]` (p_k positions among the p of `base`): links it carries and its own drive.
    `factors[k]` has shape (n_blocks, m, p_k + 1): the rows of a block themselves, or their upper
    triangular factor where this has fewer, zeros below; so m is at most p_k + 1. `torque_sum`
    (n_blocks, n) is the sum of tau. For any beta, `|tau_k - W_k beta|^2` is the sum over blocks of
    `|R_b (-beta, 1)|^2`, so every quadratic fit, its errors and its validation need nothing else.

    Source: Bierman, Factorization Methods for Discrete Sequential Estimation, 1977; the factor is
    built block by block (Golub & Van Loan, Matrix Computations, 2013, section 5.2; Demmel et al.,
    SIAM J. Sci. Comput. 34, 2012).
    """

    base: BaseParameters
    joint_names: tuple[str, ...]
    support: tuple[Indices, ...]
    factors: tuple[Array, ...]
    torque_sum: Array
    blocks: tuple[TimeBlock, ...]

    def __post_init__(self) -> None:
        for support, factor in zip(self.support, self.factors, strict=True):
            q = len(support) + 1
            blocks, m, columns = factor.shape
            if (blocks, columns) != (len(self.blocks), q) or m > q:
                raise ResultError(
                    f"factors of a joint with {q - 1} columns and {len(self.blocks)} blocks have"
                    f" shape {factor.shape}"
                )
            if not np.all(np.isfinite(factor)):
                raise IdentifiabilityError(
                    "samples hold NaN or infinite values",
                    cure=Cure("remove them from the recording", call="check_recording"),
                )
            factor.setflags(write=False)
        self.torque_sum.setflags(write=False)

    @property
    def n_joints(self) -> int:
        """Number of joints."""
        return len(self.joint_names)

    @property
    def n_blocks(self) -> int:
        """Number of time blocks."""
        return len(self.blocks)

    @property
    def n_samples(self) -> int:
        """Number of samples in all blocks; each gave one torque per joint."""
        return sum(block.n_samples for block in self.blocks)

    @property
    def duration(self) -> float:
        """Time that the blocks cover [s]."""
        return sum(block.stop - block.start for block in self.blocks)

    @property
    def sources(self) -> tuple[str, ...]:
        """The recordings, each once, in order."""
        return tuple(dict.fromkeys(block.source for block in self.blocks))

    @cached_property
    def joint_factors(self) -> tuple[Array, ...]:
        """Factor of all blocks together, per joint, shape (p_k + 1, p_k + 1).

        Of fewer samples than columns it is their rows, (m, p_k + 1).
        """
        return tuple(map(_reduce_blocks, self.factors))

    @cached_property
    def joint_grams(self) -> tuple[Array, ...]:
        """Inner products of the columns and the torque of each joint, shape (p_k + 1, p_k + 1)."""
        return tuple(factor.T @ factor for factor in self.joint_factors)

    @cached_property
    def has_torque(self) -> Mask:
        """Which joints have rows, shape (n,); those without a torque channel have none."""
        return np.array([bool(np.any(factor)) for factor in self.joint_factors])

    @property
    def mixed(self) -> bool:
        """Whether rows have a part of every joint's equation: reactions are projected away."""
        # A single joint has every parameter without any mixing.
        whole = all(len(support) == self.base.n_base for support in self.support)
        return whole and self.n_joints > 1 and self.base.n_base > 0

    @property
    def n_rows(self) -> int:
        """Number of torques: samples times joints that have torques."""
        return self.n_samples * int(np.count_nonzero(self.has_torque))

    @property
    def torque_energy(self) -> Array:
        """Sum of tau^2 over all samples, shape (n,)."""
        return np.array([factor[:, -1] @ factor[:, -1] for factor in self.joint_factors])

    def select(self, blocks: Sequence[int] | Array | Indices) -> SquareRootInformation:
        """Return the information of these blocks only; an index that comes twice counts twice.

        Raises `IdentifiabilityError` without any.
        """
        # Also of masks and negative numbers, as numpy indexes.
        chosen = np.arange(self.n_blocks)[np.asarray(blocks)]
        if chosen.size == 0:
            raise IdentifiabilityError(f"no block is selected; there are {self.n_blocks}")
        return replace(
            self,
            factors=tuple(factors[chosen] for factors in self.factors),
            torque_sum=self.torque_sum[chosen],
            blocks=tuple(self.blocks[b] for b in chosen),
        )

    def together(self) -> SquareRootInformation:
        """Return the information of all blocks as one, which takes the memory of one."""
        return replace(
            self,
            factors=tuple(factor[None] for factor in self.joint_factors),
            torque_sum=self.torque_sum.sum(axis=0, keepdims=True),
            blocks=(TimeBlock.spanning(self.blocks),),
        )

    def less(self, torques: Sequence[Array]) -> SquareRootInformation:
        """Return the information of `tau_k - W_k x_k`, with x_k (p_k,) in `torques`.

        `torque_sum` stays the sum of the torque itself.
        """
        factors = []
        for own, x in zip(self.factors, torques, strict=True):
            changed = own.copy()
            # The torque column is replaced; R stays triangular but for that column, as every use
            # allows.
            changed[:, :, -1] -= own[:, :, :-1] @ x
            factors.append(changed)
        return replace(self, factors=tuple(factors))

    def merge(self, *others: SquareRootInformation) -> SquareRootInformation:
        """Return the information of this and other recordings of the same robot.

        Raises `IdentifiabilityError` if joints or base parameters differ.
        """
        for other in others:
            if other.base.names != self.base.names or other.joint_names != self.joint_names:
                raise IdentifiabilityError(
                    f"information of {other.base.robot} with drive terms {other.base.drive}"
                    f" ({other.base.n_base} parameters) cannot be merged with information of"
                    f" {self.base.robot} with drive terms {self.base.drive} ({self.base.n_base}"
                    " parameters)"
                )
        parts = (self, *others)
        return replace(
            self,
            factors=tuple(
                stack_blocks([block for factors in own for block in factors])
                for own in zip(*(part.factors for part in parts), strict=True)
            ),
            torque_sum=np.concatenate([part.torque_sum for part in parts]),
            blocks=tuple(block for part in parts for block in part.blocks),
        )

    @cached_property
    def motion_groups(self) -> dict[tuple[int, bytes], list[Indices]]:
        """Groups of blocks of like motion that were found, by their number and weights."""
        return {}

    @cached_property
    def _known(self) -> dict[tuple[int | None, bytes], Array]:
        """Factors by block and weights: many questions are asked with one set of weights."""
        return {}

    def stacked(self, weights: ArrayLike | None = None, block: int | None = None) -> Array:
        """Return the factor (p + 1, p + 1) of all joints' rows, joint k times `weights[k]` or 1.

        With `block` it is the factor of one time block.
        """
        w = np.ones(self.n_joints) if weights is None else np.asarray(weights, dtype=np.float64)
        # By value: arrays of weights are made anew by each caller.
        known = block, w.tobytes()
        if known not in self._known:
            factors = self.joint_factors if block is None else [own[block] for own in self.factors]
            parts = [
                (support, weight * factor)
                for support, factor, weight in zip(self.support, factors, w, strict=True)
            ]
            factor = stack_factors(parts, self.base.n_base)
            # Factors of every block with one set of weights, or what memory has room for.
            if len(self._known) > min(2 * MOST_BLOCKS, MOST_KNOWN // factor.nbytes):
                self._known.clear()
            self._known[known] = factor
            self._known[known].setflags(write=False)
        return self._known[known]

    def rows_of_block(self, block: int, weights: Array) -> Array:
        """Return all joints' rows of a block in all columns, (m, p + 1), k times `weights[k]`."""
        p = self.base.n_base
        own = [factors[block] for factors in self.factors]
        rows = np.zeros((sum(map(len, own)), p + 1))
        first = 0
        for support, factor, weight in zip(self.support, own, weights, strict=True):
            rows[first : first + len(factor), np.append(support, p)] = weight * factor
            first += len(factor)
        return rows

    def multiply_block(self, block: int, weights: Array, matrix: Array) -> Array:
        """Return the rows of `rows_of_block` times a matrix (p + 1, r), (m, r)."""
        p = self.base.n_base
        parts = zip(self.support, self.factors, weights, strict=True)
        # Joint by joint: of a robot with many columns a joint has few.
        return np.concatenate(
            [
                weight * (own[block] @ matrix[np.append(support, p)])
                for support, own, weight in parts
            ]
        )

    def summed(self, weights: Array) -> Array:
        """Return the inner products (p + 1, p + 1) of all rows, of joint k times `weights[k]`^2.

        They have half of the digits of the factor that `stacked` returns.
        """
        return self.sum_grams(self.joint_grams, weights)

    def sum_grams(self, grams: Sequence[Array], weights: Array) -> Array:
        """Return the sum of inner products (p_k + 1, p_k + 1) of joints, in all columns."""
        p = self.base.n_base
        total = np.zeros((p + 1, p + 1))
        for spans, gram, weight in zip(self._spans, grams, weights, strict=True):
            weighted = weight**2 * gram
            for rows, own_rows in spans:
                for columns, own_columns in spans:
                    total[rows, columns] += weighted[own_rows, own_columns]
        return total

    def spent(self, weights: Array, covariance: Array) -> Array:
        """Return the trace of each joint's part of the hat matrix (n,), by squares.

        `covariance` (p, p) is the inverse of the weighted normal equations.
        """
        p = self.base.n_base
        # The torque's row and column are no part of it.
        wide = np.zeros((p + 1, p + 1))
        wide[:p, :p] = covariance
        traces = np.zeros(self.n_joints)
        for k, (spans, gram) in enumerate(zip(self._spans, self.joint_grams, strict=True)):
            for rows, own_rows in spans:
                for columns, own_columns in spans:
                    part = np.einsum("ij,ij->", gram[own_rows, own_columns], wide[rows, columns])
                    traces[k] += part
        return np.asarray(weights**2 * traces)

    @cached_property
    def _spans(self) -> tuple[tuple[tuple[slice, slice], ...], ...]:
        """Spans of neighbouring columns and torque of each joint, among all and among its own."""
        p = self.base.n_base
        return tuple(_find_spans(np.append(support, p)) for support in self.support)

    def residual_energy(self, beta: ArrayLike) -> Array:
        """Return `|tau_k - W_k beta|^2` for every joint, shape (n,).

        Raises `IdentifiabilityError` for a beta of another shape than (p,).
        """
        values = np.asarray(beta, dtype=np.float64)
        if values.shape != (self.base.n_base,):
            raise IdentifiabilityError(
                f"{self.base.robot} has {self.base.n_base} base parameters, got shape"
                f" {values.shape}"
            )
        errors = [
            factor @ np.append(-values[s], 1.0)
            for s, factor in zip(self.support, self.joint_factors, strict=True)
        ]
        return np.array([error @ error for error in errors])


def accumulate(
    model: RobotModel,
    base: BaseParameters,
    samples: Samples,
    *,
    block_seconds: float | None = None,
    threads: int | None = None,
) -> SquareRootInformation:
    """Reduce samples to their square-root information in one pass, as `accumulate_stream` does."""
    return accumulate_stream(model, base, (samples,), block_seconds=block_seconds, threads=threads)


@use_one_blas_thread()
def accumulate_stream(
    model: RobotModel,
    base: BaseParameters,
    stream: Iterable[Samples],
    *,
    block_seconds: float | None = None,
    threads: int | None = None,
    further: FurtherColumns | None = None,
    kept: KeptRows | None = None,
) -> SquareRootInformation:
    """Reduce a stream of samples to their square-root information, in bounded memory.

    Parameters
    ----------
    model, base
        The robot and its base parameters.
    stream
        Samples of recordings or of chunks of one. `Samples.parallel` filters regressor columns and
        torque alike, segment by segment, and leaves out its margin at both ends of each.
    block_seconds
        Length of a time block [s], by default 5, less for short recordings. Neighbours are merged
        beyond 256 blocks.
    threads
        Threads that share the blocks, by default one per core; the result does not depend on it.
    further
        Further columns, whose inner products it gathers in the same pass.
    kept
        Rows that are kept for others who ask for the same ones.

    Raises
    ------
    IdentifiabilityError
        If nothing is left after filtering, or the joints differ from the model's.
    """
    spare_rows = 1 + (further.count if further else 0)
    plan = RegressorPlan.of(model, base.drive, base.columns, spare_rows=spare_rows)
    gathered = _Gathering()
    pending: deque[Future[_Reduced]] = deque()

    def gather_next() -> None:
        block = pending.popleft().result()
        gathered.add(block)
        if further is not None:
            further.add(block.products)

    workers = choose_threads(threads, count_cores())
    with ThreadPoolExecutor(max_workers=workers) as pool:
        for part in divide_into_blocks(model, stream, block_seconds, kept):
            pending.append(pool.submit(_reduce_block, plan, part, further))
            # The longest block decides which neighbours merge.
            gathered.seconds = max(gathered.seconds, part.seconds)
            # Bounded, so that blocks wait in memory twice per thread at most; in order, so that
            # sums agree.
            if len(pending) > 2 * workers:
                gather_next()
        while pending:
            gather_next()
    if not gathered.blocks:
        raise IdentifiabilityError(
            f"no samples of {model.name} are left: every contiguous segment is shorter than the"
            " filter needs",
            cure=Cure("record longer, raise the cutoff, or filter less"),
        )
    return gathered.information(base, model.joint_names, plan.support)


@use_one_blas_thread()
def reduce_rows(
    base: BaseParameters,
    joint_names: tuple[str, ...],
    support: Sequence[Indices],
    blocks: Iterable[RowBlock],
) -> SquareRootInformation:
    """Reduce rows of an estimator, such as reweighted ones; joint k has columns `support[k]`."""
    gathered = _Gathering()
    for block in blocks:
        gathered.seconds = max(gathered.seconds, block.seconds)
        torque_sum = np.array([rows[-1].sum() for rows in block.rows])
        factors = tuple(map(shorten_columns, block.rows))
        gathered.add(_Reduced(factors, torque_sum, block.time))
    return gathered.information(base, joint_names, tuple(support))


@dataclass(frozen=True, slots=True, eq=False)
class _Reduced:
    factors: tuple[Array, ...]
    torque_sum: Array
    time: TimeBlock
    products: tuple[Array, ...] = ()


def _reduce_block(
    plan: RegressorPlan, part: SampleBlock, further: FurtherColumns | None
) -> _Reduced:
    growing = [
        GrowingFactor(len(own) + 1, min(ROWS_AT_ONCE, part.n_outputs)) for own in plan.support
    ]
    torque_sum = np.zeros(plan.model.n_joints)
    m = further.count if further else 0
    q = part.samples.q
    products = tuple(np.zeros((len(own) + 1 + m, m)) for own in plan.support)
    columns = None if further is None else lambda span: further.columns(q[span])
    for chunk in part.chunks(plan, columns):
        for k, rows in enumerate(chunk):
            torque_sum[k] += rows[-1].sum()
            # Products with the further columns, which stand before the torque in a chunk.
            products[k][:] += rows @ rows[-1 - m : -1].T
            growing[k].append(np.concatenate([rows[: -1 - m], rows[-1:]]) if m else rows)
    for product in products:
        # Torque before further columns, the order that the products are read in.
        product[:] = np.concatenate([product[: -1 - m], product[-1:], product[-1 - m : -1]])
    return _Reduced(tuple(each.shortest() for each in growing), torque_sum, part.time, products)


class _Gathering:
    """Keep the blocks in order, merging neighbours if there are too many."""

    def __init__(self) -> None:
        self.blocks: list[_Reduced] = []
        self.seconds = 0.0

    def add(self, block: _Reduced) -> None:
        if self.blocks and _is_successor(self.blocks[-1].time, block.time, self.seconds):
            self.blocks[-1] = _merge_blocks(self.blocks[-1], block)
        else:
            self.blocks.append(block)
        if len(self.blocks) > 2 * MOST_BLOCKS:
            # Blocks of twice the length: all are added again, and each joins its neighbour.
            self.seconds *= 2.0
            blocks = self.blocks
            self.blocks = []
            for each in blocks:
                self.add(each)

    def information(
        self, base: BaseParameters, joint_names: tuple[str, ...], support: tuple[Indices, ...]
    ) -> SquareRootInformation:
        """Return all blocks as one."""
        return SquareRootInformation(
            base,
            joint_names,
            support,
            tuple(map(stack_blocks, zip(*(block.factors for block in self.blocks), strict=True))),
            np.array([block.torque_sum for block in self.blocks]),
            tuple(block.time for block in self.blocks),
        )


def _find_spans(places: Indices) -> tuple[tuple[slice, slice], ...]:
    """Return spans of consecutive places, and where each lies among them."""
    edges = [0, *(np.flatnonzero(np.diff(places) != 1) + 1).tolist(), len(places)]
    return tuple(
        (slice(int(places[first]), int(places[first]) + last - first), slice(first, last))
        for first, last in pairwise(edges)
    )


def _reduce_blocks(factors: Array) -> Array:
    """Return the rows of all blocks (B, m, q) together, or their triangular factor if shorter."""
    only = factors[0]
    if len(factors) == 1 and is_triangular(only):
        # Signs of the rows are arbitrary, as in any triangular factor.
        return np.asarray(only * np.where(np.diag(only) < 0.0, -1.0, 1.0)[:, None])
    return shorten_rows(factors.reshape(-1, factors.shape[-1]))


def _is_successor(earlier: TimeBlock, later: TimeBlock, seconds: float) -> bool:
    # Length of a merged block in block lengths; segments are cut into equal parts of other lengths.
    return earlier.source == later.source and 0.0 < later.stop - earlier.start <= 1.2 * seconds


def _merge_blocks(earlier: _Reduced, later: _Reduced) -> _Reduced:
    pairs = zip(earlier.factors, later.factors, strict=True)
    return _Reduced(
        tuple(shorten_rows(np.vstack(pair)) for pair in pairs),
        earlier.torque_sum + later.torque_sum,
        TimeBlock.spanning((earlier.time, later.time)),
    )
