"""`--mcap` and `--rrd` of the commands that predict a recording."""

from __future__ import annotations

from pathlib import Path

import pytest

from command_line import call, document

pytestmark = pytest.mark.study


def test_identify_validate_and_watch_write_timelines(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    reader = pytest.importorskip("mcap.reader")
    chunk = pytest.importorskip("rerun.chunk")
    pytest.importorskip("rosbags")
    log, other, out = tmp_path / "log.csv", tmp_path / "other.csv", tmp_path / "study"
    for seed, path in enumerate((log, other)):
        document(capsys, "simulate", "two-link", "--engine", "inverse-dynamics", "--duration", 12,
                 "--seed", seed, "--robot-seed", 0, "-o", path)  # fmt: skip
    result = out / "result.json"
    for command in (
        ("identify", "two-link", log, "-o", out),
        ("validate", result, other),
        ("watch", result, other),
    ):
        mcap, rrd = tmp_path / f"{command[0]}.mcap", tmp_path / f"{command[0]}.rrd"
        files = document(capsys, *command, "--mcap", mcap, "--rrd", rrd)["files"]
        assert (files["mcap"], files["rrd"]) == (str(mcap), str(rrd))
        with mcap.open("rb") as stream:
            topics = {
                each.topic for each in reader.make_reader(stream).get_summary().channels.values()
            }
        assert {"/measured", "/position"} < topics
        assert ("/external" in topics) is (command[0] == "watch")
        places = {chunk.entity_path for chunk in chunk.RrdReader(rrd).stream()}
        assert "/torque/joint_1/measured" in places
    status, _, said = call(capsys, "validate", "two-link", other, "--mcap", tmp_path / "no.mcap")
    assert status == 2
    assert "timelines show the predictions of a result" in " ".join(said.split())
