"""Options of reading recordings: one class that owns every default."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.description.load import CONTACTS, HELD_BASE, BaseOptions
from asbuilt.description.model import USUAL_GRAVITY
from asbuilt.description.structure.locking import locks_from_text
from asbuilt.dynamics.drives.position_servo import LIMITS, PER_JOINT
from asbuilt.errors import UsageError
from asbuilt.experiment.logs.sheet import GAINS, RANGES, RATES, RecordingSheet, SheetWindow
from asbuilt.experiment.recording import TORQUE_SOURCES, TorqueSource
from asbuilt.ranges import Range, check_choice, check_ranges, make_range_error, option, switch
from asbuilt.registry import divide_settings

PathLike = str | Path
OF_BASE = tuple(entry.name for entry in fields(BaseOptions))
"""Options that concern the base of the robot."""


def _parse_numbers(text: str) -> tuple[float, ...]:
    values = tuple(float(part) for part in text.split(","))
    if not all(map(math.isfinite, values)):
        raise ValueError(text)
    return values


def parse_windows(text: str) -> tuple[tuple[float, float], ...]:
    """Return windows of time [s] that are kept, an end that is not given is that of the log.

    >>> parse_windows("5:60,80:")
    ((5.0, 60.0), (80.0, inf))
    """
    windows = []
    for part in text.split(","):
        start, colon, stop = part.partition(":")
        if not colon:
            raise ValueError(part)
        windows.append((float(start or 0.0), float(stop or math.inf)))
    return tuple(windows)


def parse_servo_numbers(text: str) -> tuple[float, ...]:
    """Return numbers separated by commas, NaN for `auto`, infinity for `none`."""
    named = {"auto": math.nan, "none": math.inf}
    parts = [part.strip().lower() for part in text.split(",")]
    _parse_numbers(",".join("0" if part in named else part for part in parts))
    return tuple(named[part] if part in named else float(part) for part in parts)


@dataclass(frozen=True, slots=True, kw_only=True)
class ReadingOptions:
    """Say how logs are read.

    Parameters
    ----------
    rate
        Sampling rate [Hz] of a log without time stamps.
    flip_torque
        Whether the log's torque has the opposite sign.
    gain
        Torque per logged unit, one for all joints or one each; replaces the sheet's gains.
    torque_source
        What measured the torque; replaces the sheet's.
    sheet
        Recording sheet that describes the log: a path, a `RecordingSheet`, or a dict with the
        fields of one; by default the one next to the log.
    window
        Segments of the log to keep, each from start to stop [s] after the first sample; a text
        `START:STOP,...` does too. Replaces the sheet's windows.
    lock
        Joints that are not identified, with their positions [rad or m], None where unknown; a text
        `JOINT[=VALUE],...` does too. Added to the sheet's. `read_fitted_recordings` locks them.
    gravity
        Acceleration of free fall in the root frame [m/s^2], in place of the description's; `-z` and
        the other axes are 9.81 m/s^2 in that direction. `read_fitted_recordings` applies it.
    kp, kd
        Gains of the position servo [N m/rad, N m s/rad], one for all joints or one each, NaN where
        unknown; they replace the sheet's, and make torques of commands.
    torque_limit
        Largest torque of the position servo [N m], one for all joints or one each; NaN: none.
    deadband
        Control error up to which the position servo gives no torque [rad], one for all joints or
        one each; NaN: unknown, so that it is estimated from the log.
    lead
        Gain of the derivative of the position servo's control error over its stiffness [s], one for
        all joints or one each; NaN: it has none.
    no_load_speed
        Speed at which the torque limit of the position servo has fallen to zero [rad/s], one for
        all joints or one each; NaN: it does not fall.
    goal_acceleration, goal_speed
        Limits of the goal that the position servo derives from its command [rad/s^2, rad/s], one
        for all joints or one each; infinite: none, NaN: unknown, so that a limit of the
        acceleration is estimated from the log, and none of the speed.
    fixed_base
        Whether a free joint of the robot is held at its pose. `load_robot` holds it.
    free_base, contacts
        Whether the base of the robot is free, and the links or frames at which it may touch the
        ground. `load_robot` has them as `base` and `contacts`.

    Raises
    ------
    UsageError
        If the rate is not positive or the torque source is unknown.
    RecordingError
        If a dict is not a recording sheet.

    Examples
    --------
    >>> ReadingOptions(rate=100, gain=2.0).gain
    (2.0,)
    """

    rate: float | None = option(
        None, "HZ", "sampling rate of a log without time stamps", range=RATES
    )
    flip_torque: bool = switch(False, "the log's torque has the opposite sign")
    gain: ArrayLike | None = option(
        None,
        "G1,G2,...",
        "torque per logged unit, one for all joints or one each; replaces the sheet's",
        parse=_parse_numbers,
        range=GAINS,
    )
    torque_source: TorqueSource | None = option(
        None,
        "KIND",
        "where torques come from: sensor, motor, current or command (a servo)",
        choices=TORQUE_SOURCES,
    )
    sheet: PathLike | RecordingSheet | Mapping[str, Any] | None = option(
        None, "FILE", "recording sheet (TOML) that describes the logs", parse=Path
    )
    window: Sequence[tuple[float, float]] | str | None = option(
        None,
        "START:STOP,...",
        "segments of the log to keep, in seconds after its first sample; an end left"
        " out is that of the log",
        parse=parse_windows,
    )
    lock: Mapping[str, float | None] | str | None = option(
        None,
        "JOINT[=VALUE],...",
        "joints to hold still at a position [rad or m]: those that the log lacks,"
        " by themselves at 0",
        parse=str,
    )
    gravity: ArrayLike | str | None = option(
        None,
        "X,Y,Z",
        "free fall in the root frame [m/s^2], or its axis such as -z; replaces the robot's",
        parse=str,
        range=Range(-1e3, 1e3, "m/s^2"),
    )

    kp: ArrayLike | None = option(
        None,
        "K1,K2,...",
        "stiffness of the position servo [N m/rad], one or each; auto: identified",
        parse=parse_servo_numbers,
    )
    kd: ArrayLike | None = option(
        None,
        "D1,D2,...",
        "damping of the position servo [N m s/rad], one or each; auto: identified with"
        " viscous friction",
        parse=parse_servo_numbers,
    )
    torque_limit: ArrayLike | None = option(
        None,
        "T1,T2,...",
        "largest torque of the position servo [N m], one or each",
        parse=parse_servo_numbers,
    )
    deadband: ArrayLike | None = option(
        None,
        "E1,E2,...",
        "control error without torque [rad], one or each; auto (default): estimated from the log",
        parse=parse_servo_numbers,
    )
    lead: ArrayLike | None = option(
        None,
        "S1,S2,...",
        "derivative gain on the servo's control error over its stiffness [s], one or each",
        parse=parse_servo_numbers,
    )
    no_load_speed: ArrayLike | None = option(
        None,
        "W1,W2,...",
        "speed at which the servo's torque limit has fallen to zero [rad/s], one or each",
        parse=parse_servo_numbers,
    )
    goal_acceleration: ArrayLike | None = option(
        None,
        "A1,A2,...",
        "limit of the acceleration of the servo's goal [rad/s^2], one or each; none;"
        " auto (default): estimated from the log",
        parse=parse_servo_numbers,
    )
    goal_speed: ArrayLike | None = option(
        None,
        "V1,V2,...",
        "limit of the speed of the servo's goal [rad/s], one or each",
        parse=parse_servo_numbers,
    )
    fixed_base: bool = switch(False, HELD_BASE)
    free_base: bool = switch(
        False,
        "the robot stands on no fixed root: legs, drones, satellites; the log has its"
        " pose (base_x ..) or an inertial sensor (imu_wx .., imu_ax ..)",
    )
    contacts: str | None = option(None, "FRAME,...", CONTACTS)

    @property
    def windows(self) -> tuple[tuple[float, float], ...]:
        """Start and stop of each segment to keep [s]; none where all is kept."""
        return () if self.window is None else make_windows(self.window)

    def with_windows(self, sheet: RecordingSheet) -> RecordingSheet:
        """Return a sheet whose windows are those given here, if any are."""
        if self.window is None:
            return sheet
        windows = [SheetWindow(start=start, stop=stop) for start, stop in self.windows]
        return sheet.model_copy(update={"windows": windows})

    @property
    def base(self) -> BaseOptions:
        """The options that concern the base of the robot."""
        return BaseOptions(**{name: getattr(self, name) for name in OF_BASE})

    def __post_init__(self) -> None:
        if self.torque_source is not None:
            check_choice("torque_source", self.torque_source, TORQUE_SOURCES)
        for name in PER_JOINT:
            if getattr(self, name) is not None:
                values = np.atleast_1d(np.asarray(getattr(self, name), dtype=np.float64)).ravel()
                unlimited = np.isinf(values) & (name in LIMITS)
                inside = [math.isnan(value) or RANGES[name].holds(value) for value in values]
                beyond = ~(unlimited | np.array(inside))
                if np.any(beyond):
                    raise make_range_error(name, float(values[beyond][0]), RANGES[name])
                object.__setattr__(self, name, tuple(values.tolist()))
        if self.gain is not None:
            gains = np.atleast_1d(np.asarray(self.gain, dtype=np.float64))
            object.__setattr__(self, "gain", tuple(gains.ravel().tolist()))
        if self.window is not None:
            object.__setattr__(self, "window", make_windows(self.window))
        if isinstance(self.lock, str):
            object.__setattr__(self, "lock", locks_from_text(self.lock))
        if self.gravity is not None:
            object.__setattr__(self, "gravity", parse_gravity(self.gravity))
        if isinstance(self.sheet, Mapping):
            object.__setattr__(self, "sheet", RecordingSheet.model_validate(dict(self.sheet)))
        check_ranges(self)


def make_windows(
    given: Sequence[tuple[float, float]] | str,
) -> tuple[tuple[float, float], ...]:
    """Return windows, of their text too; raises `UsageError` for what is no segment of time."""
    try:
        pairs = parse_windows(given) if isinstance(given, str) else given
        windows = tuple((float(start), float(stop)) for start, stop in pairs)
    except (TypeError, ValueError):
        windows = ()
    if not windows or not all(0.0 <= start < stop for start, stop in windows):
        raise UsageError(
            "window is segments of the log from START to STOP in seconds, such as 5:60 or"
            f" 5:60,80:; got {given!r}",
            value=given,
        )
    return windows


def parse_gravity(given: ArrayLike | str) -> tuple[float, float, float]:
    """Return a gravity [m/s^2] from three numbers, from their text, or from an axis such as `-z`.

    Raises `UsageError` for anything else.

    >>> parse_gravity("-y"), parse_gravity("0,0,-9.8")
    ((0.0, -9.81, 0.0), (0.0, 0.0, -9.8))
    """
    text = given.strip().lower() if isinstance(given, str) else ""
    if len(text) in (1, 2) and text[-1] in "xyz" and text[:-1] in ("", "+", "-"):
        free_fall = float(np.linalg.norm(USUAL_GRAVITY)) * (-1.0 if text[0] == "-" else 1.0)
        x, y, z = (free_fall if axis == text[-1] else 0.0 for axis in "xyz")
        return x, y, z
    try:
        values = np.asarray(text.split(",") if text else given, dtype=np.float64).ravel()
    except (TypeError, ValueError):
        values = np.empty(0)
    if values.shape != (3,) or not np.all(np.isfinite(values)):
        raise UsageError(
            "gravity is three numbers [m/s^2], such as 0,0,-9.81, or an axis, such as -z; got"
            f" {given!r}",
            value=given,
        )
    x, y, z = values.tolist()
    return x, y, z


def merge_reading_options(
    options: ReadingOptions | None, settings: Mapping[str, Any]
) -> ReadingOptions:
    """Return the options with single settings replaced.

    Raises
    ------
    UsageError
        If there is no such setting.
    """
    (chosen,) = divide_settings(settings, ReadingOptions)
    return replace(options or ReadingOptions(), **chosen)
