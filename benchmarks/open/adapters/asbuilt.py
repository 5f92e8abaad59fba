"""asbuilt with its defaults."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from adapter import Estimate, Facts, Fit
from plain import Motion

import asbuilt
from asbuilt.arrays import Array
from asbuilt.codec import make_plain
from asbuilt.description.model import RobotModel
from asbuilt.description.sibling import Sibling
from asbuilt.dynamics.drives.position_servo import PositionServo
from asbuilt.errors import AsbuiltError
from asbuilt.experiment.command.torque import drive_by_command
from asbuilt.experiment.free_base.columns import (
    ACCELERATION,
    ANGULAR,
    ANGULAR_ACCELERATION,
    LINEAR,
    POSITION,
    QUATERNION,
    add_base_coordinates,
    coordinate_rates,
)
from asbuilt.experiment.logs.recordings import read_fitted_recordings
from asbuilt.experiment.recording import Recording
from asbuilt.identification.result.result import IdentificationResult
from asbuilt.identification.trajectories.mujoco_engine import simulate_windows
from asbuilt.identification.trajectories.simulated_robot import DriveSignal, build_robot_as_built
from asbuilt.identification.trajectories.windows import Windows
from asbuilt.workflow.calibration import identify_moments
from asbuilt.workflow.study import Study
from asbuilt.workflow.study_options import PayloadOptions
from asbuilt.writers.models.as_built import as_built
from asbuilt.writers.tables.tabular import exported_masses

PACKAGE = "asbuilt"
VERSION = asbuilt.__version__  # of the tree that runs, which may be no installed one
REQUIRES: list[str] = []
TITLE = "asbuilt"
ADDRESS = "../index.md"


def recordings(facts: Facts, names: list[str]) -> list[Recording]:
    """Return logs as recordings."""
    joints = tuple(facts.joints)
    return [
        Recording(joint_names=joints, torque_source=facts.torque_source, source=name, **log)
        for name, log in zip(names, facts.logs(names), strict=True)
    ]


def payload(facts: Facts) -> list[Estimate]:
    """Weigh what the flange carries."""
    bare = recordings(facts, facts.training)
    study = asbuilt.identify(asbuilt.load_robot(facts.description), bare)
    found = asbuilt.identify_payload(study, recordings(facts, facts.loaded), unloaded=bare)
    return [Estimate("payload mass", float(found.values[0]), float(found.std_errors[0]))]


def weights(facts: Facts) -> list[Estimate]:
    """Return the first moments of what a link carries, log by log."""
    bare = recordings(facts, facts.training)
    study = asbuilt.identify(asbuilt.load_robot(facts.description), bare)
    carrier = facts.tree_links[facts.settings["carrier"] - 1]
    options = PayloadOptions(frame=carrier)
    found = []
    for log in recordings(facts, facts.loaded):
        added = identify_moments(study, log, unloaded=bare, options=options)
        each = zip(added.names, added.values, added.std_errors, strict=True)
        found += [Estimate(*values) for values in each if values[0] != "m"]
    return [each for each in found if np.isfinite(each.error)]


def follow(facts: Facts) -> list[Array]:
    """Identify from commands, and simulate the windows of the tests."""
    known = facts.settings
    model, (training,) = read_fitted_recordings(
        asbuilt.load_robot(facts.description), (commanded(facts, facts.training),)
    )
    same = {"same_servos": True} if known.get("same_servos") else {}
    study = asbuilt.identify(model, training, **same)
    servo, found = study.result.servo, []
    robot = build_robot_as_built(study.result, servo)
    for name, log in zip(facts.test, facts.logs(facts.test), strict=True):
        (recording,) = commanded(facts, [name])
        signal = DriveSignal.of(replace(recording, servo=servo), "command")
        length = round(facts.horizon * facts.rate)
        blank = np.zeros((len(log["start"]), length, len(facts.joints)))
        windows = Windows(
            name, facts.horizon, facts.rate, log["start"], blank, log["q"], log["qd"], signal
        )
        found.append(simulate_windows(robot.centred(windows.step), windows))
    return found


def commanded(facts: Facts, names: list[str]) -> list[Recording]:
    """Return logs of commands as recordings."""
    n, known = len(facts.joints), facts.settings
    gains = {key: (known.get(key, np.nan),) * n for key in ("kp", "kd")}
    found = []
    for name, log in zip(names, facts.logs(names), strict=True):
        recording = Recording(
            t=log["t"],
            q=log["q"] if len(log["q"]) == len(log["t"]) else log["u"],
            tau=np.zeros(log["u"].shape),
            joint_names=tuple(facts.joints),
            source=name,
            command=log["u"],
        )
        found.append(drive_by_command(recording, PositionServo(**gains)))
    return found


def fit(facts: Facts) -> Fit:
    """Identify with the defaults."""
    robot = asbuilt.load_robot(facts.description)
    study = asbuilt.identify(robot, recordings(facts, facts.training))
    result = study.result
    delays = np.broadcast_to(result.chain.delays or (0.0,), len(facts.joints))

    def predict(motion: Motion) -> Array:
        torque = result.predict(motion.q, motion.qd, motion.qdd)
        late = [motion.t - delay for delay in delays]
        return np.column_stack(
            [np.interp(at, motion.t, x) for at, x in zip(late, torque.T, strict=True)]
        )

    note = f"{result.method}; effects: {', '.join(_named(study)) or 'none'}"
    return Fit(predict, _parameters(result), _links(result), note, _details(study))


def fit_legs(facts: Facts) -> Fit:
    """Identify a robot with a free base with the defaults."""
    robot = asbuilt.load_robot(facts.description, base="free", contacts=",".join(facts.contacts))
    study = asbuilt.identify(robot, [_on_base(robot, facts, log) for log in facts.logs()])

    def predict(motion: Motion) -> Array:
        joints = {"q": motion.q, "qd": motion.qd, "qdd": motion.qdd, "t": motion.t}
        still = np.zeros((len(motion.t), len(facts.joints)))
        own = _on_base(robot, facts, joints | {"tau": still, "contact": still})
        torque = study.result.predict(own.q, own.qd, own.qdd)
        return np.einsum("tji,tj->ti", _rates_of_twists(own.q), torque)

    note = f"{study.result.method}; effects: {', '.join(_named(study)) or 'none'}"
    return Fit(predict, links=_links(study.result), note=note)


def _on_base(robot: RobotModel, facts: Facts, log: dict[str, Array]) -> Recording:
    """Return a log of a free base, its columns as those of a file."""
    base = {
        "q": (*POSITION, *QUATERNION),
        "qd": (*LINEAR, *ANGULAR),
        "qdd": (*ACCELERATION, *ANGULAR_ACCELERATION),
    }
    extra = {name: log[key][:, k] for key, names in base.items() for k, name in enumerate(names)}
    extra |= {f"contact_{name}": log["contact"][:, k] for k, name in enumerate(facts.contacts)}
    joints = {key: log[key][:, len(names) :] for key, names in base.items()}
    recording = Recording(
        t=log["t"],
        tau=log["tau"],
        joint_names=tuple(facts.joints),
        torque_source=facts.torque_source,
        source="log",
        extra=extra,
        **joints,
    )
    return add_base_coordinates(recording, robot)


def _rates_of_twists(q: Array) -> Array:
    """Return what takes velocities in base axes to rates of the coordinates, (N, n, n)."""
    found = np.tile(np.eye(q.shape[1]), (len(q), 1, 1))
    for k, axis in enumerate(np.eye(6)):
        v, w = np.tile(axis[:3], (len(q), 1)), np.tile(axis[3:], (len(q), 1))
        found[:, :6, k] = coordinate_rates(q, v, w)
    return found


def _named(study: Study) -> list[str]:
    return [
        each.effect + (f" at {each.joint}" if each.joint else "")
        for each in study.effects
        if each.in_model
    ]


def _parameters(result: IdentificationResult) -> list[Estimate]:
    names = result.base.standard_names
    return [
        Estimate(
            each.expression,
            each.estimate,
            each.std_error,
            {names[j]: float(row[j]) for j in np.flatnonzero(row)},
        )
        for each, row in zip(result.parameters, result.base.regrouping, strict=True)
    ]


def _links(result: IdentificationResult) -> Array | None:
    try:
        return np.reshape(as_built(result).model.parameters, (-1, 10))
    except AsbuiltError:
        return None


def _details(study: Study) -> dict[str, object]:
    """Return the numbers of the robot's page."""
    result, masses = study.result, exported_masses(study.result)
    return {
        "robot": result.robot,
        "method": result.method,
        "duration": result.duration,
        "joints": list(result.joint_names),
        "effects": [make_plain(each) for each in study.effects],
        "masses": None if masses is None else masses.as_dict(),
        "sibling": None if masses is None else Sibling.of(as_built(result).model).as_dict(),
        "drives": _drives(result),
    }


def _drives(result: IdentificationResult) -> list[dict[str, object]]:
    """Return the drive parameters that stand alone, with their standard errors."""
    names = {
        f"{symbol}{k + 1}": joint
        for k, joint in enumerate(result.joint_names)
        for symbol in result.base.drive.symbols
    }
    return [
        {
            "joint": names[each.expression],
            "name": each.expression,
            "unit": each.unit,
            "value": each.estimate,
            "error": each.std_error,
            "determined": each.determined,
        }
        for each in result.parameters
        if each.expression in names
    ]
