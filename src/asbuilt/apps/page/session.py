"""What a page has chosen, the command of each step, and the answers so far."""

from __future__ import annotations

import shlex
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from asbuilt import Cure, ReadingOptions, StudyOptions, UsageError, robot_names
from asbuilt.apps.page.columns import write_sheet
from asbuilt.apps.page.worker import Worker
from asbuilt.cli import name_option
from asbuilt.dynamics import available_terms
from asbuilt.identification import TILT

STEPS = ("show", "columns", "check", "identify", "view", "export")
"""The commands of the page, in the order of its sections."""


@dataclass(frozen=True, slots=True)
class Choices:
    """Hold what was chosen by mouse.

    Parameters
    ----------
    robot
        A bundled robot or the path of a description; empty: none yet.
    logs, validation
        Paths of recordings: to identify with, and to validate on.
    reading
        Options of how logs are read, as on a command line.
    options
        Options of `identify`, as on a command line.
    effects
        Value of `--effects`; empty: its default.
    export
        Options of `export`, as on a command line.
    """

    robot: str = ""
    logs: tuple[str, ...] = ()
    validation: tuple[str, ...] = ()
    reading: str = ""
    options: str = ""
    effects: str = ""
    export: str = ""

    @classmethod
    def of(cls, given: dict[str, Any]) -> dict[str, Any]:
        """Return the fields given, each of its type; raises `UsageError` for anything else."""
        chosen: dict[str, Any] = {}
        for entry in fields(cls):
            if entry.name in given:
                value, several = given[entry.name], entry.name in ("logs", "validation")
                texts = value if several else [value]
                if not isinstance(texts, list) or not all(isinstance(each, str) for each in texts):
                    raise UsageError(f"{entry.name} takes text, got {value!r}")
                chosen[entry.name] = tuple(texts) if several else value
        return chosen


@dataclass
class Job:
    """Hold a command while it runs."""

    step: str
    arguments: tuple[str, ...]
    what: str = ""
    fraction: float = 0.0
    begun: float = field(default_factory=time.monotonic)

    def as_dict(self) -> dict[str, Any]:
        """Return what the page shows of it."""
        return {
            "step": self.step,
            "what": self.what,
            "fraction": self.fraction,
            "seconds": round(time.monotonic() - self.begun, 1),
        }


class Session:
    """Hold the choices of a page, run its steps, and keep their answers.

    An answer belongs to the arguments that it was asked with: it is out of date as soon as other
    choices make other arguments.

    Parameters
    ----------
    folder
        Where results and uploaded files are written.
    choices
        What is chosen at first.
    """

    def __init__(self, folder: Path, choices: Choices) -> None:
        self.folder = folder
        self.choices = choices
        self.job: Job | None = None
        self.answers: dict[str, tuple[tuple[str, ...], dict[str, Any]]] = {}
        self._worker = Worker()
        self._lock = threading.Lock()

    @property
    def result(self) -> Path:
        """The result of the identification."""
        return self.folder / "result.json"

    def choose(self, given: dict[str, Any]) -> None:
        """Change what is chosen; raises `UsageError` for what no command line could say."""
        choices = replace(self.choices, **Choices.of(given))
        for path in (choices.robot, *choices.logs, *choices.validation):
            if path.startswith("-"):
                raise UsageError(f"{path!r} looks like an option; write ./{path}")
        for options in (choices.reading, choices.options, choices.export):
            _split_words(options)
        self.choices = choices

    def arguments(self, step: str) -> tuple[str, ...]:
        """Return the arguments of the command of a step."""
        chosen, result = self.choices, str(self.result)
        reading = _split_words(chosen.reading)
        logs = (*chosen.logs, *chosen.validation)
        validate = [word for log in chosen.validation for word in ("--validate", log)]
        effects = ["--effects", chosen.effects] if chosen.effects else []
        return {
            "show": ("show", chosen.robot),
            "columns": ("columns", chosen.robot, *logs[:1], *reading),
            "check": ("check", chosen.robot, *logs, *reading),
            "identify": (
                "identify", chosen.robot, *chosen.logs, *validate, *reading,
                *_split_words(chosen.options), *effects, "-o", str(self.folder),
            ),
            "view": (
                "view", result, *chosen.logs[:1], *reading, "--save", str(self.folder / "view.html")
            ),
            "export": ("export", result, *_split_words(chosen.export)),
        }[step]  # fmt: skip

    def refusal(self, step: str) -> str | None:
        """Return why a step cannot be run yet, None if it can."""
        chosen = self.choices
        if not chosen.robot:
            return "choose a robot first"
        if step in ("columns", "check", "identify") and not (chosen.logs or chosen.validation):
            return "choose a log first"
        if step == "identify":
            if not chosen.logs:
                return "choose a log to identify with; all are for validation"
            return self._find_fault()
        if step in ("view", "export") and self.answer("identify") is None:
            return "identify the robot first"
        return None

    def _find_fault(self) -> str | None:
        """Return what the check found wrong, or that the logs have not been checked."""
        checked = self.answer("check")
        if checked is None:
            return "the logs are not checked yet"
        if "error" in checked:
            return str(checked["error"]["message"])
        errors = [
            finding["message"]
            for recording in checked["recordings"]
            for finding in recording["findings"]
            if finding["severity"] == "error"
        ]
        if not errors:
            return None
        more = f" (and {len(errors) - 1} more)" if len(errors) > 1 else ""
        return f"the check found: {errors[0]}{more}"

    def answer(self, step: str) -> dict[str, Any] | None:
        """Return the answer of a step to the present choices, None if there is none."""
        arguments, answer = self.answers.get(step, ((), None))
        return answer if arguments == self.arguments(step) else None

    def run(self, step: str) -> None:
        """Start a step; raises `UsageError` if it is refused or another one runs."""
        if step not in STEPS:
            raise UsageError(f"there is no step {step!r}", available=STEPS)
        with self._lock:
            busy = self.job is not None
            why = "another step is running; cancel it or wait" if busy else self.refusal(step)
            if why is not None:
                raise UsageError(why)
            self.job = Job(step, self.arguments(step))
        threading.Thread(target=self._run, args=(self.job,), daemon=True).start()

    def assign(self, chosen: Sequence[Mapping[str, Any]]) -> Path:
        """Write a recording sheet of the columns chosen, and read the logs by it.

        Raises `UsageError` if the columns are not known yet, or cannot be a sheet's.
        """
        document = self.answer("columns")
        if document is None or "error" in document:
            raise UsageError("the columns of the log have not been read")
        words = [*_split_words(self.choices.reading)]
        place = words.index("--sheet") + 1 if "--sheet" in words else 0
        log = Path((*self.choices.logs, *self.choices.validation)[0])
        path = self.folder / f"{log.name}.sheet.toml"
        given = words[place] if 0 < place < len(words) else None
        write_sheet(path, log, given, document, chosen)
        words[max(place - 1, 0) : place + 1 if place else 0] = ["--sheet", str(path)]
        self.choices = replace(self.choices, reading=shlex.join(words))
        return path

    def cancel(self) -> None:
        """End the running step."""
        with self._lock:
            job, self.job = self.job, None
        if job is not None:
            self._worker.cancel()

    def close(self) -> None:
        """End the process of the commands."""
        self._worker.close()

    def _run(self, job: Job) -> None:
        def progress(what: str, fraction: float) -> None:
            job.what, job.fraction = what, fraction

        answer = self._worker.run(job.arguments, progress)
        with self._lock:
            if self.job is job:
                self.answers[job.step] = (job.arguments, answer)
                self.job = None

    def as_document(self) -> dict[str, Any]:
        """Return what the page needs to know, without the answers themselves."""
        job = self.job
        return {
            "choices": {each.name: getattr(self.choices, each.name) for each in fields(Choices)},
            "folder": str(self.folder),
            "robots": robot_names(),
            "switchable": [TILT, *available_terms()],
            "options": {
                "reading": _map_option_names(ReadingOptions),
                "options": _map_option_names(StudyOptions),
            },
            "job": None if job is None else job.as_dict(),
            "steps": {
                step: {
                    "command": shlex.join(("asbuilt", *self.arguments(step))),
                    "refusal": self.refusal(step),
                    "answered": step in self.answers,
                    "current": self.answer(step) is not None,
                }
                for step in STEPS
            },
        }


def _map_option_names(group: type[Any]) -> dict[str, str]:
    """Return the option of each field of an option class, with which a finding is cured."""
    return {each.name: name_option(each.name) for each in fields(group)}


def _split_words(options: str) -> Sequence[str]:
    """Return the words of a part of a command line."""
    try:
        return shlex.split(options)
    except ValueError as problem:
        raise UsageError(
            f"the options {options!r} cannot be read: {problem}", cure=Cure("close every quote")
        ) from None
