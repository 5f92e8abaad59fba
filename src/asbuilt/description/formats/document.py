"""A robot as a plain document of lists, numbers and texts.

Written to JSON and read back, it is the same robot to the last bit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, fields
from typing import Any, TypeVar, cast

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.inertia import LinkInertia
from asbuilt.description.model import (
    Contact,
    DriveValues,
    Frame,
    Joint,
    JointLimits,
    Link,
    Loop,
    MassRange,
    Mimic,
    RobotModel,
    Symbols,
)
from asbuilt.errors import DescriptionError


def model_document(model: RobotModel) -> dict[str, Any]:
    """Return the whole robot as a document.

    `model_from_document(model_document(model))` equals `model`; infinite limits are None.
    """
    before = _list(model.described_gravity)
    return {
        "name": model.name,
        "source": model.source,
        "citation": model.citation,
        "notes": list(model.notes),
        "gravity": model.gravity.tolist(),
        **({} if before is None else {"described_gravity": before}),
        "root_link": model.root_link,
        "lengths": dict(model.lengths),
        "drives_by_design": model.drives_by_design,
        "locked_joints": dict(model.locked_joints),
        "held_followers": dict(model.held_followers),
        "assumed_carriers": list(model.assumed_carriers),
        "mass_ranges": [
            [list(known.links), known.lower, known.upper if np.isfinite(known.upper) else None]
            for known in model.mass_ranges
        ],
        "usual_drive": model.usual_drive,
        "contacts": [str(contact) for contact in model.contacts],
        "motor_coupling": _list(model.motor_coupling),
        "joints": [_write_joint(joint) for joint in model.joints],
        "followers": [_write_joint(joint) for joint in model.followers],
        "loops": [_write_loop(loop) for loop in model.loops],
        "posture": dict(model.posture),
        "links": [_write_link(link) for link in model.links],
        "frames": [
            {"name": frame.name, "link": frame.link, "placement": frame.placement.tolist()}
            for frame in model.frames
        ],
    }


def model_from_document(document: Mapping[str, Any]) -> RobotModel:
    """Rebuild a robot from `model_document`.

    Raises `DescriptionError` where something is missing or of the wrong kind.
    """
    try:
        return RobotModel(
            name=str(document["name"]),
            joints=tuple(_read_joint(item) for item in document["joints"]),
            followers=tuple(_read_joint(item) for item in document.get("followers", ())),
            links=tuple(_read_link(item) for item in document["links"]),
            loops=tuple(_build(Loop, item) for item in document.get("loops", ())),
            posture={
                str(name): float(value) for name, value in document.get("posture", {}).items()
            },
            gravity=_read_array(document["gravity"]),
            root_link=str(document["root_link"]),
            frames=tuple(
                Frame(str(item["name"]), int(item["link"]), _read_array(item["placement"]))
                for item in document["frames"]
            ),
            lengths={str(symbol): float(value) for symbol, value in document["lengths"].items()},
            drives_by_design=bool(document["drives_by_design"]),
            described_gravity=_read_optional_array(document.get("described_gravity")),
            motor_coupling=_read_optional_array(document.get("motor_coupling")),
            locked_joints={
                str(name): float(value) for name, value in document.get("locked_joints", {}).items()
            },
            held_followers={
                str(name): str(of) for name, of in document.get("held_followers", {}).items()
            },
            assumed_carriers=tuple(str(name) for name in document.get("assumed_carriers", ())),
            mass_ranges=tuple(
                MassRange(
                    tuple(str(name) for name in links),
                    float(lower),
                    np.inf if upper is None else float(upper),
                )
                for links, lower, upper in document.get("mass_ranges", ())
            ),
            usual_drive=str(document.get("usual_drive", "")),
            contacts=tuple(
                contact
                for text in document.get("contacts", ())
                for contact in Contact.parse(str(text))
            ),
            source=str(document["source"]),
            citation=str(document["citation"]),
            notes=tuple(str(note) for note in document["notes"]),
        )
    except (KeyError, TypeError, AttributeError, ValueError) as problem:
        if isinstance(problem, DescriptionError):
            raise
        raise DescriptionError(
            f"a robot document cannot be read: {type(problem).__name__} {problem}; expected what"
            " `model_document` returns"
        ) from problem


Part = TypeVar("Part")


def _build(kind: type[Part], values: Mapping[str, Any]) -> Part:
    """Return a part of a robot by its fields, of which a document may have no others."""
    known = [field.name for field in fields(cast(Any, kind))]
    unknown = next((name for name in values if name not in known), None)
    if unknown is not None:
        raise DescriptionError(
            f"a robot document cannot be read: {kind.__name__} has no {unknown!r}; known are"
            f" {', '.join(known)}"
        )
    return kind(**values)


def _write_loop(loop: Loop) -> dict[str, Any]:
    given = {item.name: getattr(loop, item.name) for item in fields(Loop)}
    return {
        name: value.tolist() if isinstance(value, np.ndarray) else value
        for name, value in given.items()
    }


def _write_joint(joint: Joint) -> dict[str, Any]:
    limits = {item.name: getattr(joint.limits, item.name) for item in fields(JointLimits)}
    return {
        "name": joint.name,
        "kind": joint.kind,
        "parent": joint.parent,
        "before": joint.before.tolist(),
        "after": joint.after.tolist(),
        "limits": {name: value if np.isfinite(value) else None for name, value in limits.items()},
        "drive": {
            item.name: getattr(joint.drive, item.name)
            for item in fields(DriveValues)
            if item.name != "terms"
        },
        "drive_terms": {key: dict(numbers) for key, numbers in joint.drive.terms.items()},
        "before_symbols": joint.before_symbols,
        "after_symbols": joint.after_symbols,
        "mimic": None if joint.mimic is None else asdict(joint.mimic),
    }


def _read_joint(document: Mapping[str, Any]) -> Joint:
    unlimited = JointLimits()
    limits = {
        name: getattr(unlimited, name) if value is None else float(value)
        for name, value in document["limits"].items()
    }
    drive = {
        name: None if value is None else float(value) for name, value in document["drive"].items()
    }
    terms = {
        str(key): {str(name): float(number) for name, number in term.items()}
        for key, term in document.get("drive_terms", {}).items()
    }
    return Joint(
        name=str(document["name"]),
        kind=document["kind"],
        parent=int(document["parent"]),
        before=_read_array(document["before"]),
        after=_read_array(document["after"]),
        limits=_build(JointLimits, limits),
        drive=_build(DriveValues, {**drive, "terms": terms}),
        before_symbols=_read_symbols(document["before_symbols"]),
        after_symbols=_read_symbols(document["after_symbols"]),
        mimic=_read_mimic(document.get("mimic")),
    )


def _read_mimic(document: Mapping[str, Any] | None) -> Mimic | None:
    if document is None:
        return None
    if "multiplier" in document:  # written before joints could follow several others
        return Mimic({document["joint"]: document["multiplier"]}, document["offset"])
    return _build(Mimic, document)


def _write_link(link: Link) -> dict[str, Any]:
    return {
        "name": link.name,
        "inertia": link.inertia.parameters.tolist(),
        "inertia_known": link.inertia_known,
        "negligible": link.negligible,
        "parts": [[name, inertia.parameters.tolist()] for name, inertia in link.parts],
    }


def _read_link(document: Mapping[str, Any]) -> Link:
    return Link(
        name=str(document["name"]),
        inertia=LinkInertia(_read_array(document["inertia"])),
        inertia_known=bool(document["inertia_known"]),
        negligible=bool(document.get("negligible", False)),
        parts=tuple(
            (str(name), LinkInertia(_read_array(parameters)))
            for name, parameters in document["parts"]
        ),
    )


def _read_symbols(document: Any) -> Symbols | None:
    return (
        None
        if document is None
        else tuple(
            tuple((float(factor), str(symbol)) for factor, symbol in axis) for axis in document
        )
    )


def _read_array(values: Any) -> Array:
    return np.array(values, dtype=np.float64)


def _read_optional_array(values: Any) -> Array | None:
    return None if values is None else _read_array(values)


def _list(values: Array | None) -> list[Any] | None:
    return None if values is None else values.tolist()
