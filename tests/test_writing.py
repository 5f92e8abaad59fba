import os
from pathlib import Path

import pytest

import asbuilt.writing as files
from asbuilt.errors import UsageError
from asbuilt.writing import atomic_write, check_writable


def test_writes_text_and_bytes_and_makes_folders(tmp_path: Path) -> None:
    target = tmp_path / "a" / "b" / "x.txt"
    assert atomic_write(target, "é\r\n\n") == target
    assert target.read_bytes() == "é\r\n\n".encode()
    atomic_write(str(target), b"\x00\x01")
    assert target.read_bytes() == b"\x00\x01"
    assert [p.name for p in target.parent.iterdir()] == ["x.txt"]


def test_an_interrupted_write_leaves_the_old_file_and_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "x.txt"
    atomic_write(target, "old")

    def interrupted(_: int) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(files.os, "fsync", interrupted)
    with pytest.raises(KeyboardInterrupt):
        atomic_write(target, "new")
    assert target.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["x.txt"]


def test_full_disk_is_told_with_values(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(files.os, "fsync", full)
    with pytest.raises(UsageError, match=r"cannot write 3 bytes to .*: No space left on device"):
        atomic_write(tmp_path / "x.txt", "new")
    assert not list(tmp_path.iterdir())


def test_places_that_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="it is a folder"):
        atomic_write(tmp_path, "x")
    (tmp_path / "file").write_text("x")
    with pytest.raises(UsageError, match="cannot write"):
        atomic_write(tmp_path / "file" / "x", "x")


def test_keeps_the_mode_of_the_file_it_replaces(tmp_path: Path) -> None:
    target = tmp_path / "x"
    target.write_text("old")
    target.chmod(0o640)
    atomic_write(target, "new")
    assert target.stat().st_mode & 0o777 == 0o640
    mask = os.umask(0)
    os.umask(mask)
    assert atomic_write(tmp_path / "y", "new").stat().st_mode & 0o777 == 0o666 & ~mask


def test_a_place_is_looked_at_without_being_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    check_writable(tmp_path / "a" / "b")
    check_writable(Path("somewhere/below/here"))
    assert not list(tmp_path.iterdir())
    (tmp_path / "file").write_text("x")
    for place in (tmp_path / "file", tmp_path / "file" / "x"):
        with pytest.raises(UsageError, match="is a file"):
            check_writable(place)
    monkeypatch.setattr(files.os, "access", lambda path, mode, **_: False)
    with pytest.raises(UsageError, match="not open to you"):
        check_writable(tmp_path / "a")
