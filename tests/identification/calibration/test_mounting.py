"""How a robot stands: tilts put into simulations are found, none is found where none is, and a real
arm's is.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from asbuilt.description.load import load_robot
from asbuilt.dynamics.base.base_parameters import find_base_parameters
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.dynamics.regressor import observation_matrix
from asbuilt.errors import IdentifiabilityError, UsageError
from asbuilt.experiment.logs.readers import read_recordings
from asbuilt.experiment.signal.hold_out import hold_out
from asbuilt.experiment.signal.preparation import prepare_samples, resolve_chain
from asbuilt.experiment.signal.signal_chain import SignalChain
from asbuilt.identification.calibration.gravity_rows import GravityRows
from asbuilt.identification.calibration.mounting import _block_costs, _blocks, find_mounting
from asbuilt.identification.information.square_root_information import accumulate
from asbuilt.workflow.study import StudyOptions, identify

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


@pytest.mark.parametrize("robot", ["kuka-iiwa7-r800", "ur10e", "puma-560"])
def test_tilt_of_a_simulated_robot_is_found_within_its_error(trial, robot):
    case = trial(robot, "viscous,coulomb,offset", seed=12, duration=16.0, rate=20.0)
    samples, gravity = standing(case, [0.03, -0.02, 0.0])
    found = find_mounting(case.model, samples, drive=DRIVE)
    assert found.is_tilted
    # Gravity that is turned one way in the root frame is a base turned the other way.
    np.testing.assert_array_less(np.abs(found.tilt - [-0.03, 0.02]), 4.0 * found.std_errors + 1e-4)
    np.testing.assert_allclose(
        found.model.gravity, gravity, atol=9.81 * (4.0 * found.std_errors.max() + 1e-4)
    )
    assert np.linalg.norm(found.gravity) == pytest.approx(9.81)
    assert np.sqrt(np.mean(found.rms**2)) < np.sqrt(np.mean(found.rms_as_given**2))
    assert found.sentence.startswith("base tilt of")


@pytest.mark.parametrize("robot", ["scara", "ur10e"])
def test_one_pass_has_the_factors_and_costs_of_every_gravity(trial, robot):
    """Against a pass with the robot turned, and against the torques that it predicts."""
    case = trial(robot, "viscous,coulomb,offset", seed=5, duration=8.0, rate=20.0, noise=0.02)
    weights = 1.0 / (1.0 + np.arange(case.model.n_joints))
    gravity = Rotation.from_rotvec([0.1, -0.2, 0.0]).apply(np.array(case.model.gravity))
    turned = case.model.with_gravity(gravity)
    base = find_base_parameters(turned, DRIVE)
    rows = GravityRows.of(case.model, base, [case.samples])
    seen = accumulate(turned, base, case.samples)
    expected = seen.stacked(weights)
    np.testing.assert_allclose(
        rows.stacked(gravity, weights), expected, atol=1e-9 * np.abs(expected).max()
    )
    beta = base.regrouping @ case.chi
    cost = 0.5 * weights**2 @ seen.residual_energy(beta)
    assert rows.cost(gravity, weights, beta) == pytest.approx(cost, rel=1e-9)
    for most in (256, 2):
        blocks = _blocks(case.model, [case.samples], None, most)
        assert len(blocks) <= max(most, seen.n_blocks)
        costs = _block_costs(turned, DRIVE, case.chi, weights, blocks)
        assert costs.sum() == pytest.approx(cost, rel=1e-9)


def test_a_level_robot_stays_level(trial):
    case = trial("kuka-iiwa7-r800", "viscous,coulomb,offset", seed=13, duration=16.0, rate=20.0)
    samples, _ = standing(case, [0.0, 0.0, 0.0])
    found = find_mounting(case.model, samples, drive=DRIVE)
    assert not found.is_tilted
    assert found.model is case.model
    assert "no significant base tilt" in found.sentence


def test_a_robot_on_a_wall_is_not_taken_for_a_tilted_one(trial):
    case = trial("ur10e", "viscous,coulomb,offset", seed=14, duration=12.0, rate=20.0)
    samples, _ = standing(case, [1.2, 0.0, 0.0])
    with pytest.raises(IdentifiabilityError, match="correct gravity in the description"):
        find_mounting(case.model, samples, drive=DRIVE)


def test_gravity_and_samples_are_needed(trial):
    case = trial("two-link", "none", seed=1, duration=2.0)
    with pytest.raises(UsageError, match="description with gravity"):
        find_mounting(case.model.with_gravity([0.0, 0.0, 0.0]), case.samples)
    with pytest.raises(UsageError, match="0 batches"):
        find_mounting(case.model, [])


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
        options=StudyOptions(drive=DRIVE, method="entropic", mounting="estimate"),
    )
    rms = study.validations[0].metrics_as_built.rms
    assert np.all(rms < [0.15, 0.10, 0.15, 0.25, 0.13, 0.12, 0.08])
    tilt = np.rad2deg(np.arccos(-study.result.model.gravity[2] / 9.81))
    assert tilt == pytest.approx(1.65, abs=0.2)
    assert any("base tilt of" in note for note in study.result.notes)
