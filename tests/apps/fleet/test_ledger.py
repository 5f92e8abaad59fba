"""The ledger: same bytes however it was written, honest about what is damaged or foreign."""

from __future__ import annotations

import os
import random
import resource
import signal
import subprocess
import sys
import time
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from asbuilt import (
    FleetIdentification,
    FleetOptions,
    add_logs,
    fleet_identify,
    fleet_overview,
    open_ledger,
    rebuild_ledger,
)
from asbuilt.apps.fleet import Addition
from asbuilt.apps.fleet.reduction.log_source import make_identity_finder
from asbuilt.errors import IdentifiabilityError, RecordingError, ResultError, UsageError
from asbuilt.experiment import prepare_samples, read_recording
from asbuilt.identification import identify_samples
from asbuilt.workflow import StudyOptions, identify
from asbuilt.writers import write_recording
from fleet_logs import MODEL, content_of, recording, with_clock, write_logs

HERE = FleetOptions(workers=0)


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return write_logs(tmp_path_factory.mktemp("logs") / "R1", 4)


@pytest.fixture(scope="module")
def filled(logs: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    ledger = tmp_path_factory.mktemp("fleet") / "ledger"
    add(ledger, logs)
    return ledger


def add(ledger: Path, logs: list[Path], robot_id: str = "R1", **further: object) -> Addition:
    return add_logs(ledger, MODEL, logs, robot_id=robot_id, **({"fleet": HERE} | further))  # type: ignore[arg-type]


def codes(done: Addition) -> set[str]:
    return {finding.code for finding in done.findings}


@pytest.mark.parametrize("method", [pytest.param("consistent", marks=pytest.mark.study), "wls"])
def test_ledger_identifies_what_the_logs_identify(
    filled: Path, logs: list[Path], method: str
) -> None:
    settings = next(iter(open_ledger(str(filled)).types().values()))
    study = fleet_identify(filled, "R1", options=FleetIdentification(method=method))
    options = StudyOptions(
        effects="none", chain=settings.chain, drive=settings.drive, method=method
    )
    expected = identify(MODEL, logs, options=options).result
    samples = [prepare_samples(read_recording(log, model=MODEL), settings.chain) for log in logs]
    scatter = identify_samples(MODEL, samples, drive=settings.drive, method=method)
    np.testing.assert_allclose(study.result.std_errors, scatter.std_errors, rtol=1e-9)
    for name in ("estimates", "sigma", "singular_values"):
        np.testing.assert_allclose(
            getattr(study.result, name), getattr(expected, name), rtol=1e-9, atol=1e-15
        )
    np.testing.assert_allclose(study.result.train.rms, expected.train.rms, rtol=1e-6)
    assert study.result.n_samples == expected.n_samples


def test_a_window_of_dates_takes_the_logs_in_it(filled: Path, logs: list[Path]) -> None:
    since, until = datetime(2026, 3, 2, tzinfo=UTC), datetime(2026, 3, 4, tzinfo=UTC)
    study = fleet_identify(filled, "R1", since=since, until=until)
    settings = next(iter(open_ledger(str(filled)).types().values()))
    options = StudyOptions(
        effects="none", chain=settings.chain, drive=settings.drive, method="consistent"
    )
    expected = identify(MODEL, logs[1:3], options=options).result
    np.testing.assert_allclose(study.result.estimates, expected.estimates, rtol=1e-9)
    with pytest.raises(IdentifiabilityError, match="no sound log of R1 since 2030"):
        fleet_identify(filled, "R1", since=datetime(2030, 1, 1, tzinfo=UTC))


@pytest.mark.study
def test_the_same_bytes_for_any_number_of_workers_and_any_order(
    filled: Path, logs: list[Path], tmp_path: Path
) -> None:
    shuffled = list(logs)
    random.Random(3).shuffle(shuffled)
    add(tmp_path / "two", shuffled, fleet=FleetOptions(workers=2))
    assert content_of(tmp_path / "two") == content_of(filled)
    for log in (logs[0], *logs[:0:-1]):
        add(tmp_path / "one by one", [log])
    assert content_of(tmp_path / "one by one") == content_of(filled)


@pytest.mark.study
def test_the_same_bytes_after_a_crash(filled: Path, logs: list[Path], tmp_path: Path) -> None:
    """The command is killed as soon as the first entry is there."""
    ledger = tmp_path / "ledger"
    command = [sys.executable, "-m", "asbuilt", "fleet", "add", str(ledger), "two-link"]
    process = subprocess.Popen(
        [*command, *map(str, logs), "--id", "R1", "--workers", "0"], start_new_session=True
    )
    while process.poll() is None and not list(ledger.rglob("*.parquet")):
        time.sleep(0.005)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    done = add(ledger, logs)
    assert len(done.added) + len(done.skipped) == len(logs)
    assert {
        name: content for name, content in content_of(ledger).items() if ".part" not in name
    } == content_of(filled)


def test_logs_in_the_ledger_are_skipped_whatever_their_name(
    filled: Path, logs: list[Path], tmp_path: Path
) -> None:
    copy = tmp_path / "again_2026-03-09.csv"
    copy.write_bytes(logs[0].read_bytes())
    before = content_of(filled)
    done = add(filled, [copy, logs[1]])
    assert (len(done.added), len(done.skipped), len(done.failed)) == (0, 2, 0)
    assert content_of(filled) == before


def test_a_log_that_fails_is_listed_and_the_rest_goes_on(logs: list[Path], tmp_path: Path) -> None:
    broken, undated = tmp_path / "broken_2026-03-01.csv", tmp_path / "run.csv"
    broken.write_text("t,q_1,q_2\n0,1,2\n")
    undated.write_bytes(logs[1].read_bytes())
    absent = tmp_path / "absent.csv"
    done = add(tmp_path / "ledger", [broken, undated, absent, logs[0]])
    assert [Path(each.log) for each in done.added] == [logs[0]]
    why = {Path(each.log).name: str(each.problem) for each in done.failed}
    assert set(why) == {"broken_2026-03-01.csv", "run.csv", "absent.csv"}
    assert "does not exist" in why["absent.csv"]
    assert "has no date" in why["run.csv"]
    again = add(tmp_path / "ledger", [undated], date=datetime(2026, 3, 2, tzinfo=UTC))
    assert again.added[0].entry is not None
    assert again.added[0].entry.date.day == 2


def test_a_date_without_time_zone_is_utc_wherever_the_computer_is(
    filled: Path, logs: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TZ", "Asia/Tokyo")
    time.tzset()
    try:
        undated = tmp_path / "run.csv"
        undated.write_bytes(logs[0].read_bytes())
        noon = datetime(2026, 3, 2, 12)
        done = add(tmp_path / "ledger", [undated], date=noon)
        assert done.added[0].entry is not None
        assert done.added[0].entry.date == noon.replace(tzinfo=UTC)
        entries = open_ledger(filled).entries("R1", datetime(2026, 3, 2), datetime(2026, 3, 4))
        assert [entry.date.day for entry in entries] == [2, 3]
    finally:
        monkeypatch.undo()
        time.tzset()


def test_damaged_and_foreign_files_are_named_and_skipped(logs: list[Path], tmp_path: Path) -> None:
    ledger = tmp_path / "ledger"
    done = add(ledger, logs[:3])
    damaged = ledger / str(done.added[1].entry and done.added[1].entry.path)
    content = bytearray(damaged.read_bytes())
    content[len(content) // 2] ^= 1
    damaged.write_bytes(content)
    (damaged.parent / "notes.txt").write_text("not an entry")
    (damaged.parent / damaged.name.replace("20260302", "20260308")).write_bytes(b"")
    study = fleet_identify(ledger, "R1")
    assert len(study.result.sources) == 2
    said = [each for each in study.findings if each.code.startswith("ledger_file")]
    assert [each.code for each in said].count("ledger_file_damaged") == 2
    assert any("notes.txt" in each.message for each in said)
    assert any(damaged.name in each.message for each in said)
    assert len(add(ledger, [logs[1]]).added) == 1
    assert len(fleet_identify(ledger, "R1").result.sources) == 3


def test_other_folders_and_versions_are_refused(logs: list[Path], tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "a.png").write_bytes(b"")
    with pytest.raises(UsageError, match=r"holds other files \(a.png\)"):
        add(tmp_path / "photos", logs)
    with pytest.raises(UsageError, match="is not a ledger"):
        fleet_identify(tmp_path / "photos", "R1")
    with pytest.raises(UsageError, match="is a file"):
        add(tmp_path / "photos" / "a.png", logs)
    add(tmp_path / "ledger", logs[:1])
    mark = tmp_path / "ledger" / "ledger.json"
    mark.write_text(mark.read_text().replace('"format_version": 1', '"format_version": 9'))
    with pytest.raises(ResultError, match="format version 9, this program reads 1"):
        fleet_overview(tmp_path / "ledger")
    mark.write_text(mark.read_text().replace("asbuilt fleet ledger", "table of another program"))
    with pytest.raises(ResultError, match="of another program, with format 'table of another"):
        fleet_overview(tmp_path / "ledger")


def test_a_log_of_another_robot_is_named(logs: list[Path], tmp_path: Path) -> None:
    other = write_logs(tmp_path / "other", 1, robot=7, first=9)
    assert "log_of_another_robot" not in codes(add(tmp_path / "ledger", logs))
    done = add(tmp_path / "ledger", other)
    said = [each for each in done.findings if each.code == "log_of_another_robot"]
    assert len(said) == 1
    assert "run_2026-03-09.csv" in said[0].message


def test_short_logs_of_one_robot_are_not_those_of_two(tmp_path: Path) -> None:
    """Of 6 s each, the models differ by what the short logs leave open."""
    logs = [tmp_path / f"run_2026-03-{day:02d}.csv" for day in (19, 20)]
    for seed, path in zip((21, 26), logs, strict=True):
        write_recording(path, recording(seed, robot=7, seconds=6.0))
    assert "log_of_another_robot" not in codes(add(tmp_path / "ledger", logs))
    stranger = tmp_path / "run_2026-03-23.csv"
    write_recording(stranger, recording(23, robot=2, seconds=6.0))
    assert "log_of_another_robot" in codes(add(tmp_path / "ledger", [stranger]))


def test_two_types_under_one_identity_are_refused(logs: list[Path], tmp_path: Path) -> None:
    ledger = tmp_path / "ledger"
    add(ledger, logs[:1])
    heavier = MODEL.with_gravity(np.array([0.0, 0.0, -9.0]))
    before = content_of(ledger)
    with pytest.raises(RecordingError, match="in the ledger, not a"):
        add_logs(ledger, heavier, logs[1:2], robot_id="R1", fleet=HERE)
    assert content_of(ledger) == before
    add_logs(ledger, heavier, logs[2:3], robot_id="R2", fleet=HERE)
    done = add_logs(ledger, heavier, logs[1:2], robot_id="R1", fleet=HERE)
    assert "in the ledger, not a" in str(done.failed[0].problem)
    assert len(fleet_overview(ledger).robots) == 2


def test_clocks_that_run_back_are_named(logs: list[Path], tmp_path: Path) -> None:
    noon = datetime(2026, 5, 1, 12, tzinfo=UTC).timestamp()
    first = with_clock(logs[0], tmp_path / "a.csv", noon)
    second = with_clock(logs[1], tmp_path / "b.csv", noon + 5.0)
    powered_up = with_clock(logs[2], tmp_path / "c.csv", 2.0e6)
    done = add(tmp_path / "ledger", [first, second, powered_up])
    assert len(done.added) == 2
    assert "reads 2e+06 s, which is no date after 2000" in str(done.failed[0].problem)
    assert "logs_overlap" in codes(done)
    dates = [each.entry.date for each in done.added if each.entry]
    assert dates == [datetime.fromtimestamp(noon + shift, UTC) for shift in (0.0, 5.0)]


@pytest.mark.study
def test_rebuilding_chooses_again_and_keeps_robots_and_dates(
    logs: list[Path], tmp_path: Path
) -> None:
    ledger = tmp_path / "ledger"
    add(ledger, logs[:3], date=datetime(2026, 6, 1, tzinfo=UTC))
    before = next(iter(open_ledger(str(ledger)).types().values()))
    done = rebuild_ledger(ledger, logs, options=StudyOptions(drive="viscous,coulomb"), fleet=HERE)
    assert (len(done.added), len(done.failed)) == (3, 1)
    assert "is not in the ledger" in str(done.failed[0].problem)
    after = next(iter(open_ledger(str(ledger)).types().values()))
    assert (after.generation, str(after.drive)) == (before.generation + 1, "viscous,coulomb")
    row = fleet_overview(ledger).robots[0]
    assert (row.id, row.n_logs, row.first[:10]) == ("R1", 3, "2026-06-01")
    assert fleet_identify(ledger, "R1").result.base.drive.keys == ("viscous", "coulomb")
    with pytest.raises(UsageError, match="drive terms viscous,coulomb"):
        add(ledger, logs, options=StudyOptions(drive="viscous"))


def test_a_full_disk_is_named_and_harmless(logs: list[Path], tmp_path: Path) -> None:
    """Files of this process may have 9000 bytes for a while; an entry needs more."""
    ledger = tmp_path / "ledger"
    add(ledger, logs[:1])
    before = content_of(ledger)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (9000, limits[1]))
    try:
        done = add(ledger, [logs[1]])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, ignored)
    assert "File too large" in str(done.failed[0].problem)
    assert content_of(ledger) == before


def test_entries_are_documented_tables(filled: Path) -> None:
    frame = pl.read_parquet(filled / "logs" / "R1" / "*.parquet")
    page = Path(__file__).parents[3] / "docs" / "reference" / "fleet-ledger.md"
    assert all(f"| `{name}` |" in page.read_text() for name in frame.columns)
    whole = frame.filter(pl.col("block") == -1)
    parts = frame.filter(pl.col("block") >= 0)
    assert whole["n_samples"].sum() == parts["n_samples"].sum()
    for row in whole.iter_rows(named=True):
        q = len(row["columns"]) + 1
        factor = np.zeros((q, q))
        factor[np.triu_indices(q)] = row["factor"]
        energy = np.zeros((q, q))
        for part in parts.filter(
            (pl.col("source_sha256") == row["source_sha256"]) & (pl.col("joint") == row["joint"])
        ).iter_rows(named=True):
            piece = np.zeros((q, q))
            piece[np.triu_indices(q)] = part["factor"]
            energy += piece.T @ piece
        np.testing.assert_allclose(factor.T @ factor, energy, atol=1e-9 * energy.max())


def test_temperatures_are_kept_beside_the_information(logs: list[Path], tmp_path: Path) -> None:
    log, sheet = tmp_path / "warm_2026-03-01.csv", tmp_path / "warm_2026-03-01.csv.toml"
    lines = logs[0].read_text().splitlines()
    warm = [f"{line},{30 + k / len(lines)}" for k, line in enumerate(lines[1:])]
    log.write_text("\n".join([lines[0] + ",motor_temp", *warm]) + "\n")
    sheet.write_text('date = 2025-12-24\n[columns.extra]\ntemperature = ["motor_temp"]\n')
    add(tmp_path / "ledger", [log])
    entry = open_ledger(str(tmp_path / "ledger")).entries("R1")[0]
    assert (entry.date_from, entry.date.year) == ("sheet", 2025)
    values = entry.covariates["temperature"]
    assert values.shape == (entry.information.n_blocks, 2)
    assert np.all(np.diff(values[:, 0]) > 0)
    assert 30.0 < values.min() < values.max() < 31.0


def test_identities_from_paths() -> None:
    assert make_identity_finder("*_{id}.parquet")(Path("logs/run_arm7.parquet")) == "arm7"
    with pytest.raises(UsageError, match="must have one"):
        make_identity_finder("*.csv")
    with pytest.raises(UsageError, match="does not match"):
        make_identity_finder("{id}/*.parquet")(Path("a.csv"))


@pytest.mark.study
@pytest.mark.parametrize("workers", [0, 2])
def test_one_recording_under_two_dates_is_one_entry(
    workers: int, logs: list[Path], tmp_path: Path
) -> None:
    folder = tmp_path / "R1"
    folder.mkdir()
    names = ["2026-03-01.csv", "2026-03-02.csv", "2026-03-03.csv"]
    copies = [folder / f"arm_{name}" for name in names]
    for copy in copies:
        copy.write_bytes(logs[0].read_bytes())
    done = add(tmp_path / "ledger", copies[::-1], fleet=FleetOptions(workers=workers))
    assert [report.log for report in done.added] == [str(copies[0])]
    assert [report.log for report in done.skipped] == [str(copy) for copy in copies[1:]]
    (name,) = open_ledger(str(tmp_path / "ledger")).names("R1")
    assert {report.entry for report in done.skipped} == {name}
