"""Checks of commanded positions against the positions that followed them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.drives.position_servo import PositionServo
from asbuilt.experiment.quality.passes import still_ranges
from asbuilt.experiment.quality.reductions import find_swapped_columns, normalise_columns
from asbuilt.experiment.quality.torque_fit import COMPARED_TORQUES
from asbuilt.experiment.recording import Recording, find_advancing_rows
from asbuilt.findings import Cure, Finding, join_names

SHEET_UNITS: Mapping[str, float] = MappingProxyType(
    {"deg": math.degrees(1.0), "mrad": 1000.0, "turn": 0.5 / math.pi}
)
"""Units of angles that a sheet may name, as numbers per radian."""
UNITS: Mapping[str, float] = MappingProxyType(
    {**SHEET_UNITS, "counts of 4096 per turn": 2048 / math.pi}
)


EXPLAINED = (
    *COMPARED_TORQUES,
    *("no_torque", "saturation", "servo_stiffness", "torque_limit", "torque_spikes"),
)
"""Codes of findings that wrong commands explain."""
WRONG_SCALE = (
    "the stiffness of the servo differs",
    Cure("check it, or leave it out, so that it is identified"),
)
"""What a wrong scale of torques that follow from commands looks like, and what to do."""
FOLLOWED = 0.9
LOST = 0.6
"""Correlations from which a position follows a command, and up to which it does not."""
LONGEST = 0.3
SEARCHED = 1.0
"""Longest lag [s] of a servo, and the longest that is searched, either way; slow servos, with a
limited goal, take longer than the first."""
EVERY_LAG = -SEARCHED, SEARCHED


@dataclass(frozen=True, slots=True)
class _Motion:
    """Positions and commands at a uniform rate, and the joints that are tested.

    `r[l, i, j]` is the correlation of the position of joint i with the command of joint j `lags[l]`
    seconds earlier, over the samples that all lags share.
    """

    names: tuple[str, ...]
    step: float
    q: Array
    u: Array
    lags: Array
    r: Array
    moving: list[int]
    constant: list[int]

    def best(self, i: int, j: int, within: tuple[float, float]) -> tuple[float, float]:
        """Return the largest correlation within these lags [s], and its lag."""
        inside = np.flatnonzero((self.lags >= within[0]) & (self.lags <= within[1]))
        k = inside[int(np.argmax(self.r[inside, i, j]))]
        return float(self.r[k, i, j]), float(self.lags[k])


def check_commands(model: RobotModel, recording: Recording) -> Iterator[Finding]:
    """Compare commands with positions, where torques are computed from both.

    A position servo moves its joint to where the command was a moment ago, by about as much.
    """
    if recording.command is None or recording.servo is None:
        return
    motion = _select_motion(model, recording)
    if motion is None:
        return
    if _is_position(recording, motion.moving):
        yield Finding(
            "command_is_position",
            "error",
            "the commands are the measured positions, so that they say nothing of the torque",
            Cure("log what was sent to the servos"),
        )
        return
    swapped = _find_swapped(motion)
    rest = [j for j in motion.moving if j not in swapped]
    found = [
        *_find_constant(motion),
        *_report_swapped(motion, swapped),
        *_find_wrong_units(motion, rest),
        *_find_flipped(motion, rest),
    ]
    found = found or [*_find_wrong_clock(motion)] or [*_find_lost(motion)]
    yield from found or _find_offset(model, recording.servo, motion)


def report_open_scale(model: RobotModel, recording: Recording, scale: float) -> Finding | None:
    """Return what the masses say of a stiffness that is not stated; None where it is.

    `scale` is the torque as logged per torque of the model.
    """
    servo = recording.servo
    if servo is None or not np.any(np.isnan(servo.kp)):
        return None
    return Finding(
        "servo_stiffness",
        "info",
        f"the stiffness of the position servo is not stated; the masses of {model.name} give"
        f" about {1.0 / scale:.2g} N m/rad",
        Cure("give the stiffness if it is known; else it is identified, with its error"),
    )


def _select_motion(model: RobotModel, recording: Recording) -> _Motion | None:
    """Return what is compared; None where too little moves or is known."""
    assert recording.command is not None
    t = recording.t
    q = recording.q
    u = recording.command
    # Rows without a value of any joint would shift correlations of the others.
    rows = find_advancing_rows(t, np.isfinite(t) & np.all(np.isfinite(q) & np.isfinite(u), axis=1))
    t = t[rows]
    q = q[rows]
    u = u[rows]
    if t.size < 4:
        return None
    # Signals are compared at 50 Hz, or at the rate of the log.
    step = max(1 / 50.0, float(np.median(np.diff(t))))
    at = np.arange(t[0], t[-1], step)
    # A command holds until the next one; positions are interpolated.
    last = np.searchsorted(t, at, side="right") - 1
    # Steps without a sample beyond which the log has a gap, which is left out.
    logged = at - t[last] <= 5.0 * step
    at = at[logged]
    last = last[logged]
    # Four times the lags that are searched, so that they share enough samples.
    if at.size * step < 4 * SEARCHED:
        return None
    q = np.column_stack([np.interp(at, t, x) for x in q.T])
    u = u[last]
    smallest = still_ranges(model)
    extent = np.ptp(q, axis=0)
    # A command that never changes has no correlation with anything.
    constant = np.ptp(u, axis=0) <= 0.01 * extent
    moving = np.flatnonzero((extent > smallest) & ~constant).tolist()
    # A soft servo gives way by less than ten times that range.
    held = np.flatnonzero(constant & (extent > 10.0 * smallest)).tolist()
    reach = int(SEARCHED / step)
    lags = np.arange(-reach, reach + 1)
    # The same samples of positions for every lag, so that their correlations compare.
    positions = normalise_columns(q[reach : len(q) - reach])
    r = np.array(
        [positions.T @ normalise_columns(u[reach - lag : len(q) - reach - lag]) for lag in lags]
    )
    return _Motion(recording.joint_names, step, q, u, np.asarray(lags * step), r, moving, held)


def _is_position(recording: Recording, moving: list[int]) -> bool:
    """Return whether the commands of all moving joints are the positions, or the next ones."""
    assert recording.command is not None
    if not moving:
        return False
    q = recording.q[:, moving]
    u = recording.command[:, moving]
    size = 1e-6 * np.nanmax(np.abs(q), axis=0)
    changes = np.flatnonzero(np.any(np.diff(u, axis=0) != 0.0, axis=1))
    # Where a command holds for many samples it equals the position at rest: only changes count.
    here, next_one = (
        np.all(np.abs(u[changes] - q[changes + ahead]) <= size, axis=1) for ahead in (0, 1)
    )
    # Share of the changes of a command from which it is the position.
    return changes.size > 0 and bool(max(here.mean(), next_one.mean()) > 0.99)


def _find_constant(motion: _Motion) -> Iterator[Finding]:
    names = [motion.names[j] for j in motion.constant]
    plural = len(names) > 1
    if names:
        yield Finding(
            "command_constant",
            "error",
            f"the command{'s' * plural} of {join_names(names)} {'are' if plural else 'is'}"
            f" constant, though the joint{'s move' if plural else ' moves'} by up to"
            f" {np.ptp(motion.q[:, motion.constant], axis=0).max():.3g}",
            Cure("check which columns are commands, or lock what was moved by hand"),
            joint=None if plural else names[0],
        )


def _find_wrong_units(motion: _Motion, tested: list[int]) -> Iterator[Finding]:
    """Find commands that vary many times as much, or as little, as positions that follow them."""
    # Only joints that follow their command somehow have a ratio to ask about.
    tested = [j for j in tested if abs(motion.r[:, j, j]).max() > FOLLOWED]
    ratios = np.ptp(motion.u, axis=0) / np.maximum(np.ptp(motion.q, axis=0), 1e-12)
    # Times that a command varies more, or less, than the position, beyond what a servo explains.
    wrong = [j for j in tested if not 1 / 4.0 < ratios[j] < 4.0]
    if not wrong:
        return
    ratio = float(np.median(ratios[wrong]))
    near = [
        (unit, of)
        for unit, per_radian in UNITS.items()
        for of, expected in (("command", per_radian), ("position", 1 / per_radian))
        # By the logarithm: the nearest unit within some 20 %.
        if abs(math.log(ratio / expected)) < 0.2
    ]
    unit, quantity = near[0] if near else ("", "command")
    looks = f", as if {quantity}s were in {unit}" if near else ""
    names = [motion.names[j] for j in wrong]
    cure = f"convert the {quantity}s to radians or metres"
    if unit in SHEET_UNITS and len(wrong) == len(tested):
        cure = f'write the unit in a recording sheet: units = {{ {quantity} = "{unit}" }}'
    yield Finding(
        "command_units",
        "error",
        f"the commands of {join_names(names)} vary {ratio:.3g} times as much as the"
        f" positions{looks}",
        Cure(cure),
        joint=names[0] if len(names) == 1 else None,
    )


def _find_swapped(motion: _Motion) -> dict[int, int]:
    """Return joints that follow each other's commands, not their own, with the commands' joints.

    A joint that follows a command of one that follows its own as well moves in step with that.
    """
    moving = motion.moving
    best = np.array([[motion.best(i, j, EVERY_LAG)[0] for j in moving] for i in moving])
    pairs = {moving[i]: moving[j] for i, j in find_swapped_columns(best, FOLLOWED, LOST)}
    # A cycle of joints: an open chain has another cause.
    return pairs if set(pairs) == set(pairs.values()) else {}


def _report_swapped(motion: _Motion, pairs: Mapping[int, int]) -> Iterator[Finding]:
    names = motion.names
    if pairs:
        listed = join_names([f"{names[i]} the command of {names[j]}" for i, j in pairs.items()])
        yield Finding(
            "command_swapped",
            "error",
            f"positions follow commands of other joints: {listed}",
            Cure(
                "list the columns in the order of the joints in a recording sheet: [columns]"
                " command = [...], or command_joints for a bag"
            ),
        )


def _find_flipped(motion: _Motion, tested: list[int]) -> Iterator[Finding]:
    """Find commands whose positions go the other way."""
    inside = (motion.lags >= 0.0) & (motion.lags <= LONGEST)
    # Beyond a servo's longest lag periodic motion correlates with either sign.
    for j in tested:
        own = motion.r[inside, j, j]
        if own.max() < LOST and own.min() < -FOLLOWED:
            name = motion.names[j]
            yield Finding(
                "command_flipped",
                "error",
                f"{name} moves against its command (correlation {own.min():.2f})",
                Cure("multiply the column of its command by -1"),
                joint=name,
            )


def _find_offset(model: RobotModel, servo: PositionServo, motion: _Motion) -> Iterator[Finding]:
    """Find commands so far away that the stiffness, if stated, exceeds the torque limit."""
    away = np.median(motion.u - motion.q, axis=0)
    # The tighter of what the servo and the description allow.
    limits = np.minimum(servo.torque_limit, [joint.limits.torque for joint in model.joints])
    for j, name in enumerate(motion.names):
        torque = servo.kp[j] * abs(away[j])
        if torque > limits[j]:
            yield Finding(
                "command_offset",
                "error",
                f"the command of {name} is mostly {away[j]:.3g} from its position, {torque:.3g} at"
                f" the stiffness of {servo.kp[j]:.3g}, and the torque limit is {limits[j]:.3g}",
                Cure("check the zeros of command and position, and the stiffness"),
                joint=name,
            )


def _find_wrong_clock(motion: _Motion) -> Iterator[Finding]:
    """Find commands that come after the motion, or long before it, at most joints."""
    lags = []
    for j in motion.moving:
        r, lag = motion.best(j, j, EVERY_LAG)
        # Two samples early: a log writes the command of the next cycle.
        usual, _ = motion.best(j, j, (-2 * motion.step, LONGEST))
        # Share of what a usual lag leaves unexplained that this one must leave at most: friction
        # delays slow motion, too, but leaves a tenth.
        share = 0.5 if lag < 0.0 else 0.02
        if r > FOLLOWED and (1.0 - r < share * (1.0 - usual) or usual < LOST):
            lags.append(lag)
    # At one joint a periodic motion has such lags by itself.
    if 2 * len(lags) <= len(motion.moving):
        return
    lag = float(np.median(lags))
    if lag < 0.0:
        problem = f"positions precede their commands by {-lag:.3g} s, which no servo can do"
    else:
        problem = (
            f"positions follow their commands {lag:.3g} s later; servos take less than"
            f" {LONGEST:g} s"
        )
    yield Finding(
        "command_clock",
        "error" if lag < 0.0 else "warning",
        f"{problem}: the clocks of commands and positions differ",
        Cure("correct the times of the commands"),
    )


def _find_lost(motion: _Motion) -> Iterator[Finding]:
    """Find joints that do not go where they are commanded."""
    for j in motion.moving:
        r, _ = motion.best(j, j, (-2 * motion.step, SEARCHED))
        if r < LOST:
            name = motion.names[j]
            yield Finding(
                "command_not_followed",
                "warning",
                f"the position of {name} does not follow its command (correlation {r:.2f})",
                Cure(
                    f"check that the column is the commanded position of {name}, and not a"
                    " velocity or torque"
                ),
                joint=name,
            )
