"""Tasks without torque: motion of position servos, simulated from the measured state.

A tool gets logs of command and position, the robot as MJCF and what is known of the servos. Of each
test it gets the command and the measured state at the start of each window, and returns the
positions in all windows. The error is that of all positions of a test [rad], its mean over tests.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from plain import plain_motion, uniform
from prepare import Array, Problem, cut_logs, write_facts
from task import Task

from asbuilt.description.load import load_robot
from asbuilt.description.model import RobotModel
from asbuilt.experiment.logs.reading_options import ReadingOptions
from asbuilt.experiment.logs.recordings import read_fitted_recordings
from asbuilt.experiment.recording import Recording
from asbuilt.writers.models.mjcf import export_mjcf


def commanded_problem(task: Task, data: Path, folder: Path) -> Problem:
    """Write logs, windows and the description with the joints that are logged."""
    folder.mkdir(parents=True, exist_ok=True)
    described = load_robot(data / task.description, fixed_base=task.settings.get("fixed", False))
    reading = ReadingOptions(
        torque_source="command", lock=task.settings.get("lock"), sheet=task.sheet or None
    )
    paths = [[data / each for each in names] for names in (task.training, task.test)]
    model, (training, test) = read_fitted_recordings(described, paths, options=reading)
    if "trained" in task.settings:
        training, test = cut_logs(task, training)
    gains = {key: task.settings[key] for key in ("kp", "kd") if key in task.settings}
    joints = tuple(replace(each, drive=replace(each.drive, **gains)) for each in model.joints)
    return write_commanded(task, replace(model, joints=joints), training, test, folder)


def write_commanded(
    task: Task,
    model: RobotModel,
    training: Sequence[Recording],
    test: Sequence[Recording],
    folder: Path,
) -> Problem:
    """Write logs, windows and the robot as MJCF."""
    (folder / "robot.xml").write_text(export_mjcf(model))
    rate = task.rate or float(round(1.0 / np.median(np.diff(training[0].t)), 3))
    for k, log in enumerate(training):
        np.savez(folder / f"train_{k}.npz", t=log.t, q=log.q, u=log.command)
    horizon = task.settings["horizon"]
    hidden = []
    for k, log in enumerate(test):
        windows, measured = windows_of(log, rate, task.cutoff, horizon)
        np.savez(folder / f"test_{k}.npz", t=log.t, u=log.command, **windows)
        hidden.append(measured)
    write_facts(
        task,
        folder,
        joints=list(model.joint_names),
        tree_joints=list(model.joint_names),
        tree_links=list(model.link_names),
        gravity=list(map(float, model.gravity)),
        rate=rate,
        torque_source="command",
        horizon=horizon,
        description=str(folder.resolve() / "robot.xml"),
    )
    return Problem(folder, model, tuple(hidden))


def windows_of(
    log: Recording, rate: float, cutoff: float, horizon: float
) -> tuple[dict[str, Array], Array]:
    """Return start times and states of windows one after another, and positions (W, L, n)."""
    states = plain_motion(log.t, log.q, None, rate, cutoff)
    inner, length = states.inner(), round(horizon * rate)
    first = np.arange(inner.start, inner.stop - length, length)
    at = first[:, None] + np.arange(length)
    measured = uniform(log.t, log.q, states.t)[at]
    return {"start": states.t[first], "q": states.q[first], "qd": states.qd[first]}, measured


def rollout_errors(problem: Problem, answers: list[Array]) -> list[float]:
    """Return the root mean square of the position error of each test [rad]."""
    return [
        float(np.sqrt(np.mean((answer - hidden)[:, 1:] ** 2)))
        for answer, hidden in zip(answers, problem.hidden, strict=True)
    ]
