"""What was found in a log: events, thresholds, findings; stored thresholds."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from asbuilt.apps.watch.events import Event, Kind
from asbuilt.apps.watch.thresholds import Thresholds
from asbuilt.arrays import Array
from asbuilt.codec import FieldError, format_json, make_plain, restore_dataclass
from asbuilt.errors import ResultError
from asbuilt.findings import Cure, Finding, list_warnings
from asbuilt.tables import (
    Column,
    Shown,
    Table,
    format_plus_minus,
    round_significant,
    shorten_text,
    wrap_text,
)
from asbuilt.untrusted import parse_json, read_text

ELSEWHERE = 1e-3
"""Probability of the fit below which a force at the tool does not explain the torques."""
POINTS = 3000
"""Points of a trace, of each chunk of a log."""


KINDS: dict[Kind, tuple[str, str]] = {
    "contact": ("contact", "contacts"),
    "fault": ("fault of one joint", "faults"),
    "payload": ("change of payload", "payloads"),
}
"""Kinds of events in words, one and several."""
FORMAT = "asbuilt thresholds"
LARGEST = 1_000_000
"""Bytes of a file of thresholds; a file of seven joints has 4 kB."""


@dataclass(frozen=True, slots=True, eq=False)
class Trace:
    """Hold residual and threshold for drawing: in each bin the sample with the largest excess.

    `t` (B, n) [s], `residual` and `limit` (B, n).
    """

    t: Array
    residual: Array
    limit: Array

    def thinned(self, bins: int) -> Trace:
        """Return the samples of largest excess of at most `bins` bins, joint by joint."""
        ratio = np.abs(self.residual) / self.limit
        starts = np.unique(np.linspace(0, len(ratio), bins + 1).astype(int)[:-1]).tolist()
        spans = pairwise([*starts, len(ratio)])
        rows = np.array([start + np.argmax(ratio[start:stop], axis=0) for start, stop in spans])
        return Trace(*(np.take_along_axis(x, rows, 0) for x in (self.t, self.residual, self.limit)))

    @classmethod
    def joined(cls, traces: Sequence[Trace]) -> Trace:
        """Return traces one after another."""
        parts = zip(*((trace.t, trace.residual, trace.limit) for trace in traces), strict=True)
        return cls(*map(np.concatenate, parts))


@dataclass(frozen=True, slots=True, eq=False)
class WatchedLog:
    """Hold what was found in a log.

    Parameters
    ----------
    robot, source, joint_names
        The robot, the log and its n joints.
    model
        `"as_built"` or `"cad"`: the model of the observer.
    frame
        Link or frame at which forces are given.
    n_samples, seconds
        Size of the log, gaps left out.
    thresholds, events, findings
        The thresholds, and what was found.
    trace
        Residual and threshold for drawing.
    units
        Unit of each joint's torque, `"N m"` or `"N"`.
    smallest_force
        Step of force at the frame [N] that is seen within 20 ms, median over poses of this log.
    """

    robot: str
    source: str
    model: str
    frame: str
    joint_names: tuple[str, ...]
    n_samples: int
    seconds: float
    thresholds: Thresholds
    events: tuple[Event, ...]
    findings: tuple[Finding, ...]
    trace: Trace
    units: tuple[str, ...]
    smallest_force: float

    @property
    def rate_verified(self) -> bool:
        """Whether recordings without contact, of the time of one false alarm, set the thresholds.

        Thresholds from less lie beyond what was recorded.
        """
        thresholds = self.thresholds
        return thresholds.held_out and thresholds.hours * thresholds.false_alarms_per_hour >= 1.0

    @property
    def largest(self) -> tuple[str, float, float]:
        """Joint, time [s] and size, per threshold, of the largest residual."""
        ratio = np.abs(self.trace.residual) / self.trace.limit
        k, j = np.unravel_index(int(np.argmax(ratio)), ratio.shape)
        return self.joint_names[j], float(self.trace.t[k, j]), float(ratio[k, j])

    def as_document(self) -> dict[str, Any]:
        """Return plain numbers, texts and lists, for JSON."""
        thresholds = self.thresholds
        return {
            "robot": self.robot,
            "source": self.source,
            "model": self.model,
            "frame": self.frame,
            "joints": list(self.joint_names),
            "n_samples": self.n_samples,
            "seconds": self.seconds,
            "bandwidth": thresholds.bandwidth,
            "false_alarms_per_hour": thresholds.false_alarms_per_hour,
            "expected_false_alarms": thresholds.false_alarms_per_hour * self.seconds / 3600.0,
            "rate_verified": self.rate_verified,
            "smallest_force": self.smallest_force,
            "largest": dict(zip(("joint", "time", "ratio"), self.largest, strict=True)),
            "events": [event.as_document() for event in self.events],
            "thresholds": make_plain(thresholds),
            "warnings": list_warnings(self.findings),
        }

    def sentences(self) -> tuple[str, ...]:
        """Return log, thresholds and verdict as sentences."""
        thresholds = self.thresholds
        rate = thresholds.false_alarms_per_hour
        model = "as built" if self.model == "as_built" else "as described (CAD)"
        joint, time, ratio = self.largest
        kinds = [event.kind for event in self.events]
        counts = ", ".join(
            f"{kinds.count(kind)} {names[kinds.count(kind) > 1]}"
            for kind, names in KINDS.items()
            if kind in kinds
        )
        return (
            f"{self.robot}, {shorten_text(self.source, 60)}: {self.n_samples} samples,"
            f" {format_duration(self.seconds)}, watched with the model {model}.",
            f"Thresholds for {rate:g} false alarm{'s' * (rate != 1.0)} per hour"
            f" ({round_significant(rate * self.seconds / 3600.0, 2)} expected in this log), from"
            f" {format_duration(3600.0 * thresholds.hours)}"
            + (" without contact" if thresholds.held_out else " of this log itself")
            + ("." if self.rate_verified else ", which do not verify the rate."),
            f"Events: {counts or 'none'}. The largest external torque is"
            f" {round_significant(ratio, 2)}"
            f" times its threshold ({joint}, {time:.2f} s).",
            f"A step of force at {self.frame} of {round_significant(self.smallest_force, 2)} N is"
            " seen"
            " within 20 ms (median over directions and poses of this log).",
        )

    def table(self) -> Table:
        """Return the events, one a row."""
        columns = (
            Column("start", "s", "decimal"),
            Column("lasts", "s", "decimal"),
            Column("what", width=8),
            Column("where", width=18),
            Column("joint", detail=True),
            Column("torque", align="decimal"),
            Column("limit", align="decimal"),
            Column("force", "N", width=18),
            Column("x", "N", detail=True),
            Column("y", "N", detail=True),
            Column("z", "N", detail=True),
            Column("p", style=".2g", detail=True),
        )
        return Table(
            columns,
            tuple(self._make_row(event) for event in self.events),
            notes=(
                f"A contact acts at the link named or beyond it. Torque and limit"
                f" [{format_torque_unit(self.units)}] of the"
                " joint farthest beyond its threshold; force on the robot if it acts at"
                f" {self.frame}, or change of mass there, +/- standard error.",
            ),
            details=(
                "x, y, z: the force in root axes; p: probability of a worse fit if it acts at"
                f" {self.frame} and there alone.",
            ),
        )

    def as_text(self, full: bool = False) -> str:
        """Return findings and events for a terminal of 80 columns."""
        parts = [wrap_text(line) for line in self.sentences()]
        if self.events:
            parts += ["", self.table().as_text(full).rstrip("\n")]
        return "\n".join(parts) + "\n"

    def _make_row(self, event: Event) -> tuple[Any, ...]:
        ratio = np.abs(event.residual) / event.threshold
        k = int(np.argmax(ratio))
        force = event.contact.force
        errors = event.contact.force_error
        size = float(np.linalg.norm(force))
        along = force / size if size > 0.0 else np.zeros(3)
        if event.mass is not None:
            shown = f"{format_plus_minus(event.mass, event.mass_error)} kg"
        elif event.kind == "fault":
            shown = ""
        elif event.contact.p_value < ELSEWHERE:
            shown = "not at the tool"
        else:
            shown = format_plus_minus(size, float(np.sqrt(np.sum((along * errors) ** 2))))
        return (
            Shown(event.start, f"{event.start:.2f}"),
            Shown(event.duration, f"{event.duration:.2f}"),
            event.kind,
            event.joints[0] if event.kind == "fault" else event.link,
            self.joint_names[k],
            Shown(float(event.residual[k]), round_significant(float(event.residual[k]))),
            Shown(float(event.threshold[k]), round_significant(float(event.threshold[k]))),
            shown,
            *(format_plus_minus(float(f), float(e)) for f, e in zip(force, errors, strict=True)),
            event.contact.p_value,
        )


def format_torque_unit(units: Sequence[str]) -> str:
    """Return the unit of the torques of some joints as one text.

    >>> format_torque_unit(("N m", "N", "N m")), format_torque_unit(("N m", "N m"))
    ('N m or N', 'N m')
    """
    return " or ".join(dict.fromkeys(units))


def format_duration(seconds: float) -> str:
    """Return a time [s] with its unit: seconds, minutes or hours."""
    if seconds < 120.0:
        return f"{seconds:.3g} s"
    return f"{seconds / 60.0:.3g} min" if seconds < 7200.0 else f"{seconds / 3600.0:.3g} h"


def format_thresholds(thresholds: Thresholds) -> str:
    """Return thresholds as JSON that `read_thresholds` reads."""
    return format_json({"format": FORMAT, **make_plain(thresholds)})


def read_thresholds(path: str | os.PathLike[str]) -> Thresholds:
    """Read thresholds that `watch` wrote.

    Raises
    ------
    ResultError
        If the file cannot be read, holds no thresholds, or is damaged.
    """
    text = read_text(Path(path), "thresholds", ResultError, LARGEST)
    again = Cure("give the thresholds.json that watch wrote")
    try:
        whole = parse_json(text)
        if not isinstance(whole, Mapping) or whole.get("format") != FORMAT:
            raise ResultError(f"{path} holds no thresholds", cure=again, file=str(path))
        return restore_dataclass(Thresholds, whole)
    except ResultError:
        raise
    except (ValueError, TypeError, KeyError, FieldError) as problem:
        raise ResultError(
            f"{path}: the thresholds are damaged: {problem}", cure=again, file=str(path)
        ) from None
