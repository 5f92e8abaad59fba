"""Checks of the measured torques against the model's: sign, scale, order of joints."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.appearance import stretched_length
from asbuilt.description.model import RobotModel
from asbuilt.dynamics import inverse_dynamics
from asbuilt.experiment.quality.command_checks import WRONG_SCALE, report_open_scale
from asbuilt.experiment.quality.conventions import check_conventions, check_zeros
from asbuilt.experiment.quality.gravity_checks import check_gravity, find_friction_sign
from asbuilt.experiment.quality.passes import FirstPass
from asbuilt.experiment.quality.reductions import SmoothedMotion
from asbuilt.experiment.quality.torque_fit import (
    CLEAR,
    TorqueFit,
    compare_by_any_masses,
    find_best_assignment,
    find_swapped_torques,
    infer_density,
)
from asbuilt.experiment.recording import FLIPPED, FLIPPED_TWICE, UNWRAPPED
from asbuilt.findings import Cure, Finding, Severity, join_names

CERTAIN = 0.95
"""Correlation with the model's torque from which the scale of a single joint may differ from the
others'."""
PLAUSIBLE = 0.3, 3.0
"""Gain that masses unlike CAD explain; beyond, the unit of the torque differs. The masses of CAD
are known to some tens of percent, and gravity dominates."""
BRAKING = 0.5
"""Correlation against the direction of motion from which a torque is not friction's."""


def check_torques(
    model: RobotModel, statistics: FirstPass, motion: SmoothedMotion, position_scale: Array
) -> Iterator[Finding]:
    """Compare the measured torques with the model's rigid-body torques.

    `position_scale` (n,) converts logged positions to rad: 1, or pi/180 if they are degrees.
    """
    fit = TorqueFit.of(model, motion, position_scale)
    # Without masses there is no torque to compare with.
    if not np.any(fit.predicted > 0):
        yield from _check_without_masses(statistics, fit)
        return
    if fit.ratio == 0:
        yield Finding(
            "no_torque",
            "error",
            "the torques are constant: the torque of the first joint is"
            f" {statistics.first.tau[0, 0]:.4g} in {statistics.n_samples} samples",
            Cure("log the measured joint torques or motor currents"),
        )
        return
    # Gravity first: with the wrong one every other comparison is off.
    mounted = check_gravity(fit)
    if mounted is not None:
        yield mounted[0]
        fit = mounted[1]
    # A wrong unit would hide an order or a convention: it is taken out before these are asked.
    ratio = 1.0 if PLAUSIBLE[0] < fit.ratio < PLAUSIBLE[1] else fit.ratio
    fit = replace(fit, tau=fit.tau * (1.0 / ratio))
    best = find_best_assignment(fit)
    # The masses of CAD may prefer a swap that any masses refute; an error needs both.
    by_masses = 0 if best is fit else compare_by_any_masses(fit, best)
    if by_masses < 0:
        best = fit
    stated = "zero" in statistics.first.stated
    other = check_conventions(best, believed=stated)
    if other is None and not stated:
        other = check_zeros(best, of_encoders=_list_wrapped_joints(statistics))
    if best is not fit:
        yield _report_swapped(fit, best, "error" if by_masses > 0 else "warning")
    if other is not None:
        yield other[0]
        best = other[1]
    # Swaps by any masses are asked only where CAD shows none.
    elif best is fit:
        yield from _find_swapped_without_cad(fit)
    yield from _check_sign_and_scale(statistics, best, ratio)


def _list_wrapped_joints(statistics: FirstPass) -> tuple[int, ...]:
    """Return the joints of a log whose counters begin again within the motion."""
    wrapped = any(note.startswith(UNWRAPPED) for note in statistics.first.notes)
    return tuple(range(statistics.n_joints)) if wrapped else ()


def _check_without_masses(statistics: FirstPass, fit: TorqueFit) -> Iterator[Finding]:
    """Check signs by friction, and the scale by the length of the arm."""
    model = fit.model
    friction = fit.friction_correlation
    seen = np.flatnonzero(np.abs(friction) > BRAKING)
    by = (
        f"their signs by friction at {join_names([model.joint_names[k] for k in seen])} alone"
        if seen.size
        else "their signs neither, as no friction shows"
    )
    # With nothing to compare with, what was not checked is said.
    yield Finding(
        "no_inertia",
        "info",
        f"{model.name} has no inertial parameters, or none that act in this motion; the order of"
        f" the torques was not checked, {by}, their scale by the length of the arm: masses have"
        " the scale of the torques",
        Cure("use a description with masses to have them checked"),
    )
    yield from _check_signs_by_friction(statistics, fit)
    yield from check_scale_without_masses(fit)


def _check_signs_by_friction(statistics: FirstPass, fit: TorqueFit) -> Iterator[Finding]:
    """Find torques that act along the motion where friction, by any masses, acts against it."""
    model = fit.model
    friction = fit.friction_correlation
    wrong = np.flatnonzero(friction < -BRAKING).tolist()
    # One joint against the motion may be driven by the others; several are a sign.
    right = np.flatnonzero(friction > BRAKING).tolist()
    if len(wrong) > max(len(right), 1):
        listed = join_names([f"{model.joint_names[k]} {friction[k]:.2f}" for k in wrong])
        halves = [half.friction_correlation[wrong] for half in fit.halves()]
        # Energy first, as friction may be hidden; else both halves.
        sure = fit.kinetic_sign < 0.0 or (
            fit.kinetic_sign == 0.0 and all(np.all(half <= 0.0) for half in halves)
        )
        yield Finding(
            "torque_flipped",
            "error" if sure and "sign" not in statistics.first.stated else "warning",
            "the torque sign looks flipped: torques correlate negatively with the direction of"
            f" motion, unlike friction ({listed})",
            _make_flip_cure(statistics, -1.0, right),
        )
        return
    for k in wrong:
        yield _report_driven_motion(model, k, float(friction[k]), 1.0, wrong)


def _report_driven_motion(
    model: RobotModel, k: int, correlation: float, sign: float, wrong: Collection[int]
) -> Finding:
    """Return the finding of a joint whose torque grows against the direction of its motion."""
    return Finding(
        "joint_torque_flipped",
        "warning",
        f"the torque of {model.joint_names[k]} correlates negatively with its direction of motion"
        f" ({correlation:.2f}), unlike friction; its sign may be flipped",
        _make_signs_cure(model.n_joints, sign, wrong),
        joint=model.joint_names[k],
    )


def _report_swapped(fit: TorqueFit, best: TorqueFit, severity: Severity) -> Finding:
    names = fit.model.joint_names
    # Torque and motion may be swapped apart: a file may mix either.
    moved = [k for k in range(len(names)) if best.torque_of[k] != k or best.motion_of[k] != k]
    fits = []
    for k in moved:
        torque = names[best.torque_of[k]]
        motion = names[best.motion_of[k]]
        what = (
            f"position and torque logged for {torque}"
            if torque == motion
            else f"the position of {motion} and the torque of {torque}"
        )
        fits.append(f"{names[k]} fits {what}")
    before, after = fit.compare_correlation(best, np.array(moved))
    return Finding(
        "joints_swapped",
        severity,
        f"joints {'look' if severity == 'error' else 'may be'} swapped: {join_names(fits)} (mean"
        f" correlation with the model's torque {after:.3f} instead of {before:.3f})"
        f"{'' if severity == 'error' else '; other masses explain the log as it is as well'}",
        Cure("name the columns in a recording sheet: [columns] position = [...], torque = [...]"),
        joint=names[moved[0]],
    )


def _find_swapped_without_cad(fit: TorqueFit) -> Iterator[Finding]:
    swap = find_swapped_torques(fit)
    if swap is not None:
        one, other = (fit.model.joint_names[k] for k in swap.joints)
        yield Finding(
            "joints_swapped",
            "error",
            f"the torques of {one} and {other} look swapped: a fit of base parameters and friction"
            f" leaves {100 * swap.as_logged:.2g} % of their variance unexplained as logged,"
            f" {100 * swap.swapped:.2g} % after swapping them",
            Cure("name the columns in a recording sheet: [columns] torque = [...]"),
            joint=one,
        )


def _check_sign_and_scale(statistics: FirstPass, fit: TorqueFit, ratio: float) -> Iterator[Finding]:
    model = fit.model
    names = fit.model.joint_names
    correlation = fit.correlation
    gain = fit.gain * ratio
    predicted = fit.predicted
    # A correlation must be clear before gain or sign is read from it.
    clear = [int(k) for k in np.flatnonzero(fit.decides & (np.abs(correlation) > CLEAR))]
    if not clear:
        yield from _find_uncorrelated(fit, gain)
        return
    evidence = "; ".join(
        f"{names[k]}: gain {gain[k]:.3g}, correlation {correlation[k]:.3f}"
        for k in sorted(clear, key=lambda k: -predicted[k])[:3]
    )
    # Most joints decide the sign of all: the others are then those that differ.
    flipped = sum(correlation[k] < 0 for k in clear) * 2 > len(clear)
    sign = -1.0 if flipped else 1.0
    scale = float(np.median(np.abs(gain[clear])))
    relative = np.abs(gain) / scale
    # Beyond these gains relative to the others the unit or gain of a joint differs.
    # A gain far from the others' is another fault than a sign.
    usual = (relative > 0.2) & (relative < 5.0)
    alone = [k for k in clear if usual[k] and sign * correlation[k] < 0.0]
    if flipped:
        yield Finding(
            "torque_flipped",
            _weigh_flip(statistics, fit, clear),
            "the torque sign looks flipped: the measured torque decreases where the model's"
            f" increases ({evidence})",
            _make_flip_cure(statistics, sign, alone),
        )
    # Where rigid bodies say nothing friction does.
    friction = sign * fit.correlate_friction(set(range(model.n_joints)) - set(clear))
    braking = np.flatnonzero(friction < -BRAKING).tolist()
    for k in alone:
        yield _report_opposite_sign(statistics, fit, k, sign, alone, gain[k])
    for k in braking:
        yield _report_driven_motion(model, k, float(friction[k]), sign, [*alone, *braking])
    # An unknown stiffness is the scale: there is none to doubt.
    open_scale = report_open_scale(model, statistics.first, scale)
    if open_scale is not None:
        yield open_scale
        return
    # A scale of all joints is one unit; single joints are asked after it.
    part = None if "torque" in statistics.first.stated else find_part_of_limits(model, gain, clear)
    if part is not None:
        yield _report_part_of_limits(model, part, evidence)
        return
    if not PLAUSIBLE[0] < scale < PLAUSIBLE[1]:
        yield _report_scale(statistics, fit, scale, evidence, clear, gain)
        return
    for k in clear:
        if abs(correlation[k]) > CERTAIN and not usual[k]:
            yield Finding(
                "joint_torque_scale",
                "warning",
                f"the torque of {names[k]} is {abs(gain[k]):.3g} times the model's; the torques of"
                f" the other joints are about {scale:.3g} times theirs",
                Cure("correct its gain or unit, as by gains = [...] in a recording sheet"),
                joint=names[k],
            )
    # Masses of CAD seldom explain such gains where gravity is most of the torque; an armature that
    # CAD lacks changes other torques.
    doubtful = usual & (fit.gravity > 0.8 * predicted) & ~((abs(gain) > 0.6) & (abs(gain) < 1.7))
    for k in clear:
        if doubtful[k]:
            yield Finding(
                "torque_scale",
                "warning",
                f"the torque of {names[k]} is {abs(gain[k]):.3g} times the model's, mostly"
                f" gravity's, with a correlation of {abs(correlation[k]):.3f}: its scale or the"
                " masses of CAD are wrong by that",
                Cure(
                    "find the torque per logged unit from a payload of known mass",
                    call="find_gains",
                ),
                joint=names[k],
            )


def _weigh_flip(statistics: FirstPass, fit: TorqueFit, clear: Sequence[int]) -> Severity:
    """Return whether a second road shows that all torques are flipped.

    Friction brakes and kinetic energy is positive, whatever the masses; where neither shows, both
    halves of the log must agree.
    """
    # A sign that is stated is the user's: doubt is a warning.
    if "sign" in statistics.first.stated:
        return "warning"
    roads = find_friction_sign(fit) + fit.kinetic_sign
    halves = [half.correlation[clear] for half in fit.halves()]
    sure = roads < 0.0 or (roads == 0.0 and all(np.median(half) < -CLEAR for half in halves))
    return "error" if sure else "warning"


def _report_opposite_sign(
    statistics: FirstPass,
    fit: TorqueFit,
    k: int,
    sign: float,
    alone: Collection[int],
    gain: float,
) -> Finding:
    """Return the finding of a joint whose torque has the opposite sign of the description's.

    A load, or masses unlike CAD, turn the sign of gravity's torque, too. An error needs that any
    masses fit better with the other sign, or that the joint's friction does; where any masses fit
    better as logged, its sign is right.
    """
    name = fit.model.joint_names[k]
    evidence = f"gain {gain:.3g}, correlation {fit.correlation[k]:.3f}"
    # All suspects are turned together, and this one alone turned back.
    others = np.where(np.isin(np.arange(fit.model.n_joints), list(alone)), -1.0, 1.0)
    signs = np.where(np.arange(fit.model.n_joints) == k, 1.0, others)
    by_masses = compare_by_any_masses(fit.with_signs(signs), fit.with_signs(others))
    if by_masses < 0:
        return Finding(
            "joint_masses_differ",
            "warning",
            f"the torque of {name} has the opposite sign of the model's ({evidence}), but any"
            " masses fit all torques better with the sign logged: a load or masses that the"
            " description lacks act there",
            Cure("describe what is mounted, or identify: masses are found"),
            joint=name,
        )
    braking = sign * fit.correlate_friction([k])[k] < -BRAKING
    sure = (by_masses > 0 or braking) and "sign" not in statistics.first.stated
    return Finding(
        "joint_torque_flipped",
        "error" if sure else "warning",
        f"the torque of {name} alone has the opposite sign of the model's ({evidence})",
        _make_signs_cure(fit.model.n_joints, sign, alone),
        joint=name,
    )


def _find_uncorrelated(fit: TorqueFit, gain: Array) -> Iterator[Finding]:
    """Find torques unlike the model's, unless noise or friction of the model's size explains it."""
    predicted = fit.predicted
    k = int(np.argmax(predicted))
    correlation = fit.correlation[k]
    # Noise and friction of the model's size hide a correlation, and need no finding.
    if not (correlation > 0.3 and 0.8 < gain[k] < 1.25):
        yield Finding(
            "torque_uncorrelated",
            "warning",
            f"no torque of the log correlates with the model's: {correlation:.2f} for"
            f" {fit.model.joint_names[k]}, whose torque should vary by {predicted[k]:.3g} N m",
            Cure("check robot, columns and units, and gravity if the robot hangs or is on a wall"),
        )


def _make_flip_cure(statistics: FirstPass, sign: float, others: Collection[int]) -> Cure:
    """Return the cure of signs that are flipped, at all joints but `others`."""
    if others:
        return _make_signs_cure(statistics.n_joints, sign, others)
    # All may have been flipped already.
    notes = statistics.first.notes
    if FLIPPED_TWICE in notes:
        return Cure(
            "keep one of the two flips: sign = -1 in the recording sheet, or the flip of all"
        )
    if FLIPPED in notes:
        return Cure("flip the torque sign back: it was flipped, here or by sign = -1 of the sheet")
    return Cure(
        "flip the torque sign, or write sign = -1 in a recording sheet",
        settings={"flip_torque": True},
    )


def _make_signs_cure(n_joints: int, sign: float, flipped: Collection[int]) -> Cure:
    """Return the cure of signs, where the `flipped` joints have the opposite of all others."""
    signs = ", ".join(f"{-sign if k in flipped else sign:.0f}" for k in range(n_joints))
    return Cure(f"write sign = [{signs}] in a recording sheet, times the signs that it has")


AGREEMENT = 1.5
"""Ratio up to which gains, of halves of a log or of joints, are one scale."""


def _is_one_scale(fit: TorqueFit, clear: Sequence[int]) -> bool:
    """Return whether rigid bodies show one scale, in both halves of the log and at all joints.

    Where friction is most of a torque, what is left after it has no scale of its own; masses that
    are wrong differ from joint to joint, a unit does not.
    """
    whole = np.std(fit.tau, axis=0)[clear]
    # Friction leaves no scale of rigid bodies.
    bodies = [k for k, part in zip(clear, whole, strict=True) if fit.measured[k] > 0.5 * part]
    if not bodies:
        return False
    gains = [np.abs(part.gain[bodies]) for part in (*fit.halves(), fit)]
    one, two, _ = map(np.median, gains)
    # Of all joints the whole log; each ratio of two is the square of one.
    alike = np.max(gains[2]) < AGREEMENT**2 * np.min(gains[2])
    return bool(max(one, two) < AGREEMENT * min(one, two) and alike)


SHARES_OF_LIMITS = {"percent": 0.01, "permille": 0.001}
"""Units of torque that drives log, as shares of a joint's largest torque."""
ONE_SHARE = 1.25
"""Ratio up to which gains of joints, times their limits, are one unit: masses of CAD differ by some
tenths from joint to joint."""


def find_part_of_limits(model: RobotModel, gain: Array, clear: Sequence[int]) -> str | None:
    """Return the share of the description's limits that torques are in; None if they are in none.

    The factors from the model's torques to the logged ones, (n,), then are in inverse proportion to
    the limits; that they are so, and of the right size, is no chance where the limits differ.
    """
    limits = np.array([joint.limits.torque for joint in model.joints])[list(clear)]
    factors = np.abs(gain[list(clear)])
    if len(clear) < 2 or not np.all(np.isfinite(limits) & (limits > 0.0)):
        return None
    for name, share in SHARES_OF_LIMITS.items():
        units = factors * share * limits
        one = np.max(units) < ONE_SHARE * np.min(units)
        differ = np.max(factors) > AGREEMENT * np.min(factors)
        # Masses unlike CAD's, or a rated torque below the limit, change the size by less than two.
        if one and differ and 0.5 < float(np.median(units)) < 2.0:
            return name
    return None


def _report_part_of_limits(model: RobotModel, part: str, evidence: str) -> Finding:
    limits = [joint.limits.torque for joint in model.joints]
    gains = [float(f"{SHARES_OF_LIMITS[part] * limit:.4g}") for limit in limits]
    listed = ", ".join(f"{limit:g}" for limit in limits)
    return Finding(
        "torque_scale",
        "warning",
        f"the torques look like {part} of the limits of torque, {listed} N m: the joints' factors"
        f" to the model's torques are in inverse proportion to these ({evidence})",
        Cure(
            "give the torque per logged unit, a part of the rated torque of each joint: gains ="
            f" [{', '.join(f'{value:g}' for value in gains)}] in a recording sheet",
            sheet={"gains": gains} if np.all(np.isfinite(limits)) else {},
        ),
    )


CURRENT_GAINS = 0.3, 300.0
"""Torque per current [N m/A] of joints with gears, from a finger's to the base of a large arm."""


def _report_current(
    model: RobotModel, gain: Array, clear: Sequence[int], severity: Severity
) -> Finding:
    """Return the finding of currents in an unknown unit, with the gains by the masses of CAD."""
    found = {k: 1.0 / abs(float(gain[k])) for k in clear}
    listed = join_names(
        [f"{value:.2g} N m at {model.joint_names[k]}" for k, value in found.items()]
    )
    per_ampere = 1e3 * float(np.median([*found.values()]))
    low, high = CURRENT_GAINS
    as_amperes = f" ({per_ampere:.2g} N m/A if they are mA)" if low < per_ampere < high else ""
    return Finding(
        "torque_scale",
        severity,
        f"the torques are currents without gains: by the masses of {model.name} one logged unit"
        f" makes {listed}{as_amperes}",
        Cure(
            "give the gains in N m per logged unit, one per joint, here or as gains = [...] in a"
            " recording sheet; a payload of known mass determines them",
            settings={"torque_source": "current"},
            call="find_gains",
        ),
    )


def _report_scale(
    statistics: FirstPass,
    fit: TorqueFit,
    scale: float,
    evidence: str,
    clear: Sequence[int],
    gain: Array,
) -> Finding:
    """Return the finding of torques whose scale is not the description's.

    An error needs two roads: the density of an arm of this length, by the log and by the masses of
    CAD, or else one scale everywhere.
    """
    model = fit.model
    # The density by CAD asks whether masses of the description can be an arm's.
    by_cad = infer_density(replace(fit, tau=inverse_dynamics(model, fit.q, fit.qd, fit.qdd)))
    by_log = infer_density(replace(fit, tau=fit.tau * scale))
    low, high = DENSITY
    plausible = [None if density is None else low < density < high for density in (by_cad, by_log)]
    if plausible == [False, True]:
        return Finding(
            "masses_implausible",
            "warning",
            f"the masses of {model.name} are {1.0 / scale:.3g} times those of the torques"
            f" ({evidence}), and no arm of this length has them, while the torques are of an arm's"
            " size: masses, or lengths, of the description look to be in another unit",
            Cure("correct the description"),
        )
    # Two roads agree, or one scale is shared by everything.
    sure = plausible == [True, False] or _is_one_scale(fit, clear)
    # Links of one mass have placeholders, whose scale no torque follows.
    masses = [link.inertia.mass for link in model.links if link.inertia.mass > 0.0]
    # Converted drawings have one mass for many links.
    placeholders = len(masses) > 2 and 2 * len(set(masses)) <= len(masses)
    sure = sure and not placeholders and "torque" not in statistics.first.stated
    if statistics.first.torque_source == "current":
        return _report_current(model, gain, clear, "error" if sure else "warning")
    if statistics.first.has_computed_torque:
        guess, cure = WRONG_SCALE
    elif 300 < scale < 3000:
        guess = "they look like mN m"
        cure = Cure(
            'write units = { torque = "mN m" } in a recording sheet',
            sheet={"units": {"torque": "mN m"}} if sure else {},
        )
    elif 0.005 < scale < 0.3:
        guess = "they look like motor currents without gains"
        cure = Cure(
            "give the gains in N m/A, one per joint, here or as gains = [...] in a recording sheet;"
            " a payload of known mass determines them",
            settings={"torque_source": "current"},
            call="find_gains",
        )
    else:
        guess = "the unit or the robot differs"
        cure = Cure("give the gain that converts them to N m, or units in a recording sheet")
    return Finding(
        "torque_scale",
        "error" if sure else "warning",
        f"the torques are {scale:.3g} times the torques of {model.name} ({evidence}): {guess}",
        cure,
    )


DENSITY = 0.5, 800.0
"""Densities [kg/m^3] of rods `stretched_length` wide that a robot may have.

Mass of arms grows with the third power of length. These are a quarter of the lightest and nine
times the heaviest: 2 to 16 for the descriptions of thirteen robots whose torque of gravity varies
by 0.4 to 65 N m, 50 for the TX40 and 87 for the two-link arm; recordings of six real arms in N m
give 1.7 to 87.
"""


def check_scale_without_masses(fit: TorqueFit) -> Iterator[Finding]:
    """Find torques of a size that no robot of this length has."""
    density = infer_density(fit)
    low, high = DENSITY
    if density is None or low < density < high:
        return
    length = stretched_length(fit.model)
    bound = (
        f"more than {low * length**3:.2g}" if density < low else f"less than {high * length**3:.0f}"
    )
    cure = Cure(
        "give the torque per logged unit, one per joint, as gains = [...] in a recording sheet; a"
        " payload of known mass determines it",
        call="find_gains",
    )
    if density > high:
        cure = Cure('write units = { torque = "mN m" } in a recording sheet, or the unit it has')
    yield Finding(
        "torque_scale",
        "warning",
        f"the torques look not to be N m: gravity's share of them fits an arm of about"
        f" {density * length**3:.2g} kg, and arms of this length ({length:.2g} m stretched) weigh"
        f" {bound} kg; masses and torques come out in the logged unit",
        cure,
    )
