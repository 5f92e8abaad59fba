"""The sentences that say why: specific to the robot, and true."""

from __future__ import annotations

import numpy as np
import pytest

from asbuilt.description import DHRow, RobotModel, bundled_robot, robot_from_dh
from asbuilt.dynamics import DriveSet, StandardParameter, find_base_parameters, observation_matrix

RIGHT = np.pi / 2


def verdicts(model: RobotModel, drive: str = "none") -> dict[str, StandardParameter]:
    return {
        parameter.name: parameter
        for parameter in find_base_parameters(model, DriveSet.parse(drive)).standard
    }


def test_the_first_link_of_an_upright_arm() -> None:
    found = verdicts(bundled_robot("kuka-iiwa7-r800"))
    assert found["Ixx1"] == StandardParameter(
        1,
        "Ixx1",
        "unidentifiable",
        (),
        "Ixx1: not identifiable: link 1 only turns about a vertical axis, so only its inertia about"
        " that axis has an effect",
    )
    assert "the position of its mass along that axis has no effect" in found["my1"].why
    assert "gravity does no work" in found["mx1"].why
    assert "the origin of its frame lies on that axis" in found["m1"].why


def test_the_same_arm_on_a_wall() -> None:
    found = verdicts(bundled_robot("kuka-iiwa7-r800").with_gravity((0.0, 9.81, 0.0)))
    assert found["Ixx1"].why.startswith(
        "Ixx1: not identifiable: link 1 only turns about a horizontal axis"
    )
    assert found["mx1"].status == "identifiable"


def test_a_link_further_out() -> None:
    found = verdicts(bundled_robot("kuka-iiwa7-r800"), "armature,viscous,coulomb,offset")
    assert found["m3"].status == "grouped"
    assert found["m3"].members == (11, 14, 19)
    assert (
        "a mass on the axis of joint 3 moves with link 2 whatever joint 3 does" in found["m3"].why
    )
    assert "a first moment along the axis of joint 3" in found["my3"].why
    assert (
        "equal inertias about the two directions perpendicular to the axis of joint 3"
        in found["Izz3"].why
    )
    assert found["Ixx2"].why.endswith(
        "its sum with Izz2, Izz3, my3, m3 and 4 more is identifiable, named Ixx2"
    )
    assert found["Ixy3"].status == "identifiable"
    assert "this product of inertia" in found["Ixy3"].why
    assert (
        "link 1 only turns about a vertical axis, never along the axis of joint 2"
        in found["Ia2"].why
    )
    assert (
        found["Ia3"].status
        == found["Fv1"].status
        == found["Fc7"].status
        == found["Fo4"].status
        == "identifiable"
    )


def test_sliding_links() -> None:
    gantry = robot_from_dh(
        [DHRow(kind="prismatic", alpha=-RIGHT), DHRow(kind="prismatic", alpha=RIGHT), DHRow()],
        name="gantry",
    )
    found = verdicts(gantry, "armature,offset")
    assert (
        "link 1 only slides along a vertical line and never turns, so its moments of inertia"
        " have no effect on the torques" in found["Ixx1"].why
    )
    assert "link 2 only slides, in a plane, and never turns" in found["Ixx2"].why
    assert "the position of its mass has no effect on the torques" in found["mx2"].why
    assert found["Fo1"].status == "grouped"
    assert "at a constant slope, so the weight it carries is constant, too" in found["Fo1"].why
    assert found["Fo2"].status == "identifiable"
    slope = verdicts(gantry.with_gravity((0.0, 0.0, 0.0)), "offset")
    assert slope["Fo1"].status == "identifiable"
    assert "slides along a fixed line" in slope["Ixx1"].why


def test_parallel_axes() -> None:
    found = verdicts(bundled_robot("scara"))
    assert (
        "link 2 only turns about vertical, parallel axes, so only its inertia about that direction"
        " has an effect" in found["Ixx2"].why
    )
    assert (
        "joint 3 slides, so link 3 always turns with link 2 and their inertias add up"
        in found["Izz3"].why
    )
    assert "has an effect only through its inertia about that axis" in found["mx1"].why


def test_no_sentence_calls_a_single_cause_by_a_foreign_name() -> None:
    model = robot_from_dh([DHRow(a=0.2, alpha=RIGHT), DHRow(a=0.4)], name="elbow")
    found = verdicts(model)
    assert (
        found["mx2"].why
        == "mx2: identifiable only in a sum: a mass on the axis of joint 2 has the effect of one of"
        " link 1; the other effects of the mass equal the effects of mx2; its sum with m2 is"
        " identifiable, named mx2"
    )


@pytest.mark.parametrize(
    "robot", ["kuka-iiwa7-r800", "puma-560", "scara", "franka-panda", "two-link"]
)
def test_every_sentence_names_its_parameter_and_its_link(robot: str) -> None:
    for parameter in verdicts(bundled_robot(robot), "armature,viscous,coulomb,offset").values():
        subject, _, reason = parameter.why.partition(": ")
        assert subject == parameter.name
        number = parameter.name.lstrip("IFxyzmavco")
        assert (
            f"link {number}" in reason or f"joint {number}" in reason or f" {number} " in reason
        ), parameter.why
        assert (parameter.status == "unidentifiable") == (not parameter.members)
        assert ("sum" in reason) == (parameter.status == "grouped")


def test_a_link_that_gravity_turns_does_not_act_through_its_inertia_alone() -> None:
    rows = [DHRow(a=0.5), DHRow(a=0.4, alpha=RIGHT)]
    found = verdicts(robot_from_dh(rows, name="two").with_gravity((0.0, -9.81, 0.0)))
    assert found["m1"].why == (
        "m1: identifiable only in a sum: link 1 only turns about a horizontal axis, so it has an"
        " effect only through its inertia about that axis and the torque of gravity about it, which"
        " other parameters have too; it is part of the sums named Izz1 and mx1"
    )


@pytest.mark.study
def test_sentences_on_gravity_agree_with_the_torque_of_robots_at_rest() -> None:
    """Random small robots: who acts through inertia alone has no torque at rest, and the others."""
    rng, said = np.random.default_rng(4), {"alone": 0, "gravity": 0}
    axes = np.vstack([np.eye(3), -np.eye(3)])
    for _ in range(60):
        rows = [
            DHRow(
                a=float(rng.choice([0.0, 0.3, 0.5])),
                b=float(rng.choice([0.0, 0.2])),
                alpha=float(rng.choice([0.0, RIGHT, -RIGHT, 0.4])),
            )
            for _ in range(int(rng.integers(1, 4)))
        ]
        model = robot_from_dh(rows, name="small").with_gravity(9.81 * axes[rng.integers(6)])
        q = rng.uniform(-3.0, 3.0, (8, model.n_joints))
        at_rest = observation_matrix(model, q, np.zeros_like(q), np.zeros_like(q))
        for column, (name, verdict) in enumerate(verdicts(model).items()):
            torque = float(np.abs(at_rest[:, column]).max())
            if "through its inertia about that axis and the torque of gravity" in verdict.why:
                said["gravity"] += 1
                assert torque > 1e-3, (name, verdict.why)
            elif "only through its inertia about that axis" in verdict.why:
                said["alone"] += 1
                assert torque < 1e-9, (name, verdict.why)
    assert min(said.values()) > 5
