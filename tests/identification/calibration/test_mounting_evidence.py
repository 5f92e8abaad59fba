"""A base tilt predicts motions held out better if the base is tilted, and not otherwise."""

import numpy as np
import pytest

from asbuilt import load_robot, simulate_recording
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.excitation.motions.random_motion import random_fourier
from asbuilt.experiment.signal.preparation import prepare_samples, resolve_chain
from asbuilt.experiment.signal.signal_chain import SignalChain
from asbuilt.experiment.virtual.sensors import SensorNoise
from asbuilt.identification.calibration.mounting import find_mounting
from asbuilt.identification.calibration.mounting_evidence import relief_on_other_motions


@pytest.mark.parametrize("degrees", [0.0, 2.0])
def test_relief_is_that_of_a_tilted_base(degrees):
    arm = load_robot("scara")
    angle = np.deg2rad(degrees)
    tilted = arm.with_gravity(9.81 * np.array([np.sin(angle), 0.0, -np.cos(angle)]))
    drive = DriveSet.parse("viscous,coulomb,offset")
    log = simulate_recording(
        tilted,
        random_fourier(arm, rng=4, duration=20.0),
        rate=100.0,
        drive=drive,
        drive_values=np.full(3 * arm.n_joints, 0.5),
        noise=SensorNoise(torque_noise=0.2),
        rng=4,
    )
    samples = [prepare_samples(log, resolve_chain(SignalChain(), log))]
    mounting = find_mounting(arm, samples, drive=drive)
    relief = relief_on_other_motions(mounting, samples, drive=drive)
    assert relief is not None
    assert mounting.is_tilted == (degrees > 0.0)
    if degrees:
        assert relief[0] > 3.0 * relief[1]
        assert relief[0] > np.log(2.0)
    else:
        assert relief[0] < 0.1


@pytest.mark.study
def test_torques_without_noise_end_in_an_answer():
    arm = load_robot("ur10e")
    tilted = arm.with_gravity(9.81 * np.array([np.sin(0.17), 0.0, -np.cos(0.17)]))
    log = simulate_recording(tilted, random_fourier(arm, rng=4), rate=200.0)
    samples = [prepare_samples(log, resolve_chain(SignalChain(), log))]
    drive = DriveSet.parse("viscous,coulomb,offset")
    mounting = find_mounting(arm, samples, drive=drive)
    assert mounting.is_tilted
    assert relief_on_other_motions(mounting, samples, drive=drive) is None
