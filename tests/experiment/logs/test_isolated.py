"""The process that reads files of unknown origin: kept while all is well, else replaced."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from asbuilt import children
from asbuilt import isolated_reading as isolated
from asbuilt.errors import MissingExtraError, RecordingError
from asbuilt.experiment import LogTable, read_isolated
from asbuilt.isolated_reading import FileKind

READERS = '''
import os, resource, signal, time
import numpy as np
from asbuilt.experiment.logs.formats.log_format import LogTable

def process(path):
    return LogTable(source=str(path), columns={"pid": np.array([float(os.getpid())])})

def limits(path):
    soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
    left = signal.getitimer(signal.ITIMER_PROF)[0]
    return LogTable(source=str(path), columns={"left": np.array([left])}, notes=(str(soft),))

def refuses(path):
    raise ValueError("no numbers")

def crashes(path):
    os.kill(os.getpid(), signal.SIGSEGV)

def hangs(path):
    time.sleep(60)

def computes(path):
    while True:
        pass

def waits(path):
    end = time.process_time() + 0.02
    time.sleep(1.5)
    return process(path)

def unpacks(path):
    import tempfile
    folder = tempfile.mkdtemp()
    path.with_suffix(".place").write_text(folder)
    for k in range(1000):
        with open(f"{folder}/{k}", "wb") as file:
            file.write(bytes(1 << 20))
        time.sleep(0.01)

def unpacks_one(path):
    import tempfile
    folder = tempfile.mkdtemp()
    path.with_suffix(".place").write_text(folder)
    with open(f"{folder}/0", "wb") as file:
        for _ in range(1000):
            file.write(bytes(1 << 20))

def is_killed_before(path):
    """Crash in a process that has read before, as if it had been killed while it was idle."""
    if limits.__doc__:
        os.kill(os.getpid(), signal.SIGKILL)
    return process(path)

def lacks(path):
    import no_such_library

def text(path):
    size = float(path.stat().st_size)
    return LogTable(source=str(path), columns={"size": np.array([size])}, notes=(str(os.getpid()),))

def counts(path, last, then=None):
    for k in range(last):
        yield {"k": k, "pid": os.getpid()}, [np.full(3, k)]
    if then is not None:
        then(path)

def marks(path):
    limits.__doc__ = "marked"
    return process(path)
'''


@pytest.fixture
def read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., LogTable]]:
    name = f"readers_of_{tmp_path.name.replace('-', '_')}"
    (tmp_path / f"{name}.py").write_text(READERS)
    log = tmp_path / "log.bin"
    log.write_bytes(b"0")
    monkeypatch.syspath_prepend(tmp_path)
    module = __import__(name)
    monkeypatch.setattr(isolated, "_idle", [])

    def read(what: str, path: Path = log, **kind: FileKind) -> LogTable:
        return read_isolated(getattr(module, what), path, **kind)

    read.parts = lambda **settings: isolated.read_parts_apart(module.counts, log, **settings)
    read.module = module
    yield read
    isolated._end_idle()
    sys.modules.pop(name)


def process_of(table: LogTable) -> int:
    return int(table.columns["pid"][0])


def is_running(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return True


def test_one_process_reads_many_files(read: Callable[..., LogTable]) -> None:
    first = process_of(read("process"))
    assert first != os.getpid()
    assert {process_of(read("process")) for _ in range(3)} == {first}


def test_a_relative_path_counts_from_the_folder_of_the_call(
    read: Callable[..., LogTable], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    processes = set()
    for size in (1, 2):
        (tmp_path / str(size)).mkdir()
        (tmp_path / str(size) / "log.bin").write_bytes(b"0" * size)
        monkeypatch.chdir(tmp_path / str(size))
        table = read("text", Path("log.bin"))
        assert table.columns["size"].tolist() == [size]
        processes |= set(table.notes)
    assert len(processes) == 1


@pytest.mark.parametrize(
    ("what", "said"), [("refuses", "no numbers"), ("crashes", "crashes its reader (SIGSEGV)")]
)
def test_a_process_that_met_an_error_is_not_used_again(
    read: Callable[..., LogTable], what: str, said: str
) -> None:
    first = process_of(read("process"))
    with pytest.raises(RecordingError) as caught:
        read(what)
    assert said in str(caught.value)
    assert not is_running(first)
    assert process_of(read("process")) != first


def test_a_library_that_is_not_installed_is_named_with_its_extra(
    read: Callable[..., LogTable], tmp_path: Path
) -> None:
    with pytest.raises(MissingExtraError, match="needs the package no_such_library") as caught:
        read("lacks", kind=FileKind("HDF5", extra="hdf5"))
    assert caught.value.extra == "hdf5"
    with pytest.raises(RecordingError, match=r"cannot be read as HDF5 \(ModuleNotFoundError: "):
        read("lacks", kind=FileKind("HDF5"))


def test_a_file_that_takes_too_much_computing_ends_its_process(
    read: Callable[..., LogTable], monkeypatch: pytest.MonkeyPatch
) -> None:
    first = process_of(read("process"))
    monkeypatch.setattr(isolated, "LIMITS", replace(isolated.LIMITS, time=0.3))
    with pytest.raises(RecordingError, match=r"takes more than 0.3 s of computing to read"):
        read("computes")
    assert not is_running(first)


def test_waiting_costs_nothing_of_the_limit(
    read: Callable[..., LogTable], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A computer that has no time for the process for a while does not make its file damaged."""
    read("process")
    monkeypatch.setattr(isolated, "LIMITS", replace(isolated.LIMITS, time=0.5))
    assert process_of(read("waits")) != os.getpid()


def test_a_file_without_progress_is_given_up_and_not_called_damaged(
    read: Callable[..., LogTable], monkeypatch: pytest.MonkeyPatch
) -> None:
    first = process_of(read("process"))
    monkeypatch.setattr(children, "STILL", 0.6)
    monkeypatch.setattr(isolated, "STILL", 0.6)
    monkeypatch.setattr(children, "LOOK", 0.05)
    with pytest.raises(RecordingError, match=r"stopped after 0.6 s without progress") as caught:
        read("hangs")
    assert "damaged" not in str(caught.value)
    assert not is_running(first)


@pytest.mark.parametrize("what", ["unpacks", "unpacks_one"])
def test_disk_is_limited_and_nothing_stays_on_it(
    read: Callable[..., LogTable], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, what: str
) -> None:
    monkeypatch.setattr(isolated, "LIMITS", replace(isolated.LIMITS, disk=20_000_000))
    monkeypatch.setattr(children, "LOOK", 0.05)
    with pytest.raises(RecordingError, match=r"unpacks to more than 0.02 GB"):
        read(what)
    assert not Path((tmp_path / "log.place").read_text()).exists()


def test_a_limit_of_time_leaves_nothing_on_the_disk(
    read: Callable[..., LogTable], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    read("process")
    monkeypatch.setattr(isolated, "LIMITS", replace(isolated.LIMITS, time=0.02))
    with pytest.raises(RecordingError, match="of computing to read"):
        read("unpacks")
    assert not Path((tmp_path / "log.place").read_text()).exists()


def test_files_of_a_folder_that_are_not_read_do_not_count(tmp_path: Path) -> None:
    (tmp_path / "videos").mkdir()
    with (tmp_path / "videos" / "front.mp4").open("wb") as film:
        film.truncate(5_000_000_000)
    (tmp_path / "data.parquet").write_bytes(b"0" * 1000)
    assert isolated._measure_size(tmp_path, FileKind(reads=(".parquet",))) == 1000.0
    with pytest.raises(RecordingError, match="5000 MB; at most 4000 MB"):
        isolated._measure_size(tmp_path, FileKind())


def test_a_process_that_was_killed_while_idle_is_replaced(read: Callable[..., LogTable]) -> None:
    first = process_of(read("process"))
    os.kill(first, signal.SIGKILL)
    assert process_of(read("process")) != first
    second = process_of(read("marks"))
    assert process_of(read("is_killed_before")) != second


def test_every_file_has_limits_of_its_own(
    read: Callable[..., LogTable], monkeypatch: pytest.MonkeyPatch
) -> None:
    read("process")
    tables = []
    for seconds in (50.0, 90.0):
        monkeypatch.setattr(isolated, "LIMITS", replace(isolated.LIMITS, time=seconds))
        tables.append(read("limits"))
    for seconds, table in zip((50.0, 90.0), tables, strict=True):
        assert -0.1 <= seconds - table.columns["left"][0] < 5.0  # the system rounds
    first, second = (int(table.notes[0]) for table in tables)
    assert first > 0
    assert abs(second - first) < isolated.LIMITS.memory


def test_a_process_is_replaced_after_many_files(
    read: Callable[..., LogTable], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(isolated, "MOST_FILES", 2)
    found = [process_of(read("process")) for _ in range(4)]
    assert found[0] == found[1] != found[2] == found[3]


def test_a_file_is_read_part_by_part_in_one_process(read: Any) -> None:
    parts = list(read.parts(last=4))
    assert [document["k"] for document, _ in parts] == [0, 1, 2, 3]
    assert [values.tolist() for _, (values,) in parts] == [[k] * 3 for k in range(4)]
    (process,) = {document["pid"] for document, _ in parts}
    assert process != os.getpid()
    assert not is_running(process)


def test_parts_that_nobody_asks_for_leave_no_process(read: Any) -> None:
    parts = read.parts(last=1000)
    process = next(parts)[0]["pid"]
    assert is_running(process)
    parts.close()
    assert not is_running(process)


@pytest.mark.parametrize(
    ("then", "said"), [("crashes", "crashes its reader"), ("refuses", "no numbers")]
)
def test_a_part_that_cannot_be_read_is_one_error(read: Any, then: str, said: str) -> None:
    parts = read.parts(last=2, then=getattr(read.module, then))
    assert [next(parts)[0]["k"] for _ in range(2)] == [0, 1]
    with pytest.raises(RecordingError, match=said):
        next(parts)
