"""Ledgers that a stranger wrote, identities and places of any kind, and writers that race."""

from __future__ import annotations

import io
import json
import os
import random
import re
import subprocess
import sys
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest

from asbuilt import (
    FleetOptions,
    Ledger,
    add_logs,
    fleet_drift,
    fleet_identify,
    fleet_overview,
    open_ledger,
)
from asbuilt.apps.fleet import Addition
from asbuilt.apps.fleet.ledger.entry import EntryName, digest_content
from asbuilt.apps.fleet.ledger.store import check_robot_id
from asbuilt.apps.fleet.reduction.log_source import find_identity, make_identity_finder
from asbuilt.errors import AsbuiltError, ResultError, UsageError
from asbuilt.workflow import StudyOptions
from asbuilt.writing import _OWNER
from fleet_logs import MODEL, content_of, write_logs
from studied_cases import first_of

HERE = FleetOptions(workers=0)
Spoil = Callable[[pl.DataFrame], pl.DataFrame]


def add(ledger: Path, logs: list[Path], robot_id: str = "R1", **further: Any) -> Addition:
    return add_logs(ledger, MODEL, logs, robot_id=robot_id, **({"fleet": HERE} | further))


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return write_logs(tmp_path_factory.mktemp("logs"), 2)


@pytest.fixture
def ledger(filled: dict[str, bytes], tmp_path: Path) -> Path:
    for name, content in filled.items():
        path = tmp_path / "ledger" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    return tmp_path / "ledger"


@pytest.fixture(scope="module")
def filled(logs: list[Path], tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    place = tmp_path_factory.mktemp("filled") / "ledger"
    add(place, logs)
    return content_of(place)


def entry(ledger: Path) -> Path:
    return sorted((ledger / "logs" / "R1").glob("*.parquet"))[0]


def with_content(path: Path, content: bytes) -> Path:
    """Replace an entry by one whose name fits its content, as a stranger can write it."""
    name = EntryName.parse("R1", path.name)
    assert name is not None
    path.unlink()
    target = path.with_name(path.name.replace(name.content, digest_content(content)))
    target.write_bytes(content)
    return target


def forged(path: Path, frame: pl.DataFrame) -> Path:
    """Replace an entry by another table."""
    content = io.BytesIO()
    frame.write_parquet(content)
    return with_content(path, content.getvalue())


def column(name: str, change: Callable[[Any], Any]) -> Spoil:
    def spoil(frame: pl.DataFrame) -> pl.DataFrame:
        values = [change(each) for each in frame[name].to_list()]
        return frame.with_columns(pl.Series(name, values, dtype=frame.schema[name]))

    return spoil


SPOILT: dict[str, Spoil] = {
    "a number that is none": column("factor", lambda x: [float("nan"), *x[1:]]),
    "an infinite torque": column("torque_sum", lambda x: float("inf")),
    "another robot": column("robot_id", lambda x: "R2"),
    "a robot that leads elsewhere": column("robot_id", lambda x: "../../etc"),
    "another date": column("date", lambda x: datetime(2020, 1, 1, tzinfo=UTC)),
    "no date": column("date", lambda x: None),
    "another log": column("source_sha256", lambda x: "0" * 64),
    "other settings": column("settings", lambda x: "0" * 12),
    "no samples": column("n_samples", lambda x: 0),
    "a negative duration": column("duration", lambda x: -1.0),
    "a rate of nan": column("rate", lambda x: float("nan")),
    "another joint": column("joint", lambda x: "x"),
    "a covariate of inf": column("covariates", lambda x: [{"name": "t", "value": float("inf")}]),
    "short factors": column("factor", lambda x: x[:-1]),
    "a date of another age": column("date", lambda x: datetime(9999, 12, 31, tzinfo=UTC)),
    "more samples than any log": column("n_samples", lambda x: 2**62),
    "factors whose squares overflow": column("factor", lambda x: [1e200 * each for each in x]),
    "factors without end": column("factor", lambda x: [1e308] * len(x)),
    "factors of nothing": column("factor", lambda x: [0.0] * len(x)),
    "factors of rounding": column("factor", lambda x: [1e-300 * each for each in x]),
    "torques without end": column("torque_sum", lambda x: 1e308),
    "tilts without end": column("tilt", lambda x: x and [1e308] * len(x)),
    "a temperature without end": column("covariates", lambda x: [{"name": "t", "value": 1e308}]),
    "a block that ends before it starts": column("stop", lambda x: -1e9),
    "a duration without end": column("duration", lambda x: 1e308),
    "a rate of nothing": column("rate", lambda x: 1e-300),
    "a name without end": column("log", lambda x: "x" * 200_000),
    "a date from anywhere": column("date_from", lambda x: "hearsay"),
    "texts as numbers": lambda frame: frame.with_columns(pl.col("duration").cast(pl.String)),
    "no column": lambda frame: frame.drop("rate"),
    "no rows": lambda frame: frame.head(0),
    "one row": lambda frame: frame.head(1),
    "rows in another order": lambda frame: frame.reverse(),
    "version 9": lambda frame: frame.with_columns(format_version=pl.lit(9, pl.Int16)),
}


def test_a_date_that_python_has_not_is_named_and_skipped(ledger: Path) -> None:
    path = entry(ledger)
    frame = pl.read_parquet(path)
    date = pl.lit(2**61).cast(pl.Datetime("us", "UTC"))
    target = forged(path, frame.with_columns(date=date))
    found = fleet_drift(ledger).findings
    assert [target.name in each.message for each in found if "damaged" in each.code] == [True]


@pytest.mark.parametrize("what", SPOILT)
def test_an_entry_of_a_stranger_is_named_and_skipped(what: str, ledger: Path) -> None:
    path = entry(ledger)
    frame = SPOILT[what](pl.read_parquet(path))
    target = forged(path, frame)
    study = fleet_identify(ledger, "R1")
    assert len(study.result.sources) == 1
    (said,) = [each for each in study.findings if each.code == "ledger_file_damaged"]
    assert target.name in said.message
    assert len(said.message) < 500


@pytest.mark.parametrize(
    "content", first_of(2, [b"", b"PAR1", b"PAR1" + bytes(100) + b"PAR1", os.urandom(999)])
)
def test_an_entry_that_is_no_table_is_named_and_skipped(content: bytes, ledger: Path) -> None:
    with_content(entry(ledger), content)
    assert [each.code for each in fleet_identify(ledger, "R1").findings].count(
        "ledger_file_damaged"
    ) == 1


@pytest.mark.study
def test_an_entry_that_unpacks_to_gigabytes_costs_little(ledger: Path, tmp_path: Path) -> None:
    """In this process; the other that unpacks it has a limit of its own."""
    resource = pytest.importorskip("resource")
    bomb = tmp_path / "bomb.parquet"
    rows = pl.DataFrame({"factor": [[0.0] * 1_000_000]})
    pl.concat([rows] * 30).write_parquet(bomb, compression="zstd")
    assert bomb.stat().st_size < 2e6
    with_content(entry(ledger), bomb.read_bytes())
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert len(fleet_identify(ledger, "R1").result.sources) == 1
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000


@pytest.mark.parametrize("what", ["entry", "settings", "mark"])
@pytest.mark.parametrize("kind", ["pipe", "zero", "folder", "loop", "large"])
def test_what_is_no_regular_file_is_never_read(what: str, kind: str, ledger: Path) -> None:
    path = {
        "entry": entry(ledger),
        "settings": next((ledger / "types").rglob("*.json")),
        "mark": ledger / "ledger.json",
    }[what]
    path.unlink()
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind == "large":
        with path.open("wb") as file:
            file.truncate(10**11)
    else:
        path.symlink_to("/dev/zero" if kind == "zero" else path.name)
    began = time.process_time()
    if what == "entry":
        assert len(fleet_identify(ledger, "R1").result.sources) == 1
    elif what == "settings":
        codes = [each.code for each in fleet_overview(ledger).findings]
        assert "ledger_file_damaged" in codes
    else:
        with pytest.raises(ResultError, match=r"ledger\.json"):
            fleet_overview(ledger)
    assert time.process_time() - began < 5.0


def changed(document: Any, key: str, value: Any) -> Any:
    where = document
    *path, last = key.split(".")
    for each in path:
        where = where[int(each) if each.isdigit() else each]
    where[int(last) if last.isdigit() else last] = value
    return document


@pytest.mark.parametrize(("key", "value"), [
    ("model.links.0.inertia.9", float("nan")), ("model.links.0.inertia.9", 1e999),
    ("chain.cutoff", float("inf")), ("chain.cutoff", "fast"), ("chain", None), ("drive", [1]),
    ("generation", -1), ("robot_type", "../../x"), ("robot_type", "other"), ("model", 3),
    ("digest", "0" * 12), ("torque_source", "magic"), ("parameters", []), ("chosen", None),
    ("model.joints.0.parent", 10**20), ("asked_chain", []), ("format_version", "1"),
])  # fmt: skip
def test_settings_of_a_stranger_are_named_and_skipped(key: str, value: Any, ledger: Path) -> None:
    path = next((ledger / "types").rglob("*.json"))
    text = json.dumps(changed(json.loads(path.read_text()), key, value))
    path.write_text(text.replace("Infinity", "1e999"))
    found = fleet_overview(ledger)
    assert not found.types
    assert "ledger_file_damaged" in [each.code for each in found.findings]


def test_settings_without_end_are_named_and_skipped(ledger: Path) -> None:
    path = next((ledger / "types").rglob("*.json"))
    path.write_text('{"format": ' + "[" * 100_000)
    (said,) = [each for each in fleet_overview(ledger).findings if "damaged" in each.code]
    assert "nested deeper" in said.message


@pytest.mark.parametrize("robot_id", ["", " ", "\n", "a\0b", "x" * 61, "x" * 10**6, "\x1b[31m",
    "ü" * 60, "\ud800", "a\u202eb"])  # fmt: skip
def test_identities_that_are_refused(robot_id: str, ledger: Path, logs: list[Path]) -> None:
    before = content_of(ledger)
    for attempt in (lambda: add(ledger, logs, robot_id), lambda: fleet_identify(ledger, robot_id)):
        with pytest.raises(UsageError, match="identity") as caught:
            attempt()
        assert len(str(caught.value)) < 500
    assert content_of(ledger) == before


@pytest.mark.parametrize("robot_id", ["..", ".", "/", "../../x", "a/b", "a\\b", "*", "%2E", "ü" * 9,
    "CON", "a b", "-x", "'; rm -rf /", "x" * 60])  # fmt: skip
def test_identities_that_stay_within_the_ledger(
    robot_id: str, ledger: Path, logs: list[Path]
) -> None:
    assert check_robot_id(robot_id) == robot_id
    done = add(ledger, logs[:1], robot_id)
    assert done.added[0].entry is not None
    assert robot_id in open_ledger(str(ledger)).robot_ids()
    assert {path.parent.name for path in ledger.parent.rglob("*.parquet")} >= {"R1"}
    assert sorted(path.name for path in ledger.iterdir()) == ["ledger.json", "logs", "types"]


def test_folders_that_are_no_robots_are_named(ledger: Path) -> None:
    for name in ("%0A", "a%2Fb%2F", "%FF", "x" * 100, "a.b"):
        (ledger / "logs" / name).mkdir()
    found = fleet_overview(ledger)
    assert [row.id for row in found.robots] == ["R1"]
    assert [each.code for each in found.findings].count("ledger_file_foreign") >= 4


@pytest.mark.parametrize("root", ["", "a\0b", "x" * 5000, "x/" * 3000, "file://a\0", "nosuch://x",
    "://", "http:/x", "s3://", "s3:///", "memory://" + "x" * 9, "ftp://", "\ud800", "python://x",
    "reference://x", "zip://x::file:///nowhere.zip", "file:///nowhere/at/all"])  # fmt: skip
def test_places_that_are_no_ledger(root: str) -> None:
    with pytest.raises(AsbuiltError) as caught:
        fleet_overview(root)
    assert len(str(caught.value)) < 1000


@pytest.mark.parametrize("path", ["a" * 1000, "/".join("a" * 500), "a/" * 100 + "b.csv"])
@pytest.mark.parametrize("pattern", ["*a" * 40 + "*{id}" + "*a" * 40 + "!", "*" * 200 + "{id}x",
    "{id}" + "*" * 200 + "!"])  # fmt: skip
def test_no_pattern_takes_long(pattern: str, path: str) -> None:
    began = time.process_time()
    with pytest.raises(UsageError, match="does not match"):
        make_identity_finder(pattern)(Path(path))
    assert time.process_time() - began < 5.0
    with pytest.raises(UsageError, match="at most"):
        make_identity_finder(pattern * 1 + "a" * 300)


def test_identities_are_those_of_a_regular_expression() -> None:
    """The oracle backtracks, which is right and slow."""
    rng = random.Random(4)
    matched = 0
    for _ in range(4000):
        before, after = ("".join(rng.choices("ab*/_", k=rng.randrange(5))) for _ in range(2))
        path = "".join(rng.choices("aab/_", k=rng.randrange(12)))
        text = "[^/]*".join(map(re.escape, before.split("*"))) + "(?P<id>[^/]+?)"
        text += "[^/]*".join(map(re.escape, after.split("*")))
        found = re.search(rf"(?:^|/){text}\Z", path)
        assert find_identity(f"{before}{{id}}{after}", path) == (found and found["id"])
        matched += found is not None
    assert matched > 300


def late(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have the next writer find no settings, as one that looks before another has written."""
    known, seen = Ledger.settings_of, []

    def settings_of(self: Ledger, robot_type: str) -> Any:
        seen.append(robot_type)
        return None if len(seen) == 1 else known(self, robot_type)

    monkeypatch.setattr(Ledger, "settings_of", settings_of)


def test_the_second_of_two_first_writers_is_told_and_changes_nothing(
    logs: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ledger = tmp_path / "ledger"
    add(ledger, logs[:1], options=StudyOptions(drive="viscous"))
    before = content_of(ledger)
    late(monkeypatch)
    with pytest.raises(UsageError, match="the ledger has the drive terms viscous"):
        add(ledger, logs[1:], options=StudyOptions(drive="coulomb"))
    assert content_of(ledger) == before


def test_the_second_of_two_first_writers_without_wishes_takes_the_first_ones_settings(
    logs: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ledger = tmp_path / "ledger"
    add(ledger, logs[:1], options=StudyOptions(drive="viscous"))
    late(monkeypatch)
    done = add(ledger, logs[1:])
    assert not done.fixed
    assert len(fleet_identify(ledger, "R1").result.sources) == 2
    assert "ledger_entries_superseded" not in [each.code for each in done.findings]


@pytest.mark.study
def test_two_commands_that_begin_at_once_leave_one_set_of_settings(
    logs: list[Path], tmp_path: Path
) -> None:
    for turn in range(2):
        ledger = tmp_path / str(turn)
        command = [sys.executable, "-m", "asbuilt", "fleet", "add", str(ledger), "two-link"]
        started = [
            subprocess.Popen(
                [*command, *map(str, logs), "--id", drive, "--drive", drive, "--workers", "0"],
                stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True,
            )
            for drive in ("viscous", "coulomb")
        ]  # fmt: skip
        told = [each.communicate()[1] for each in started]
        assert sorted(each.returncode for each in started) == [0, 2], told
        assert "the ledger has the drive terms" in "".join(told)
        (settings,) = open_ledger(str(ledger)).all_settings().values()
        assert open_ledger(str(ledger)).robot_ids() == [str(settings.drive)]


def test_remains_of_dead_writers_are_swept(ledger: Path, logs: list[Path]) -> None:
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    host = _OWNER.rsplit(".", 1)[0]
    folder = entry(ledger).parent
    remains = [folder / f".x.{host}.{ended.pid}.abc.part", folder / f".x.{_OWNER}.abc.part"]
    for path in remains:
        path.write_text("half")
    entry(ledger).unlink()
    add(ledger, logs)
    assert [path.exists() for path in remains] == [False, True]


@pytest.mark.parametrize("year", [1, 1969, 1999, 2100, 9999])
def test_dates_that_no_log_has(year: int, logs: list[Path], tmp_path: Path) -> None:
    done = add(tmp_path / "ledger", logs[:1], date=datetime(year, 1, 1, tzinfo=UTC))
    assert "not between 2000 and 2100" in str(done.failed[0].problem)


def test_numbers_survive_the_other_process(ledger: Path) -> None:
    """The oracle reads the file itself."""
    opened = open_ledger(str(ledger))
    first = opened.entries("R1")[0]
    frame = pl.read_parquet(entry(ledger)).filter(pl.col("block") == -1)
    for k, row in enumerate(frame.iter_rows(named=True)):
        factor = first.whole.factors[k][0]
        np.testing.assert_array_equal(factor[np.triu_indices(len(factor))], row["factor"])
