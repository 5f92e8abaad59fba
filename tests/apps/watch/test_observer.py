"""The residual against torques and forces that are known."""

import numpy as np
import pytest
from watched_robot import RATE, WatchedRobot

from asbuilt import Observer
from asbuilt.apps.watch import estimate_contact
from asbuilt.apps.watch.events import frame_jacobian
from asbuilt.description import bundled_robot
from asbuilt.dynamics import DriveSet, TorqueModel, gravity_torque
from asbuilt.errors import RecordingError, UsageError
from asbuilt.excitation import random_fourier
from asbuilt.experiment import VirtualRobot
from asbuilt.experiment.virtual.physics import Physics

BANDWIDTH = 8.0
GAIN = 2.0 * np.pi * BANDWIDTH


def test_residual_follows_a_step_of_torque_by_the_analytic_lag() -> None:
    """Noise-free motion at 1 kHz with a torque from 1 s on, between samples a ramp."""
    robot = VirtualRobot.ideal(bundled_robot("kuka-iiwa7-r800"))
    moved = random_fourier(robot.model, rng=4, duration=3.0).sample(1000.0)
    external = np.array([3.0, -8.0, 2.0, 4.0, 1.0, 0.5, -0.2])
    tau = robot.exact_torque(moved.q, moved.qd, moved.qdd) - np.outer(moved.t >= 1.0, external)
    seen = Observer(robot.model, bandwidth=BANDWIDTH).observe(moved.t, moved.q, tau, moved.qd)
    since = np.maximum(moved.t - 0.9995, 0.0)
    expected = np.outer(1.0 - np.exp(-GAIN * since), external)
    settled = (moved.t > 0.5) & (np.abs(moved.t - 1.0) > 0.002)
    errors = np.abs(seen.residual - expected)[settled] / np.abs(external).max()
    assert errors.max() < 1e-3


def test_lag_does_not_depend_on_the_clock() -> None:
    """Held still under a constant torque: exact on an irregular clock."""
    model, rng = bundled_robot("ur10e"), np.random.default_rng(0)
    q, external = rng.normal(size=6), rng.normal(size=6)
    t = np.cumsum(rng.uniform(0.001, 0.08, 60))
    tau = np.tile(gravity_torque(model, q) - external, (60, 1))
    seen = Observer(model, bandwidth=BANDWIDTH).observe(
        t, np.tile(q, (60, 1)), tau, np.zeros((60, 6))
    )
    expected = np.outer(1.0 - np.exp(-GAIN * (t - t[0])), external)
    assert np.allclose(seen.residual, expected, rtol=0, atol=1e-10)


@pytest.mark.parametrize("velocities", [True, False])
def test_sample_by_sample_is_the_whole_log(watched: WatchedRobot, velocities: bool) -> None:
    log = watched.quiet[0].between(0.0, 4.0)
    kept = np.ones(log.n_samples, dtype=bool)
    kept[300:340] = False
    log = log.taken(kept)
    assert log.qd is not None
    qd = log.qd if velocities else [None] * log.n_samples
    observer = Observer(watched.result)
    single = [observer.update(*row) for row in zip(log.t, log.q, log.tau, qd, strict=True)]
    whole = Observer(watched.result).observe(log.t, log.q, log.tau, log.qd if velocities else None)
    assert np.allclose(single, whole.residual, rtol=0, atol=1e-10)
    assert np.all(whole.residual[300] == 0.0)


def test_threshold_of_a_sample_is_that_of_the_log(watched: WatchedRobot) -> None:
    log = watched.quiet[0].between(0.0, 1.0)
    assert log.qd is not None
    observer = Observer(watched.result, thresholds=watched.thresholds)
    limits = []
    for row in zip(log.t, log.q, log.tau, log.qd, strict=True):
        observer.update(*row)
        limits.append(observer.threshold)
    seen = observer.observe(log.t, log.q, log.tau, log.qd)
    expected = watched.thresholds.of_log(seen, observer.model_error)[1]
    assert np.allclose(limits, expected, rtol=1e-10)


def test_friction_of_unknown_direction_stays_within_what_the_threshold_holds() -> None:
    """Joints creep to and fro; their velocities are known to 1e-6 rad/s, at most half of theirs."""
    coulomb, error, rng = np.array([3.0, 5.0]), 1e-6, np.random.default_rng(0)
    robot = TorqueModel(bundled_robot("two-link"), DriveSet.parse("coulomb"), coulomb)
    t = np.arange(0.0, 4.0, 0.01)
    qd = 2.0 * error * np.sin(np.outer(t, [3.0, 7.1]) + 0.1)
    tau = robot(np.zeros(qd.shape), qd, np.zeros(qd.shape))
    logged = qd + rng.uniform(-error, error, qd.shape)
    blind, seen = (
        Observer(robot, velocity_error=given).observe(t, np.zeros(qd.shape), tau, logged)
        for given in (0.0, error)
    )
    assert np.any(np.abs(blind.residual) > 0.5 * coulomb)
    assert np.all(np.abs(seen.residual) <= seen.unknown_friction + 1e-3 * coulomb)
    assert np.all(seen.unknown_friction <= 2.0 * coulomb)
    fast = Observer(robot, velocity_error=error).observe(t, 0.0 * qd, tau, np.ones(qd.shape))
    assert np.all(fast.unknown_friction == 0.0)


def test_filtered_positions_serve_without_velocities(watched: WatchedRobot) -> None:
    """A torque of 10 N m is seen behind both lags."""
    external = np.zeros((801, 7))
    external[400:] = [0, 10.0, 0, 0, 0, 0, 0]
    log = watched.record(9, 4.0, external)
    assert log.n_samples == len(external)
    seen = Observer(watched.result).observe(log.t, log.q, log.tau)
    late = seen.t > 400 / RATE + 0.2
    assert abs(seen.residual[late, 1].mean() - 10.0) < 0.5


@pytest.mark.study
def test_force_of_another_engine_is_found_with_its_point() -> None:
    """MuJoCo pushes a link of a moving arm; force and line of action follow from the torques."""
    model = bundled_robot("kuka-iiwa7-r800")
    physics = Physics(model, timestep=0.001)
    command = random_fourier(model, rng=3, duration=1.5).sample(1000.0)
    pushed, force = np.array([0.02, -0.03, 0.11]), np.array([12.0, -20.0, 15.0])
    link, rows = 6, []
    physics.start(command.q[0], command.qd[0])
    M = np.diag([60.0, 60.0, 20.0, 20.0, 5.0, 2.0, 0.5])
    for k, t in enumerate(command.t):
        q, qd = physics.state
        tau = gravity_torque(model, q) + M @ (10.0 * (command.q[k] - q) + (command.qd[k] - qd))
        here = frame_jacobian(
            model, q, link, np.block([[np.eye(3), pushed[:, None]], [0, 0, 0, 1]])
        )
        rows.append((t, q, qd, tau))
        body = physics.compiled.body(model.links[link].name).id
        data = physics.data
        centre = data.xipos[body]
        origin, turned = data.xpos[body], data.xmat[body].reshape(3, 3)
        lever = origin + turned @ pushed - centre if k else np.zeros(3)
        data.xfrc_applied[body, :3] = force
        data.xfrc_applied[body, 3:] = np.cross(lever, force)
        physics.advance(tau)
    t, q, qd, tau = (np.array(column) for column in zip(*rows, strict=True))
    seen = Observer(model, bandwidth=BANDWIDTH).observe(t, q, tau, qd)
    expected = here[3:].T @ force
    assert np.allclose(seen.residual[-1], expected, rtol=0, atol=0.05 * np.abs(expected).max())
    contact = estimate_contact(model, q[-1], seen.residual[-1], 0.01 * np.eye(7), link, np.eye(4))
    turned = physics.data.xmat[body].reshape(3, 3)
    assert contact.point is not None
    along = force / np.linalg.norm(force)
    off = turned @ pushed - contact.point
    assert np.linalg.norm(off - along * (along @ off)) < 0.015
    wrong = estimate_contact(model, q[-1], expected, 1e-4 * np.eye(7), link, np.eye(4))
    assert wrong.p_value < 1e-6
    placed = np.eye(4)
    placed[:3, 3] = pushed
    right = estimate_contact(model, q[-1], expected, 1e-4 * np.eye(7), link, placed)
    assert np.allclose(right.force, force, atol=0.2)
    assert right.p_value > 0.9


def test_bad_samples_are_refused(watched: WatchedRobot) -> None:
    observer, n = Observer(watched.result), 7
    observer.update(0.0, np.zeros(n), np.zeros(n), np.zeros(n))
    with pytest.raises(UsageError, match="time must advance"):
        observer.update(0.0, np.zeros(n), np.zeros(n), np.zeros(n))
    with pytest.raises(UsageError, match="q must be 7 finite numbers"):
        observer.update(0.1, np.full(n, np.nan), np.zeros(n), np.zeros(n))
    with pytest.raises(UsageError, match="no thresholds"):
        _ = observer.threshold
    with pytest.raises(UsageError, match="bandwidth"):
        Observer(watched.result, bandwidth=0.0)
    with pytest.raises(UsageError, match="belong to the joints"):
        Observer(bundled_robot("ur10e"), thresholds=watched.thresholds)
    with pytest.raises(RecordingError, match="time must advance"):
        observer.observe([0.0, 0.0], np.zeros((2, n)), np.zeros((2, n)))
