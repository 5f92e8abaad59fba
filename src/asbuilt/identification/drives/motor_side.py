"""Drive parameters at the motor shaft."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from asbuilt.description.model import RobotModel
from asbuilt.errors import DescriptionError
from asbuilt.identification.result.result import IdentificationResult


@dataclass(frozen=True, slots=True)
class MotorSideParameter:
    """Hold a drive parameter at the joint and at the motor, `std_error` and `unit` at the motor."""

    name: str
    gear_ratio: float
    joint_side: float
    motor_side: float
    std_error: float
    unit: str


def motor_side_parameters(result: IdentificationResult) -> tuple[MotorSideParameter, ...]:
    """Return the drive parameters at the motor of all joints with a known gear ratio N.

    With `theta_motor = N q` and `tau_joint = N tau_motor`: inertia, viscous friction and stiffness
    shrink by N^2, torques by N, `qd |qd|` by N^3, `qd^3` by N^4; for a power of speed with exponent
    a by N^(1 + a). A parameter that is regrouped with links is left out: its value is not the
    drive's alone. Raises `DescriptionError` if no gear ratio is known.
    """
    ratios = gear_ratios(result.model)
    if not ratios:
        raise DescriptionError(
            f"{result.robot} has no gear ratio; add drive = {{gear_ratio = 100.0}} to its links in"
            " the robot file"
        )
    found = []
    alone = {
        parameter.name: parameter
        for parameter in result.parameters
        if parameter.expression == parameter.name
    }
    for joint, ratio in ratios.items():
        for term in result.base.drive.at(joint).terms:
            for symbol, unit, power in zip(
                term.symbols, term.units(revolute=True), term.powers_of_ratio(), strict=True
            ):
                parameter = alone.get(f"{symbol}{joint + 1}")
                if parameter is None:
                    continue
                shrunk = float(np.abs(ratio) ** power) * (
                    np.sign(ratio) if term.turns_over else 1.0
                )
                found.append(
                    MotorSideParameter(
                        parameter.name,
                        ratio,
                        parameter.estimate,
                        parameter.estimate / shrunk,
                        parameter.std_error / abs(shrunk),
                        unit,
                    )
                )
    return tuple(found)


def gear_ratios(model: RobotModel) -> dict[int, float]:
    """Return the gear ratios that the description gives, by joint (counted from 0)."""
    return {
        k: joint.drive.gear_ratio
        for k, joint in enumerate(model.joints)
        if joint.drive.gear_ratio is not None
    }
