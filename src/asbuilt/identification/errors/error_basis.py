"""How standard errors were judged, in words and for programs.

A number without that is half a number.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any, Literal

ErrorKind = Literal["blocks", "bootstrap", "textbook"]
ERROR_KINDS: tuple[ErrorKind, ...] = ("blocks", "bootstrap", "textbook")
UNSTATED = "unstated"
"""Kind of the errors in results that do not say."""
TELLING_GROWTH = 1.1
"""Errors judged from block to block, in textbook errors, from which the textbook's are called too
small.
"""


@dataclass(frozen=True, slots=True)
class ErrorBasis:
    """Say how standard errors were judged.

    `kind` is `"blocks"` (by formula, from one time block to another), `"bootstrap"` (from fits to
    time blocks drawn with replacement), `"textbook"` (residuals taken as independent) or
    `"unstated"`; `asked` is what was asked for, other than `kind` where there were too few blocks.
    `n_blocks` time blocks of about `block_seconds` [s] were at hand, `n_draws` fits made, holding
    fixed what `held_fixed` names. `growth` is the median over parameters of the error from blocks
    in textbook errors; None where there are too few blocks to say.
    """

    kind: str = UNSTATED
    asked: str = UNSTATED
    n_blocks: int = 0
    block_seconds: float | None = None
    n_draws: int = 0
    held_fixed: tuple[str, ...] = ()
    growth: float | None = None

    def sentence(self, effective_samples: float, n_samples: int) -> str:
        """Say it in a sentence or two, with the number of samples that are worth independent ones."""
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
            listed = (
                ", ".join(self.held_fixed[:-1])
                + (" and " if len(self.held_fixed) > 1 else "")
                + "".join(self.held_fixed[-1:])
            )
            held = f", with {listed} held fixed" if self.held_fixed else ""
            return (
                f"Standard errors (bootstrap): scatter of {self.n_draws} fits to {blocks} drawn"
                f" with replacement{held} ({worth})."
            )
        if self.kind == "textbook":
            return (
                f"Standard errors (textbook): residuals taken as independent, {self._too_small()}."
            )
        return f"Standard errors allow for residual correlation ({worth})."

    def _too_small(self) -> str:
        if self.growth is None:
            few = (
                f"; {self.n_blocks} time blocks are too few to do better"
                if self.asked != "textbook"
                else ""
            )
            return f"which they hardly are, so TOO SMALL{few}"
        if self.growth < TELLING_GROWTH:
            return (
                f"and here they nearly are (errors from time blocks are {self.growth:.2g} times as"
                " large); TOO SMALL where residuals are correlated"
            )
        return (
            "which they are not: TOO SMALL, errors from time blocks (--errors blocks) are"
            f" {self.growth:.2g} times as large"
        )

    def as_dict(self) -> dict[str, Any]:
        """Return plain numbers, texts and lists, ready for JSON."""
        return asdict(self) | {"held_fixed": list(self.held_fixed)}

    @classmethod
    def from_dict(cls, stored: Mapping[str, Any]) -> ErrorBasis:
        """Read what `as_dict` wrote; what is missing takes its default."""
        known = {field.name: stored[field.name] for field in fields(cls) if field.name in stored}
        return cls(**(known | {"held_fixed": tuple(known.get("held_fixed", ()))}))
