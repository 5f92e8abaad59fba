"""A robot in tables: geometry, mass properties, limits, drives, and its base parameters."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.formats.document import model_document
from asbuilt.description.model import ROOT, Joint, Link, RobotModel
from asbuilt.description.plausibility import check_plausibility, explain_implausible_links
from asbuilt.description.rotation import is_about_digits
from asbuilt.dynamics import BaseParameters, parameter_values
from asbuilt.findings import Cure, join_names, list_findings
from asbuilt.tables import Cell, Column, Table, stack_tables, wrap_text

MOST_ROWS = 24
"""Base parameters in a short text."""


def robots_table(models: Sequence[RobotModel]) -> Table:
    """List robots: name, joints, total mass, whose facts they are."""
    return Table.of(
        models,
        (
            Column("robot", of="name"),
            Column("joints", align="right", of="n_joints"),
            Column("mass", "kg", "decimal", ".2f", of=_add_up_masses),
            Column("source", width=96, of="citation"),
        ),
    )


def _add_up_masses(model: RobotModel) -> float:
    return float(model.parameters[9::10].sum())


def robots_document(models: Sequence[RobotModel]) -> dict[str, Any]:
    """Return what `asbuilt robots --json` prints."""
    return {
        "robots": [
            {
                "name": model.name,
                "n_joints": model.n_joints,
                "mass": _add_up_masses(model),
                "citation": model.citation,
            }
            for model in models
        ]
    }


def robot_document(model: RobotModel) -> dict[str, Any]:
    """Return what `asbuilt show --json` prints.

    The model, and the reason for every link that is physically inconsistent or implausible.
    """
    reasons = explain_inconsistent_links(model)
    return {
        "robot": model.name,
        "headline": describe_robot_readiness(model),
        "physically_consistent": not reasons,
        "inconsistencies": reasons,
        "implausible": explain_implausible_links(model),
        "findings": [finding.as_dict() for finding in check_plausibility(model)],
        "model": model_document(model),
    }


def explain_inconsistent_links(model: RobotModel) -> dict[str, str]:
    """Return by name why links are physically inconsistent, those that are consistent left out."""
    return {
        link.name: reason
        for link in model.links
        if link.inertia_known and (reason := link.inertia.inconsistency()) is not None
    }


def _name_kind(joint: Joint) -> str:
    if joint.mimic is None or joint.has_motor:
        return joint.kind
    if joint.is_passive:
        return "passive"
    return f"follows {' and '.join(joint.mimic.factors)}"


def tabulate_robot_joints(model: RobotModel) -> Table:
    """List the joints: parent link, placement of the axis in it, limits and described drives."""
    # Both units where only some joints slide.
    unit = ", ".join(sorted({joint.torque_unit for joint in model.moving_joints}, reverse=True))
    columns = [
        Column("joint", of="name"),
        Column("kind", of=_name_kind),
        Column("on link", width=16, of=lambda joint: _name_link(model, joint.parent)),
        Column("axis at", "m", detail=True, of=lambda joint: _format_vector(joint.before[:3, 3])),
        Column("axis along", detail=True, of=lambda joint: _format_vector(joint.before[:3, 2])),
        Column("range", width=22, of=_format_range),
        Column("velocity", "1/s", "decimal", ".4g", of="limits.velocity"),
        Column("torque", unit, "decimal", ".4g", of="limits.torque"),
        Column("Ia", "", "decimal", ".4g", detail=True, of="drive.armature"),
        Column("Fv", "", "decimal", ".4g", detail=True, of="drive.viscous"),
        Column("Fc", "", "decimal", ".4g", detail=True, of="drive.coulomb"),
        Column("further drive terms", detail=True, of=_word_further_terms),
    ]
    if not any(joint.drive.terms for joint in model.joints):
        columns.pop()
    return Table.of(model.moving_joints, columns, "Joints")


def _name_link(model: RobotModel, index: int) -> str:
    return model.root_link if index == ROOT else model.links[index].name


def _format_range(joint: Joint) -> str:
    limits = joint.limits
    if math.isinf(limits.lower) and math.isinf(limits.upper):
        return "-"
    factor, unit = (180.0 / math.pi, "deg") if joint.is_revolute else (1.0, "m")
    return f"{limits.lower * factor:.4g} .. {limits.upper * factor:.4g} {unit}"


def _word_further_terms(joint: Joint) -> str:
    """Return further drive terms with all parameters, such as `stribeck Fs 0.3 velocity 0.05`."""
    return "; ".join(
        " ".join([key, *(f"{name} {value:.4g}" for name, value in numbers.items())])
        for key, numbers in joint.drive.terms.items()
    )


def tabulate_robot_links(model: RobotModel) -> Table:
    """List the links: mass, centre of mass, inertia about it in link axes, and consistency."""
    implausible = explain_implausible_links(model)
    return Table.of(
        model.links,
        (
            Column("link", of="name"),
            Column(
                "mass",
                "kg",
                "decimal",
                of=lambda link: link.inertia.mass if link.inertia_known else None,
            ),
            Column("centre of mass", "m", of=_format_centre),
            Column("Ixx Iyy Izz about it", "kg m^2", of=_format_moments),
            Column("Ixy Ixz Iyz", "kg m^2", detail=True, of=_format_products),
            Column("consistency", of=lambda link: _describe_consistency(link, implausible)),
        ),
        "Links",
    )


def _read_central_inertia(link: Link) -> Array:
    """Return the inertia about the centre of mass, zero without a mass."""
    return link.inertia.inertia_about_com if link.inertia.mass > 0 else np.zeros((3, 3))


def _format_centre(link: Link) -> str:
    return _format_vector(link.inertia.com) if link.has_mass else "-"


def _format_moments(link: Link) -> str:
    return _format_vector(np.diag(_read_central_inertia(link))) if link.inertia_known else "-"


def _format_products(link: Link) -> str:
    about = _read_central_inertia(link)
    products = about[np.triu_indices(3, 1)]
    # Products below this part of the largest moment are rounding.
    entries = np.where(np.abs(products) > 1e-12 * np.abs(about).max(), products, 0.0)
    return _format_vector(entries) if link.inertia_known else "-"


def _describe_consistency(link: Link, implausible: Mapping[str, str]) -> str:
    """Return whether a body has these mass properties, and whether they are there at all."""
    if not link.inertia_known:
        return "not given"
    reason = link.inertia.inconsistency()
    if reason is not None:
        return f"INCONSISTENT: {reason}"
    if not link.inertia.parameters.any():
        return "ALL ZERO: no mass properties"
    if link.name in implausible:
        return "IMPLAUSIBLE: see above"
    return "OK" if np.any(_read_central_inertia(link)) else "ZERO INERTIA: a point mass"


def robot_text(
    model: RobotModel, full: bool = False, cure_text: Callable[[Cure], str] = str
) -> str:
    """Return what `asbuilt show` prints; every column, finding and note if `full`."""
    merged = [f"{frame.name} (on {_name_link(model, frame.link)})" for frame in model.frames]
    known = {"source": model.citation, "read from": model.source}
    known |= {"fixed frames": ", ".join(merged)} if full else {}
    head = (
        describe_robot_readiness(model),
        f"gravity {_format_vector(model.gravity)} m/s^2 in {model.root_link}",
        *(f"{what}: {text}" for what, text in known.items() if text),
        *(f"note: {note}" for note in model.notes if full or not is_about_digits(note)),
    )
    tables = stack_tables((tabulate_robot_joints(model), tabulate_robot_links(model)), full)
    findings = list_findings(check_plausibility(model), cure_text, full=full)
    return "\n".join([*map(wrap_text, head), *findings, "", tables])


def describe_robot_readiness(model: RobotModel) -> str:
    """Return what a user decides by: whether the description can be simulated and compared with."""
    size = f"{model.name}: {model.n_joints} joints, {_add_up_masses(model):.4g} kg moving"
    unknown = [link.name for link in model.links if not link.inertia_known]
    reasons = explain_inconsistent_links(model)
    if reasons:
        name, reason = next(iter(reasons.items()))
        count = f"{len(reasons)} of {model.n_links} links are" if len(reasons) > 1 else f"{name} is"
        return f"{size}; {count} PHYSICALLY INCONSISTENT ({name}: {reason})."
    implausible = explain_implausible_links(model)
    if implausible:
        return f"{size}; IMPLAUSIBLE MASS PROPERTIES of {join_names(list(implausible), 3)}."
    if unknown:
        return f"{size}; no masses are known of {join_names(unknown, 3)}."
    return f"{size}, all links physically consistent."


def base_table(base: BaseParameters, model: RobotModel) -> Table:
    """List the base parameters: id, expression with symbolic lengths, value by design."""
    values = base.values(parameter_values(model, base.drive))
    n = base.n_base
    return Table.of(
        range(n),
        (
            Column("id", align="right", of=lambda k: int(base.ids[k])),
            Column("base parameter", width=54, of=lambda k: base.symbolic[k]),
            Column("unit", of=lambda k: base.units[k]),
            Column("value", align="decimal", of=lambda k: float(values[k])),
        ),
        f"{base.robot}: {n} base parameters of {base.n_standard} standard parameters",
        important=None if n <= 1.2 * MOST_ROWS else tuple(range(MOST_ROWS)),
    )


def identifiability_table(base: BaseParameters) -> Table:
    """List the standard parameters of each link or joint by identifiability."""
    statuses = ("identifiable", "grouped", "unidentifiable")
    places: dict[str, dict[str, list[str]]] = {}
    for parameter in base.standard:
        symbol = parameter.name.rstrip("0123456789")
        found = places.setdefault(parameter.name[len(symbol) :], {name: [] for name in statuses})
        found[parameter.status].append(symbol)
    rows: list[tuple[Cell, ...]] = [
        (int(number), *(" ".join(symbols) or "-" for symbols in found.values()))
        for number, found in places.items()
    ]
    return Table(
        (
            Column("link", align="right"),
            Column("identifiable"),
            Column("in sums only"),
            Column("unidentifiable"),
        ),
        tuple(rows),
        title="Standard parameters",
    )


def standard_table(base: BaseParameters) -> Table:
    """List the standard parameters: identifiable, in which base parameters, and why."""
    return Table.of(
        base.standard,
        (
            Column("id", align="right", of="id"),
            Column("parameter", of="name"),
            Column("status", of="status"),
            Column(
                "in base ids", of=lambda parameter: " ".join(map(str, parameter.members)) or "-"
            ),
            Column("why", of="why"),
        ),
        "Standard parameters",
    )


def _format_vector(values: Iterable[float]) -> str:
    # Three vectors of three numbers and a name fit 80 columns so; files have all digits.
    return " ".join(f"{value + 0.0:.3g}" for value in values)
