"""Drive terms in tables."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from asbuilt.dynamics.drives.selection import available_terms
from asbuilt.identification.calibration.torque_gains import TorqueGains
from asbuilt.identification.calibration.two_channels import TwoChannelEstimate
from asbuilt.identification.drives.motor_side import MotorSideParameter
from asbuilt.tables import Column, Table, percent, plus_minus, stacked

USE = """\
Terms are chosen as --drive viscous,coulomb,offset; armature is added by default for torques from motors and currents.
Options follow colons: stribeck:velocity=0.05 for all joints, smooth_coulomb:width=0.02/0.01/0.02 one per joint, spring:joints=2/5 at some joints.
An option in brackets that is not stated is fitted to the recording, joint by joint, within what is credible. --drive auto chooses among the terms marked *
where they are credible and lower the error on held-out time blocks; --drive auto,spring:joints=2 has a spring besides."""


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


def drives_text() -> str:
    """Return the drive terms as a table, with how to choose them."""
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
        Column("parameters"),
        Column("torque"),
        Column("options"),
        Column("units"),
    )
    return Table(columns, tuple(rows)).as_text() + "\n" + USE


def gains_document(found: TorqueGains) -> dict[str, Any]:
    """Return gains as plain data.

    `gain` is the list that stands in place of those in use, `option` and `sheet` the same as text.
    """
    return {
        "joints": list(found.joint_names),
        "gains": [_number(value) for value in found.gains],
        "std_errors": [_number(value) for value in found.std_errors],
        "in_use": found.in_use.tolist(),
        "factors": [_number(value) for value in found.factors],
        "factor_std_errors": [_number(value) for value in found.factor_std_errors],
        "determined": found.determined.tolist(),
        "gain": [float(value) for value in _listed(found).split(",")],
        "option": f"--gain={_listed(found)}",
        "sheet": _sheet_line(found),
        "payload_share": [_number(value) for value in found.payload_share],
        "known": list(found.known),
        "frame": found.frame,
        "payload": found.payload.tolist(),
        "sources": list(found.sources),
        "notes": list(found.sentences()),
    }


def gains_text(found: TorqueGains) -> str:
    """Return gains as a table with what they rest on, and the option and the line of a recording
    sheet that put them to use.
    """
    rows = [
        (
            name,
            f"{used:g}",
            plus_minus(float(factor), float(factor_error)),
            plus_minus(float(gain), float(error)),
            f"{100 * share:.0f}" if share >= 0.0 else "-",
            "yes" if told else "NO",
        )
        for name, used, factor, factor_error, gain, error, share, told in zip(
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
    columns = (
        Column("joint"),
        Column("gain in use", align="right"),
        Column("off by"),
        Column("torque per logged unit"),
        Column("payload in torque", "%", "right"),
        Column("told"),
    )
    lines = [Table(columns, tuple(rows)).as_text().rstrip()]
    lines += [
        f"[{number}] {sentence[0].upper()}{sentence[1:]}."
        for number, sentence in enumerate(found.sentences(), start=1)
    ]
    if found.determined.any():
        lines += [
            "In place of the gains in use, give the next command",
            f"  --gain={_listed(found)}",
        ]
        lines += ["or write into the recording sheet", f"  {_sheet_line(found)}"]
    return "\n".join(lines)


def _listed(found: TorqueGains) -> str:
    return ",".join(f"{gain:.6g}" for gain in found.to_use)


def _sheet_line(found: TorqueGains) -> str:
    return f"gains = [{_listed(found).replace(',', ', ')}]"


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
        "undetermined": list(found.estimate.undetermined),
    }


def channels_text(found: TwoChannelEstimate) -> str:
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
    errors = tuple(
        zip(found.joint_names, found.rms_sensor.tolist(), found.rms_motor.tolist(), strict=True)
    )
    notes = [
        "Side link: felt by sensors and motors alike; side motor: by the motors alone, named with"
        " an m. Standard errors allow for residual correlation."
    ]
    if found.estimate.undetermined:
        notes.append(f"NOT TOLD by this motion: {'; '.join(found.estimate.undetermined)}.")
    columns = (
        Column("parameter"),
        Column("unit"),
        Column("side"),
        Column("value"),
        Column("%", align="decimal"),
    )
    title = (
        f"{found.robot}: sensors and motors together, {len(found.names)} parameters,"
        f" {int(found.of_motor_side.sum())} of them of the motor side"
    )
    tables = (
        Table(columns, tuple(rows), title=title, notes=tuple(notes)),
        Table(
            (
                Column("joint"),
                Column("RMS sensor", "N m", "decimal", ".3g"),
                Column("RMS motor", "N m", "decimal", ".3g"),
            ),
            errors,
        ),
    )
    return stacked(tables)


def motor_side_table(parameters: Sequence[MotorSideParameter]) -> Table:
    """List drive parameters at the joint and at the motor's shaft."""
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
