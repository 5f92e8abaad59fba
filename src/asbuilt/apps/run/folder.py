"""The folder of a loop: motions, logs and settings, from which a loop continues."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from asbuilt import AsbuiltError, Recording, UsageError, writers
from asbuilt.apps.run.options import RunOptions
from asbuilt.codec import format_json, restore_dataclass
from asbuilt.errors import ResultError
from asbuilt.findings import Cure
from asbuilt.untrusted import parse_json, read_text
from asbuilt.writing import atomic_write

SETTINGS = "run.json"


@dataclass(frozen=True, kw_only=True)
class RunSettings:
    """Hold with what a loop was started, and is resumed.

    Parameters
    ----------
    robot
        Name of the robot.
    on
        The driver and its argument, such as `virtual:lab`.
    motion
        File of the motion that matters; None: the robot's whole range.
    programs
        Formats of controller programs.
    options
        The options.
    logs
        Logs that lie elsewhere, by number of the round.
    """

    robot: str = ""
    on: str = ""
    motion: str | None = None
    programs: tuple[str, ...] = ()
    options: RunOptions = field(default_factory=RunOptions)
    logs: Mapping[str, str] = field(default_factory=dict)


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
        named = self._read().logs.get(str(number))
        return None if named is None or not Path(named).exists() else Path(named)

    def keep_log(self, number: int, recording: Recording) -> Path:
        """Keep the log of a round: the file it was read from, or else a new one."""
        source = Path(recording.source)
        if not (recording.source and source.exists()):
            return writers.write_log(self.path / f"round_{number}.csv", recording)["recording"]
        settings = self._read()
        logs = {**settings.logs, str(number): str(source.resolve())}
        self.keep_settings(replace(settings, logs=logs))
        return source

    def keep_settings(self, settings: RunSettings) -> None:
        """Write the settings with which the loop is resumed."""
        atomic_write(self.path / SETTINGS, format_json(settings), own=True)

    def read_settings(self) -> RunSettings:
        """Return the settings of an earlier loop.

        Raises
        ------
        UsageError
            If the folder has none.
        ResultError
            If they cannot be read.
        """
        if not self.has_rounds():
            raise UsageError(
                f"{self.path} holds no loop to resume: it has no {SETTINGS}",
                cure=Cure("name the folder into which the loop wrote its rounds"),
                file=str(self.path),
            )
        return self._read()

    def has_rounds(self) -> bool:
        """Return whether an earlier loop left its files here."""
        return (self.path / SETTINGS).is_file()

    def _read(self) -> RunSettings:
        """Return the settings, those of no loop if there are none; raises `ResultError`."""
        if not self.has_rounds():
            return RunSettings()
        path = self.path / SETTINGS
        text = read_text(path, "settings of a loop", ResultError)
        try:
            return restore_dataclass(RunSettings, parse_json(text))
        except (ValueError, TypeError, AsbuiltError) as problem:
            raise ResultError(
                f"{path} holds no settings of a loop: {problem}", file=str(path)
            ) from None
