"""The folder of a loop: motions, logs and settings, from which a loop continues."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from asbuilt import Recording, UsageError, writers
from asbuilt.errors import ResultError
from asbuilt.findings import Cure
from asbuilt.untrusted import parse_json, read_text
from asbuilt.writing import atomic_write

SETTINGS = "run.json"


@dataclass(frozen=True)
class RunFolder:
    """Name the files of a loop: `round_1_motion.csv`, `round_1.csv` and its sheet, `run.json`.

    What a round is learned from is what its files hold, so that a loop that is resumed, and a user
    with `asbuilt identify`, get the same numbers.
    """

    path: Path

    def motion_path(self, number: int) -> Path:
        """Return the file of the motion of a round."""
        return self.path / f"round_{number}_motion.csv"

    def find_log(self, number: int) -> Path | None:
        """Return the log of a round; None if it is not recorded."""
        own = self.path / f"round_{number}.csv"
        if own.exists():
            return own
        named = self._read().get("logs", {}).get(str(number))
        return None if named is None or not Path(named).exists() else Path(named)

    def name_log(self, recording: Recording) -> Path | None:
        """Return the file that a recording was read from; None if it has none."""
        source = Path(recording.source)
        return source if recording.source and source.exists() else None

    def keep_log(self, number: int, recording: Recording) -> Path:
        """Keep the log of a round: the file it was read from, or else a new one."""
        source = self.name_log(recording)
        if source is None:
            return writers.write_log(self.path / f"round_{number}.csv", recording)["recording"]
        settings = self._read()
        logs = {**settings.get("logs", {}), str(number): str(source.resolve())}
        self._write({**settings, "logs": logs})
        return source

    def keep_settings(self, settings: Mapping[str, Any]) -> None:
        """Write the settings with which the loop is resumed."""
        self.path.mkdir(parents=True, exist_ok=True)
        self._write({**settings, "logs": self._read().get("logs", {})})

    def read_settings(self) -> dict[str, Any]:
        """Return the settings of an earlier loop.

        Raises
        ------
        UsageError
            If the folder has none.
        """
        if not (self.path / SETTINGS).is_file():
            raise UsageError(
                f"{self.path} holds no loop to resume: it has no {SETTINGS}",
                cure=Cure("name the folder into which the loop wrote its rounds"),
                file=str(self.path),
            )
        return self._read()

    def has_rounds(self) -> bool:
        """Return whether an earlier loop left its files here."""
        return (self.path / SETTINGS).is_file()

    def _read(self) -> dict[str, Any]:
        path = self.path / SETTINGS
        if not path.is_file():
            return {}
        try:
            read = parse_json(read_text(path, "settings of a loop", ResultError))
        except ResultError:
            raise
        except ValueError as problem:
            raise ResultError(f"{path} cannot be read: {problem}", file=str(path)) from None
        if not isinstance(read, dict):
            raise ResultError(f"{path} holds no settings of a loop", file=str(path))
        return read

    def _write(self, settings: Mapping[str, Any]) -> None:
        atomic_write(self.path / SETTINGS, json.dumps(settings, indent=2) + "\n", own=True)
