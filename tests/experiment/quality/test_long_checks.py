"""Recordings checked chunk by chunk against the same recordings checked as a whole."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from dataclasses import astuple, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from asbuilt.description import RobotModel, bundled_robot
from asbuilt.errors import RecordingError
from asbuilt.experiment import Recording, RecordingStream, check_recording, read_recording
from asbuilt.experiment.logs import long_recordings
from asbuilt.experiment.quality import reductions
from asbuilt.experiment.quality.passes import Plateau, run_first_pass
from asbuilt.experiment.quality.reductions import Clock
from asbuilt.workflow import recorded_information
from command_line import document
from fourier_recording import record

CHUNK_SAMPLES = 700


@pytest.fixture(scope="module")
def iiwa() -> RobotModel:
    return bundled_robot("kuka-iiwa7-r800")


@pytest.fixture(scope="module")
def clean(iiwa: RobotModel) -> Recording:
    return record(iiwa, 3)


def written(recording: Recording, path: Path) -> Path:
    names = recording.joint_names
    assert recording.qd is not None
    columns = {"t": recording.t}
    for what, values in (("q", recording.q), ("qd", recording.qd), ("tau", recording.tau)):
        columns |= {f"{what}_{name}": values[:, k] for k, name in enumerate(names)}
    pl.DataFrame(columns).write_parquet(path)
    return path


def changed(
    recording: Recording, what: str, rows: object, columns: object, value: object
) -> Recording:
    values = np.array(getattr(recording, what))
    values[rows, columns] = value  # type: ignore[index]
    return replace(recording, **{what: values})  # type: ignore[arg-type]


def across(recording: Recording) -> Recording:
    """Lose samples, repeat time stamps and values, all at the borders of chunks."""
    edge, t = 2 * CHUNK_SAMPLES, np.array(recording.t)
    t[edge:] += 0.3
    t[3 * CHUNK_SAMPLES] = t[3 * CHUNK_SAMPLES - 1]
    q, tau = np.array(recording.q), np.array(recording.tau)
    for values in (q, tau):
        values[CHUNK_SAMPLES - 3 : CHUNK_SAMPLES + 4] = values[CHUNK_SAMPLES - 3]
    return replace(recording, t=t, q=q, tau=tau)


def polled(recording: Recording) -> Recording:
    return recording.taken(np.repeat(np.arange(recording.n_samples // 2), 2))  # type: ignore[arg-type]


def doubled(recording: Recording) -> Recording:
    held = polled(recording)
    return replace(held, t=recording.t[: held.n_samples])


def resting(recording: Recording) -> Recording:
    """Rest for two whole chunks, where every joint hardly moves."""
    q, qd = np.array(recording.q), np.array(recording.qd)
    q[CHUNK_SAMPLES : 3 * CHUNK_SAMPLES], qd[CHUNK_SAMPLES : 3 * CHUNK_SAMPLES] = (
        q[CHUNK_SAMPLES],
        0.0,
    )
    return replace(recording, q=q, qd=qd)


SPOILT: dict[str, tuple[Callable[[Recording], Recording], set[str]]] = {
    "as it is": (lambda r: r, set()),
    "flipped": (lambda r: r.flipped(), {"torque_flipped"}),
    "swapped": (lambda r: replace(r, tau=r.tau[:, [0, 3, 2, 1, 4, 5, 6]]), {"joints_swapped"}),
    "across chunks": (across, {"clock_gap", "clock_repeated"}),
    "time runs back": (
        lambda r: replace(
            r, t=np.where(np.arange(r.n_samples) < 2 * CHUNK_SAMPLES, r.t, r.t - 5.0)
        ),
        {"clock_backward"},
    ),
    "samples twice": (doubled, {"stale_samples"}),
    "at rest for a while": (resting, set()),
    "a joint at rest": (
        lambda r: changed(changed(r, "q", slice(None), 4, 0.1), "qd", slice(None), 4, 0.0),
        {"joint_still"},
    ),
    "joints in step": (
        lambda r: replace(
            r, q=np.repeat(r.q[:, :1], 7, axis=1), qd=np.repeat(r.qd[:, :1], 7, axis=1)
        ),
        {"joints_correlated"},
    ),
    "missing": (
        lambda r: changed(r, "tau", [5, CHUNK_SAMPLES, 2 * CHUNK_SAMPLES + 1], 2, np.nan),
        {"not_finite"},
    ),
    "absurd": (
        lambda r: changed(r, "q", [CHUNK_SAMPLES - 1, 3 * CHUNK_SAMPLES], slice(2, 4), 1e20),
        {"not_finite"},
    ),
    "beyond limits": (
        lambda r: changed(r, "q", slice(CHUNK_SAMPLES - 10, CHUNK_SAMPLES + 20), 1, 2.5),
        {"position_limit"},
    ),
    "cut off": (
        lambda r: replace(r, tau=np.clip(r.tau, -np.inf, np.percentile(r.tau, 90, axis=0))),
        {"saturation"},
    ),
    "in coarse steps": (lambda r: replace(r, tau=np.round(20 * r.q) / 20), set()),
    "degrees": (lambda r: replace(r, q=np.rad2deg(r.q), qd=np.rad2deg(r.qd)), {"degrees"}),
    "smooth": (lambda r: replace(r, tau=np.cumsum(np.cumsum(r.q, axis=0), axis=0)), set()),
}


@pytest.mark.parametrize(
    "how",
    [
        pytest.param(name, marks=() if k % 3 == 0 else pytest.mark.study)
        for k, name in enumerate(SPOILT)
    ],
)
def test_findings_are_those_of_the_whole(
    iiwa: RobotModel, clean: Recording, tmp_path: Path, how: str
) -> None:
    spoil, expected = SPOILT[how]
    path = written(spoil(clean), tmp_path / "log.parquet")
    whole = check_recording(iiwa, read_recording(path, model=iiwa))
    long = check_recording(iiwa, RecordingStream(path, iiwa, chunk_samples=CHUNK_SAMPLES))
    assert expected <= set(whole.codes)
    assert long.as_text() == whole.as_text()
    assert long.findings == whole.findings


def test_statistics_do_not_depend_on_where_chunks_end(iiwa: RobotModel, clean: Recording) -> None:
    spoilt = changed(across(clean), "tau", [5, 900, 901], 2, np.nan)
    rng = np.random.default_rng(1)
    one = run_first_pass(iiwa, [spoilt])
    for _ in range(5):
        edges = [
            0,
            *np.unique(
                [CHUNK_SAMPLES, *rng.choice(np.arange(1, clean.n_samples), 9, replace=False)]
            ),
            clean.n_samples,
        ]
        other = run_first_pass(iiwa, [spoilt.taken(slice(a, b)) for a, b in pairwise(edges)])
        for name in ("t", "rows", "valid", "forward", "step", "duration"):
            np.testing.assert_array_equal(getattr(other.clock, name), getattr(one.clock, name))
        for name in ("backward", "repeated"):
            np.testing.assert_array_equal(
                astuple(getattr(other.clock, name)), astuple(getattr(one.clock, name))
            )
        np.testing.assert_array_equal(other.clock.gaps, one.clock.gaps)
        assert astuple(other.repeats) == astuple(one.repeats)
        for name, parts in (
            ("position_range", ("count", "low", "high")),
            ("torque_range", ("count", "low", "high")),
            ("saturated", ("count", "value", "time")),
        ):
            for part in parts:
                np.testing.assert_array_equal(
                    getattr(getattr(other, name), part), getattr(getattr(one, name), part)
                )
        joints = other.moments.moving
        np.testing.assert_allclose(
            other.moments.correlations(joints), np.corrcoef(spoilt.q[:, joints].T), atol=1e-12
        )
        assert [(found.quantity, found.joint, found.rows.tolist()) for found in other.missing] == [
            ("torque", 2, [5, 900, 901])
        ]


def test_gaps_are_told_where_few_times_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(2)
    steps = 1e-3 * rng.uniform(0.9, 1.1, 50_000)
    lost = np.array([137, 20_000, 49_000])
    steps[lost] = [0.1, 0.3, 0.2]
    steps[[30_000, 30_001]] = 0.0
    steps[40_000] = -0.5
    t = np.cumsum(steps)
    monkeypatch.setattr(reductions, "KEPT_SAMPLES", 3000)
    clock = Clock()
    for begin in range(0, t.size, 500):
        clock = clock.with_more(t[begin : begin + 500], np.full(500, True))
    before, gaps = clock.gaps
    assert clock.t.size <= 3500
    np.testing.assert_array_equal(clock.t, t[clock.rows])
    assert clock.rows[0] == 0
    assert clock.rows[-1] == t.size - 1
    np.testing.assert_array_equal(before, t[lost - 1])
    np.testing.assert_allclose(gaps, [0.1, 0.3, 0.2], rtol=1e-9)
    assert (clock.repeated.count, clock.repeated.row) == (2, 29_999)
    assert (clock.backward.count, clock.backward.row) == (1, 39_999)
    assert clock.duration == t.max() - t.min()
    np.testing.assert_allclose(clock.step, np.median(steps), rtol=0.01)


def test_values_near_an_extreme_are_counted_where_few_are_kept() -> None:
    rng = np.random.default_rng(3)
    distinct = rng.uniform(0.95, 1.0, 40_000)
    values = rng.choice(distinct, 400_000)
    plateau = Plateau(1.0, 0.05)
    for begin in range(0, values.size, 4000):
        part = values[begin : begin + 4000]
        plateau = plateau.with_more(part, np.arange(4000.0), begin)
    assert plateau.near.size <= 1000
    assert plateau.n_near == values.size
    np.testing.assert_allclose(plateau.n_values, np.unique(values).size, rtol=0.15)


@pytest.mark.study
def test_long_recordings_are_not_held(
    iiwa: RobotModel, clean: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only flags grow with the length: of 22 columns six more minutes take less than a byte."""
    monkeypatch.setattr(reductions, "KEPT_SAMPLES", 10_000)

    def peak(minutes: int) -> float:
        parts = [replace(clean, t=clean.t + 20.0 * k) for k in range(3 * minutes)]
        path = written(
            replace(
                clean,
                **{
                    name: np.concatenate([getattr(part, name) for part in parts])
                    for name in ("t", "q", "qd", "tau")
                },  # type: ignore[arg-type]
            ),
            tmp_path / f"{minutes}.parquet",
        )
        stream = RecordingStream(path, iiwa, chunk_samples=4000)
        tracemalloc.start()
        check_recording(iiwa, stream)
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return most / (minutes * 12_000)

    peak(4)
    growth = (peak(10) * 10 - peak(4) * 4) / 6
    assert growth < 1.0


@pytest.mark.study
def test_command_checks_long_files_in_chunks(
    iiwa: RobotModel,
    clean: Recording,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = written(clean, tmp_path / "log.parquet")
    whole = document(capsys, "check", "kuka-iiwa7-r800", path)
    monkeypatch.setattr(long_recordings, "LONG", 1e5)
    monkeypatch.setattr(long_recordings, "CHUNK", CHUNK_SAMPLES)
    monkeypatch.setattr("asbuilt.experiment.logs.recordings.read_recording", None)
    long = document(capsys, "check", "kuka-iiwa7-r800", path)
    one, other = whole["recordings"][0], long["recordings"][0]
    assert {key: other[key] for key in other if key != "information"} == {
        key: one[key] for key in one if key != "information"
    }
    np.testing.assert_allclose(
        other["information"]["d_efficiency"], one["information"]["d_efficiency"], rtol=0.1
    )
    assert other["information"]["moved_too_little"] == one["information"]["moved_too_little"]


def test_information_of_a_stream_is_that_of_the_whole(
    iiwa: RobotModel, clean: Recording, tmp_path: Path
) -> None:
    path = written(clean, tmp_path / "log.parquet")
    whole = recorded_information(iiwa, read_recording(path, model=iiwa)).efficiency
    long = recorded_information(
        iiwa, RecordingStream(path, iiwa, chunk_samples=CHUNK_SAMPLES)
    ).efficiency
    np.testing.assert_allclose(long.by_joint, whole.by_joint, rtol=0.1)


def test_streams_of_other_robots_are_refused(clean: Recording, tmp_path: Path) -> None:
    stream = RecordingStream(written(clean, tmp_path / "log.parquet"), chunk_samples=CHUNK_SAMPLES)
    with pytest.raises(RecordingError, match="7 joints"):
        check_recording(bundled_robot("ur10e"), stream)
