"""Drift of virtual fleets: which robots changed, what and how large; its page and command."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from asbuilt import (
    FleetDrift,
    FleetDriftOptions,
    FleetOptions,
    add_logs,
    fleet_drift,
    open_ledger,
    write_fleet_report,
)
from asbuilt.apps.fleet.drift.columns import make_day, merge_by_day
from asbuilt.apps.fleet.drift.drift import RobotDrift, conclude_drift
from asbuilt.apps.fleet.ledger.entry import read_entry
from asbuilt.apps.fleet.reduction.log_source import make_identity_finder
from asbuilt.apps.fleet.report import render_fleet
from asbuilt.description import LinkInertia
from asbuilt.description.rotation import find_axes_across
from asbuilt.dynamics import gravity_torque
from asbuilt.errors import UsageError
from asbuilt.excitation import random_fourier
from asbuilt.experiment import Recording, VirtualRobot
from asbuilt.writers import write_recording
from command_line import call, document
from fleet_logs import MODEL

DAYS, CHANGE = 8, 5
BEGIN = datetime(2026, 3, 1, tzinfo=UTC)


def _logged(robot: VirtualRobot, k: int, day: int) -> Recording:
    motion = random_fourier(MODEL, rng=50 * k + day, duration=8.0)
    found = robot.record(motion, rate=100.0, rng=100 * k + day).recording
    return replace(found, torque_source="sensor")


def _robot(k: int, day: int) -> VirtualRobot:
    """R1 carries a payload from the sixth day on, R2 has 40 % more friction in its first joint."""
    robot = VirtualRobot.typical(MODEL, k)
    values = np.array(robot.drive_values)
    rng = np.random.default_rng([k, day])
    names = [name for j in range(MODEL.n_joints) for name in robot.drive.names(j + 1)]
    values[[name.startswith("Fv") for name in names]] *= 1.0 + 0.05 * rng.standard_normal()
    if k == 2 and day >= CHANGE:
        values[[name in ("Fv1", "Fc1") for name in names]] *= 1.4
    robot = robot.with_drive(robot.drive, values)
    if k == 1 and day >= CHANGE:
        robot = robot.with_tool(LinkInertia.from_com(0.3, [0.1, 0.0, 0.0], 1e-4 * np.eye(3)))
    return robot


@pytest.fixture(scope="module")
def ledger(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six robots over eight days, two of which change; one of them has two days only."""
    folder = tmp_path_factory.mktemp("drift")
    logs = []
    for k in range(1, 7):
        for day in range(2 if k == 6 else DAYS):
            path = folder / f"R{k}" / f"{BEGIN + timedelta(days=day):%Y-%m-%d}.csv"
            path.parent.mkdir(exist_ok=True)
            write_recording(path, _logged(_robot(k, day), k, day))
            logs.append(path)
    add_logs(
        folder / "ledger",
        "two-link",
        logs,
        robot_id=make_identity_finder("{id}/*.csv"),
        fleet=FleetOptions(workers=0),
    )
    return folder / "ledger"


@pytest.fixture(scope="module")
def drift(ledger: Path) -> FleetDrift:
    return fleet_drift(ledger)


@pytest.mark.study
def test_the_robots_that_changed_are_named_and_dated(drift: FleetDrift) -> None:
    assert {each.id for each in drift.changed} == {"R1", "R2"}
    for each in drift.changed:
        assert each.when is not None
        assert each.when[:10] == f"{BEGIN + timedelta(days=CHANGE):%Y-%m-%d}"
        assert min(each.distances[CHANGE:]) > 3.0 * max(each.distances[:CHANGE])
    few = next(each for each in drift.robots if each.id == "R6")
    assert few.p_value is None
    assert not few.changed
    assert "drift_too_few_days" in {finding.code for finding in drift.findings}


@pytest.mark.study
def test_the_friction_that_grew_is_named_with_its_size(drift: FleetDrift) -> None:
    (found,) = next(each for each in drift.robots if each.id == "R2").what[:1]
    assert (found.effect, found.joint, found.unit) == ("friction", MODEL.joint_names[0], "%")
    assert found.estimate == pytest.approx(40.0, abs=8.0)


@pytest.mark.study
def test_the_torque_of_a_payload_is_that_of_its_weight_and_inertia(drift: FleetDrift) -> None:
    found = next(each for each in drift.robots if each.id == "R1").what[0]
    assert found.effect == "payload"
    with_tool, without = _robot(1, CHANGE), _robot(1, 0)
    squares, n = 0.0, 0
    for day in range(DAYS):
        motion = random_fourier(MODEL, rng=50 + day, duration=8.0).sample(100.0)
        extra = with_tool.exact_torque(motion.q, motion.qd, motion.qdd)
        extra = extra - replace(with_tool, model=without.model).exact_torque(
            motion.q, motion.qd, motion.qdd
        )
        squares, n = squares + np.sum(extra**2, axis=0), n + len(extra)
    assert found.torque == pytest.approx(float(np.sqrt(squares / n).max()), rel=0.1)


@pytest.mark.study
def test_changes_before_a_date_do_not_count(ledger: Path) -> None:
    late = fleet_drift(ledger, since=BEGIN + timedelta(days=CHANGE))
    assert {each.id for each in late.changed} == {"R1", "R2"}
    with pytest.raises(UsageError, match="false_discovery_rate is 0; it must be a number"):
        FleetDriftOptions(false_discovery_rate=0.0)


@pytest.mark.study
def test_tilt_products_are_those_of_gravity_torques(ledger: Path) -> None:
    opened = open_ledger(str(ledger))
    name, settings = opened.current_names("R3")[0]
    entry = opened.read(name, settings)
    assert entry is not None
    again = read_entry(entry.content, name, settings)
    products = entry.tilt[1]
    assert np.array_equal(again.tilt[1], products)
    gram = make_day(entry).equations.of_joints[1]
    assert np.linalg.eigvalsh(gram).min() > -1e-6 * np.trace(gram)
    motion = random_fourier(MODEL, rng=150, duration=8.0).sample(100.0)
    tilted = [
        MODEL.with_gravity(np.cross(MODEL.gravity, a)) for a in find_axes_across(MODEL.gravity)
    ]
    T = np.column_stack([gravity_torque(each, motion.q)[:, 1] for each in tilted])
    share = entry.whole.n_samples / len(T)
    assert products[-2:] == pytest.approx(share * T.T @ T, rel=0.1, abs=0.05 * np.trace(T.T @ T))


@pytest.mark.study
def test_a_change_beyond_what_a_probability_resolves_comes_first() -> None:
    """A body on the flange may be 40 standard errors off, of probability 0 in double precision."""
    dates = ("2026-03-01", "2026-03-09")
    robots = [
        RobotDrift(name, "type", 9, *dates, False, dates[1], p, None, (), dates, (1.0, 9.0))
        for name, p in (("quiet", 0.7), ("less sure", 1e-9), ("sure", 0.0))
    ]
    found = conclude_drift("ledger", None, robots, (), FleetDriftOptions())
    order = ["sure", "less sure", "quiet"]
    assert [robot.id for robot in found.robots] == order
    page = render_fleet(found)
    places = [page.index(f'id="robot-{name.replace(" ", "%20")}"') for name in order]
    assert places == sorted(places)


def test_logs_of_one_day_count_together(ledger: Path) -> None:
    entries = open_ledger(str(ledger)).entries("R3")
    logs = [make_day(each) for each in entries]
    same = [replace(day, date=BEGIN + timedelta(hours=k)) for k, day in enumerate(logs)]
    (together,) = merge_by_day(same)
    assert together.n_logs == len(logs)
    one, *others = (day.equations for day in logs)
    every = one.merge(*others)
    assert together.equations.of_joints[0] == pytest.approx(every.grams[0].sum(axis=0))
    assert together.n_samples == every.lengths.sum()


@pytest.mark.study
def test_page_shows_every_robot_and_escapes_names(drift: FleetDrift, tmp_path: Path) -> None:
    odd = replace(drift, robots=(*drift.robots, replace(drift.robots[-1], id="<b>&")))
    page = render_fleet(odd)
    assert page.count("<details") == len(odd.robots)
    assert page.count('class="history changed"') == 2 * len(drift.changed)
    assert "<b>&" not in page
    assert "http" not in page.split("</style>")[1].replace("http-equiv", "")
    assert page.index('id="robot-R1"') < page.index('id="robot-R3"')
    (kind,) = drift.types
    assert f"{kind.torque[0]:.2g}, {kind.torque[1]:.2g} N m</td>" in page
    sliding = replace(kind, torque=(1.0, 2.5, 30.0), torque_units=("N m", "N m", "N"))
    assert "<td>1, 2.5 N m, 30 N</td>" in render_fleet(replace(drift, types=(sliding,)))
    assert write_fleet_report(tmp_path / "fleet.html", drift).read_text() == render_fleet(drift)


@pytest.mark.study
def test_commands(capsys: pytest.CaptureFixture[str], ledger: Path, tmp_path: Path) -> None:
    found = document(capsys, "fleet", "drift", ledger)
    fields = {"id", "n_logs", "first", "last", "changed", "when", "p_value", "what"}
    assert all(each.keys() >= fields for each in found["robots"])
    assert found["false_discovery_rate"] == 0.05
    status, out, _ = call(capsys, "fleet", "report", ledger, "--out", tmp_path / "page")
    assert status == 0
    assert "2 of 5 robots changed" in " ".join(out.split())
    assert max(len(line) for line in out.splitlines() if str(tmp_path) not in line) <= 80
    assert (tmp_path / "page" / "fleet.html").exists()
    assert call(capsys, "fleet", "drift", tmp_path)[0] == 2
