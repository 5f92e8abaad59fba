from __future__ import annotations

import numpy as np
import pytest

from asbuilt.description import (
    DriveValues,
    Joint,
    JointLimits,
    Link,
    LinkInertia,
    RobotModel,
    load_robot,
    placement,
)
from asbuilt.description.rotation import rotation_x
from asbuilt.errors import MotionError
from asbuilt.excitation import (
    MotionBounds,
    PointToPointMotion,
    QuinticMotion,
    check_motion,
    random_fourier,
    random_point_to_point,
)

SILENT = DriveValues()


def arm(limits: tuple[JointLimits, JointLimits], drive: DriveValues = SILENT) -> RobotModel:
    """A turning pendulum (horizontal axis, 2 kg at 0.5 m) that carries a slide of 1 kg along its
    own axis.
    """
    pendulum = Joint(
        "turn", "revolute", -1, placement(rotation_x(np.pi / 2)), np.eye(4), limits[0], drive
    )
    slide = Joint("slide", "prismatic", 0, np.eye(4), np.eye(4), limits[1])
    links = (
        Link("one", LinkInertia.from_com(2.0, [0.5, 0, 0], np.zeros((3, 3)))),
        Link("two", LinkInertia.from_com(1.0, [0, 0, 0], np.zeros((3, 3)))),
    )
    return RobotModel("arm", (pendulum, slide), links)


LIMITS = (JointLimits(-1.0, 2.0, 1.5, 5.0, 100.0, 30.0), JointLimits(-0.3, 0.3, 0.5))


def test_margins_of_a_known_motion() -> None:
    motion = QuinticMotion.between([0.0, 0.0], [1.0, 0.15], 2.0)
    report = check_motion(arm(LIMITS), motion)
    worst = report.worst_margin
    assert worst["position"] == pytest.approx(0.5)
    assert report.worst["position"].joint == "slide"  # type: ignore[union-attr]
    assert worst["velocity"] == pytest.approx(1 - 0.9375 / 1.5)
    assert worst["acceleration"] == pytest.approx(1 - 10 / np.sqrt(3) / 4 / 5.0, rel=1e-6)
    assert worst["jerk"] == pytest.approx(1 - 7.5 / 100)
    assert report.is_respected
    report.raise_if_violated()


def test_torque_is_checked_with_weight_inertia_and_the_described_drive() -> None:
    motion = QuinticMotion.between([0.0, 0.0], [1.0, 0.0], 2.0)
    q, qd, qdd = motion.at(np.linspace(0, 2, 2001))
    rigid = 0.5 * qdd[:, 0] + 2.0 * 9.81 * 0.5 * np.cos(q[:, 0])
    for drive, extra in (
        (DriveValues(), 0.0),
        (DriveValues(viscous=3.0, coulomb=2.0), 3.0 * qd[:, 0] + 2.0 * np.sign(qd[:, 0])),
    ):
        margin = check_motion(arm(LIMITS, drive), motion).worst["torque"]
        assert margin is not None
        assert margin.joint == "turn"
        assert margin.margin == pytest.approx(1 - np.abs(rigid + extra).max() / 30, abs=1e-6)


def test_violations_are_named_with_time_value_limit_and_cure() -> None:
    motion = QuinticMotion.between([0.0, 0.0], [1.0, 0.4], 0.5)
    report = check_motion(arm(LIMITS), motion)
    assert not report.is_respected
    assert report.worst_margin["velocity"] == pytest.approx(1 - 1.5 / 0.5)
    with pytest.raises(
        MotionError,
        match=(
            r"of turn is .* rad/s.* at t = 0\.\d+ s, beyond its limit of .*slow the motion down:"
            r" motion.slowed\(.*more limits"
        ),
    ) as caught:
        report.raise_if_violated()
    # The named factor cures everything but the position.
    factor = float(str(caught.value).split("slowed(")[1].split(")")[0])
    left = check_motion(arm(LIMITS), motion.slowed(factor)).violations
    assert {violation.quantity for violation in left} == {"position"}
    assert "slide" in str(left[0])
    assert left[0].limit == 0.3


def test_a_limit_may_be_reached_exactly() -> None:
    motion = PointToPointMotion.within(
        [[-1.0, -0.3], [2.0, 0.3]], velocity=[1.5, 0.5], acceleration=[5.0, 1.0]
    )
    model = arm((JointLimits(-1.0, 2.0, 1.5, 5.0), JointLimits(-0.3, 0.3, 0.5, 1.0)))
    report = check_motion(model, motion)
    assert report.is_respected
    assert report.worst_margin["position"] == pytest.approx(0.0, abs=1e-12)


def test_the_end_between_two_samples_is_checked() -> None:
    motion = QuinticMotion.between([0.0, 0.0], [2.5, 0.0], 1.95)
    assert check_motion(arm(LIMITS), motion, rate=1.0).worst_margin["position"] == pytest.approx(
        -0.5 / 1.5
    )


def test_unknown_limits_are_not_reported() -> None:
    report = check_motion(
        arm((JointLimits(), JointLimits())), QuinticMotion.between([0.0, 0.0], [9.0, 9.0], 0.1)
    )
    assert set(report.worst_margin.values()) == {None}
    assert str(report) == "the description gives no limits"


def test_the_number_of_joints_must_fit() -> None:
    with pytest.raises(MotionError, match="moves 1 joints, arm has 2: turn, slide"):
        check_motion(arm(LIMITS), QuinticMotion.between([0.0], [1.0], 1.0))


def test_assumed_bounds_fill_what_is_unknown() -> None:
    bounds = MotionBounds.assumed(
        arm((JointLimits(), JointLimits(lower=0.2, velocity=2.0))), fraction=0.5
    )
    np.testing.assert_allclose(bounds.lower, [-np.pi / 2, 0.45])
    np.testing.assert_allclose(bounds.upper, [np.pi / 2, 0.95])
    np.testing.assert_allclose(bounds.velocity, [0.75, 1.0])
    assert np.all(np.isfinite(bounds.acceleration))
    assert np.all(np.isinf(bounds.torque))


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("generator", [random_fourier, random_point_to_point])
def test_random_motions_respect_every_limit_and_use_them(generator: object, seed: int) -> None:
    model = arm((JointLimits(-1.0, 2.0, 1.5, 5.0, 60.0, 14.0), JointLimits(-0.3, 0.3, 0.5)))
    if generator is random_point_to_point:
        model = model.with_limits(
            [JointLimits(-1.0, 2.0, 1.5, 5.0, torque=14.0), model.joints[1].limits]
        )
    motion = generator(model, seed)  # type: ignore[operator]
    report = check_motion(model, motion)
    assert report.is_respected
    assert min(margin.margin for margin in report.margins) < 0.5
    again, other = generator(model, seed), generator(model, seed + 100)  # type: ignore[operator]
    np.testing.assert_array_equal(again.derivative(1.0), motion.derivative(1.0))
    assert np.abs(other.derivative(1.0) - motion.derivative(1.0)).max() > 0


def test_random_motion_without_torque_limit_attains_the_fraction_exactly() -> None:
    model = arm((JointLimits(-1.0, 2.0, 1.5, 5.0), JointLimits(-0.3, 0.3, 0.5, 3.0)))
    motion = random_fourier(model, 4, fraction=0.8)
    for j, limit in enumerate(joint.limits for joint in model.joints):
        low, high = motion.extremes(0)
        used = [
            (high - low)[j] / (limit.upper - limit.lower),
            motion.peaks(1)[j] / limit.velocity,
            motion.peaks(2)[j] / limit.acceleration,
        ]
        assert max(used) == pytest.approx(0.8, abs=1e-9)


@pytest.mark.parametrize(
    "arguments", [{"n_harmonics": 1}, {"periods": 0}, {"fraction": 0.0}, {"duration": -1.0}]
)
def test_senseless_random_motions_are_refused(arguments: dict[str, float]) -> None:
    with pytest.raises(MotionError):
        random_fourier(arm(LIMITS), 1, **arguments)  # type: ignore[arg-type]


def test_a_robot_too_weak_for_its_weight_is_refused() -> None:
    model = arm((JointLimits(-0.1, 0.1, 1.5, 5.0, torque=0.5), JointLimits(-0.3, 0.3, 0.5)))
    for generator in (random_fourier, random_point_to_point):
        with pytest.raises(
            MotionError, match=r"no random motion within the torque limits \(0.5, inf\)"
        ):
            generator(model, 1)


def test_jumps_of_acceleration_are_not_taken_for_no_jerk() -> None:
    panda = load_robot("franka-panda")
    way = np.array([np.zeros(7), np.full(7, -0.3)])
    jumping = PointToPointMotion.within(way, velocity=1.0, acceleration=2.0)
    smooth = QuinticMotion.between(way[0], way[1], 2.0)
    assert check_motion(panda, jumping).worst["jerk"] is None
    assert check_motion(panda, smooth).worst["jerk"] is not None
