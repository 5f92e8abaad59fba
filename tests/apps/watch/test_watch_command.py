"""`asbuilt watch` from the command line."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from watched_robot import WatchedRobot

from asbuilt import UsageError, WatchOptions, watch
from asbuilt.writers import write_recording, write_result
from command_line import call, document


@pytest.fixture(scope="module")
def folder(watched: WatchedRobot, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A result, quiet logs, and a log with a push."""
    folder = tmp_path_factory.mktemp("watch")
    write_result(folder / "result.json", watched.result)
    for k, log in enumerate(watched.quiet):
        write_recording(folder / f"quiet{k}.csv", log)
    external = np.zeros(watched.record(24, 10.0).q.shape)
    external[800:900, 1] = 60.0
    pushed = watched.record(24, 10.0, external)
    write_recording(folder / "pushed.csv", pushed)
    write_recording(folder / "bare.csv", replace(pushed, qd=None))
    return folder


def test_a_push_is_reported_and_thresholds_are_kept(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    quiet = [x for k in range(4) for x in ("--calibrate", folder / f"quiet{k}.csv")]
    out = folder / "events"
    told = document(
        capsys, "watch", folder / "result.json", folder / "pushed.csv", *quiet, "-o", out,
        "--unchecked",
    )  # fmt: skip
    (event,) = told["events"]
    assert event["kind"] == "contact"
    assert abs(event["start"] - 4.0) < 0.05
    assert told["rate_verified"] is False
    assert json.loads((out / "events.json").read_text())["events"] == told["events"]
    page = (out / "watch.html").read_text()
    assert "events-table" in page
    assert "http://" not in page.replace("http://www.w3.org", "")
    assert (out / "watch.png").stat().st_size > 10_000
    status, text, err = call(
        capsys, "watch", folder / "result.json", folder / "pushed.csv", "--unchecked",
        "--thresholds", out / "thresholds.json",
    )  # fmt: skip
    assert status == 0, err
    assert "Events: 1 contact." in text
    assert max(len(line) for line in text.splitlines()) <= 80
    status, _, err = call(
        capsys, "watch", folder / "result.json", folder / "bare.csv", "--unchecked",
        "--thresholds", out / "thresholds.json",
    )  # fmt: skip
    assert status == 1
    assert "has no velocities" in err


def test_a_log_without_velocities_is_filtered(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    told = document(
        capsys, "watch", folder / "result.json", folder / "bare.csv", "--unchecked",
        "--calibrate", folder / "quiet0.csv", "--calibrate", folder / "quiet1.csv",
    )  # fmt: skip
    assert "velocities_filtered" in {each["code"] for each in told["warnings"]}
    assert any(abs(event["start"] - 4.0) < 0.1 for event in told["events"])


def test_what_is_wrong_is_said_without_a_traceback(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    result, log = folder / "result.json", folder / "pushed.csv"
    spoilt = tmp_path / "thresholds.json"
    spoilt.write_text('{"format": "asbuilt thresholds", "joint_names": 3}')
    foreign = tmp_path / "foreign.json"
    foreign.write_text("[]")
    cases = (
        (("--thresholds", spoilt), 1, "damaged"),
        (("--thresholds", foreign), 1, "holds no thresholds"),
        (("--thresholds", spoilt, "--calibrate", folder / "quiet0.csv"), 2, "exclude each other"),
        (("--calibrate", log), 2, "given twice"),
        (("--false-alarms-per-hour", "-1", "--unchecked"), 2, "must be a number from"),
        (("--frame", "nowhere", "--unchecked"), 1, "nowhere"),
    )
    for arguments, status, words in cases:
        found, _, err = call(capsys, "watch", result, log, *arguments)
        assert words in err, (arguments, err)
        assert "Traceback" not in err
        assert found in (status, 1, 2)


def test_thresholds_are_for_what_they_were_set_for(watched: WatchedRobot) -> None:
    log = watched.record(24, 10.0)
    for options, said in (
        (WatchOptions(bandwidth=4.0, checked=False), r"bandwidth \[Hz\] 8, not 4"),
        (WatchOptions(false_alarms_per_hour=0.1, checked=False), r"rate \[1/h\] 1, not 0.1"),
    ):
        with pytest.raises(UsageError, match=said):
            watch(watched.result, log, thresholds=watched.thresholds, options=options)
