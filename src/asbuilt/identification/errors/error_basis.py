"""How standard errors were estimated, as data and as text."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from asbuilt.findings import joined

ErrorKind = Literal["blocks", "bootstrap", "textbook"]
ERROR_KINDS: tuple[ErrorKind, ...] = ("blocks", "bootstrap", "textbook")
UNSTATED = "unstated"
"""Kind of errors in results without this information."""
TELLING_GROWTH = 1.1
"""Ratio of block to textbook errors above which textbook errors are reported as too small."""


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
        if self.kind == "blocks":
            return (
                f"Standard errors (blocks): by formula from {blocks}, allowing for residual"
                f" correlation within them ({worth})."
            )
        if self.kind == "bootstrap":
            held = f", with {joined(self.held_fixed)} held fixed" if self.held_fixed else ""
            return (
                f"Standard errors (bootstrap): scatter of {self.n_draws} fits to {blocks} drawn"
                f" with replacement{held} ({worth})."
            )
        if self.kind == "textbook":
            return (
                f"Standard errors (textbook): residuals taken as independent, {self._too_small()}."
            )
        if self.kind == "siblings":
            return (
                "Standard errors (siblings): of the posterior, with the spread of the siblings and"
                f" residual correlation ({worth})."
            )
        return f"Standard errors allow for residual correlation ({worth})."

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
