"""What every motion keeps, whatever its parametrisation."""

from __future__ import annotations

import numpy as np
import pytest

from asbuilt.errors import MotionError
from asbuilt.excitation import (
    BSplineMotion,
    Concatenated,
    FourierMotion,
    Motion,
    PointToPointMotion,
    QuinticMotion,
    SampledMotion,
    SplineMotion,
    Trajectory,
)
from asbuilt.excitation.motions.motion import BasisMotion
from asbuilt.excitation.motions.piecewise import PiecewisePolynomial

POSES = np.random.default_rng(7).uniform(-2, 2, size=(6, 3))
TIMES = [0.0, 1.8, 3.1, 5.0, 6.2, 8.0]
LIMITS = {"velocity": [1.5, 1.0, 2.0], "acceleration": 4.0}


def motions() -> dict[str, Motion]:
    rng = np.random.default_rng(3)
    quintic = QuinticMotion.within(POSES, **LIMITS, dwell=0.3)
    fourier = FourierMotion(rng.normal(size=(9, 3)), 8.0, periods=2)
    sampled = fourier.sample(20)
    return {
        "quintic": quintic,
        "quintic moving": QuinticMotion.between(
            POSES[0],
            POSES[1],
            1.7,
            start_velocity=POSES[2],
            end_velocity=0.4,
            end_acceleration=POSES[3],
        ),
        "point to point": PointToPointMotion.within(POSES, **LIMITS, dwell=0.2),
        "cubic natural": SplineMotion.through(POSES, TIMES, degree=3, ends="natural"),
        "quintic spline": SplineMotion.within(POSES, **LIMITS, jerk=30.0),
        "quintic spline natural": SplineMotion.through(POSES, TIMES, ends="natural"),
        "fourier": fourier,
        "b-spline": BSplineMotion(rng.normal(size=(9, 3)), 7.0),
        "slowed": fourier.slowed(1.7),
        "concatenated": Concatenated(
            [quintic, QuinticMotion.between(POSES[-1], fourier.start, 4.0), fourier],
            dwell=[0.5, 0.0],
        ),
        "sampled": SampledMotion.of(sampled.t, sampled.q, sampled.qd, sampled.qdd),
    }


MOTIONS = motions()
each_motion = pytest.mark.parametrize("name", MOTIONS)
AT_REST = sorted(MOTIONS.keys() - {"quintic moving", "cubic natural", "quintic spline natural"})
SMOOTH = sorted(MOTIONS.keys() - {"point to point"})


def breaks_of(motion: Motion) -> np.ndarray:
    if isinstance(motion, PiecewisePolynomial):
        return motion.breaks
    if isinstance(motion, Concatenated):
        inner = [
            start + breaks_of(m) for start, m in zip(motion.starts, motion.motions, strict=True)
        ]
        return np.concatenate(
            [*inner, [m.duration + s for m, s in zip(motion.motions, motion.starts, strict=True)]]
        )
    return np.array([0.0, motion.duration])


@each_motion
@pytest.mark.parametrize("order", [1, 2, 3])
def test_derivative_is_the_central_difference_of_the_one_below(name: str, order: int) -> None:
    motion, h = MOTIONS[name], 1e-4
    t = np.random.default_rng(order).uniform(2 * h, motion.duration - 2 * h, 500)
    t = t[np.min(np.abs(t[:, None] - breaks_of(motion)), axis=1) > 2 * h]
    below = [motion.derivative(t + k * h, order - 1) for k in (-2, -1, 1, 2)]
    difference = (below[0] - 8 * below[1] + 8 * below[2] - below[3]) / (12 * h)
    scale = 1 + np.abs(motion.derivative(t, order)).max()
    np.testing.assert_allclose(motion.derivative(t, order), difference, atol=1e-7 * scale, rtol=0)


@each_motion
def test_integrating_the_velocity_gives_the_distance(name: str) -> None:
    motion = MOTIONS[name]
    nodes, weights = np.polynomial.legendre.leggauss(12)
    edges = np.unique(np.concatenate([breaks_of(motion), np.linspace(0, motion.duration, 60)]))
    half = np.diff(edges)[:, None] / 2
    t = (edges[:-1, None] + half + half * nodes).ravel().clip(0, motion.duration)
    distance = (half * weights).ravel() @ motion.derivative(t, 1)
    np.testing.assert_allclose(distance, motion.end - motion.start, atol=1e-9)


@pytest.mark.parametrize("name", AT_REST)
def test_starts_and_ends_with_zero_velocity(name: str) -> None:
    motion = MOTIONS[name]
    np.testing.assert_allclose(motion.derivative([0.0, motion.duration], 1), 0.0, atol=1e-12)


@pytest.mark.parametrize("name", sorted(set(AT_REST) & set(SMOOTH)))
def test_starts_and_ends_with_zero_acceleration(name: str) -> None:
    motion = MOTIONS[name]
    np.testing.assert_allclose(motion.derivative([0.0, motion.duration], 2), 0.0, atol=1e-11)


@pytest.mark.parametrize("name", SMOOTH)
def test_acceleration_is_continuous(name: str) -> None:
    motion = MOTIONS[name]
    inner = breaks_of(motion)
    inner = inner[(inner > 1e-6) & (inner < motion.duration - 1e-6)]
    jump = motion.derivative(inner + 1e-9, 2) - motion.derivative(inner - 1e-9, 2)
    assert np.abs(jump).max(initial=0.0) < 1e-5


@each_motion
@pytest.mark.parametrize("order", [0, 1, 2, 3])
def test_extremes_are_those_of_a_fine_grid(name: str, order: int) -> None:
    motion = MOTIONS[name]
    values = motion.derivative(np.linspace(0, motion.duration, 40001), order)
    low, high = motion.extremes(order)
    scale = 1e-12 + np.abs(values).max()
    assert np.all(low <= values.min(axis=0) + 1e-9 * scale)
    assert np.all(high >= values.max(axis=0) - 1e-9 * scale)
    np.testing.assert_allclose(low, values.min(axis=0), atol=1e-2 * scale)
    np.testing.assert_allclose(high, values.max(axis=0), atol=1e-2 * scale)


@each_motion
def test_one_time_gives_one_row(name: str) -> None:
    motion = MOTIONS[name]
    t = 0.37 * motion.duration
    for one, many in zip(motion.at(t), motion.at([t]), strict=True):
        assert one.shape == (3,)
        np.testing.assert_array_equal(one, many[0])


@each_motion
def test_times_outside_are_refused(name: str) -> None:
    motion = MOTIONS[name]
    with pytest.raises(MotionError, match="outside the motion"):
        motion.at(-0.1)
    with pytest.raises(MotionError, match="lasts from 0 to"):
        motion.at([0.0, motion.duration + 0.1])
    np.testing.assert_array_equal(motion.derivative(motion.duration * (1 + 1e-12)), motion.end)


@each_motion
def test_sampling_covers_the_motion(name: str) -> None:
    motion = MOTIONS[name]
    trajectory = motion.sample(250)
    assert trajectory.t[0] == 0.0
    assert motion.duration - 1 / 250 < trajectory.t[-1] <= motion.duration * (1 + 1e-9)
    np.testing.assert_allclose(np.diff(trajectory.t), 1 / 250, rtol=1e-9)
    assert not trajectory.q.flags.writeable
    assert (trajectory.n_samples, trajectory.n_joints) == trajectory.qdd.shape


def test_sampling_includes_an_end_on_the_grid() -> None:
    assert QuinticMotion.between([0.0], [1.0], 0.3).sample(10).n_samples == 4
    assert FourierMotion(np.ones((3, 1)), 1.1).sample(1000).n_samples == 1101


@pytest.mark.parametrize("rate", [0.0, -1.0, np.nan, np.inf])
def test_a_rate_must_be_positive(rate: float) -> None:
    with pytest.raises(MotionError, match="rate"):
        MOTIONS["fourier"].sample(rate)


@pytest.mark.parametrize("name", ["fourier", "b-spline"])
@pytest.mark.parametrize("order", [0, 1, 2, 3])
def test_derivatives_are_linear_in_the_coefficients(name: str, order: int) -> None:
    motion = MOTIONS[name]
    assert isinstance(motion, BasisMotion)
    t = np.linspace(0, motion.duration, 50)
    np.testing.assert_allclose(
        motion.basis(t, order) @ motion.coefficients, motion.derivative(t, order), atol=1e-12
    )


def test_slowing_scales_each_derivative() -> None:
    motion = MOTIONS["quintic"]
    slow = motion.slowed(10)
    for order in range(4):
        np.testing.assert_allclose(
            slow.derivative(5.0, order), motion.derivative(0.5, order) / 10**order, rtol=1e-12
        )
    with pytest.raises(MotionError, match="positive factor"):
        motion.slowed(0)


def test_concatenation_rests_between_motions() -> None:
    there, back = QuinticMotion.between([0.0], [1.0], 2.0), QuinticMotion.between([1.0], [0.2], 1.0)
    both = Concatenated([there, back], dwell=0.5)
    assert both.duration == 3.5
    np.testing.assert_array_equal(both.derivative([2.0, 2.2, 2.4999]).ravel(), 1.0)
    np.testing.assert_array_equal(both.derivative([2.1, 2.3], 1), 0.0)
    np.testing.assert_allclose(both.derivative(3.0), back.derivative(0.5))


def test_motions_that_do_not_meet_are_refused() -> None:
    there = QuinticMotion.between([0.0, 0.0], [1.0, 1.0], 2.0)
    with pytest.raises(
        MotionError,
        match=(
            r"motion 1 ends with position 1 of joint 2, motion 2 starts with"
            r" 0.5.*QuinticMotion.between"
        ),
    ):
        Concatenated([there, QuinticMotion.between([1.0, 0.5], [0.0, 0.0], 1.0)])
    moving = QuinticMotion.between([0.0, 0.0], [1.0, 1.0], 2.0, end_velocity=0.5)
    with pytest.raises(MotionError, match=r"ends with velocity 0\.5 of joint 1"):
        Concatenated([moving, QuinticMotion.between([1.0, 1.0], [0.0, 0.0], 1.0)])
    onward = QuinticMotion.between([1.0, 1.0], [2.0, 2.0], 2.0, start_velocity=0.5)
    assert Concatenated([moving, onward]).duration == 4.0
    with pytest.raises(MotionError, match="still moving"):
        Concatenated([moving, onward], dwell=0.1)
    with pytest.raises(MotionError, match="moves 2 joints, motion 2 moves 1"):
        Concatenated([there, QuinticMotion.between([1.0], [0.0], 1.0)])
    with pytest.raises(MotionError, match="dwell"):
        Concatenated([there], dwell=[]).duration and Concatenated([moving, onward], dwell=-1.0)
    with pytest.raises(MotionError, match="no motion"):
        Concatenated([])


def test_a_trajectory_has_one_shape() -> None:
    with pytest.raises(MotionError, match="qdd of a trajectory"):
        Trajectory(np.zeros(3), np.zeros((3, 2)), np.zeros((3, 2)), np.zeros((2, 2)))
