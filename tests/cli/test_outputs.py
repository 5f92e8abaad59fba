"""What a command writes replaces regular files alone, and none that the command reads."""

from __future__ import annotations

import os
import shutil
import stat
from pathlib import Path

import pytest

from asbuilt.errors import UsageError
from asbuilt.untrusted import protect_inputs, read_bytes
from asbuilt.workflow import identify
from asbuilt.writers import write_result
from asbuilt.writers.models.urdf import format_urdf
from asbuilt.writing import atomic_write, check_replaceable
from command_line import call
from fleet_logs import MODEL, recording


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a robot, a log and a result."""
    folder = tmp_path_factory.mktemp("study")
    shape = '</inertial><visual><geometry><box size="1 .2 .2"/></geometry></visual>'
    (folder / "r.urdf").write_text(format_urdf(MODEL).replace("</inertial>", shape))
    write_result(folder / "result.json", identify(MODEL, [recording(1)]).result)
    return folder


@pytest.fixture
def here(study: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of it, the current folder."""
    for path in study.iterdir():
        shutil.copy(path, tmp_path)
    (tmp_path / "sub").mkdir()
    monkeypatch.chdir(tmp_path)
    return tmp_path


def place(kind: str, of: str) -> str:
    """Another name of a file."""
    if kind == "same":
        return of
    if kind == "relative":
        return f"sub/../{of}"
    if kind == "absolute":
        return str(Path(of).absolute())
    target = Path(f"other{Path(of).suffix}")
    if kind == "hard link":
        os.link(of, target)
    else:
        target.symlink_to(of)
    return str(target)


@pytest.mark.parametrize("kind", ["same", "relative", "absolute", "hard link", "symbolic link"])
@pytest.mark.parametrize(("source", "command"), [
    ("r.urdf", "convert r.urdf OUT"),
    ("r.urdf", "masses r.urdf --density 2700 --out OUT"),
    ("result.json", "export result.json --to bam=OUT"),
    ("result.json", "export result.json --toml OUT"),
    ("result.json", "export result.json --mjcf OUT"),
])  # fmt: skip
def test_no_input_is_replaced_under_any_name(
    capsys: pytest.CaptureFixture[str], here: Path, kind: str, source: str, command: str
) -> None:
    before = (here / source).read_bytes()
    status, out, err = call(capsys, *command.replace("OUT", place(kind, source)).split())
    assert (status, out) == (2, ""), err
    assert "cannot write" in err
    assert ("symbolic link" if kind == "symbolic link" else "this command reads it") in err
    assert (here / source).read_bytes() == before
    assert not list(here.rglob("*.part"))


@pytest.mark.parametrize("kind", ["pipe", "socket", "device", "folder", "dangling link", "loop"])
def test_only_regular_files_are_replaced(
    capsys: pytest.CaptureFixture[str], here: Path, kind: str
) -> None:
    target = here / "x.toml"
    if kind == "pipe":
        os.mkfifo(target)
    elif kind == "device":
        try:
            os.mknod(target, stat.S_IFCHR | 0o600, os.makedev(1, 3))
        except PermissionError:
            pytest.skip("making a device needs rights")
    elif kind == "folder":
        target.mkdir()
    elif kind == "socket":
        os.mknod(target, stat.S_IFSOCK | 0o600)
    else:
        target.symlink_to("x.toml" if kind == "loop" else "nowhere.toml")
    before = target.lstat()
    status, out, err = call(capsys, "convert", "r.urdf", "x.toml")
    assert (status, out) == (2, "")
    assert "cannot write x.toml: it is a" in err
    assert ("; give the name of" in err) is True
    assert target.lstat() == before
    assert not Path("nowhere.toml").exists()


def test_devices_of_the_machine_stay() -> None:
    """Looked at, not tried: as root a mistake here would break the machine."""
    for name in ("/dev/null", "/dev/stdout", "/dev/full"):
        if Path(name).exists():
            with pytest.raises(UsageError, match="cannot write /dev/"):
                check_replaceable(Path(name))


def test_a_link_among_the_files_of_a_set_is_refused_and_the_set_stays(
    capsys: pytest.CaptureFixture[str], here: Path
) -> None:
    (here / "victim").write_text("precious")
    (here / "out").mkdir()
    (here / "out" / "thresholds.json").symlink_to(here / "victim")
    with pytest.raises(UsageError, match=r"symbolic link to .*victim"):
        atomic_write(here / "out" / "thresholds.json", "{}")
    assert (here / "victim").read_text() == "precious"


def test_outside_of_commands_a_file_that_was_read_may_be_replaced(tmp_path: Path) -> None:
    path = tmp_path / "x"
    path.write_text("old")
    read_bytes(path, "file", UsageError)
    atomic_write(path, "new")
    with protect_inputs():
        atomic_write(path, "newer")
        read_bytes(path, "file", UsageError)
        with pytest.raises(UsageError, match="this command reads it"):
            atomic_write(path, "newest")
        atomic_write(path, "newest", own=True)
    assert path.read_text() == "newest"


@pytest.mark.parametrize("name", ["a" * 300, "é" * 120, "nowhere/" * 800 + "x"])
def test_names_that_no_file_can_have_are_one_error(
    capsys: pytest.CaptureFixture[str], here: Path, name: str
) -> None:
    status, out, err = call(capsys, "convert", "r.urdf", f"{name}.toml")
    if len(name) == 120:
        assert (status, err) == (0, "")
        return
    assert (status, out) == (2, "")
    assert "cannot write" in err
    assert len(err) < 400


def test_the_first_of_many_creates(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for links in (True, False):
        if not links:
            monkeypatch.delattr(os, "link")
            monkeypatch.setattr(os, "link", _no_links, raising=False)
        path = tmp_path / f"x{links}"
        atomic_write(path, "first", create=True)
        with pytest.raises(FileExistsError):
            atomic_write(path, "second", create=True)
        assert path.read_text() == "first"
    assert not list(tmp_path.glob(".*"))


def _no_links(*_: object) -> None:
    raise PermissionError(1, "Operation not permitted")
