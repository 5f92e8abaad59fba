"""How a robot stands: tilts put into simulations are found, none is found where none is, and a real
arm's is.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from asbuilt.description import load_robot
from asbuilt.dynamics import DriveSet, observation_matrix
from asbuilt.errors import IdentifiabilityError, UsageError
from asbuilt.experiment import (
    SignalChain,
    hold_out,
    prepare_samples,
    read_recordings,
    resolve_chain,
)
from asbuilt.identification import find_effects
from asbuilt.workflow import StudyOptions, identify

DRIVE = DriveSet.parse("viscous,coulomb,offset")


def standing(case, tilt, noise=0.02, seed=0):
    """The samples of a trial, its root turned by a rotation vector."""
    rng = np.random.default_rng(seed)
    samples = case.samples
    gravity = Rotation.from_rotvec(tilt).apply(np.array(case.model.gravity))
    W = observation_matrix(
        case.model.with_gravity(gravity), samples.q, samples.qd, samples.qdd, drive=case.base.drive
    )
    tau = (W @ case.chi).reshape(samples.q.shape)
    tau = tau + noise * np.sqrt(np.mean(tau**2, axis=0)) * rng.normal(size=tau.shape)
    return replace(samples, tau=tau, tau_raw=np.zeros(0)), gravity


def found_in(case, samples):
    return find_effects(case.model, DRIVE, samples, stated={"tilt"}, keys={"tilt"})


@pytest.mark.parametrize(
    "robot",
    [
        "ur10e",
        pytest.param("kuka-iiwa7-r800", marks=pytest.mark.study),
        pytest.param("puma-560", marks=pytest.mark.study),
    ],
)
def test_tilt_of_a_simulated_robot_is_found_within_its_error(trial, robot):
    case = trial(robot, "viscous,coulomb,offset", seed=12, duration=24.0, rate=50.0)
    samples, gravity = standing(case, [0.03, -0.02, 0.0])
    effects = found_in(case, [samples])
    (tilt,) = effects.found
    assert tilt.in_model
    assert tilt.error_after < tilt.error_before
    truth = np.rad2deg(np.hypot(0.03, 0.02))
    assert abs(tilt.estimate - truth) < 4.0 * tilt.std_error + 0.006
    np.testing.assert_allclose(
        effects.model.gravity, gravity, atol=9.81 * (4.0 * np.deg2rad(tilt.std_error) + 1e-4)
    )
    # Gravity that is turned one way in the root frame is a base turned the other way.
    assert "(-1.7" in tilt.text
    assert "+1.1" in tilt.text


def test_a_level_robot_stays_level(trial):
    case = trial("kuka-iiwa7-r800", "viscous,coulomb,offset", seed=13, duration=16.0, rate=20.0)
    samples, _ = standing(case, [0.0, 0.0, 0.0])
    effects = found_in(case, [samples])
    assert not effects.found
    assert effects.model is case.model


def test_a_robot_on_a_wall_is_not_taken_for_a_tilted_one(trial):
    case = trial("ur10e", "viscous,coulomb,offset", seed=14, duration=12.0, rate=20.0)
    samples, _ = standing(case, [1.2, 0.0, 0.0])
    with pytest.raises(IdentifiabilityError, match="more than 20 deg") as raised:
        found_in(case, [samples])
    assert "correct gravity in the description" in str(raised.value)


def test_a_tilt_is_not_stated_without_gravity_or_on_a_free_base(trial):
    case = trial("two-link", "none", seed=1, duration=12.0)
    case = replace(case, model=case.model.with_gravity([0.0, 0.0, 0.0]))
    with pytest.raises(UsageError, match="can have no base tilt: its gravity is"):
        found_in(case, [case.samples])


@pytest.mark.study
def test_a_real_arm_stood_askew_and_knowing_it_halves_its_errors(shared):
    """Med 7: turned by 1.7 deg. Plain least squares.

    0.55 0.41 0.36 0.40 0.13 0.09 0.09 N m held out.
    """
    model = load_robot(shared / "models" / "lbrstack_med7.urdf")
    log = shared / "data" / "lbr_med7" / "measurements_with_ext_tau_1_dgr.csv"
    recordings = read_recordings([log], model=model, rate=100.0, flip_torque=True)
    samples = prepare_samples(recordings[0], resolve_chain(SignalChain(), *recordings))
    train, held = hold_out(samples, "blocks:5s:3")
    study = identify(
        model,
        [train],
        validation=[held],
        options=StudyOptions(drive=DRIVE, mounting="estimate"),
    )
    rms = study.validations[0].metrics_as_built.rms
    assert np.all(rms < [0.15, 0.10, 0.15, 0.25, 0.13, 0.12, 0.08])
    tilt = np.rad2deg(np.arccos(-study.result.model.gravity[2] / 9.81))
    assert tilt == pytest.approx(1.65, abs=0.2)
    assert any(each.effect == "tilt" for each in study.result.effects)
