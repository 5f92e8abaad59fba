"""Recording sheets: description of a log in TOML, written next to it."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    WithJsonSchema,
    model_validator,
)

from asbuilt.dynamics.drives.position_servo import PER_JOINT
from asbuilt.errors import RecordingError
from asbuilt.experiment.logs.columns.roles import parse_unit_scale
from asbuilt.experiment.recording import TorqueSource
from asbuilt.ranges import Range
from asbuilt.registry import list_known_fields, suggest_name
from asbuilt.untrusted import describe_problem, parse_toml, read_text

ColumnName = int | str
LONGEST_NUMBER = 4
"""Digits of the number of a column; a log has at most 10 000 of them."""
ROBOT_FIELDS = {"links", "dh", "robot", "gravity"}
"""Fields of a robot description, which a recording sheet does not have."""


def _spread_numbers(value: object) -> object:
    """Spread "2-7" or "q_1 - q_6" over the numbers between; a single name is a list of one."""
    if isinstance(value, list):
        spread = [_spread_numbers(part) for part in value]
        return [item for part in spread for item in (part if isinstance(part, list) else [part])]
    if isinstance(value, int) and not isinstance(value, bool):
        return [value]
    if not isinstance(value, str):
        return value
    numbers = re.fullmatch(r"\s*(\D*?)(\d+)\s*(?:-|:|\.\.)\s*(\D*?)(\d+)\s*", value)
    if numbers is None or numbers.group(1) != numbers.group(3):
        return [value]
    if max(len(numbers.group(2)), len(numbers.group(4))) > LONGEST_NUMBER:
        raise ValueError(f"the range {value[:60]!r} is too long")
    prefix = numbers.group(1)
    first = int(numbers.group(2))
    last = int(numbers.group(4))
    if last < first:
        raise ValueError(f"the range {value!r} runs backwards; list its columns one by one")
    return [f"{prefix}{k}" if prefix else k for k in range(first, last + 1)]


def _list_without_values(value: object) -> object:
    """Give each joint of a list no position."""
    return dict.fromkeys(value) if isinstance(value, list) else value


FiniteNumber = Annotated[float, Field(allow_inf_nan=False)]
ServoNumber = Annotated[float, Field(ge=0, allow_inf_nan=False)] | Literal["auto"]
ServoNumbers = ServoNumber | list[ServoNumber] | None
GoalNumber = ServoNumber | Literal["none"]
GoalNumbers = GoalNumber | list[GoalNumber] | None
_COLUMN = {"anyOf": [{"type": "integer"}, {"type": "string"}]}
ColumnList = Annotated[
    list[ColumnName],
    BeforeValidator(_spread_numbers),
    WithJsonSchema({"anyOf": [*_COLUMN["anyOf"], {"type": "array", "items": _COLUMN}]}),
]
_LOCK = {
    "anyOf": [
        {"type": "array", "items": {"type": "string"}},
        {"type": "object", "additionalProperties": {"type": "number"}},
    ]
}


RATES = Range(1e-3, 1e6, "Hz")
"""Sampling rates: a sample in a quarter of an hour, and a thousand in a millisecond."""
GAINS = Range(-1e9, 1e9)
ANY = Range(-1e12, 1e12)
"""Any quantity in any unit, such as the ticks of a counter."""
RANGES = {"rate": RATES, "gains": GAINS, "time_factor": Range(1e-12, 1e12)} | {
    name: Range(0.0, 1e9) for name in PER_JOINT
}
"""Ranges of numbers, by field."""


def _list_numbers(given: Any) -> list[Any]:
    """Return the numbers of a field."""
    values = given if isinstance(given, list) else [given]
    return [value for value in values if isinstance(value, int | float)]


class _Part(BaseModel):
    # Parts are built with the sheet that has them, which takes half as long.
    model_config = ConfigDict(extra="forbid", frozen=True, strict=False, defer_build=True)

    @model_validator(mode="before")
    @classmethod
    def _refuse_truth(cls, given: Any) -> Any:
        """Refuse `rate = true`, which would be 1."""
        for name, value in given.items() if isinstance(given, Mapping) else ():
            if (
                any(isinstance(number, bool) for number in _list_numbers(value))
                and name != "header"
            ):
                raise ValueError(f"{name} = {str(value).lower()} is given; a number is expected")
        return given

    @model_validator(mode="after")
    def _check_ranges(self) -> Self:
        for name in type(self).model_fields:
            for value in _list_numbers(getattr(self, name)):
                allowed = RANGES.get(name, ANY)
                if isinstance(value, float) and math.isfinite(value) and not allowed.holds(value):
                    raise ValueError(f"{name} is {value:g}; it must be a number {allowed}")
        return self


BASE_VECTORS = {
    "base_position": ("base_", "xyz"),
    "base_quaternion": ("base_q", "xyzw"),
    "base_velocity": ("base_v", "xyz"),
    "base_angular_velocity": ("base_w", "xyz"),
    "imu_acceleration": ("imu_a", "xyz"),
    "imu_angular_velocity": ("imu_w", "xyz"),
    "imu_quaternion": ("imu_q", "xyzw"),
}
"""Beginnings and ends of the usual names of columns of a floating base, by field of a sheet."""


class SheetColumns(_Part):
    """Columns by name, or by number from 1.

    Lists in joint order, where "2-7" and "q_1-q_6" stand for all between. Columns of a floating
    base and of its inertial sensor are x y z, or x y z w, in SI; `contact` has the flag of each
    contact.
    """

    time: ColumnName | None = None
    position: ColumnList | None = None
    velocity: ColumnList | None = None
    acceleration: ColumnList | None = None
    torque: ColumnList | None = None
    command: ColumnList | None = None
    motor_position: ColumnList | None = None
    link_position: ColumnList | None = None
    base_position: ColumnList | None = None
    base_quaternion: ColumnList | None = None
    base_velocity: ColumnList | None = None
    base_angular_velocity: ColumnList | None = None
    imu_acceleration: ColumnList | None = None
    imu_angular_velocity: ColumnList | None = None
    imu_quaternion: ColumnList | None = None
    contact: dict[str, ColumnName] = Field(default_factory=dict)
    extra: dict[str, ColumnList] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _check_vectors(self) -> Self:
        for name, (_, axes) in BASE_VECTORS.items():
            listed = getattr(self, name)
            if listed is not None and len(listed) != len(axes):
                raise ValueError(
                    f"columns.{name} lists {len(listed)} columns; list {len(axes)}, in the order"
                    f" {' '.join(axes)}"
                )
        return self

    @property
    def by_base(self) -> dict[str, ColumnName]:
        """The columns of a floating base and its contacts that are listed, by their usual names."""
        found = {f"contact_{frame}": column for frame, column in self.contact.items()}
        for name, (start, axes) in BASE_VECTORS.items():
            usual = [f"{start}{axis}" for axis in axes]
            found |= zip(usual, getattr(self, name) or (), strict=False)
        return found

    @property
    def numbered(self) -> bool:
        """Whether positions are given, and all columns by number, so that names do not matter."""
        columns = [column for listed in self.by_group.values() for column in listed]
        return self.position is not None and all(
            isinstance(column, int) for column in [*columns, *([self.time] if self.time else [])]
        )

    @property
    def by_group(self) -> dict[tuple[str, str], list[ColumnName]]:
        """The columns that are listed, by quantity and kind: an encoder's side, or "sheet"."""
        given: dict[tuple[str, str], list[ColumnName] | None] = {
            ("position", ""): self.position,
            ("velocity", ""): self.velocity,
            ("acceleration", ""): self.acceleration,
            ("torque", ""): self.torque,
            ("command", ""): self.command,
            ("position", "motor"): self.motor_position,
            ("position", "link"): self.link_position,
        }
        given |= {(name, "sheet"): columns for name, columns in self.extra.items()}
        return {group: columns for group, columns in given.items() if columns is not None}


class SheetUnits(_Part):
    """Units of the log, each converted to SI: "deg", "deg/s", "mN m", "ms", ..."""

    time: str | None = None
    position: str | None = None
    velocity: str | None = None
    acceleration: str | None = None
    torque: str | None = None
    command: str | None = None

    @model_validator(mode="after")
    def _check_units(self) -> SheetUnits:
        for name, unit in self.model_dump().items():
            if unit is not None and parse_unit_scale(unit) is None:
                raise ValueError(
                    f"units.{name}: {unit!r} is not known; write s, ms, us, ns | rad, deg, mrad, m,"
                    " mm (per s, s^2) | N m, mN m, kN m, N | A, mA"
                )
        return self


class SheetRange(_Part):
    """Positions [rad or m] of a joint at two numbers of the log, such as 0 and 100."""

    logged: tuple[FiniteNumber, FiniteNumber]
    position: tuple[FiniteNumber, FiniteNumber]

    @model_validator(mode="after")
    def _check_extent(self) -> SheetRange:
        for name, (first, last) in (("logged", self.logged), ("position", self.position)):
            if first == last:
                raise ValueError(f"joint_units: {name} = [{first:g}, {last:g}] has no extent")
        return self


def _refuse_unknown_unit(unit: object) -> object:
    """Refuse the text of an unknown unit."""
    if isinstance(unit, str) and parse_unit_scale(unit) is None:
        raise ValueError(f"joint_units: {unit!r} is not known; write rad, deg, mrad, m or mm")
    return unit


class SheetWindow(_Part):
    """A segment of the recording to keep [s], counted from its first sample."""

    start: float = 0.0
    stop: float = Field(default=float("inf"))

    @model_validator(mode="after")
    def _check_order(self) -> SheetWindow:
        if not self.stop > self.start:
            raise ValueError(
                f"windows: stop {self.stop:g} s does not come after start {self.start:g} s"
            )
        return self


class SheetFiles(_Part):
    """Separate files for the quantities, relative to the sheet."""

    position: str | None = None
    velocity: str | None = None
    acceleration: str | None = None
    torque: str | None = None


class RecordingSheet(_Part):
    """Describe a log: every field is optional and overrides what the column names give.

    `sign` multiplies the torques (-1 where the log gives the load's torque instead of the drive's;
    "command" where it gives magnitudes, with the sign of the servo's control error),
    `gains` turn them into N m (amperes times N m/A); `position_sign` multiplies positions,
    velocities, accelerations and commands (-1 where the log's joint turns the other way than the
    description's); each is one number or one per joint. `zero`
    are the positions [rad or m] that the log gives where the description has zero, and
    `time_factor` multiplies the log's times, where its clock is wrong. `lock`
    names joints that are not identified, with their positions [rad or m] if these are known.
    `joints` lists the joints in the order of the columns, or gives the robot's name of each joint
    of the log. `kp`, `kd` and the limits describe the position servo, "auto" if unknown; of
    the acceleration and the speed of its goal also "none". `joint_units` are for single
    joints, in place of `units`: a unit, or the positions at two numbers of the log. `topic` and
    `command_topic` hold the joint states and the commanded ones in a bag, and
    `command_joints` the joints of commands that are numbers alone, in their order; `base_topic` and
    `imu_topic` the pose of a floating base and its inertial sensor, whose links or frames in the
    description are `base_frame` and `imu_frame`. `date` is when
    the recording began, in UTC unless it names a time zone.

    Examples
    --------
    >>> sheet = RecordingSheet.model_validate({"rate": 100, "columns": {"position": "2-4"}})
    >>> sheet.columns.position
    [2, 3, 4]
    """

    rate: float | None = Field(default=None, gt=0, allow_inf_nan=False)
    header: bool | None = None
    separator: Literal[",", ";", "\t", "|", " "] | None = None
    joints: list[str] | dict[str, str] | None = None
    torque_source: TorqueSource | None = None
    sign: float | list[float] | Literal["command"] | None = None
    gains: float | list[float] | None = None
    position_sign: float | list[float] | None = None
    zero: FiniteNumber | list[FiniteNumber] | None = None
    time_factor: float | None = Field(default=None, gt=0, allow_inf_nan=False)
    kp: ServoNumbers = None
    kd: ServoNumbers = None
    torque_limit: ServoNumbers = None
    no_load_speed: ServoNumbers = None
    deadband: ServoNumbers = None
    lead: ServoNumbers = None
    goal_acceleration: GoalNumbers = None
    goal_speed: GoalNumbers = None
    columns: SheetColumns = SheetColumns()
    units: SheetUnits = SheetUnits()
    joint_units: dict[str, Annotated[str | SheetRange, BeforeValidator(_refuse_unknown_unit)]] = (
        Field(default_factory=dict)
    )
    windows: list[SheetWindow] = Field(default_factory=list)
    files: SheetFiles = SheetFiles()
    lock: Annotated[
        dict[str, FiniteNumber | None], BeforeValidator(_list_without_values), WithJsonSchema(_LOCK)
    ] = Field(default_factory=dict)
    topic: str | None = None
    command_topic: str | None = None
    base_topic: str | None = None
    imu_topic: str | None = None
    base_frame: str | None = None
    imu_frame: str | None = None
    command_joints: list[str] | None = None
    date: datetime | None = None

    @property
    def names_commands(self) -> bool:
        """Whether the log is read for its commands: where they cannot be used, that is an error."""
        stated = (self.kp, self.kd, self.command_topic, self.command_joints, self.columns.command)
        return self.torque_source == "command" or any(each is not None for each in stated)

    def in_windows(self, t: NDArray[np.float64], start: float) -> NDArray[np.bool_]:
        """Return which times (N,) [s] of a recording that began at `start` lie in a window.

        All do where there are no windows.
        """
        inside = [
            (t >= start + window.start) & (t < start + window.stop) for window in self.windows
        ]
        return np.any(inside, axis=0) if inside else np.ones(t.size, dtype=np.bool_)

    @model_validator(mode="after")
    def _check_signs(self) -> RecordingSheet:
        for name in ("sign", "position_sign"):
            given = getattr(self, name)
            if any(sign not in (1, -1) for sign in _list_numbers(given)):
                raise ValueError(
                    f"{name}: {given} is given; each sign is 1 or -1 (other factors are gains)"
                )
        if any(gain == 0 or not math.isfinite(gain) for gain in _list_numbers(self.gains)):
            raise ValueError(f"gains: {self.gains} is given; each must be finite and not zero")
        return self


def read_sheet(path: str | Path) -> RecordingSheet:
    """Read a recording sheet.

    Raises
    ------
    RecordingError
        If the file is no TOML, or has an unknown field or an invalid value.
    """
    path = Path(path)
    text = read_text(path, "recording sheet", RecordingError)
    try:
        content = parse_toml(text)
    except ValueError as error:
        raise RecordingError(
            f"recording sheet {path} is not TOML: {describe_problem(error)}", file=str(path)
        ) from None
    try:
        return RecordingSheet.model_validate(content)
    except ValidationError as error:
        raise RecordingError(_explain_faults(path, error), file=str(path)) from error


def find_sheet_beside(log: Path) -> Path | None:
    """Return the sheet next to a log: `run.csv.toml` or `run.toml`; None if there is none."""
    candidates = (log.with_name(log.name + ".toml"), log.with_suffix(".toml")) if log.name else ()
    for candidate in candidates:
        fields: set[str] = set()
        if candidate != log and candidate.is_file():
            with suppress(ValueError):  # what is no TOML is refused where it is read
                fields = set(parse_toml(read_text(candidate, "recording sheet", RecordingError)))
            if not fields & ROBOT_FIELDS:
                return candidate
    return None


def find_sheet_of_another(log: Path) -> Path | None:
    """Return the sheet of another log of the same kind in the folder of one without any."""
    if find_sheet_beside(log) is not None or not log.parent.is_dir():
        return None
    others = (path for path in sorted(log.parent.glob(f"*{log.suffix}.toml")) if path.is_file())
    return next((path for path in others if path.with_suffix("").is_file()), None)


def _explain_faults(path: Path, error: ValidationError) -> str:
    problems = []
    for item in error.errors():
        *place, last = item["loc"] or ("",)
        field = ".".join(
            str(part)
            for part in item["loc"]
            if not (isinstance(part, str) and ("[" in part or part in {"int", "str", "float"}))
        )
        problem = item["msg"].removeprefix("Value error, ")
        if item["type"] == "extra_forbidden" and not place and last in ROBOT_FIELDS:
            return (
                f"{path} is a robot description, not a recording and no recording sheet; the robot"
                " comes first, then the logs"
            )
        if item["type"] == "extra_forbidden":
            known = list_known_fields(RecordingSheet.model_json_schema(), place)
            near = suggest_name(str(last), known)
            problem = f"field {field!r} is not known here; {near}known are {', '.join(known)}"
        elif item["type"] != "value_error":
            problem = f"field {field!r} is {item['input']!r}: {problem[0].lower()}{problem[1:]}"
        problems.append(problem)
    return f"recording sheet {path}: {'; '.join(dict.fromkeys(problems))}"
