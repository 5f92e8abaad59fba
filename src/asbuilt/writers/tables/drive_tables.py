"""Drive terms in tables."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from typing import Any

from asbuilt.dynamics.drives.selection import available_terms
from asbuilt.findings import joined
from asbuilt.identification.calibration.torque_gains import TorqueGains
from asbuilt.identification.calibration.two_channels import TwoChannelEstimate
from asbuilt.identification.drives.motor_side import MotorSideParameter
from asbuilt.tables import Column, Table, percent, plus_minus, stacked

MOST_NOTES, MOST_ROWS = 3, 14
"""Notes and rows of a short text."""
USE = (
    "Terms are listed as viscous,coulomb,offset; armature is a default for torques from motors and"
    " currents.",
    "Options follow colons: stribeck:velocity=0.05 for all joints,"
    " smooth_coulomb:width=0.02/0.01/0.02 for each joint, spring:joints=2/5 for some joints.",
    "An option in brackets is fitted to the recording of each joint unless it is stated.",
    "auto chooses among the terms marked *: those that lower the error on held-out time blocks."
    " auto,spring:joints=2 adds a spring.",
)


def drives_document() -> dict[str, Any]:
    """Return the drive terms as plain data."""
    return {
        "drives": [
            {
                "key": term.key,
                "parameters": list(term.symbols),
                "formula": term.formula,
                "units": list(term.units(revolute=True)),
                "default_for": list(term.default_for),
                "tried_for": list(term.tried_for),
                "stands_for": term.stands_for,
                "options": [
                    {
                        "name": s.name,
                        "default": s.default,
                        "lower": s.lower,
                        "upper": s.upper,
                        "credible": _number_pair(s.credible),
                        "of_top_speed": s.speed,
                        "unit": s.unit,
                        "fitted": s.fitted,
                    }
                    for s in term.nonlinear
                ],
                "does": (type(term).__doc__ or "").splitlines()[0],
            }
            for term in available_terms().values()
        ]
    }


def drives_text(full: bool = False) -> str:
    """Return the drive terms as a table, and how to choose them; with units if `full`."""
    rows = []
    for term in available_terms().values():
        options = ", ".join(
            f"[{s.name} {s.default:g}]" if s.fitted else f"{s.name} {s.default:g}"
            for s in term.nonlinear
        )
        rows.append(
            (
                term.key + ("*" if term.tried_for else ""),
                " ".join(term.symbols),
                term.formula,
                options or "-",
                ", ".join(term.units(revolute=True)),
            )
        )
    columns = (
        Column("term"),
        Column("parameters", detail=True),
        Column("torque"),
        Column("options"),
        Column("units", detail=True),
    )
    return Table(columns, tuple(rows), notes=USE).as_text(full)


def gains_document(found: TorqueGains) -> dict[str, Any]:
    """Return gains as plain data; `option` and `sheet` are the gains to use as text."""
    return {
        "joints": list(found.joint_names),
        "gains": [_number(value) for value in found.gains],
        "std_errors": [_number(value) for value in found.std_errors],
        "in_use": found.in_use.tolist(),
        "factors": [_number(value) for value in found.factors],
        "factor_std_errors": [_number(value) for value in found.factor_std_errors],
        "determined": found.determined.tolist(),
        "gain": [float(value) for value in _listed(found).split(",")],
        "option": _option(found),
        "of_command": found.of_command,
        "sheet": _sheet_line(found),
        "payload_share": [_number(value) for value in found.payload_share],
        "known": list(found.known),
        "frame": found.frame,
        "payload": found.payload.tolist(),
        "sources": list(found.sources),
        "notes": list(found.sentences()),
    }


def gains_text(found: TorqueGains, full: bool = False) -> str:
    """Return gains as a table, and the option and the line of a recording sheet that use them."""
    columns = (
        Column("joint"),
        Column("gain in use", align="right", style="g", detail=found.of_command),
        Column("factor", detail=found.of_command),
        Column("kp [N m/rad]" if found.of_command else "torque per logged unit"),
        Column("payload", "% of torque", "right"),
        Column("determined"),
    )
    rows = [
        (
            name,
            float(used),
            plus_minus(float(factor), float(factor_error)),
            plus_minus(float(gain), float(error)),
            f"{100 * share:.0f}" if share >= 0.0 else "-",
            "yes" if determined else "NO",
        )
        for name, used, factor, factor_error, gain, error, share, determined in zip(
            found.joint_names,
            found.in_use,
            found.factors,
            found.factor_std_errors,
            found.gains,
            found.std_errors,
            found.payload_share,
            found.determined,
            strict=True,
        )
    ]
    notes = tuple(f"{text[0].upper()}{text[1:]}." for text in found.sentences())
    shown = notes if full else notes[:MOST_NOTES]
    text = Table(columns, tuple(rows), title="Torque gains", notes=shown).as_text(full)
    if not found.determined.any():
        return text
    return "\n".join(
        [
            text,
            "Instead of the gains in use:",
            f"  {_option(found)}",
            "or in the recording sheet:",
            f"  {_sheet_line(found)}\n",
        ]
    )


def _listed(found: TorqueGains) -> str:
    return ",".join(f"{gain:.6g}" for gain in found.to_use)


def _option(found: TorqueGains) -> str:
    if not found.of_command:
        return f"--gain={_listed(found)}"
    return "--kp=" + ",".join(str(each) for each in _stiffnesses(found))


def _sheet_line(found: TorqueGains) -> str:
    if not found.of_command:
        return f"gains = [{_listed(found).replace(',', ', ')}]"
    return "kp = " + json.dumps(_stiffnesses(found))


def _stiffnesses(found: TorqueGains) -> list[float | str]:
    """Return the stiffness of each servo, "auto" if it is undetermined."""
    return [
        float(f"{gain:.6g}") if determined else "auto"
        for gain, determined in zip(found.gains, found.determined, strict=True)
    ]


def _number_pair(values: tuple[float, float]) -> list[float | None]:
    return [_number(value) for value in values]


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def channels_document(found: TwoChannelEstimate) -> dict[str, Any]:
    """Return an estimate from sensors and motors together as plain data."""
    return {
        "robot": found.robot,
        "joints": list(found.joint_names),
        "parameters": [
            {
                "name": name,
                "unit": unit,
                "side": "motor" if motor else "link",
                "estimate": float(value),
                "std_error": float(error),
            }
            for name, unit, motor, value, error in zip(
                found.names,
                found.units,
                found.of_motor_side,
                found.values,
                found.std_errors,
                strict=True,
            )
        ],
        "rms_sensor": found.rms_sensor.tolist(),
        "rms_motor": found.rms_motor.tolist(),
        "motor_scale": [
            {"joint": name, "estimate": _number(scale), "std_error": _number(error)}
            for name, scale, error in zip(
                found.joint_names, found.scales.tolist(), found.scale_errors.tolist(), strict=True
            )
        ],
        "warnings": [{"code": each.code, "message": each.text} for each in found.findings],
        "undetermined": list(found.estimate.undetermined),
    }


def channels_text(found: TwoChannelEstimate, full: bool = False) -> str:
    """Return an estimate from sensors and motors together as tables."""
    rows = [
        (name, unit, "motor" if motor else "link", plus_minus(value, error), percent(value, error))
        for name, unit, motor, value, error in zip(
            found.names,
            found.units,
            found.of_motor_side,
            found.values.tolist(),
            found.std_errors.tolist(),
            strict=True,
        )
    ]
    values = list(zip(found.values.tolist(), found.std_errors.tolist(), strict=True))
    errors = tuple(
        (name, sensor, motor, plus_minus(scale, error))
        for name, sensor, motor, scale, error in zip(
            found.joint_names,
            found.rms_sensor.tolist(),
            found.rms_motor.tolist(),
            found.scales.tolist(),
            found.scale_errors.tolist(),
            strict=True,
        )
    )
    notes = [
        f"UNDETERMINED by this motion: {text}."
        for text in [joined(found.estimate.undetermined)]
        if found.estimate.undetermined
    ]
    details = (
        "Side link: torque that sensors and motors measure; side motor (names with m): torque that"
        " motors alone measure. Standard errors allow for residual correlation.",
    )
    columns = (
        Column("parameter"),
        Column("unit"),
        Column("side"),
        Column("value"),
        Column("%", align="decimal"),
    )
    n_motor = int(found.of_motor_side.sum())
    title = (
        f"{found.robot}: sensors and motors together, {len(found.names)} parameters, {n_motor} of"
        " them of the motor side"
    )
    size = [abs(value) / error if error > 0 else 0.0 for value, error in values]
    order = sorted(range(len(size)), key=lambda k: -size[k])[:MOST_ROWS]
    parameters = Table(
        columns, tuple(rows), title, tuple(notes), details, important=tuple(sorted(order))
    )
    heads = (
        Column("joint"),
        Column("RMS sensor", "N m", "decimal", ".3g"),
        Column("RMS motor", "N m", "decimal", ".3g"),
        Column("motor / sensor"),
    )
    return stacked((Table(heads, errors), parameters), full)


def motor_side_table(parameters: Sequence[MotorSideParameter]) -> Table:
    """Return drive parameters at the joint and at the shaft of the motor."""
    rows = [
        (
            each.name,
            each.unit,
            each.gear_ratio,
            each.joint_side,
            plus_minus(each.motor_side, each.std_error),
        )
        for each in parameters
    ]
    columns = (
        Column("parameter"),
        Column("unit"),
        Column("gear ratio", align="right"),
        Column("at the joint", align="decimal", style=".4g"),
        Column("at the motor"),
    )
    return Table(columns, tuple(rows))
