"""Normal equations: all that a question about squares of residuals asks of a recording."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from asbuilt.arrays import Array, Indices
from asbuilt.identification.information.rows import TimeBlock

MODEL = "model"
"""Group of the columns of base parameters, which comes first."""


class _GroupedColumns:
    """Count the joints, time blocks and columns of what has columns in named groups."""

    groups: Mapping[str, int]
    support: tuple[Indices, ...]
    blocks: tuple[TimeBlock, ...]

    @property
    def n_joints(self) -> int:
        """Number of joints."""
        return len(self.support)

    @property
    def n_blocks(self) -> int:
        """Number of time blocks."""
        return len(self.blocks)

    @property
    def n_columns(self) -> int:
        """Number of columns P of all groups."""
        return sum(self.groups.values())


@dataclass(frozen=True, eq=False)
class Equations(_GroupedColumns):
    """Hold the Gram matrices of the rows `[A_k | y_k]` of every joint k and time block b.

    The P columns of A stand in named groups of so many each, such as the model's own and those of
    effects that it may lack; joint k has the columns `support[k]`. `grams[k]` (B, s_k + 1, s_k + 1)
    ends with the torque y. `counts` (n, B) are the rows that count. For any x (P,),
    `|y_k - A_k x|^2` is a form in these, and so is every fit, its errors and its validation.

    Squares lose half of the digits that rows have: what needs them, such as the rank of a
    recording, takes `SquareRootInformation`.
    """

    groups: Mapping[str, int]
    support: tuple[Indices, ...]
    grams: tuple[Array, ...]
    blocks: tuple[TimeBlock, ...]
    counts: Array

    @property
    def lengths(self) -> Array:
        """Samples of each block (B,)."""
        return np.array([block.n_samples for block in self.blocks], dtype=np.float64)

    def in_model(self, k: int) -> Indices:
        """Return which columns of the model joint k has."""
        return np.asarray(self.support[k][self.support[k] < self.groups[MODEL]])

    @cached_property
    def of_joints(self) -> tuple[Array, ...]:
        """Gram matrices of each joint over all blocks."""
        return tuple(gram.sum(axis=0) for gram in self.grams)

    def of_joint(self, k: int, weight: Array) -> Array:
        """Return the Gram matrix of joint k over all blocks, which weigh (B,)."""
        return np.asarray(np.tensordot(weight, self.grams[k], 1))

    def stacked(self, weights: Array) -> Array:
        """Return the sum over joints, (P + 1, P + 1), of joint k times `weights[k]`^2."""
        total = np.zeros((self.n_columns + 1,) * 2)
        for k, support in enumerate(self.support):
            gram = self.of_joints[k]
            places = np.append(support, self.n_columns)
            # Columns first, then whole rows: places by pairs would take five times as long.
            wide = np.zeros((len(places), self.n_columns + 1))
            wide[:, places] = weights[k] ** 2 * gram
            total[places] += wide
        return total

    def energies(self, k: int, ends: Array) -> Array:
        """Return the square of a combination (s_k + 1,) of joint k's rows in each block, (B,)."""
        squares = np.einsum("i,bij,j->b", ends, self.grams[k], ends)
        return np.asarray(np.maximum(squares, 0.0))

    def energy(self, x: Array, torque: float = 1.0) -> Array:
        """Return `|torque y_k - A_k x|^2` of every joint over all blocks, (n,)."""
        ends = [np.append(-x[support], torque) for support in self.support]
        squares = [y @ gram @ y for y, gram in zip(ends, self.of_joints, strict=True)]
        return np.asarray(np.maximum(squares, 0.0))

    def together(self) -> Equations:
        """Return the equations of all blocks as one."""
        return replace(
            self,
            grams=tuple(gram[None] for gram in self.of_joints),
            blocks=(TimeBlock.spanning(self.blocks),),
            counts=self.counts.sum(axis=1, keepdims=True),
        )

    def merge(self, *others: Equations) -> Equations:
        """Return the blocks of these and other equations in the same columns."""
        parts = (self, *others)
        return replace(
            self,
            grams=tuple(map(np.concatenate, zip(*(part.grams for part in parts), strict=True))),
            blocks=tuple(block for part in parts for block in part.blocks),
            counts=np.concatenate([part.counts for part in parts], axis=1),
        )


@dataclass(frozen=True, eq=False)
class BlockRows(_GroupedColumns):
    """Hold the rows `[A_k | y_k]` of every joint k and time block b, or fewer of equal squares.

    Columns and groups are those of `Equations`. `rows[k]` has shape (B, m, s_k + 1), the torque
    last: the samples of a block, or their triangular factor where these are more than the columns;
    rows of zeros fill up shorter blocks. Blocks of a robot of many joints have far fewer samples
    than columns, so that rows take a small part of the memory and the time of their squares.
    """

    groups: Mapping[str, int]
    support: tuple[Indices, ...]
    rows: tuple[Array, ...]
    blocks: tuple[TimeBlock, ...]

    @property
    def n_samples(self) -> int:
        """Number of samples of all blocks."""
        return sum(block.n_samples for block in self.blocks)

    @cached_property
    def places(self) -> Indices:
        """Where joint k has each column and the torque, (n, P + 1), -1 where it does not."""
        places = np.full((self.n_joints, self.n_columns + 1), -1)
        for own, support in zip(places, self.support, strict=True):
            own[np.append(support, self.n_columns)] = np.arange(len(support) + 1)
        return places

    def among(self, columns: Indices) -> BlockRows:
        """Return the rows of some columns alone, which are numbered as before, and the torque."""
        kept = [np.flatnonzero(np.isin(support, columns)) for support in self.support]
        own = zip(self.rows, self.support, kept, strict=True)
        return replace(
            self,
            support=tuple(s[k] for s, k in zip(self.support, kept, strict=True)),
            rows=tuple(rows[..., np.append(k, len(s))] for rows, s, k in own),
        )

    def product(self, k: int, columns: Indices, coefficients: Array) -> Array:
        """Return joint k's rows (B, m, ...) times coefficients (c, ...) of some columns."""
        own = self.places[k, columns]
        there = own >= 0
        return np.asarray(self.rows[k][:, :, own[there]] @ coefficients[there])

    def inner(
        self, weights: Array, left: Indices, right: Indices, blocks: Indices | None = None
    ) -> Array:
        """Return inner products (l, r) of columns over all joints, k times `weights[k]`^2.

        They are over all blocks or some.
        """
        total = np.zeros((len(left), len(right)))
        for own, rows, weight in zip(self.places, self.rows, weights, strict=True):
            flat = rows if blocks is None else rows[blocks]
            flat = weight * flat.reshape(-1, rows.shape[-1])
            rows_at = np.flatnonzero(own[left] >= 0)
            columns_at = np.flatnonzero(own[right] >= 0)
            one = flat[:, own[left[rows_at]]]
            # Squares of one array take half of the time.
            other = one if left is right else flat[:, own[right[columns_at]]]
            total[np.ix_(rows_at, columns_at)] += one.T @ other
        return total

    def squares(self, weights: Array) -> Squares:
        """Return the inner products of all columns."""
        joints = np.count_nonzero(self.places >= 0, axis=0)
        # The model's columns and the torque belong to every row that may have them.
        shared = joints != 1
        shared[: self.groups[MODEL]] = True
        shared[-1] = True
        shared_place = np.where(shared, np.cumsum(shared) - 1, -1)
        crossed = np.zeros((int(shared.sum()), self.n_columns + 1))
        local = []
        for support, rows, weight in zip(self.support, self.rows, weights, strict=True):
            flat = weight * rows.reshape(-1, rows.shape[-1])
            columns = np.append(support, self.n_columns)
            common = shared[columns]
            crossed[np.ix_(shared_place[columns[common]], columns)] += flat[:, common].T @ flat
            alone = flat[:, ~common]
            local.append((columns[~common], alone.T @ alone))
        return Squares(crossed, shared_place, tuple(local))


MOST_WHOLE = 500_000
"""Products of all columns that are held as one matrix, which is read ten times as fast: 4 MB, where
those of an arm of seven joints take 1.2. A search holds a dozen such matrices."""


@dataclass(frozen=True, eq=False)
class Squares:
    """Hold the inner products (P + 1, P + 1) of columns most of which only one joint has.

    `shared_place` (P + 1,) are the rows of `shared` (S, P + 1), -1 for what one joint k alone has:
    `local[k]` are the places of that and its products among each other. All others are zero.
    """

    shared: Array
    shared_place: Indices
    local: tuple[tuple[Indices, Array], ...]

    @cached_property
    def diagonal(self) -> Array:
        """Squared length of each column (P + 1,)."""
        found = np.zeros(self.shared.shape[1])
        columns = np.flatnonzero(self.shared_place >= 0)
        found[columns] = self.shared[self.shared_place[columns], columns]
        for places, own in self.local:
            found[places] = np.diag(own)
        return found

    def at(self, left: Indices, right: Indices) -> Array:
        """Return the products (l, r) of some columns with others."""
        whole = self._whole
        return self._gather(left, right) if whole is None else whole[left[:, None], right]

    @cached_property
    def _whole(self) -> Array | None:
        """All products (P + 1, P + 1), from which some are read at once; None if they are many."""
        every = np.arange(len(self.shared_place))
        return self._gather(every, every) if len(every) ** 2 <= MOST_WHOLE else None

    def _gather(self, left: Indices, right: Indices) -> Array:
        """Return the products (l, r) of some columns with others from what is held of them."""
        found = np.zeros((len(left), len(right)))
        left_shared = self.shared_place[left] >= 0
        right_shared = self.shared_place[right] >= 0
        found[left_shared] = self.shared[np.ix_(self.shared_place[left[left_shared]], right)]
        rest = left[~left_shared]
        across = self.shared[np.ix_(self.shared_place[right[right_shared]], rest)]
        found[np.ix_(~left_shared, right_shared)] = across.T
        rows = np.flatnonzero(~left_shared)
        columns = np.flatnonzero(~right_shared)
        for j in np.unique(self._joint[rest]) if columns.size else ():
            mine = rows[self._joint[left[rows]] == j]
            yours = columns[self._joint[right[columns]] == j]
            inside = np.ix_(self._own_place[left[mine]], self._own_place[right[yours]])
            found[np.ix_(mine, yours)] = self.local[j][1][inside]
        return found

    @cached_property
    def _joint(self) -> Indices:
        """The joint that alone has each column (P + 1,), -1 for shared ones."""
        joint = np.full(len(self.shared_place), -1)
        for k, (places, _) in enumerate(self.local):
            joint[places] = k
        return joint

    @cached_property
    def _own_place(self) -> Indices:
        """Place of each column among those of its joint (P + 1,)."""
        place = np.full(len(self.shared_place), -1)
        for places, _ in self.local:
            place[places] = np.arange(len(places))
        return place


@dataclass(frozen=True, slots=True, eq=False)
class Products:
    """Hold the inner products (c, c) of some columns, in ascending order."""

    columns: Indices
    values: Array

    def at(self, left: Indices, right: Indices) -> Array:
        """Return the products (l, r) of some of the columns with others of them."""
        rows, columns = (np.searchsorted(self.columns, each) for each in (left, right))
        return self.values[rows[:, None], columns]
