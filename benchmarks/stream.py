"""CPU time of `asbuilt watch RESULT -` on a stream of a seven-joint arm at 1 kHz.

    python benchmarks/stream.py

Two streams of different length through a pipe, written in real time: the difference of their CPU
times, user and system, is what the seconds between cost, whatever else the machine does.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import asbuilt
from asbuilt import VirtualRobot
from asbuilt.apps import watch as app
from asbuilt.writers import write_result

RATE = 1000.0
LOGGED = 30.0
SHORT = 2.0
START = 4.0
"""Seconds [s] of the logs, of a short stream, and for the start of the command."""


def make_files(folder: Path) -> list[str]:
    """Write a result and thresholds; return a header and rows of motion without contact."""
    model = asbuilt.load_robot("kuka-iiwa7-r800")
    robot = VirtualRobot.preset("lab", model, 0, engine="inverse-dynamics")
    first, second = (
        robot.record(asbuilt.random_fourier(model, k, duration=LOGGED), k, rate=RATE).recording
        for k in (1, 2)
    )
    result = asbuilt.identify(model, [first]).result
    write_result(folder / "result.json", result)
    app.write_watched(folder, asbuilt.watch(result, second, calibrate=[first]))
    names = ["t", *(f"{each}_{k}" for each in ("q", "tau") for k in range(model.n_joints))]
    rows = np.hstack([second.t[:, None], second.q, second.tau]).tolist()
    return [",".join(names), *(",".join(map(repr, row)) for row in rows)]


def measure_stream(folder: Path, lines: list[str]) -> float:
    """Return the CPU time [s] of a process that watches the lines, written at their rate."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    command = ["watch", str(folder / "result.json"), "-", "--thresholds"]
    process = subprocess.Popen(
        [sys.executable, "-m", "asbuilt", *command, str(folder / "thresholds.json")],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    assert process.stdin is not None
    pipe = process.stdin.fileno()
    os.write(pipe, f"{lines[0]}\n".encode())
    start = time.monotonic() + START
    for k, line in enumerate(lines[1:]):
        time.sleep(max(0.0, start + k / RATE - time.monotonic()))
        os.write(pipe, f"{line}\n".encode())
    process.stdin.close()
    process.wait()
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=14.0)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        lines = make_files(Path(place))
        short = measure_stream(Path(place), lines[: 1 + int(SHORT * RATE)])
        whole = measure_stream(Path(place), lines[: 1 + int(given.seconds * RATE)])
    share = (whole - short) / (given.seconds - SHORT)
    print(f"a stream of seven joints at 1 kHz: {share:.1%} of a core")


if __name__ == "__main__":
    main()
