"""Options of the study of a log for contact."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from asbuilt.ranges import Range, check_ranges, option, switch

Watched = Literal["as_built", "cad"]


@dataclass(frozen=True, slots=True, kw_only=True)
class WatchOptions:
    """Configure `watch`.

    Parameters
    ----------
    false_alarms_per_hour
        Rate of false alarms of the whole robot that the thresholds are set for.
    bandwidth
        Bandwidth of the momentum observer [Hz].
    model
        Whether the observer has the robot as built or as described.
    frame
        Link or frame of the tool, at which forces are given; None: the flange.
    checked
        Refuse recordings in which `check_recording` finds errors.
    """

    false_alarms_per_hour: float = option(
        1.0,
        "RATE",
        "false alarms per hour, all joints together, that thresholds are set for",
        range=Range(1e-6, 3600.0, "1/h"),
    )
    bandwidth: float = option(
        8.0, "HZ", "bandwidth of the momentum observer", range=Range(1e-3, 1e4, "Hz")
    )
    model: Watched = option(
        "as_built",
        "WHICH",
        "model of the observer: as-built or cad",
        choices={"as-built": "as_built", "cad": "cad"},
    )
    frame: str | None = option(
        None, "NAME", "link or frame of the tool, where forces are given (default: the flange)"
    )
    checked: bool = switch(True, "use the recordings whatever their checks find")

    def __post_init__(self) -> None:
        check_ranges(self)
