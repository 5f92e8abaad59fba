"""Stiffness and delay of servos against MuJoCo's position actuators."""

import dataclasses

import numpy as np
import pytest

from asbuilt.description.formats.mjcf import read_mjcf
from asbuilt.dynamics import DriveSet, PositionServo, find_base_parameters
from asbuilt.dynamics.drives.position_servo import read_described_servo
from asbuilt.experiment import Recording, SignalChain, prepare_samples, resolve_chain
from asbuilt.experiment.command.torque import drive_by_command, hold_command
from asbuilt.identification.identify import fit_samples
from asbuilt.identification.servo.servo_estimate import estimate_servo
from asbuilt.identification.servo.servo_fits import estimate_servo_delay_errors
from asbuilt.workflow import StudyOptions, identify
from asbuilt.workflow.servo import CommandedTorque
from studied_cases import first_of

KP, DELAY, STEP, RATE = (15.0, 15.0, 15.0), 0.013, 0.001, 100.0
ROBOT = """
<mujoco model="arm"><option timestep="0.001" integrator="implicitfast"/>
<default><joint damping="0.4" armature="0.02" frictionloss="0.05"/>
<position kp="15" kv="0.0"/></default>
<worldbody><body name="a"><joint name="pan" axis="0 0 1"/>
<geom type="capsule" size="0.03" fromto="0 0 0 0 0 0.1" mass="0.3"/>
<body name="b" pos="0 0 0.1"><joint name="lift" axis="0 1 0"/>
<geom type="capsule" size="0.02" fromto="0 0 0 0.25 0 0" mass="0.4"/>
<body name="c" pos="0.25 0 0"><joint name="elbow" axis="0 1 0"/>
<geom type="capsule" size="0.02" fromto="0 0 0 0.2 0 0" mass="0.3"/></body></body></body>
</worldbody><actuator><position joint="pan"/><position joint="lift"/><position joint="elbow"/>
</actuator></mujoco>
"""


@pytest.fixture(scope="module")
def recording():
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_string(ROBOT)
    model.geom_contype[:] = 0
    model.dof_solref[:], model.dof_solimp[:] = [0.004, 1.0], [0.99, 0.999, 0.001, 0.5, 2.0]
    data, per, n = mujoco.MjData(model), round(1.0 / RATE / STEP), 4000
    rng, t = np.random.default_rng(3), np.arange(4000) / RATE
    waves = [
        (rng.uniform(0.1, 0.5) / f, 2.0 * np.pi * f, rng.uniform(0, 6.28))
        for _ in range(3)
        for f in (0.3, 0.55, 0.9, 1.7)
    ]
    u = np.stack(
        [sum(a * np.sin(w * t + p) for a, w, p in waves[4 * k : 4 * k + 4]) for k in range(3)], 1
    )
    fine = np.repeat(u, per, axis=0)
    late = np.concatenate([np.repeat(u[:1], round(DELAY / STEP), axis=0), fine])
    q = np.empty((n, 3))
    data.qpos[:] = u[0]
    for k in range(n):
        q[k] = data.qpos
        for i in range(per):
            data.ctrl[:] = late[k * per + i]
            mujoco.mj_step(model, data)
    q += rng.normal(scale=1e-4, size=q.shape)
    return Recording(
        t=t, q=q, tau=np.zeros_like(q), command=u, joint_names=("pan", "lift", "elbow")
    )


def unknown(kp=(np.nan,) * 3, kd=(0.0,) * 3):
    return PositionServo(kp=kp, kd=kd)


def estimated(recording, servo, model=None, **settings):
    model = model or read_mjcf(ROBOT)
    drive = DriveSet.parse("armature,viscous,coulomb")
    driven = drive_by_command(recording, servo)
    chain = resolve_chain(SignalChain(), driven)
    return estimate_servo(model, [driven], drive, chain, **settings)


def test_delay_of_a_known_servo_is_found(recording):
    found = estimated(recording, unknown(KP))
    assert found.servo.kp == KP
    assert found.errors.delay < 1e-3
    assert found.servo.delay == pytest.approx(DELAY, abs=STEP)
    assert found.unexplained == ()


def test_stiffness_is_found_from_the_masses_of_cad(recording):
    found = estimated(recording, unknown())
    assert not found.errors.shared
    assert found.servo.kp == pytest.approx(KP, rel=0.03)
    assert np.array(found.errors.kp) / np.array(found.servo.kp) == pytest.approx(0.1, rel=0.05)
    assert found.servo.delay == pytest.approx(DELAY, abs=STEP)
    assert set(found.errors.scale) <= {"gravity", "inertia"}


def test_wrong_masses_of_cad_are_no_delay(recording):
    """Links of other masses scale each joint's stiffness otherwise, but not what turns what."""
    plain = estimated(recording, unknown(KP))
    model = read_mjcf(ROBOT)
    chi = model.parameters.reshape(3, 10) * np.array([[1.0], [0.8], [1.25]])
    found = estimated(recording, unknown(), model.with_parameters(chi.ravel()))
    assert np.ptp(found.servo.kp) < 0.02 * np.mean(found.servo.kp)
    assert found.servo.delay == pytest.approx(plain.servo.delay, abs=2.0 * found.errors.delay)


@pytest.mark.study
def test_one_stiffness_is_shared_if_asked(recording):
    together = estimated(recording, unknown(), shared=True)
    assert together.errors.shared
    assert np.ptp(together.servo.kp) == 0.0
    assert together.servo.kp[0] == pytest.approx(15.0, rel=0.03)


@pytest.mark.study
def test_time_in_contact_is_named(recording):
    q = recording.q.copy()
    touching = (recording.t >= 10.0) & (recording.t < 12.0)
    q[touching, 2] += 0.15
    found = estimated(dataclasses.replace(recording, q=q), unknown(KP))
    starts = [block.start for block in found.unexplained]
    assert starts
    assert all(8.5 <= start <= 12.5 for start in starts)


def test_a_study_of_commands_recovers_armature_and_friction(recording):
    driven = drive_by_command(recording, unknown(KP))
    study = identify(
        read_mjcf(ROBOT),
        driven,
        options=StudyOptions(
            method="entropic", drive=DriveSet.parse("armature,viscous,coulomb"), checked=False
        ),
    )
    result = study.result
    assert result.servo.delay == pytest.approx(DELAY, abs=1e-3)
    found = {each.name: each for each in result.parameters}
    assert found["Fv2"].estimate == pytest.approx(0.4, abs=0.05)
    assert found["Fc2"].estimate == pytest.approx(0.05, abs=0.02)
    assert found["Ia3"].estimate == pytest.approx(0.02, abs=0.006)
    again = type(result).from_json(result.to_json())
    assert again.servo == result.servo
    assert again.servo_errors == result.servo_errors


def test_gains_of_position_actuators_are_read():
    pytest.importorskip("mujoco")
    servo = read_described_servo(read_mjcf(ROBOT))
    assert servo is not None
    assert servo.kp == KP
    assert servo.kd == (0.0, 0.0, 0.0)


@pytest.mark.study
def test_stiffness_does_not_share_gravity_with_a_constant_torque(recording):
    driven = drive_by_command(recording, unknown())
    chain = resolve_chain(SignalChain(), driven)
    model = read_mjcf(ROBOT)
    with_offset, without = (
        estimate_servo(model, [driven], DriveSet.parse(terms), chain, delay=DELAY)
        for terms in ("armature,viscous,coulomb,offset", "armature,viscous,coulomb")
    )
    # Ratios come from a fit of all columns, and move by what a column more changes in it.
    moved = np.abs(np.subtract(with_offset.servo.kp, without.servo.kp))
    assert np.all(moved < 0.002 * np.array(without.errors.kp))


def test_noise_of_positions_demands_no_low_cutoff_where_they_are_in_the_torque(recording):
    driven = drive_by_command(recording, unknown(KP))
    measured = dataclasses.replace(driven, torque_source="unknown")
    assert resolve_chain(SignalChain(), measured).cutoff < 7.0
    assert resolve_chain(SignalChain(), driven).cutoff >= 7.0


def limited_recording(acceleration):
    """Return a recording of the arm whose servo limits its goal, with fast commands."""
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_string(ROBOT)
    model.geom_contype[:] = 0
    data, per, n = mujoco.MjData(model), round(1.0 / RATE / STEP), 3000
    t = np.arange(n) / RATE
    sweep = 0.2 * np.sin(2.0 * np.pi * (0.2 * t + 0.05 * t**2))
    u = np.stack([sweep, np.roll(sweep, 40), 0.8 * np.roll(sweep, 90)], axis=1)
    servo = PositionServo(kp=KP, kd=(0.0,) * 3, goal_acceleration=(acceleration,) * 3)
    fine = servo.goal(t, u)[1]
    assert fine.shape == (n * per, 3)
    q = np.empty((n, 3))
    data.qpos[:] = u[0]
    for k in range(n):
        q[k] = data.qpos
        for i in range(per):
            data.ctrl[:] = fine[k * per + i]
            mujoco.mj_step(model, data)
    q += np.random.default_rng(5).normal(scale=2e-4, size=q.shape)
    return Recording(
        t=t, q=q, tau=np.zeros_like(q), command=u, joint_names=("pan", "lift", "elbow")
    )


def sought(recording):
    servo = PositionServo(kp=KP, kd=(0.0,) * 3, goal_acceleration=(np.nan,) * 3)
    return estimated(recording, servo)


@pytest.fixture(scope="module")
def limited():
    return limited_recording(20.0)


@pytest.mark.study
def test_a_limit_of_the_goal_is_found_and_counts(limited):
    found = sought(limited)
    assert found.servo.goal_acceleration == pytest.approx((20.0,) * 3, rel=0.05)
    assert found.errors.goal_sought == (True,) * 3
    assert 0.0 < found.errors.goal_acceleration < 2.0
    assert np.mean([block.start > 5.0 for block in found.goals[0].acts]) > 0.9
    ignored = estimated(limited, unknown(KP))
    assert abs(found.servo.delay) < 2e-3 < abs(ignored.servo.delay)
    assert found.of_recording(0) == found.servo


@pytest.mark.study
def test_a_limit_of_the_goal_does_not_hang_on_the_last_digits_of_a_recording(limited):
    last = 1e-12 * np.random.default_rng(1).normal(size=limited.q.shape)
    as_read = sought(dataclasses.replace(limited, q=limited.q + last)).servo
    assert as_read.goal_acceleration == pytest.approx(sought(limited).servo.goal_acceleration)


@pytest.mark.study
def test_no_limit_of_the_goal_is_found_where_there_is_none(recording):
    for each in (recording, limited_recording(np.inf)):
        found = sought(each)
        assert found.goals == (None,)
        assert found.servo.goal_acceleration == (np.inf,) * 3
        assert not found.servo.limits_goal


@pytest.mark.study
def test_parameters_follow_the_delay_of_the_servo_as_their_errors_say(recording):
    driven = drive_by_command(recording, unknown(KP))
    model, drive = read_mjcf(ROBOT), DriveSet.parse("armature,viscous,coulomb")
    chain = resolve_chain(SignalChain(), driven)
    base = find_base_parameters(model, drive)

    def fitted(delay):
        late = drive_by_command(recording, dataclasses.replace(unknown(KP), delay=delay))
        return fit_samples(model, [prepare_samples(late, chain)], base=base, method="wls")

    found = estimated(recording, unknown(KP))
    fit = fitted(found.servo.delay)
    added = estimate_servo_delay_errors(
        fit.information, fit.estimate, found.slopes, found.servo.delay, 1e-3
    )
    moved = 0.5 * (
        fitted(found.servo.delay + 1e-3).estimate.beta
        - fitted(found.servo.delay - 1e-3).estimate.beta
    )
    sizes = np.sqrt(np.diag(added.covariance))
    drives = [j for j, name in enumerate(base.names) if name[:2] in ("Fv", "Ia")]
    assert sizes[drives] == pytest.approx(np.abs(moved[drives]), rel=0.1, abs=1e-4)
    assert np.max(sizes[drives]) > 0.005
    shift = 1e-3 * added.shift[drives] / found.servo.delay
    assert shift == pytest.approx(-moved[drives], rel=0.1, abs=1e-4)
    assert (
        estimate_servo_delay_errors(fit.information, fit.estimate, found.slopes, 0.0, 0.0) is None
    )


@pytest.mark.study
def test_magnitudes_beside_commands_give_the_damping_of_the_servo(recording):
    error = hold_command(recording, DELAY) - recording.q
    velocity = np.gradient(recording.q, recording.t, axis=0)
    noise = np.random.default_rng(4).normal(scale=2e-3, size=error.shape)
    current = np.abs(0.2 * (error - 0.04 * velocity)) + np.abs(noise)
    logged = dataclasses.replace(recording, tau=current)
    found = estimated(logged, unknown(KP))
    late = found.servo.delay
    for law in found.currents:
        assert law.kind == "motor"
        assert law.holds
        assert law.lag - late == pytest.approx(0.04, abs=4e-3)
    (told,) = [
        each
        for each in CommandedTorque(found).findings(read_mjcf(ROBOT), DriveSet.parse("viscous"))
        if each.code == "servo_current_explained"
    ]
    assert "pan 3" in told.message or "pan 4" in told.message


@pytest.mark.parametrize(("skew", "told"), first_of(1, [(0.0, False), (0.02, True)]))
def test_a_torque_before_its_command_is_no_delay(recording, skew, told):
    """Positions that were logged late are told from a servo that is late."""
    t = recording.t
    moved = np.stack([np.interp(t + skew, t, x) for x in recording.q.T], axis=1)
    found = estimated(dataclasses.replace(recording, q=moved), unknown(KP))
    assert found.servo.delay == pytest.approx(DELAY - skew, abs=1.5e-3)
    findings = CommandedTorque(found).findings(read_mjcf(ROBOT), DriveSet.parse("viscous"))
    assert ("servo_ahead" in [each.code for each in findings]) == told
