from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from asbuilt.description import ROOT, Frame, RobotModel, load_robot
from asbuilt.description.plausibility import find_inconsistencies
from asbuilt.dynamics import (
    DriveSet,
    find_base_parameters,
    inverse_dynamics,
    observation_matrix,
    parameter_values,
)
from asbuilt.writers import as_built, write_robot_toml
from asbuilt.writers.models.robot_toml import format_robot_toml


def same_torques(one: RobotModel, two: RobotModel) -> None:
    rng = np.random.default_rng(0)
    q, qd, qdd = rng.normal(size=(3, 20, one.n_joints))
    expected = inverse_dynamics(one, q, qd, qdd)
    np.testing.assert_allclose(
        inverse_dynamics(two, q, qd, qdd), expected, atol=1e-11 * np.abs(expected).max()
    )


def test_round_trip_keeps_everything(example: Any, tmp_path: Path) -> None:
    placement = np.eye(4)
    placement[:3, 3] = [0.1, -0.2, 1e-7]
    frames = (Frame("tool\n\u007f\"'", 3, placement), Frame("pedestal", ROOT, np.eye(4)))
    model = replace(example.model, frames=frames, notes=("a note\twith \\ and é",))
    back = load_robot(write_robot_toml(tmp_path / "robot.toml", model))
    same_torques(model, back)
    assert np.array_equal(model.parameters, back.parameters)
    assert np.array_equal(model.gravity, back.gravity)
    assert (back.name, back.joint_names, back.link_names, back.parents) == (
        model.name,
        model.joint_names,
        model.link_names,
        model.parents,
    )
    assert back.citation == model.citation
    assert back.notes == model.notes
    assert dict(back.lengths) == dict(model.lengths)
    assert [j.limits for j in back.joints] == [j.limits for j in model.joints]
    assert [j.drive for j in back.joints] == [j.drive for j in model.joints]
    assert [j.kind for j in back.joints] == [j.kind for j in model.joints]
    assert [(f.name, f.link) for f in back.frames] == [(f.name, f.link) for f in model.frames]
    np.testing.assert_array_equal(back.frames[0].placement, placement)
    drive = DriveSet.parse("viscous")
    assert find_base_parameters(back, drive).symbolic == find_base_parameters(model, drive).symbolic


def test_writing_what_was_read_gives_the_same_text(example: Any, tmp_path: Path) -> None:
    path = write_robot_toml(tmp_path / "robot.toml", example.model)
    assert format_robot_toml(load_robot(path)) == path.read_text(encoding="utf-8")


@pytest.mark.parametrize("name", ["lbrstack_med7.urdf", "kuka_lwr4.urdf"])
def test_descriptions_of_strangers(shared: Path, tmp_path: Path, name: str) -> None:
    model = load_robot(shared / "models" / name)
    back = load_robot(write_robot_toml(tmp_path / "robot.toml", model))
    same_torques(model, back)
    np.testing.assert_allclose(back.parameters, model.parameters, atol=1e-15)
    assert [link.inertia_known for link in back.links] == [
        link.inertia_known for link in model.links
    ]
    assert [[part for part, _ in link.parts] for link in back.links] == [
        [part for part, _ in link.parts] for link in model.links
    ]


@pytest.mark.parametrize("which", ["example", "armature_example"])
def test_identified_robot_predicts_what_was_identified(
    which: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    example: Any = request.getfixturevalue(which)
    samples = example.held_out
    result = replace(
        example.result, cause_data=None, textbook_covariance=1e-20 * example.result.covariance
    )
    robot = load_robot(write_robot_toml(tmp_path / "robot.toml", as_built(result).model))
    drive = result.base.drive
    chi = parameter_values(robot, drive)
    assert not np.any(np.isnan(chi))
    np.testing.assert_allclose(result.base.values(chi), result.estimates, rtol=1e-9, atol=1e-10)
    torque = (
        observation_matrix(robot, samples.q, samples.qd, samples.qdd, drive=drive) @ chi
    ).reshape(samples.q.shape)
    np.testing.assert_allclose(torque, result.predict(samples).predicted, atol=1e-9)
    assert ("NOT physically consistent" in robot.notes[-1]) == bool(find_inconsistencies(robot))


def test_design_values_give_the_design_back(example: Any) -> None:
    known = tuple(
        replace(p, estimate=0.0 if np.isnan(p.cad) else p.cad) for p in example.result.parameters
    )
    sharp = 1e-20 * example.result.covariance
    robot = as_built(
        replace(
            example.result,
            parameters=known,
            cause_data=None,
            textbook_covariance=sharp,
        )
    ).model
    np.testing.assert_allclose(robot.parameters, example.model.parameters, atol=1e-8)
