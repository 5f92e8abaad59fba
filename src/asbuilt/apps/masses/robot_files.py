"""Robot descriptions with computed mass properties."""

from __future__ import annotations

import os
from pathlib import Path

from asbuilt.apps.masses.computed_masses import LinkMasses
from asbuilt.errors import InertiaError, UsageError
from asbuilt.findings import Cure
from asbuilt.writers import write_robot_toml, write_urdf

UNREADABLE = ("missing_mesh", "doubtful_mesh", "mesh_scale", "no_geometry")
"""Findings that say why nothing was computed of a link."""
MOST_REASONS = 3
"""Reasons that an error lists."""


def write_masses(path: str | os.PathLike[str], masses: LinkMasses) -> tuple[Path, tuple[str, ...]]:
    """Write the robot with its computed mass properties: a URDF edited in place, or TOML.

    Returns the path and notes on what the file cannot hold.

    Raises
    ------
    UsageError
        If the suffix is neither .urdf nor .toml, or nothing was computed.
    InertiaError
        If computed mass properties are physically inconsistent.
    """
    place = Path(path)
    model = masses.computed_model
    computed = {link.name: link.computed for link in masses.links if link.computed is not None}
    if not computed:
        reasons = [f.message for f in masses.findings if f.code in UNREADABLE]
        why = f": {'; '.join(reasons[:MOST_REASONS])}" if reasons else ", so there is none to write"
        raise UsageError(
            f"no mass properties were computed{why}",
            cure=Cure("name the folder with the meshes, or repair them", {"meshes": "DIR"})
            if reasons
            else None,
        )
    for name, inertia in computed.items():
        if (reason := inertia.inconsistency()) is not None:
            raise InertiaError(f"computed mass properties of link {name!r}: {reason}", link=name)
    if place.suffix.lower() == ".toml":
        return write_robot_toml(place, model), ()
    if place.suffix.lower() != ".urdf":
        raise UsageError(f"{place} must end in .urdf or .toml")
    original = masses.model.source if masses.model.source.lower().endswith(".urdf") else None
    return write_urdf(place, model, original=original)
