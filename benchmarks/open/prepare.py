"""What every tool gets of a task: the same description, the same logs, the same states to predict.

A folder holds `facts.json`, `robot.urdf` (the tree of bodies, without meshes), `train_0.npz` (`t`,
`q`, `tau` as logged, in N m and rad, and `qd` where it is logged) and `test_0.npz` (`t`, `q`, `qd`,
`qdd` after the plain low-pass). The torque of the test stays with the runner.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from plain import plain_motion, uniform
from task import Task

from asbuilt.description.load import load_robot
from asbuilt.description.model import RobotModel
from asbuilt.description.structure.couplings import Coupling
from asbuilt.dynamics.drives.torque import choose_usual_drive
from asbuilt.errors import InertiaError
from asbuilt.experiment.logs.readers import read_recordings
from asbuilt.experiment.recording import Recording
from asbuilt.writers.models.urdf import format_urdf

Array = Any
SCORED = 2.2
"""Edges that a part of a log must outlast to be predicted: both its own, and some more."""
HIDDEN = ("mass", "ratio")
"""Settings that are the answer."""


@dataclass(frozen=True, eq=False)
class Problem:
    """A prepared task: its folder, the robot, the hidden torques and, where known, the truth.

    `hidden` holds for each test the torque as logged (N, n) on the grid of its states. `truth` are
    standard parameters by name, `clean` the torques of a
    true robot with a free base in the states of a test (N, 6 + n).
    """

    folder: Path
    model: RobotModel
    hidden: tuple[Array, ...]
    truth: dict[str, float] | None = None
    mass: float | None = None
    clean: tuple[Array, ...] = ()


def read_task_logs(
    task: Task, data: Path, scratch: Path
) -> tuple[RobotModel, list[Any], list[Any]]:
    """Return the robot, what is trained on and what is predicted."""
    described = task.description
    name = described if not described.startswith("models/") else str(data / described)
    model = load_robot(name)
    sheet = scratch / "sheet.toml"
    scratch.mkdir(parents=True, exist_ok=True)
    sheet.write_text(_toml(task.sheet))
    logs = [
        [read_recordings([data / each], model=model, sheet=sheet)[0] for each in paths]
        for paths in (task.training, task.test)
    ]
    if not task.test and set(task.settings) & {"trained", "blocks"}:
        return model, *cut_logs(task, logs[0])
    return model, *logs


def cut_logs(task: Task, logs: Sequence[Recording]) -> tuple[list[Recording], list[Recording]]:
    """Return what is trained on and what is predicted of logs that hold both.

    `trained`: the first part of each log, and the rest. `blocks = [seconds, every]`: each log in
    blocks, of which the last of `every` is predicted; those before it are one log. What is left of
    a block at the end is predicted if it outlasts the ends that are not scored.
    """
    training, test = [], []
    for log in logs:
        if "trained" in task.settings:
            middle = int(task.settings["trained"] * len(log.t))
            training.append(cut(log, slice(0, middle)))
            test.append(cut(log, slice(middle, None)))
            continue
        seconds, every = task.settings["blocks"]
        edges = np.arange(log.t[0], log.t[-1], seconds)
        at = [*np.searchsorted(log.t, edges), len(log.t)]
        for k in range(0, len(at) - 1, every):
            last = min(k + every - 1, len(at) - 2)
            if last == k + every - 1:
                held = cut(log, slice(at[last], at[last + 1]))
                test += [held] if held.t[-1] - held.t[0] > SCORED * task.edge else []
            else:
                last += 1
            training.append(cut(log, slice(at[k], at[last])))
    return training, test


def halves(logs: Sequence[Recording]) -> tuple[list[Recording], list[Recording]]:
    """Return two sets of logs: alternate logs where there are two or more, else first and last."""
    if len(logs) > 1:
        return list(logs[::2]), list(logs[1::2])
    (log,) = logs
    middle = len(log.t) // 2
    return [cut(log, slice(0, middle))], [cut(log, slice(middle, None))]


def cut(log: Recording, rows: slice) -> Recording:
    """Return some rows of a log."""
    qd = None if log.qd is None else log.qd[rows]
    command = None if log.command is None else log.command[rows]
    kept = {"t": log.t[rows], "q": log.q[rows], "tau": log.tau[rows]}
    return replace(log, qd=qd, command=command, extra={}, **kept)


def write_problem(
    task: Task,
    model: RobotModel,
    training: Sequence[Recording],
    test: Sequence[Recording],
    folder: Path,
    truth: dict[str, float] | None = None,
    description: str = "",
) -> Problem:
    """Write what the tools get."""
    folder.mkdir(parents=True, exist_ok=True)
    rate = task.rate or _rate(training[0])
    tree = model.tree
    bare = tuple(replace(joint, drive=type(joint.drive)()) for joint in tree.joints)
    try:
        plain = format_urdf(replace(tree, joints=bare, frames=()))
    except InertiaError:  # bodies that cannot exist: the file as it is, with its faults
        plain = Path(description).read_text()
    (folder / "robot.urdf").write_text(with_origins(plain))
    for k, log in enumerate(training):
        values = {"t": log.t, "q": log.q, "tau": log.tau}
        if log.qd is not None:
            values["qd"] = log.qd
        np.savez(folder / f"train_{k}.npz", **values)
    loaded = []
    if task.kind in ("payload", "ratio"):
        loaded = [f"loaded_{k}.npz" for k in range(len(test))]
        for name, log in zip(loaded, test, strict=True):
            np.savez(folder / name, t=log.t, q=log.q, tau=log.tau)
    hidden = []
    for k, whole in enumerate(() if loaded else test):
        log = whole if task.test_seconds is None else _first(whole, task.test_seconds)
        states = plain_motion(log.t, log.q, None, rate, task.cutoff)
        np.savez(folder / f"test_{k}.npz", t=states.t, q=states.q, qd=states.qd, qdd=states.qdd)
        hidden.append(uniform(log.t, log.tau, states.t))
    coupling = model.joint_map
    source = training[0].torque_source
    write_facts(
        task,
        folder,
        joints=list(model.joint_names),
        tree_joints=list(tree.joint_names),
        tree_links=list(tree.link_names),
        coupling={"matrix": coupling.matrix.tolist(), "offset": coupling.offset.tolist()}
        if isinstance(coupling, Coupling)
        else None,
        loops=loops_of(model),
        gravity=list(map(float, model.gravity)),
        rate=rate,
        torque_source=source,
        armature=any(each.key == "armature" for each in choose_usual_drive(model, source).terms),
        loaded=loaded,
        description=description or str(folder.resolve() / "robot.urdf"),
    )
    described = [link.inertia.mass for link in tree.links]
    return Problem(folder, model, tuple(hidden), truth, sum(described) or None)


def write_facts(task: Task, folder: Path, **facts: Any) -> None:
    """Write what a tool is told beside the logs that lie in the folder."""
    settings = {key: value for key, value in task.settings.items() if key not in HIDDEN}
    logs = {
        kind: sorted(path.name for path in folder.glob(f"{name}_*.npz"))
        for kind, name in (("training", "train"), ("test", "test"))
    }
    own = {"task": task.name, "cutoff": task.cutoff, "edge": task.edge, "settings": settings}
    told = own | logs | facts
    (folder / "facts.json").write_text(json.dumps(told, indent=1))


def with_origins(urdf: str) -> str:
    """Return a URDF in which every joint and inertia states its origin, which some readers need."""
    root = ElementTree.fromstring(urdf)
    for place in (*root.iter("joint"), *root.iter("inertial")):
        if place.find("origin") is None:
            place.insert(0, ElementTree.Element("origin", xyz="0 0 0", rpy="0 0 0"))
    return ElementTree.tostring(root, encoding="unicode")


def loops_of(model: RobotModel) -> dict[str, Any] | None:
    """Return points of links that coincide, and where joints are about; None without loops."""
    if not model.loops:
        return None
    points = [
        {"a": (loop.link_a, list(loop.point_a)), "b": (loop.link_b, list(loop.point_b))}
        for loop in model.loops
    ]
    return {"points": points, "posture": dict(model.posture)}


def _first(log: Recording, seconds: float) -> Recording:
    return cut(log, slice(0, int(np.searchsorted(log.t, log.t[0] + seconds))))


def _rate(log: Recording) -> float:
    return float(round(1.0 / float(np.median(np.diff(log.t))), 3))


def _toml(sheet: dict[str, Any]) -> str:
    """Return a recording sheet as TOML."""
    flat = {key: value for key, value in sheet.items() if not isinstance(value, dict)}
    lines = [f"{key} = {json.dumps(value)}" for key, value in flat.items()]
    for key, table in sheet.items():
        if isinstance(table, dict):
            lines += [f"[{key}]", *(f"{k} = {json.dumps(v)}" for k, v in table.items())]
    return "\n".join(lines) + "\n"
