"""Joint torque sensors and motor torques recorded together: links, gears and rotors."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from asbuilt.arrays import Array, Indices
from asbuilt.description.model import RobotModel
from asbuilt.dynamics import BaseParameters, DriveSet, StandardParameter, find_base_parameters
from asbuilt.dynamics.base.symbols import Polynomial
from asbuilt.dynamics.drives.torque import list_coupled_motor_terms
from asbuilt.dynamics.regressor import RegressorPlan
from asbuilt.errors import UsageError
from asbuilt.experiment.signal.samples import Samples
from asbuilt.findings import Cure, Finding, join_names
from asbuilt.identification.estimators.least_squares import fit_least_squares
from asbuilt.identification.information.estimate import Estimate
from asbuilt.identification.information.rows import RowBlock, divide_into_blocks
from asbuilt.identification.information.square_root_information import (
    SquareRootInformation,
    reduce_rows,
)
from asbuilt.identification.uncertainty.uncertainty import Uncertainty, estimate_block_uncertainty

LINK_SIDE = DriveSet.parse("viscous,coulomb,offset")
MOTOR_SIDE = DriveSet.parse("armature,viscous,coulomb,offset")


# When the scale of a motor's torque is fitted.

# Standard errors by which it must differ from 1; one joint in 400 does by chance
SCALE_SIGMAS = 3.0
# Difference from 1 below which it does not matter: torque constants are known to 1 % at best
SCALE_SMALLEST = 0.01
# Fits of the scales, each linear about the one before; errors square from round to round
SCALE_ROUNDS = 3


@dataclass(frozen=True, slots=True, eq=False)
class TwoChannelEstimate:
    """Hold the parameters of links, link-side drives and motor side of n joints.

    Parameters
    ----------
    robot, joint_names
        The robot.
    names, units, values, std_errors
        Base parameters of links and link-side drives, then of the motor side.
    of_motor_side
        Which parameters are of the motor side.
    rms_sensor, rms_motor
        Torque errors of the two channels (n,).
    scales, scale_errors
        Torque of each motor channel relative to its sensor (n,), with standard errors; where it
        differs from 1, motors were divided by it, and all errors count that it was fitted.
    estimate
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
    scales: Array
    scale_errors: Array
    estimate: Estimate

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Motors whose torque has another scale than the sensors', as one finding."""
        listed = [
            f"{name} {scale:.3f} +/- {error:.3f}"
            for name, scale, error in zip(
                self.joint_names, self.scales.tolist(), self.scale_errors.tolist(), strict=True
            )
            if _differs(scale, error)
        ]
        if not listed:
            return ()
        message = (
            "motor torques have another scale than the sensors', friction and armature of the"
            f" motors apart: {join_names(listed)} times"
        )
        cure = Cure("divide the motor gains by this, or look for friction that grows with load")
        return (Finding("motor_scale", "warning", message, cure=cure),)


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
        and the terms of motors that several joints share.

    Raises
    ------
    UsageError
        If the instants of the channels differ, or a term depends on load or is not linear.
    """
    sensors, motors = (each if isinstance(each, Sequence) else [each] for each in (sensor, motor))
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
        DriveSet((*MOTOR_SIDE.terms, *list_coupled_motor_terms(model).terms))
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
    acting = _find_acting(model, ahead)
    base = find_base_parameters(model, link_side)
    links = RegressorPlan.of(model, link_side, base.columns, spare_rows=1)
    drives = RegressorPlan.of(model, ahead, 10 * model.n_links + acting, spare_rows=1)
    fit = partial(_fit_channels, base, links, drives, sensors, motors)
    scales, errors, (both, information, estimate, uncertainty) = _fit_scales(
        fit, model.n_joints, base.n_base
    )
    rms = np.sqrt(information.residual_energy(estimate.beta) / information.n_samples)
    n = model.n_joints
    kept = base.n_base + len(acting)
    return TwoChannelEstimate(
        robot=model.name,
        joint_names=model.joint_names,
        names=both.names[:kept],
        units=both.units[:kept],
        of_motor_side=np.arange(kept) >= base.n_base,
        values=estimate.beta[:kept],
        std_errors=uncertainty.std_errors[:kept],
        rms_sensor=rms[:n],
        rms_motor=rms[n:],
        scales=scales,
        scale_errors=errors,
        estimate=estimate,
    )


_Fitted = tuple[BaseParameters, SquareRootInformation, Estimate, Uncertainty]


def _fit_channels(
    base: BaseParameters,
    links: RegressorPlan,
    drives: RegressorPlan,
    sensors: Sequence[Samples],
    motors: Sequence[Samples],
    scales: Array,
    scaled: Sequence[int],
    beta: Array | None,
) -> _Fitted:
    """Fit both channels, given scales of the motors and the joints whose scale is a parameter.

    Such scales multiply the torque of links `beta` (p,).
    """
    both = _combine_sides(base, drives, scaled)
    divided = [replace(motor, tau=motor.tau / scales) for motor in motors]
    information = _join_channels(both, links, drives, sensors, divided, scaled, beta)
    estimate = fit_least_squares(information, weights="joint", prior=np.zeros(both.n_base))
    return both, information, estimate, estimate_block_uncertainty(information, estimate)


def _join_channels(
    both: BaseParameters,
    links: RegressorPlan,
    drives: RegressorPlan,
    sensors: Sequence[Samples],
    motors: Sequence[Samples],
    scaled: Sequence[int],
    beta: Array | None,
) -> SquareRootInformation:
    """Return the information of both channels; scales multiply the torque of links `beta`."""
    model = links.model
    n = links.model.n_joints
    p = len(links.columns)
    first = p + len(drives.columns)
    own_scale = [[first + scaled.index(k)] if k in scaled else [] for k in range(n)]
    support = (
        *links.support,
        *(
            np.concatenate([own, p + extra, np.array(scale, dtype=np.intp)])
            for own, extra, scale in zip(links.support, drives.support, own_scale, strict=True)
        ),
    )
    names = (
        *(f"{name} sensor" for name in model.joint_names),
        *(f"{name} motor" for name in model.joint_names),
    )

    def rows() -> Iterator[RowBlock]:
        pairs = zip(
            divide_into_blocks(model, sensors), divide_into_blocks(model, motors), strict=True
        )
        for seen, driven in pairs:
            motor_rows = []
            both_sides = zip(driven.rows(links), driven.rows(drives), strict=True)
            for k, (behind, ahead) in enumerate(both_sides):
                columns = behind[:-1]
                moved = (
                    [] if beta is None or k not in scaled else [beta[links.support[k]] @ columns]
                )
                motor_rows.append(np.vstack([columns, ahead[:-1], *moved, ahead[-1:]]))
            yield RowBlock((*seen.rows(links), *motor_rows), seen.time, seen.seconds)

    return reduce_rows(both, names, support, rows())


def _fit_scales(
    fit: Callable[[Array, Sequence[int], Array | None], _Fitted], n: int, first: int
) -> tuple[Array, Array, _Fitted]:
    """Return scales of the motors, their errors, and the fit in which those that differ are free.

    The scale of a motor multiplies the torque behind it, which is linearised about the links of
    the fit before; `first` is the number of their parameters.
    """
    found = fit(np.ones(n), (), None)
    scales = np.ones(n)
    errors = np.full(n, np.nan)
    scaled: tuple[int, ...] = tuple(range(n))
    for _ in range(SCALE_ROUNDS):
        divisors = np.where(np.isin(np.arange(n), scaled), scales, 1.0)
        found = fit(divisors, scaled, found[2].beta[:first])
        change = found[2].beta[-len(scaled) :]
        error = found[3].std_errors[-len(scaled) :]
        chosen = list(scaled)
        errors[chosen] = divisors[chosen] * error
        scales[chosen] = divisors[chosen] * (1.0 + change)
        scaled = tuple(k for k in scaled if _differs(scales[k], errors[k]))
        if not scaled:
            return scales, errors, fit(np.ones(n), (), None)
    return scales, errors, found


def _differs(scale: float, error: float) -> bool:
    return abs(scale - 1.0) > max(SCALE_SIGMAS * error, SCALE_SMALLEST)


def _find_acting(model: RobotModel, motor_side: DriveSet) -> Indices:
    """Return which drive parameters of the motor side act; single motors have no coupled terms."""
    coupled = np.any(model.motor_shares != 0.0, axis=1)
    acts = [
        term.is_at(k) and (bool(coupled[k]) or not term.of_motor)
        for k in range(model.n_joints)
        for term in motor_side.terms
        for _ in term.symbols
    ]
    return np.flatnonzero(acts)


def _combine_sides(
    base: BaseParameters, drives: RegressorPlan, scaled: Sequence[int]
) -> BaseParameters:
    """Return the base parameters, the independent ones of the motor side, and scales of motors."""
    every = [
        (f"{symbol}m{number}", unit)
        for number, joint in enumerate(drives.model.joints, start=1)
        for symbol, unit in zip(drives.drive.symbols, drives.drive.units(joint.kind), strict=True)
    ]
    acting = [every[j] for j in drives.columns - 10 * drives.model.n_links]
    added = [*acting, *((f"scalem{k + 1}", "1") for k in scaled)]
    names, units = (tuple(each[i] for each in added) for i in (0, 1))
    first = base.n_standard
    p = base.n_base
    m = len(names)
    regrouping = np.zeros((p + m, first + m))
    regrouping[:p, :first] = base.regrouping
    regrouping[p:, first:] = np.eye(m)
    why = "the difference between motor and sensor torque holds the motor side alone"
    identifiable = [
        StandardParameter(first + j + 1, name, "identifiable", (first + j + 1,), f"{name}: {why}")
        for j, name in enumerate(names)
    ]
    alone = [{first + j: Polynomial.number(1.0)} for j in range(m)]
    return replace(
        base,
        standard_names=base.standard_names + names,
        standard_units=base.standard_units + units,
        columns=np.concatenate([base.columns, np.arange(first, first + m)]),
        regrouping=regrouping,
        symbolic_rows=partial(list, [*base.symbolic_rows(), *alone]),
        classified=partial(tuple, [*base.standard, *identifiable]),
    )
