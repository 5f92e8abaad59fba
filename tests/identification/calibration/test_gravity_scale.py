"""Scale of gravity torques: that of the torques logged, where CAD is right."""

import dataclasses

import numpy as np
import pytest

from asbuilt import LinkInertia, StudyOptions, identify, load_robot, simulate_recording
from asbuilt.description.inertia import shift_matrix
from asbuilt.dynamics import inverse_dynamics
from asbuilt.excitation import random_fourier
from asbuilt.experiment import read_recording
from asbuilt.identification import choose_payload_frame, identify_payload_samples
from asbuilt.identification.calibration.payload_rows import (
    UNCALIBRATED,
    USUAL_UNCERTAINTY,
    derive_gain_doubt,
    derive_gain_errors,
    gravity_scales,
    name_doubtful_gains,
)
from asbuilt.workflow import prepare


@pytest.fixture(scope="module")
def arm():
    return load_robot("ur10e")


def result_of(arm, scale):
    log = simulate_recording(arm, random_fourier(arm, rng=3, duration=8.0), rate=200.0, rng=3)
    log = dataclasses.replace(log, tau=scale * log.tau, torque_source="motor")
    options = StudyOptions(method="wls", checked=False)
    return identify(arm, log, options=options).result


@pytest.fixture(scope="module")
def right(arm):
    return result_of(arm, 1.0)


@pytest.fixture(scope="module")
def half(arm):
    return result_of(arm, 0.5)


@pytest.mark.study
def test_the_scale_of_gravity_torques_is_that_of_the_log(right, half):
    """The first axis is vertical and the last has its mass on its axis: they have no scale."""
    for result, scale in ((right, 1.0), (half, 0.5)):
        found = gravity_scales(result)
        assert np.isnan(found[0])
        np.testing.assert_allclose(found[1:3], scale, rtol=1e-3)


def test_agreement_with_cad_keeps_the_usual_gain_error(right):
    np.testing.assert_allclose(derive_gain_errors(right, "motor"), USUAL_UNCERTAINTY["motor"])
    assert name_doubtful_gains(right, "motor") == ()
    assert derive_gain_errors(right, "unknown").max() == 0.0


def test_half_of_the_gravity_torque_widens_gains(half):
    errors = derive_gain_errors(half, "motor")
    # If CAD is right the true torque is twice the logged one: 100 % less CAD's tolerance.
    assert errors[1] == pytest.approx(np.hypot(UNCALIBRATED, 0.8), rel=1e-2)
    assert errors[0] == UNCALIBRATED
    assert name_doubtful_gains(half, "motor")[:1] == (half.model.joint_names[1],)
    assert derive_gain_errors(half, "sensor").max() == 0.0
    # What measured the torques is not stated, and gravity contradicts that they are right.
    np.testing.assert_allclose(
        derive_gain_errors(half, "unknown")[1], np.hypot(UNCALIBRATED, 0.8), rtol=1e-2
    )
    np.testing.assert_allclose(derive_gain_errors(half, "motor", 0.03), 0.03)


def test_without_cad_masses_nothing_is_known(arm, right):
    unknown = dataclasses.replace(
        arm, links=tuple(dataclasses.replace(link, inertia_known=False) for link in arm.links)
    )
    result = dataclasses.replace(right, model=unknown)
    assert np.all(np.isnan(gravity_scales(result)))
    np.testing.assert_allclose(derive_gain_errors(result, "motor"), UNCALIBRATED)


def test_doubt_begins_beyond_the_tolerance_of_cad():
    found = derive_gain_doubt(np.array([np.nan, 1.0, 1.2, 0.5, 1.5]))
    np.testing.assert_allclose(found, [0.0, 0.0, 0.0, 0.8, 1 / 3 - 0.2], atol=1e-12)


@pytest.mark.study
def test_a_payload_of_unchecked_gains_is_within_its_interval(shared):
    """Logs of an arm whose gains are off by 2 to 3, with the torque that .48 kg adds to them."""
    model = load_robot(shared / "models/airbot/airbot_play.urdf")
    folder = shared / "data/airbot"
    if not folder.is_dir():
        pytest.skip("the shared recordings are absent")
    names = ("vali_ga_N12T25.csv", "vali_opt.csv")
    bare, log = (
        read_recording(folder / name, model=model, sheet=folder / "sheet.toml") for name in names
    )
    result = identify(model, bare, checked=False).result
    samples = prepare(model, [log], chain=result.chain, holdout=None, checked=False).training[0]
    scales = np.nan_to_num(gravity_scales(result), nan=1.0)
    _, link, placement = choose_payload_frame(model)
    body = LinkInertia.from_com(0.48, np.array([0.02, 0.0, 0.05]), 5e-4 * np.eye(3))
    bodies = model.parameters.reshape(-1, 10).copy()
    bodies[link] += shift_matrix(placement) @ body.parameters
    state = samples.q, samples.qd, samples.qdd
    loaded = model.with_parameters(bodies.ravel())
    added = inverse_dynamics(loaded, *state) - inverse_dynamics(model, *state)
    tau = samples.tau + scales * added
    payload = identify_payload_samples(result, dataclasses.replace(samples, tau=tau))
    assert abs(payload.values[0] - 0.48) < 1.96 * payload.std_errors[0]
    assert "mass" not in payload.determined
    assert "joint2" in payload.gains_in_doubt
