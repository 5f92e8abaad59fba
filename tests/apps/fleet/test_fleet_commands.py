"""The commands of fleets: their documents, texts and exit statuses."""

from __future__ import annotations

from pathlib import Path

import pytest

from command_line import call, document
from fleet_logs import write_logs

HERE = ("--workers", "0")


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("logs")
    return [path for k in (1, 2) for path in write_logs(folder / f"R{k}", 2, robot=k)]


@pytest.mark.study
def test_a_ledger_from_the_command_line(
    capsys: pytest.CaptureFixture[str], logs: list[Path], tmp_path: Path
) -> None:
    ledger, place = tmp_path / "ledger", ("two-link", *logs, "--id-from", "{id}/*.csv", *HERE)
    done = document(capsys, "fleet", "add", ledger, *place)
    assert (len(done["added"]), done["skipped"], done["failed"]) == (4, [], [])
    assert {entry["id"] for entry in done["entries"]} == {"R1", "R2"}
    assert "ledger_settings_fixed" in {finding["code"] for finding in done["findings"]}
    status, out, _ = call(capsys, "fleet", "add", ledger, *place)
    assert status == 0
    assert "0 logs added, 4 skipped" in out
    shown = document(capsys, "fleet", "show", ledger, "--thorough")
    assert [(each["id"], each["n_logs"]) for each in shown["robots"]] == [("R1", 2), ("R2", 2)]
    status, out, _ = call(capsys, "fleet", "show", ledger)
    assert status == 0
    assert max(map(len, out.splitlines()[1:])) <= 80
    found = document(capsys, "fleet", "identify", ledger, "--id", "R2", "--out", tmp_path / "out")
    assert (found["method"], found["id"], found["rank"]) == ("consistent", "R2", found["n_base"])
    assert found["train"]["max_abs"] == [None, None]
    status, out, _ = call(capsys, "validate", tmp_path / "out" / "result.json", logs[3])
    assert status == 0
    again = document(capsys, "fleet", "rebuild", ledger, *logs, *HERE)
    assert len(again["added"]) == 4


def test_what_is_refused(
    capsys: pytest.CaptureFixture[str], logs: list[Path], tmp_path: Path
) -> None:
    ledger = tmp_path / "ledger"
    status, _, err = call(capsys, "fleet", "add", ledger, "two-link", logs[0])
    assert status == 2
    assert "--id ID or by --id-from PATTERN" in err
    broken = tmp_path / "2026-03-01.csv"
    broken.write_text("a,b\n1,2\n")
    status, out, err = call(
        capsys, "fleet", "add", ledger, "two-link", broken, logs[0], "--id=R1", *HERE
    )
    assert status == 1
    assert "1 log added" in out
    assert "FAILED" in out
    status, _, err = call(capsys, "fleet", "identify", ledger, "--id", "R9")
    assert status == 2
    assert "has no robot 'R9'; it has R1" in err
    status, _, err = call(capsys, "fleet", "identify", ledger, "--id=R1", "--method=huber")
    assert status == 2
    assert "huber needs samples" in err
    assert call(capsys, "fleet", "show", tmp_path)[0] == 2
    status, _, err = call(capsys, "fleet", "identify", ledger, "--id=R1", "--since=yesterday")
    assert status == 2
    assert "'yesterday' is not a date" in err
