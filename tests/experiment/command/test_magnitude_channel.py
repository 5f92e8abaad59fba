"""Currents without a sign beside commands, made by a motor's own equations."""

import dataclasses

import numpy as np
import pytest

from asbuilt.dynamics import PositionServo
from asbuilt.errors import RecordingError
from asbuilt.experiment import Recording, read_recording
from asbuilt.experiment.command.magnitude import (
    describe_laws,
    fit_logged_magnitude_laws,
    fit_magnitude_laws,
    is_magnitude,
    sign_by_command,
)
from asbuilt.experiment.command.torque import drive_by_command

DUTY, VOLTAGE, RESISTANCE, INDUCED = 3.0, 12.0, 4.0, 1.8
LAG = INDUCED / (DUTY * VOLTAGE)
"""Duty cycle per rad, supply voltage [V], resistance [ohm], induced voltage [V s/rad]."""


def simulated(step=1e-3, duration=40.0, keep=10):
    """Integrate a geared DC motor under a proportional servo and gravity; return log and currents.

    Currents are means over a sampling period. The motor's current is (D V - k w) / R with the duty
    cycle D; the supply gives D times that.
    """
    inertia, coulomb, weight = 0.05, 0.15, 0.8
    n = round(duration / step)
    t = step * np.arange(n)
    command = 0.5 * np.sin(1.3 * t) + 0.4 * np.sin(2.9 * t + 1.0)
    command = np.repeat(command[::keep], keep)[:n]
    q, w = np.empty(n), np.empty(n)
    motor = np.empty(n)
    x, v = command[0], 0.0
    for k in range(n):
        duty = DUTY * (command[k] - x)
        i = (duty * VOLTAGE - INDUCED * v) / RESISTANCE
        q[k], w[k], motor[k] = x, v, i
        torque = INDUCED * i
        v += step / inertia * (torque - weight * np.sin(x) - coulomb * np.tanh(v / 0.01))
        x += step * v
    supply = DUTY * (command - q) * motor
    kept = slice(None, None, keep)
    motor, supply = (np.convolve(each, np.ones(keep) / keep, "same") for each in (motor, supply))
    log = Recording(
        t=t[kept],
        q=q[kept, None],
        qd=w[kept, None],
        tau=np.abs(motor[kept, None]),
        command=command[kept, None],
    )
    return log, motor[kept], supply[kept]


@pytest.fixture(scope="module")
def log():
    return simulated()


def noisy(values, rng):
    return np.maximum(values + 0.02 * np.abs(values).max() * rng.normal(size=values.shape), 0.0)


def test_the_current_of_a_motor_gives_the_damping_of_its_servo(log):
    recording, motor, _ = log
    law = fit_magnitude_laws(recording, [noisy(np.abs(motor), np.random.default_rng(1))[:, None]])[
        0
    ]
    assert law.kind == "motor"
    assert law.holds
    assert law.explained > 0.9
    assert law.lag == pytest.approx(LAG, abs=0.01)
    assert law.scale == pytest.approx(DUTY * VOLTAGE / RESISTANCE, rel=0.05)


def test_the_current_of_a_supply_grows_with_the_square(log):
    recording, _, supply = log
    drawn = noisy(np.maximum(supply, 0.0), np.random.default_rng(2))
    law = fit_magnitude_laws(recording, [drawn[:, None]])[0]
    assert law.kind == "supply"
    assert law.holds
    assert law.lag == pytest.approx(LAG, abs=0.01)
    assert law.scale == pytest.approx(DUTY**2 * VOLTAGE / RESISTANCE, rel=0.05)
    assert law.lag_error < 0.01
    with pytest.raises(RecordingError, match="supply currents"):
        sign_by_command(dataclasses.replace(recording, tau=drawn[:, None]))


def test_the_sign_of_a_current_is_that_of_the_command(log):
    recording, motor, _ = log
    signed = sign_by_command(recording)
    clear = np.abs(motor) > 0.1 * np.abs(motor).max()
    assert np.mean(np.sign(signed.tau[clear, 0]) == np.sign(motor[clear])) > 0.995
    assert "sign of command" in signed.notes[-1]


def test_a_column_that_does_not_follow_the_command_has_no_sign(log):
    recording, _, _ = log
    noise = np.abs(np.random.default_rng(3).normal(size=recording.tau.shape))
    assert not fit_magnitude_laws(recording, [noise])[0].holds
    with pytest.raises(RecordingError, match="do not follow the command"):
        sign_by_command(dataclasses.replace(recording, tau=noise))
    unused = sign_by_command(dataclasses.replace(recording, tau=noise), ["joint_1"])
    assert np.abs(unused.tau) == pytest.approx(noise)


def test_no_command_and_torques_with_a_sign_are_refused(log):
    recording, motor, _ = log
    with pytest.raises(RecordingError, match="no commanded positions"):
        sign_by_command(dataclasses.replace(recording, command=None))
    with pytest.raises(RecordingError, match="they have a sign"):
        sign_by_command(dataclasses.replace(recording, tau=motor[:, None]))


def test_magnitudes_beside_commands_are_a_second_channel(log):
    recording, motor, _ = log
    servo = PositionServo(kp=(np.nan,), kd=(np.nan,))
    laws = fit_logged_magnitude_laws([drive_by_command(recording, servo)])
    assert laws[0].holds
    assert "motor currents" in describe_laws(("elbow",), laws)
    signed = dataclasses.replace(recording, tau=motor[:, None])
    assert fit_logged_magnitude_laws([drive_by_command(signed, servo)]) == ()


def test_a_magnitude_is_never_negative():
    t = np.linspace(0.0, 10.0, 1000)
    assert is_magnitude(np.abs(np.sin(t)))
    assert not is_magnitude(np.sin(t))
    assert not is_magnitude(np.zeros(10))


def test_a_sheet_takes_the_sign_from_the_command(log, tmp_path):
    recording, motor, _ = log
    path = tmp_path / "log.csv"
    table = np.column_stack([recording.t, recording.q, recording.qd, recording.tau])
    np.savetxt(
        path,
        np.column_stack([table, recording.command]),
        delimiter=",",
        header="t,q_1,qd_1,i_1,command_1",
        comments="",
    )
    path.with_suffix(".toml").write_text('sign = "command"\ngains = 1.8\n')
    read = read_recording(path)
    clear = np.abs(motor) > 0.1 * np.abs(motor).max()
    assert read.tau[clear, 0] == pytest.approx(1.8 * motor[clear], rel=1e-6)
    path.with_suffix(".toml").write_text('sign = "commands"\n')
    with pytest.raises(RecordingError, match="sign"):
        read_recording(path)
