"""What each time block adds to the error of an estimate, and what all blocks together miss."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from scipy.special import ndtri, stdtr, stdtrit

from asbuilt.arrays import Array, Indices, Mask
from asbuilt.codec import store_as
from asbuilt.errors import ResultError
from asbuilt.findings import join_names
from asbuilt.identification.information.rows import TimeBlock
from asbuilt.scaled import Scaled

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
LEAST_LEFT = 0.05
"""Least `(1 - 2 p D / N)^2`: a fit that absorbs more of its residuals is not corrected further."""


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
        return sentences.get(
            self.kind, f"Standard errors allow for residual correlation ({worth})."
        )

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
    # Little-endian on every machine, so that a result reads the same elsewhere.
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
        return 2.0 / (2.0 / self.degrees_alone + self.common_variance)

    @classmethod
    def of(cls, moves: Array, degrees_alone: Array, common_variance: float) -> BlockScatter:
        """Return the scatter of any number of blocks in at most `MOST_GROUPS` groups."""
        # Neighbours go together, as residuals outlast a block.
        group = np.arange(len(moves)) * min(MOST_GROUPS, len(moves)) // max(len(moves), 1)
        return cls(
            np.add.reduceat(moves, np.flatnonzero(np.diff(group, prepend=-1)), axis=0),
            degrees_alone,
            common_variance,
        )

    @property
    def without_bias(self) -> Array:
        """The moves without the bias, (B, p)."""
        return self.moves if self.bias is None else self.moves[:-1]

    def with_further(self, covariance: Array, bias: Array | None = None) -> BlockScatter:
        """Return the scatter with further errors of covariance (p, p).

        If they include the square of a bias (p,), that is one move; the others are independent.
        """
        square = np.zeros_like(covariance) if bias is None else np.outer(bias, bias)
        moves = [self.moves, Scaled(covariance - square).root]
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
    # The quantile function takes no infinity.
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
    return 2.0 * stdtr(np.where(np.isfinite(freedom), freedom, 1e12), -deviation)


def sum_degrees(*parts: tuple[Array, Array]) -> Array:
    """Return the degrees of freedom of sums of variances, each given with its own.

    `(sum v)^2 / sum (v^2 / nu)` (Satterthwaite 1946; Welch 1947).

    >>> sum_degrees((np.array([1.0]), np.array([9.0])), (np.array([1.0]), np.array([9.0])))
    array([18.])
    """
    total = np.sum([variance for variance, _ in parts], axis=0)
    spread = np.sum([variance**2 / freedom for variance, freedom in parts], axis=0)
    return np.asarray(
        np.divide(total**2, spread, out=np.full(np.shape(total), np.inf), where=spread > 0)
    )


def mean_degrees(degrees_of_freedom: Array) -> float:
    """Return the harmonic mean of degrees of freedom; infinite if all are.

    >>> mean_degrees(np.array([4.0, 12.0])), mean_degrees(np.array([np.inf, np.inf]))
    (6.0, inf)
    """
    inverse = float(np.mean(1.0 / np.asarray(degrees_of_freedom, dtype=np.float64)))
    return 1.0 / inverse if inverse > 0.0 else np.inf


@dataclass(frozen=True, slots=True, eq=False)
class BlockScores:
    """Hold what each of B time blocks says of r unknowns of a fit, all of them, nuisance too.

    Parameters
    ----------
    grams, scores
        `L^T W_b^T W_b L` (B, r, r) and `L^T W_b^T e_b` (B, r) of the weighted residual e, with the
        inverse root L that makes the sum of the `grams` one.
    blocks
        Their times.
    alike
        The blocks in groups of like motion.
    n_rows
        Number of torques.
    variance
        Variance of a weighted residual.
    """

    grams: Array
    scores: Array
    blocks: Sequence[TimeBlock]
    alike: Sequence[Indices]
    n_rows: int
    variance: float


@dataclass(frozen=True, slots=True)
class CommonGrowth:
    """Hold a factor on all variances and the relative variance of that factor.

    `of_noise` is the factor without what blocks of like motion share.
    """

    factor: float
    variance: float
    of_noise: float = 1.0


def estimate_common_growth(
    data: BlockScores, moves: Array, absorbed: Array, leverage: float, freedom: float
) -> CommonGrowth:
    """Return the factor by which block variances are too small, for three reasons.

    Successive blocks are correlated, since noise lasts. Blocks that repeat a motion (with their
    successors), and less so blocks of like motion, share what the model lacks there, as neighbours
    in space do (Conley, J. Econometrics 92, 1999): a motion recorded twice shows the noise twice,
    but the error of the model once. All add twice the sum of `g_b . g_c` over pairs of blocks to
    the sum of `g_b . g_b`. And a fit absorbs more of correlated residuals: N rows with design
    effect D (samples per independent sample) are worth N / D, so a fit of p parameters leaves 1 - p
    D / N of their energy, where CR2 allows for 1 - p / N. D follows from the design effect of the
    moves, `D (1 - p D / N) = D_moves (1 - p / N)`.

    Parameters
    ----------
    data
        The blocks.
    moves
        Scores of the blocks, corrected for leverage, `(1 - M_b)^(-1/2) g_b`, (n_blocks, rank).
    absorbed
        `(1 - M_b)^(-1/2) M_b`, (n_blocks, rank, rank): by their products the fit makes moves of
        two blocks opposite where residuals are independent.
    leverage
        Trace p of the hat matrix.
    freedom
        Degrees of freedom of the variance of one parameter.
    """
    if data.variance <= 0.0 or not np.any(moves):
        return CommonGrowth(1.0, 0.0)
    rank = effective_rank(moves)
    after = _find_successive(data.blocks)
    # A pair counts under one of three reasons only.
    again = np.triu(_extend_to_successors(find_repetitions(data), after), 1) & ~after
    alike = _pair_like_motion(data.alike, len(moves)) & ~after & ~again
    products, taken, spreads = _add_pairs(moves, absorbed, leverage, (after, again, alike))
    parts = products + taken
    of_noise = 1.0 + float(np.clip(parts[0], 0.0, 1.0))
    # Of what blocks share beyond chance the fit takes its part too. Least part that it leaves: of
    # few motions it absorbs almost all.
    left = np.maximum(1.0 - taken[1:], 0.3)
    x = parts[1:] / left
    v = spreads[1:] / rank / left**2
    # An excess x of variance v is shrunk by its chance part: below its error nothing is left.
    beyond = x - np.divide(v, x, out=np.zeros_like(x), where=x > 0.0)
    along = of_noise + float(np.maximum(beyond, 0.0).sum())
    share = leverage / max(data.n_rows, 1)
    # Design effect of the moves: their squares over what independent residuals have.
    seen = float(np.sum(moves**2)) / (moves.shape[1] * data.variance)
    grown, steep = _evaluate_absorption(share, along * seen)
    spread = spreads.sum() / rank / along**2
    return CommonGrowth(
        along * grown,
        steep**2 * spread + (steep**2 - 1.0) * (2.0 / (rank * freedom)),
        of_noise * _evaluate_absorption(share, of_noise * seen)[0],
    )


def effective_rank(moves: Array) -> float:
    """Return `tr(O)^2 / tr(O^2)` of `O = sum_b g_b g_b^T`, between 1 and the number of columns.

    Products of *different* blocks give `tr(O^2)` without bias (Chen & Qin, Annals of Statistics 38,
    2010).
    """
    products = moves @ moves.T
    n = len(moves)
    squares = np.diag(products)
    trace = float(np.trace(products))
    # Pairs of different blocks only; n / (n - 1) makes up for those left out.
    across = float((products**2).sum() - (squares**2).sum()) * n / max(n - 1, 1)
    return float(np.clip(trace**2 / max(across, 1e-12 * trace**2), 1.0, moves.shape[1]))


def _evaluate_absorption(share: float, seen: float) -> tuple[float, float]:
    """Return the factor for absorbed residuals, and its slope: d log D / d log D_moves."""
    # Discriminant of D (1 - s D) = D_moves (1 - s), s = p / N: the smaller root is D.
    left = 1.0 - 4.0 * share * seen * (1.0 - share)
    if share <= 0.0 or left >= 1.0:
        return 1.0, 1.0
    root = np.sqrt(max(left, LEAST_LEFT))
    grown = (1.0 - root) / (0.5 * (1.0 - max(left, LEAST_LEFT)) / (1.0 - share))
    return max(float(grown), 1.0), float((1.0 - share) / root / grown) if left > LEAST_LEFT else 1.0


def find_repetitions(data: BlockScores) -> Mask:
    """Return which pairs of blocks repeat a motion, the first lower, shape (n_blocks, n_blocks).

    Their information per sample is alike.
    """
    samples = np.array([block.n_samples for block in data.blocks], dtype=np.float64)
    features = (data.grams / samples[:, None, None]).reshape(len(samples), -1)
    products = features @ features.T
    total = np.add.outer(np.diag(products), np.diag(products))
    # |a - b|^2 by products: the features of all pairs do not fit memory.
    apart = np.maximum(total - 2.0 * products, 0.0)
    # Relative distance of the information per sample below which blocks repeat a motion: 0.01 to
    # 0.05 in one motion recorded twice, over 0.18 between other blocks of six real robots.
    return np.triu(apart < 0.1**2 * total, 1)


def _add_pairs(
    moves: Array, absorbed: Array, leverage: float, masks: Sequence[Mask]
) -> tuple[Array, Array, Array]:
    """Return twice the sum of products over pairs of blocks, over the sum of squares.

    For each mask of pairs: that sum, what the fit takes from it where residuals are independent,
    and its variance for independent blocks with moves of one column.
    """
    products = moves @ moves.T
    flat = absorbed.reshape(len(moves), -1)
    energy = np.diag(products)
    whole = float(energy.sum())
    taken = float(np.trace(products)) / leverage * (flat @ flat.T)
    return (
        np.array([2.0 * products[which].sum() / whole for which in masks]),
        np.array([2.0 * taken[which].sum() / whole for which in masks]),
        np.array([4.0 * (energy @ which @ energy) / whole**2 for which in masks]),
    )


def _find_successive(blocks: Sequence[TimeBlock]) -> Mask:
    """Return which pairs of blocks are successive, the first lower."""
    successive = np.zeros((len(blocks),) * 2, dtype=np.bool_)
    for b, (block, other) in enumerate(pairwise(blocks)):
        # A gap of half a block ends what residuals share.
        successive[b, b + 1] = (
            block.source == other.source
            and 0.0 <= other.start - block.stop < 0.5 * (block.stop - block.start)
        )
    return successive


def _extend_to_successors(repeated: Mask, after: Mask) -> Mask:
    """Return pairs that repeat a motion, and pairs of one block and the successor of the other.

    What successive blocks share in one recording is shared across repetitions too.
    """
    both = repeated | repeated.T
    pairs = both.copy()
    pairs[:, 1:] |= both[:, :-1] & np.diag(after, 1)
    return pairs | pairs.T


def _pair_like_motion(groups: Sequence[Indices], n_blocks: int) -> Mask:
    """Return which pairs of blocks are in the same group of like motion, the first lower."""
    number = np.empty(n_blocks, dtype=np.int64)
    for k, group in enumerate(groups):
        number[group] = k
    return np.triu(number[:, None] == number, 1)
