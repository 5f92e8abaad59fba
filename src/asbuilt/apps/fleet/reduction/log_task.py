"""Reduction of one log: the task of a worker, which writes its entry by itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from asbuilt import prepare
from asbuilt.apps.fleet.ledger.entry import DIGITS, Entry, EntryName, merge_blocks
from asbuilt.apps.fleet.ledger.ledger import Ledger, open_ledger
from asbuilt.apps.fleet.ledger.settings import TypeSettings
from asbuilt.apps.fleet.reduction.log_source import choose_log_date, hash_sources, read_logs
from asbuilt.arrays import Array
from asbuilt.description import RobotModel
from asbuilt.errors import AsbuiltError, RecordingError
from asbuilt.executor import Outcome
from asbuilt.experiment import (
    ReadingOptions,
    Recording,
    check_recording,
    find_sheet,
    head_of,
    resolve_chain,
)
from asbuilt.findings import Cure, Finding
from asbuilt.identification import (
    LONGEST_BLOCK,
    FurtherColumns,
    SquareRootInformation,
    accumulate_stream,
)

Result = TypeVar("Result")

# Hold how a log is reduced, and when it differs from the logs of its type.

# Time blocks of a log: they are 5 s or longer, and standard errors need 8 or more in all
LOG_BLOCKS = 16
# Ratio from which a log's cutoff is named as differing from the cutoff of its type
LOG_OTHER_CUTOFF = 1.5
# Difference of positions [rad or m] of a locked joint from which two logs do not merge
LOG_OTHER_POSITION = 5e-3
LOG_BEGINNING = 60_000  # Samples from which a type is settled: those read first of a long recording
LOG_CHECKED_SECONDS = 120.0
# Time [s] and samples at the beginning of a log whose check suffices if it finds nothing
LOG_CHECKED_SAMPLES = 10_000


COVARIATES = ("temperature", "temp")
"""Words in the names of quantities that are kept in addition to the information."""


@dataclass(frozen=True, slots=True)
class LogTask:
    """Describe the reduction of one recording of a robot.

    Parameters
    ----------
    ledger
        Folder or URL of the ledger.
    settings_path
        Where the ledger keeps the settings of the robot's type.
    robot_id
        Identity of the robot.
    paths
        Files of the recording.
    reading
        How to read them.
    date
        When it was recorded, if that is given.
    checked
        Refuse a recording in which `check_recording` finds errors.
    """

    ledger: str
    settings_path: str
    robot_id: str
    paths: tuple[Path, ...]
    reading: ReadingOptions
    date: datetime | None = None
    checked: bool = True


@dataclass(frozen=True, slots=True)
class LogReport:
    """Hold what became of a log: an entry was added, was there already, or `problem` says why not.

    `cure` is what to do about a problem.
    """

    log: str
    robot_id: str
    entry: EntryName | None = None
    added: bool = False
    n_samples: int = 0
    seconds: float = 0.0
    problem: str | None = None
    cure: Cure | None = None
    findings: tuple[Finding, ...] = ()

    @classmethod
    def of_failure(cls, paths: Sequence[Path], robot_id: str, problem: AsbuiltError) -> LogReport:
        """Return the report of a recording that has no entry."""
        return cls(str(paths[0]), robot_id, problem=problem.message, cure=problem.cure)


def read_outcome(outcome: Outcome[Any, Result]) -> Result:
    """Return what a worker returned; raise its error, or `RecordingError` if it was lost."""
    if outcome.result is None:
        raise outcome.error or RecordingError(outcome.problem or "it failed")
    return outcome.result


def reduce_log(task: LogTask) -> LogReport:
    """Reduce a recording and append its entry, unless it is in the ledger already.

    Raises
    ------
    RecordingError
        If the recording cannot be read, does not fit the type, has errors or no date.
    """
    log = str(task.paths[0])
    ledger = _open_root(task.ledger)
    settings = _read_settings(task.ledger, task.settings_path)
    digest = hash_sources(task.paths)
    known = ledger.names(task.robot_id)
    own = (digest[:DIGITS], settings.digest)
    for name in known:
        if (name.source, name.settings) == own and ledger.is_sound(name):
            return LogReport(log, task.robot_id, name)
    if any(name.settings != settings.digest for name in known):
        check_type(ledger, task.robot_id, settings.described, settings.robot_type)
    entry, findings = reduce_to_entry(task, settings, digest)
    return LogReport(
        log,
        task.robot_id,
        ledger.append(entry),
        added=True,
        n_samples=entry.information.n_samples,
        seconds=entry.duration,
        findings=findings,
    )


def reduce_to_entry(
    task: LogTask, settings: TypeSettings, digest: str
) -> tuple[Entry, tuple[Finding, ...]]:
    """Return the entry of a recording, and its findings; raises as `reduce_log` does."""
    first = task.paths[0]
    model, (logged, *_) = read_logs(settings.described, task.paths, task.reading)
    head = head_of(logged)
    _check_fits(first, model, head, settings)
    began, date_from = choose_log_date(
        first, head, task.date, find_sheet(first, task.reading.sheet)[0].date
    )
    beginning = head.taken(slice(0, LOG_BEGINNING)) if head.n_samples > LOG_BEGINNING else head
    codes = _check_beginning(settings, beginning) if task.checked else ()
    (samples,) = prepare(settings.model, [logged], chain=settings.chain, checked=False).training
    tilts = FurtherColumns.tilts(settings.model)
    seconds = samples.duration / LOG_BLOCKS
    information = accumulate_stream(
        settings.model,
        settings.base,
        (samples,),
        block_seconds=seconds if seconds > LONGEST_BLOCK else None,
        threads=1,
        further=tilts,
    )
    information = merge_blocks(information, 2 * LOG_BLOCKS)
    entry = Entry(
        robot_id=task.robot_id,
        settings=settings,
        information=information,
        log=first.name,
        source_sha256=digest,
        date=began,
        date_from=date_from,
        duration=float(samples.t[-1] - samples.t[0]),
        rate=samples.parallel.output_rate if samples.parallel else samples.rate,
        covariates=average_covariates(head, information),
        warnings=codes,
        tilt=tuple(tilts.products),
    )
    return entry, check_other_settings(task, settings, beginning)


def check_other_settings(
    task: LogTask, settings: TypeSettings, head: Recording
) -> tuple[Finding, ...]:
    """Return findings if a log alone would have led to other settings than its type has."""
    if settings.asked_chain.cutoff is not None or settings.chain.cutoff is None:
        return ()
    kept = replace(settings.asked_chain, rests=True)  # standstill speeds, unused here, take longer
    wanted = resolve_chain(kept, head).cutoff or 0.0
    ratio = wanted / settings.chain.cutoff
    if 1.0 / LOG_OTHER_CUTOFF < ratio < LOG_OTHER_CUTOFF:
        return ()
    return (
        Finding(
            "ledger_settings_differ",
            "warning",
            f"{task.paths[0]} alone calls for a cutoff of {wanted:.3g} Hz; all logs of"
            f" {settings.model.name} are filtered at {settings.chain.cutoff:.3g} Hz, chosen from"
            " the first one",
            Cure(
                "rebuild the ledger from all logs, which then choose together",
                call="rebuild_ledger",
            ),
        ),
    )


def average_covariates(head: Recording, information: SquareRootInformation) -> dict[str, Array]:
    """Return the mean of logged temperatures in each block (n_blocks, n), by name.

    A recording sheet names them; one column for all joints is repeated for each.
    """
    n = information.n_joints
    found = {}
    for name, values in head.extra.items():
        columns = values.reshape(len(head.t), -1)
        if columns.shape[1] != n or not any(word in name.lower() for word in COVARIATES):
            continue
        found[name] = np.full((information.n_blocks, n), np.nan)
        for b, block in enumerate(information.blocks):
            inside = columns[(head.t >= block.start) & (head.t <= block.stop)]
            if len(inside) and np.all(np.isfinite(inside)):
                found[name][b] = inside.mean(axis=0)
    return found


def _check_beginning(settings: TypeSettings, beginning: Recording) -> tuple[str, ...]:
    """Return the codes of warnings of a recording; raise `RecordingError` if it has errors.

    All of a beginning is checked only if something is found in the first part of it.
    """
    early = int(np.count_nonzero(beginning.t - beginning.t[0] < LOG_CHECKED_SECONDS))
    enough = max(LOG_CHECKED_SAMPLES, early)
    if enough < beginning.n_samples:
        first = check_recording(settings.model, beginning.taken(slice(0, enough)))
        if not (first.errors or first.warnings):
            return ()
    check = check_recording(settings.model, beginning)
    check.raise_errors(but=())
    return tuple(dict.fromkeys(found.code for found in check.warnings))


@lru_cache(maxsize=4)
def _open_root(root: str) -> Ledger:
    return open_ledger(root)


@lru_cache(maxsize=16)
def _read_settings(root: str, path: str) -> TypeSettings:
    return TypeSettings.from_content(_open_root(root).store.read(path), path)


def check_type(ledger: Ledger, robot_id: str, described: RobotModel, robot_type: str) -> None:
    """Raise `RecordingError` if the ledger has a robot of another type under this identity."""
    known = {name.settings for name in ledger.names(robot_id)}
    settings = ledger.all_settings() if known else {}
    for other in (settings[digest] for digest in sorted(known & settings.keys())):
        if other.robot_type != robot_type:
            raise RecordingError(
                f"{robot_id} is a {other.model.name} ({other.robot_type}) in the ledger, not a"
                f" {described.name} ({robot_type})",
                cure=Cure("give each robot an identity of its own", {"id": "ID"}),
            )


def _check_fits(path: Path, model: RobotModel, head: Recording, settings: TypeSettings) -> None:
    """Raise `RecordingError` if a log has other joints or another torque than its type."""
    if model.joint_names != settings.model.joint_names:
        raise RecordingError(
            f"{path} has the joints {', '.join(model.joint_names)}; the logs of"
            f" {settings.robot_type} have {', '.join(settings.model.joint_names)}",
            cure=Cure("add it to another ledger, or lock the joints that are not logged"),
            file=str(path),
        )
    for joint, held in settings.model.locked_joints.items():
        here = model.locked_joints.get(joint, held)
        if abs(here - held) > LOG_OTHER_POSITION:
            raise RecordingError(
                f"{path} was recorded with {joint} at {here:.4g}; the logs of"
                f" {settings.robot_type} have it at {held:.4g}",
                cure=Cure("add it to another ledger"),
                file=str(path),
            )
    if head.torque_source != settings.torque_source:
        raise RecordingError(
            f"{path} has torques from {head.torque_source}; the logs of {settings.robot_type} have"
            f" them from {settings.torque_source}",
            cure=Cure(
                "state the torque source if it is unknown, or add the log to another ledger",
                {"torque_source": settings.torque_source},
            ),
            file=str(path),
        )
