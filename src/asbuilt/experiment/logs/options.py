"""Options of reading recordings: one class that owns every default."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.errors import UsageError
from asbuilt.experiment.logs.sheet import RecordingSheet
from asbuilt.experiment.recording import TORQUE_SOURCES, TorqueSource

PathLike = str | Path


def _numbers(text: str) -> tuple[float, ...]:
    values = tuple(float(part) for part in text.split(","))
    if not all(map(math.isfinite, values)):
        raise ValueError(text)
    return values


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
        fields of one; by default the one beside the log.

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

    rate: float | None = field(
        default=None,
        metadata={"help": "sampling rate of a log without time stamps", "metavar": "HZ"},
    )
    flip_torque: bool = field(
        default=False, metadata={"help": "the log's torque has the opposite sign"}
    )
    gain: ArrayLike | None = field(
        default=None,
        metadata={
            "help": "torque per logged unit, one for all joints or one each; replaces the sheet's",
            "metavar": "G1,G2,...",
            "parse": _numbers,
        },
    )
    torque_source: TorqueSource | None = field(
        default=None,
        metadata={
            "help": "what measured the torque: sensor, motor or current",
            "metavar": "KIND",
            "choices": TORQUE_SOURCES,
        },
    )
    sheet: PathLike | RecordingSheet | Mapping[str, Any] | None = field(
        default=None,
        metadata={
            "help": "recording sheet (TOML) that describes the logs",
            "metavar": "FILE",
            "parse": Path,
        },
    )

    def __post_init__(self) -> None:
        if self.rate is not None and not 0.0 < self.rate < np.inf:
            raise UsageError(
                f"the sampling rate must be a positive number of Hz, got {self.rate:g}",
                value=self.rate,
                lower=0.0,
            )
        if self.torque_source not in (None, *TORQUE_SOURCES):
            raise UsageError(
                f"torque_source {self.torque_source!r} is not one of {', '.join(TORQUE_SOURCES)}",
                value=self.torque_source,
                available=TORQUE_SOURCES,
            )
        if self.gain is not None:
            gains = np.atleast_1d(np.asarray(self.gain, dtype=np.float64))
            object.__setattr__(self, "gain", tuple(gains.ravel().tolist()))
        if isinstance(self.sheet, Mapping):
            object.__setattr__(self, "sheet", RecordingSheet.model_validate(dict(self.sheet)))


def reading_options(options: ReadingOptions | None, settings: Mapping[str, Any]) -> ReadingOptions:
    """Return the options with single settings replaced.

    Raises
    ------
    UsageError
        If there is no such setting.
    """
    known = [entry.name for entry in fields(ReadingOptions)]
    unknown = [name for name in settings if name not in known]
    if unknown:
        raise UsageError(
            f"{unknown[0]!r} is not an option of reading; there are {', '.join(known)}",
            value=unknown[0],
            available=known,
        )
    return replace(options or ReadingOptions(), **settings)
