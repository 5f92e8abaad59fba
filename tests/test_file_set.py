"""A set of files is replaced as a set; killed processes leave nothing for long."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from asbuilt.writing import _OWNER, atomic_write, file_set, remove_leftovers

MEMBERS = ("result.json", "robot.toml", "robot.urdf")


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_members_of_an_older_set_go(tmp_path: Path) -> None:
    for name in (*MEMBERS, "mine.txt"):
        (tmp_path / name).write_text("old")
    with file_set(tmp_path, "result.json", MEMBERS):
        atomic_write(tmp_path / "result.json", "new")
        atomic_write(tmp_path / "robot.toml", "new")
        assert (tmp_path / "result.json").read_text() == "old"
    assert names(tmp_path) == ["mine.txt", "result.json", "robot.toml"]
    assert (tmp_path / "robot.toml").read_text() == "new"


def test_a_failure_leaves_the_older_set(tmp_path: Path) -> None:
    for name in MEMBERS:
        (tmp_path / name).write_text("old")

    def broken() -> None:
        with file_set(tmp_path, "result.json", MEMBERS):
            atomic_write(tmp_path / "result.json", "new")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        broken()
    assert names(tmp_path) == sorted(MEMBERS)
    assert {(tmp_path / name).read_text() for name in MEMBERS} == {"old"}


def test_the_robot_that_was_given_and_foreign_files_stay(tmp_path: Path) -> None:
    given = tmp_path / "robot.urdf"
    given.write_text("given")
    with file_set(tmp_path, "result.json", MEMBERS):
        atomic_write(tmp_path / "result.json", "1")
    assert given.exists()
    with file_set(tmp_path, "result.json", MEMBERS, keep=str(given)):
        atomic_write(tmp_path / "result.json", "2")
    assert given.exists()


def test_leftovers_of_dead_processes_are_removed(tmp_path: Path) -> None:
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    host = _OWNER.rsplit(".", 1)[0]
    dead = tmp_path / f".result.json.{host}.{ended.pid}.abcd.part"
    alive = tmp_path / f".result.json.{_OWNER}.abcd.part"
    other = tmp_path / f".result.json.elsewhere.{ended.pid}.abcd.part"
    for path in (dead, alive, other):
        path.write_text("half")
    remove_leftovers(tmp_path)
    assert names(tmp_path) == sorted([alive.name, other.name])
