"""Choice of further columns of a fit, one at a time, by what they take from the residual."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from asbuilt.arrays import Array
from asbuilt.identification.errors.block_scatter import student_probability, widening
from asbuilt.identification.errors.leverage import block_variances

LEVEL = 0.05
"""Probability that chance adds a column, over all candidates (Bonferroni)."""
SEPARATE = 1e-3
"""Squared part of a column outside all others below which it is not distinguished from them."""
WITHIN = 1e-5
"""The same below which nothing can be said of a column."""
RIDGE = 1e-9
"""Squared length added to columns of unit length, for those that one time alone excites."""
PARTS = 5
"""Parts of the time that are left out in turn."""
SMALLEST_SHARE = 0.02
"""Share of the squared residual below which a column is not distinguished from other effects."""


@dataclass(frozen=True, slots=True)
class Chosen:
    """Hold a chosen column (from 0), its value, standard error, and share of the residual.

    The share is that of the squared residual, before it was chosen, that the column takes away.
    """

    column: int
    value: float
    std_error: float
    share: float


@dataclass(frozen=True, eq=False)
class BlockEquations:
    """Hold the normal equations of `r` columns of a fit and `m` candidates, by time block.

    `grams` (B, r + m, r + m) and `scores` (B, r + m) are those of the residual of a fit to the
    first r columns, `squares` (B,) its sum of squares.
    """

    grams: Array
    scores: Array
    squares: Array
    n_own: int
    scale: Array = field(init=False)

    def __post_init__(self) -> None:
        length = np.sqrt(np.diag(self.grams.sum(axis=0)))
        scale = np.where(length > 0.0, length, 1.0)
        object.__setattr__(self, "scale", scale)
        object.__setattr__(self, "grams", self.grams / scale / scale[:, None])
        object.__setattr__(self, "scores", self.scores / scale)

    @property
    def n_candidates(self) -> int:
        """Number of candidates."""
        return int(self.scores.shape[1] - self.n_own)

    def selected(
        self,
        most: int,
        admitted: Callable[[Chosen], bool] = lambda chosen: True,
        given: Sequence[int] = (),
    ) -> tuple[Chosen, ...]:
        """Return at most so many columns, beside those `given`, in the order of choice.

        Each time, of the columns that are significant beside those chosen (from time blocks, CR2 of
        Bell and McCaffrey, Survey Methodology 28, 2002), and which are `admitted`, the one is
        chosen that takes away most of the squared residual (forward selection: Efroymson 1960), if
        it lowers that of times left out as well (by one standard error over these).
        """
        inside, found = self._places(given), dict[int, Chosen]()
        while len(found) < most:
            trials = sorted(self._trials(inside), key=lambda each: -each.share)
            best = next(
                (
                    each
                    for each in trials
                    if each.share >= SMALLEST_SHARE
                    and admitted(each)
                    and self._predicts(inside, each.column)
                ),
                None,
            )
            if best is None:
                break
            inside.append(self.n_own + best.column)
            found[best.column] = best
        return tuple(found.values())

    def together(self, columns: Sequence[int], given: Sequence[int] = ()) -> tuple[Chosen, ...]:
        """Return columns with their values in a fit with all of them, significant or not.

        Those that cannot be distinguished from the others, and from those `given`, are left out.
        """
        inside = self._places((*given, *columns))
        return tuple(
            each
            for place in inside[self.n_own + len(given) :]
            for each in self._trials([j for j in inside if j != place], [place], level=1.0)
        )

    def acts(self, column: int) -> bool:
        """Return whether a column has any length."""
        c = self.n_own + column
        return bool(self.grams[:, c, c].sum() > 0.0)

    def smallest_seen(self, column: int, share: float) -> float:
        """Return the value at which a column takes away a share of the squared residual.

        Infinite if it cannot be distinguished from the fit's own columns.
        """
        own, c = range(self.n_own), self.n_own + column
        G = self.grams.sum(axis=0)
        known = np.linalg.pinv(G[np.ix_(own, own)], hermitian=True)
        gram = float(G[c, c] - G[c, own] @ known @ G[own, c])
        return (
            np.inf
            if gram < SEPARATE
            else float(np.sqrt(share * self.residual / gram) / self.scale[c])
        )

    def shares_alone(self, given: Sequence[int] = ()) -> Array:
        """Return the share of the squared residual that each candidate alone takes away, (m,).

        Beside those `given`; 0 for columns within those of the fit. Columns that are not separate
        count too: their values are uncertain, but they may be what is the matter.
        """
        inside, G, s = self._places(given), self.grams.sum(axis=0), self.scores.sum(axis=0)
        known = np.linalg.pinv(G[np.ix_(inside, inside)], hermitian=True)
        across = G[:, inside]
        gram = (np.diag(G) - np.einsum("ij,jk,ik->i", across, known, across))[self.n_own :]
        score = (s - across @ (known @ s[inside]))[self.n_own :]
        out = np.zeros(len(gram))
        return np.asarray(np.divide(score**2, gram, out=out, where=gram > WITHIN) / self.residual)

    @property
    def residual(self) -> float:
        """Squared residual of the fit without candidates."""
        return float(self.squares.sum())

    def _places(self, columns: Sequence[int]) -> list[int]:
        """Return the places of the fit's own columns and of candidates."""
        return [*range(self.n_own), *(self.n_own + column for column in columns)]

    def _predicts(self, inside: Sequence[int], column: int) -> bool:
        """Return whether a column lowers the squared residual of times that are left out."""
        own, more = list(inside), [*inside, self.n_own + column]
        edges = np.linspace(0, len(self.squares), PARTS + 1).round().astype(int)
        if len(np.unique(edges)) <= PARTS:
            return True
        relief = [
            self._left_out(own, slice(a, b)) - self._left_out(more, slice(a, b))
            for a, b in pairwise(edges.tolist())
        ]
        return bool(np.mean(relief) > np.std(relief, ddof=1) / np.sqrt(PARTS))

    def _left_out(self, inside: Sequence[int], out: slice) -> float:
        """Return the squared residual of blocks by a fit to all others, less that without it."""
        G, s = self.grams[:, inside][:, :, inside], self.scores[:, inside]
        gram, score = G[out].sum(axis=0), s[out].sum(axis=0)
        others = G.sum(axis=0) - gram + RIDGE * np.eye(len(inside))
        x = np.linalg.solve(others, s.sum(axis=0) - score)
        return float(x @ gram @ x - 2.0 * x @ score)

    def _trials(
        self, inside: Sequence[int], places: Sequence[int] | None = None, level: float = LEVEL
    ) -> list[Chosen]:
        """Return the significant columns beside those inside, each tried alone."""
        return list(self._tried(list(inside), places, level))

    def _tried(
        self, inside: list[int], places: Sequence[int] | None, level: float
    ) -> Iterator[Chosen]:
        G, s = self.grams.sum(axis=0), self.scores.sum(axis=0)
        known = np.linalg.pinv(G[np.ix_(inside, inside)], hermitian=True)
        x = known @ s[inside]
        residual = float(self.squares.sum() - s[inside] @ x)
        own = self.grams[:, inside][:, :, inside]
        left = self.scores[:, inside] - own @ x
        for c in range(self.n_own, G.shape[0]) if places is None else places:
            if c in inside:
                continue
            moved = known @ G[inside, c]
            across = self.grams[:, inside, c]
            gram = G[c, c] - G[inside, c] @ moved
            if gram < SEPARATE or residual <= 0.0:
                continue
            score = s[c] - G[c, inside] @ x
            value = score / gram
            blocks = self.grams[:, c, c] - 2.0 * across @ moved + (own @ moved) @ moved
            scores = self.scores[:, c] - across @ x - left @ moved - blocks * value
            scatter, freedom = block_variances(
                np.array([[1.0 / gram]]), blocks[:, None, None], scores[:, None]
            )
            errors = np.sqrt(np.maximum(scatter, 1.0) / gram) * widening(freedom)
            p, error = float(student_probability(value / errors, freedom)[0]), float(errors[0])
            if p * self.n_candidates <= level or level >= 1.0:
                scale = float(self.scale[c])
                yield Chosen(
                    c - self.n_own,
                    value / scale,
                    error / scale,
                    score**2 / gram / residual,
                )
