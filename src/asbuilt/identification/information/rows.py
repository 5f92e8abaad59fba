"""Rows of identification: filtered regressor columns and torque of each joint by time block."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice, pairwise
from threading import Lock

import numpy as np

from asbuilt.arrays import Array, Indices, Mask
from asbuilt.description.model import RobotModel
from asbuilt.description.rotation import find_axes_across
from asbuilt.dynamics import BaseParameters, gravity_torque
from asbuilt.dynamics.regressor import RegressorPlan
from asbuilt.errors import IdentifiabilityError
from asbuilt.experiment.signal.samples import Samples
from asbuilt.identification.information.triangular import shorten_columns


@dataclass(slots=True, eq=False)
class FurtherColumns:
    """Gather `[W_k | tau_k | T_k]^T T_k` of further columns T of every joint k, in order of time.

    T are the torques of the links by design under gravity `g x axis` for the two axes across
    gravity: the torque of a base tilted by an angle [rad] about an axis, to first order. With the
    factors of `[W_k | tau_k]` a change of the tilt can be estimated like one of any parameter.

    Parameters
    ----------
    models
        The robot under each tilted gravity.
    products
        The inner products of each joint, (p_k + 1 + m, m), m = 2; empty before the first block.
    """

    models: tuple[RobotModel, ...]
    products: list[Array] = field(default_factory=list)

    @classmethod
    def tilts(cls, model: RobotModel) -> FurtherColumns:
        """Return the columns of two base tilts."""
        axes = find_axes_across(model.gravity)
        return cls(tuple(model.with_gravity(np.cross(model.gravity, axis)) for axis in axes))

    @property
    def count(self) -> int:
        """Number of columns m."""
        return len(self.models)

    def columns(self, q: Array) -> Sequence[Array]:
        """Return the columns of positions (L, n), each (L, n), before filtering."""
        return [gravity_torque(model, q) for model in self.models]

    def add(self, products: Sequence[Array]) -> None:
        """Add the inner products of the next time block."""
        if not self.products:
            # Sizes are known from the first block on.
            self.products = [np.zeros_like(product) for product in products]
        self.products = [a + b for a, b in zip(self.products, products, strict=True)]


@dataclass(frozen=True, slots=True)
class RowRules:
    """Hold how a recording is divided into blocks, and how much of it is held."""

    samples_at_once: int = 2048
    """Samples, before filtering, whose regressor is held at once."""
    shortest_block: float = 1.0
    """Shortest time block [s]."""
    usual_blocks: int = 10
    """Blocks of a short recording, so that standard errors can be estimated from them."""
    most_held: float = 25e6
    """Memory [bytes] of rows that are kept between passes; more are made again in every pass."""
    usual_joints: int = 12
    """Joints up to which that holds; rows of more joints take more memory and time to make."""

    def room_for(self, n_joints: int) -> float:
        """Return the memory [bytes] of rows that are kept of a robot."""
        return self.most_held * max(1.0, n_joints / self.usual_joints)


ROWS = RowRules()
LONGEST_BLOCK = 5.0
"""Default length of a time block [s]."""


@dataclass(frozen=True, slots=True)
class TimeBlock:
    """Describe a block: recording, first and last instant [s], number of samples."""

    source: str
    start: float
    stop: float
    n_samples: int

    @classmethod
    def spanning(cls, blocks: Sequence[TimeBlock]) -> TimeBlock:
        """Return neighbouring blocks as one."""
        n_samples = sum(block.n_samples for block in blocks)
        return cls(blocks[0].source, blocks[0].start, blocks[-1].stop, n_samples)


class KeptRows:
    """Keep the filtered rows of samples, so that those who share it walk over a motion once.

    Rows depend on robot, drive terms and samples alone, neither on time blocks nor on what else is
    asked of them. The latest are kept, as many as `ROWS.room_for` the robot holds.
    """

    def __init__(self) -> None:
        self._entries: list[tuple[RegressorPlan, Samples, dict[int, tuple[Array, ...]]]] = []
        self._lock = Lock()

    def find(self, plan: RegressorPlan, samples: Samples) -> dict[int, tuple[Array, ...]] | None:
        """Return `[W_k | tau_k]^T` of each joint by the start of a segment; None if they are many.

        Rows from which reactions are projected depend on more, and are not kept.
        """
        # Eight bytes a number, torque included.
        size = 8.0 * samples.n_filtered * sum(len(own) + 1 for own in plan.support)
        if samples.reactions or size > ROWS.room_for(plan.model.n_joints):
            return None
        with self._lock:  # blocks of one motion are asked for by several threads
            for entry in self._entries:
                # Identity, not equality: comparing samples costs as much as the rows.
                if entry[1] is samples and _same_columns(entry[0], plan):
                    return entry[2]
            rows = _evaluate_rows(plan, samples)
            self._entries.append((plan, samples, rows))
            # The oldest go first: passes ask for the latest motions again.
            most = ROWS.room_for(plan.model.n_joints)
            while sum(_count_bytes(each) for *_, each in self._entries) > most:
                del self._entries[0]
            return rows


def _count_bytes(segments: dict[int, tuple[Array, ...]]) -> int:
    return sum(rows.nbytes for segment in segments.values() for rows in segment)


def _same_columns(one: RegressorPlan, other: RegressorPlan) -> bool:
    """Return whether two plans have the same rows but for spare ones."""
    alike = one.model is other.model and one.drive == other.drive
    return alike and np.array_equal(one.columns, other.columns)


def _evaluate_rows(plan: RegressorPlan, samples: Samples) -> dict[int, tuple[Array, ...]]:
    """Return the rows of whole segments, each by its start."""
    # One spare row for the torque: further columns are inserted into copies.
    plan = RegressorPlan.of(plan.model, plan.drive, plan.columns, spare_rows=1)
    found = {}
    for start, stop in samples.segments:
        parallel = samples.parallel
        n = parallel.n_outputs(stop - start) if parallel else stop - start
        if n < 1:
            continue
        whole = SampleBlock(samples, start, stop, 0, n, 0.0)
        found[start] = whole.rows(plan)
    return found


@dataclass(frozen=True, slots=True, eq=False)
class SampleBlock:
    """Hold a time block: outputs `first` to `last` of the segment from `start` to `stop`."""

    samples: Samples
    start: int
    stop: int
    first: int
    last: int
    seconds: float
    kept: KeptRows | None = None

    @property
    def n_outputs(self) -> int:
        """Number of filtered samples."""
        return self.last - self.first

    @property
    def time(self) -> TimeBlock:
        """Time and number of samples."""
        t = self.samples.t[self.start : self.stop]
        parallel = self.samples.parallel
        t = parallel.times(t) if parallel else t
        return TimeBlock(
            self.samples.source, float(t[self.first]), float(t[self.last - 1]), self.n_outputs
        )

    def _insert(
        self, rows: Sequence[Array], further: Sequence[Array], span: slice
    ) -> tuple[Array, ...]:
        """Return rows with further columns (L, n) of their span placed before the torque."""
        filtered = [self._filter(each) for each in further]
        speed = np.abs(self._filter(self.samples.qd[span])) if self.samples.slowest else ()
        found = []
        for k, own in enumerate(rows):
            added = np.array([each[k] for each in filtered]).reshape(-1, own.shape[1])
            # Rows of a resting joint are zero in every column, further ones too.
            if self.samples.slowest:
                added[:, speed[k] < self.samples.slowest[k]] = 0.0
            found.append(np.concatenate([own[:-1], added, own[-1:]]))
        return tuple(found)

    def touches(self, samples: Mask) -> Mask:
        """Return which filtered samples (n_outputs,) have a part in any of some samples (N,)."""
        parallel = self.samples.parallel
        step, width = (parallel.decimation, parallel.taps.size) if parallel else (1, 1)
        begin = step * np.arange(self.n_outputs)
        first = self.start + step * self.first
        # Of this block alone: what is counted of a long recording for each of its blocks adds up.
        counted = np.cumsum(samples[first : first + step * (self.n_outputs - 1) + width])
        # How many come before each place: a window has none if both its ends count the same.
        before = np.concatenate([[0], counted])
        return np.asarray(before[begin + width] != before[begin])

    def filtered(self, values: Callable[[slice], Array]) -> Array:
        """Return filtered values (n, n_outputs) of what is given (m, n) on a span of samples.

        As in `chunks`, they are zero where a joint moves slower than `samples.slowest`.
        """
        samples = self.samples
        parallel = self.samples.parallel
        step, width = (parallel.decimation, parallel.taps.size) if parallel else (1, 1)
        # The window of the filter reaches beyond the last output by its width.
        span = slice(self.start + self.first * step, self.start + (self.last - 1) * step + width)
        rows = self._filter(values(span))
        if samples.slowest:
            slow = np.abs(self._filter(samples.qd[span])) < np.array(samples.slowest)[:, None]
            rows = np.where(slow, 0.0, rows)
        return rows

    def _filter(self, values: Array) -> Array:
        """Filter values of consecutive samples (m, n), giving (n, n_outputs)."""
        parallel = self.samples.parallel
        return parallel.apply(np.ascontiguousarray(values.T)) if parallel else values.T

    def rows(
        self, plan: RegressorPlan, further: Callable[[slice], Sequence[Array]] | None = None
    ) -> tuple[Array, ...]:
        """Return the rows of all chunks together, (p_k + 1, n_outputs) of each joint."""
        # A chunk is a view of the buffer that the next one overwrites.
        chunks = [tuple(rows.copy() for rows in chunk) for chunk in self.chunks(plan, further)]
        return tuple(map(np.hstack, zip(*chunks, strict=True)))

    def chunks(
        self, plan: RegressorPlan, further: Callable[[slice], Sequence[Array]] | None = None
    ) -> Iterator[tuple[Array, ...]]:
        """Yield the filtered rows `[W_k | tau_k]^T` of each joint, (p_k + 1, m), in chunks.

        A chunk is valid until the next. Rows of a joint that moves slower than `samples.slowest`
        are zero. Where reactions are projected away, rows are in units of their noise.
        `further` returns more columns of a span of samples, each (L, n), placed before the torque;
        `plan` has a spare row for each and one more.
        """
        samples = self.samples
        parallel = self.samples.parallel
        step, width = (parallel.decimation, parallel.taps.size) if parallel else (1, 1)
        # Of decimated samples the windows overlap: fewer outputs fit a chunk.
        at_once = min(self.n_outputs, max(1, (ROWS.samples_at_once - width) // step + 1))
        known = None if self.kept is None else self.kept.find(plan, samples)
        if known is not None:
            rows = known[self.start]
            for first in range(self.first, self.last, at_once):
                last = min(first + at_once, self.last)
                span = slice(self.start + first * step, self.start + (last - 1) * step + width)
                parts = tuple(row[:, first:last] for row in rows)
                yield self._insert(parts, further(span), span) if further else parts
            return
        buffer = plan.buffer((at_once - 1) * step + width)
        output = plan.buffer(at_once) if parallel else buffer
        for first in range(self.first, self.last, at_once):
            last = min(first + at_once, self.last)
            span = slice(self.start + first * step, self.start + (last - 1) * step + width)
            rows = plan.evaluate(samples.q[span], samples.qd[span], samples.qdd[span], buffer)
            # Further columns before the torque, filled from the last spare row back.
            last_rows = (*(further(span) if further else ()), samples.tau[span])
            for k, columns in enumerate(rows):
                for place, values in enumerate(last_rows, start=-len(last_rows)):
                    columns[place] = values[:, k]
            samples.reactions.at(span).project_rows(plan.model, samples.q[span], rows, buffer)
            filtered = rows
            if parallel:
                parallel.apply(buffer[:, : span.stop - span.start], out=output[:, : last - first])
                filtered = plan.joint_rows(output, last - first)
            if samples.slowest:
                speed = np.abs(self._filter(samples.qd[span]))
                for columns, own, slowest in zip(filtered, speed, samples.slowest, strict=True):
                    # Friction near reversals is no function of the velocity: these rows do not
                    # count.
                    columns[:, own < slowest] = 0.0
            yield filtered


def divide_into_blocks(
    model: RobotModel,
    stream: Iterable[Samples],
    block_seconds: float | None = None,
    kept: KeptRows | None = None,
) -> Iterator[SampleBlock]:
    """Yield the time blocks of samples, each within one contiguous segment.

    Their rows come from those `kept`, if they are given.

    Raises `IdentifiabilityError` if the joints differ from the model's.
    """
    for samples in stream:
        if samples.joint_names != model.joint_names:
            raise IdentifiabilityError(
                f"samples of {samples.source} have joints {', '.join(samples.joint_names)},"
                f" {model.name} has {', '.join(model.joint_names)}; read the recording with"
                " model=..., which matches joints by name"
            )
        rate = samples.parallel.output_rate if samples.parallel else samples.rate
        usual = samples.n_filtered / rate / ROWS.usual_blocks
        seconds = block_seconds or float(np.clip(usual, ROWS.shortest_block, LONGEST_BLOCK))
        for start, stop in samples.segments:
            n = samples.parallel.n_outputs(stop - start) if samples.parallel else stop - start
            if n < 1:
                continue
            # Equal blocks, rather than a short rest whose scores would scatter more.
            edges = np.linspace(0, n, max(1, round(n / rate / seconds)) + 1).round().astype(int)
            for first, last in pairwise(edges.tolist()):
                yield SampleBlock(samples, start, stop, first, last, seconds, kept)


@dataclass(frozen=True, slots=True, eq=False)
class RowBlock:
    """Hold the rows of a time block: columns and, last, torque of each joint, (p_k + 1, N_b)."""

    rows: tuple[Array, ...]
    time: TimeBlock
    seconds: float


class Rows:
    """Iterate over the rows of samples block by block, any number of times.

    `support[k]` are the base parameters of joint k's columns. Few rows are kept in memory between
    passes. `every` n takes each n-th block alone. The torque of parameters `less[k]` (p_k,) of each
    joint is taken from its torque, if they are given.
    """

    def __init__(
        self,
        model: RobotModel,
        base: BaseParameters,
        samples: Iterable[Samples],
        block_seconds: float | None = None,
        every: int = 1,
        less: Sequence[Array] = (),
        kept: KeptRows | None = None,
    ) -> None:
        self._less = less
        self._kept = kept
        self._plan = RegressorPlan.of(model, base.drive, base.columns, spare_rows=1)
        self._samples = samples
        self._block_seconds = block_seconds
        self._every = every
        self._held: list[RowBlock] | None = None
        self._parts: list[tuple[Array, ...]] | None = None
        self._roots: list[tuple[Array, ...]] | None = None
        self.support: tuple[Indices, ...] = self._plan.support

    def take_torque(self, samples: Sequence[Samples]) -> bool:
        """Take the torque of other samples in place, if they are of the very motion that is kept.

        Return whether they are.
        """
        if (
            self._held is None
            or self._less
            or not all(map(_same_motion, tuple(self._samples), samples))
        ):
            # Rows of another motion cannot take its torque.
            return False
        for part, block in zip(self._divide(samples), self._held, strict=True):
            torques = part.filtered(part.samples.tau.__getitem__)
            for rows, torque in zip(block.rows, torques, strict=True):
                rows[-1] = torque
        self._samples = samples
        self._parts = None
        return True

    def _divide(self, samples: Iterable[Samples]) -> Iterator[SampleBlock]:
        """Return the time blocks that are used."""
        blocks = divide_into_blocks(self._plan.model, samples, self._block_seconds, self._kept)
        return islice(blocks, 0, None, self._every)

    @property
    def are_kept(self) -> bool:
        """Whether the rows are held in memory, as they are after a first pass if they are few."""
        return self._held is not None

    def roots(self) -> list[tuple[Array, ...]]:
        """Return rows (m, p_k) with the squares of W_k, of every block and joint, few of them.

        Another torque leaves them as they are.
        """
        if self._roots is None:
            self._roots = [
                tuple(shorten_columns(rows[:-1]) for rows in block) for block in self.by_block()
            ]
        return self._roots

    def parts(self) -> Iterator[tuple[Array, ...]]:
        """Return the rows of the joints in few parts, the same every time: one if they are kept."""
        if self._parts is None:
            # A pass over the rows keeps them if they are few.
            deque(self, maxlen=0)
            every = zip(*(each.rows for each in self._held or ()), strict=True)
            self._parts = [tuple(map(np.hstack, every))] if self._held else []
        return iter(self._parts or self.by_block())

    def by_block(self) -> Iterator[tuple[Array, ...]]:
        """Yield the rows of the joints, block by block."""
        yield from (each.rows for each in self)

    def __iter__(self) -> Iterator[RowBlock]:
        if self._held is not None:
            yield from self._held
            return
        kept = list[RowBlock]()
        size = 0
        most = ROWS.room_for(self._plan.model.n_joints)
        for part in self._divide(self._samples):
            block = RowBlock(part.rows(self._plan), part.time, part.seconds)
            for rows, x in zip(block.rows, self._less, strict=False):
                rows[-1] -= x @ rows[:-1]
            size += sum(rows.nbytes for rows in block.rows)
            # Past the limit nothing is kept, not even the blocks before: rows of a long recording
            # are made again in every pass.
            kept = [*kept, block] if size <= most else []
            yield block
        self._held = kept if size <= most else None


def _same_motion(one: Samples, other: Samples) -> bool:
    """Return whether samples differ at most by their torque, without reactions."""
    pairs = zip(
        (one.t, one.q, one.qd, one.qdd), (other.t, other.q, other.qd, other.qdd), strict=True
    )
    alike = one.segments == other.segments and one.slowest == other.slowest
    alike &= one.parallel is other.parallel and not (one.reactions or other.reactions)
    return alike and all(np.array_equal(x, y) for x, y in pairs)
