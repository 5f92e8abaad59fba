"""Tasks of the open benchmark: one TOML file each, with where its data come from and their digests.

A task names the files of its data folder with their sha256 digests, the description of the robot,
how the columns are read (`sheet`, a recording sheet of asbuilt), what is trained on and what is
predicted, the cutoff [Hz] of the plain low-pass, what the filter spoils at both ends of a log
(`edge` [s]), and the norm of the error. Without `test`, each log is cut: see `prepare.cut_logs`.
"""

from __future__ import annotations

import hashlib
import tomllib
import urllib.request
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

HERE = Path(__file__).resolve().parent
SHARED = HERE.parents[2] / "shared"
DOWNLOADED = HERE / ".data"
RESULTS = HERE / "results.jsonl"

Kind = Literal["torque", "legs", "twin", "halves", "virtual", "payload", "ratio", "command"]
Norm = Literal["torque", "joints", "limits"]


@dataclass(frozen=True, kw_only=True)
class Source:
    """Where files come from: repository, commit and licence as far as known, and a raw address."""

    repository: str
    commit: str = ""
    licence: str = "none stated"
    raw: str = ""
    robots: int = 1


@dataclass(frozen=True, kw_only=True)
class Task:
    """One task; paths are relative to the folder of data (`data/...`, `models/...`)."""

    name: str
    kind: Kind
    title: str
    description: str
    cutoff: float
    source: Source
    rate: float | None = None
    norm: Norm = "torque"
    files: dict[str, str] = field(default_factory=dict)
    addresses: dict[str, str] = field(default_factory=dict)
    training: tuple[str, ...] = ()
    test: tuple[str, ...] = ()
    sheet: dict[str, Any] = field(default_factory=dict)
    test_seconds: float | None = None
    edge: float = 1.0
    armature: bool = False
    skips: dict[str, str] = field(default_factory=dict)
    settings: dict[str, Any] = field(default_factory=dict)
    note: str = ""
    robot_page: bool = True

    def missing(self, data: Path) -> list[str]:
        """Return the files that a folder lacks."""
        return [each for each in self.files if not (data / each).is_file()]

    def damaged(self, data: Path) -> list[str]:
        """Return the files whose digest is another one."""
        return [
            path
            for path, digest in self.files.items()
            if (data / path).is_file() and sha256(data / path) != digest
        ]


def sha256(path: Path) -> str:
    """Return the digest of a file in hexadecimal digits."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def read_task(path: Path) -> Task:
    """Read a task."""
    values = tomllib.loads(path.read_text())
    values["source"] = Source(**values["source"])
    for key in ("training", "test"):
        values[key] = tuple(values.get(key, ()))
    return Task(name=path.stem, **values)


def tasks() -> dict[str, Task]:
    """Return all tasks by name."""
    return {
        path.stem: read_task(path)
        for path in sorted((HERE / "tasks").glob("*.toml"), key=lambda each: each.stem)
    }


def download(task: Task, data: Path) -> list[str]:
    """Fetch the files that a folder lacks from their public places, and return what went wrong."""
    problems = []
    for path in task.missing(data):
        address = task.addresses.get(path, "")
        if not address:
            problems.append(f"{path}: its public address is not known")
            continue
        url = address if "://" in address else task.source.raw + address
        try:
            with urllib.request.urlopen(url, timeout=60) as answer:
                content = answer.read()
        except OSError as problem:
            problems.append(f"{path}: {url} does not answer: {problem}")
            continue
        found = hashlib.sha256(content).hexdigest()
        if found != task.files[path]:
            problems.append(f"{path}: {url} has digest {found[:12]}, not {task.files[path][:12]}")
            continue
        (data / path).parent.mkdir(parents=True, exist_ok=True)
        (data / path).write_bytes(content)
    return problems
