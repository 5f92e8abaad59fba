"""Options of a design: every default is stated here, once."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

from asbuilt.errors import UsageError
from asbuilt.ranges import Range, check_ranges, option


def _parse_numbers(text: str) -> tuple[float, ...]:
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = (math.nan,)
    if not all(map(math.isfinite, values)):
        raise UsageError(f"expected finite numbers separated by commas, got {text!r}")
    return values


def _parse_noise(text: str) -> float | tuple[float, ...]:
    values = _parse_numbers(text)
    # One number holds for all joints.
    return values[0] if len(values) == 1 else values


def _parse_duration(text: str) -> float | str:
    try:
        return "auto" if text == "auto" else float(text)
    except ValueError:
        raise UsageError(f"expected a positive number of seconds or auto, got {text!r}") from None


def _parse_names(text: str) -> tuple[str, ...]:
    return tuple(name for name in text.split(",") if name.strip())


@dataclass(frozen=True)
class DesignOptions:
    """Configure the design of a motion.

    Parameters
    ----------
    parametrisation
        Family of motions, see `PARAMETRISATIONS`.
    size
        Harmonics, control points, way points or poses; None: by duration and limits.
    duration
        Duration [s], or `"auto"`: as short as `precision` allows.
    precision
        With `duration="auto"`: the largest torque error of one parameter's standard error, as a
        fraction of the torque.
    periods
        How often a Fourier series repeats within the duration; None: by duration and limits.
    drive
        Drive terms to identify, such as `"viscous,coulomb,offset"`, or `"none"`.
    criterion
        `"d"`, `"a"`, `"e"` or `"condition"`.
    focus
        Names or ids of the base parameters that matter (D_s).
    noise
        Standard deviation of the torque, one number or one per joint [N m or N].
    information_rate
        Independent torque samples per second to which the noise refers [1/s].
    fraction, torque_fraction
        Share of the limits of motion, and of the torque limits, that the motion may use.
    power
        Mechanical power allowed, one number or one per joint [W]; empty: unlimited.
    perturbed, spread
        Number of other robots whose torque limit must hold, and how far their masses are off.
    collision
        Bodies to keep apart: `"skeleton[:RADIUS]"`, a `.urdf` with geometry or a `.toml` file.
    tool_box, tool_frame
        Box `x0, x1, y0, y1, z0, z1` of the root frame [m] and the frame that must stay in it.
    starts, seed
        Random starts of local searches, by which the work of the whole search is limited, and seed:
        the same motion on every machine.
    time_limit
        Time after which the best motion so far is kept [s]; None: as long as the starts take.

    Raises
    ------
    UsageError
        If a value is out of range.

    Examples
    --------
    >>> DesignOptions(duration=10.0, starts=4).fraction
    0.95
    """

    parametrisation: str = option(
        "fourier",
        "KIND",
        "family of motions: fourier, bspline, quintic, point-to-point or an installed one",
    )
    size: int | None = option(
        None,
        "N",
        "harmonics, control points, way points or poses (default: by duration and limits)",
        range=Range(2, 200),
    )
    # 3600.0: longest motion that is designed [s].
    duration: float | Literal["auto"] = option(
        20.0,
        "S",
        "duration, or auto: as short as the precision allows",
        parse=_parse_duration,
        range=Range(0.01, 3600.0, "s"),
    )
    precision: float = option(
        0.002,
        "SHARE",
        "with duration auto: torque error per parameter, relative to the torque",
        range=Range(1e-9, 1.0),
    )
    periods: int | None = option(
        None,
        "N",
        "repetitions of a Fourier series within the duration (default: by duration)",
        range=Range(1, 1000),
    )
    drive: str = option("viscous,coulomb,offset", "LIST", "drive terms to identify, or none")
    criterion: str = option("d", "NAME", "d, a, e or condition")
    focus: tuple[str, ...] = option(
        (), "LIST", "names or ids of the base parameters that matter", parse=_parse_names
    )
    noise: float | tuple[float, ...] = option(
        1.0,
        "S1,S2,...",
        "standard deviation of the torque, one or one per joint [N m]",
        parse=_parse_noise,
        range=Range(1e-9, 1e9, "N m"),
    )
    information_rate: float = field(default=100.0, metadata={"range": Range(1e-6, 1e6, "1/s")})
    fraction: float = option(
        0.95, "SHARE", "usable share of the limits of motion", range=Range(0, 1, above=True)
    )
    torque_fraction: float = option(
        0.8, "SHARE", "usable share of the torque limits", range=Range(1e-3, 1)
    )
    power: tuple[float, ...] = option(
        (),
        "P1,P2,...",
        "mechanical power allowed, one or one per joint [W]",
        parse=_parse_numbers,
        range=Range(0, 1e9, "W", above=True),
    )
    perturbed: int = option(
        0, "N", "hold the torque limit for N other robots, masses 10 % off", range=Range(0, 1000)
    )
    spread: float = field(default=0.1, metadata={"range": Range(0, 1)})
    collision: str | None = option(
        None,
        "SOURCE",
        "keep bodies apart: skeleton[:RADIUS], a .urdf with geometry, or a .toml file",
    )
    tool_box: tuple[float, ...] = option(
        (),
        "X0,X1,Y0,Y1,Z0,Z1",
        "keep the tool in this box of the root frame [m]",
        parse=_parse_numbers,
        range=Range(-1e6, 1e6, "m"),
    )
    tool_frame: str | None = option(None, "NAME", "frame that stays in the box (default: the last)")
    # 48, two rounds: eight arms of 2 to 14 joints gained nothing from further ones.
    starts: int = option(48, "N", "random starts of local searches", range=Range(1, 10_000))
    seed: int = option(0, "N", "seed of the random numbers", range=Range(0, 1e18))
    time_limit: float | None = option(
        None,
        "S",
        "longest time for the whole design (default: as long as the starts take)",
        range=Range(0, 1e6, "s", above=True),
    )

    def __post_init__(self) -> None:
        check_ranges(self)

    @property
    def longest(self) -> float:
        """The time limit [s], infinite if there is none."""
        return math.inf if self.time_limit is None else self.time_limit

    @property
    def seconds(self) -> float:
        """The duration as a number; raises `UsageError` if it is `"auto"`."""
        if isinstance(self.duration, str):
            raise UsageError("the duration is 'auto'; give a number of seconds")
        return self.duration
