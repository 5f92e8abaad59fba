"""What each time block adds to the error of an estimate, and how errors were estimated."""

from __future__ import annotations

import base64
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from scipy.special import ndtri, stdtr, stdtrit

from asbuilt.arrays import Array
from asbuilt.codec import store_as
from asbuilt.errors import ResultError
from asbuilt.findings import join_names

ErrorKind = Literal["blocks", "bootstrap", "textbook"]
ERROR_KINDS: tuple[ErrorKind, ...] = ("blocks", "bootstrap", "textbook")
UNSTATED = "unstated"
"""Kind of errors in results without this information."""
TELLING_GROWTH = 1.1
"""Ratio of block to textbook errors above which textbook errors are reported as too small."""


FEWEST_DEGREES = 3.0
"""Least degrees of freedom of a variance from time blocks."""
COVERED = 0.975
"""Upper quantile of the 95 % interval for which standard errors are widened."""
MOST_GROUPS = 60
"""Blocks whose errors are kept; of more, neighbours are added up."""


@dataclass(frozen=True, slots=True)
class ErrorBasis:
    """Hold how standard errors were estimated.

    Parameters
    ----------
    kind
        `"blocks"` (formula from time blocks), `"bootstrap"` (fits to time blocks drawn with
        replacement), `"textbook"` (residuals taken as independent), `"siblings"`
        (posterior with other robots as prior) or `"unstated"`.
    asked
        Requested kind, which needs enough time blocks.
    n_blocks, block_seconds
        Number and median length [s] of the time blocks.
    n_draws
        Number of bootstrap fits.
    held_fixed
        Choices that the bootstrap fits share.
    growth
        Median over parameters of block error over textbook error; None with too few blocks.
    """

    kind: str = UNSTATED
    asked: str = UNSTATED
    n_blocks: int = 0
    block_seconds: float | None = None
    n_draws: int = 0
    held_fixed: tuple[str, ...] = ()
    growth: float | None = None

    def sentence(self, effective_samples: float, n_samples: int) -> str:
        """Return a note with the number of effectively independent samples."""
        worth = f"effective samples {round(effective_samples)} of {n_samples}"
        blocks = f"{self.n_blocks} time blocks" + (
            f" of {self.block_seconds:.3g} s" if self.block_seconds else ""
        )
        held = f", with {join_names(self.held_fixed)} held fixed" if self.held_fixed else ""
        sentences = {
            "blocks": f"Standard errors (blocks): by formula from {blocks}, allowing for residual"
            f" correlation within them ({worth}).",
            "bootstrap": f"Standard errors (bootstrap): scatter of {self.n_draws} fits to {blocks}"
            f" drawn with replacement{held} ({worth}).",
            "textbook": "Standard errors (textbook): residuals taken as independent,"
            f" {self._too_small()}.",
            "siblings": "Standard errors (siblings): of the posterior, with the spread of the"
            f" siblings and residual correlation ({worth}).",
        }
        usual = f"Standard errors allow for residual correlation ({worth})."
        return sentences.get(self.kind, usual)

    def _too_small(self) -> str:
        if self.growth is None:
            few = f"; {self.n_blocks} time blocks are too few to correct this"
            return f"so TOO SMALL{few if self.asked != 'textbook' else ''}"
        if self.growth < TELLING_GROWTH:
            return (
                f"which is nearly true here (errors from time blocks are {self.growth:.2g} times as"
                " large); TOO SMALL if residuals are correlated"
            )
        return f"so TOO SMALL: errors from time blocks are {self.growth:.2g} times as large"


def _pack_matrix(matrix: Array) -> dict[str, object]:
    text = base64.b64encode(np.ascontiguousarray(matrix, dtype="<f8").tobytes()).decode("ascii")
    return {"shape": list(matrix.shape), "values": text}


def _unpack_matrix(document: dict[str, object]) -> Array:
    values = np.frombuffer(base64.b64decode(str(document["values"])), dtype="<f8")
    shape = document["shape"]
    if not isinstance(shape, list) or not np.all(np.isfinite(values)):
        raise ValueError("expected finite numbers and their shape")
    return values.reshape([int(length) for length in shape]).copy()


@dataclass(frozen=True, slots=True, eq=False)
class BlockScatter:
    """Hold the scatter of an estimate of p parameters between B time blocks.

    Parameters
    ----------
    moves
        Part of each block in the error of the estimate, corrected for leverage, shape (B, p);
        their sum of squares is the unwidened variance.
    degrees_alone
        Degrees of freedom of each variance (Satterthwaite), shape (p,), without
    common_variance
        the relative variance of a factor that is common to all.
    bias
        The bias by effects that the model lacks, (p,), which is the last row of `moves`. In the
        difference of two estimates it is the difference of both.
    """

    moves: Array = field(metadata=store_as(encode=_pack_matrix, decode=_unpack_matrix))
    degrees_alone: Array
    common_variance: float = 0.0
    bias: Array | None = None

    def __post_init__(self) -> None:
        if self.moves.ndim != 2 or self.degrees_alone.shape != self.moves.shape[1:]:
            raise ResultError(
                f"block errors {self.moves.shape} need one number of degrees of freedom for each"
                f" parameter, got {self.degrees_alone.shape}; identify again"
            )
        for values in (self.moves, self.degrees_alone, self.bias):
            if values is not None:
                values.setflags(write=False)

    @property
    def degrees_of_freedom(self) -> Array:
        """Degrees of freedom of each variance, shape (p,)."""
        return np.asarray(2.0 / (2.0 / self.degrees_alone + self.common_variance))

    @classmethod
    def of(cls, moves: Array, degrees_alone: Array, common_variance: float) -> BlockScatter:
        """Return the scatter of any number of blocks in at most `MOST_GROUPS` groups."""
        group = np.arange(len(moves)) * min(MOST_GROUPS, len(moves)) // max(len(moves), 1)
        first = np.flatnonzero(np.diff(group, prepend=-1))
        return cls(np.add.reduceat(moves, first, axis=0), degrees_alone, common_variance)

    @property
    def without_bias(self) -> Array:
        """The moves without the bias, (B, p)."""
        return self.moves if self.bias is None else self.moves[:-1]

    def beside(self, covariance: Array, bias: Array | None = None) -> BlockScatter:
        """Return the scatter with further errors of covariance (p, p).

        If they include the square of a bias (p,), that is one move; the others are independent.
        """
        own = np.zeros_like(covariance) if bias is None else np.outer(bias, bias)
        values, axes = np.linalg.eigh(covariance - own)
        kept = values > 1e-12 * max(float(values[-1]), 0.0)
        moves = [self.moves, (axes[:, kept] * np.sqrt(values[kept])).T]
        if bias is not None:
            moves.append(bias[None])
        return BlockScatter(np.vstack(moves), self.degrees_alone, self.common_variance, bias)


def widening(degrees_of_freedom: Array) -> Array:
    """Return Student's 97.5 % quantile over the normal one; 1 for infinite degrees of freedom.

    A standard error that is widened by it gives a 95 % interval of 1.96 standard errors.

    >>> widening(np.array([5.0, np.inf])).round(3).tolist()
    [1.312, 1.0]
    """
    freedom = np.maximum(np.asarray(degrees_of_freedom, dtype=np.float64), FEWEST_DEGREES)
    finite = np.isfinite(freedom)
    quantile = stdtrit(np.where(finite, freedom, 1e9), COVERED)
    return np.where(finite, quantile / ndtri(COVERED), 1.0)


def student_probability(sigmas: Array, degrees_of_freedom: Array) -> Array:
    """Return the probability of as large a deviation in *widened* standard errors by chance.

    Student's distribution of `sigmas` times `widening`.

    >>> student_probability(np.array([1.96, 1.96]), np.array([5.0, np.inf])).round(3).tolist()
    [0.05, 0.05]
    """
    freedom = np.maximum(np.asarray(degrees_of_freedom, dtype=np.float64), FEWEST_DEGREES)
    deviation = np.abs(np.asarray(sigmas, dtype=np.float64)) * widening(freedom)
    return np.asarray(2.0 * stdtr(np.where(np.isfinite(freedom), freedom, 1e12), -deviation))


def sum_degrees(*parts: tuple[Array, Array]) -> Array:
    """Return the degrees of freedom of sums of variances, each given with its own.

    `(sum v)^2 / sum (v^2 / nu)` (Satterthwaite 1946; Welch 1947).

    >>> sum_degrees((np.array([1.0]), np.array([9.0])), (np.array([1.0]), np.array([9.0])))
    array([18.])
    """
    total = np.sum([variance for variance, _ in parts], axis=0)
    spread = np.sum([variance**2 / freedom for variance, freedom in parts], axis=0)
    none = np.full(np.shape(total), np.inf)
    return np.asarray(np.divide(total**2, spread, out=none, where=spread > 0))


def mean_degrees(degrees_of_freedom: Array) -> float:
    """Return the harmonic mean of degrees of freedom; infinite if all are.

    >>> mean_degrees(np.array([4.0, 12.0])), mean_degrees(np.array([np.inf, np.inf]))
    (6.0, inf)
    """
    inverse = float(np.mean(1.0 / np.asarray(degrees_of_freedom, dtype=np.float64)))
    return 1.0 / inverse if inverse > 0.0 else np.inf
