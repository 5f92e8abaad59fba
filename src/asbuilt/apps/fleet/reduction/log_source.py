"""Logs as they come: what identifies them, when they were recorded, and how they are read."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path

from asbuilt import StudyOptions, prepare
from asbuilt.apps.fleet.ledger.settings import (
    EARLIEST,
    LATEST,
    DateSource,
    TypeSettings,
    convert_to_utc,
    name_robot_type,
)
from asbuilt.description import RobotModel
from asbuilt.errors import RecordingError, UsageError
from asbuilt.experiment import (
    ReadingOptions,
    Recording,
    RecordingStream,
    Samples,
    SignalChain,
    find_sheet,
    head_of,
    read_fitted_recordings,
)
from asbuilt.findings import Cure, join_names
from asbuilt.identification import settle_drive
from asbuilt.untrusted import shorten_path

LONGEST_PATTERN = 250
"""Characters of a pattern that finds identities in paths."""
_IN_NAME = re.compile(
    r"(?<!\d)(20\d\d)([-_.]?)(0[1-9]|1[0-2])\2(0[1-9]|[12]\d|3[01])"
    r"(?:[T_ -]?([01]\d|2[0-3])[-_.:h]?([0-5]\d)(?:[-_.:m]?([0-5]\d))?)?(?!\d)"
)


def hash_sources(paths: Sequence[Path]) -> str:
    """Return the SHA-256 of the content of a recording's files, which may lie in folders.

    Raises `RecordingError` if one cannot be read.
    """
    digest = hashlib.sha256()
    try:
        for path in sorted(paths, key=lambda path: path.name):
            for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
                if file.is_file():
                    with file.open("rb") as stream:
                        digest.update(hashlib.file_digest(stream, "sha256").digest())
    except OSError as problem:
        raise RecordingError(
            f"recording {paths[0]} cannot be read: {problem.strerror or problem}",
            file=str(paths[0]),
        ) from problem
    return digest.hexdigest()


def make_identity_finder(pattern: str) -> Callable[[Path], str]:
    """Return a function that finds the identity of a robot in the path of a log.

    Parameters
    ----------
    pattern
        End of the path, in which `{id}` stands for the identity and `*` for anything, both within
        one name: `{id}/*.csv`, `*_{id}.parquet`.

    Raises
    ------
    UsageError
        If the pattern has no `{id}`; the function raises it for a path that does not match.

    Examples
    --------
    >>> make_identity_finder("{id}/*.csv")(Path("logs/arm-7/2026-03-01.csv"))
    'arm-7'
    """
    if pattern.count("{id}") != 1:
        raise UsageError(
            f"the pattern {pattern[:80]!r} must have one {{id}}, in the place of the"
            " robot's identity",
            cure=Cure("write one such as {id}/*.csv"),
        )
    if len(pattern) > LONGEST_PATTERN:
        raise UsageError(f"the pattern has {len(pattern)} characters, at most {LONGEST_PATTERN}")

    def identity(path: Path) -> str:
        found = find_identity(pattern, path.as_posix())
        if found is None:
            shown = shorten_path(path)
            raise UsageError(f"{shown} does not match the pattern {pattern!r} of identities")
        return found

    return identity


def find_identity(pattern: str, path: str) -> str | None:
    """Return what stands at `{id}` where a pattern matches the end of a path; None if it does not.

    A `*` takes as much of a name as it can, `{id}` as little, and both stay within one name. Every
    pair of a place in the pattern and one in the path is tried once, so that the time is bounded
    by the product of the lengths, which backtracking is not.

    >>> find_identity("*_{id}.csv", "logs/run_1_arm.csv")
    'arm'
    """
    before, _, after = pattern.partition("{id}")
    parts = [*before, "first", "rest", *after]
    starts = [0, *(k + 1 for k, letter in enumerate(path) if letter == "/")]
    waiting = [(0, k, 0, 0) for k in reversed(starts)]
    tried = set()
    while waiting:
        place, at, first, last = waiting.pop()
        if (place, at) in tried:
            continue
        tried.add((place, at))
        if place == len(parts):
            if at == len(path):
                return path[first:last]
            continue
        part = parts[place]
        letter = path[at : at + 1]
        inside = letter not in ("", "/")
        if part == "first":
            waiting += [(place + 1, at + 1, at, at)] * inside
        elif part == "rest":
            waiting += [(place, at + 1, first, last)] * inside + [(place + 1, at, first, at)]
        elif part == "*":
            waiting += [(place + 1, at, first, last)] + [(place, at + 1, first, last)] * inside
        elif part == letter:
            waiting.append((place + 1, at + 1, first, last))
    return None


def read_logs(
    described: RobotModel, paths: Sequence[Path], reading: ReadingOptions
) -> tuple[RobotModel, list[Recording | RecordingStream]]:
    """Return the robot as it was recorded, and the recordings; large ones are streams.

    Raises
    ------
    RecordingError
        If one cannot be read, does not fit the robot, or holds samples.
    """
    # Streams leave further columns out. 50 MB: a worker then needs less than 700 MB.
    extra = any(find_sheet(path, reading.sheet)[0].columns.extra for path in paths)
    model, (read,) = read_fitted_recordings(
        described, (list(paths),), reading, streamed_from=None if extra else 50e6
    )
    logged = [recording for recording in read if not isinstance(recording, Samples)]
    if len(logged) < len(read):
        raise RecordingError(f"{paths[0]} holds samples, not a recording", file=str(paths[0]))
    return model, logged


def parse_date(text: str) -> datetime:
    """Return a date or a date with time, in UTC unless it names a time zone.

    Raises `UsageError` for anything else.

    >>> parse_date("2026-03-01").isoformat(), parse_date("2026-03-01T12:30+02:00").isoformat()
    ('2026-03-01T00:00:00+00:00', '2026-03-01T10:30:00+00:00')
    """
    try:
        return convert_to_utc(datetime.fromisoformat(text.strip()))
    except (ValueError, OverflowError):
        raise UsageError(
            f"{text[:60]!r} is not a date; expected one such as 2026-03-01 or 2026-03-01T12:30:00",
            value=text,
        ) from None


def _check_date(date: datetime) -> datetime:
    """Return a date of a log in UTC; raises `RecordingError` beyond those that a clock can have."""
    date = convert_to_utc(date)
    if EARLIEST <= date < LATEST:
        return date
    raise RecordingError(
        f"the log has the date {date.date()}, which is not between {EARLIEST:%Y} and {LATEST:%Y}",
        cure=Cure("give the date", {"date": "DATE"}),
    )


def find_date_in_name(path: Path) -> datetime | None:
    """Return the date in the name of a log, or else of its folder.

    >>> find_date_in_name(Path("r1/2026-03-01/run_2026-03-01_12-30-05.csv")).isoformat()
    '2026-03-01T12:30:05+00:00'
    >>> find_date_in_name(Path("run_20260301.csv")).isoformat()
    '2026-03-01T00:00:00+00:00'
    >>> find_date_in_name(Path("run_7.csv"))
    """
    for text in (path.name, path.parent.name):
        found = _IN_NAME.search(text)
        if found:
            year, _, month, day, hour, minute, second = found.groups()
            time = f"{hour or 0:>02}:{minute or 0:>02}:{second or 0:>02}"
            try:
                return datetime.fromisoformat(f"{year}-{month}-{day}T{time}+00:00")
            except ValueError:
                continue
    return None


def choose_log_date(
    path: Path, recording: Recording, given: datetime | None, in_sheet: datetime | None
) -> tuple[datetime, DateSource]:
    """Return when a log began: as given, in its sheet, by its time stamps, or in its name.

    Raises
    ------
    RecordingError
        If nothing says when.
    """
    if given is not None:
        return _check_date(given), "given"
    if in_sheet is not None:
        return _check_date(in_sheet), "sheet"
    if EARLIEST.timestamp() < recording.started < LATEST.timestamp():
        began = recording.started + float(recording.t[0])
        return datetime.fromtimestamp(round(began, 3), UTC), "stamps"
    if named := find_date_in_name(path):
        return named, "name"
    clock = "its time stamps count from no date"
    if recording.started:
        clock = f"its clock reads {recording.started:.6g} s, which is no date after 2000"
    raise RecordingError(
        f"{path} has no date: {clock}, and its name holds none such as 2026-03-01",
        cure=Cure("give the date, here or as date = ... in a recording sheet", {"date": "DATE"}),
        file=str(path),
    )


def choose_settings(
    described: RobotModel,
    logs: Sequence[Sequence[Path]],
    *,
    reading: ReadingOptions,
    options: StudyOptions,
    robot_type: str | None = None,
    generation: int = 0,
) -> TypeSettings:
    """Choose the signal chain and drive terms of a robot type from recordings.

    Parameters
    ----------
    described
        The robot as described.
    logs
        The files of each recording.
    reading, options
        How to read, and what is not left open; `drive`, `chain` and `checked` count.
    robot_type
        Name of the type, if it has one.
    generation
        Number of times that the type was made again.

    Raises
    ------
    RecordingError
        If a recording cannot be read or used.
    UsageError
        If drive terms depend on the load, which differs from estimate to estimate.
    """
    model, read = read_logs(described, [path for files in logs for path in files], reading)
    prepared = prepare(
        model,
        read,
        chain=options.chain,
        checked=options.checked,
        tolerated=(),
        estimate_delay=not head_of(read[0]).has_computed_torque,
    )
    choice = settle_drive(model, prepared.training, options.drive)
    if choice.drive.needs_load:
        raise UsageError(
            f"the drive terms {choice.drive} depend on the load, so that information of two logs"
            " does not merge",
            cure=Cure("leave these terms out", {"drive": "viscous,coulomb,offset"}),
        )
    chain = prepared.chain or SignalChain()
    names = join_names([files[0].name for files in logs], most=3)
    cutoff = "" if chain.cutoff is None else f", cutoff {chain.cutoff:.3g} Hz"
    late = ", ".join(f"{1e3 * delay:.3g}" for delay in chain.delays)
    delay = f", torque {late} ms late" if late else ""
    return TypeSettings(
        robot_type=robot_type or name_robot_type(described),
        generation=generation,
        described=described,
        model=model,
        drive=choice.drive,
        chain=chain,
        torque_source=head_of(read[0]).torque_source,
        asked_drive=None if options.drive is None else str(options.drive),
        asked_chain=options.chain or SignalChain(),
        chosen=(
            f"drive terms {choice.drive}{cutoff}{delay}; chosen from {names}",
            *choice.sentences,
        ),
    )
