"""Options of a loop: every default is stated here, once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from asbuilt.ranges import Range, check_ranges, option

Purpose = Literal["torque", "simulator", "payload"]
PURPOSES: tuple[Purpose, ...] = ("torque", "simulator", "payload")


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Configure a loop of rounds.

    Parameters
    ----------
    purpose
        What the model is for: the torque of motion, a simulator, or a payload at the flange.
    until
        Wanted error [%]: of the torque, or of the simulated motion for a simulator.
    rounds
        Most rounds, those of an earlier start included.
    seconds
        Motion of a round [s].
    speed
        Share of the limits of motion that the first round uses; it is slow and small.
    fraction
        Share of the limits of motion that the further rounds use.
    collision
        Bodies to keep apart, as for `DesignOptions`.
    drive
        Drive terms to identify; None: the usual ones.
    seed
        Seed of all random numbers.

    Raises
    ------
    UsageError
        If a value is out of range.
    """

    purpose: Purpose = option(
        "torque",
        "PURPOSE",
        "what the model is for: torque, simulator or payload",
        choices=PURPOSES,
    )
    until: float = option(
        5.0,
        "PERCENT",
        "wanted error of the torque; for a simulator, of the simulated motion",
        range=Range(1e-6, 1e3, "%"),
    )
    rounds: int = option(8, "N", "most rounds", range=Range(2, 1000))
    seconds: float = option(10.0, "S", "motion of a round", range=Range(2.0, 600.0, "s"))
    speed: float = option(
        0.3,
        "SHARE",
        "share of the limits that the first round uses, in range and speed",
        range=Range(0.01, 1.0),
    )
    fraction: float = option(
        0.95, "SHARE", "usable share of the limits of motion", range=Range(0.01, 1.0)
    )
    collision: str | None = option(
        None,
        "SOURCE",
        "keep bodies apart: skeleton[:RADIUS], a .urdf with geometry, or a .toml file",
    )
    drive: str | None = option(
        None, "LIST", "drive terms to identify (default: those usual for the torque source)"
    )
    seed: int = option(0, "N", "seed of everything random", range=Range(0, 1e18))

    def __post_init__(self) -> None:
        check_ranges(self)
