"""One way in for recordings, and a log format that another distribution adds."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from datetime import datetime
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from asbuilt.errors import RecordingError, UsageError
from asbuilt.experiment import (
    ReadingOptions,
    Recording,
    RecordingStream,
    Samples,
    as_recordings,
    read_recording,
)
from asbuilt.experiment.logs import long_recordings


def arrays(n: int = 40) -> dict[str, np.ndarray]:
    t = 0.01 * np.arange(n)
    q = np.stack([np.sin(t), np.cos(t)], axis=1)
    return {"t": t, "q": q, "tau": 3.0 * q}


def frame() -> pl.DataFrame:
    made = arrays()
    columns = {"t": made["t"]}
    columns |= {f"{name}_{k}": made[name][:, k - 1] for name in ("q", "tau") for k in (1, 2)}
    return pl.DataFrame(columns)


def test_every_source_gives_the_same_recording(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    frame().write_csv(path)
    expected = arrays()
    for source in (path, str(path), [path], frame(), arrays()):
        found = read_recording(source, gain=2.0)
        np.testing.assert_allclose(found.t, expected["t"])
        np.testing.assert_allclose(found.q, expected["q"])
        np.testing.assert_allclose(found.tau, 2.0 * expected["tau"])


def test_pandas_frames_with_a_named_index_of_time_stamps() -> None:
    pandas = pytest.importorskip("pandas")
    plain = pandas.DataFrame({name: frame()[name].to_numpy() for name in frame().columns})
    stamped = plain.assign(t=pandas.to_timedelta(plain["t"], unit="s")).set_index("t")
    for source in (plain, plain.set_index("t"), stamped):
        found = read_recording(source)
        np.testing.assert_allclose(found.t, arrays()["t"], atol=1e-12)
        np.testing.assert_allclose(found.q, arrays()["q"])


def test_missing_time_stamps_are_missing() -> None:
    stamps = [datetime(2026, 1, 1, second=k) for k in range(3)]
    columns = {"q_1": [0.0, 0.1, 0.2], "tau_1": [1.0, 2.0, 3.0]}
    recording = read_recording(pl.DataFrame({"t": [stamps[0], None, stamps[2]], **columns}))
    np.testing.assert_array_equal(recording.t, [0.0, np.nan, 2.0])
    t = np.array(stamps, dtype="datetime64[us]")
    np.testing.assert_array_equal(read_recording({"t": t, **columns}).t, [0.0, 1.0, 2.0])


def test_time_stamps_in_an_archive_are_seconds(tmp_path: Path) -> None:
    t = np.arange(4) * np.timedelta64(10, "ms")
    for stamps in (t, np.datetime64("2026-01-01") + t):
        np.savez(tmp_path / "log.npz", t=stamps, q_1=np.arange(4.0), tau_1=np.ones(4))
        recording = read_recording(tmp_path / "log.npz")
        np.testing.assert_allclose(recording.t, [0.0, 0.01, 0.02, 0.03], atol=1e-6)


def test_one_or_many_of_any_kind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "log.csv"
    frame().write_csv(path)
    recording = read_recording(path)
    x = arrays()["q"]
    samples = Samples(arrays()["t"], x, x, x, x, rate=100.0, joint_names=("a", "b"))
    stream = RecordingStream(path)
    items = [path, frame(), arrays(), recording, stream, samples]
    found = as_recordings(None, items, flip_torque=True)
    assert found[3:] == [recording, stream, samples]
    for each in found[:3]:
        assert isinstance(each, Recording)
        np.testing.assert_array_equal(each.tau, -recording.tau)
    for item in items:
        assert len(as_recordings(None, item)) == 1
    monkeypatch.setattr(long_recordings, "LONG", 10)
    (long,) = as_recordings(None, path, ReadingOptions(gain=2.0), flip_torque=True)
    assert isinstance(long, RecordingStream)
    np.testing.assert_allclose(long.head.tau, -2.0 * recording.tau)


def test_a_sheet_may_be_a_dict() -> None:
    named = {"columns": {"position": "2-3", "torque": "4-5"}, "units": {"position": "deg"}}
    renamed = frame().rename({name: f"x{k}" for k, name in enumerate(frame().columns)})
    found = read_recording(renamed, sheet=named, rate=100.0)
    np.testing.assert_allclose(found.q, np.deg2rad(arrays()["q"]))


def test_errors_carry_fields(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text("t,q1,tau1\n0,1,2\n0.1,oops,2\n", encoding="utf-8")
    with pytest.raises(RecordingError) as error:
        read_recording(path)
    assert (error.value.file, error.value.line, error.value.value) == (str(path), 3, "oops")
    with pytest.raises(UsageError, match=r"no option 'speed'; .*there are rate, flip_torque"):
        read_recording(path, speed=3)
    with pytest.raises(UsageError, match=r"no option 'flip_torques'; did you mean 'flip_torque'\?"):
        read_recording(path, flip_torques=True)
    with pytest.raises(UsageError, match="torque_source 'wheel' is not one of sensor"):
        ReadingOptions(torque_source="wheel")  # type: ignore[arg-type]
    with pytest.raises(RecordingError, match="none of its columns is numeric"):
        read_recording(pl.DataFrame({"t": ["a"]}))


FORMAT = """
import json

import numpy as np

from asbuilt.experiment import FORMATS, LogFormat, LogTable


def read_lines(path, sheet):
    rows = [json.loads(line) for line in path.read_text().splitlines()]
    columns = {name: np.array([row[name] for row in rows], dtype=float) for name in rows[0]}
    return LogTable(source=str(path), columns=columns)


FORMATS.register("json lines", LogFormat(suffixes=(".jsonl",), read=read_lines))
"""


@pytest.mark.study
def test_a_format_of_another_distribution_is_checked_from_the_command_line(tmp_path: Path) -> None:
    site = tmp_path / "site"
    about = site / "json_lines-1.0.dist-info"
    about.mkdir(parents=True)
    (site / "json_lines.py").write_text(FORMAT, encoding="utf-8")
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: json-lines\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[asbuilt.log_formats]\njsonl = json_lines\n")
    log = tmp_path / "log.jsonl"
    log.write_text("\n".join(json.dumps(row) for row in frame().to_dicts()), encoding="utf-8")

    def check(path: str) -> subprocess.CompletedProcess[str]:
        command = ("-m", "asbuilt", "check", "two-link", str(log), "--json")
        return subprocess.run(
            [sys.executable, *command],
            env=os.environ | {"PYTHONPATH": os.pathsep.join([path, *sys.path])},
            capture_output=True,
            text=True,
            check=False,
        )

    found = json.loads(check(str(site)).stdout)
    assert found["recordings"][0]["n_samples"] == 40
    assert "known are" in check("").stdout
