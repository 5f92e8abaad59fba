"""USD overlay: masses, drives and joint friction over the prims of an imported robot."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from asbuilt.description import Joint, LinkInertia, quaternion_from_rotation
from asbuilt.writers import (
    SIMULATOR_FORMATS,
    ExportedDrives,
    SimulatorFormat,
)

SCHEMAS = ("PhysicsDriveAPI:{axis}", "PhysxJointAPI", "PhysxJointAxisAPI:{axis}")


class UsdOverlay(SimulatorFormat):
    """A text layer of opinions that is put over the layer of the robot."""

    key = "usd"
    title = "USD overlay (.usda) with masses, drives and joint friction"

    def document(self, drives: ExportedDrives, path: Path) -> tuple[str, tuple[str, ...]]:
        """Return the layer and its notes."""
        model = drives.plain
        root = make_prim_name(drives.plain.name)
        lines = [
            "#usda 1.0",
            "(",
            f'    defaultPrim = "{root}"',
            f'    doc = "{drives.origin}. Put this layer over the robot layer; angular'
            ' coefficients are per degree."',
            "    kilogramsPerUnit = 1",
            "    metersPerUnit = 1",
            '    upAxis = "Z"',
            ")",
            "",
            f'over "{root}"',
            "{",
        ]
        for link in model.links:
            lines += _write_over(link.name, ("PhysicsMassAPI",), _write_mass(link.inertia), 1)
        lines += ['    over "joints"', "    {"]
        for joint in model.joints:
            axis = "angular" if joint.is_revolute else "linear"
            schemas = tuple(schema.format(axis=axis) for schema in SCHEMAS)
            lines += _write_over(joint.name, schemas, _write_drive(joint, axis), 2)
        lines += ["    }", "}", ""]
        return "\n".join(lines), (
            *drives.left_out("a USD joint"),
            f"prims are /{root}/LINK and /{root}/joints/JOINT, as the URDF importer of Isaac Sim"
            " makes them (fixed joints merged); move them if yours are elsewhere",
            "Coulomb friction is static and dynamic friction effort, which Isaac Sim 5 knows",
        )


def _write_drive(joint: Joint, axis: str) -> Iterator[str]:
    """Yield the attributes of a joint, coefficients of angular ones per degree."""
    per = np.pi / 180.0 if axis == "angular" else 1.0
    drive = joint.drive
    limit = joint.limits.torque
    coulomb = drive.coulomb or 0.0
    armature = drive.armature or 0.0
    yield f"float drive:{axis}:physics:stiffness = {(drive.kp or 0.0) * per!r}"
    yield f"float drive:{axis}:physics:damping = {(drive.kd or 0.0) * per!r}"
    if np.isfinite(limit):
        yield f"float drive:{axis}:physics:maxForce = {limit!r}"
    yield f"float physxJoint:armature = {armature!r}"
    yield f"float physxJointAxis:{axis}:armature = {armature!r}"
    yield f"float physxJointAxis:{axis}:staticFrictionEffort = {coulomb!r}"
    yield f"float physxJointAxis:{axis}:dynamicFrictionEffort = {coulomb!r}"
    yield (
        f"float physxJointAxis:{axis}:viscousFrictionCoefficient = {(drive.viscous or 0.0) * per!r}"
    )


def _write_mass(inertia: LinkInertia) -> Iterator[str]:
    """Yield the attributes of a link."""
    yield f"float physics:mass = {inertia.mass!r}"
    if inertia.mass <= 0.0:
        return
    moments, axes = inertia.principal_axes
    yield f"point3f physics:centerOfMass = {_write_tuple(inertia.com)}"
    yield f"float3 physics:diagonalInertia = {_write_tuple(moments)}"
    yield f"quatf physics:principalAxes = {_write_tuple(quaternion_from_rotation(axes))}"


def _write_over(
    name: str, schemas: tuple[str, ...], attributes: Iterator[str], depth: int
) -> list[str]:
    """Return the lines of an opinion on a prim, so many levels below the root."""
    listed = ", ".join(f'"{schema}"' for schema in schemas)
    head = [f'over "{make_prim_name(name)}" (', f"    prepend apiSchemas = [{listed}]", ")", "{"]
    lines = [*head, *(f"    {attribute}" for attribute in attributes), "}"]
    return ["    " * depth + line for line in lines]


def _write_tuple(values: object) -> str:
    return f"({', '.join(repr(float(value)) for value in np.ravel(np.asarray(values)))})"


def make_prim_name(name: str) -> str:
    """Return a valid name of a prim: a-z, A-Z, digits and underscores, no digit first."""
    valid = re.sub(r"[^A-Za-z0-9_]", "_", name)
    return f"_{valid}" if not valid or valid[0].isdigit() else valid


SIMULATOR_FORMATS.register("usd", UsdOverlay())
