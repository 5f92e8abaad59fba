"""Hold an identified model against a recording.

Measured torque, the prediction as built and the prediction by design.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.drives.torque import described_drive, drive_torque
from asbuilt.dynamics.newton_euler import inverse_dynamics
from asbuilt.errors import ResultError
from asbuilt.identification.identify import design_values as described_values
from asbuilt.identification.result.metrics import TorqueMetrics, torque_metrics
from asbuilt.identification.result.torque_prediction import Prediction, carrying, predict_torque
from asbuilt.validation.residuals import (
    ResidualAnalysis,
    VelocityCurve,
    analyse_residual,
    velocity_curve,
)

if TYPE_CHECKING:
    from asbuilt.experiment.signal.samples import Samples
    from asbuilt.identification.result.result import IdentificationResult


@dataclass(frozen=True, slots=True, eq=False)
class Validation:
    """Hold torques of a recording, all (N, n) at the times `t` (N,) of the filtered grid, N m or N.

    `velocity` is the joint velocity there, `drive` the torque of the identified drive terms that
    follow velocity (friction, offset).
    """

    source: str
    joint_names: tuple[str, ...]
    units: tuple[str, ...]
    t: Array
    velocity: Array
    measured: Array
    predicted: Array
    predicted_cad: Array
    drive: Array
    metrics_as_built: TorqueMetrics
    metrics_cad: TorqueMetrics

    def __post_init__(self) -> None:
        for values in (
            self.t,
            self.velocity,
            self.measured,
            self.predicted,
            self.predicted_cad,
            self.drive,
        ):
            values.setflags(write=False)

    @property
    def error(self) -> Array:
        """Measured torque minus the prediction as built, (N, n)."""
        return self.measured - self.predicted

    @property
    def friction(self) -> Array:
        """Measured torque minus the rigid-body part of the prediction as built, (N, n).

        What the drives took.
        """
        return self.error + self.drive

    def residuals(self) -> ResidualAnalysis:
        """Analyse the error of the prediction as built."""
        return analyse_residual(self.t, self.error, self.joint_names)

    def friction_curves(self) -> tuple[VelocityCurve, ...]:
        """Return the torque the drives took against velocity, one curve per joint."""
        return tuple(
            velocity_curve(qd, torque)
            for qd, torque in zip(self.velocity.T, self.friction.T, strict=True)
        )


def validate(
    result: IdentificationResult, samples: Samples, *, cad: RobotModel | None = None
) -> Validation:
    """Predict a recording from the values as built and by design, the torque and both predictions
    through the same filter.

    `cad` replaces the description that the result carries, such as the manufacturer's; it must have
    the same joints and geometry. Design values on which it is silent add nothing. Raises
    ResultError where joints do not fit.
    """
    if tuple(samples.joint_names) != tuple(result.joint_names):
        raise ResultError(
            f"the recording {samples.source!r} has joints {', '.join(samples.joint_names)}; the"
            f" result of {result.robot} needs {', '.join(result.joint_names)} in this order"
        )
    design = np.nan_to_num(
        result.cad_values if cad is None else design_values(result, cad), nan=0.0
    )
    as_built, by_design = (
        predict_torque(result.model, result.base, beta, samples)
        for beta in (result.estimates, design)
    )
    return Validation(
        source=samples.source,
        joint_names=tuple(result.joint_names),
        units=torque_units(result.model),
        t=as_built.t,
        velocity=samples.filtered(samples.qd),
        measured=as_built.measured,
        predicted=as_built.predicted,
        predicted_cad=by_design.predicted,
        drive=_drive_torque(result, samples),
        metrics_as_built=_metrics(result, result.estimates, samples, as_built),
        metrics_cad=_metrics(result, design, samples, by_design),
    )


def _metrics(
    result: IdentificationResult, beta: Array, samples: Samples, prediction: Prediction
) -> TorqueMetrics:
    """Return the metrics of a prediction on its filtered grid, with the error against the torque as
    recorded beside them.
    """
    recorded = predict_torque(
        result.model, result.base, beta, replace(samples, tau=samples.tau_raw, parallel=None)
    )
    metrics = torque_metrics(
        prediction.measured, prediction.predicted, samples.source, result.joint_names
    )
    return replace(metrics, rms_recorded=np.sqrt(np.mean(recorded.error**2, axis=0)))


def validate_description(model: RobotModel, samples: Samples) -> TorqueMetrics:
    """Predict a recording with a robot as described, drives included, through the filter of the
    samples, and return how far off that is.

    Raises ResultError where joints do not fit.
    """
    if tuple(samples.joint_names) != model.joint_names:
        raise ResultError(
            f"the recording {samples.source!r} has joints {', '.join(samples.joint_names)};"
            f" {model.name} has {', '.join(model.joint_names)}"
        )
    drive, values = described_drive(model)
    state = (samples.q, samples.qd, samples.qdd)
    load = inverse_dynamics(model, *state)
    torque = load + drive_torque(drive, values, *state, load=load, shares=model.motor_shares)
    metrics = torque_metrics(
        samples.filtered_torque, samples.filtered(torque), samples.source, model.joint_names
    )
    recorded = replace(samples, tau=samples.tau_raw, parallel=None).filtered_torque
    return replace(metrics, rms_recorded=np.sqrt(np.mean((recorded - torque) ** 2, axis=0)))


def torque_units(model: RobotModel) -> tuple[str, ...]:
    """Return the unit of each joint's torque: N m where it turns, N where it slides."""
    return tuple("N m" if joint.is_revolute else "N" for joint in model.joints)


def design_values(result: IdentificationResult, cad: RobotModel) -> Array:
    """Return the base parameters that another description of the same robot gives, shape (p,).

    NaN where it is silent.

    Raises ResultError where the two differ in joints or geometry, since base parameters then mean
    different things.
    """
    if cad.n_joints != result.model.n_joints:
        raise ResultError(
            f"{cad.name} has {cad.n_joints} joints, the result of {result.robot} has"
            f" {result.model.n_joints}"
        )
    ours, theirs = result.model.geometry, cad.geometry
    for what in (
        "parent",
        "revolute",
        "before_rotation",
        "before_translation",
        "after_rotation",
        "after_translation",
    ):
        one, two = (
            np.asarray(getattr(ours, what), dtype=np.float64),
            np.asarray(getattr(theirs, what), dtype=np.float64),
        )
        off = np.abs(one - two).reshape(len(one), -1).max(axis=1)
        worst = int(np.argmax(off))
        if off[worst] > 1e-6:
            raise ResultError(
                f"{cad.name} and {result.robot} differ in geometry: {what.replace('_', ' ')} of"
                f" joint {result.joint_names[worst]!r} by {off[worst]:.3g}; compare descriptions"
                " with the same joint frames, or identify with the other one"
            )
    return described_values(cad, result.base)


def _drive_torque(result: IdentificationResult, samples: Samples) -> Array:
    """Return the filtered torque of the identified drive terms other than armature, (N, n).

    A term regrouped with others adds nothing.
    """
    drive = result.base.drive
    own = drive.without("armature", "motor_armature", "spring", "balancer")
    identified = {parameter.name: parameter.estimate for parameter in result.parameters}
    values = [
        identified.get(name, 0.0) for k in range(result.model.n_joints) for name in own.names(k + 1)
    ]
    state = (samples.q, samples.qd, samples.qdd)
    load = (
        inverse_dynamics(carrying(result.model, result.base, result.estimates), *state)
        if own.needs_load
        else None
    )
    return samples.filtered(
        drive_torque(own, values, *state, load=load, shares=result.model.motor_shares)
    )
