"""The ledger: append-only store of the information of the logs of many robots."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from functools import cached_property
from pathlib import Path
from urllib.parse import unquote

from asbuilt.apps.fleet.ledger.entry import Entry, EntryName, digest_content, read_entry
from asbuilt.apps.fleet.ledger.settings import (
    EARLIEST,
    FORMAT_VERSION,
    LATEST,
    TypeSettings,
    check_version,
    convert_to_utc,
)
from asbuilt.apps.fleet.ledger.store import (
    Store,
    is_folder,
    name_entry_folder,
    open_store,
)
from asbuilt.codec import format_json
from asbuilt.errors import ResultError, UsageError
from asbuilt.findings import Cure, Finding
from asbuilt.untrusted import parse_json

FORMAT = "asbuilt fleet ledger"
MARK = "ledger.json"
FOLDERS = ("logs", "pending", "types")


@dataclass(frozen=True, eq=False)
class Ledger:
    """Read and append to a ledger; `open_ledger` makes it.

    Files are written once and never changed: `types/TYPE/GENERATION-DIGEST.json` are the settings
    of a robot type, `logs/ID/DATE-SOURCE-SETTINGS-CONTENT.parquet` the entries. The digests in the
    names are the manifest: any number of writers append without a file that they share, and a file
    that was damaged is found. What a ledger holds does not depend on the order in which it was
    written.
    """

    store: Store

    @property
    def root(self) -> str:
        """Folder or URL."""
        return self.store.root

    @cached_property
    def findings(self) -> list[Finding]:
        """What is wrong with files that were read so far; they were skipped."""
        return []

    def robot_ids(self) -> list[str]:
        """Return the identities of all robots, sorted."""
        folders = self.store.names("logs")
        for name in folders:
            if not is_folder(name):
                self._report_foreign(f"logs/{name[:80]}")
        return sorted(unquote(name) for name in folders if is_folder(name))

    def types(self) -> dict[str, TypeSettings]:
        """Return the settings of each robot type: the first of the latest generation."""
        found: dict[str, TypeSettings] = {}
        for setting in self.all_settings().values():
            known = found.get(setting.robot_type)
            if known is None or setting.generation > known.generation:
                found[setting.robot_type] = setting
        return found

    def all_settings(self) -> dict[str, TypeSettings]:
        """Return the settings of all types and generations by digest, without damaged files."""
        found: dict[str, TypeSettings] = {}
        for folder in self.store.names("types"):
            for name in self.store.names(f"types/{folder}"):
                path = f"types/{folder}/{name}"
                try:
                    setting = TypeSettings.from_content(self.store.read(path), path)
                except ResultError as problem:
                    self._report_damage(path, problem)
                else:
                    found.setdefault(setting.digest, setting)
        return found

    def settings_of(self, robot_type: str) -> TypeSettings | None:
        """Return the settings of a robot type; None if no log of it was added yet."""
        return self.types().get(robot_type)

    def names(self, robot_id: str) -> list[EntryName]:
        """Return the names of a robot's entries of any settings, by date."""
        folder = name_entry_folder(robot_id)
        found = []
        for name in self.store.names(folder):
            parsed = EntryName.parse(robot_id, name)
            if parsed is None:
                self._report_foreign(f"{folder}/{name}")
            else:
                found.append(parsed)
        return sorted(found)

    def current_names(
        self, robot_id: str, types: dict[str, TypeSettings] | None = None
    ) -> list[tuple[EntryName, TypeSettings]]:
        """Return a robot's entries of the latest settings with these, by date, each log once."""
        found: dict[str, tuple[EntryName, TypeSettings]] = {}
        for name, settings in self._all_current(robot_id, types):
            found.setdefault(name.source, (name, settings))
        return list(found.values())

    def _all_current(
        self, robot_id: str, types: dict[str, TypeSettings] | None
    ) -> list[tuple[EntryName, TypeSettings]]:
        """Return the names of entries of the latest settings; a log may have several."""
        latest = self.types() if types is None else types
        by_digest = {setting.digest: setting for setting in latest.values()}
        names = self.names(robot_id)
        current = [(n, by_digest[n.settings]) for n in names if n.settings in by_digest]
        left_out = len({name.source for name in names} - {name.source for name, _ in current})
        if left_out:
            self._report(
                Finding(
                    "ledger_entries_superseded",
                    "info",
                    f"{left_out} logs of {robot_id} have entries of earlier settings only, and are"
                    " left out",
                    Cure("rebuild the ledger from all logs, these too", call="rebuild_ledger"),
                )
            )
        return current

    def read(self, name: EntryName, settings: TypeSettings) -> Entry | None:
        """Return an entry; None if its file is damaged, which is named in `findings`."""
        try:
            return read_entry(self.store.read(name.path), name, settings)
        except ResultError as problem:
            self._report_damage(name.path, problem)
            return None

    def entries(
        self,
        robot_id: str,
        since: datetime | None = None,
        until: datetime | None = None,
        types: dict[str, TypeSettings] | None = None,
    ) -> list[Entry]:
        """Return a robot's sound entries of the latest settings, `since <= date < until` (UTC)."""
        first = EARLIEST if since is None else convert_to_utc(since)
        end = LATEST if until is None else convert_to_utc(until)
        found: dict[str, Entry] = {}
        for name, settings in self._all_current(robot_id, types):
            asked = first <= name.date < end
            entry = self.read(name, settings) if asked and name.source not in found else None
            if entry is not None:
                found[name.source] = entry
        return list(found.values())

    def is_sound(self, name: EntryName) -> bool:
        """Return whether the file of an entry has the content that was written."""
        try:
            return digest_content(self.store.read(name.path)) == name.content
        except ResultError:
            return False

    def append(self, entry: Entry) -> EntryName:
        """Write an entry, unless it is there and sound."""
        name = entry.name
        if not self.is_sound(name):
            self.store.write(name.path, entry.content)
        return name

    def append_settings(self, settings: TypeSettings) -> TypeSettings:
        """Write the settings of a type; return the settings of the first of several writers.

        Raises `ResultError` if that one's file is damaged.
        """
        if self.store.create(settings.path, settings.content):
            return settings
        return TypeSettings.from_content(self.store.read(settings.path), settings.path)

    def _report_damage(self, path: str, problem: ResultError) -> None:
        message = problem.message if path in problem.message else f"{path}: {problem.message}"
        self._report(Finding("ledger_file_damaged", "warning", f"Skipped: {message}", problem.cure))

    def _report_foreign(self, path: str) -> None:
        message = f"Skipped: {path} is no entry of a ledger"
        self._report(Finding("ledger_file_foreign", "warning", message, Cure("remove it")))

    def _report(self, finding: Finding) -> None:
        if finding not in self.findings:
            self.findings.append(finding)


def open_ledger(ledger: Ledger | str | Path, *, create: bool = False) -> Ledger:
    """Return the ledger in a folder or at a URL such as `s3://bucket/ledger`.

    Parameters
    ----------
    ledger
        Where it is; one that is open is returned as it is.
    create
        Whether an empty or missing folder becomes a ledger.

    Raises
    ------
    UsageError
        If there is no ledger, or the folder holds something else.
    ResultError
        If the ledger is of another version, or its mark is damaged.
    """
    if isinstance(ledger, Ledger):
        return ledger
    root = str(ledger)
    store = open_store(root)
    names = store.names("")
    foreign = [name for name in names if name not in FOLDERS]
    if MARK in names:
        _check_mark(root, store)
    elif not create:
        raise UsageError(
            f"{root} is not a ledger: it has no {MARK}",
            cure=Cure("give the folder or URL that logs were added to", call="add_logs"),
            file=root,
        )
    elif foreign:
        raise UsageError(
            f"{root} is not a ledger, and holds other files ({foreign[0]})",
            cure=Cure("give an empty or new folder"),
            file=root,
        )
    else:
        mark = {"format": FORMAT, "format_version": FORMAT_VERSION}
        store.write(MARK, format_json(mark).encode())
    return Ledger(store)


def _check_mark(root: str, store: Store) -> None:
    try:
        mark = parse_json(store.read(MARK))
        written = mark["format"]
        version = mark.get("format_version")
    except (ValueError, KeyError, TypeError, AttributeError) as problem:
        raise ResultError(
            f"{root} is not a ledger: {MARK} is damaged ({type(problem).__name__})",
            cure=Cure(f"restore {MARK} from another ledger of the same version"),
            file=root,
        ) from problem
    if written != FORMAT:
        raise ResultError(
            f"{root} is not a ledger: its {MARK} is of another program, with format {written!r}"
            f" instead of {FORMAT!r}",
            cure=Cure("give the folder or URL of a ledger, or a new one"),
            file=root,
        )
    check_version(root, version)
