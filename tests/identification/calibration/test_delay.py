"""Delay of the torque: found within its error, told from a lag of friction, counted in errors."""

from dataclasses import replace

import numpy as np
import pytest

from asbuilt.description import load_robot
from asbuilt.dynamics import DriveSet, find_base_parameters
from asbuilt.excitation import random_fourier
from asbuilt.experiment import (
    Recording,
    SensorNoise,
    SignalChain,
    prepare_samples,
    read_recording,
    resolve_chain,
    simulate_recording,
)
from asbuilt.identification.calibration.delay import (
    HELPFUL,
    DelayEstimate,
    find_delays,
    measure_delay_relief,
)
from asbuilt.identification.identify import fit_samples
from asbuilt.identification.uncertainty.delay_errors import estimate_delay_errors
from asbuilt.workflow.delays import settle_delays

MODEL = load_robot("two-link")
DRIVE = DriveSet.parse("viscous,coulomb,offset")
FRICTION = (1.0, 0.5, 0.1, 0.7, 0.4, -0.1)


def recorded(
    seed: int,
    delay=0.0,
    rate: float = 250.0,
    *,
    seconds: float = 30.0,
    noise: float = 0.3,
    model=MODEL,
) -> Recording:
    return simulate_recording(
        model,
        random_fourier(model, rng=seed, duration=seconds),
        rate=rate,
        drive=DRIVE,
        drive_values=np.resize(FRICTION, 3 * model.n_joints),
        noise=SensorNoise(torque_noise=noise, torque_delay=delay),
        rng=seed,
    )


def found(*logs: Recording, model=MODEL) -> DelayEstimate:
    chain = resolve_chain(SignalChain(), *logs)
    return find_delays(
        model,
        lambda delays: [
            prepare_samples(log, replace(chain, delay=tuple(own.tolist())))
            for log, own in zip(logs, delays, strict=True)
        ],
        drive=DRIVE,
        count=len(logs),
    )


@pytest.mark.parametrize(
    ("delay", "rate"),
    [
        (-0.004, 250.0),
        *(
            pytest.param(*each, marks=pytest.mark.study)
            for each in ((0.01, 1000.0), (0.005, 100.0))
        ),
    ],
)
def test_delays_are_found_within_two_standard_errors(delay, rate):
    z = []
    for seed in range(5):
        estimate = found(recorded(seed, delay, rate, seconds=20.0))
        assert estimate.joint_estimates is None
        z.append(float((estimate.estimates[0] - delay) / estimate.std_errors[0]))
    assert np.sum(np.abs(z) > 2.0) <= 1
    assert np.sqrt(np.mean(np.square(z))) > 0.2


def test_recordings_have_delays_of_their_own():
    estimate = found(recorded(1, 0.010), recorded(2), recorded(3, -0.003))
    off = estimate.estimates - [0.010, 0.0, -0.003]
    assert np.all(np.abs(off) < 3.0 * estimate.std_errors)
    assert np.all(np.abs(off) < 2.5e-3)
    assert estimate.applied.tolist()[::2] == [True, True]


def test_recordings_of_one_logger_share_a_delay_that_is_known_better():
    logs = [recorded(seed, 0.004, seconds=15.0) for seed in (11, 12, 13, 14)]
    shared = found(*logs)
    alone = found(logs[0])
    assert len(set(shared.estimates)) == 1
    assert abs(shared.estimates[0] - 0.004) < 3.0 * shared.std_errors[0]
    # Four times the data: half the error, but for what friction that lags would add.
    assert shared.std_errors[0] < 0.75 * alone.std_errors[0]


def test_errors_of_parameters_count_a_shared_delay_once():
    """Recordings that share a delay move together: more of them do not average its error away."""
    logs = [recorded(seed, 0.010, seconds=15.0) for seed in (7, 8)]
    chain = replace(resolve_chain(SignalChain(), *logs), delay=0.010)
    samples = [prepare_samples(log, chain) for log in logs]
    added = {}
    for name, errors in (("shared", (1e-3, 1e-3)), ("apart", (1e-3, 1.0000001e-3))):
        stated = [
            replace(batch, delay_errors=(error,))
            for batch, error in zip(samples, errors, strict=True)
        ]
        fit = fit_samples(MODEL, stated, drive=DRIVE, method="wls")
        added[name] = np.sqrt(np.diag(fit.errors().delay.covariance))
    late = [
        fit_samples(
            MODEL,
            [prepare_samples(log, replace(chain, delay=d)) for log in logs],
            drive=DRIVE,
            method="wls",
        ).estimate.beta
        for d in (0.009, 0.011)
    ]
    moved = 0.5 * np.abs(late[1] - late[0])
    big = moved > 0.05 * moved.max()
    np.testing.assert_allclose(added["shared"][big], moved[big], rtol=0.15)
    # Two delays of one error each would add the root of two such shares.
    assert np.median(added["apart"][big] / added["shared"][big]) < 0.95


def test_friction_that_lags_is_no_delay():
    log = recorded(5, seconds=60.0)
    late = recorded(5, 0.030, seconds=60.0)
    bodies = {
        name: simulate_recording(
            MODEL,
            random_fourier(MODEL, rng=5, duration=60.0),
            drive=DRIVE,
            drive_values=np.zeros(6),
            rate=250.0,
            noise=SensorNoise(torque_delay=delay),
        ).tau
        for name, delay in (("now", 0.0), ("late", 0.030))
    }
    lagging = replace(log, tau=bodies["now"] + late.tau - bodies["late"])
    estimate = found(lagging)
    assert estimate.lag > 0.015
    assert not estimate.applied.any()
    assert abs(estimate.estimates[0]) < 0.004


@pytest.mark.parametrize(
    ("error", "certain", "helps", "applied"),
    [
        (0.004, True, None, True),
        (0.004, True, False, True),
        (0.02, False, False, False),
        (0.02, False, True, True),
    ],
)
def test_an_uncertain_delay_is_applied_only_if_it_helps(error, certain, helps, applied):
    estimate = DelayEstimate(
        np.array([0.05]), np.array([error]), 0.0, 0.0, np.array([certain]), helps=helps
    )
    assert estimate.applied.tolist() == [applied]
    assert not replace(estimate, estimates=np.array([1.9 * error])).applied.any()


def test_the_error_on_other_motions_falls_if_and_only_if_torques_are_late():
    """Shifting by the true delay helps; shifting torques that are in time harms."""
    late, now = recorded(3, 0.02), recorded(3)
    chain = resolve_chain(SignalChain(), late)
    base = find_base_parameters(MODEL, DRIVE)

    def pair(log):
        return ([prepare_samples(log, replace(chain, delay=each))] for each in (0.0, 0.02))

    fall, error = measure_delay_relief(MODEL, base, np.ones(2), *pair(late))
    assert fall > HELPFUL * error
    fall, error = measure_delay_relief(MODEL, base, np.ones(2), *pair(now))
    assert fall < -3.0 * error


@pytest.mark.parametrize("held_out", [None, "blocks:4.1s:3"])
@pytest.mark.parametrize(
    ("robot", "log"),
    [
        ("kuka_lwr4.urdf", "kuka_lwr4/measurements_3.npz"),
        ("airbot/airbot_play.urdf", "airbot/vali_ptrnSrch_N7T25QR-5.csv"),
    ],
)
@pytest.mark.study
def test_delays_that_friction_imitates_are_not_applied(shared, robot, log, held_out):
    """Applied, they change the error on other recordings by -18 to +27 %."""
    model = load_robot(str(shared / "models" / robot))
    sheet = shared / "data" / "airbot" / "sheet.toml" if "airbot" in log else None
    options = {} if sheet is None else {"sheet": sheet}
    recording = read_recording(shared / "data" / log, model=model, **options)
    late = settle_delays(
        model, [recording], ["x"], resolve_chain(SignalChain(), recording), held_out
    )
    (delay,) = late.recordings
    assert delay.delays == ()
    assert late.chain.delay is None


def test_errors_of_parameters_count_that_of_the_delay():
    """The scatter of estimates whose delay is off by its error is what is added."""
    log = recorded(7, 0.010)
    chain = resolve_chain(SignalChain(), log)
    error = 2e-4

    def fitted(delay: float):
        samples = prepare_samples(log, replace(chain, delay=delay))
        return fit_samples(
            MODEL, [replace(samples, delay_errors=(error,))], drive=DRIVE, method="wls"
        )

    fit, high, low = fitted(0.010), fitted(0.010 + error), fitted(0.010 - error)
    moved = 0.5 * (high.estimate.beta - low.estimate.beta)
    added = np.sqrt(np.diag(fit.errors().delay.covariance))
    big = np.abs(moved) > 0.05 * np.abs(moved).max()
    ratio = added[big] / np.abs(moved)[big]
    assert np.ptp(ratio) < 0.2 * ratio.mean()
    assert ratio.mean() > 0.97
    np.testing.assert_allclose(
        fit.errors().delay.shift, moved / error * -0.010, rtol=0.2, atol=0.02
    )
    assert (
        estimate_delay_errors(MODEL, fit.base, fit.estimate, [prepare_samples(log, chain)]) is None
    )


@pytest.mark.parametrize("joint", [0, 2])
def test_friction_of_one_joint_that_bends_before_it_slides_is_no_delay_of_that_joint(joint):
    """Dahl's bristles, integrated here: they lag by a way, not by a time."""
    model = load_robot("scara")
    log = recorded(2, seconds=40.0, noise=0.05, model=model)
    q = log.q[:, joint]
    z, way = np.zeros(len(q)), 0.004 * np.ptp(q)
    for i, step in enumerate(np.diff(q)):
        side = np.sign(step)
        z[i + 1] = side + (z[i] - side) * np.exp(-abs(step) / way)
    tau = np.array(log.tau)
    tau[:, joint] += 4.0 * z
    estimate = found(replace(log, tau=tau), model=model)
    assert estimate.joint_estimates is None
    assert abs(estimate.estimates[0]) < 2.0 * estimate.std_errors[0]
