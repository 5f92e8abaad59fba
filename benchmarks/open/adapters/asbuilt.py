"""asbuilt with its defaults."""

from __future__ import annotations

import numpy as np
from adapter import Estimate, Facts, Fit
from plain import Motion

import asbuilt
from asbuilt.arrays import Array
from asbuilt.codec import plain
from asbuilt.description.sibling import Sibling
from asbuilt.errors import AsbuiltError
from asbuilt.experiment.recording import Recording
from asbuilt.identification.result.result import IdentificationResult
from asbuilt.workflow.study import Study
from asbuilt.writers.models.as_built import as_built
from asbuilt.writers.tables.mass_tables import exported_masses

PACKAGE = "asbuilt"
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


def payload(facts: Facts) -> Estimate:
    """Weigh what the flange carries."""
    bare = recordings(facts, facts.training)
    study = asbuilt.identify(asbuilt.load_robot(facts.description), bare)
    found = asbuilt.identify_payload(study, recordings(facts, facts.loaded), unloaded=bare)
    return Estimate("payload mass", float(found.values[0]), float(found.std_errors[0]))


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
        "effects": [plain(each) for each in study.effects],
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
