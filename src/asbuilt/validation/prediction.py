"""Validation of an identified model: torque measured, as built and by CAD, and a letter for it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics import (
    BaseParameters,
    described_drive,
    drive_torque,
    gravity_torque,
    inverse_dynamics,
)
from asbuilt.errors import ResultError, UsageError
from asbuilt.experiment.signal.samples import Samples
from asbuilt.identification import IdentificationResult, TorqueMetrics
from asbuilt.identification.bodies.cad_prior import design_values
from asbuilt.identification.result.torque_prediction import (
    Prediction,
    pair_with_measured,
    predict_in_spans,
    predict_torque,
)
from asbuilt.tables import format_share
from asbuilt.validation.carried_load import CarriedLoad
from asbuilt.validation.residuals import (
    ResidualAnalysis,
    VelocityCurve,
    analyse_residual,
    bin_by_velocity,
)

SAME_GEOMETRY = 1e-6
"""Largest difference of joint frames [rad or m] of two descriptions of one robot."""


@dataclass(frozen=True, eq=False, repr=False)
class Validation:
    """Hold the torques of a recording, all (N, n) at the times `t` (N,) of the filtered grid.

    `velocity` is the joint velocity there, `drive` the torque of the identified drive terms that
    follow velocity (friction, offset). `metrics_as_built` and `metrics_cad` measure the two
    predictions, `metrics_exported` the prediction of the robot which exports carry (None: unknown).
    `load` is what the recording carries and the model lacks (None: nothing, or a part of the
    training motion).
    Torques are in N m or N, as `units` says joint by joint.
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
    metrics_exported: TorqueMetrics | None = None
    load: CarriedLoad | None = None

    def __post_init__(self) -> None:
        for values in (self.t, self.velocity, self.measured, self.predicted, self.predicted_cad):
            values.setflags(write=False)
        self.drive.setflags(write=False)

    def __repr__(self) -> str:
        rms = ", ".join(f"{value:.3g}" for value in self.metrics_as_built.rms)
        return (
            f"<Validation on {self.source}: {len(self.t)} samples, relative torque error"
            f" {100 * self.metrics_as_built.relative_error:.2g} % as built,"
            f" {100 * self.metrics_cad.relative_error:.2g} % by CAD; RMS as built {rms}>"
        )

    @property
    def error(self) -> Array:
        """Measured torque minus the prediction as built, (N, n)."""
        return self.measured - self.predicted

    @property
    def friction(self) -> Array:
        """Measured torque minus the rigid-body part of the prediction as built, (N, n)."""
        return self.error + self.drive

    @cached_property
    def _residuals(self) -> ResidualAnalysis:
        return analyse_residual(self.t, self.error, self.joint_names)

    def residuals(self) -> ResidualAnalysis:
        """Analyse the error of the prediction as built."""
        return self._residuals

    def friction_curves(self) -> tuple[VelocityCurve, ...]:
        """Return the torque of the drives against velocity, one curve per joint."""
        return tuple(
            bin_by_velocity(qd, torque)
            for qd, torque in zip(self.velocity.T, self.friction.T, strict=True)
        )


def validate_samples(
    result: IdentificationResult, samples: Samples, *, cad: RobotModel | None = None
) -> Validation:
    """Predict a recording from the values as built and by design, through its filter.

    Parameters
    ----------
    result
        The identified robot.
    samples
        Prepared samples of a recording.
    cad
        Another description of the robot with the same geometry, in place of the result's own.
        Unknown design values count as zero. Damping, friction and armature that a description
        may state for a simulator's sake count if the recording is predicted better with them.

    Raises
    ------
    ResultError
        If joints or geometry do not fit.
    """
    design = result.cad_values if cad is None else derive_cad_values(result, cad)
    return predict_both(result.model, result.base, result.estimates, design, samples, cad=cad)


def predict_both(
    model: RobotModel,
    base: BaseParameters,
    estimates: Array,
    design: Array,
    samples: Samples,
    *,
    cad: RobotModel | None = None,
) -> Validation:
    """Predict a recording from base parameters (p,) as built and by design (NaN: zero).

    `cad` is the description of the design, None: `model`, without a tilt that was found.
    """
    as_built = predict_torque(model, base, estimates, samples)
    described = model.as_described if cad is None else cad
    by_design = _predict_under_gravity(
        model, base, np.nan_to_num(design, nan=0.0), samples, described
    )
    if not described.drives_by_design:
        # Damping and friction of a URDF or MJCF may be a simulator's; where they help they count.
        candidates = (by_design, _predict_described(described, samples))
        by_design = min(candidates, key=lambda candidate: candidate.metrics().relative_error)
    return Validation(
        source=samples.source,
        joint_names=model.joint_names,
        units=torque_units(model),
        t=as_built.t,
        velocity=samples.filtered(samples.qd),
        measured=as_built.measured,
        predicted=as_built.predicted,
        predicted_cad=by_design.predicted,
        drive=samples.filtered_spans(_predict_friction(model, base, estimates, samples)),
        metrics_as_built=as_built.metrics(),
        metrics_cad=by_design.metrics(),
    )


def _predict_under_gravity(
    model: RobotModel, base: BaseParameters, design: Array, samples: Samples, described: RobotModel
) -> Prediction:
    """Predict by base parameters under the gravity of a description."""
    # Gravity as described: the difference is linear, and added apart.
    turned = described.gravity - model.gravity
    if not turned.any():
        return predict_torque(model, base, design, samples)
    turning = described.with_gravity(turned)
    torque = (
        part + gravity_torque(turning, samples.q[span])
        for span, _, part in predict_in_spans(model, base, design, samples)
    )
    return pair_with_measured(model, samples, torque)


def validate_description(model: RobotModel, samples: Samples) -> TorqueMetrics:
    """Predict a recording with a robot as described, drives included, through its filter.

    Raises
    ------
    ResultError
        If joints do not fit.
    """
    return _predict_described(model, samples).metrics()


def _predict_described(model: RobotModel, samples: Samples) -> Prediction:
    if tuple(samples.joint_names) != model.joint_names:
        raise ResultError(
            f"the recording {samples.source!r} has joints {', '.join(samples.joint_names)};"
            f" {model.name} has {', '.join(model.joint_names)}"
        )
    drive, values = described_drive(model)
    shares = model.motor_shares

    def predict(span: slice) -> Array:
        state = samples.q[span], samples.qd[span], samples.qdd[span]
        load = inverse_dynamics(model, *state)
        return load + drive_torque(drive, values, *state, load=load, shares=shares)

    return pair_with_measured(model, samples, map(predict, samples.spans()))


def torque_units(model: RobotModel) -> tuple[str, ...]:
    """Return the unit of each joint's torque: N m if revolute, N if prismatic."""
    return tuple(joint.torque_unit for joint in model.joints)


def name_torque_unit(units: Iterable[str]) -> str:
    """Return the unit of torques of several joints together, both where only some of them slide.

    >>> name_torque_unit(["N m", "N", "N m"])
    'N m, N'
    """
    return ", ".join(sorted(set(units), reverse=True))


def derive_cad_values(result: IdentificationResult, cad: RobotModel) -> Array:
    """Return the base parameters by another description of the same robot, shape (p,), NaN unknown.

    Raises
    ------
    ResultError
        If the two differ in joints or geometry, since base parameters then mean different things.
    """
    if cad.n_joints != result.model.n_joints:
        raise ResultError(
            f"{cad.name} has {cad.n_joints} joints, the result of {result.robot} has"
            f" {result.model.n_joints}"
        )
    if not np.array_equal(cad.link_shares, result.model.link_shares):
        raise ResultError(
            f"in {cad.name} and in {result.robot} other joints follow others; compare descriptions"
            " with the same couplings"
        )
    ours = result.model.geometry
    theirs = cad.geometry
    names = result.model.tree.joint_names
    for what in (
        "parent",
        "revolute",
        "before_rotation",
        "before_translation",
        "after_rotation",
        "after_translation",
    ):
        one, two = (
            np.asarray(getattr(geometry, what), dtype=np.float64) for geometry in (ours, theirs)
        )
        off = np.abs(one - two).reshape(len(one), -1).max(axis=1)
        worst = int(np.argmax(off))
        if off[worst] > SAME_GEOMETRY:
            raise ResultError(
                f"{cad.name} and {result.robot} differ in geometry: {what.replace('_', ' ')} of"
                f" joint {names[worst]!r} by {off[worst]:.3g}; compare descriptions"
                " with the same joint frames, or identify with the other one",
                joint=names[worst],
                value=float(off[worst]),
            )
    return design_values(cad, result.base)


def predict_friction_torque(
    model: RobotModel, base: BaseParameters, estimates: Array, samples: Samples
) -> Array:
    """Return the torque (N, n) of the identified drive terms other than armature and springs.

    A parameter that is regrouped with others counts as zero.
    """
    torque = np.zeros(samples.q.shape)
    parts = _predict_friction(model, base, estimates, samples)
    for span, part in zip(samples.spans(), parts, strict=True):
        torque[span] = part
    return torque


def _predict_friction(
    model: RobotModel, base: BaseParameters, estimates: Array, samples: Samples
) -> Iterator[Array]:
    """Yield the torque of `predict_friction_torque` on each of the samples' spans, (L, n)."""
    springs = [term.key for term in base.drive.terms if term.by_position]
    friction = base.drive.without("armature", "motor_armature", *springs)
    identified = dict(zip(base.names, estimates.tolist(), strict=True))
    # A parameter that was regrouped has no value of its own.
    values = [
        identified.get(name, 0.0) for k in range(model.n_joints) for name in friction.names(k + 1)
    ]
    shares = model.motor_shares
    for span, rigid, _ in predict_in_spans(model, base, estimates, samples):
        state = samples.q[span], samples.qd[span], samples.qdd[span]
        load = rigid if friction.needs_load else None
        yield drive_torque(friction, values, *state, load=load, shares=shares)


LETTERS = (("A", 0.03), ("B", 0.06), ("C", 0.12), ("D", 0.25), ("E", 1.0))
"""Relative torque error `|tau - tau_hat| / |tau|` below which a model has each letter.

`A` is what is left on arms with joint torque sensors if the model has all that acts (LWR4+ on
another motion: 2 to 3 %); each further letter up to `D` allows twice as much. Predicting no torque
at all has an error of 1, so that `E` is better than that."""
NO_BETTER = "F"
"""The letter of a model that is no better than none."""


def choose_letter(error: float) -> str:
    """Return the letter of a relative torque error on motion that was not fitted.

    Raises
    ------
    UsageError
        If the error is no number of 0 or more.

    Examples
    --------
    >>> choose_letter(0.023), choose_letter(0.24), choose_letter(1.3)
    ('A', 'D', 'F')
    """
    if not error >= 0.0:
        raise UsageError(f"a relative torque error is 0 or more, got {error}", value=error)
    # The first limit that the error is below.
    return next((letter for letter, limit in LETTERS if error < limit), NO_BETTER)


def describe_letters() -> str:
    """Return what the letters mean, in a sentence."""
    (first, least), *graded, (last, _) = LETTERS
    more = ", ".join(f"{letter} {format_share(limit, 0)}" for letter, limit in graded)
    return (
        f"{first} within {format_share(least, 0)}, {more}, {last} better than no model,"
        f" {NO_BETTER} no better"
    )
