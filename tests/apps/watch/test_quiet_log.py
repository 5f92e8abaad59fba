"""A log that says nothing beyond the bounds of its known errors is watched all the same."""

from __future__ import annotations

import json
from pathlib import Path

import polars as pl
import pytest

from command_line import call, document


@pytest.mark.study
def test_a_log_without_noise_sets_thresholds_and_shows_a_push(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    for seed, name in ((3, "train"), (4, "quiet")):
        given = ("simulate", "two-link", "--preset", "ideal", "--duration", 12, "--rate", 100)
        status, _, err = call(capsys, *given, "--seed", seed, "--out", tmp_path / f"{name}.csv")
        assert status == 0, err
    study = tmp_path / "study"
    assert call(capsys, "identify", "two-link", tmp_path / "train.csv", "-o", study)[0] == 0
    watched = document(capsys, "watch", study / "result.json", tmp_path / "quiet.csv")
    assert watched["events"] == []
    log = pl.read_csv(tmp_path / "quiet.csv")
    push = pl.Series([3.0 * (400 <= k < 440) for k in range(log.height)])
    log.with_columns(pl.col("tau_joint_1") + push).write_csv(tmp_path / "pushed.csv")
    sheet = tmp_path / "quiet.csv.toml"
    if sheet.exists():
        (tmp_path / "pushed.csv.toml").write_text(sheet.read_text())
    (event,) = document(capsys, "watch", study / "result.json", tmp_path / "pushed.csv")["events"]
    assert "joint_1" in json.dumps(event)
