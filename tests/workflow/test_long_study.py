"""A study of a recording that is read in stretches against the same study of the whole."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from asbuilt.description import LinkInertia, load_robot
from asbuilt.dynamics import DriveSet
from asbuilt.excitation import random_fourier
from asbuilt.experiment import (
    RecordingStream,
    SignalChain,
    VirtualRobot,
    read_recording,
    resolve_chain,
)
from asbuilt.experiment.logs import long_recordings
from asbuilt.workflow import StudyOptions, identify
from command_line import document


@pytest.fixture(scope="module")
def model():
    return load_robot("scara")


def logged(robot, path):
    recording = robot.record(
        random_fourier(robot.model, rng=1, duration=30.0), rate=250.0, rng=2
    ).recording
    columns = (
        {"t": recording.t}
        | {f"q_{k}": recording.q[:, k] for k in range(recording.q.shape[1])}
        | {f"tau_{k}": recording.tau[:, k] for k in range(recording.q.shape[1])}
    )
    pl.DataFrame(columns).write_parquet(path)
    return path


@pytest.fixture(scope="module")
def log(model, tmp_path_factory):
    return logged(
        VirtualRobot.typical(model, rng=1), tmp_path_factory.mktemp("logs") / "run.parquet"
    )


@pytest.mark.study
def test_study_of_a_stream_is_that_of_the_whole(model, log):
    whole = read_recording(log, model=model)
    chain = resolve_chain(SignalChain(), whole)
    options = StudyOptions(
        chain=chain,
        drive=DriveSet.parse("viscous,coulomb,offset"),
        holdout="last:0.3",
        method="consistent",
        effects="none",
    )
    one = identify(model, [whole], options=options)
    other = identify(model, [RecordingStream(log, model, chunk_samples=4000)], options=options)
    size = np.abs(one.result.estimates).max()
    np.testing.assert_allclose(other.result.estimates, one.result.estimates, atol=0.02 * size)
    np.testing.assert_allclose(
        other.validations[0].metrics_as_built.rms,
        one.validations[0].metrics_as_built.rms,
        rtol=0.02,
    )
    np.testing.assert_allclose(other.result.n_samples, one.result.n_samples, rtol=0.02)
    stream = RecordingStream(log, model, chunk_samples=4000)
    tilts = [
        next(each.estimate for each in study.effects if each.effect == "tilt")
        for study in (identify(model, [whole]), identify(model, [stream]))
    ]
    assert tilts[1] == pytest.approx(tilts[0], rel=0.02)


@pytest.mark.study
def test_command_line_streams_long_files(model, log, monkeypatch, capsys):
    monkeypatch.setattr(long_recordings, "LONG", 1e5)
    answer = document(capsys, "identify", "scara", log, "--holdout", "blocks:5s:3")
    assert any("read in chunks" in line for line in answer["provenance"])
    assert answer["validation"][0]["relative_error"] < 0.1


@pytest.mark.study
def test_long_files_are_judged_and_weighed_as_whole_ones(model, log, monkeypatch, capsys, tmp_path):
    """The same verdict within what choosing the filters by the beginning alone makes.

    Nothing is read as a whole.
    """
    result = document(capsys, "identify", "scara", log, "--out", tmp_path)["files"]["result"]
    tool = LinkInertia.from_com(1.5, [0.0, 0.02, 0.08], np.diag([0.01, 0.01, 0.005]))
    loaded = logged(VirtualRobot.typical(model, rng=1).with_tool(tool), tmp_path / "loaded.parquet")
    commands = (
        ("validate", result, log),
        ("validate", "scara", log),
        ("payload", result, loaded),
    )
    whole = [document(capsys, *command) for command in commands]
    monkeypatch.setattr(long_recordings, "LONG", 1e5)
    monkeypatch.setattr("asbuilt.experiment.logs.recordings.read_recording", None)
    long = [document(capsys, *command) for command in commands]
    for one, other in zip(whole, long, strict=True):
        for ours, theirs in zip(one["validation"], other["validation"], strict=True):
            np.testing.assert_allclose(theirs["rms"], ours["rms"], rtol=0.02)
    masses = [answer["mass"]["estimate"] for answer in (whole[2], long[2])]
    np.testing.assert_allclose(masses, 1.5, atol=0.05)
    np.testing.assert_allclose(masses[1], masses[0], atol=0.01)
