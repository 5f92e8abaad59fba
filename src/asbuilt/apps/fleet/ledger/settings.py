"""What a ledger fixes for a robot type, and what its entries may hold.

docs/reference/fleet-ledger.md describes the columns. A number outside its range is of no log, and
its squares would overflow wherever an entry is used.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cached_property, lru_cache
from importlib.metadata import version as version_of
from typing import Any, Literal, get_args
from urllib.parse import quote

import polars as pl

from asbuilt.codec import format_json, make_plain, restore_dataclass
from asbuilt.description import RobotModel, model_document, model_from_document
from asbuilt.dynamics import BaseParameters, DriveSet, RegressorPlan, find_base_parameters
from asbuilt.errors import AsbuiltError, ResultError
from asbuilt.experiment import SignalChain, TorqueSource
from asbuilt.findings import Cure
from asbuilt.ranges import Range
from asbuilt.untrusted import parse_json

FORMAT = "asbuilt fleet settings"
FORMAT_VERSION = 1
"""Of all files of a ledger."""
SOFTWARE = version_of("asbuilt")
RESTORE = Cure("restore it from a copy, or rebuild the ledger from its logs")
DESCRIBED = ("source", "citation", "notes")
"""Fields of a robot that say where it is from; the same robot may come from two places."""


@dataclass(frozen=True, eq=False)
class TypeSettings:
    """Hold what all logs of a robot type are reduced with.

    Parameters
    ----------
    robot_type
        Name and digest of the robot as described: robots of one description are one type.
    generation
        Number of times that the type was made again.
    described
        The robot as described.
    model
        The robot as recorded: joints that are not logged are locked.
    drive
        Drive terms, every nonlinear parameter stated.
    chain
        The signal chain, every choice settled.
    torque_source
        What measured the torque.
    asked_drive, asked_chain
        What was asked for: the drive terms, None for the usual ones, and the chain with its open
        choices.
    chosen
        What was chosen, and from which log, as sentences.
    """

    robot_type: str
    generation: int
    described: RobotModel
    model: RobotModel
    drive: DriveSet
    chain: SignalChain
    torque_source: TorqueSource
    asked_drive: str | None = None
    asked_chain: SignalChain = field(default_factory=SignalChain)
    chosen: tuple[str, ...] = ()

    @cached_property
    def base(self) -> BaseParameters:
        """The base parameters."""
        return find_base_parameters(self.model, self.drive)

    @cached_property
    def plan(self) -> RegressorPlan:
        """The columns of each joint."""
        return RegressorPlan.of(self.model, self.drive, self.base.columns, spare_rows=1)

    @cached_property
    def content(self) -> bytes:
        """The settings as a JSON document, which `from_content` reads back to the last bit."""
        return format_json(self._document | {"digest": self.digest}).encode()

    @cached_property
    def digest(self) -> str:
        """Digest of all that the information depends on."""
        document = self._document
        model = {key: value for key, value in document["model"].items() if key not in DESCRIBED}
        kept = ("robot_type", "generation", "torque_source", "drive", "chain", "parameters")
        return _hash_document({key: document[key] for key in kept} | {"model": model})

    @cached_property
    def _document(self) -> dict[str, Any]:
        return {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "software": SOFTWARE,
            "robot_type": self.robot_type,
            "generation": self.generation,
            "torque_source": self.torque_source,
            "drive": list(self.drive.specifications),
            "chain": make_plain(self.chain),
            "parameters": list(self.base.names),
            "columns": [support.tolist() for support in self.plan.support],
            "joints": list(self.model.joint_names),
            "asked_drive": self.asked_drive,
            "asked_chain": make_plain(self.asked_chain),
            "chosen": list(self.chosen),
            "model": model_document(self.model),
            "described": model_document(self.described),
        }

    @property
    def path(self) -> str:
        """Where the ledger keeps the settings."""
        return f"types/{self.robot_type}/{self.generation:04d}.json"

    @property
    def pending_path(self) -> str:
        """Where the ledger keeps them until they are valid."""
        return f"pending/{self.robot_type}-{self.generation:04d}-{self.digest}.json"

    @classmethod
    @lru_cache(maxsize=64)
    def from_content(cls, content: bytes, path: str) -> TypeSettings:
        """Read settings.

        Raises
        ------
        ResultError
            If they are damaged, or of another format.
        """
        try:
            document = parse_json(content)
            check_version(
                path, document["format_version"] if document["format"] == FORMAT else None
            )
            found = cls(
                robot_type=str(document["robot_type"]),
                generation=int(document["generation"]),
                described=model_from_document(document["described"]),
                model=model_from_document(document["model"]),
                drive=DriveSet.parse(document["drive"]),
                chain=restore_dataclass(SignalChain, document["chain"]),
                torque_source=document["torque_source"],
                asked_drive=document["asked_drive"],
                asked_chain=restore_dataclass(SignalChain, document["asked_chain"]),
                chosen=tuple(map(str, document["chosen"])),
            )
        except ResultError:
            raise
        except (KeyError, TypeError, ValueError, AttributeError, AsbuiltError) as problem:
            why = str(problem) or type(problem).__name__
            raise make_damage_error(path, why, RESTORE) from problem
        if found.digest != document.get("digest", path.rpartition("-")[2].removesuffix(".json")):
            raise make_damage_error(path, "its content is not what its digest says", RESTORE)
        if path.startswith("types/") and not path.startswith(f"types/{found.robot_type}/"):
            why = f"it belongs to the type {found.robot_type}"
            raise make_damage_error(path, why, RESTORE)
        if list(found.base.names) != document["parameters"]:
            raise ResultError(
                f"{path} has other base parameters than its robot has today",
                cure=Cure("rebuild the ledger from its logs"),
                file=path,
            )
        return found


def check_version(path: str, version: object) -> None:
    """Raise `ResultError` unless a file of a ledger has the format version of this program."""
    if version != FORMAT_VERSION:
        raise ResultError(
            f"{path} has format version {version}, this program reads {FORMAT_VERSION}",
            cure=Cure("use the version of asbuilt that wrote the ledger, or rebuild it"),
            file=path,
        )


def name_robot_type(described: RobotModel) -> str:
    """Return the name of a robot type: the description's name and a digest of its content."""
    document = model_document(described)
    what = {key: value for key, value in document.items() if key not in DESCRIBED}
    return f"{quote(described.name, safe='')[:60]}-{_hash_document(what)}"


def _hash_document(document: Mapping[str, Any]) -> str:
    """Return the hexadecimal digits of a digest in names."""
    text = json.dumps(make_plain(document), sort_keys=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def make_damage_error(path: str, why: str, cure: Cure) -> ResultError:
    """Return the error of a file of a ledger that is damaged."""
    return ResultError(f"{path} is damaged: {why[:200]}", cure=cure, file=path)


EARLIEST = datetime(2000, 1, 1, tzinfo=UTC)
LATEST = datetime(2100, 1, 1, tzinfo=UTC)
"""Dates that a clock can be trusted for; a counter since power-on is none."""


def convert_to_utc(date: datetime) -> datetime:
    """Return a date in UTC, which one without time zone is in already."""
    return date.replace(tzinfo=UTC) if date.tzinfo is None else date.astimezone(UTC)


DateSource = Literal["given", "sheet", "stamps", "name"]
SCHEMA: dict[str, Any] = {
    "robot_id": pl.String,
    "robot_type": pl.String,
    "settings": pl.String,
    "log": pl.String,
    "source_sha256": pl.String,
    "date": pl.Datetime("us", "UTC"),
    "date_from": pl.String,
    "duration": pl.Float64,
    "rate": pl.Float64,
    "block": pl.Int16,
    "start": pl.Float64,
    "stop": pl.Float64,
    "n_samples": pl.Int64,
    "joint": pl.String,
    "torque_sum": pl.Float64,
    "columns": pl.List(pl.Int16),
    "factor": pl.List(pl.Float64),
    "tilt": pl.List(pl.Float64),
    "covariates": pl.List(pl.Struct({"name": pl.String, "value": pl.Float64})),
    "warnings": pl.List(pl.String),
    "software": pl.String,
    "format_version": pl.Int16,
}
SUMS = Range(-1e18, 1e18)
"""Sums over samples: 1e12 of them, of 1 MN m each; fourth powers do not overflow."""
LEAST = 1e-9
"""Largest number of a factor [N m] below which its log says nothing: drives resolve 1e-4 N m."""
RANGES: Mapping[str, Range] = {
    "duration": Range(0.0, 1e9, "s", above=True),  # thirty years
    "rate": Range(1e-3, 1e6, "Hz"),
    "start": Range(-1e10, 1e10, "s"),
    "stop": Range(-1e10, 1e10, "s"),
    "n_samples": Range(1, 1e12),
    "torque_sum": SUMS,
    "factor": SUMS,
    "tilt": SUMS,
    "covariates": Range(-1e6, 1e6),
}
OPTIONAL = ("tilt", "covariates")
"""Columns that may lack values; earlier entries have no `tilt` at all."""
LONGEST_TEXT = 1000
"""Letters of a text, such as the name of a log with its folders."""


def check_schema(frame: pl.DataFrame) -> None:
    """Raise `ValueError` with column and value unless a table is one of an entry."""
    for name, kind in SCHEMA.items():
        if name == "tilt" and name not in frame.columns:
            continue
        column = frame[name]
        if column.dtype != kind:
            raise ValueError(f"{name} is of type {column.dtype}, not {kind}")
        if name not in OPTIONAL and column.has_nulls():
            raise ValueError(f"{name} has no value in some rows")
        values = column.explode() if isinstance(kind, pl.List) else column
        if values.dtype == pl.Struct:
            _check_texts(name, values.struct.field("name"))
            values = values.struct.field("value")
        if name in RANGES:
            _check_numbers(name, values.drop_nulls())
        elif values.dtype == pl.String:
            _check_texts(name, values)
    if not (frame["factor"].explode().abs() >= LEAST).any():
        raise ValueError("factor holds no information: all of its numbers are zero")
    _check_dates(frame["date"])
    if not frame["date_from"].is_in(get_args(DateSource)).all():
        raise ValueError(f"date_from is {frame['date_from'][0]!r}, not {get_args(DateSource)}")
    if (frame["start"] > frame["stop"]).any():
        raise ValueError("start lies behind stop in some rows")


def _check_numbers(name: str, values: pl.Series) -> None:
    allowed = RANGES[name]
    outside = ~values.is_between(allowed.lower, allowed.upper)  # NaN is in no range
    if allowed.above:
        outside |= values == allowed.lower
    if outside.any():
        worst = values.filter(outside)[0]
        raise ValueError(f"{name} holds {worst:g}; it must be a number {allowed}")


def _check_texts(name: str, texts: pl.Series) -> None:
    lengths = texts.drop_nulls().str.len_chars().to_list()
    if lengths and max(lengths) > LONGEST_TEXT:
        raise ValueError(f"{name} has {max(lengths)} letters; at most {LONGEST_TEXT} are read")


def _check_dates(dates: pl.Series) -> None:
    """Compare as numbers, since Python has no dates beyond the year 9999."""
    first, last = (int(limit.timestamp() * 1e6) for limit in (EARLIEST, LATEST))
    stamps = dates.cast(pl.Int64)
    if not stamps.is_between(first, last, closed="left").all():
        raise ValueError(f"date is not between {EARLIEST:%Y} and {LATEST:%Y}")
