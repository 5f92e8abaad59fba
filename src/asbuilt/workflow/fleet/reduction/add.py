"""Logs of robots added to a ledger, each reduced by a worker."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

from asbuilt.description.load import load_robot
from asbuilt.description.model import RobotModel
from asbuilt.errors import AsbuiltError, RecordingError, UsageError
from asbuilt.executor import Outcome, Workers, open_workers
from asbuilt.experiment.logs.options import ReadingOptions
from asbuilt.experiment.logs.readers import group_files
from asbuilt.findings import Cure, Finding, rank_findings
from asbuilt.untrusted import shorten_path
from asbuilt.workflow.fleet.ledger.ledger import Ledger, open_ledger
from asbuilt.workflow.fleet.ledger.settings import TypeSettings, name_robot_type
from asbuilt.workflow.fleet.ledger.store import LONGEST_PATTERN, check_robot_id, find_identity
from asbuilt.workflow.fleet.options import FleetOptions
from asbuilt.workflow.fleet.overview import report_suspicions
from asbuilt.workflow.fleet.reduction.log_source import choose_settings
from asbuilt.workflow.fleet.reduction.log_task import LogReport, LogTask, check_type, reduce_log
from asbuilt.workflow.options import StudyOptions
from asbuilt.workflow.prepare import Progress


@dataclass(frozen=True, eq=False)
class Addition:
    """Hold what became of the logs that were to be added.

    Parameters
    ----------
    ledger
        Folder or URL.
    settings
        What the logs were reduced with.
    fixed
        Whether these logs fixed it.
    added, skipped, failed
        Reports of logs with a new entry, with an entry already, and without.
    findings
        What is wrong, or worth knowing, errors first.
    seconds
        Time taken.
    dashboard
        Address of the page of the cluster that did the work.
    """

    ledger: str
    settings: tuple[TypeSettings, ...]
    fixed: bool
    added: tuple[LogReport, ...]
    skipped: tuple[LogReport, ...]
    failed: tuple[LogReport, ...]
    findings: tuple[Finding, ...]
    seconds: float
    dashboard: str | None = None


def add_logs(
    ledger: str | Path,
    robot: RobotModel | str | Path,
    logs: Sequence[str | Path],
    *,
    robot_id: str | Callable[[Path], str],
    reading: ReadingOptions | None = None,
    options: StudyOptions | None = None,
    fleet: FleetOptions | None = None,
    date: datetime | None = None,
    progress: Progress | None = None,
) -> Addition:
    """Reduce logs of robots of one type to information and append it to a ledger.

    The first log of a type fixes the signal chain, the drive terms and their nonlinear parameters.
    Logs that are in the ledger are skipped, so that an interrupted call is repeated as it was. A
    log that cannot be used is listed in `failed`, and the rest goes on. The ledger is the same to
    the last bit for any number of workers and any order of the logs.

    Parameters
    ----------
    ledger
        Folder or URL such as `s3://bucket/ledger`; it is made if it is missing or empty.
    robot
        A robot, the name of a bundled one, or the path of a description.
    logs
        Files; those whose names differ in the quantity alone are one recording.
    robot_id
        Identity of the robot, or a function that returns it for a log.
    reading
        How to read the logs.
    options
        How to reduce the first log of a type: `drive`, `chain` and `checked` count.
    fleet
        Who does the work.
    date
        When the logs were recorded; None: as their sheets, time stamps or names say.
    progress
        Called with what is done and the fraction.

    Returns
    -------
    Addition
        What was added, skipped and failed, and findings.

    Raises
    ------
    UsageError
        If the place is no ledger, no log is given, or no log can fix the settings.
    """
    began = time.monotonic()
    ledger, logs, reading = make_reachable(ledger, logs, reading or ReadingOptions(), fleet)
    options = options or StudyOptions()
    described = robot if isinstance(robot, RobotModel) else load_robot(robot)
    if reading.gravity is not None:
        described = described.with_gravity(reading.gravity)
    recordings = group_recording_files(logs)
    opened = open_ledger(ledger, create=True)
    with open_workers(*read_worker_settings(fleet)) as workers:
        settings, fixed, failed = _choose_type_settings(
            opened, described, recordings, reading, options, robot_id, workers
        )
        unusable = {report.log for report in failed}
        tasks = (
            LogTask(
                ledger=opened.root,
                settings_path=settings.path,
                robot_id=_check_identity(robot_id, files[0]),
                paths=files,
                reading=reading,
                date=date,
                checked=options.checked,
            )
            for files in recordings
            if str(files[0]) not in unusable
        )
        reports = [*failed, *run_tasks(workers, tasks, len(recordings) - len(failed), progress)]
        dashboard = workers.dashboard
    return conclude_addition(
        opened, (settings,), reports, fixed=fixed, began=began, dashboard=dashboard
    )


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


def run_tasks(
    workers: Workers, tasks: Iterable[LogTask], count: int, progress: Progress | None
) -> Iterator[LogReport]:
    """Yield the report of each task, with rate and remaining time to `progress`."""
    report, began = progress or (lambda what, fraction: None), time.monotonic()
    if workers.dashboard:
        report(f"reduce: {count} logs, dashboard at {workers.dashboard}", 0.0)
    else:
        report(f"reduce: {count} logs by {workers.count} workers", 0.0)
    for done, outcome in enumerate(workers.run(reduce_log, tasks), start=1):
        yield _report_outcome(outcome)
        rate = done / max(time.monotonic() - began, 1e-9)
        left = (count - done) / rate
        report(
            f"reduce: {done} of {count} logs, {rate:.3g} a second, {_format_duration(left)} left",
            done / count,
        )


def conclude_addition(
    ledger: Ledger,
    settings: tuple[TypeSettings, ...],
    reports: Sequence[LogReport],
    *,
    fixed: bool,
    began: float,
    dashboard: str | None,
) -> Addition:
    """Return what became of all logs, in the order of their paths, and what is suspicious."""
    ordered = sorted(reports, key=lambda each: each.log)
    added = tuple(each for each in ordered if each.added)
    findings = [found for each in ordered for found in each.findings]
    if fixed:
        findings += [
            Finding(
                "ledger_settings_fixed",
                "info",
                f"Fixed for all logs of {each.robot_type}: {each.chosen[0]}",
            )
            for each in settings
        ]
    for robot_id in sorted({each.robot_id for each in added}):
        findings += report_suspicions(ledger, robot_id)
    return Addition(
        ledger=ledger.root,
        settings=settings,
        fixed=fixed,
        added=added,
        skipped=tuple(e for e in ordered if not e.added and e.problem is None),
        failed=tuple(each for each in ordered if each.problem is not None),
        findings=rank_findings([*findings, *ledger.findings]),
        seconds=time.monotonic() - began,
        dashboard=dashboard,
    )


def make_reachable(
    ledger: str | Path,
    logs: Sequence[str | Path],
    reading: ReadingOptions,
    fleet: FleetOptions | None,
) -> tuple[str, list[Path], ReadingOptions]:
    """Return ledger, logs and how to read them, by absolute paths for workers of a scheduler.

    Those run in other folders than this process.
    """
    root, paths, sheet = str(ledger), [Path(each) for each in logs], reading.sheet
    if read_worker_settings(fleet)[1] is None:
        return root, paths, reading
    if isinstance(sheet, str | os.PathLike):
        reading = replace(reading, sheet=Path(sheet).absolute())
    return (
        root if "://" in root else str(Path(root).absolute()),
        [path.absolute() for path in paths],
        reading,
    )


def read_worker_settings(fleet: FleetOptions | None) -> tuple[int | None, str | None]:
    """Return the number of workers and the address of the scheduler."""
    chosen = fleet or FleetOptions()
    return chosen.workers, chosen.scheduler


def group_recording_files(logs: Sequence[str | Path]) -> list[tuple[Path, ...]]:
    """Return the files of each recording, sorted, missing ones too."""
    if not logs:
        raise UsageError("no log is given; give at least one")
    paths = sorted({Path(each) for each in logs})
    present = [path for path in paths if path.exists()]
    groups = [tuple(group) for group in group_files(present)]
    return sorted([*groups, *((path,) for path in paths if not path.exists())])


def _check_identity(robot_id: str | Callable[[Path], str], path: Path) -> str:
    return check_robot_id(robot_id if isinstance(robot_id, str) else robot_id(path))


def _choose_type_settings(
    ledger: Ledger,
    described: RobotModel,
    recordings: Sequence[tuple[Path, ...]],
    reading: ReadingOptions,
    options: StudyOptions,
    robot_id: str | Callable[[Path], str],
    workers: Workers,
) -> tuple[TypeSettings, bool, list[LogReport]]:
    """Return the settings of a type, whether they are new, and the logs that could not fix them."""
    for files in recordings:
        _check_identity(robot_id, files[0])
    known = ledger.settings_of(name_robot_type(described))
    if known is not None:
        _check_asked(known, options)
        return known, False, []
    failed: list[LogReport] = []
    for files in recordings:
        identity = _check_identity(robot_id, files[0])
        try:
            check_type(ledger, identity, described, name_robot_type(described))
            outcome = next(workers.run(_choose_from_task, [(described, files, reading, options)]))
            if outcome.result is None:
                raise RecordingError(outcome.problem or "")
            if isinstance(outcome.result, AsbuiltError):
                raise outcome.result
            valid = ledger.append_settings(outcome.result)
            if valid.digest != outcome.result.digest:
                _check_asked(valid, options)
            return valid, valid.digest == outcome.result.digest, failed
        except RecordingError as problem:
            failed.append(
                LogReport(str(files[0]), identity, problem=problem.message, cure=problem.cure)
            )
    reason = failed[0].problem
    raise RecordingError(
        f"none of {len(recordings)} logs can fix the settings of {described.name}: {reason}",
        cure=failed[0].cure,
    )


def _choose_from_task(
    task: tuple[RobotModel, tuple[Path, ...], ReadingOptions, StudyOptions],
) -> TypeSettings | AsbuiltError:
    described, files, reading, options = task
    try:
        return choose_settings(described, [files], reading=reading, options=options)
    except AsbuiltError as problem:
        return problem


def _check_asked(known: TypeSettings, options: StudyOptions) -> None:
    """Raise `UsageError` if other settings are asked for than the ledger has."""
    if options.drive is not None and str(options.drive) not in (
        known.asked_drive,
        str(known.drive),
    ):
        raise UsageError(
            f"the ledger has the drive terms {known.drive} for {known.robot_type}, not"
            f" {options.drive}",
            cure=Cure("leave them out, or rebuild the ledger from its logs"),
        )
    chain = options.chain
    if chain is not None and chain not in (type(chain)(), known.asked_chain, known.chain):
        raise UsageError(
            f"the ledger has another signal chain for {known.robot_type}: {known.chosen[0]}",
            cure=Cure("leave the options of filtering out, or rebuild the ledger from its logs"),
        )


def _report_outcome(outcome: Outcome[LogTask, LogReport]) -> LogReport:
    if outcome.result is not None:
        return outcome.result
    task = outcome.task
    return LogReport(str(task.paths[0]), task.robot_id, problem=outcome.problem or "it failed")


def _format_duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = seconds / 60
    return f"{minutes:.0f} min" if minutes < 90 else f"{minutes / 60:.1f} h"
