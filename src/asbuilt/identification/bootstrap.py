"""Errors of any estimator by drawing time blocks again and again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from asbuilt.dynamics.blas import one_blas_thread
from asbuilt.errors import AsbuiltError, IdentifiabilityError
from asbuilt.identification.least_squares import Estimate
from asbuilt.identification.square_root_information import SquareRootInformation
from asbuilt.identification.uncertainty import Uncertainty

Array = NDArray[np.float64]
Seed = np.random.Generator | int | None

FEWEST_BLOCKS = 8
MOST_FAILURES = 0.1
"""Share of draws for which an estimator may refuse before the whole is refused."""


@dataclass(frozen=True, slots=True, eq=False)
class Bootstrap:
    """Hold the estimates (n_draws, p) of as many recordings put together from blocks of one, drawn with replacement."""

    estimates: Array

    def __post_init__(self) -> None:
        self.estimates.setflags(write=False)

    @property
    def covariance(self) -> Array:
        """Covariance (p, p) of the estimates."""
        return np.atleast_2d(np.cov(self.estimates, rowvar=False))

    @property
    def std_errors(self) -> Array:
        """Standard errors, shape (p,)."""
        return np.asarray(self.estimates.std(axis=0, ddof=1), dtype=np.float64)

    def intervals(self, level: float = 0.95) -> Array:
        """Return the percentile interval of each parameter, shape (p, 2)."""
        outside = (1.0 - level) / 2.0
        return np.quantile(self.estimates, [outside, 1.0 - outside], axis=0).T


def block_bootstrap(
    information: SquareRootInformation,
    fit: Callable[[SquareRootInformation], Array],
    *,
    n_draws: int = 200,
    rng: Seed = 0,
    progress: Callable[[str, float], None] | None = None,
) -> Bootstrap:
    """Fit recordings made of time blocks drawn with replacement: errors that hold for correlated residuals and for any estimator.

    `fit` maps information to estimates (p,), such as a constrained fit for which no formula is honest. Each draw has as many blocks as the recording;
    residuals may be correlated within a block (Kuensch, Annals of Statistics 17, 1989; here blocks do not overlap). With B blocks, standard errors come
    out small by about sqrt((B - 1) / B). Reads the information alone, so a draw of a least-squares fit takes milliseconds.

    Raises
    ------
    IdentifiabilityError
        If there are fewer than 8 blocks, or the estimator refuses more than a tenth of the draws.
    """
    n = information.n_blocks
    if n < FEWEST_BLOCKS:
        raise IdentifiabilityError(
            f"{n} time blocks are too few to draw from, {FEWEST_BLOCKS} are needed; record longer, or choose shorter blocks"
        )
    generator = np.random.default_rng(rng)
    estimates, refused = [], 0
    with one_blas_thread():
        for draw in range(n_draws):
            try:
                estimates.append(np.asarray(fit(information.select(generator.integers(n, size=n))), dtype=np.float64))
            except AsbuiltError:
                refused += 1
            if progress is not None:
                progress("bootstrap", (draw + 1) / n_draws)
    if refused > MOST_FAILURES * n_draws or len(estimates) < 2:
        raise IdentifiabilityError(
            f"the estimator refused {refused} of {n_draws} draws of {n} blocks; single blocks carry what others do not: record longer"
        )
    return Bootstrap(np.array(estimates))


def bootstrap_uncertainty(information: SquareRootInformation, estimate: Estimate, drawn: Bootstrap) -> Uncertainty:
    """Return the scatter of the draws as the errors of an estimate, no variance smaller than the textbook one.

    Standard errors are widened by sqrt(B / (B - 1)) for B blocks, which drawing with replacement makes too small.
    """
    n = information.n_blocks
    textbook = np.diag(estimate.covariance)
    covariance = drawn.covariance * n / (n - 1.0)
    swell = np.sqrt(np.maximum(textbook / np.maximum(np.diag(covariance), np.finfo(np.float64).tiny), 1.0))
    covariance = covariance * np.outer(swell, swell)
    told = textbook > 0
    share = float(np.exp(np.mean(np.log(textbook[told] / np.diag(covariance)[told])))) if told.any() else 1.0
    return Uncertainty(covariance, information.n_samples * share, "bootstrap", n)
