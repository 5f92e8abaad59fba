"""Joint torque sensors and motor torques recorded together: links, gears and rotors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from asbuilt.arrays import Array, Indices
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import BaseParameters, find_base_parameters
from asbuilt.dynamics.base.identifiability import StandardParameter
from asbuilt.dynamics.drives.defaults import coupled_motor_terms
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.dynamics.regressor import RegressorPlan
from asbuilt.errors import ResultError, UsageError
from asbuilt.identification.errors.uncertainty import Uncertainty, block_uncertainty
from asbuilt.identification.estimators.least_squares import fit_least_squares
from asbuilt.identification.information.estimate import Estimate
from asbuilt.identification.information.rows import sample_blocks
from asbuilt.identification.information.square_root_information import SquareRootInformation
from asbuilt.identification.information.triangular import GrowingFactor

if TYPE_CHECKING:
    from asbuilt.experiment.signal.samples import Samples


LINK_SIDE = DriveSet.parse("viscous,coulomb,offset")
MOTOR_SIDE = DriveSet.parse("armature,viscous,coulomb,offset")


@dataclass(frozen=True, slots=True, eq=False)
class TwoChannelEstimate:
    """Hold the parameters of links, link-side drives and motor side of n joints.

    Parameters
    ----------
    robot, joint_names
        The robot.
    names, units, values, std_errors
        Base parameters of links and link-side drives, then those of the motor side.
    of_motor_side
        Which parameters are of the motor side.
    rms_sensor, rms_motor
        Torque errors of the two channels (n,).
    estimate, uncertainty, information
        The fit behind.
    """

    robot: str
    joint_names: tuple[str, ...]
    names: tuple[str, ...]
    units: tuple[str, ...]
    of_motor_side: NDArray[np.bool_]
    values: Array
    std_errors: Array
    rms_sensor: Array
    rms_motor: Array
    estimate: Estimate
    uncertainty: Uncertainty
    information: SquareRootInformation

    def value(self, name: str) -> float:
        """Return the value of one parameter; raises `ResultError` for an unknown name."""
        if name not in self.names:
            raise ResultError(f"unknown parameter {name!r}; available: {', '.join(self.names)}")
        return float(self.values[self.names.index(name)])


def identify_two_channels(
    model: RobotModel,
    sensor: Samples | Sequence[Samples],
    motor: Samples | Sequence[Samples],
    *,
    link_side: DriveSet = LINK_SIDE,
    motor_side: DriveSet | None = None,
) -> TwoChannelEstimate:
    """Identify links, link-side friction and motor side from torques on both sides of the gears.

    `tau_sensor = Y beta + link side`, `tau_motor = tau_sensor + motor side`: bearings and links act
    on both, armature, gear friction and motor offset on the motor's torque alone. The difference
    determines every parameter of the motor side that acts, named with an m (`Iam1`, `Fvm1`; `Iam`
    of coupled motors becomes `Iamm`). Each joint and channel has its own weight.

    Parameters
    ----------
    model
        The robot as designed.
    sensor, motor
        Samples of joint torque sensors and of motor torques, in pairs at the same instants.
    link_side
        Drive terms on the link side.
    motor_side
        Drive terms on the motor side; by default armature, viscous and Coulomb friction and offset,
        and those of motors that several joints share.

    Raises
    ------
    UsageError
        If the instants of the channels differ, or a term depends on load or is not linear.
    """
    sensors, motors = (
        list(each) if isinstance(each, Sequence) else [each] for each in (sensor, motor)
    )
    if len(sensors) != len(motors) or not sensors:
        raise UsageError(
            f"each recording needs both channels, got {len(sensors)} of sensors and {len(motors)}"
            " of motors"
        )
    for one, other in zip(sensors, motors, strict=True):
        if (
            one.t.shape != other.t.shape
            or np.abs(one.t - other.t).max() > 1e-9
            or one.segments != other.segments
        ):
            raise UsageError(
                f"{one.source} and {other.source} are not of the same instants: {len(one.t)}"
                f" samples up to {one.t[-1]:g} s and {len(other.t)} up to {other.t[-1]:g} s. Log"
                " sensors and motors together, with the same time stamps, and prepare both with"
                " the same signal chain"
            )
    ahead = (
        DriveSet((*MOTOR_SIDE.terms, *coupled_motor_terms(model).terms))
        if motor_side is None
        else motor_side
    )
    for side in (link_side, ahead):
        side.check_joints(model.n_joints)
        if not side.is_linear:
            raise UsageError(
                "two channels need nonlinear parameters that are stated, such as"
                f" stribeck:velocity=0.05, got {side}"
            )
    if link_side.needs_load or ahead.needs_load:
        raise UsageError("two channels need drive terms that do not depend on load")
    acting = _acting(model, ahead)
    both = _both_sides(model, find_base_parameters(model, link_side), ahead, acting)
    information = _joined(model, both, link_side, ahead, acting, sensors, motors)
    estimate = fit_least_squares(information, weights="joint", prior=np.zeros(both.n_base))
    uncertainty = block_uncertainty(information, estimate)
    rms = np.sqrt(information.residual_energy(estimate.beta) / information.n_samples)
    n = model.n_joints
    return TwoChannelEstimate(
        robot=model.name,
        joint_names=model.joint_names,
        names=both.names,
        units=both.units,
        of_motor_side=np.arange(both.n_base) >= both.n_base - len(acting),
        values=estimate.beta,
        std_errors=uncertainty.std_errors,
        rms_sensor=rms[:n],
        rms_motor=rms[n:],
        estimate=estimate,
        uncertainty=uncertainty,
        information=information,
    )


def _acting(model: RobotModel, motor_side: DriveSet) -> Indices:
    """Return which drive parameters of the motor side act; single motors have no coupled terms."""
    coupled = np.any(model.motor_shares != 0.0, axis=1)
    acts = [
        term.is_at(k) and (bool(coupled[k]) or not term.of_motor)
        for k in range(model.n_joints)
        for term in motor_side.terms
        for _ in term.symbols
    ]
    return np.flatnonzero(acts)


def _both_sides(
    model: RobotModel, base: BaseParameters, motor_side: DriveSet, acting: Indices
) -> BaseParameters:
    """Return the base parameters followed by the independent ones of the motor side."""
    every = [
        f"{symbol}m{number}"
        for number in range(1, model.n_joints + 1)
        for symbol in motor_side.symbols
    ]
    every_unit = [unit for joint in model.joints for unit in motor_side.units(joint.kind)]
    names, units = tuple(every[j] for j in acting), tuple(every_unit[j] for j in acting)
    first, p, m = base.n_standard, base.n_base, len(names)
    regrouping = np.zeros((p + m, first + m))
    regrouping[:p, :first], regrouping[p:, first:] = base.regrouping, np.eye(m)
    why = "the difference between motor and sensor torque holds the motor side alone"
    return replace(
        base,
        standard_names=base.standard_names + names,
        standard_units=base.standard_units + units,
        columns=np.concatenate([base.columns, np.arange(first, first + m)]),
        regrouping=regrouping,
        expressions=base.expressions + names,
        symbolic=base.symbolic + names,
        standard=base.standard
        + tuple(
            StandardParameter(
                first + j + 1, name, "identifiable", (first + j + 1,), f"{name}: {why}"
            )
            for j, name in enumerate(names)
        ),
    )


def _joined(
    model: RobotModel,
    both: BaseParameters,
    link_side: DriveSet,
    motor_side: DriveSet,
    acting: Indices,
    sensors: Sequence[Samples],
    motors: Sequence[Samples],
) -> SquareRootInformation:
    n = model.n_joints
    p = both.n_base - len(acting)
    links = RegressorPlan.of(model, link_side, both.columns[:p], spare_rows=1)
    drives = RegressorPlan.of(model, motor_side, 10 * n + acting, spare_rows=1)
    support = (
        *links.support,
        *(
            np.concatenate([own, p + extra])
            for own, extra in zip(links.support, drives.support, strict=True)
        ),
    )
    factors: list[list[Array]] = [[] for _ in support]
    sums, times = [], []
    for seen, driven in zip(
        sample_blocks(model, sensors), sample_blocks(model, motors), strict=True
    ):
        growing = [GrowingFactor(len(columns) + 1) for columns in support]
        total = np.zeros(2 * n)
        for behind, links_again, ahead in zip(
            seen.chunks(links), driven.chunks(links), driven.chunks(drives), strict=True
        ):
            for k in range(n):
                growing[k].append(behind[k])
                growing[n + k].append(np.vstack([links_again[k][:-1], ahead[k]]))
                total[k] += behind[k][-1].sum()
                total[n + k] += ahead[k][-1].sum()
        for kept, grown in zip(factors, growing, strict=True):
            kept.append(grown.factor())
        sums.append(total)
        times.append(seen.time)
    names = (
        *(f"{name} sensor" for name in model.joint_names),
        *(f"{name} motor" for name in model.joint_names),
    )
    return SquareRootInformation(
        both,
        names,
        support,
        tuple(np.array(each) for each in factors),
        np.array(sums),
        tuple(times),
    )
