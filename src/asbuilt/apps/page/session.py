"""What a page has chosen, the command of each step, and the answers so far."""

from __future__ import annotations

import re
import shlex
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from hashlib import blake2b
from pathlib import Path
from typing import Any

from asbuilt import UsageError, robot_names
from asbuilt.apps.page.choices import (
    EXPORTS,
    LINES,
    ROLES,
    Choices,
    Fingerprints,
    is_same_robot,
    list_field_options,
    list_options,
    read_options,
    set_option,
    split_words,
)
from asbuilt.apps.page.columns import write_sheet
from asbuilt.apps.page.worker import Worker
from asbuilt.dynamics import available_terms
from asbuilt.identification import TILT
from asbuilt.writing import remove_leftovers

STEPS = ("show", "columns", "check", "identify", "view", "export")
"""The commands of the page, in the order of its sections."""
READING = ("show", "columns", "check")
"""Steps that only read, and follow every choice by themselves."""
SAMPLE = "sample"
"""A job that is no step: it records the virtual robot of a page that was opened empty."""
SAMPLE_ROBOT = "ur10e"


@dataclass
class Job:
    """Hold a command while it runs, what it reads, and the key that its answer will have."""

    step: str
    arguments: tuple[str, ...]
    inputs: list[Path]
    key: str
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


@dataclass(frozen=True)
class Answer:
    """Hold what a command printed.

    Parameters
    ----------
    key
        Letters that stand for its arguments and for what every file that it read held.
    arguments
        The arguments.
    document
        What it printed with `--json`.
    written
        Fingerprint of the files that it wrote.
    """

    key: str
    arguments: tuple[str, ...]
    document: dict[str, Any]
    written: str


class Session:
    """Hold the choices of a page, run its steps, and keep their answers.

    An answer belongs to the question: the arguments, and the content of every file that they name.
    It is out of date as soon as other choices or other files make another question.

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
        self.note = ""
        self.answers: dict[str, Answer] = {}
        self.offered: list[dict[str, Any]] = []
        self._fingerprints = Fingerprints(folder)
        self._serial = 0
        self._worker = Worker()
        self._lock = threading.RLock()
        self._remove_leftovers()

    @property
    def result(self) -> Path:
        """The result of the identification."""
        return self.folder / "result.json"

    @property
    def uploads(self) -> Path:
        """Folder of the files that were sent."""
        return self.folder / "uploads"

    def choose(self, given: Mapping[str, Any]) -> None:
        """Change what is chosen; raises `UsageError` for what no command line could say.

        Options go with the robot: another one starts without those of the last, another log of the
        same robot keeps them.
        """
        with self._lock:
            chosen = Choices.of(given)
            note = ""
            old = self.choices
            robot = chosen.get("robot", old.robot)
            if old.robot and robot != old.robot and not is_same_robot(robot, old.robot):
                left = " ".join(filter(None, (old.reading, old.options)))
                chosen = {"reading": "", "options": "", "effects": ""} | chosen
                note = f"The options of {Path(old.robot).name} were reset: {left}" if left else ""
            self.choices = replace(old, **chosen)
            self.note = note
            self.follow()

    def use_logs(self, paths: Any, role: Any) -> None:
        """Give recordings a role of `ROLES`, the last in it; an empty one removes them.

        What a page knows of the others may be old: two changes made at once are both kept.
        """
        if role not in ("", *ROLES) or not isinstance(paths, list):
            raise UsageError("a list of logs takes a use", value=role, available=ROLES)
        with self._lock:
            chosen = {
                name: [path for path in getattr(self.choices, name) if path not in paths]
                for name in ROLES
            }
            if role:
                chosen[role] += paths
            self.choose(chosen)

    def set_option(self, line: Any, option: Any, value: Any) -> None:
        """Give an option a value in a line of options; True sets a flag, False removes it."""
        if line not in LINES or not isinstance(option, str) or not isinstance(value, str | bool):
            raise UsageError("an option takes the name of its line, its name and a text")
        with self._lock:
            text = set_option(line, getattr(self.choices, line), option, value)
            self.choose({line: text})

    def arguments(self, step: str) -> tuple[str, ...]:
        """Return the arguments of the command of a step."""
        chosen = self.choices
        reading = split_words(chosen.reading)
        logs = chosen.recordings
        others = [
            word
            for option, paths in (("--validate", chosen.validation), ("--payload", chosen.payload))
            for path in paths
            for word in (option, path)
        ]
        effects = ["--effects", chosen.effects] if chosen.effects else []
        result = str(self.result)
        return {
            "show": ("show", chosen.robot),
            "columns": ("columns", chosen.robot, *logs[:1], *reading),
            "check": ("check", chosen.robot, *logs, *reading),
            "identify": (
                "identify", chosen.robot, *chosen.logs, *others, *reading,
                *split_words(chosen.options), *effects, "-o", str(self.folder),
            ),
            "view": (
                "view", result, *chosen.logs[:1], *reading, "--save", str(self.folder / "view.html")
            ),
            "export": ("export", result, *self._list_export_words()),
        }[step]  # fmt: skip

    def _list_export_words(self) -> tuple[str, str]:
        _, option, name = EXPORTS[self.choices.export]
        path = str(self.folder / name)
        return option, f"{self.choices.export}={path}" if option == "--to" else path

    def find_key(self, step: str) -> str:
        """Return letters that stand for the arguments of a step and the content of its inputs."""
        return self._mark_question(self.arguments(step), self._list_inputs(step))

    def _mark_question(self, arguments: tuple[str, ...], inputs: list[Path]) -> str:
        mark = blake2b(digest_size=12)
        mark.update(self._fingerprints.of_inputs(*inputs).encode())
        mark.update("\0".join(arguments).encode("utf-8", "surrogateescape"))
        return mark.hexdigest()

    def _list_inputs(self, step: str) -> list[Path]:
        """Return every path that a step reads if something lies there."""
        arguments = self.arguments(step)[1:]
        words = [part for word in arguments for part in (word, word.partition("=")[2]) if part]
        paths = [Path(word) for word in words if word not in robot_names()]
        for log in map(Path, self.choices.recordings):
            if step not in ("show", "export") and log.name:
                paths += [log.with_name(f"{log.name}.toml"), log.with_suffix(".toml")]
        written = {
            "identify": self.folder,
            "view": self.folder / "view.html",
            "export": self.folder / EXPORTS[self.choices.export][2],
        }.get(step)
        return [path for path in dict.fromkeys(paths) if path != written]

    def refusal(self, step: str) -> str | None:
        """Return why a step cannot be run yet, None if it can."""
        chosen = self.choices
        if not chosen.robot:
            return "choose a robot first"
        if step in ("columns", "check", "identify") and not chosen.recordings:
            return "choose a log first"
        if step == "identify":
            if not chosen.logs:
                return "choose a log to identify with"
            return self._find_fault()
        if step in ("view", "export"):
            identified = self.answer("identify")
            if identified is None or "error" in identified:
                return "identify the robot first"
        return None

    def _find_fault(self) -> str | None:
        """Return what the check found wrong, or that the logs have not been checked."""
        checked = self.answer("check")
        if checked is None:
            return "the logs are not checked yet"
        if "error" in checked:
            # The check above has the whole message.
            return str(checked["error"]["message"]).partition("; ")[0]
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
        """Return the answer of a step to the present question, None if there is none."""
        stored = self.answers.get(step)
        if stored is None or (step != "identify" and self.refusal(step) is not None):
            return None
        is_same = stored.key == self.find_key(step)
        return stored.document if is_same and self._has_files(stored) else None

    def find_answer(self, key: str) -> dict[str, Any] | None:
        """Return the stored answer of a key, None if another one has taken its place."""
        with self._lock:
            return next(
                (answer.document for answer in self.answers.values() if answer.key == key), None
            )

    def _mark_files(self, document: Mapping[str, Any]) -> str:
        """Return the fingerprint of the files that a command wrote; of a study, of those shown."""
        files = document.get("files")
        if not isinstance(files, dict):
            return ""
        shown = [path for kind, path in files.items() if kind in ("result", "report")]
        return self._fingerprints.of_inputs(*(shown or files.values()))

    def _has_files(self, answer: Answer) -> bool:
        """Return whether the files of an answer hold what it wrote.

        A command that was ended after its last file has replaced them and has no answer.
        """
        return answer.written == self._mark_files(answer.document)

    def run(self, step: str, given: Mapping[str, Any] | None = None) -> None:
        """Make further choices, and start a step.

        Raises `UsageError` if the step is refused or another one runs.
        """
        if step not in STEPS:
            raise UsageError(f"there is no step {step[:40]!r}", available=STEPS)
        with self._lock:
            if given:
                self.choose(given)
            self._begin(step, self.arguments(step), self.refusal(step))

    def run_sample(self) -> None:
        """Record a virtual robot, and choose it and its recording."""
        log = self.folder / SAMPLE / f"{SAMPLE_ROBOT}.csv"
        words = ("--engine", "inverse-dynamics", "--preset", "lab", "--rate", "250")
        with self._lock:
            started = self.choices.robot or self.choices.recordings
            why = "a robot or a log is chosen already" if started else None
            self._begin(SAMPLE, ("simulate", SAMPLE_ROBOT, *words, "-o", str(log)), why)

    def _begin(self, step: str, arguments: tuple[str, ...], why: str | None) -> None:
        if self.job is not None:
            why = "another step is running; cancel it or wait"
        if why is not None:
            raise UsageError(why)
        inputs = self._list_inputs(step) if step in STEPS else []
        self.job = Job(step, arguments, inputs, self._mark_question(arguments, inputs))
        threading.Thread(target=self._run, args=(self.job,), daemon=True).start()

    def follow(self) -> None:
        """Start the first step that only reads and has no answer; end one whose question is old."""
        with self._lock, self._fingerprints.hold():
            job = self.job
            if job is not None and job.step in READING and job.key != self.find_key(job.step):
                self._end()
            if self.job is None:
                waiting = (step for step in READING if self.refusal(step) is None)
                due = next((step for step in waiting if self.answer(step) is None), None)
                if due is not None:
                    self._begin(due, self.arguments(due), None)

    def assign(self, chosen: Any) -> Path:
        """Write a recording sheet of the columns chosen, and read the logs by it.

        Raises `UsageError` if the columns are not known yet, or cannot be a sheet's.
        """
        with self._lock:
            document = self.answer("columns")
            if document is None or "error" in document:
                raise UsageError("the columns of the log have not been read")
            sheet = read_options("reading", self.choices.reading).get("--sheet")
            log = Path(self.choices.recordings[0])
            path = self.folder / f"{log.name}.sheet.toml"
            write_sheet(path, log, None if sheet is None else str(sheet), document, chosen)
            self.set_option("reading", "--sheet", str(path))
            return path

    def make_batch(self) -> str:
        """Return the name of a new folder of uploads: files of one name lie side by side."""
        with self._lock:
            self.uploads.mkdir(parents=True, exist_ok=True)
            number = 1 + max(
                (_read_number(folder.name) for folder in self.uploads.iterdir()), default=0
            )
            (self.uploads / str(number)).mkdir()
            return str(number)

    def cancel(self) -> None:
        """End the running step."""
        with self._lock:
            self._end()

    def _end(self) -> None:
        if self.job is not None:
            self.job = None
            self._worker.cancel()
            self._remove_leftovers()

    def close(self) -> None:
        """End the process of the commands, and remove what was half-written."""
        self._worker.close()
        self._remove_leftovers()

    def _remove_leftovers(self) -> None:
        with suppress(OSError):
            for folder in (self.folder, *self.uploads.glob("*/**/")):
                remove_leftovers(folder)

    def _run(self, job: Job) -> None:
        def progress(what: str, fraction: float) -> None:
            job.what = what
            job.fraction = fraction

        document = self._worker.run(job.arguments, progress)
        with self._lock:
            if self.job is not job:
                return
            self.job = None
            if job.step == SAMPLE:
                self._take_sample(document)
                return
            if job.step == "identify":
                self._offer_effects(job.arguments, document)
            key = job.key
            if self._mark_question(job.arguments, job.inputs) != key:
                # A file changed while it was read: nobody knows which of its contents this is of.
                key += f"-{time.monotonic_ns()}"
            written = self._mark_files(document)
            self.answers[job.step] = Answer(key, job.arguments, document, written)
            self.follow()

    def _offer_effects(self, arguments: tuple[str, ...], document: dict[str, Any]) -> None:
        """Keep the effects that were switched off, so that they can be switched on again."""
        found = list(document.get("effects", ()))
        before = self.answers.get("identify")
        if "--effects" in arguments and before is not None:
            known = {(effect["effect"], effect["joint"]) for effect in found}
            found += [
                {**effect, "in_model": False}
                for effect in self.offered
                if (effect["effect"], effect["joint"]) not in known
            ]
        self.offered = found

    def _take_sample(self, document: dict[str, Any]) -> None:
        """Choose the robot and the recording of a sample, or say why there is none."""
        if "error" in document:
            self.note = str(document["error"]["message"])
        else:
            log = str(document["files"]["recording"])
            self.choose({"robot": SAMPLE_ROBOT, "logs": [log]})

    def as_document(self) -> dict[str, Any]:
        """Return what the page needs to know, without the answers themselves.

        A document is newer than all of a smaller `serial`.
        """
        with self._lock, self._fingerprints.hold():
            self._serial += 1
            job = self.job
            return {
                "serial": self._serial,
                "choices": asdict(self.choices),
                "fields": {line: read_options(line, getattr(self.choices, line)) for line in LINES},
                "note": self.note,
                "offered": self.offered,
                "folder": str(self.folder),
                "robots": robot_names(),
                "formats": {name: about[0] for name, about in EXPORTS.items()},
                "switchable": [TILT, *available_terms()],
                "options": {line: list_field_options(line) for line in LINES},
                "flags": [
                    option
                    for line in LINES
                    for option, is_flag in list_options(line).items()
                    if is_flag
                ],
                "job": None if job is None else job.as_dict(),
                "steps": {step: self._describe_step(step) for step in STEPS},
            }

    def _describe_step(self, step: str) -> dict[str, Any]:
        """Return the command of a step, why it must wait, and the key of its last answer."""
        stored = self.answers.get(step)
        return {
            "command": shlex.join(("asbuilt", *self.arguments(step))),
            "refusal": self.refusal(step),
            "key": None if stored is None else stored.key,
            "answered": None if stored is None else shlex.join(("asbuilt", *stored.arguments)),
            "current": self.answer(step) is not None,
            "kept": stored is not None and self._has_files(stored),
        }


def _read_number(name: str) -> int:
    """Return the number of a folder of uploads, 0 for anything else."""
    return int(name) if re.fullmatch(r"[0-9]{1,9}", name) else 0
