"""The free base of a robot in a log, and checks of its velocities, orientation and contacts.

The pose of the base and the positions of the joints say how fast the feet move, and a foot that
stands does not. So poses, velocities and contact flags have to agree, and the reading of a log
under which they agree much better names what is wrong with it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import numpy as np

from asbuilt.arrays import Array, Mask
from asbuilt.description.model import RobotModel
from asbuilt.description.structure.free_base import AXES
from asbuilt.dynamics.reactions import contact_basis, contact_jacobians
from asbuilt.experiment.free_base.columns import (
    add_base_coordinates,
    base_rotations,
    find_base_spin,
    with_base_columns,
    yaw_pitch_roll,
)
from asbuilt.experiment.free_base.feet import (
    check_forces,
    collect_measured_wrenches,
    estimate_rolling_radii,
    find_better_reading,
    set_rolling_radii,
)
from asbuilt.experiment.free_base.ground import Ground, measure_ground
from asbuilt.experiment.logs.formats.log_format import LogTable
from asbuilt.experiment.logs.sheet import RecordingSheet
from asbuilt.experiment.quality.torque_fit import COMPARED_TORQUES
from asbuilt.experiment.recording import Recording
from asbuilt.findings import Cure, Finding, join_names, undesigned

# When a free base is read wrongly: own choices, tested on virtual and real robots.

LONGEST_SHIFT = 0.1
"""Longest time [s] by which contact flags are shifted."""
SHIFT = 0.02
"""Least time [s] by which they are late if they are."""
SLIP = 0.3
"""Speed [m/s] above which a contact that is closed slips."""
OFTEN = 0.1
"""Part of the time in which it slips from which that is said."""
GRAVITY_IN_RATES = 5.0
"""Least mean [m/s^2] by which accelerations that hold gravity differ from the velocity's rates."""
OTHER_RADIUS = 0.3
"""Part by which stated radii are off from those on which feet roll."""
SAMPLES = 20_000
"""Samples of a log that are looked at."""
POSTURES = 200
"""Samples of them for the equations that contacts leave."""
WITH_EQUATIONS = 0.02
"""Part of the postures that have some, from which contacts leave equations."""


def check_free_base(model: RobotModel, recording: Recording) -> tuple[Finding, ...]:
    """Return what is wrong with base and contacts of a recording."""
    part = recording.taken(slice(0, SAMPLES))
    if part.n_samples < 10 or not np.all(np.isfinite(part.q)):
        return ()
    rates = np.gradient(part.q, part.t, axis=0)
    found = [*_check_velocities(model, part, rates), *_check_accelerations(model, part)]
    found += check_forces(model, part, rates)
    if model.contacts and part.contact is not None:
        found += _check_equations(model, part)
        found += _check_contacts(model, part, rates)
    return tuple(found)


def _check_equations(model: RobotModel, recording: Recording) -> Iterator[Finding]:
    """Find contacts whose unmeasured forces can be any torque at all, so that none says anything.

    A flat contact has six components: two of them hold all equations of two legs of six joints and
    a base, four of legs of three joints hold more than there are.
    """
    measured = {place.frame for place in collect_measured_wrenches(recording, model)}
    unknown = [contact.frame not in measured for contact in model.contacts]
    rows = slice(0, None, -(-recording.n_samples // POSTURES))
    if recording.contact is None or not any(unknown):
        return
    closed = recording.contact[rows] * unknown
    basis = contact_basis(model, recording.q[rows], closed)
    taken = np.count_nonzero(np.linalg.norm(basis, axis=1) > 0.5, axis=0)
    if np.mean(taken < model.n_joints) > WITH_EQUATIONS:
        return
    flat = [contact.frame for contact in model.contacts if contact.flat]
    yield Finding(
        "contacts_hold_everything",
        "error",
        f"unmeasured forces at the closed contacts may be any torque of the {model.n_joints}"
        " coordinates of base and joints, so that no equation is left"
        + (f": {join_names(flat)} are flat and have three moments each" if flat else ""),
        Cure(
            "state feet that touch at a point, or are balls of some radius, as such and not as"
            " flat, log the forces, or lift feet"
        ),
    )


def _check_velocities(model: RobotModel, recording: Recording, rates: Array) -> Iterator[Finding]:
    """Find velocities in other axes, and quaternions in another order."""
    q = recording.q
    qd = recording.qd
    if qd is None or model.n_floating != 6:
        return
    R = base_rotations(q)
    in_world = "in world axes"

    def off_linear(velocity: Array) -> float:
        return _measure_mean_square(velocity - rates[:, :3])

    as_logged = np.einsum("sji,sj->si", R, qd[:, :3])
    if find_better_reading(off_linear, qd[:, :3], [(in_world, as_logged)]):
        yield _report_wrong_axes("base_vx .. base_vz")
    logged = find_base_spin(q, qd)
    spin = find_base_spin(q, rates)
    readings = {in_world: np.einsum("sij,sj->si", R, spin)}
    for order, angles in _list_other_readings(R):
        turned = np.gradient(np.unwrap(angles, axis=0), recording.t, axis=0)
        readings[order] = find_base_spin(
            np.hstack([q[:, :3], angles]), np.hstack([rates[:, :3], turned])
        )
    best = find_better_reading(
        lambda spin: _measure_mean_square(logged - spin), spin, readings.items()
    )
    if best == in_world:
        yield _report_wrong_axes("base_wx .. base_wz")
    elif best is not None:
        yield Finding(
            "quaternion_order",
            "error",
            f"the quaternion of the base is {best}: so read, it turns as base_wx .. base_wz say,"
            " and as x y z w it does not",
            Cure("write it as base_qx base_qy base_qz base_qw, base axes to world axes"),
        )


def _report_wrong_axes(columns: str) -> Finding:
    return Finding(
        "base_velocity_axes",
        "error",
        f"{columns} are in world axes: so read, they agree with the pose, and in base axes, which"
        " are expected, they do not",
        Cure("turn them into base axes, or leave them out, and they are derived from the pose"),
    )


def _list_other_readings(R: Array) -> Iterator[tuple[str, Array]]:
    """Yield other readings of quaternions that were read as x y z w, and their angles."""
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 - light start

    x, y, z, w = Rotation.from_matrix(R).as_quat().T
    yield "w x y z", yaw_pitch_roll(np.stack([y, z, w, x], axis=1))
    yield "the inverse (world axes to base axes)", yaw_pitch_roll(np.stack([-x, -y, -z, w], axis=1))


def _check_accelerations(model: RobotModel, recording: Recording) -> Iterator[Finding]:
    """Find accelerations that hold gravity, as an inertial sensor measures them."""
    if recording.qdd is None or recording.qd is None or model.n_floating != 6:
        return
    derived = np.gradient(recording.qd[:, :3], recording.t, axis=0)
    off = np.mean(recording.qdd[:, :3] - derived, axis=0)
    if np.linalg.norm(off) > GRAVITY_IN_RATES:
        yield Finding(
            "base_acceleration_gravity",
            "error",
            f"base_ax .. base_az are on average {np.linalg.norm(off):.2g} m/s^2 away from the"
            " rates of base_vx .. base_vz; an inertial sensor measures gravity too",
            Cure("take gravity out, or leave them out, and they are derived from the velocities"),
        )


def _check_contacts(model: RobotModel, recording: Recording, rates: Array) -> Iterator[Finding]:
    """Find contacts that never close, that slip, and flags that come early or late."""
    assert recording.contact is not None
    yield from _report_radii(model, recording)
    closed = recording.contact > 0.5
    names = [contact.frame for contact in model.contacts]
    never = [
        name
        for name, own in zip(names, closed.T, strict=True)
        if not own.any() and f"contact_{name}_fx" not in recording.extra
    ]
    if never and not _is_falling(model, recording):
        all_open = len(never) == len(names)
        yield Finding(
            "contact_never_closes",
            "error" if all_open else "warning",
            f"{join_names([f'contact_{name}' for name in never])} never close"
            + (", and the base does not fall" if all_open else ""),
            Cure("check the flags: 1 where the contact is closed"),
        )
    speed = np.stack(
        [
            np.linalg.norm(np.einsum("sij,sj->si", J[:, :3], rates), axis=1)
            for J in contact_jacobians(model, recording.q)
        ],
        axis=1,
    )
    late = _measure_flag_delay(speed, closed, recording.rate)
    if late:
        yield Finding(
            "contact_timing",
            "error",
            f"contact flags come {1e3 * abs(late):.0f} ms {'late' if late > 0 else 'early'}: feet"
            " stand still while their contact is closed if they are shifted by that",
            Cure("shift the columns contact_NAME, or the clock of what writes them"),
        )
        return
    for k, name in enumerate(names):
        inner = _mark_inside(closed[:, k], round(0.03 * recording.rate))
        slips = float(np.mean(speed[inner, k] > SLIP)) if inner.any() else 0.0
        if slips > OFTEN:
            yield Finding(
                "contact_slips",
                "warning",
                f"{name} moves faster than {SLIP:g} m/s in {100 * slips:.0f} % of the"
                " time in which its contact is closed; forces there are projected away all the"
                " same, and what an open contact would say is lost",
                Cure("check its flags"),
            )


def _report_radii(model: RobotModel, recording: Recording) -> Iterator[Finding]:
    """Report on which radius feet roll, and radii that were stated otherwise."""
    rolling = []
    other = []
    for contact, radius in zip(
        model.contacts, estimate_rolling_radii(model, [recording]), strict=True
    ):
        if radius is None:
            continue
        stated = contact.radius or 0.0
        text = f"{contact.frame} {1e3 * radius:.3g} mm"
        if contact.flat or abs(stated - radius) > OTHER_RADIUS * max(stated, radius):
            kind = "a sole" if contact.flat else f"{1e3 * stated:.3g} mm"
            other.append(f"{text} (stated: {kind})")
        else:
            rolling.append(text)
    if rolling:
        yield Finding(
            "feet_roll",
            "info",
            f"in stance feet move as balls roll, on radii of {join_names(rolling)}: the ground is"
            " taken"
            " to touch them so far below their frames",
            Cure("state other radii [m] after the names, or 0 for points: FL_FOOT:0.02"),
        )
    if other:
        yield Finding(
            "contact_radius",
            "warning",
            f"in stance feet move as balls roll on radii of {join_names(other)}; a force at another"
            " point has another moment",
            Cure("state these radii, or leave them out, and they are taken from the log"),
        )


def _is_falling(model: RobotModel, recording: Recording) -> bool:
    """Return whether the base falls freely on average, as it does where nothing touches it."""
    t = recording.t - recording.t[0]
    up = -model.gravity / max(float(np.linalg.norm(model.gravity)), 1e-9)
    places = 3 if model.n_floating == len(AXES) else 2  # a planar base has no height of its own
    height = recording.q[:, :places] @ up[:places]
    fall = -2.0 * np.polyfit(t, height, 2)[0]
    return bool(fall > 0.5 * np.linalg.norm(model.gravity))


def _measure_flag_delay(speed: Array, closed: Mask, rate: float) -> float:
    """Return by how long [s] flags come late (early if negative), 0 if they are right.

    Speeds beyond nine tenths of them count as that, since feet in the air have any.
    """
    capped = np.minimum(speed, np.quantile(speed, 0.9, axis=0)) ** 2
    changing = [k for k in range(closed.shape[1]) if closed[:, k].any() and not closed[:, k].all()]
    most = round(LONGEST_SHIFT * rate)
    if not changing or len(closed) < 4 * most:
        return 0.0
    inner = slice(most, len(closed) - most)

    def disagreement(shift: int) -> float:
        moved = np.roll(closed, -shift, axis=0)[inner]
        return float(sum(capped[inner, k][moved[:, k]].mean() for k in changing))

    shifts = range(-most, most + 1)
    late = (find_better_reading(disagreement, 0, zip(shifts, shifts, strict=True)) or 0) / rate
    return late if abs(late) >= SHIFT else 0.0


def _mark_inside(closed: Mask, margin: int) -> Mask:
    """Return which samples are closed and `margin` away from any that is open."""
    reach = np.convolve((~closed).astype(np.float64), np.ones(2 * margin + 1), mode="same")
    return np.asarray(reach == 0.0, dtype=np.bool_)


def _measure_mean_square(x: Array) -> float:
    """Return the mean square, single outliers cut off."""
    squares = np.sum(x * x, axis=1)
    return float(np.minimum(squares, np.percentile(squares, 99.0)).mean())


OF_HELD_BASE = (*COMPARED_TORQUES, "rank_deficient", "weak_excitation")
"""Codes of findings about a robot that is held: on legs contacts push it, and excite it."""


@dataclass(frozen=True)
class FloatingRoot:
    """Say that the base moves: a log has its pose or an inertial sensor, and maybe contacts."""

    model: RobotModel

    moves: ClassVar[Literal[True]] = True

    def complete(
        self,
        recording: Recording,
        table: LogTable,
        sheet: RecordingSheet,
        finish: Callable[[Recording], Recording],
    ) -> Recording:
        """Return a finished recording with the coordinates of the base before the joints."""
        recording, sensor = with_base_columns(recording, table, sheet, self.model)
        return add_base_coordinates(finish(recording), self.model, sensor)

    def settle(self, model: RobotModel, recordings: Sequence[Recording]) -> RobotModel:
        """Return the robot with the radii on which its feet roll."""
        return set_rolling_radii(model, recordings) if model.has_reactions else model

    def hold(self, recording: Recording) -> tuple[RobotModel, Recording]:
        """Return robot and recording with the base held."""
        held = self.model.on_held_base
        driven = recording.reordered(held.joint_names)
        return held, replace(driven, undriven=(), contact=None)

    def add_findings(
        self, found: Sequence[Finding], recording: Recording, *, has_clock: bool
    ) -> tuple[Finding, ...]:
        """Return findings on the held robot, and those on base and contacts.

        What compares torques with the model's is left out, since contacts push the robot. Without
        a clock base and contacts are not checked.
        """
        # Cures name a motion designed for a held base, which one on legs cannot use.
        kept = (
            replace(finding, cure=finding.cure and undesigned(finding.cure))
            for finding in found
            if finding.code not in OF_HELD_BASE
        )
        return (*kept, *(check_free_base(self.model, recording) if has_clock else ()))

    def measure_ground(self, recording: Recording, starts: Array, horizon: float) -> Ground | None:
        """Return the ground in windows (W,) of a length [s]; None where nothing touches it."""
        return measure_ground(self.model, recording, starts, horizon)

    def measure_errors(
        self, measured: Sequence[Array], simulated: Sequence[Array]
    ) -> tuple[float, float] | None:
        """Return the root mean square of distances [m] and tilts [rad] between the bases."""
        if self.model.n_floating != len(AXES):
            return None
        q = [
            np.concatenate([x[:, 1:].reshape(-1, x.shape[2]) for x in y])
            for y in (measured, simulated)
        ]
        places, verticals = (
            np.linalg.norm(np.subtract(*pair), axis=1)
            for pair in ([x[:, :3] for x in q], [base_rotations(x)[:, 2] for x in q])
        )
        # Chord between unit vectors: 2 arcsin of its half is the angle.
        tilts = 2.0 * np.arcsin(np.clip(0.5 * verticals, 0.0, 1.0))
        return float(np.sqrt(np.mean(places**2))), float(np.sqrt(np.mean(tilts**2)))
