"""Normal equations: all that a question about squares of residuals asks of a recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from asbuilt.arrays import Array, Indices
from asbuilt.identification.information.rows import TimeBlock

MODEL = "model"
"""Group of the columns of base parameters, which comes first."""


@dataclass(frozen=True, eq=False)
class Equations:
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

    def stacked(self, weights: Array, blocks: Sequence[int] | Indices | None = None) -> Array:
        """Return the sum over joints, (P + 1, P + 1), of joint k times `weights[k]`^2."""
        total = np.zeros((self.n_columns + 1,) * 2)
        for k, support in enumerate(self.support):
            gram = self.of_joints[k] if blocks is None else self.grams[k][blocks].sum(axis=0)
            places = np.append(support, self.n_columns)
            total[np.ix_(places, places)] += weights[k] ** 2 * gram
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
