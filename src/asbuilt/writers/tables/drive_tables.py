"""Drive terms in tables."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

from asbuilt.codec import make_plain
from asbuilt.dynamics import DriveTerm, available_terms
from asbuilt.findings import join_names, list_warnings
from asbuilt.identification import MotorSideParameter, TorqueGains, TwoChannelEstimate
from asbuilt.tables import Column, Table, format_percent, format_plus_minus, stack_tables

MOST_NOTES = 3
MOST_ROWS = 14
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
                        "credible": make_plain(s.credible),
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
    return Table.of(
        available_terms().values(),
        (
            Column("term", of=lambda term: term.key + ("*" if term.tried_for else "")),
            Column("parameters", detail=True, of=lambda term: " ".join(term.symbols)),
            Column("torque", of="formula"),
            Column("options", of=_word_options),
            Column("units", detail=True, of=lambda term: ", ".join(term.units(revolute=True))),
        ),
        notes=USE,
    ).as_text(full)


def _word_options(term: DriveTerm) -> str:
    options = (
        (f"{parameter.name} {parameter.default:g}", parameter.fitted)
        for parameter in term.nonlinear
    )
    return ", ".join(f"[{text}]" if fitted else text for text, fitted in options) or "-"


def gains_document(found: TorqueGains) -> dict[str, Any]:
    """Return gains as plain data; `option` and `sheet` are the gains to use as text."""
    return {
        "joints": list(found.joint_names),
        "gains": make_plain(found.gains),
        "std_errors": make_plain(found.std_errors),
        "in_use": found.in_use.tolist(),
        "factors": make_plain(found.factors),
        "factor_std_errors": make_plain(found.factor_std_errors),
        "determined": found.determined.tolist(),
        "gain": [float(value) for value in _format_gains(found).split(",")],
        "option": _write_option(found),
        "of_command": found.of_command,
        "sheet": _write_sheet_line(found),
        "payload_share": make_plain(found.payload_share),
        "known": list(found.known),
        "frame": found.frame,
        "payload": found.payload.tolist(),
        "sources": list(found.sources),
        "notes": list(found.sentences()),
    }


def gains_text(found: TorqueGains, full: bool = False) -> str:
    """Return gains as a table, and the option and the line of a recording sheet that use them."""
    factors = found.factors
    errors = found.factor_std_errors
    shares = found.payload_share
    gain = "kp [N m/rad]" if found.of_command else "torque per logged unit"
    columns = (
        Column("joint", of=lambda k: found.joint_names[k]),
        Column(
            "gain in use",
            "",
            "right",
            "g",
            None,
            found.of_command,
            lambda k: float(found.in_use[k]),
        ),
        Column(
            "factor", detail=found.of_command, of=lambda k: format_plus_minus(factors[k], errors[k])
        ),
        Column(gain, of=lambda k: format_plus_minus(found.gains[k], found.std_errors[k])),
        Column(
            "payload",
            "% of torque",
            "right",
            of=lambda k: f"{100 * shares[k]:.0f}" if shares[k] >= 0.0 else "-",
        ),
        Column("determined", of=lambda k: "yes" if found.determined[k] else "NO"),
    )
    notes = tuple(f"{text[0].upper()}{text[1:]}." for text in found.sentences())
    shown = notes if full else notes[:MOST_NOTES]
    joints = range(len(found.joint_names))
    use = (
        f"\nInstead of the gains in use:\n  {_write_option(found)}\n"
        f"or in the recording sheet:\n  {_write_sheet_line(found)}\n"
    )
    text = Table.of(joints, columns, "Torque gains", notes=shown).as_text(full)
    return text + (use if found.determined.any() else "")


def _format_gains(found: TorqueGains) -> str:
    return ",".join(f"{gain:.6g}" for gain in found.to_use)


def _write_option(found: TorqueGains) -> str:
    if not found.of_command:
        return f"--gain={_format_gains(found)}"
    return "--kp=" + ",".join(str(stiffnesse) for stiffnesse in _list_stiffnesses(found))


def _write_sheet_line(found: TorqueGains) -> str:
    if not found.of_command:
        return f"gains = [{_format_gains(found).replace(',', ', ')}]"
    return "kp = " + json.dumps(_list_stiffnesses(found))


def _list_stiffnesses(found: TorqueGains) -> list[float | str]:
    """Return each stiffness, "auto" if it is undetermined."""
    return [
        float(f"{gain:.6g}") if determined else "auto"
        for gain, determined in zip(found.gains, found.determined, strict=True)
    ]


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
            {"joint": name, "estimate": make_plain(scale), "std_error": make_plain(error)}
            for name, scale, error in zip(
                found.joint_names, found.scales.tolist(), found.scale_errors.tolist(), strict=True
            )
        ],
        "warnings": list_warnings(found.findings),
        "undetermined": list(found.estimate.undetermined),
    }


def channels_text(found: TwoChannelEstimate, full: bool = False) -> str:
    """Return an estimate from sensors and motors together as tables."""
    values = found.values
    spread = found.std_errors
    scales = found.scales
    doubts = found.scale_errors
    lost = join_names(found.estimate.undetermined)
    n = len(found.names)
    size = [
        abs(value) / error if error > 0 else 0.0
        for value, error in zip(values, spread, strict=True)
    ]
    most = sorted(range(n), key=lambda k: -size[k])[:MOST_ROWS]
    parameters = Table.of(
        range(n),
        (
            Column("parameter", of=lambda k: found.names[k]),
            Column("unit", of=lambda k: found.units[k]),
            Column("side", of=lambda k: "motor" if found.of_motor_side[k] else "link"),
            Column("value", of=lambda k: format_plus_minus(values[k], spread[k])),
            Column("%", align="decimal", of=lambda k: format_percent(values[k], spread[k])),
        ),
        f"{found.robot}: sensors and motors together, {n} parameters,"
        f" {int(found.of_motor_side.sum())} of them of the motor side",
        notes=(f"UNDETERMINED by this motion: {lost}.",) if lost else (),
        details=(
            "Side link: torque that sensors and motors measure; side motor (names with m): torque"
            " that motors alone measure. Standard errors allow for residual correlation.",
        ),
        important=tuple(sorted(most)),
    )
    errors = Table.of(
        range(len(found.joint_names)),
        (
            Column("joint", of=lambda k: found.joint_names[k]),
            Column("RMS sensor", "N m", "decimal", ".3g", of=lambda k: found.rms_sensor[k]),
            Column("RMS motor", "N m", "decimal", ".3g", of=lambda k: found.rms_motor[k]),
            Column("motor / sensor", of=lambda k: format_plus_minus(scales[k], doubts[k])),
        ),
    )
    return stack_tables((errors, parameters), full)


def tabulate_motor_side(parameters: Sequence[MotorSideParameter]) -> Table:
    """Return drive parameters at the joint and at the shaft of the motor."""
    return Table.of(
        parameters,
        (
            Column("parameter", of="name"),
            Column("unit", of="unit"),
            Column("gear ratio", align="right", of="gear_ratio"),
            Column("at the joint", align="decimal", style=".4g", of="joint_side"),
            Column(
                "at the motor",
                of=lambda parameter: format_plus_minus(parameter.motor_side, parameter.std_error),
            ),
        ),
    )
