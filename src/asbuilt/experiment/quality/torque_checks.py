"""Whether the logged torques are those of this robot.

Sign, scale, order of joints, saturation, filtering.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from scipy.signal import welch

from asbuilt.arrays import Array, Indices
from asbuilt.description.model import RobotModel
from asbuilt.experiment.quality.first_pass import Survey
from asbuilt.experiment.quality.second_pass import CloserLook
from asbuilt.experiment.quality.smoothed_motion import SmoothedMotion
from asbuilt.experiment.quality.torque_fit import TorqueFit, best_assignment
from asbuilt.experiment.quality.torque_order import exchanged_torques
from asbuilt.findings import Finding, joined

_CLEAR = 0.9
"""Correlation with the model's torque from which a joint's torque speaks clearly,"""
_FAINT = 0.3
"""and from which the loudest one, where none is clear, is what the model says beneath noise or
friction of its own size,
"""
_ALIKE = (0.8, 1.25)
"""if its size is within these factors of the model's."""
_SPEAKING_SHARE = 0.02
"""Torques that the model has vary by less than this part of the largest say nothing."""
_PLAUSIBLE = (0.3, 3.0)
"""Factors by which the masses of CAD may be off; beyond them the unit of the torque is."""
_BRAKING = 0.5
"""Correlation against the direction of motion from which a torque does not act as friction does."""
_QUIET_FLOOR = 1e-9
"""Power at high frequency, in parts of the peak, below which no sensor was at work."""
_PLATEAU_RUN = 5
"""Samples in a row at an extreme from which a torque may be cut off."""
_SHORTEST = 256
"""Samples that a spectrum takes."""


def torque_findings(
    model: RobotModel,
    recording: Survey,
    closer: CloserLook,
    motion: SmoothedMotion | None,
    position_scale: Array,
) -> Iterator[Finding]:
    """Hold the measured torques against the model's rigid-body torques.

    Gravity decides most, its size is known to some tens of percent from CAD.

    `position_scale` (n,) turns logged positions into rad (1, or pi/180 where they were found to be
    degrees).
    """
    yield from _saturation(model, recording, closer)
    yield from _filtered(closer.torques, recording.rate)
    if motion is None:
        return
    fit = TorqueFit.of(model, motion, position_scale)
    if not np.any(fit.predicted > 0):
        yield Finding(
            "no_inertia",
            "info",
            f"{model.name} has no inertial parameters, or none that act in this motion; the"
            " torques' sign, scale and order were not checked",
            "Use a description with masses to have them checked",
        )
        return
    ratio = float(np.sqrt(np.sum(fit.measured**2) / np.sum(fit.predicted**2)))
    if ratio == 0:
        yield Finding(
            "no_torque",
            "error",
            f"the torques do not change at all: the first joint's is {recording.first_torque:.4g}"
            f" in {recording.n_samples} samples",
            "Log the measured joint torques or motor currents",
        )
        return
    if not _PLAUSIBLE[0] < ratio < _PLAUSIBLE[1]:
        fit = TorqueFit.of(model, motion, position_scale, 1.0 / ratio)
    else:
        ratio = 1.0
    best = best_assignment(fit)
    if best is not fit:
        yield from _exchanges(model, fit, best)
    else:
        yield from _exchanges_without_cad(model, fit)
    yield from _sign_and_scale(model, recording, best, ratio)


def _exchanges(model: RobotModel, fit: TorqueFit, best: TorqueFit) -> Iterator[Finding]:
    names = model.joint_names
    moved = [k for k in range(model.n_joints) if best.torque_of[k] != k or best.motion_of[k] != k]
    told = []
    for k in moved:
        torque, motion = names[best.torque_of[k]], names[best.motion_of[k]]
        what = (
            f"position and torque logged for {torque}"
            if torque == motion
            else f"the position of {motion} and the torque of {torque}"
        )
        told.append(f"{names[k]} fits {what}")
    before, after = (float(np.mean(np.abs(f.correlation[moved]))) for f in (fit, best))
    yield Finding(
        "joints_swapped",
        "error",
        f"joints look swapped: {joined(told)} (mean correlation with the model's torque {after:.3f}"
        f" instead of {before:.3f})",
        "Check the order of the columns; name them in a recording sheet: [columns] position ="
        " [...], torque = [...]",
        joint=names[moved[0]],
    )


def _exchanges_without_cad(model: RobotModel, fit: TorqueFit) -> Iterator[Finding]:
    exchange = exchanged_torques(fit)
    if exchange is not None:
        one, other = (model.joint_names[k] for k in exchange.joints)
        yield Finding(
            "joints_swapped",
            "error",
            f"the torques of {one} and {other} look swapped: whatever the masses and friction,"
            f" {100 * exchange.as_logged:.2g} % of their variance is left unexplained as logged and"
            f" {100 * exchange.exchanged:.2g} % once exchanged",
            "Check the order of the torque columns; name them in a recording sheet: [columns]"
            " torque = [...]",
            joint=one,
        )


def _sign_and_scale(
    model: RobotModel, recording: Survey, fit: TorqueFit, ratio: float
) -> Iterator[Finding]:
    names = model.joint_names
    correlation, gain, predicted = fit.correlation, fit.gain * ratio, fit.predicted
    loud = predicted > _SPEAKING_SHARE * np.max(predicted)
    speaking = [int(k) for k in np.flatnonzero(loud & (np.abs(correlation) > _CLEAR))]
    if not speaking:
        k = int(np.argmax(predicted))
        if correlation[k] > _FAINT and _ALIKE[0] < gain[k] < _ALIKE[1]:
            return  # as the model says, beneath noise or friction of its own size
        yield Finding(
            "torque_unlike_model",
            "warning",
            f"no joint's torque follows the model's (correlation {correlation[k]:.2f} in"
            f" {names[k]}, which should vary by {predicted[k]:.3g} N m)",
            "Check robot, columns and units; if the robot hangs or stands on a wall, set gravity in"
            " its description",
        )
        return
    evidence = joined(
        [
            f"{names[k]} gain {gain[k]:.3g}, correlation {correlation[k]:.3f}"
            for k in sorted(speaking, key=lambda k: -predicted[k])[:3]
        ]
    )
    negative = [k for k in speaking if correlation[k] < 0]
    if len(negative) * 2 > len(speaking):
        yield Finding(
            "torque_flipped",
            "error",
            "the torque sign looks flipped: the measured torque falls where the model's rises"
            f" ({evidence})",
            "The log gives the load's torque, not the drive's: use --flip-torque, or sign = -1 in a"
            " recording sheet",
        )
    sign = -1.0 if len(negative) * 2 > len(speaking) else 1.0
    scale = float(np.median([abs(gain[k]) for k in speaking]))
    for k in range(model.n_joints):
        against = (
            sign * correlation[k] < -_CLEAR
            if k in speaking
            else loud[k] and sign * correlation[k] < -0.95
        )
        if against and 0.2 < abs(gain[k]) / scale < 5:
            yield Finding(
                "joint_torque_flipped",
                "error",
                f"the torque of {names[k]} alone has the opposite sign of the model's (gain"
                f" {gain[k]:.3g}, correlation {correlation[k]:.3f})",
                "Turn it in a recording sheet: sign ="
                f" [{', '.join('-1' if i == k else '1' for i in range(model.n_joints))}]",
                joint=names[k],
            )
    silent = ~np.isin(np.arange(model.n_joints), speaking)
    friction = sign * fit.friction_correlation if silent.any() else np.zeros(model.n_joints)
    for k in np.flatnonzero(silent & (friction < -_BRAKING)).tolist():
        yield Finding(
            "joint_torque_flipped",
            "warning",
            f"the torque of {names[k]} acts against its motion (correlation with the direction of"
            f" motion {friction[k]:.2f}), as friction does not; its sign may be the opposite of the"
            " other joints'",
            "Turn it in a recording sheet: sign ="
            f" [{', '.join('-1' if i == k else '1' for i in range(model.n_joints))}]",
            joint=names[k],
        )
    if not _PLAUSIBLE[0] < scale < _PLAUSIBLE[1]:
        yield _scale_finding(model, recording, scale, evidence)
        return
    odd = [k for k in speaking if abs(correlation[k]) > 0.95 and not 0.2 < abs(gain[k]) / scale < 5]
    for k in odd:
        yield Finding(
            "joint_torque_scale",
            "warning",
            f"the torque of {names[k]} is {abs(gain[k]):.3g} times the model's while the others are"
            f" about {scale:.3g} times theirs",
            "Check its gain and unit: --gain g1,g2,... or gains = [...] in a recording sheet",
            joint=names[k],
        )


def _scale_finding(model: RobotModel, recording: Survey, scale: float, evidence: str) -> Finding:
    if 300 < scale < 3000:
        guess, cure = (
            "they look like mN m",
            'Write units = { torque = "mN m" } in a recording sheet',
        )
    elif scale < 0.3 and (scale > 0.005 or recording.torque_source == "current"):
        guess = "they look like motor currents without gains"
        cure = (
            "Give the gains in N m/A, one per joint: --gain g1,g2,... or gains = [...] in a"
            " recording sheet, and --torque-source current"
        )
    else:
        guess, cure = (
            "their unit or the robot is another",
            "Give the factor to N m: --gain G, or units in a recording sheet",
        )
    return Finding(
        "torque_scale",
        "error",
        f"the torques are {scale:.3g} times those of {model.name} ({evidence}): {guess}",
        cure,
    )


def _saturation(model: RobotModel, recording: Survey, closer: CloserLook) -> Iterator[Finding]:
    """Find torques that stay at an extreme value, or reach the joint's torque limit."""
    fresh = np.flatnonzero(recording.fresh)
    for k, joint in enumerate(model.joints):
        for plateau in closer.plateaus[k]:
            flat = plateau.places.size
            longest, start = _longest_run(plateau.places)
            usual = (plateau.n_near - flat) / max(1, plateau.near.size - 1)
            if longest >= _PLATEAU_RUN and flat > 8 * max(usual, 1.0):
                yield Finding(
                    "saturation",
                    "warning",
                    f"the torque of {joint.name} stays at {plateau.extreme:.5g} N m in {flat} of"
                    f" {fresh.size} samples, up to {longest} in a row: it is cut off there",
                    "Leave these stretches out with time windows in a recording sheet, or record a"
                    " gentler motion",
                    joint=joint.name,
                    time=float(recording.t[fresh[start]]),
                )
        limit, over = joint.limits.torque, int(recording.loud.count[k])
        if (
            not closer.plateaus[k]
            or recording.torque_source == "current"
            or not np.isfinite(limit)
            or limit <= 0
        ):
            continue
        if 3 <= over < 0.5 * fresh.size:
            yield Finding(
                "torque_limit",
                "warning",
                f"the torque of {joint.name} reaches {recording.loud.value[k]:.4g} N m in {over} of"
                f" {fresh.size} samples; its limit is {limit:.4g} N m",
                "Record a gentler motion if the drive saturates, or check the torque's unit",
                joint=joint.name,
                time=float(recording.t[recording.loud.row[k]]),
            )


def _longest_run(places: Indices) -> tuple[int, int]:
    """Return how many of rising places follow each other without a break at most, and the first of
    them.
    """
    if not places.size:
        return 0, 0
    starts = np.flatnonzero(np.diff(places, prepend=places[0] - 2) != 1)
    lengths = np.diff(starts, append=places.size)
    longest = int(np.argmax(lengths))
    return int(lengths[longest]), int(places[starts[longest]])


def _filtered(torques: Sequence[Array], rate: float) -> Iterator[Finding]:
    """Find torques (N, n) without the noise floor of a sensor.

    Power at high frequency below 1e-9 of the peak's, in most joints; several pieces are averaged.
    """
    shortest = min((len(tau) for tau in torques if len(tau) >= _SHORTEST), default=0)
    if not shortest or not np.isfinite(rate):
        return
    spectra = [
        _spectrum(tau, rate, min(1024, shortest)) for tau in torques if len(tau) >= _SHORTEST
    ]
    frequency, power = spectra[0][0], np.mean([power for _, power in spectra], axis=0)
    peak = power.max(axis=0)
    if not np.any(peak > 0):
        return
    relative = power[:, peak > 0] / peak[peak > 0]
    floor = np.median(relative[frequency > 0.35 * rate], axis=0)
    if np.median(floor) > _QUIET_FLOOR:
        return
    middle = np.median(relative, axis=1)
    last = int(np.flatnonzero(middle > max(100 * float(np.median(floor)), 1e-9))[-1])
    yield Finding(
        "already_filtered",
        "info",
        f"the torques hold nothing above about {frequency[last]:.2g} Hz (power at high frequency is"
        f" {np.median(floor):.0e} of the peak's): they were low-pass filtered before, or simulated"
        " without noise",
        "Filtering again adds little; where positions and torques were filtered differently, the"
        " errors of the parameters are too small",
    )


def _spectrum(tau: Array, rate: float, length: int) -> tuple[Array, Array]:
    trend = np.linspace(-1.0, 1.0, tau.shape[0])[:, None]
    level = tau - tau.mean(axis=0)
    level = level - trend * (trend * level).sum(axis=0) / np.sum(trend**2)
    frequency, power = welch(level, fs=rate, nperseg=length, axis=0)
    return frequency, power
