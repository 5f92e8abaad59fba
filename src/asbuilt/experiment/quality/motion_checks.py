"""Checks of the logged motion: units, limits, joints at rest or in step, velocities, excitation."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.appearance import stretched_length
from asbuilt.description.model import RobotModel
from asbuilt.dynamics import find_base_parameters, observation_matrix
from asbuilt.experiment.gravity_load import DEGREE, LARGEST_RADIANS, infer_unit_by_gravity
from asbuilt.experiment.quality.gravity_checks import measure_gravity_share
from asbuilt.experiment.quality.passes import FirstPass, still_ranges
from asbuilt.experiment.quality.reductions import SmoothedMotion
from asbuilt.experiment.quality.torque_fit import (
    USUAL_FRICTION,
    TorqueFit,
    compare_by_any_masses,
)
from asbuilt.experiment.quality.velocity_checks import check_velocities
from asbuilt.findings import Cure, Finding, join_names

FAR = 2.0
KEPT = 1.1
"""Multiples of its limit from which a position is far outside, and up to which it is inside."""
FEWEST_ALIKE = 3
"""Joints with one and the same limit from which it is a placeholder if the log exceeds it."""
RATE_TOO_HIGH = 4.0
"""Share of gravity in that of accelerations from which a clock is too fast: by half. Armatures
that the description lacks, and gains, make the share smaller."""


@dataclass(frozen=True, slots=True)
class Excess:
    """Say why motion in radians is impossible: degrees, a rate too high, or another robot.

    Parameters
    ----------
    evidence
        What exceeds which limit, as text.
    unit
        Unit of the positions that the torques support, None if they support neither; radians only
        at a lower rate.
    rate
        Highest rate [Hz] at which every joint keeps its limit of velocity in radians; None if the
        positions themselves are impossible.
    """

    evidence: str
    unit: Literal["rad", "deg"] | None
    rate: float | None = None

    def finding(self, given: float) -> Finding:
        """Return the finding for a log whose rate was taken to be `given` [Hz]."""
        convert = 'convert them, or write units = { position = "deg" } in a recording sheet'
        right_rate = "give the rate of the recording, or correct the time stamps"
        slower = (
            ""
            if self.rate is None
            else f"the rate of {given:.4g} Hz is too high; every limit of velocity is kept up to"
            f" {self.rate:.3g} Hz"
        )
        # The unit and the rate are told apart by what the torques support.
        if self.unit == "rad":
            return Finding(
                "rate_wrong",
                "error",
                f"{slower}: {self.evidence}, and the torques follow gravity at these positions in"
                " radians",
                Cure(right_rate, settings={"rate": "HZ"}),
            )
        if self.unit == "deg":
            other = ""
            cure = Cure(convert, sheet={"units": {"position": "deg"}})
        elif slower:
            other = f", or {slower}"
            cure = Cure(f"{convert}; or {right_rate}", settings={"rate": "HZ"})
        else:
            other = ", or another robot's"
            cure = Cure(f"choose the robot recorded, or {convert}")
        kept = "" if slower else ", and as degrees every joint keeps its limits"
        return Finding(
            "degrees",
            "error",
            f"the positions look like degrees{other}: {self.evidence}{kept}",
            cure,
        )


def find_impossible_motion(
    model: RobotModel, statistics: FirstPass, motion: SmoothedMotion | None
) -> Excess | None:
    """Return why the motion in radians is impossible, None if it is not.

    Limits alone do not tell, as many descriptions have placeholders: the torque must support
    degrees, or a slower clock, by gravity of the description or by any masses. A unit that is
    stated is believed.
    """
    turning = [k for k, joint in enumerate(model.joints) if joint.is_revolute]
    if not turning:
        return None
    # A far position is a unit's or a robot's; speed alone may be the clock's.
    evidence, largest = _find_far_position(model, statistics, turning)
    rate = None
    if not evidence and motion is not None:
        evidence, ratio = _find_fast_joint(model, motion, turning)
        rate = statistics.rate / ratio
    if not evidence:
        return None
    # What a sheet states is believed.
    if "position" in statistics.first.stated:
        return None
    # No joint turns this far: torques need not be asked.
    if largest >= LARGEST_RADIANS:
        return Excess(evidence, "deg", rate)
    if motion is None:
        return Excess(evidence, None, rate)
    # Gravity in degrees instead of radians is off by factors, and needs no masses.
    unit = infer_unit_by_gravity(model, motion.q, motion.tau)
    one, other = (
        TorqueFit.of(model, motion, np.full(model.n_joints, scale)) for scale in (1.0, DEGREE)
    )
    by_masses = compare_by_any_masses(one, other)
    if unit == "deg" or (unit is None and by_masses > 0):
        return Excess(evidence, "deg", rate)
    if rate is not None and _is_too_fast(one):
        return Excess(evidence, "rad", rate)
    # Positions unlike the robot's, whose torques are unlike them as well, are another's.
    if rate is None and unit is None and by_masses == 0:
        return Excess(evidence, None, rate)
    return None


def _is_too_fast(fit: TorqueFit) -> bool:
    """Return whether the clock is too fast by the description's masses and by any.

    A clock that is fast by a factor makes accelerations its square as large, and gravity small.
    """
    # As many times the gravity: any masses would fit better if the clock were so fast.
    heavier = fit.model.with_gravity(RATE_TOO_HIGH * np.array(fit.model.gravity))
    return (
        measure_gravity_share(fit) > RATE_TOO_HIGH
        and compare_by_any_masses(fit, replace(fit, model=heavier)) > 0
    )


def _find_far_position(
    model: RobotModel, statistics: FirstPass, turning: list[int]
) -> tuple[str, float]:
    """Return which position is far outside its limits, empty if none is, and the largest one."""
    joints = [model.joints[k] for k in turning]
    largest = statistics.position_range.furthest[turning]
    bounds = np.array([max(abs(joint.limits.lower), abs(joint.limits.upper)) for joint in joints])
    # A joint without limits turns once.
    bounds = np.where(np.isfinite(bounds), bounds, 2 * np.pi)
    over = largest / bounds
    # One joint is far outside as radians, a third of them are outside, and as degrees none is.
    if not (
        np.max(over) > FAR
        and np.sum(over > 1.2) >= max(1, len(joints) // 3)
        and np.all(over * DEGREE < KEPT)
    ):
        return "", float(np.nanmax(largest, initial=0.0))
    k = int(np.argmax(over))
    return (
        f"{joints[k].name} reaches {largest[k]:.4g}, {over[k]:.3g} times its limit of"
        f" {bounds[k]:.4g} rad"
    ), float(np.max(largest))


def _measure_speeds(motion: SmoothedMotion) -> Array:
    """Return the largest speed of each joint (n,), but for single samples, which may be noise."""
    return np.asarray(np.percentile(np.abs(motion.qd), 99.5, axis=0))


def _find_fast_joint(
    model: RobotModel, motion: SmoothedMotion, turning: list[int]
) -> tuple[str, float]:
    """Return which joint is far too fast, empty if none is, and how many times its limit."""
    speed = _measure_speeds(motion)[turning]
    fastest = np.array([model.joints[k].limits.velocity for k in turning])
    # A joint without a limit of velocity is taken to turn at 10 rad/s.
    # A speed in degrees must be a usual one, so that converting cures it.
    ratio = speed / np.where(np.isfinite(fastest) & (fastest > 0), fastest, 10.0)
    k = int(np.argmax(ratio))
    if not (ratio[k] > 3.0 and np.median(ratio) > 1.5 and np.all(ratio * DEGREE < 1.5)):
        return "", 1.0
    return (
        f"{model.joint_names[turning[k]]} turns at {speed[k]:.4g} per second, {ratio[k]:.3g} times"
        f" its limit of {speed[k] / ratio[k]:.4g} rad/s"
    ), float(ratio[k])


def check_recorded_motion(
    model: RobotModel, statistics: FirstPass, motion: SmoothedMotion | None, excess: Excess | None
) -> Iterator[Finding]:
    """Find degrees, positions outside limits, joints at rest or in step, and wrong velocities."""
    velocities: list[Finding] = []
    if motion is not None and motion.logged_qd is not None:
        velocities = list(check_velocities(model, statistics, motion, motion.logged_qd))
    if excess is None:
        yield from _find_millimetres(model, statistics)
        yield from _check_limits(model, statistics)
        if motion is not None:
            yield from _find_too_fast(model, statistics.rate, motion)
    elif "rate_wrong" not in [finding.code for finding in velocities]:
        yield excess.finding(statistics.rate)
    degrees = excess is not None and excess.unit != "rad"
    yield from _find_still(model, statistics, DEGREE if degrees else 1.0)
    yield from _find_correlated(statistics)
    yield from velocities


def _find_millimetres(model: RobotModel, statistics: FirstPass) -> Iterator[Finding]:
    """Find sliding joints that are far outside their limits, and inside them as millimetres."""
    for k, joint in enumerate(model.joints):
        bound = max(abs(joint.limits.lower), abs(joint.limits.upper))
        # A slide without limits is no longer than the robot.
        bound = bound if np.isfinite(bound) else stretched_length(model)
        # By absolute position: millimetres are off by a factor, not by a shift.
        furthest = float(statistics.position_range.furthest[k])
        # 1e-3: a millimetre in metres.
        if joint.is_revolute or not FAR < furthest / bound < 1e3 * KEPT:
            continue
        yield Finding(
            "millimetres",
            "error",
            f"the positions of {joint.name} look like millimetres: it slides to {furthest:.4g},"
            f" {furthest / bound:.3g} times its limit of {bound:.4g} m, and as millimetres it"
            " keeps it",
            Cure(
                f'write [joint_units] {joint.name} = "mm" in a recording sheet',
                sheet={"joint_units": {joint.name: "mm"}},
            ),
            joint=joint.name,
        )


def _check_limits(model: RobotModel, statistics: FirstPass) -> Iterator[Finding]:
    outside = statistics.outside_limits
    for k in np.flatnonzero(outside.count).tolist():
        joint = model.joints[k]
        value = outside.value[k]
        time = float(outside.time[k])
        yield Finding(
            "position_limit",
            "warning",
            f"{joint.name} is outside its limits [{joint.limits.lower:.4g},"
            f" {joint.limits.upper:.4g}] {joint.unit} in {outside.count[k]} of"
            f" {statistics.n_samples} samples, furthest {value:.4g} {joint.unit} at {time:.4g} s",
            Cure("compare units and zero position of the joint in the log with the model"),
            joint=joint.name,
            time=time,
        )


def _find_too_fast(model: RobotModel, rate: float, motion: SmoothedMotion) -> Iterator[Finding]:
    """Find that most joints exceed their limits of velocity, as at a rate too high."""
    limits = np.array([joint.limits.velocity for joint in model.joints])
    known = np.flatnonzero(np.isfinite(limits) & (limits > 0.0))
    if not known.size:
        return
    ratio = _measure_speeds(motion)[known] / limits[known]
    # Multiple of its limit at the median joint from which the rate is doubted.
    if np.median(ratio) <= 1.2:
        return
    k = int(np.argmax(ratio))
    name = model.joint_names[known[k]]
    placeholders = doubt_limits(
        model, "velocity", limits[known], f"{name} moves {ratio[k]:.3g} times as fast"
    )
    yield placeholders or Finding(
        "velocity_limit",
        "warning",
        f"most joints exceed their limits of velocity, {name}"
        # The rate that the fastest joint would allow.
        f" {ratio[k]:.2g} times: the rate of {rate:.4g} Hz is too high (limits allow"
        f" {rate / ratio[k]:.3g} Hz), or the limits are wrong",
        Cure("give the rate of the recording, or correct the time stamps", settings={"rate": "HZ"}),
    )


def doubt_limits(model: RobotModel, quantity: str, limits: Array, exceeded: str) -> Finding | None:
    """Return that one number is the limit of all joints, which the log has `exceeded`."""
    # Descriptions that are converted from drawings have one number as every limit.
    if limits.size < FEWEST_ALIKE or np.ptp(limits) > 0.0:
        return None
    return Finding(
        "limits_doubted",
        "info",
        f"every limit of {quantity} of {model.name} is {limits[0]:.4g}, and {exceeded}: they look"
        " like placeholders, and say nothing of the log",
        Cure("write the true limits into the description"),
    )


def _find_still(model: RobotModel, statistics: FirstPass, scale: float) -> Iterator[Finding]:
    """Find joints that hardly move; `scale` converts positions of joints that turn to rad."""
    extremes = statistics.position_range
    factor = np.where([joint.is_revolute for joint in model.joints], scale, 1.0)
    span = np.where(extremes.count > 0, factor * (extremes.high - extremes.low), 0.0)
    still = np.flatnonzero(span < still_ranges(model))
    if still.size == model.n_joints:
        k = int(np.argmax(span))
        yield Finding(
            "nothing_moves",
            "error",
            f"no joint moves: the largest position range is {span[k]:.3g} {model.joints[k].unit},"
            f" the range of {model.joint_names[k]}",
            Cure(
                "record the robot in motion, and check that the position columns are the measured"
                " ones",
                call="design_motion",
            ),
        )
        return
    for k in still.tolist():
        joint = model.joints[k]
        yield Finding(
            "joint_still",
            "warning",
            f"{joint.name} hardly moves: its position range is {span[k]:.3g} {joint.unit}; its"
            " friction and part of its inertia stay undetermined",
            Cure("move every joint over a large part of its range", call="design_motion"),
            joint=joint.name,
        )


def _find_correlated(statistics: FirstPass) -> Iterator[Finding]:
    moving = statistics.moments.moving
    correlation = np.abs(statistics.moments.correlations(moving))
    # Correlation of positions from which joints move in step.
    # The largest group: joints that move in step with each other, not with one only.
    group = max((np.flatnonzero(row > 0.995) for row in correlation), key=len, default=())
    if len(group) < 3:
        return
    names = [statistics.first.joint_names[moving[k]] for k in group]
    least = float(np.min(correlation[np.ix_(group, group)]))
    everyone = len(group) == statistics.n_joints
    yield Finding(
        "joints_correlated",
        "warning" if everyone else "info",
        f"{'all' if everyone else len(group)} joints move in step: {join_names(names)}"
        f" (correlation of positions at least {least:.4f}), so their inertias are hard to separate",
        Cure("record a motion in which every joint moves independently", call="design_motion"),
    )


_SQUARABLE = 1e-4
"""Singular value, relative to the largest, from which on its square has digits enough."""
_RANK_TOLERANCE = 1e-7
"""Singular value or column norm, relative to the largest, below which it counts as zero."""


def check_excitation(
    model: RobotModel, statistics: FirstPass, motion: SmoothedMotion | None
) -> Iterator[Finding]:
    """Find recordings with too few samples, rank deficiency, or a large scaled condition number.

    The observation matrix belongs to the base parameters with viscous, Coulomb and offset terms,
    its columns scaled to unit length.
    """
    base = find_base_parameters(model, USUAL_FRICTION)
    if statistics.n_samples < base.n_base:
        yield Finding(
            # Least squares of fewer rows than parameters determines nothing, whatever the motion.
            "too_few_samples",
            "error",
            f"{statistics.n_samples} samples are fewer than the {base.n_base} parameters to"
            " identify (base parameters, viscous, Coulomb and offset terms)",
            Cure(f"record at least some thousand samples of {model.name} in motion"),
        )
        return
    if motion is None:
        yield Finding(
            "too_short",
            "error",
            "no segment of the recording is long enough to differentiate:"
            f" {statistics.n_samples} samples in {statistics.duration:.3g} s",
            Cure("record at least ten seconds without gaps"),
        )
        return
    # Number of samples used; more do not change the condition number noticeably.
    rows = motion.thinned(800)
    states = (motion.q[rows], motion.qd[rows], motion.qdd[rows])
    observed = observation_matrix(model, *states, drive=base.drive, columns=base.columns)
    # Without the squares as an array, which of many joints is as large as all rows.
    lengths = np.sqrt(np.einsum("ij,ij->j", observed, observed))
    # A column without excitation keeps its length, so that it counts as zero in the rank.
    lengths[lengths <= _RANK_TOLERANCE * np.max(lengths)] = 1.0
    values, directions = _decompose(observed, lengths)
    rank = int(np.sum(values > _RANK_TOLERANCE * values[0]))
    # The last direction is the least excited.
    worst = join_names([base.names[k] for k in np.argsort(-np.abs(directions[-1]))[:4]])
    if rank < base.n_base:
        yield Finding(
            "rank_deficient",
            "warning",
            f"this motion determines {rank} of {base.n_base} parameters; the least excited are"
            f" {worst}",
            Cure(
                "move every joint independently, or choose fewer drive terms; undetermined"
                " parameters keep their CAD values",
                call="design_motion",
            ),
        )
    elif values[0] / values[-1] > 100.0:  # designed motions have 10 to 50
        yield Finding(
            "weak_excitation",
            "warning",
            f"the scaled condition number is {values[0] / values[-1]:.3g} (good motions have 10 to"
            f" 50) over {statistics.duration:.3g} s; least excited are {worst}",
            Cure(
                "add recordings or design a motion, and validate on another recording",
                call="design_motion",
            ),
        )


def _decompose(observed: Array, lengths: Array) -> tuple[Array, Array]:
    """Return singular values, largest first, and right vectors of columns divided by lengths."""
    gram = observed.T @ observed / np.outer(lengths, lengths)
    squares, axes = np.linalg.eigh(gram)
    if squares[0] > _SQUARABLE**2 * squares[-1]:
        return np.sqrt(squares[::-1]), axes.T[::-1]
    # The triangle has the singular values of all rows, with all digits.
    triangle = np.linalg.qr(observed / lengths, mode="r")
    _, values, directions = np.linalg.svd(triangle, full_matrices=False)
    return values, directions
