"""A robot in tables: geometry, mass properties, limits, drives, and its base parameters."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.formats.document import model_document
from asbuilt.description.inertia import LinkInertia
from asbuilt.description.model import ROOT, DriveValues, Joint, RobotModel
from asbuilt.dynamics.base.base_parameters import BaseParameters
from asbuilt.dynamics.parameters import parameter_values
from asbuilt.findings import joined
from asbuilt.tables import Cell, Column, Table, stacked, wrapped

MOST_ROWS = 24
"""Base parameters in a short text."""
ROUNDING = 1e-12
"""Products of inertia below this part of the largest moment are rounding, and shown as zero."""


def robots_table(models: Sequence[RobotModel]) -> Table:
    """List robots: name, joints, total mass, whose facts they are."""
    rows = tuple(
        (model.name, model.n_joints, float(model.parameters[9::10].sum()), model.citation)
        for model in models
    )
    columns = (
        Column("robot"),
        Column("joints", align="right"),
        Column("mass", "kg", "decimal", ".2f"),
        Column("source", width=96),
    )
    return Table(columns, rows)


def robots_document(models: Sequence[RobotModel]) -> dict[str, Any]:
    """Return what `asbuilt robots --json` prints."""
    return {
        "robots": [
            {
                "name": model.name,
                "n_joints": model.n_joints,
                "mass": float(model.parameters[9::10].sum()),
                "citation": model.citation,
            }
            for model in models
        ]
    }


def robot_document(model: RobotModel) -> dict[str, Any]:
    """Return what `asbuilt show --json` prints.

    The model, and the reason for every link that is physically inconsistent.
    """
    inconsistencies = {
        link.name: link.inertia.inconsistency() for link in model.links if link.inertia_known
    }
    return {
        "robot": model.name,
        "headline": robot_headline(model),
        "physically_consistent": all(reason is None for reason in inconsistencies.values()),
        "inconsistencies": {
            name: reason for name, reason in inconsistencies.items() if reason is not None
        },
        "model": model_document(model),
    }


def _kind(joint: Joint) -> str:
    if joint.mimic is None or joint.has_motor:
        return joint.kind
    if joint.is_passive:
        return "passive"
    return f"follows {' and '.join(joint.mimic.factors)}"


def joints_table(model: RobotModel) -> Table:
    """List the joints: parent link, placement of the axis in it, limits and described drives."""
    rows: list[tuple[Cell, ...]] = []
    further = any(joint.drive.terms for joint in model.joints)
    for joint in model.moving_joints:
        parent = model.root_link if joint.parent == ROOT else model.links[joint.parent].name
        degrees = 180.0 / math.pi if joint.is_revolute else 1.0
        limits = joint.limits
        unit = "deg" if joint.is_revolute else "m"
        span = (
            "-"
            if math.isinf(limits.lower) and math.isinf(limits.upper)
            else f"{limits.lower * degrees:.6g} .. {limits.upper * degrees:.6g} {unit}"
        )
        rows.append(
            (
                joint.name,
                _kind(joint),
                parent,
                _vector(joint.before[:3, 3]),
                _vector(joint.before[:3, 2]),
                span,
                limits.velocity,
                limits.torque,
                joint.drive.armature,
                joint.drive.viscous,
                joint.drive.coulomb,
                *([_further_terms(joint.drive)] if further else []),
            )
        )
    columns = (
        Column("joint"),
        Column("kind"),
        Column("on link", width=16),
        Column("axis at", "m", detail=True),
        Column("axis along", detail=True),
        Column("range", width=20),
        Column("velocity", "1/s", "decimal", ".4g"),
        Column("torque", "N m", "decimal", ".4g"),
        Column("Ia", "", "decimal", ".4g", detail=True),
        Column("Fv", "", "decimal", ".4g", detail=True),
        Column("Fc", "", "decimal", ".4g", detail=True),
        *([Column("further drive terms", detail=True)] if further else []),
    )
    return Table(columns, tuple(rows), title="Joints")


def _further_terms(drive: DriveValues) -> str:
    """Return further drive terms with all parameters, such as `stribeck Fs 0.3 velocity 0.05`."""
    return "; ".join(
        " ".join([key, *(f"{name} {value:.4g}" for name, value in numbers.items())])
        for key, numbers in drive.terms.items()
    )


def links_table(model: RobotModel) -> Table:
    """List the links: mass, centre of mass, inertia about it in link axes, and consistency."""
    rows: list[tuple[Cell, ...]] = []
    for link in model.links:
        inertia = link.inertia
        if not link.inertia_known:
            rows.append((link.name, None, "-", "-", "-", "not given"))
            continue
        reason = inertia.inconsistency()
        about_com = inertia.inertia_about_com if inertia.mass > 0 else np.zeros((3, 3))
        com = _vector(inertia.com) if inertia.mass > 0 else "-"
        products = _vector(
            _rounded(
                [about_com[0, 1], about_com[0, 2], about_com[1, 2]], float(np.abs(about_com).max())
            )
        )
        rows.append(
            (
                link.name,
                inertia.mass,
                com,
                _vector(np.diag(about_com)),
                products,
                _verdict(inertia, about_com, reason),
            )
        )
    columns = (
        Column("link"),
        Column("mass", "kg", "decimal", ".6g"),
        Column("centre of mass", "m"),
        Column("Ixx Iyy Izz about it", "kg m^2"),
        Column("Ixy Ixz Iyz", "kg m^2", detail=True),
        Column("consistency"),
    )
    return Table(columns, tuple(rows), title="Links")


def _verdict(inertia: LinkInertia, about_com: Array, reason: str | None) -> str:
    """Return whether a body has these mass properties, and whether they are there at all."""
    if reason is not None:
        return f"INCONSISTENT: {reason}"
    if not inertia.parameters.any():
        return "ALL ZERO: no mass properties"
    return "OK" if np.any(about_com) else "ZERO INERTIA: a point mass"


def robot_text(model: RobotModel, full: bool = False) -> str:
    """Return what `asbuilt show` prints; every column and note if `full`."""
    head = [
        robot_headline(model),
        f"gravity {_vector(model.gravity)} m/s^2 in {model.root_link}",
    ]
    if model.citation:
        head.append(f"source: {model.citation}")
    if model.source:
        head.append(f"read from: {model.source}")
    merged = [
        f"{frame.name} (on"
        f" {model.root_link if frame.link == ROOT else model.links[frame.link].name})"
        for frame in model.frames
    ]
    if merged:
        head.append(f"fixed frames: {', '.join(merged)}")
    lines = [wrapped(line) for line in (*head, *(f"note: {note}" for note in model.notes))]
    tables = stacked((joints_table(model), links_table(model)), full)
    return "\n".join([*lines, "", tables])


def robot_headline(model: RobotModel) -> str:
    """Return what a user decides by: whether the description can be simulated and compared with."""
    mass = f"{model.parameters[9::10].sum():.4g}"
    size = f"{model.name}: {model.n_joints} joints, {mass} kg moving"
    unknown = [link.name for link in model.links if not link.inertia_known]
    reasons = {
        link.name: reason
        for link in model.links
        if link.inertia_known and (reason := link.inertia.inconsistency()) is not None
    }
    if reasons:
        name, reason = next(iter(reasons.items()))
        count = f"{len(reasons)} of {model.n_links} links are" if len(reasons) > 1 else f"{name} is"
        return f"{size}; {count} PHYSICALLY INCONSISTENT ({name}: {reason})."
    if unknown:
        return f"{size}; no masses are known of {joined(unknown, 3)}."
    return f"{size}, all links physically consistent."


def base_table(base: BaseParameters, model: RobotModel) -> Table:
    """List the base parameters: id, expression with symbolic lengths, value by design."""
    values = base.values(parameter_values(model, base.drive))
    rows = tuple(
        (int(number), symbolic, unit, None if np.isnan(value) else float(value))
        for number, symbolic, unit, value in zip(
            base.ids, base.symbolic, base.units, values, strict=True
        )
    )
    columns = (
        Column("id", align="right"),
        Column("base parameter", width=54),
        Column("unit"),
        Column("value", align="decimal", style=".6g"),
    )
    title = f"{base.robot}: {base.n_base} base parameters of {base.n_standard} standard parameters"
    important = None if len(rows) <= 1.2 * MOST_ROWS else tuple(range(MOST_ROWS))
    return Table(columns, rows, title=title, important=important)


def identifiability_table(base: BaseParameters) -> Table:
    """List the standard parameters of each link or joint by identifiability."""
    statuses = ("identifiable", "grouped", "unidentifiable")
    places: dict[str, dict[str, list[str]]] = {}
    for parameter in base.standard:
        symbol = parameter.name.rstrip("0123456789")
        found = places.setdefault(parameter.name[len(symbol) :], {name: [] for name in statuses})
        found[parameter.status].append(symbol)
    rows: list[tuple[Cell, ...]] = [
        (int(number), *(" ".join(found[status]) or "-" for status in statuses))
        for number, found in places.items()
    ]
    columns = (
        Column("link", align="right"),
        Column("identifiable"),
        Column("in sums only"),
        Column("unidentifiable"),
    )
    return Table(columns, tuple(rows), title="Standard parameters")


def standard_table(base: BaseParameters) -> Table:
    """List the standard parameters: identifiable, in which base parameters, and why."""
    rows = tuple(
        (
            parameter.id,
            parameter.name,
            parameter.status,
            " ".join(str(member) for member in parameter.members) or "-",
            parameter.why,
        )
        for parameter in base.standard
    )
    columns = (
        Column("id", align="right"),
        Column("parameter"),
        Column("status"),
        Column("in base ids"),
        Column("why"),
    )
    return Table(columns, rows, title="Standard parameters")


def _rounded(values: Iterable[float], size: float) -> list[float]:
    """Return values with zero in place of those that are rounding beside others of this size."""
    return [value if abs(value) > ROUNDING * size else 0.0 for value in values]


def _vector(values: Iterable[float]) -> str:
    return " ".join(f"{value + 0.0:.5g}" for value in values)
