"""Mass properties of links from geometry and material or from a table, next to the file's."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from asbuilt.apps.masses.mass_findings import (
    LinkMass,
    check_described_mass,
    check_surface,
    sort_by_plausibility,
)
from asbuilt.apps.masses.solids import (
    LENGTH,
    CadLink,
    GeometryKind,
    LinkSolid,
    look_up_density,
    read_solids,
)
from asbuilt.description import (
    Link,
    LinkInertia,
    RobotModel,
    add_plausibility,
    close_match,
    make_link_finding,
    parse_finite_number,
    read_rows,
)
from asbuilt.errors import DescriptionError, UsageError
from asbuilt.findings import Finding


@dataclass(frozen=True, eq=False)
class LinkMasses:
    """Hold the mass properties of all links, the least plausible first, and findings on them."""

    model: RobotModel
    links: tuple[LinkMass, ...]
    findings: tuple[Finding, ...]

    @property
    def computed_model(self) -> RobotModel:
        """The robot with the computed mass properties, where there are any."""
        computed = {link.name: link.computed for link in self.links if link.computed is not None}
        links = (
            Link(name=link.name, inertia=computed[link.name]) if link.name in computed else link
            for link in self.model.links
        )
        return replace(self.model, links=tuple(links))

    def __repr__(self) -> str:
        known = sum(link.computed is not None for link in self.links)
        return (
            f"LinkMasses({self.model.name!r}, {known} of {len(self.links)} links computed,"
            f" {len(self.findings)} findings)"
        )


def link_masses(
    model: RobotModel,
    *,
    meshes: str | os.PathLike[str] | None = None,
    density: float | Mapping[str, float] | None = None,
    material: str | Mapping[str, str] | None = None,
    table: str | os.PathLike[str] | None = None,
    about: Literal["com", "origin"] | None = None,
    products: Literal["tensor", "integral"] | None = None,
    prefer: GeometryKind = "visual",
) -> LinkMasses:
    """Compute the mass properties of links and compare them with the description's.

    Without `density`, `material` and `table`, each link keeps its mass, spread evenly over its
    geometry.

    Parameters
    ----------
    model
        The robot; geometry comes from the URDF file it was read from.
    meshes
        Folder with the meshes; by default they are searched for in the URDF's folder and above.
    density, material
        Density [kg/m^3] or material of all links, or of each by name.
    table
        Table of a CAD program, as `read_cad_table` reads it, in place of geometry.
    about, products
        Conventions of the table: tensor about the centre of mass ("com") or the "origin", products
        as entries of the "tensor" or as the plain "integral" of x y dm.
    prefer
        Geometry that counts where a link has both.

    Returns
    -------
    LinkMasses
        Links, the least plausible first, with findings.

    Raises
    ------
    DescriptionError
        If the robot has no geometry, the folder or a mesh is not there, a material is unknown or
        the table cannot be read.
    UsageError
        If the arguments exclude each other.

    Examples
    --------
    >>> from asbuilt.description.load import load_robot
    >>> link_masses(load_robot("two-link"), density=2700.0)  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    ...
    asbuilt.errors.DescriptionError: two-link does not come from a URDF file, so it has no ...
    """
    if table is not None:
        if density is not None or material is not None or meshes is not None:
            raise UsageError("a table has masses already; leave meshes, density and material out")
        links, findings = _read_table(model, Path(table), about, products)
    else:
        if about is not None or products is not None:
            raise UsageError("about and products are conventions of a table; give one")
        folder = None if meshes is None else Path(meshes)
        if folder is not None and not folder.is_dir():
            raise DescriptionError(f"there is no folder {folder} with meshes", file=str(folder))
        solids = read_solids(model, [] if folder is None else [folder], prefer=prefer)
        links, findings = _weigh_solids(model, solids, _read_materials(model, density, material))
    findings += [found for link in links for found in check_described_mass(link)]
    findings = list(add_plausibility(model, findings))
    return LinkMasses(model, sort_by_plausibility(links, findings), tuple(findings))


def _read_materials(
    model: RobotModel,
    density: float | Mapping[str, float] | None,
    material: str | Mapping[str, str] | None,
) -> dict[str, float] | None:
    """Return densities by link, "" for all others; None if masses of the description count."""
    if density is None and material is None:
        return None
    if density is not None and material is not None and not isinstance(density, Mapping):
        raise UsageError("density and material exclude each other unless each names its links")
    names = (*model.link_names, *(frame.name for frame in model.frames))
    found: dict[str, float] = {}
    for given in (material, density):
        by_link = given if isinstance(given, Mapping) else {} if given is None else {"": given}
        for name, value in by_link.items():
            if name and name not in names:
                raise DescriptionError(
                    f"{model.name} has no link {name!r}{close_match(name, names)}; its links are"
                    f" {', '.join(names)}"
                )
            found[name] = look_up_density(value, f"link {name!r}" if name else model.name)
    return found


def _weigh_solids(
    model: RobotModel, solids: tuple[LinkSolid, ...], densities: Mapping[str, float] | None
) -> tuple[list[LinkMass], list[Finding]]:
    links = list[LinkMass]()
    findings = list[Finding]()
    for k, link in enumerate(model.links):
        own = [solid for solid in solids if solid.link == k]
        findings += [found for solid in own for found in check_surface(link.name, solid)]
        if not own:
            findings.append(
                make_link_finding("no_geometry", "info", link.name, "it has no geometry")
            )
        parts = dict(link.parts) or {link.name: link.inertia}
        sized = [solid for solid in own if solid.has_plausible_size]
        values = [_find_density(solid, link.name, densities, parts) for solid in sized]
        scaled = [
            value * solid.inertia.parameters
            for solid, value in zip(sized, values, strict=True)
            if value is not None and not solid.missing
        ]
        known = [solid.corners for solid in sized if len(solid.corners)]
        corners = np.concatenate(known or [np.full((1, 3), np.nan)])
        links.append(
            LinkMass(
                link.name,
                link.inertia if link.inertia_known else None,
                LinkInertia(np.sum(scaled, axis=0)) if 0 < len(scaled) == len(own) else None,
                own[0].kind if own else "",
                sum(solid.inertia.mass for solid in sized) or float("nan"),
                corners.min(axis=0),
                corners.max(axis=0),
            )
        )
    return links, findings


def _find_density(
    solid: LinkSolid,
    carrier: str,
    densities: Mapping[str, float] | None,
    parts: Mapping[str, LinkInertia],
) -> float | None:
    if densities is not None:
        names = [name for name in (solid.name, carrier, "") if name in densities]
        return densities[names[0]] if names else None
    mass = parts[solid.name].mass if solid.name in parts else 0.0
    return mass / solid.inertia.mass if mass > 0.0 and solid.inertia.mass > 0.0 else None


def _read_table(
    model: RobotModel,
    path: Path,
    about: Literal["com", "origin"] | None,
    products: Literal["tensor", "integral"] | None,
) -> tuple[list[LinkMass], list[Finding]]:
    read = read_cad_table(path, about=about, products=products)
    for name in read:
        if name not in model.link_names:
            raise DescriptionError(
                f"{path}: {model.name} has no link {name!r}{close_match(name, model.link_names)};"
                f" its links are {', '.join(model.link_names)}"
            )
    unknown = np.full(3, np.nan)
    links = [
        LinkMass(
            link.name,
            link.inertia if link.inertia_known else None,
            read[link.name].link.inertia if link.name in read else None,
            "table" if link.name in read else "",
            float("nan"),
            unknown,
            unknown,
        )
        for link in model.links
    ]
    return links, [
        make_link_finding("doubtful_table", "warning", name, doubt)
        for name, cad in read.items()
        for doubt in cad.warnings
    ]


MASS = {"kg": 1.0, "g": 1e-3, "t": 1e3, "lb": 0.45359237, "lbm": 0.45359237}
_FACTOR = re.compile(r"([a-zA-Zµ]+)(?:\^?(-?\d+)|([²³]))?")
_SUPERSCRIPT = {"²": 2, "³": 3}
COLUMNS: dict[str, tuple[str, ...]] = {
    "link": ("link", "body"),
    "part": ("part", "component", "name"),
    "mass": ("mass", "m"),
    "cx": ("cx", "rx", "x", "comx"),
    "cy": ("cy", "ry", "y", "comy"),
    "cz": ("cz", "rz", "z", "comz"),
    "Ixx": ("ixx", "lxx"),
    "Iyy": ("iyy", "lyy"),
    "Izz": ("izz", "lzz"),
    "Ixy": ("ixy", "lxy", "iyx"),
    "Ixz": ("ixz", "lxz", "izx"),
    "Iyz": ("iyz", "lyz", "izy"),
}
"""Our name of each column and the names it goes by, without case, blanks and underscores."""

DIMENSION = (
    {"mass": (1, 0)}
    | dict.fromkeys(("cx", "cy", "cz"), (0, 1))
    | dict.fromkeys(("Ixx", "Iyy", "Izz", "Ixy", "Ixz", "Iyz"), (1, 2))
)

_HEADER = re.compile(r"^\s*(?P<name>[^\[(]+?)\s*(?:[\[(](?P<unit>[^\])]*)[\])])?\s*$")


def read_cad_table(
    path: str | Path,
    *,
    about: Literal["com", "origin"] | None,
    products: Literal["tensor", "integral"] | None,
) -> dict[str, CadLink]:
    """Read the mass properties of links from a CSV table, one row per part.

    Rows of one link add up.

    Columns `link, part, mass, cx, cy, cz, Ixx, Iyy, Izz, Ixy, Ixz, Iyz` (part is optional, other
    usual names are understood). Units stand in the header, as in `mass [g]` and `Ixx [g mm^2]`;
    nothing is assumed. Two conventions must be given because files do not say them: the tensor is
    `about` the centre of mass or the origin of the axes, and its `products` are the entries of the
    tensor, `-integral(x y dm)`, or the plain integrals `+integral(x y dm)`. Raises
    `DescriptionError` with line and column, and `UsageError` without conventions.
    """
    path = Path(path)
    if about not in ("com", "origin") or products not in ("tensor", "integral"):
        raise UsageError(
            "a table does not state its conventions; give about ('com' or 'origin') and"
            " products ('tensor' or 'integral')"
        )
    lines, separator = read_rows(path, ";\t,", "part")
    decimal_point = "," if separator == "," else "."  # which a comma in a number stands for
    header = lines[0][1]
    columns, factors = _find_columns(path, header)
    parts: dict[str, list[tuple[str, LinkInertia]]] = {}
    warnings: dict[str, list[str]] = {}
    for number, cells in lines[1:]:
        place = f"{path}, line {number}"
        if len(cells) < len(header) or any(cell.strip() for cell in cells[len(header) :]):
            raise DescriptionError(
                f"{place}: {len(cells)} cells, but the header has {len(header)} columns; where"
                " numbers have decimal commas, separate cells by semicolons"
            )
        values = {
            name: (
                parse_finite_number(
                    cells[columns[name]].strip().replace(",", decimal_point), f"{place}: {name}"
                )
                * factors[name]
            )
            for name in DIMENSION
        }
        link = cells[columns["link"]].strip()
        inertia = _make_inertia(values, about, products)
        part = (
            cells[columns["part"]].strip()
            if "part" in columns
            else f"part_{len(parts.get(link, [])) + 1}"
        )
        parts.setdefault(link, []).append((part, inertia))
        reason = inertia.inconsistency()
        if reason is not None:
            doubt = (
                f"link {link!r}, part {part!r}: {reason}; check units, about={about!r} and"
                f" products={products!r}"
            )
            warnings.setdefault(link, []).append(doubt)
    return {
        link: CadLink(
            Link(
                name=link,
                inertia=LinkInertia(np.sum([inertia.parameters for _, inertia in bodies], axis=0)),
                parts=tuple(bodies),
            ),
            tuple(warnings.get(link, ())),
        )
        for link, bodies in parts.items()
    }


def _make_inertia(values: Mapping[str, float], about: str, products: str) -> LinkInertia:
    sign = 1.0 if products == "tensor" else -1.0
    xy, xz, yz = (sign * values[name] for name in ("Ixy", "Ixz", "Iyz"))
    tensor = np.array([[values["Ixx"], xy, xz], [xy, values["Iyy"], yz], [xz, yz, values["Izz"]]])
    com = np.array([values["cx"], values["cy"], values["cz"]])
    mass = values["mass"]
    return (
        LinkInertia.from_com(mass, com, tensor)
        if about == "com"
        else LinkInertia.from_origin(mass, mass * com, tensor)
    )


def _find_columns(path: Path, header: list[str]) -> tuple[dict[str, int], dict[str, float]]:
    columns: dict[str, int] = {}
    factors: dict[str, float] = {}
    for position, cell in enumerate(header):
        match = _HEADER.match(cell)
        plain = re.sub(r"[\s_]", "", match["name"]).lower() if match else ""
        name = next((ours for ours, names in COLUMNS.items() if plain in names), None)
        if match is None or name is None:
            continue
        if name in columns:
            raise DescriptionError(f"{path}: column {cell.strip()!r} gives {name} a second time")
        columns[name] = position
        if name in DIMENSION:
            mass, length = DIMENSION[name]
            if not (match["unit"] or "").strip():
                raise DescriptionError(
                    f"{path}: column {cell.strip()!r} states no unit; write it like 'Ixx [g mm^2]'"
                )
            try:
                factors[name] = parse_unit_factor(match["unit"], mass=mass, length=length)
            except DescriptionError as error:
                raise DescriptionError(f"{path}: column {cell.strip()!r}: {error}") from None
    missing = [name for name in COLUMNS if name not in columns and name != "part"]
    if missing:
        raise DescriptionError(
            f"{path}: column {', '.join(missing)} is missing; found"
            f" {', '.join(cell.strip() for cell in header)}"
        )
    return columns, factors


def parse_unit_factor(text: str, *, mass: int, length: int) -> float:
    """Return the SI value of a unit such as `"g mm^2"`, `"kg*m²"` or `"lb in2"`.

    It must be mass^mass length^length.

    Raises `DescriptionError` where a symbol is unknown or the dimension is another one.

    >>> parse_unit_factor("g mm^2", mass=1, length=2)
    1e-09
    """
    value = 1.0
    found_mass = 0
    found_length = 0
    if _FACTOR.sub("", text).strip(" *·.()") or not text.strip():
        raise DescriptionError(f"the unit {text!r} is not understood; write it like 'g mm^2'")
    for symbol, power, superscript in _FACTOR.findall(text):
        exponent = _SUPERSCRIPT.get(superscript) or int(power or 1)
        if symbol in MASS:
            found_mass += exponent
            value *= MASS[symbol] ** exponent
        elif symbol in LENGTH:
            found_length += exponent
            value *= LENGTH[symbol] ** exponent
        else:
            raise DescriptionError(
                f"the unit {text!r} holds {symbol!r}, which is unknown; known are"
                f" {', '.join([*MASS, *LENGTH])}"
            )
    if (found_mass, found_length) != (mass, length):
        raise DescriptionError(
            f"the unit {text!r} is mass^{found_mass} length^{found_length}; expected mass^{mass}"
            f" length^{length}"
        )
    return value
