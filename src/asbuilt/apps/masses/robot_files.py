"""Robot descriptions with computed mass properties."""

from __future__ import annotations

import os
from pathlib import Path

from asbuilt.apps.masses.computed_masses import LinkMasses
from asbuilt.errors import InertiaError, UsageError
from asbuilt.writers import write_robot_toml, write_urdf


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
    place, model = Path(path), masses.computed_model
    computed = {each.name: each.computed for each in masses.links if each.computed is not None}
    if not computed:
        raise UsageError("no mass properties were computed, so there is nothing to write")
    for name, inertia in computed.items():
        if (reason := inertia.inconsistency()) is not None:
            raise InertiaError(f"computed mass properties of link {name!r}: {reason}", link=name)
    if place.suffix.lower() == ".toml":
        return write_robot_toml(place, model), ()
    if place.suffix.lower() != ".urdf":
        raise UsageError(f"{place} must end in .urdf or .toml")
    original = masses.model.source if masses.model.source.lower().endswith(".urdf") else None
    return write_urdf(place, model, original=original)
