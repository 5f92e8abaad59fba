"""Recording sheet of the columns that were chosen by mouse."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import tomli_w

from asbuilt import Cure, UsageError
from asbuilt.experiment.logs.columns.roles import unit_scale
from asbuilt.experiment.logs.readers import find_sheet
from asbuilt.writing import atomic_write

QUANTITIES = ("position", "velocity", "acceleration", "torque", "command")
UNITS = ("deg", "mrad", "mm", "rpm", "mN m", "kN m", "mA", "ms", "us", "ns")
"""Units other than SI that a column may have been found to be in."""
SAME_UNIT = 1e-6
"""Relative difference of the factors of one unit."""


def write_sheet(
    path: Path,
    log: Path,
    given: str | None,
    document: Mapping[str, Any],
    chosen: Sequence[Mapping[str, Any]],
) -> Path:
    """Write the sheet that reads a log by the columns chosen.

    Parameters
    ----------
    path
        The sheet to write.
    log
        The log.
    given
        The sheet that it was read with; None: the one beside the log, if there is one. Its other
        fields are kept.
    document
        What `asbuilt columns --json` printed: factors to SI, the source of torque.
    chosen
        For each column `name`, `quantity` and `joint`, empty where it has none.

    Raises
    ------
    UsageError
        If a joint has two columns of one quantity or a quantity has columns of some joints only,
        or if the sheet lists files.
    """
    sheet, _ = find_sheet(log, given)
    content = sheet.model_dump(mode="json", exclude_defaults=True, exclude_none=True)
    if "files" in content:
        raise UsageError(
            f"the sheet of {log} lists files, which the page does not change",
            cure=Cure("edit the sheet itself"),
        )
    factors = {each["name"]: each["factor"] for each in document["columns"]}
    joints = [
        joint
        for joint in document["joints"]
        if any(each["quantity"] == "position" and each["joint"] == joint for each in chosen)
    ]
    columns: dict[str, Any] = {}
    units: dict[str, str] = dict(content.get("units", {}))
    for quantity in ("time", *QUANTITIES):
        names = _columns(quantity, joints, chosen)
        found = [each["name"] for each in document["columns"] if each["quantity"] == quantity]
        # A sheet that names the time takes it from that column alone, without its nanoseconds.
        if names and not (quantity == "time" and document["named"] and names == found):
            listed = [_number_or_name(name, named=document["named"]) for name in names]
            columns[quantity] = listed[0] if quantity == "time" else listed
            unit = _unit(quantity, [factors.get(name) for name in names])
            if unit:
                units.setdefault(quantity, unit)
    extra = content.get("columns", {}).get("extra")
    content["columns"] = columns | ({"extra": extra} if extra else {})
    content["joints"] = joints
    if units:
        content["units"] = units
    source = document.get("torque_source")
    if source not in (None, "unknown"):
        content.setdefault("torque_source", source)
    return atomic_write(path, tomli_w.dumps(content))


def _columns(
    quantity: str, joints: Sequence[str], chosen: Sequence[Mapping[str, Any]]
) -> list[str]:
    """Return the columns of a quantity in the order of the joints, none if it has none."""
    own = [each for each in chosen if each["quantity"] == quantity]
    if quantity == "time":
        if len(own) > 1:
            raise UsageError(f"{own[0]['name']} and {own[1]['name']} are both the time; choose one")
        return [each["name"] for each in own]
    names = []
    for joint in joints if own else ():
        found = [each["name"] for each in own if each["joint"] == joint]
        if len(found) != 1:
            what = " and ".join(found) if found else "no column"
            raise UsageError(
                f"{joint} has {what} of {quantity}; it must have one, or no joint may have any"
            )
        names += found
    return names


def _number_or_name(name: str, *, named: bool) -> str | int:
    return name if named else int(name)


def _unit(quantity: str, factors: Sequence[float | None]) -> str | None:
    """Return the unit that the columns were found to be in; None for SI or an unknown one."""
    known = {factor for factor in factors if factor is not None}
    if known <= {1.0}:
        return None
    for unit in UNITS:
        scale = unit_scale(unit)
        if scale is not None and all(abs(scale / each - 1.0) < SAME_UNIT for each in known):
            return unit
    raise UsageError(
        f"the columns of {quantity} have the factors {', '.join(f'{each:g}' for each in known)}"
        " to SI, which a sheet cannot name by one unit",
        cure=Cure("write the sheet by hand"),
    )
