"""A person with a controller as driver: motions go out as files, logs come in as files."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from pathlib import Path

import asbuilt
from asbuilt import Recording, writers
from asbuilt.apps.run.drivers import DRIVERS, DriverRequest
from asbuilt.excitation import Motion
from asbuilt.writing import check_writable

POLL = 0.5
"""Time between two looks into the inbox [s]; people copy files more slowly."""
SETTLED = 2
"""Looks in a row at which a log must have the same size, so that it is copied to its end."""
_NUMBERED = re.compile(r"motion_[0-9]{1,9}")
SIDE_FILES = (".toml", ".part", ".tmp", ".crdownload")
"""Suffixes of recording sheets, and of files that are still being copied; no logs."""


class FilesDriver:
    """Write each motion into DIR/outbox and wait for its log in DIR/inbox.

    The motion is `motion_N.csv`; its log is the file or folder of the inbox whose name begins with
    `motion_N`, in any format that `check` reads, with a recording sheet `motion_N.toml` if one is
    needed. A motion that is in the outbox already keeps its number, so that a loop that is started
    again waits for the same log.
    """

    moves_metal = False
    """Files move nothing: whoever runs them confirms."""

    def __init__(self, request: DriverRequest) -> None:
        self._request = request
        self.outbox = request.folder / "outbox"
        self.inbox = request.folder / "inbox"
        for folder in (self.outbox, self.inbox):
            check_writable(folder)
            folder.mkdir(parents=True, exist_ok=True)
        for form in request.programs:
            writers.PROGRAM_WRITERS.find("controller").check(form, request.model)

    def describe(self) -> str:
        """Return the two folders."""
        return f"motions in {self.outbox}, logs from {self.inbox}"

    def record(self, motion: Motion) -> Recording:
        """Write the motion and its programs, wait for the log and read it."""
        name = self._send(motion)
        while True:
            for log in self._list_logs(name):
                if _is_settled(log):
                    return asbuilt.read_recording(log, model=self._request.model)
            if self._request.stopped():
                raise KeyboardInterrupt
            time.sleep(POLL)

    def waits_for(self, motion: Motion) -> str:
        """Return what a person must do with a motion."""
        name = self._send(motion)
        return f"run {self.outbox / name}.csv, then put its log into {self.inbox} as {name}.*"

    def _send(self, motion: Motion) -> str:
        """Write a motion and its programs unless they are there; return its name."""
        model = self._request.model
        draft = asbuilt.write_motion(self.outbox / "draft.csv", motion, model.joint_names)
        text = draft.read_bytes()
        draft.unlink()
        sent = {path.stem: path for path in self.outbox.glob("motion_*.csv")}
        for name, path in sent.items():
            if path.read_bytes() == text:
                return name
        # Beyond the last: of a motion that was deleted the log may still be in the inbox.
        numbers = [int(stem.removeprefix("motion_")) for stem in sent if _NUMBERED.fullmatch(stem)]
        name = f"motion_{max(numbers, default=0) + 1}"
        for form in self._request.programs:
            writers.PROGRAM_WRITERS.find("controller").write(
                self.outbox / f"{name}_{form}",
                model,
                motion,
                form,
                name=name,
                collision=self._request.collision,
            )
        # The motion comes last: where it is, its programs are.
        asbuilt.write_motion(self.outbox / f"{name}.csv", motion, model.joint_names)
        return name

    def _list_logs(self, name: str) -> Iterator[Path]:
        """Yield the files of the inbox that belong to a motion, sheets left out."""
        for path in sorted(self.inbox.glob(f"{name}*")):
            rest = path.name.removeprefix(name)
            if path.suffix.lower() not in SIDE_FILES and not rest[:1].isdigit():
                yield path


def _is_settled(log: Path) -> bool:
    """Return whether the size of a log no longer changes."""
    sizes = []
    for look in range(SETTLED):
        time.sleep(POLL / SETTLED if look else 0.0)
        parts = [log, *log.rglob("*")] if log.is_dir() else [log]
        sizes.append(sum(part.stat().st_size for part in parts if part.exists()))
    return sizes[0] > 0 and len(set(sizes)) == 1


DRIVERS.register("files", FilesDriver)
