"""Short logs of virtual robots for the tests of fleets."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from asbuilt.description import RobotModel, load_robot
from asbuilt.excitation import random_fourier
from asbuilt.experiment import Recording, VirtualRobot
from asbuilt.writers import write_recording

MODEL: RobotModel = load_robot("two-link")


def virtual(seed: int) -> VirtualRobot:
    """A robot with links and friction of its own."""
    return VirtualRobot.typical(MODEL, seed)


def recording(seed: int, robot: int = 1, seconds: float = 12.0) -> Recording:
    """A recording of a robot; each seed is another motion."""
    motion = random_fourier(MODEL, rng=100 + seed, duration=seconds)
    found = virtual(robot).record(motion, rate=100.0, rng=seed).recording
    return replace(found, torque_source="sensor")


def write_logs(folder: Path, count: int, robot: int = 1, first: int = 1) -> list[Path]:
    """Write logs of a robot, one a day of March 2026."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for day in range(first, first + count):
        path = folder / f"run_2026-03-{day:02d}.csv"
        write_recording(path, recording(day, robot))
        paths.append(path)
    return paths


def content_of(folder: Path) -> dict[str, bytes]:
    """Every file below a folder with its content."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def with_clock(path: Path, target: Path, start: float) -> Path:
    """Write a log again with time stamps that count from a date."""
    lines = path.read_text().splitlines()
    head = lines[0].split(",")
    column = head.index("t")
    rows = [line.split(",") for line in lines[1:]]
    for row in rows:
        row[column] = repr(float(np.round(start + float(row[column]), 6)))
    target.write_text("\n".join([lines[0], *(",".join(row) for row in rows)]) + "\n")
    return target
