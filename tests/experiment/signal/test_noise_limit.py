"""The band that coarse positions leave, by the torque of a robot whose truth is known."""

from dataclasses import replace

import numpy as np
import pytest

from asbuilt.description import bundled_robot
from asbuilt.excitation import random_fourier
from asbuilt.experiment import (
    Recording,
    SensorNoise,
    SignalChain,
    VirtualRobot,
    check_recording,
    prepare_samples,
    resolve_chain,
)
from asbuilt.experiment.signal.band_choice import estimate_noise_limit
from asbuilt.identification import identify_samples
from asbuilt.validation import validate_samples
from studied_cases import first_of

COARSE = {"three decimals": (2e3 * np.pi, 1000.0), "counts": (4096.0, 1000.0), "slow": (16491, 195)}


def recorded(robot, seed, duration=20.0, rate=1000.0, **noise):
    return (
        VirtualRobot.typical(bundled_robot(robot), rng=3)
        .with_noise(SensorNoise(**noise))
        .record(random_fourier(bundled_robot(robot), rng=seed, duration=duration), 5, rate=rate)
        .recording
    )


@pytest.mark.parametrize("kind", first_of(1, COARSE))
def test_a_coarse_log_predicts_another_motion_as_well_as_a_fine_one(kind):
    counts, rate = COARSE[kind]
    model = bundled_robot("ur10e")
    other = prepare_samples(recorded("ur10e", 104, 10.0), SignalChain(cutoff=20.0))
    drive = VirtualRobot.typical(model, rng=3).train.drive
    errors = []
    for encoder in (0.0, counts):
        log = recorded("ur10e", 4, rate=rate, encoder_counts=encoder, torque_noise=0.1)
        result = identify_samples(model, [prepare_samples(log)], drive=drive)
        errors.append(validate_samples(result, other).metrics_as_built.relative_error)
    assert errors[1] < errors[0] + 0.003


def test_steps_lower_the_cutoff_only_as_far_as_they_matter():
    cutoffs = [
        resolve_chain(
            SignalChain(),
            recorded("kuka-iiwa7-r800", 4, encoder_counts=counts, torque_noise=0.01),
        ).cutoff
        for counts in (0.0, 2.0**19, 4096.0, 1024.0)
    ]
    assert cutoffs[0] == cutoffs[1] == 7.0
    assert cutoffs[1] > cutoffs[2] > cutoffs[3] >= 3.0


def test_one_noisy_joint_does_not_decide_for_all():
    def cutoff(counts):
        log = recorded("kuka-iiwa7-r800", 4, encoder_counts=counts, torque_noise=0.01)
        return resolve_chain(SignalChain(), log).cutoff

    assert cutoff((2.0**19,) * 6 + (1024.0,)) > 1.2 * cutoff(1024.0)


def test_a_good_velocity_is_used_in_place_of_coarse_positions():
    log = recorded("ur10e", 4, encoder_counts=1024.0, torque_noise=0.01, velocity_noise=1e-4)
    assert resolve_chain(SignalChain(), log).cutoff == 7.0
    assert resolve_chain(SignalChain(), replace(log, qd=None)).cutoff < 6.0
    assert any("logged velocities used" in line for line in prepare_samples(log).provenance)


def test_noise_is_told_from_motion_by_torque():
    """Two joints with one and the same motion; torque shows whose fast part is real."""
    rng, t = np.random.default_rng(0), np.arange(0.0, 60.0, 0.005)
    slow = np.sin(0.8 * np.pi * t) + 0.3 * np.sin(1.4 * np.pi * t)
    fast = 0.0007 * np.sin(24.0 * np.pi * t)
    q = np.column_stack([slow + fast] * 2)
    acceleration = np.gradient(np.gradient(slow, 0.005), 0.005)
    tau = np.column_stack([acceleration, acceleration - (24.0 * np.pi) ** 2 * fast])
    limit = estimate_noise_limit([(q, tau + 1e-3 * rng.standard_normal(tau.shape))], 200.0)
    assert limit is not None
    at = np.searchsorted(limit.frequency, [8.0, 16.0])
    assert limit.error[at[1], 0] > 2 * limit.error[at[0], 0]
    assert limit.error[at[1], 1] < limit.error[at[0], 1]
    assert limit.limiting_joint(20.0) == 0


def test_the_check_names_step_noise_and_limit():
    model = bundled_robot("kuka-iiwa7-r800")
    coarse = recorded("kuka-iiwa7-r800", 4, encoder_counts=1024.0, torque_noise=0.01)
    found = check_recording(model, coarse)
    assert {"band_limited_by_noise", "coarse_positions"} <= set(found.codes)
    np.testing.assert_allclose(found.position_step, 2 * np.pi / 1024, rtol=1e-3)
    assert min(found.position_noise) >= 0.99 * (2 * np.pi / 1024) ** 2 / 6000
    fine = check_recording(model, recorded("kuka-iiwa7-r800", 4, torque_noise=0.01))
    assert not {"band_limited_by_noise", "coarse_positions"} & set(fine.codes)
    assert not any(fine.position_step)


def test_no_torque_and_no_motion_limit_nothing():
    t = np.arange(0.0, 20.0, 0.01)
    still = Recording(t=t, q=np.zeros((2000, 1)), tau=np.zeros((2000, 1)))
    assert estimate_noise_limit([(still.q, still.tau)], 100.0) is None
    moving = Recording(t=t, q=np.sin(t)[:, None], tau=np.zeros((2000, 1)))
    assert resolve_chain(SignalChain(), moving).cutoff == 7.0
