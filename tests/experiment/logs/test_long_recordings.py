"""Recordings read in stretches against the same read whole."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from asbuilt.description import load_robot
from asbuilt.errors import RecordingError
from asbuilt.excitation import random_fourier
from asbuilt.experiment import (
    Recording,
    RecordingStream,
    SignalChain,
    as_recordings,
    hold_out,
    is_long,
    prepare_samples,
    read_recording,
    resolve_chain,
    simulate_recording,
)
from asbuilt.experiment.logs import long_recordings
from asbuilt.experiment.logs.formats import delimited
from asbuilt.experiment.logs.long_recordings import stream_recording


@pytest.fixture(scope="module")
def model():
    return load_robot("kuka-iiwa7-r800")


@pytest.fixture(scope="module", params=["parquet", "csv"])
def log(request, model, tmp_path_factory):
    recording = simulate_recording(model, random_fourier(model, rng=1, duration=60.0), rate=200.0)
    columns = (
        {"t": recording.t}
        | {f"q_{k}": recording.q[:, k] for k in range(7)}
        | {f"tau_{k}": recording.tau[:, k] for k in range(7)}
    )
    path = tmp_path_factory.mktemp("logs") / f"run.{request.param}"
    frame = pl.DataFrame(columns)
    frame.write_parquet(path) if request.param == "parquet" else frame.write_csv(path)
    return path


def test_what_the_filters_leave_is_that_of_the_whole(model, log):
    whole = read_recording(log, model=model)
    chain = resolve_chain(SignalChain(cutoff=5.0), whole)
    samples = prepare_samples(whole, chain)
    stream = replace(RecordingStream(log, model), chunk_samples=2500)
    pieces = stream.prepared(chain)
    np.testing.assert_allclose(pieces.filtered_times, samples.filtered_times, atol=1e-9)
    for name in ("tau", "q", "qd", "qdd"):
        np.testing.assert_allclose(
            pieces.filtered(getattr(pieces, name)),
            samples.filtered(getattr(samples, name)),
            atol=1e-8,
        )
    assert pieces.rate == samples.rate
    assert pieces.origin == samples.origin
    for (_, ours), (_, theirs) in zip(
        [hold_out(pieces, "blocks:5s:3")], [hold_out(samples, "blocks:5s:3")], strict=True
    ):
        assert np.all(np.isin(np.round(ours.filtered_times, 6), np.round(theirs.filtered_times, 6)))


def test_the_beginning_is_the_head_and_it_can_be_gone_through_again(model, log):
    stream = replace(RecordingStream(log, model), chunk_samples=5000)
    assert stream.head.n_samples == 12_001
    assert [sum(part.n_samples for part in stream) for _ in range(2)] == [12_001, 12_001]
    assert stream.source == str(log)


def test_only_long_files_are_streamed(model, log, monkeypatch):
    assert isinstance(as_recordings(model, [log])[0], Recording)
    assert not is_long(log)
    monkeypatch.setattr(long_recordings, "LONG", 1e5)
    opened = as_recordings(model, [log])[0]
    assert isinstance(opened, RecordingStream)
    assert opened.model is model
    assert not is_long(log.parent)
    assert not is_long(log.with_suffix(".npz"))


def test_file_without_samples_is_refused(model, tmp_path):
    path = tmp_path / "empty.parquet"
    pl.DataFrame(
        {"t": pl.Series([], dtype=pl.Float64)}
        | {f"{x}_{k}": pl.Series([], dtype=pl.Float64) for x in ("q", "tau") for k in range(7)}
    ).write_parquet(path)
    with pytest.raises(RecordingError, match="no samples"):
        _ = RecordingStream(path, model).head


def test_text_that_is_read_in_parts_is_the_whole_text(tmp_path, monkeypatch) -> None:
    """Comments, blank lines and rows that lack cells, at the beginning of parts too."""
    rows = [f"{0.01 * k:.2f},{np.sin(k):.6f},{np.cos(k):.6f}" for k in range(900)]
    rows[100:100] = ["# a comment, with a comma"] * 40 + [""] * 3
    rows[500] = rows[500].rpartition(",")[0]
    log = tmp_path / "log.csv"
    log.write_text("\n".join(["t,q_1,tau_1", *rows, "9.00,1"]))
    for at_once in (64, 700, 1 << 20):
        monkeypatch.setattr(delimited, "AT_ONCE", at_once)
        dialect = delimited.find_dialect(log)
        whole = delimited.read_delimited(log, dialect).columns
        chunks = list(delimited._read_chunks(log, dialect, dialect.names, 128))
        assert [first for first, _ in chunks] == list(range(0, 900, 128))
        for name, values in whole.items():
            parts = np.concatenate([chunk[name] for _, chunk in chunks])
            np.testing.assert_array_equal(parts, values)


def test_windows_of_chunks_count_from_the_first_sample_of_a_corrected_clock(tmp_path) -> None:
    t = np.arange(5.0, 9.0, 0.01)
    log = tmp_path / "log.csv"
    pl.DataFrame({"t": t, "q_1": np.sin(t), "tau_1": np.cos(t)}).write_csv(log)
    sheet = {"time_factor": 2.0, "windows": [{"start": 0.99, "stop": 3.01}]}
    whole = read_recording(log, sheet=sheet)
    chunks = list(stream_recording(log, sheet=sheet, chunk_samples=64))
    np.testing.assert_array_equal(np.concatenate([chunk.t for chunk in chunks]), whole.t)
    assert whole.t[0] == pytest.approx(11.0)


@pytest.mark.parametrize("read", [read_recording, lambda log: list(stream_recording(log))])
def test_files_that_a_sheet_lists_take_the_place_of_the_log(tmp_path, read):
    rows = "\n".join(f"{0.01 * k},{0.1 * k},{k}" for k in range(50))
    (tmp_path / "log.csv").write_text(f"t,q_1,tau_1\n{rows}\n")
    (tmp_path / "other.csv").write_text("t,tau_1\n0.0,1.0\n0.1,2.0\n")
    (tmp_path / "log.toml").write_text('[files]\ntorque = "other.csv"\n')
    with pytest.raises(RecordingError, match="no columns for joint positions"):
        read(tmp_path / "log.csv")


@pytest.mark.parametrize(
    "text",
    [
        "t,q_1,tau_1\n0,1.1,2\n0.1,0.30000000000000004,-3e-7\n",
        "t;q_1;tau_1\n0;nan;2\n\n0.1;1;inf\n",
        "t\tq_1\ttau_1\n0\t1\t\n0.1\t2\t3\n",
        "t,q_1,tau_1\n0,1,2\n# a comment\n0.1,2,3\n",
    ],
)
def test_small_table_of_numbers_is_what_polars_reads(tmp_path, monkeypatch, text):
    path = tmp_path / "log.csv"
    path.write_text(text)
    found = delimited.read_delimited(path).columns
    monkeypatch.setattr(delimited, "SMALL", 0)
    expected = delimited.read_delimited(path).columns
    assert list(found) == list(expected)
    for name, values in expected.items():
        np.testing.assert_array_equal(found[name], values)


@pytest.mark.parametrize("separator", [",", ";", " "])
def test_a_mark_of_the_byte_order_is_no_part_of_a_number(tmp_path, separator):
    rows = [[f"{x:.2f}" for x in (0.01 * k, 0.1 * k, k)] for k in range(50)]
    text = "\n".join(separator.join(row) for row in rows)
    (tmp_path / "log.txt").write_text(text, encoding="utf-8-sig")
    sheet = {"columns": {"time": 1, "position": [2], "torque": [3]}}
    (chunk,) = stream_recording(tmp_path / "log.txt", sheet=sheet)
    for recording in (chunk, read_recording(tmp_path / "log.txt", sheet=sheet)):
        np.testing.assert_allclose(recording.q[:, 0], 0.1 * np.arange(50))
        assert recording.n_samples == 50


def test_counters_go_on_to_the_last_row_of_a_stream(tmp_path):
    q = 0.05 * np.arange(301)
    frame = {"t": 0.01 * np.arange(301), "q_1": q % (2.0 * np.pi), "tau_1": np.cos(q)}
    pl.DataFrame(frame).write_csv(tmp_path / "log.csv")
    chunks = list(stream_recording(tmp_path / "log.csv", chunk_samples=150))
    assert [chunk.n_samples for chunk in chunks] == [150, 150, 1]
    whole = np.concatenate([chunk.q[:, 0] for chunk in chunks])
    np.testing.assert_allclose(np.diff(whole), 0.05, atol=1e-12)


def test_rows_in_the_second_in_which_a_chunk_ends_are_kept(tmp_path):
    nanoseconds = 1_000_003_000_000 + 10_000_000 * np.arange(400)
    order = np.arange(400)
    order[10::50], order[11::50] = order[11::50], order[10::50].copy()
    q = np.sin(0.05 * np.arange(400))
    columns = {
        "stamp.sec": nanoseconds // 10**9,
        "stamp.nanosec": nanoseconds % 10**9,
        "q_1": q,
        "tau_1": np.cos(0.05 * np.arange(400)),
    }
    pl.DataFrame(columns)[order].write_csv(tmp_path / "log.csv")
    chunks = list(stream_recording(tmp_path / "log.csv", chunk_samples=150))
    np.testing.assert_array_equal(np.concatenate([chunk.q[:, 0] for chunk in chunks]), q)


def test_a_stream_takes_the_channel_of_torques_that_follows_gravity(tmp_path):
    robot = load_robot("two-link")
    recording = simulate_recording(robot, random_fourier(robot, rng=1, duration=10.0), rate=100.0)
    noise = np.random.default_rng(0).normal(size=recording.tau.shape)
    columns = {
        "t": recording.t,
        **{f"q_{k + 1}": recording.q[:, k] for k in range(2)},
        **{f"alpha_torque_{k + 1}": noise[:, k] for k in range(2)},
        **{f"beta_torque_{k + 1}": recording.tau[:, k] for k in range(2)},
    }
    pl.DataFrame(columns).write_csv(tmp_path / "log.csv")
    chunks = stream_recording(tmp_path / "log.csv", model=robot, chunk_samples=300)
    tau = np.concatenate([chunk.tau for chunk in chunks])
    np.testing.assert_allclose(tau, recording.tau, atol=1e-12)


@pytest.mark.parametrize("began", [0.0, 1.7e9])
@pytest.mark.parametrize("chunk_samples", [398, 399])
def test_rounded_stamps_go_on_to_the_last_row_of_a_stream(tmp_path, began, chunk_samples):
    t = 0.01 * np.arange(800)
    stamps = began + np.floor(20.0 * t + 1e-9) / 20.0
    columns = {"t": stamps, "q_1": np.sin(t), "tau_1": np.cos(t)}
    pl.DataFrame(columns).write_csv(tmp_path / "log.csv")
    chunks = list(stream_recording(tmp_path / "log.csv", chunk_samples=chunk_samples))
    assert [chunk.n_samples for chunk in chunks][2:] == [800 - 2 * chunk_samples]
    times = np.concatenate([chunk.t for chunk in chunks])
    np.testing.assert_allclose(np.diff(times), 0.01, atol=1e-6)
