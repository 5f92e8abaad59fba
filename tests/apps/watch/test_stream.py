"""Rows from standard input: the events of the file, within a sample; broken streams are said."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from watched_robot import WatchedRobot

from asbuilt import Observer, ReadingOptions, watch
from asbuilt.apps.watch import Event, StreamWatch, make_stream_observer, read_lines, watch_stream
from asbuilt.apps.watch.stream import MOST_BROKEN, RowReader
from asbuilt.description import bundled_robot
from asbuilt.errors import RecordingError, UsageError
from asbuilt.experiment import Recording
from asbuilt.writers import write_recording, write_result


def pushed(watched: WatchedRobot) -> Recording:
    external = np.zeros(watched.record(24, 10.0).q.shape)
    external[800:900, 1] = 60.0
    return watched.record(24, 10.0, external)


def as_csv(log: Recording) -> list[str]:
    n = log.n_joints
    names = ["t", *(f"{each}_{k}" for each in ("q", "qd", "tau") for k in range(n))]
    assert log.qd is not None
    rows = np.hstack([log.t[:, None], log.q, log.qd, log.tau])
    return [",".join(names), *(",".join(map(repr, row)) for row in rows.tolist())]


def as_json_lines(log: Recording) -> list[str]:
    assert log.qd is not None
    columns = zip(*(x.tolist() for x in (log.t, log.q, log.qd, log.tau)), strict=True)
    return [json.dumps(dict(zip(("t", "q", "qd", "tau"), row, strict=True))) for row in columns]


def run(
    watched: WatchedRobot, lines: Iterator[str] | list[str]
) -> tuple[list[float], list[Event], list[str], StreamWatch]:
    """Starts, events and messages of a stream."""
    starts: list[float] = []
    events: list[Event] = []
    told: list[str] = []
    watching = StreamWatch(
        Observer(watched.result, thresholds=watched.thresholds),
        None,
        lambda t, *_: starts.append(t),
        events.append,
    )
    watch_stream(iter(lines), watching, told.append)
    return starts, events, told, watching


@pytest.mark.parametrize("form", [as_csv, as_json_lines])
def test_the_events_are_those_of_the_file(watched: WatchedRobot, form: object) -> None:
    log = pushed(watched)
    of_file = watch(watched.result, log, thresholds=watched.thresholds).events
    starts, events, told, watching = run(watched, form(log))  # type: ignore[operator]
    assert not told
    assert watching.n_samples == log.n_samples
    assert len(events) == len(of_file) >= 1
    for mine, other in zip(events, of_file, strict=True):
        assert (mine.kind, mine.joints, mine.link) == (other.kind, other.joints, other.link)
        assert (mine.start, mine.end, mine.peak) == (other.start, other.end, other.peak)
        np.testing.assert_allclose(mine.residual, other.residual, rtol=1e-6, atol=1e-8)
        np.testing.assert_allclose(mine.threshold, other.threshold, rtol=1e-6)
    assert starts == [event.start for event in of_file]


def test_a_begin_is_told_with_its_sample(watched: WatchedRobot) -> None:
    """No later row is asked for before the start of an event is told."""
    log = pushed(watched)
    first = watch(watched.result, log, thresholds=watched.thresholds).events[0].start
    given: list[float] = []

    def lines() -> Iterator[str]:
        header, *rows = as_csv(log)
        yield header
        for t, row in zip(log.t.tolist(), rows, strict=True):
            given.append(t)
            yield row

    asked: list[float] = []
    watching = StreamWatch(
        Observer(watched.result, thresholds=watched.thresholds),
        None,
        lambda t, *_: asked.append(given[-1]),
        lambda event: None,
    )
    watch_stream(lines(), watching, lambda text: None)
    assert asked[0] == first


def test_units_signs_and_names_of_columns_are_those_of_a_log() -> None:
    model = bundled_robot("ur10e")
    names = ["tau_5", "time_ms", "note"]
    names += [f"q_{k} [deg]" for k in range(6)] + [f"tau_{k}" for k in range(5)]
    reader = RowReader.of(names, model, ReadingOptions(flip_torque=True), "stream")
    row = np.arange(1.0, len(names) + 1.0)
    t, found = reader.read(row)
    assert t == pytest.approx(2e-3)
    np.testing.assert_allclose(found["q"], np.deg2rad(row[3:9]), rtol=1e-9)
    np.testing.assert_allclose(found["tau"], -np.array([*row[9:14], row[0]]), rtol=1e-9)
    assert "qd" not in found
    with pytest.raises(RecordingError, match="no column of time"):
        RowReader.of([name for name in names if name != "time_ms"], model, ReadingOptions(), "x")


def test_rows_that_cannot_be_read_are_said(watched: WatchedRobot) -> None:
    header, *rows = as_csv(pushed(watched))
    torn = [header, *rows[:50], rows[50][:20], "", *rows[51:60], rows[55], *rows[60:80]]
    _, _, told, watching = run(watched, torn)
    assert told[0].startswith("line 52 cannot be read (ValueError ")
    assert len(told) == 1
    assert watching.n_samples == 79
    assert watching.left_out == 1
    with pytest.raises(RecordingError, match="lines together cannot be read"):
        run(watched, [header, *["nothing"] * MOST_BROKEN])
    with pytest.raises(RecordingError, match="nothing came"):
        run(watched, [])
    kept = [name for name in header.split(",") if not name.startswith("qd")]
    with pytest.raises(RecordingError, match="no velocities"):
        run(watched, [",".join(kept), ",".join("0" for _ in kept)])
    with pytest.raises(UsageError, match="no quieter half"):
        make_stream_observer(watched.result)


def test_a_pause_and_a_torn_end_are_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("asbuilt.apps.watch.stream.STALLED", 0.05)
    source, sink = os.pipe()
    told: list[str] = []

    def write() -> None:
        os.write(sink, b"a\nb")
        threading.Event().wait(0.2)
        os.write(sink, b"c\nrest")
        os.close(sink)

    writer = threading.Thread(target=write)
    writer.start()
    assert list(read_lines(source, told.append)) == ["a", "bc"]
    writer.join()
    os.close(source)
    assert told == [
        "no row for 0.05 s: the stream has stalled",
        "the stream goes on",
        "the stream ended within a row",
    ]


@pytest.mark.study
def test_a_pipe_from_the_command_line(watched: WatchedRobot, tmp_path: Path) -> None:
    write_result(tmp_path / "result.json", watched.result)
    quiet = []
    for k, log in enumerate(watched.quiet):
        write_recording(tmp_path / f"quiet{k}.csv", log)
        quiet += ["--calibrate", f"quiet{k}.csv"]
    text = "\n".join(as_csv(pushed(watched))) + "\n"
    done = subprocess.run(
        [sys.executable, "-m", "asbuilt", "watch", "result.json", "-", *quiet, "--unchecked",
         "--json"],
        cwd=tmp_path, input=text, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    lines = [json.loads(line) for line in io.StringIO(done.stdout)]
    assert [line["event"] for line in lines] == ["begin", "end", "stream ended"]
    assert abs(lines[0]["time"] - 4.0) < 0.05
    assert lines[1]["kind"] == "contact"
    assert lines[2]["n_samples"] == 2001


def test_an_odd_first_step_is_forgotten(watched: WatchedRobot) -> None:
    """The causal filter has the pole of the thresholds' rate, whatever the first step is."""
    log = watched.quiet[0].taken(slice(None, 800, 2))
    thresholds = replace(watched.thresholds, rate=100.0, filtered=True)
    regular, odd = (Observer(watched.result, thresholds=thresholds) for _ in range(2))
    odd.update(float(log.t[0]) - 0.05, log.q[0], log.tau[0])
    for t, q, tau in zip(log.t.tolist(), log.q, log.tau, strict=True):
        regular.update(t, q, tau)
        odd.update(t, q, tau)
    assert np.abs(odd.residual - regular.residual).max() < 1e-3 * np.abs(regular.residual).max()
