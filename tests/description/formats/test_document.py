"""A robot through its document and back."""

from __future__ import annotations

import json

import numpy as np
import pytest

from asbuilt.description import JointLimits, load_robot, model_document, model_from_document
from asbuilt.errors import DescriptionError


@pytest.mark.parametrize("name", ["two-link", "kuka-iiwa7-r800", "scara", "franka-panda"])
def test_a_robot_survives_its_document(name):
    model = load_robot(name)
    model = model.with_limits([JointLimits(lower=-1.0, velocity=0.1 + 0.2) for _ in model.joints])
    text = json.dumps(model_document(model), allow_nan=False)
    again = model_from_document(json.loads(text))
    assert json.dumps(model_document(again)) == text
    assert again.name == model.name
    assert again.joint_names == model.joint_names
    assert [joint.limits for joint in again.joints] == [joint.limits for joint in model.joints]
    assert [joint.drive for joint in again.joints] == [joint.drive for joint in model.joints]
    assert [joint.before_symbols for joint in again.joints] == [
        joint.before_symbols for joint in model.joints
    ]
    assert np.array_equal(again.parameters, model.parameters)
    for one, other in zip(model.joints, again.joints, strict=True):
        assert np.array_equal(one.before, other.before)
        assert np.array_equal(one.after, other.after)
    assert dict(again.lengths) == dict(model.lengths)


def test_a_damaged_robot_document_is_refused():
    document = model_document(load_robot("two-link"))
    for changes in (
        {"joints": None},
        {"joints": [{}]},
        {"gravity": [0.0]},
        {"joints": [document["joints"][0] | {"kind": "helical"}]},
    ):
        with pytest.raises(DescriptionError):
            model_from_document(document | changes)


def test_an_unknown_field_of_a_part_is_named():
    document = model_document(load_robot("two-link"))
    joint = document["joints"][0]
    renamed = joint | {"limits": {**joint["limits"], "speed": 1.0}}
    with pytest.raises(DescriptionError, match="JointLimits has no 'speed'; known are lower"):
        model_from_document(document | {"joints": [renamed, *document["joints"][1:]]})
