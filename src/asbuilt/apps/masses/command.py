"""The command that computes link masses."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import asbuilt
from asbuilt import (
    UsageError,
    writers,
)
from asbuilt.apps import masses as app
from asbuilt.cli import (
    AsJson,
    Full,
    Robot,
    answer,
    describe_cure,
    list_files,
    require_known_value,
    written_file,
)
from asbuilt.findings import list_findings


def masses(
    robot: Robot,
    meshes: Annotated[
        Path | None,
        typer.Option("--meshes", metavar="DIR", help="folder with the meshes of the URDF"),
    ] = None,
    density: Annotated[
        str | None,
        typer.Option("--density", metavar="LIST", help="kg/m^3: 2700, or link_1=2700,link_2=1050"),
    ] = None,
    material: Annotated[
        str | None,
        typer.Option("--material", metavar="LIST", help="aluminium, or link_1=steel,link_2=abs"),
    ] = None,
    table: Annotated[
        Path | None,
        typer.Option("--table", metavar="FILE", help="mass properties that a CAD program wrote"),
    ] = None,
    about: Annotated[
        str | None,
        typer.Option("--about", metavar="POINT", help="of the table's inertia: com or origin"),
    ] = None,
    products: Annotated[
        str | None,
        typer.Option("--products", metavar="SIGN", help="of the table: tensor or integral"),
    ] = None,
    geometry: Annotated[
        str,
        typer.Option("--geometry", metavar="KIND", help="visual or collision, where both exist"),
    ] = "visual",
    out: Annotated[
        Path | None,
        written_file(text="robot with the computed mass properties, .urdf or .toml"),
    ] = None,
    full: Full = False,
    as_json: AsJson = False,
) -> None:
    """Compute mass properties of links from meshes and materials or from a CAD table.

    The table compares them with the description, the least plausible first. Without densities,
    materials and table, each link keeps its mass, spread evenly over its geometry.
    """
    found = asbuilt.link_masses(
        asbuilt.load_robot(robot),
        meshes=meshes,
        density=_parse_numbers(_parse_by_link("--density", density)),
        material=_parse_by_link("--material", material),
        table=table,
        about=None if about is None else require_known_value("--about", about, ("com", "origin")),
        products=None
        if products is None
        else require_known_value("--products", products, ("tensor", "integral")),
        prefer=require_known_value("--geometry", geometry, ("visual", "collision")),
    )
    files = {}
    notes = {}
    if out is not None:
        files["robot"], note = app.write_masses(out, found)
        notes["robot"] = note
    lines = list_findings(found.findings, describe_cure, full=full)
    answer(
        as_json,
        lambda: writers.with_files(app.masses_document(found), files),
        lambda: (
            "\n".join([app.masses_table(found).as_text(full), *lines]) + list_files(files, notes)
        ),
    )


def _parse_by_link(option: str, text: str | None) -> str | dict[str, str] | None:
    """Return one value for all links, or values by link."""
    if text is None or "=" not in text:
        return text
    pairs = [entry.partition("=") for entry in text.split(",")]
    if any(not name.strip() or not value.strip() for name, _, value in pairs):
        raise UsageError(f"{option} must be one value or LINK=VALUE,..., got {text!r}")
    return {name.strip(): value.strip() for name, _, value in pairs}


def _parse_numbers(given: str | dict[str, str] | None) -> float | dict[str, float] | None:
    try:
        if isinstance(given, dict):
            return {name: float(value) for name, value in given.items()}
        return None if given is None else float(given)
    except ValueError as error:
        raise UsageError(f"--density takes numbers in kg/m^3: {error}") from None
