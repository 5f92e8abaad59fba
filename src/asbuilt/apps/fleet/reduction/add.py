"""Logs of robots added to a ledger, each reduced by a worker."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any

from asbuilt.apps.fleet.ledger.ledger import Ledger, open_ledger
from asbuilt.apps.fleet.ledger.settings import TypeSettings, name_robot_type
from asbuilt.apps.fleet.ledger.store import check_robot_id
from asbuilt.apps.fleet.options import FleetOptions
from asbuilt.apps.fleet.overview import report_suspicions
from asbuilt.apps.fleet.reduction.log_source import choose_settings, hash_sources
from asbuilt.apps.fleet.reduction.log_task import (
    LogReport,
    LogTask,
    check_type,
    read_outcome,
    reduce_log,
)
from asbuilt.description import RobotModel, load_robot
from asbuilt.errors import AsbuiltError, RecordingError, UsageError
from asbuilt.executor import Workers, open_workers
from asbuilt.experiment import ReadingOptions, group_files
from asbuilt.findings import Cure, Finding, rank_findings
from asbuilt.workflow import Progress, StudyOptions


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
    options = options or StudyOptions()
    fleet = fleet or FleetOptions()
    ledger, logs, reading = make_reachable(ledger, logs, reading or ReadingOptions(), fleet)
    described = load_robot(robot)
    if reading.gravity is not None:
        described = described.with_gravity(reading.gravity)
    recordings = group_recording_files(logs)
    opened = open_ledger(ledger, create=True)
    owners = {
        files: check_robot_id(robot_id if isinstance(robot_id, str) else robot_id(files[0]))
        for files in recordings
    }
    with open_workers(fleet.workers, fleet.scheduler) as workers:
        settings, fixed, failed = _choose_type_settings(
            opened, described, owners, reading, options, workers
        )
        unusable = {report.log for report in failed}
        copies = _find_copies(owners)

        def make_task(files: tuple[Path, ...]) -> LogTask:
            return LogTask(
                ledger=opened.root,
                settings_path=settings.path,
                robot_id=owners[files],
                paths=files,
                reading=reading,
                date=date,
                checked=options.checked,
            )

        asked = [files for files in owners if str(files[0]) not in unusable]
        firsts = [files for files in asked if files not in copies]
        made = run_tasks(workers, map(make_task, firsts), len(firsts), progress)
        reports = [*failed, *made]
        became = {report.log: report for report in reports}
        for files in (files for files in asked if files in copies):
            first = str(copies[files][0])
            if became[first].problem is None:
                reports.append(LogReport(str(files[0]), owners[files], became[first].entry))
            else:
                # The first had no date, say: this one is reduced in its place.
                (became[first],) = run_tasks(workers, [make_task(files)], 1, None)
                reports.append(became[first])
    return conclude_addition(
        opened, (settings,), reports, fixed=fixed, began=began, dashboard=workers.dashboard
    )


def run_tasks(
    workers: Workers, tasks: Iterable[LogTask], count: int, progress: Progress | None
) -> Iterator[LogReport]:
    """Yield the report of each task, with rate and remaining time to `progress`."""
    report = progress or (lambda what, fraction: None)
    began = time.monotonic()
    page = workers.dashboard
    by = f", dashboard at {page}" if page else f" by {workers.count} workers"
    report(f"reduce: {count} logs{by}", 0.0)
    for done, outcome in enumerate(workers.run(reduce_log, tasks), start=1):
        try:
            made = read_outcome(outcome)
        except AsbuiltError as problem:
            made = LogReport.of_failure(outcome.task.paths, outcome.task.robot_id, problem)
        yield made
        rate = done / max(time.monotonic() - began, 1e-9)
        left = _format_duration((count - done) / rate)
        report(f"reduce: {done} of {count} logs, {rate:.3g} a second, {left} left", done / count)


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
    ordered = sorted(reports, key=lambda report: report.log)
    findings = [found for report in ordered for found in report.findings]
    if fixed:
        findings += [
            Finding(
                "ledger_settings_fixed",
                "info",
                f"Fixed for all logs of {setting.robot_type}: {setting.chosen[0]}",
            )
            for setting in settings
        ]
    for robot_id in sorted({report.robot_id for report in ordered if report.added}):
        findings += report_suspicions(ledger, robot_id)
    return Addition(
        ledger=ledger.root,
        settings=settings,
        fixed=fixed,
        added=tuple(report for report in ordered if report.added),
        skipped=tuple(e for e in ordered if not e.added and e.problem is None),
        failed=tuple(report for report in ordered if report.problem is not None),
        findings=rank_findings([*findings, *ledger.findings]),
        seconds=time.monotonic() - began,
        dashboard=dashboard,
    )


def make_reachable(
    ledger: str | Path,
    logs: Sequence[str | Path],
    reading: ReadingOptions,
    fleet: FleetOptions,
) -> tuple[str, list[Path], ReadingOptions]:
    """Return ledger, logs and how to read them, by absolute paths for workers of a scheduler.

    Those run in other folders than this process.
    """
    root = str(ledger)
    paths = [Path(log) for log in logs]
    sheet = reading.sheet
    if fleet.scheduler is None:
        return root, paths, reading
    if isinstance(sheet, str | os.PathLike):
        reading = replace(reading, sheet=Path(sheet).absolute())
    return (
        root if "://" in root else str(Path(root).absolute()),
        [path.absolute() for path in paths],
        reading,
    )


def group_recording_files(logs: Sequence[str | Path]) -> list[tuple[Path, ...]]:
    """Return the files of each recording, sorted, missing ones too."""
    if not logs:
        raise UsageError("no log is given; give at least one")
    paths = sorted({Path(log) for log in logs})
    groups = [tuple(group) for group in group_files([path for path in paths if path.exists()])]
    return sorted([*groups, *((path,) for path in paths if not path.exists())])


def _choose_type_settings(
    ledger: Ledger,
    described: RobotModel,
    owners: Mapping[tuple[Path, ...], str],
    reading: ReadingOptions,
    options: StudyOptions,
    workers: Workers,
) -> tuple[TypeSettings, bool, list[LogReport]]:
    """Return the settings of a type, whether they are new, and the logs that could not fix them.

    `owners` are the identities of the robots by the files of their recordings.
    """
    known = ledger.settings_of(name_robot_type(described))
    if known is not None:
        _check_asked(known, options)
        return known, False, []
    failed: list[LogReport] = []
    for files, owner in owners.items():
        try:
            check_type(ledger, owner, described, name_robot_type(described))
            task = (described, files, reading, options)
            (chosen,) = map(read_outcome, workers.run(_choose_from_task, [task]))
        except RecordingError as problem:
            failed.append(LogReport.of_failure(files, owner, problem))
            continue
        valid = ledger.append_settings(chosen)
        if valid.digest != chosen.digest:
            _check_asked(valid, options)
        return valid, valid.digest == chosen.digest, failed
    raise RecordingError(
        f"none of {len(owners)} logs can fix the settings of {described.name}: {failed[0].problem}",
        cure=failed[0].cure,
    )


def _choose_from_task(
    task: tuple[RobotModel, tuple[Path, ...], ReadingOptions, StudyOptions],
) -> TypeSettings:
    described, files, reading, options = task
    return choose_settings(described, [files], reading=reading, options=options)


def _find_copies(
    owners: Mapping[tuple[Path, ...], str],
) -> dict[tuple[Path, ...], tuple[Path, ...]]:
    """Return recordings whose content another one of the same robot has, with the first of them.

    Workers do not see each other's logs, so that which of two dates is kept would depend on their
    speed: the first path counts. Only files of one size are read.
    """
    alike: dict[Any, list[tuple[Path, ...]]] = {}
    for files, owner in owners.items():
        with suppress(OSError):
            sizes = tuple(path.stat().st_size for path in files if path.is_file())
            if len(sizes) == len(files):
                alike.setdefault((owner, sizes), []).append(files)
    copies = dict[tuple[Path, ...], tuple[Path, ...]]()
    for group in alike.values():
        first = dict[str, tuple[Path, ...]]()
        for files in group if len(group) > 1 else ():
            with suppress(AsbuiltError, OSError):  # reported where the log is reduced
                original = first.setdefault(hash_sources(files), files)
                if original is not files:
                    copies[files] = original
    return copies


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


def _format_duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = seconds / 60
    return f"{minutes:.0f} min" if minutes < 90 else f"{minutes / 60:.1f} h"
