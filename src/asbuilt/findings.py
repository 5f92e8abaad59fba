"""One thing that is wrong, or worth knowing, about a recording."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Severity = Literal["error", "warning", "info"]


@dataclass(frozen=True)
class Finding:
    """Say what is wrong with a recording (`message`: place and value, one sentence) and what to do about it (`cure`).

    `severity` "error" means that an identification would be wrong, "warning" that it would be poor, "info" that one should know.
    `joint` is a joint name, `time` the first affected time [s].
    """

    code: str
    severity: Severity
    message: str
    cure: str = ""
    joint: str | None = None
    time: float | None = None

    def __str__(self) -> str:
        return f"{self.severity.upper()} {self.code}: {self.message}." + (
            f" {self.cure}." if self.cure else ""
        )


def joined(names: list[str] | tuple[str, ...], most: int = 7) -> str:
    """Join names with commas, the last with "and"; long lists are cut."""
    listed = list(names[:most]) + ([f"{len(names) - most} more"] if len(names) > most else [])
    return listed[0] if len(listed) == 1 else f"{', '.join(listed[:-1])} and {listed[-1]}"
