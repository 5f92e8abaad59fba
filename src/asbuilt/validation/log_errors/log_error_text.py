"""What is said of errors of a log."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from asbuilt.errors import AsbuiltError
from asbuilt.findings import Cure, Finding, joined
from asbuilt.identification.calibration.mounting import Mounting
from asbuilt.tables import significant
from asbuilt.validation.log_errors.error_columns import Kind
from asbuilt.validation.log_errors.log_error_search import LogError
from asbuilt.validation.log_errors.log_errors import Sought, sought_errors
from asbuilt.validation.log_errors.plateaus import Plateau, plateaus, without_plateaus
from asbuilt.validation.prediction import torque_units

if TYPE_CHECKING:
    from asbuilt.experiment.signal.samples import Samples
    from asbuilt.identification.result.result import IdentificationResult

UNSEEN = 0.05
"""Error of the clock, as a share, that a log should show."""
ZERO_UNSEEN, LENGTH_UNSEEN, GAIN_UNSEEN = np.deg2rad(2.0), 0.01, 0.1
"""Errors of a zero position [rad, m] and of a gain, as a share, that a log should show."""
DEAD = 0.15
"""Part of the model's torque below which a torque channel does not follow the motion."""


def log_error_findings(
    result: IdentificationResult,
    training: Sequence[Samples],
    *,
    mounting: Mounting | None = None,
    block_seconds: float | None = None,
) -> tuple[Finding, ...]:
    """Return findings that name the errors of the log which the residual shows.

    The mounting is that of `log_errors`.
    """
    flat = _plateaus(result, training, block_seconds)
    rest = without_plateaus(training, flat) if flat else training
    sought = sought_errors(result, rest, mounting=mounting, block_seconds=block_seconds)
    held = sorted({each.joint for each in flat})
    named = [result.joint_names[joint] for joint in held]
    others = [each for each in sought.errors if each.kind != "nonlinear" or each.joint not in named]
    return (
        *(_saturated(result, joint, flat) for joint in held),
        *_findings(result, others),
        *_unseen_clock(sought),
        *_unseen_zeros(result, sought),
        *_unseen_gains(result, sought),
    )


def _unseen_clock(sought: Sought) -> Iterator[Finding]:
    """Say which error of the clock the log would not show."""
    if sought.clock_unseen < UNSEEN or any(each.kind == "clock" for each in sought.errors):
        return
    size = (
        f"below {significant(100 * sought.clock_unseen, 2)} % would not show"
        if np.isfinite(sought.clock_unseen)
        else "of any size would not show"
    )
    yield Finding(
        "clock_unseen",
        "info",
        f"An error of the clock {size} in this log: other parameters take its place",
        Cure("compare the sampling rate with another clock, or record faster motions as well"),
    )


def _unseen_zeros(result: IdentificationResult, sought: Sought) -> Iterator[Finding]:
    """Say which errors of zero positions the log would not show."""
    turns = [joint.is_revolute for joint in result.model.joints]
    rows = [
        (size, f"{significant(np.rad2deg(size), 2)} deg" if turn else f"{1e3 * size:.0f} mm", joint)
        for joint, turn, size in zip(result.joint_names, turns, sought.zero_unseen, strict=False)
        if size > (ZERO_UNSEEN if turn else LENGTH_UNSEEN)
    ]
    if rows:
        yield Finding(
            "zero_unseen",
            "info",
            f"Errors of zero positions would not show in this log {_listed_unseen(rows)}: other"
            " parameters take their place, or the residual hides them",
            Cure("calibrate these joints, or record more poses"),
        )


def _unseen_gains(result: IdentificationResult, sought: Sought) -> Iterator[Finding]:
    """Say which errors of single gains the log would not show."""
    rows = [
        (size, f"{significant(100 * size, 2)} %", joint)
        for joint, size in zip(result.joint_names, sought.gain_unseen, strict=False)
        if size > GAIN_UNSEEN
    ]
    if rows:
        yield Finding(
            "gain_unseen",
            "info",
            f"Errors of single torque gains would not show in this log {_listed_unseen(rows)}:"
            " other parameters take their place, or the residual hides them",
            Cure("a payload of known mass calibrates them (`gains`)"),
        )


def _listed_unseen(rows: Sequence[tuple[float, str, str]]) -> str:
    """Return sizes and joints as text, those of any size last."""
    sized = [f"below {text} at {joint}" for size, text, joint in rows if np.isfinite(size)]
    never = [joint for size, _, joint in rows if not np.isfinite(size)]
    return joined([*sized, *([f"of any size at {joined(never)}"] if never else [])])


def _plateaus(
    result: IdentificationResult, training: Sequence[Samples], block_seconds: float | None
) -> tuple[Plateau, ...]:
    """Return the torques that saturate, none where the samples cannot be fitted again."""
    try:
        return plateaus(result.model, result.base, training, block_seconds)
    except (AsbuiltError, np.linalg.LinAlgError):
        return ()


def _saturated(result: IdentificationResult, joint: int, flat: Sequence[Plateau]) -> Finding:
    own = [each for each in flat if each.joint == joint]
    name, unit = result.joint_names[joint], torque_units(result.model)[joint]
    levels = joined([f"{each.level:.4g}" for each in own])
    implied = joined([f"{each.implied:.4g}" for each in own])
    return Finding(
        "torque_saturates",
        "warning",
        f"The torque of {name} stays at {levels} {unit} where its motion, by a fit to the rest of"
        f" the log, asks for up to {implied} {unit}: the drive or the sensor saturates",
        Cure(
            "leave these times out by [[windows]] in a recording sheet, record a gentler motion, or"
            " check the range of the sensor"
        ),
        joint=name,
    )


def _findings(result: IdentificationResult, found: Sequence[LogError]) -> Iterator[Finding]:
    for each in found:
        if each.kind not in _SAID:
            continue
        said = _SAID[each.kind](result, each)
        explained = f"; that explains {100 * each.share:.0f} % of the squared residual"
        if each.instead:
            explained += (
                f", and an error of {' or '.join(each.instead)} would explain about as much"
            )
        yield replace(said, message=said.message + explained, joint=each.joint)


def _clock(result: IdentificationResult, each: LogError) -> Finding:
    pace = "faster" if each.value > 0 else "slower"
    factor = f"{1.0 / (1.0 + each.value):.4g}"
    return Finding(
        "clock_wrong",
        "warning",
        f"The torques are those of a motion {_percent(each)} {pace} than the clock of the log says:"
        " only then do masses act alike by gravity and by acceleration",
        Cure(
            f"check the sampling rate; if it is wrong, multiply the times by {factor}"
            f" (time_factor = {factor} in a recording sheet), or the rate by {1.0 + each.value:.4g}"
        ),
    )


def _zero(result: IdentificationResult, each: LogError) -> Finding:
    k = result.model.joint_names.index(str(each.joint))
    revolute = result.model.joints[k].is_revolute
    scale, unit = (np.rad2deg(1.0), "deg") if revolute else (1e3, "mm")
    zero = ["0"] * result.model.n_joints
    zero[k] = f"{each.value:.3g}"
    return Finding(
        "zero_position_wrong",
        "warning",
        f"Positions of {each.joint} seem logged"
        f" {_size(abs(scale * each.value), scale * each.std_error)} {unit} too"
        f" {'large' if each.value > 0 else 'small'}: the zero position is not the description's",
        Cure(
            "check the calibration of the joint, or correct it in a recording sheet:"
            f" zero = [{', '.join(zero)}]"
        ),
    )


def _scale(result: IdentificationResult, each: LogError) -> Finding:
    factor = _size(1.0 + each.value, each.std_error)
    if 1.0 + each.value < DEAD:
        return Finding(
            "torque_does_not_follow",
            "warning",
            f"The torque of {each.joint} is {factor} of what the motion and the other joints imply:"
            " it is another quantity, or its sensor fails",
            Cure("check the column and the sensor"),
        )
    gains = ["1"] * result.model.n_joints
    gains[result.model.joint_names.index(str(each.joint))] = f"{1.0 / (1.0 + each.value):.3g}"
    return Finding(
        "joint_gain_wrong",
        "warning",
        f"The torque of {each.joint} is {factor} of what its own motion and the other joints imply",
        Cure(
            "check its gain; to agree with the others, multiply it in a recording sheet by gains ="
            f" [{', '.join(gains)}]"
        ),
    )


def _nonlinear(result: IdentificationResult, each: LogError) -> Finding:
    return Finding(
        "torque_saturates",
        "warning",
        f"The largest torques of {each.joint} are {_percent(each)} smaller than the small ones"
        " imply: the drive or the sensor saturates, or a gain depends on the torque",
        Cure("record a gentler motion, or check the range of the sensor"),
    )


def _drift(result: IdentificationResult, each: LogError) -> Finding:
    unit = torque_units(result.model)[result.model.joint_names.index(str(each.joint))]
    return Finding(
        "torque_drifts",
        "warning",
        f"The torque of {each.joint} drifts by {_size(each.value, each.std_error)} {unit} over the"
        " recording",
        Cure("let the sensor warm up and set it to zero, or identify shorter parts"),
    )


def _warming(result: IdentificationResult, each: LogError) -> Finding:
    return Finding(
        "friction_drifts",
        "warning",
        f"Friction of {each.joint} {'rises' if each.value > 0 else 'falls'} by {_percent(each)}"
        " over the recording, as that of a drive whose temperature changes; its parameters are"
        " those of the middle",
        Cure("record cold and warm robots separately"),
    )


_SAID: dict[Kind, Callable[[IdentificationResult, LogError], Finding]] = {
    "clock": _clock,
    "zero": _zero,
    "scale": _scale,
    "nonlinear": _nonlinear,
    "drift": _drift,
    "warming": _warming,
}


def _percent(each: LogError) -> str:
    return f"{_size(100 * abs(each.value), 100 * each.std_error)} %"


def _size(value: float, error: float) -> str:
    """Return a value with its error, both to the second digit of the error."""
    digits = max(0, 1 - int(np.floor(np.log10(error)))) if error > 0.0 else 3
    return f"{value:.{digits}f} +- {error:.{digits}f}"
