"""The demonstration of a fleet: ten virtual robots over ten days, one of which changes."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from asbuilt import (
    FleetDrift,
    FleetOptions,
    IdentificationResult,
    LinkInertia,
    VirtualRobot,
    fleet_drift,
    fleet_identify,
    random_fourier,
    write_recording,
)
from asbuilt.apps.fleet.reduction.add import Addition, add_logs
from asbuilt.apps.fleet.reduction.log_source import make_identity_finder
from asbuilt.apps.fleet.report import addition_document, describe_drift_outcome
from asbuilt.description import bundled_robot
from asbuilt.tables import Column, Table, wrap_text
from asbuilt.validation import Drift, compare_results
from asbuilt.workflow import Progress

ROBOT = "ur10e"
ROBOTS = range(1, 11)
DAYS = 10
BEGIN = datetime(2026, 3, 1, tzinfo=UTC)
CHANGED = 7
SINCE = 6
"""The robot that changes, and the day from which it carries the tool."""
TOOL = LinkInertia.from_com(1.0, [0.0, 0.0, 0.06], np.diag([0.003, 0.003, 0.001]))
SECONDS = 12.0
RATE = 100.0


@dataclass(frozen=True, slots=True, eq=False)
class FleetDemo:
    """Hold the demonstration: what was added, each robot's result, and what changed.

    `changes` compares the halves of each robot's days, `drift` all robots with natural variation.
    """

    ledger: Path
    logs: Path
    addition: Addition
    results: dict[str, IdentificationResult]
    changes: dict[str, Drift]
    drift: FleetDrift
    seconds: float


def run_demo(
    folder: Path,
    *,
    progress: Progress | None = None,
    robots: Sequence[int] = ROBOTS,
    days: int = DAYS,
) -> FleetDemo:
    """Record virtual robots, add the logs to a ledger, and identify each robot from it.

    Parameters
    ----------
    folder
        Where logs and ledger go.
    progress
        Called with the name of each step and the fraction done.
    robots, days
        Numbers of the robots, and how many days.
    """
    report = progress or (lambda what, fraction: None)
    began = time.perf_counter()
    logs = []
    for k in robots:
        for day in range(1, days + 1):
            logs.append(_record(folder / "logs", k, day))
            report("record the robots", len(logs) / (len(robots) * days))
    ledger = folder / "ledger"
    addition = add_logs(
        ledger,
        ROBOT,
        logs,
        robot_id=make_identity_finder("{id}/*.csv"),
        fleet=FleetOptions(workers=0),
        progress=report,
    )
    results = {}
    changes = {}
    middle = BEGIN + timedelta(days=SINCE - 1)
    for done, k in enumerate(robots, start=1):
        report("identify each robot", done / len(robots))
        name = _name_arm(k)
        results[name] = fleet_identify(ledger, name).result
        halves = (
            fleet_identify(ledger, name, until=middle).result,
            fleet_identify(ledger, name, since=middle).result,
        )
        changes[name] = compare_results(*halves, labels=("before", "after"))
    drift = fleet_drift(ledger, progress=report)
    seconds = time.perf_counter() - began
    return FleetDemo(ledger, folder / "logs", addition, results, changes, drift, seconds)


def _record(folder: Path, k: int, day: int) -> Path:
    """Write the log of a robot and a day: a motion and a friction of its own."""
    model = bundled_robot(ROBOT)
    robot = VirtualRobot.typical(model, k)
    rng = np.random.default_rng([k, day])
    values = np.array(robot.drive_values)
    names = [name for j in range(model.n_joints) for name in robot.drive.names(j + 1)]
    # Standard deviation of viscous friction from day to day.
    values[[name.startswith("Fv") for name in names]] *= 1.0 + 0.02 * rng.standard_normal()
    robot = robot.with_drive(robot.drive, values)
    if k == CHANGED and day >= SINCE:
        robot = robot.with_tool(TOOL)
    motion = random_fourier(model, rng=1000 * k + day, duration=SECONDS)
    recording = robot.record(motion, rate=RATE, rng=100 * k + day).recording
    path = folder / _name_arm(k) / f"{BEGIN + timedelta(days=day - 1):%Y-%m-%d}.csv"
    write_recording(path, replace(recording, source=path.name))
    return path


def _name_arm(k: int) -> str:
    return f"arm-{k:02d}"


def describe_demo(demo: FleetDemo) -> str:
    """Return the screen with which the demonstration ends."""
    results = demo.results
    columns = (
        Column("robot", of=str),
        Column("logs", of=lambda name: len(results[name].sources)),
        Column(
            "torque error",
            "%",
            of=lambda name: f"{100.0 * results[name].train.relative_error:.2f}",
        ),
        Column("of CAD", "%", of=lambda name: f"{100.0 * results[name].cad.relative_error:.1f}"),
        Column("change", "chi2 / p", of=lambda name: f"{_measure_change(demo.changes[name]):.1f}"),
    )
    worst = max(demo.changes, key=lambda name: _measure_change(demo.changes[name]))
    lines = [
        wrap_text(
            f"{len(results)} virtual {ROBOT} over {DAYS} days, {len(demo.addition.added)} logs of"
            f" {SECONDS:g} s reduced to a ledger. From day {SINCE} on, {_name_arm(CHANGED)} carries"
            f" {TOOL.mass:g} kg that no description has."
        ),
        "",
        Table.of(results, columns).as_text(),
        wrap_text(
            f"{worst} changed most: between the first {SINCE - 1} days and the rest chi-square is"
            f" {_measure_change(demo.changes[worst]):.0f} per parameter, of noise alone 1."
        ),
        "",
        wrap_text(describe_drift_outcome(demo.drift)),
        *(
            wrap_text(f"{robot.id}, from {(robot.when or '')[:10]}: {change.text}")
            for robot in demo.drift.changed
            for change in robot.what
        ),
        "",
        f"logs    {demo.logs}",
        f"ledger  {demo.ledger}",
        f"try     asbuilt fleet report {demo.ledger} --out page",
        f"        asbuilt fleet identify {demo.ledger} --id {worst}",
        f"{demo.seconds:.0f} s",
    ]
    return "\n".join(lines) + "\n"


def _measure_change(drift: Drift) -> float:
    """Return chi-square per parameter of the difference between two results."""
    return float(drift.chi_square.statistic / max(drift.chi_square.degrees, 1))


def demo_document(demo: FleetDemo) -> dict[str, Any]:
    """Return what `asbuilt demo fleet --json` prints."""
    return {
        "add": addition_document(demo.addition),
        "robots": [
            {
                "id": name,
                "n_logs": len(result.sources),
                "train": result.train.as_dict(),
                "cad": result.cad.as_dict(),
                "change": _measure_change(demo.changes[name]),
            }
            for name, result in demo.results.items()
        ],
        "drift": demo.drift.as_document(),
        "files": {"logs": str(demo.logs), "ledger": str(demo.ledger)},
        "seconds": demo.seconds,
    }
