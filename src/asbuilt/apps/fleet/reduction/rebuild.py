"""Rebuild of a ledger from its logs, with settings chosen from many of them."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import numpy as np

from asbuilt.apps.fleet.ledger.entry import DIGITS, EntryName
from asbuilt.apps.fleet.ledger.ledger import Ledger, open_ledger
from asbuilt.apps.fleet.ledger.settings import TypeSettings
from asbuilt.apps.fleet.options import FleetOptions
from asbuilt.apps.fleet.reduction.add import (
    Addition,
    conclude_addition,
    group_recording_files,
    make_reachable,
    run_tasks,
)
from asbuilt.apps.fleet.reduction.log_source import choose_settings, hash_sources
from asbuilt.apps.fleet.reduction.log_task import LogReport, LogTask, read_outcome
from asbuilt.errors import AsbuiltError, RecordingError, UsageError
from asbuilt.executor import Workers, open_workers
from asbuilt.experiment import ReadingOptions
from asbuilt.findings import Cure
from asbuilt.workflow import Progress, StudyOptions


def rebuild_ledger(
    ledger: str | Path,
    logs: Sequence[str | Path],
    *,
    reading: ReadingOptions | None = None,
    options: StudyOptions | None = None,
    fleet: FleetOptions | None = None,
    progress: Progress | None = None,
) -> Addition:
    """Reduce logs of a ledger again, each type with settings chosen from several of its logs.

    The entries of the old settings stay valid until all logs are reduced, and remain in the folder.
    Logs of a type that are not given are left out of the ledger from then on, which
    `fleet_overview` names.

    Parameters
    ----------
    ledger
        Folder or URL.
    logs
        Files that were added to the ledger; robot and date of each are known by its content.
    reading
        How to read the logs.
    options
        What is not left open; `drive`, `chain` and `checked` count. None: what was left open before
        is chosen again.
    fleet
        Who does the work.
    progress
        Called with what is done and the fraction.

    Returns
    -------
    Addition
        What was added and failed, and findings.

    Raises
    ------
    UsageError
        If there is no ledger, or no log is given.
    RecordingError
        If the logs from which settings are chosen cannot be used.
    """
    began = time.monotonic()
    options = options or StudyOptions()
    fleet = fleet or FleetOptions()
    ledger, logs, reading = make_reachable(ledger, logs, reading or ReadingOptions(), fleet)
    opened = open_ledger(ledger)
    renewed = []
    types = opened.types()
    with open_workers(fleet.workers, fleet.scheduler) as workers:
        by_type, reports = _group_by_type(opened, workers, group_recording_files(logs))
        for robot_type, items in sorted(by_type.items()):
            settings = _renew_settings(types[robot_type], items, reading, options)
            renewed.append(settings)
            opened.store.write(settings.pending_path, settings.content)
            tasks = (
                LogTask(
                    ledger=opened.root,
                    settings_path=settings.pending_path,
                    robot_id=name.robot_id,
                    paths=files,
                    reading=reading,
                    date=_read_given_date(opened, name),
                    checked=options.checked,
                )
                for files, name in items
            )
            reports += run_tasks(workers, tasks, len(items), progress)
            if opened.append_settings(settings).digest != settings.digest:
                raise UsageError(
                    f"another program has rebuilt {robot_type} in the meantime; its settings are"
                    " valid, and those chosen here are not",
                    cure=Cure("rebuild the ledger again if those will not do"),
                )
    return conclude_addition(
        opened, tuple(renewed), reports, fixed=True, began=began, dashboard=workers.dashboard
    )


def _group_by_type(
    ledger: Ledger,
    workers: Workers,
    recordings: Sequence[tuple[Path, ...]],
) -> tuple[dict[str, list[tuple[tuple[Path, ...], EntryName]]], list[LogReport]]:
    """Return the logs of each type with the entry of each, and reports of those without."""
    settings = ledger.all_settings()
    entry_of = {
        name.source: name
        for robot_id in ledger.robot_ids()
        for name in ledger.names(robot_id)
        if name.settings in settings
    }
    found: dict[str, list[tuple[tuple[Path, ...], EntryName]]] = {}
    failed = []
    for outcome in workers.run(hash_sources, recordings):
        files = outcome.task
        try:
            name = entry_of.get(read_outcome(outcome)[:DIGITS])
            if name is not None:
                found.setdefault(settings[name.settings].robot_type, []).append((files, name))
                continue
            if files[0].exists():
                cure = Cure("add it", call="add_logs")
                raise RecordingError(f"{files[0]} is not in the ledger", cure=cure)
            cure = Cure("give the logs by their paths")
            raise RecordingError(f"{files[0]} does not exist", cure=cure)
        except AsbuiltError as problem:
            failed.append(LogReport.of_failure(files, "", problem))
    for items in found.values():
        items.sort()
    return found, failed


def _renew_settings(
    before: TypeSettings,
    items: Sequence[tuple[tuple[Path, ...], EntryName]],
    reading: ReadingOptions,
    options: StudyOptions,
) -> TypeSettings:
    """Return the next settings of a type, chosen from logs that are evenly spread over `items`."""
    picked = np.unique(np.linspace(0, len(items) - 1, 8).round().astype(int))
    return choose_settings(
        before.described,
        [items[k][0] for k in picked.tolist()],
        reading=reading,
        options=replace(
            options,
            drive=before.asked_drive if options.drive is None else options.drive,
            chain=before.asked_chain if options.chain is None else options.chain,
        ),
        robot_type=before.robot_type,
        generation=before.generation + 1,
    )


def _read_given_date(ledger: Ledger, name: EntryName) -> datetime | None:
    """Return the date of an entry if it was given, since the log does not say it."""
    entry = ledger.read(name, ledger.all_settings()[name.settings])
    return entry.date if entry is not None and entry.date_from == "given" else None
