"""CPU time and memory of commands on robots and recordings of growing size.

    python benchmarks/sizes.py [CASE ...] [--command check|identify|show]

A case is a kind and a size, `tree:60` or `hours-one:10`; a kind alone is measured at its usual
sizes. Kinds: `tree` and `chain` are joints of a robot with limbs and of a serial one, with 40 s at
200 Hz; `hours` and `hours-one` are hours of a 7-joint arm at 1 kHz in Parquet, in row groups of a
minute and in one; `loops` are repetitions of a closed chain's loop, `mesh` the parts of a mesh's
path, and `frames` the fixed links of a robot.
Every command runs as a user runs it, in a process of its own. Numbers are seconds of CPU (user and
system, of children too) and the greatest resident memory in MB.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import numpy as np
import polars as pl

from asbuilt.description.load import load_robot
from asbuilt.dynamics.newton_euler import inverse_dynamics

RATE = 200.0
SECONDS = 40.0
HARMONICS = 5
NOISE = 0.02
"""Of a joint's largest torque."""

HOURS_RATE = 1000.0
CHUNK = 60_000
"""Samples that are made at once, and of a row group: a minute."""

AXES = ("0 0 1", "0 1 0", "1 0 0")
LIMIT = 1.2
"""Of every joint [rad]: limbs of a person do not turn round."""


@dataclass(frozen=True, slots=True)
class Link:
    """A link on a turning joint: the link that carries it, where, its axis and its size."""

    name: str
    parent: str
    place: tuple[float, float, float]
    axis: str
    mass: float
    length: float


def limb(
    name: str, parent: str, start: tuple[float, float, float], n: int, size: float
) -> list[Link]:
    """Return a limb of `n` joints whose links shrink from `size` [m] along z, turned in order about
    the three axes.
    """
    links = []
    for k in range(n):
        length = size * 0.9**k
        links.append(
            Link(
                f"{name}_{k}",
                parent,
                start if k == 0 else (0.01 * (-1) ** k, 0.0, links[-1].length),
                AXES[k % 3],
                40.0 * length**2 + 0.02,
                length,
            )
        )
        parent = links[-1].name
    return links


def serial_chain(n: int) -> list[Link]:
    """Return one limb of `n` joints that stays about 3 m long."""
    return limb("link", "root", (0.0, 0.0, 0.1), n, 0.3)


def humanoid(n: int) -> list[Link]:
    """Return waist, head, arms and legs, then fingers on the arms, until there are `n` joints."""
    links = limb("waist", "root", (0.0, 0.0, 0.1), min(n, 3), 0.2)
    limbs = [
        ("left_arm", "waist_2", (0.0, 0.2, 0.3), 7, 0.3),
        ("right_arm", "waist_2", (0.0, -0.2, 0.3), 7, 0.3),
        ("left_leg", "root", (0.0, 0.1, -0.1), 6, 0.4),
        ("right_leg", "root", (0.0, -0.1, -0.1), 6, 0.4),
        ("head", "waist_2", (0.0, 0.0, 0.4), 3, 0.15),
    ]
    for finger in range(5):
        for side in ("left", "right"):
            place = (0.02 * finger - 0.04, 0.0, 0.1)
            limbs.append((f"{side}_finger_{finger}", f"{side}_arm_6", place, 3, 0.08))
    for name, parent, start, length, size in limbs:
        links += limb(name, parent, start, min(length, n - len(links)), size)
    if len(links) < n:
        raise ValueError(f"a robot with limbs has at most {len(links)} joints, not {n}")
    return links


def urdf(links: Sequence[Link], *, mesh: str | None = None, frames: int = 0) -> str:
    """Return the URDF of links on a fixed `root`; `mesh` is the path of the last link's, and
    `frames` fixed links without mass stand on the root.
    """
    shape = f'<visual><geometry><mesh filename="{mesh}"/></geometry></visual>' if mesh else ""
    parts = ['<robot name="sized"><link name="root"/>']
    for link in links:
        across = link.mass * (0.25 * link.length) ** 2
        along = link.mass * link.length**2 / 10
        place = " ".join(f"{x:.6g}" for x in link.place)
        parts.append(
            f'<link name="{link.name}"><inertial>'
            f'<origin xyz="{0.05 * link.length:.6g} {0.03 * link.length:.6g} {link.length / 2:.6g}"'
            f'/><mass value="{link.mass:.6g}"/><inertia ixx="{along:.6g}" iyy="{along:.6g}" '
            f'izz="{across:.6g}" ixy="0" ixz="0" iyz="0"/></inertial>'
            f"{shape if link is links[-1] else ''}</link>"
            f'<joint name="{link.name}_joint" type="revolute"><parent link="{link.parent}"/>'
            f'<child link="{link.name}"/><origin xyz="{place}"/><axis xyz="{link.axis}"/>'
            f'<limit lower="-{LIMIT}" upper="{LIMIT}" velocity="10" effort="1000"/></joint>'
        )
    for k in range(frames):
        parts.append(
            f'<link name="frame_{k}"/><joint name="frame_{k}_joint" type="fixed">'
            f'<parent link="root"/><child link="frame_{k}"/></joint>'
        )
    return "\n".join(parts) + "\n</robot>\n"


def recorded(
    path: Path, t: np.ndarray, rng: np.random.Generator, masses: float = 1.1
) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and noisy torques, (n_samples, n_joints), of a robot that weighs `masses`
    times what its description says and has friction; the same motion for all parts of a recording.
    """
    model = load_robot(path)
    n = model.n_joints
    shape = np.random.default_rng(7)
    base = 2 * np.pi * 0.1
    q = np.zeros((t.size, n))
    qd = np.zeros((t.size, n))
    qdd = np.zeros((t.size, n))
    for k in range(1, HARMONICS + 1):
        a, b = shape.normal(scale=0.25 / k, size=(2, n))
        sine = np.sin(k * base * t)[:, None]
        cosine = np.cos(k * base * t)[:, None]
        q += a * sine + b * cosine
        qd += k * base * (a * cosine - b * sine)
        qdd -= (k * base) ** 2 * (a * sine + b * cosine)
    tau = masses * inverse_dynamics(model, q, qd, qdd)
    largest = np.abs(tau).max(axis=0)
    tau += largest * (0.05 * np.tanh(qd / 0.01) + 0.02 * qd)
    return q, tau + NOISE * largest * rng.normal(size=q.shape)


def limbs(folder: Path, links: Sequence[Link]) -> tuple[Path, Path]:
    """Write a robot and its log of 40 s at 200 Hz."""
    robot = folder / "robot.urdf"
    log = folder / "log.csv"
    robot.write_text(urdf(links))
    t = np.arange(round(SECONDS * RATE)) / RATE
    q, tau = recorded(robot, t, np.random.default_rng(1))
    columns = {"t": t}
    columns |= {f"q_{k}": q[:, k] for k in range(len(links))}
    columns |= {f"tau_{k}": tau[:, k] for k in range(len(links))}
    pl.DataFrame(columns).write_csv(log, float_precision=8)
    return robot, log


def hours(folder: Path, hours: float, *, one_group: bool) -> tuple[Path, Path]:
    """Write an arm of seven joints and hours of it at 1 kHz, in row groups of a minute or in one.

    In one row group memory grows with the hours, since it is written at once.
    """
    robot = folder / "robot.urdf"
    log = folder / "log.parquet"
    robot.write_text(urdf(limb("link", "root", (0.0, 0.0, 0.3), 7, 0.3)))
    n_samples = round(hours * 3600 * HOURS_RATE)
    rng = np.random.default_rng(1)
    parts = []
    for start in range(0, n_samples, CHUNK):
        t = np.arange(start, min(start + CHUNK, n_samples)) / HOURS_RATE
        q, tau = recorded(robot, t, rng)
        # Single precision, so that ten hours fit the disk.
        columns = {"t": t}
        columns |= {f"q_{k}": q[:, k].astype(np.float32) for k in range(q.shape[1])}
        columns |= {f"tau_{k}": tau[:, k].astype(np.float32) for k in range(q.shape[1])}
        parts.append(folder / f"part_{start:010d}.parquet")
        pl.DataFrame(columns).write_parquet(parts[-1])
    pl.scan_parquet(parts).sink_parquet(log, row_group_size=n_samples if one_group else CHUNK)
    for part in parts:
        part.unlink()
    return robot, log


def loops(folder: Path, n: int) -> tuple[Path]:
    """Write the four-bar linkage with its loop said `n` times."""
    text = (files("asbuilt") / "description/robots/four-bar.toml").read_text()
    robot, _, loop = text.partition("[[loops]]")
    closed = folder / "robot.toml"
    closed.write_text(robot + n * f"[[loops]]{loop}\n")
    return (closed,)


def mesh(folder: Path, n: int) -> tuple[Path]:
    """Write an arm whose last link's mesh lies `n` folders down, and is not there."""
    robot = folder / "robot.urdf"
    links = limb("link", "root", (0.0, 0.0, 0.3), 7, 0.3)
    robot.write_text(urdf(links, mesh="package://robot/" + n * "part/" + "link.stl"))
    return (robot,)


def frames(folder: Path, n: int) -> tuple[Path]:
    """Write an arm with `n` frames."""
    robot = folder / "robot.urdf"
    robot.write_text(urdf(limb("link", "root", (0.0, 0.0, 0.3), 7, 0.3), frames=n))
    return (robot,)


KINDS: dict[str, tuple[Callable[[Path, float], tuple[Path, ...]], tuple[str, ...], tuple]] = {
    "tree": (lambda f, n: limbs(f, humanoid(int(n))), ("check", "identify"), (20, 30, 60)),
    "chain": (lambda f, n: limbs(f, serial_chain(int(n))), ("check", "identify"), (20, 30, 60)),
    "hours": (lambda f, n: hours(f, n, one_group=False), ("check", "identify"), (1, 2)),
    "hours-one": (lambda f, n: hours(f, n, one_group=True), ("check", "identify"), (1, 2)),
    "loops": (lambda f, n: loops(f, int(n)), ("show",), (500, 1000)),
    "mesh": (lambda f, n: mesh(f, int(n)), ("show",), (1500, 3000)),
    "frames": (lambda f, n: frames(f, int(n)), ("show",), (25_000, 50_000)),
}
"""By kind: what writes it, the commands that are measured, the usual sizes."""


def run(command: str, given: Sequence[Path], log: Path | None = None) -> dict[str, float]:
    """Run a command and return its CPU time [s], greatest memory [MB] and exit status."""
    with open(log or os.devnull, "w") as out:
        process = subprocess.Popen(
            [sys.executable, "-m", "asbuilt", command, *map(str, given)],
            stdout=out,
            stderr=subprocess.STDOUT,
        )
        _, status, usage = os.wait4(process.pid, 0)
    return {
        "cpu_s": usage.ru_utime + usage.ru_stime,
        "memory_mb": usage.ru_maxrss / 1e3,
        "exit": os.waitstatus_to_exitcode(status),
    }


def measure() -> dict[str, float]:
    """Return CPU time and memory of what is quick: descriptions at two sizes, and 20 joints."""
    quick = ("loops", "mesh", "frames", "tree:20", "chain:20")
    return {
        f"{case}_{command}_{name}": value
        for case, command, numbers in measured(quick)
        for name, value in numbers.items()
        if name != "exit"
    }


def measured(
    cases: Sequence[str], only: str | None = None
) -> Iterator[tuple[str, str, dict[str, float]]]:
    """Yield case, command and numbers, one after another."""
    for case in cases:
        kind, _, size = case.partition(":")
        write, commands, sizes = KINDS[kind]
        for n in (float(size),) if size else sizes:
            with tempfile.TemporaryDirectory() as folder:
                written = write(Path(folder), n)
                for command in (only,) if only else commands:
                    yield f"{kind}:{n:g}", command, run(command, written)


def main() -> None:
    """Print a line for every case and command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("cases", nargs="*", default=list(KINDS))
    parser.add_argument("--command", help="measure this one alone")
    arguments = parser.parse_args()
    for case, command, numbers in measured(arguments.cases, arguments.command):
        shown = "  ".join(f"{name} {value:9.2f}" for name, value in numbers.items())
        print(f"{case:<14} {command:<10} {shown}", flush=True)


if __name__ == "__main__":
    main()
