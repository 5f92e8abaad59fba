"""Tasks with a free base: trained on the first part of a log, scored on the last.

The score is that of torques without the forces of closed contacts: `|P (tau - tau_hat)| / |P tau|`
with P of Pinocchio's Jacobians (`flyer`) at the states of the test. The low-pass before P ends
where contacts no longer count as closed; the one after it may ring.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from adapter import Facts
from flyer import BASE, projections
from plain import Motion, closed_contacts, logged_motion, low_pass
from prepare import Array, Problem, write_facts
from score import relative_error
from task import Task
from twin import twin_log

from asbuilt.description.load import load_robot
from asbuilt.dynamics.drives.torque import choose_usual_drive

POSE = ("base_x", "base_y", "base_z", "base_qx", "base_qy", "base_qz", "base_qw")
TWIST = ("base_vx", "base_vy", "base_vz", "base_wx", "base_wy", "base_wz")
CHANGE = ("base_ax", "base_ay", "base_az", "base_alphax", "base_alphay", "base_alphaz")


def legged_problem(task: Task, data: Path, folder: Path) -> Problem:
    """Write the two parts of a log, and the description as it is."""
    source = data / task.description
    model = load_robot(source, base="free", contacts=",".join(task.settings["contacts"]))
    log = read_legged_log(data / task.training[0], model.joint_names[model.n_floating :], task)
    known = None
    if task.kind == "twin":
        log, known = twin_log(model, log, source, task.settings)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "robot.urdf").write_text(source.read_text())
    middle = int(task.settings["trained"] * len(log["t"]))
    np.savez(folder / "train_0.npz", **{key: x[:middle] for key, x in log.items()})
    rest = {key: x[middle:] for key, x in log.items()}
    rate = float(round(1.0 / np.median(np.diff(log["t"])), 3))
    states = logged_motion(rest, rate, task.cutoff)
    kept = {key: getattr(states, key) for key in ("t", "q", "qd", "qdd")}
    np.savez(folder / "test_0.npz", **kept, contact=rest["contact"])
    names = list(model.joint_names[model.n_floating :])
    write_facts(
        task,
        folder,
        joints=names,
        tree_joints=["base", *names],
        tree_links=list(model.link_names),
        gravity=list(map(float, model.gravity)),
        rate=rate,
        torque_source="motor",
        armature=any(each.key == "armature" for each in choose_usual_drive(model, "motor").terms),
        contacts=task.settings["contacts"],
        description=str(source.resolve()),
    )
    mass = sum(link.inertia.mass for link in model.links)
    true = () if known is None else (known(states),)
    return Problem(folder, model, (np.array(states.tau),), mass=float(mass), clean=true)


def against_torques(problem: Problem, answer: Array) -> dict[str, Any]:
    """Return the error of an answer (N, 6 + n), and where it is known that from the true torques.

    These are of the true bodies and drives in the states of the test; `floor` is their own error:
    what is below it fits errors of the log.
    """
    found: dict[str, Any] = {}
    pairs = [projected_errors(problem, answer)]
    found["error"], found["per_joint"] = relative_error(pairs, "torque")
    for true in problem.clean:
        logged = np.hstack([np.zeros((len(answer), BASE)), problem.hidden[0]])
        away = [projected_errors(problem, logged + answer - true)]
        found["true_error"] = relative_error(away, "torque")[0]
        found["floor"] = relative_error([projected_errors(problem, true)], "torque")[0]
    return found


def read_legged_log(path: Path, joints: Any, task: Task) -> dict[str, Array]:
    """Return `t`, `q`, `qd`, `qdd`, `tau` and `contact` of a log in the columns of asbuilt."""
    names = path.read_text().splitlines()[0].split(",")
    table = np.loadtxt(path, delimiter=",", skiprows=1)
    column = {name: table[:, k] for k, name in enumerate(names)}

    def those(*wanted: str) -> Array:
        return np.column_stack([column[name] for name in wanted])

    def of_joints(kind: str) -> tuple[str, ...]:
        return tuple(f"{kind}_{joint}" for joint in joints)

    return {
        "t": column["t"],
        "q": those(*POSE, *of_joints("q")),
        "qd": those(*TWIST, *of_joints("qd")),
        "qdd": those(*CHANGE, *of_joints("qdd")),
        "tau": those(*of_joints("tau")),
        "contact": those(*(f"contact_{name}" for name in task.settings["contacts"])),
    }


def projected_errors(problem: Problem, answer: Array) -> tuple[Array, Array]:
    """Return root mean squares (6 + n,) of the projected error and torque, edges off.

    Contacts open and close, so that P jumps: the low-pass comes after it, alike for both.
    """
    stored = np.load(problem.folder / "test_0.npz")
    facts = Facts(folder=problem.folder, **json.loads((problem.folder / "facts.json").read_text()))
    states = Motion(*(stored[key] for key in ("t", "q", "qd", "qdd")))
    contact = closed_contacts(stored["contact"], facts.rate, facts.cutoff)
    P = projections(facts, states.q, contact)
    torque = np.hstack([np.zeros((len(states.t), BASE)), problem.hidden[0]])
    found = []
    for each in (torque - answer, torque):
        left = low_pass(np.einsum("tij,tj->ti", P, each), facts.rate, facts.cutoff)
        found.append(np.sqrt(np.mean(left[states.inner(facts.edge)] ** 2, axis=0)))
    return found[0], found[1]
