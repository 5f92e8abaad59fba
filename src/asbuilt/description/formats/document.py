"""A robot as a plain document of lists, numbers and texts.

Written to JSON and read back, it is the same robot to the last bit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from asbuilt.codec import make_plain, restore_dataclass
from asbuilt.description.model import DriveValues, JointLimits, RobotModel
from asbuilt.errors import DescriptionError

NEEDED = ("gravity", "root_link", "frames", "lengths", "drives_by_design", "source", "citation")
"""Fields that a document has even where they are as usual: one without them is damaged."""


def model_document(model: RobotModel) -> dict[str, Any]:
    """Return the whole robot as a document.

    `model_from_document(model_document(model))` equals `model`; infinite limits are None.
    """
    document: dict[str, Any] = make_plain(model)
    for joint in (*document["joints"], *document["followers"]):
        joint["drive_terms"] = joint["drive"].pop("terms")
    if model.described_gravity is None:
        del document["described_gravity"]
    return document


def model_from_document(document: Mapping[str, Any]) -> RobotModel:
    """Rebuild a robot from `model_document`.

    Raises `DescriptionError` where something is missing or of the wrong kind.
    """
    try:
        joints = {
            name: [_gather_drive(joint) for joint in document.get(name, ())]
            for name in ("joints", "followers")
        }
        lacking = next((name for name in NEEDED if name not in document), None)
        if lacking is not None:
            raise KeyError(lacking)
        return restore_dataclass(RobotModel, {**document, **joints})
    except (KeyError, TypeError, AttributeError, ValueError) as problem:
        if isinstance(problem, DescriptionError):
            raise
        raise DescriptionError(
            f"a robot document cannot be read: {type(problem).__name__} {problem}; expected what"
            " `model_document` returns"
        ) from problem


def _gather_drive(joint: Mapping[str, Any]) -> dict[str, Any]:
    """Return the document of a joint with all terms in its drive, as the joint has them."""
    for kind, values in ((JointLimits, joint["limits"]), (DriveValues, joint["drive"])):
        known = [field.name for field in fields(kind)]
        unknown = next((name for name in values if name not in known), None)
        if unknown is not None:
            raise DescriptionError(
                f"a robot document cannot be read: {kind.__name__} has no {unknown!r}; known are"
                f" {', '.join(known)}"
            )
    return {**joint, "drive": {**joint["drive"], "terms": joint.get("drive_terms", {})}}
