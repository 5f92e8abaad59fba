"""Gains from a known payload.

Simulated drives whose gains are known, and the recorded pair of a UR10e.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from asbuilt.description import LinkInertia, bundled_robot, load_robot
from asbuilt.description.inertia import shift_matrix
from asbuilt.dynamics import DriveSet
from asbuilt.errors import IdentifiabilityError, UsageError
from asbuilt.excitation import random_fourier
from asbuilt.experiment import SignalChain, prepare_samples, read_recordings, simulate_recording
from asbuilt.identification import choose_payload_frame, identify_gains

ROBOT = bundled_robot("kuka-iiwa7-r800")
GAINS = np.array([12.0, 9.0, 14.0, 8.0, 11.0, 7.0, 5.0])
PAYLOAD = LinkInertia.from_com(3.0, [0.03, -0.02, 0.09], np.diag([0.012, 0.015, 0.009]))
DRIVE = DriveSet.parse("viscous,coulomb,offset")


@pytest.fixture(scope="module")
def pair():
    rng = np.random.default_rng(3)
    values = np.column_stack(
        [rng.uniform(0.3, 1.0, 7), rng.uniform(0.5, 2.0, 7), rng.normal(size=7) * 0.2]
    ).ravel()
    _, link, placement = choose_payload_frame(ROBOT)
    chi = ROBOT.parameters.copy()
    chi[10 * link : 10 * link + 10] += shift_matrix(placement) @ PAYLOAD.parameters
    samples = []
    for robot, seed in ((ROBOT, 4), (ROBOT.with_parameters(chi), 5)):
        recording = simulate_recording(
            robot,
            random_fourier(ROBOT, seed, duration=25.0),
            rate=200.0,
            drive=DRIVE,
            drive_values=values,
        )
        noise = 0.05 * np.random.default_rng(seed).normal(size=recording.tau.shape)
        current = recording.tau / GAINS + noise
        samples.append(
            prepare_samples(
                replace(recording, tau=current, torque_source="current"),
                SignalChain(cutoff=8.0, parallel_cutoff=8.0),
            )
        )
    return samples


def test_the_mass_alone_gives_every_gain(pair):
    found = identify_gains(ROBOT, *pair, mass=3.0, drive=DRIVE)
    assert np.all(found.determined)
    np.testing.assert_allclose(found.gains, GAINS, rtol=0.03)
    assert np.all(np.abs(found.gains - GAINS) < 5.0 * found.std_errors)
    np.testing.assert_allclose(found.payload[6:9] / 3.0, [0.03, -0.02, 0.09], atol=0.01)
    assert "given for the payload: mass" in found.sentences()[0]


def test_more_knowledge_makes_the_gains_surer(pair):
    mass = identify_gains(ROBOT, *pair, mass=3.0, drive=DRIVE)
    whole = identify_gains(
        ROBOT,
        *pair,
        mass=3.0,
        com=[0.03, -0.02, 0.09],
        inertia_about_com=np.diag([0.012, 0.015, 0.009]),
        drive=DRIVE,
    )
    np.testing.assert_allclose(whole.gains, GAINS, rtol=0.02)
    assert np.mean(np.log(whole.std_errors / mass.std_errors)) < 0.0


def test_the_scale_is_that_of_the_mass(pair):
    one, two = (identify_gains(ROBOT, *pair, mass=mass, drive=DRIVE).gains for mass in (3.0, 6.0))
    np.testing.assert_allclose(two, 2.0 * one, rtol=1e-5)


def test_a_torque_of_the_wrong_sign_has_a_negative_gain(pair):
    signs = np.array([1, -1, 1, 1, -1, 1, 1])
    turned = [replace(samples, tau=samples.tau * signs) for samples in pair]
    straight, found = (
        identify_gains(ROBOT, *samples, mass=3.0, drive=DRIVE) for samples in (pair, turned)
    )
    np.testing.assert_allclose(found.gains, signs * straight.gains, rtol=1e-5)
    assert np.all(found.determined)
    assert "opposite sign at" in " ".join(found.sentences())


def test_gains_stand_in_place_of_those_in_use(pair):
    used = np.linspace(5.0, 20.0, 7)
    logged = identify_gains(ROBOT, *pair, mass=3.0, drive=DRIVE)
    scaled = identify_gains(
        ROBOT,
        *(replace(samples, tau=samples.tau * used) for samples in pair),
        mass=3.0,
        drive=DRIVE,
        in_use=used,
    )
    np.testing.assert_allclose(scaled.gains, logged.gains, rtol=1e-5)
    np.testing.assert_allclose(scaled.std_errors, logged.std_errors, rtol=1e-2)
    np.testing.assert_allclose(scaled.factors * used, scaled.gains)


def test_wrong_calls_are_refused(pair):
    with pytest.raises(UsageError, match="positive"):
        identify_gains(ROBOT, *pair, mass=0.0)
    with pytest.raises(
        UsageError, match="without and with the payload, got 1 and 0; pass at least one of each"
    ):
        identify_gains(ROBOT, pair[0], [], mass=3.0, drive=DRIVE)
    with pytest.raises(UsageError, match="without and with the payload, got 0 and 1"):
        identify_gains(ROBOT, [], pair[1], mass=3.0, drive=DRIVE)
    with pytest.raises(UsageError, match="com"):
        identify_gains(ROBOT, *pair, mass=1.0, inertia_about_com=np.eye(3))
    for wrong in ([1.0, 2.0], 0.0, np.append(np.ones(6), np.nan)):
        with pytest.raises(UsageError, match="one number or 7, one per joint, none of them 0"):
            identify_gains(ROBOT, *pair, mass=3.0, drive=DRIVE, in_use=wrong)
    short = pair[1].between(1.0, 1.1)
    assert short.n_filtered == 0
    with pytest.raises(IdentifiabilityError, match="with the payload are left"):
        identify_gains(ROBOT, pair[0], short, mass=3.0, drive=DRIVE)


def test_the_recorded_pair_of_a_ur10e(shared, tmp_path):
    sheet = tmp_path / "sheet.toml"
    sheet.write_text(
        'header = false\ntorque_source = "current"\n[columns]\ntime = 1\nposition = "2-7"\nvelocity'
        ' = "8-13"\ntorque = "14-19"\n'
    )
    robot = load_robot(str(shared / "models" / "ur10e.urdf"))
    logs = [
        shared / "data" / "ur10e" / f"ur-20_02_19_14harm50sec{load}.csv" for load in ("", "Load")
    ]
    recordings = [read_recordings([log], model=robot, sheet=sheet)[0] for log in logs]
    chain = SignalChain(cutoff=5.0)
    found = identify_gains(
        robot, *(prepare_samples(recording, chain) for recording in recordings), mass=2.805
    )
    in_use = np.array([14.87, 13.26, 11.13, 10.62, 11.03, 11.47])
    assert np.all(found.gains[1:] > 0.87 * in_use[1:])
    assert np.all(found.gains[1:] < 1.03 * in_use[1:])
    assert found.payload_share[0] < found.payload_share[1:].min()
