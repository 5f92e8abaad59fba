"""Mass properties of links from geometry, materials and tables."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import asbuilt
from asbuilt import writers
from asbuilt.cli.answers import answer, finding_text, listed_files
from asbuilt.cli.arguments.options import AsJson, Full, Robot, described_robot, writable_file
from asbuilt.cli.arguments.spread import one_of
from asbuilt.errors import UsageError


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
        typer.Option(
            "--out",
            "-o",
            metavar="FILE",
            help="robot with the computed mass properties, .urdf or .toml",
            callback=writable_file,
        ),
    ] = None,
    full: Full = False,
    as_json: AsJson = False,
) -> None:
    """Compute mass properties of links from meshes and materials or from a CAD table.

    They stand beside those of the description, the least plausible first. Without densities,
    materials and table, each link keeps its mass, spread evenly over its geometry.
    """
    from asbuilt.tables import wrapped

    densities = _by_link("--density", density)
    found = asbuilt.link_masses(
        described_robot(robot),
        meshes=meshes,
        density=_numbers(densities),
        material=_by_link("--material", material),
        table=table,
        about=None if about is None else one_of("--about", about, ("com", "origin")),
        products=None
        if products is None
        else one_of("--products", products, ("tensor", "integral")),
        prefer=one_of("--geometry", geometry, ("visual", "collision")),
    )
    files, notes = {}, {}
    if out is not None:
        files["robot"], said = writers.write_masses(out, found)
        notes["robot"] = said
    shown = found.findings if full else found.findings[:10]
    lines = [wrapped(finding_text(finding)) for finding in shown]
    if len(found.findings) > len(shown):
        lines.append(f"{len(found.findings) - len(shown)} more findings: --full")
    answer(
        as_json,
        lambda: writers.with_files(writers.masses_document(found), files),
        lambda: (
            "\n".join([writers.masses_table(found).as_text(full), *lines])
            + listed_files(files, notes)
        ),
    )


def _by_link(option: str, text: str | None) -> str | dict[str, str] | None:
    """Return one value for all links, or values by link."""
    if text is None or "=" not in text:
        return text
    pairs = [entry.partition("=") for entry in text.split(",")]
    if any(not name.strip() or not value.strip() for name, _, value in pairs):
        raise UsageError(f"{option} must be one value or LINK=VALUE,..., got {text!r}")
    return {name.strip(): value.strip() for name, _, value in pairs}


def _numbers(given: str | dict[str, str] | None) -> float | dict[str, float] | None:
    try:
        if isinstance(given, dict):
            return {name: float(value) for name, value in given.items()}
        return None if given is None else float(given)
    except ValueError as error:
        raise UsageError(f"--density takes numbers in kg/m^3: {error}") from None
