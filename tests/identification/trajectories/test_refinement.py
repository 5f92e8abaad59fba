"""Refinement by trajectories: the truth of a virtual servo arm, from several starts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.identification.trajectories.arms import SERVO, recorded_by_mujoco, servo_arm

from asbuilt.arrays import Array
from asbuilt.dynamics import DriveSet, parameter_values
from asbuilt.experiment import SignalChain, prepare_samples
from asbuilt.experiment.command.torque import drive_by_command
from asbuilt.identification.identify import Fit, fit_samples
from asbuilt.identification.trajectories.objective import Quadratic, Weights
from asbuilt.identification.trajectories.refined_fit import RefinedFit, refine_fit
from asbuilt.identification.trajectories.refinement import score_inflation
from asbuilt.identification.trajectories.simulated_robot import ServoCoordinates
from asbuilt.identification.trajectories.windows import Windows, cut_windows

pytest.importorskip("mujoco")
DRIVE = DriveSet.parse("armature,viscous,coulomb")


@pytest.fixture(scope="module")
def study() -> tuple[Fit, Windows]:
    """The arm's links are 20 % heavier than CAD, its delay is unknown."""
    truth = servo_arm()
    recording = recorded_by_mujoco(truth, SERVO, duration=16.0, noise=2e-4, step=1e-4)
    recording = drive_by_command(replace(recording, qd=None), replace(SERVO, delay=0.0))
    cad = truth.with_parameters(truth.parameters / 1.2)
    chain = SignalChain(cutoff=8.0)
    fit = fit_samples(cad, [prepare_samples(recording, chain)], drive=DRIVE, method="entropic")
    whole = prepare_samples(recording, replace(chain, rests=True, parallel=False))
    return fit, cut_windows(recording, whole, 0.5)


@pytest.fixture(scope="module")
def refined(study: tuple[Fit, Windows]) -> RefinedFit:
    fit, windows = study
    return refine_fit(fit, [windows], replace(SERVO, delay=0.0))


@pytest.mark.study
def test_refinement_recovers_the_truth_within_its_intervals(
    study: tuple[Fit, Windows], refined: RefinedFit
) -> None:
    base = refined.fit.base
    truth = base.regrouping @ np.nan_to_num(parameter_values(servo_arm(), DRIVE))
    estimate, error = refined.fit.estimate.beta, refined.fit.uncertainty.std_errors
    drives = [k for k, name in enumerate(base.names) if name[:2] in ("Fv", "Fc", "Ia")]
    assert len(drives) == 4, "armatures are regrouped with the links of a planar arm"
    assert np.all(np.abs(estimate - truth)[drives] < 4.0 * error[drives] + 0.02 * truth[drives])
    assert np.all(error[drives] < 0.2 * truth[drives] + 0.01)
    assert refined.law.servo is not None
    assert refined.law.servo.delay == pytest.approx(0.006, abs=5e-4)
    linear = study[0].estimate.beta
    assert np.linalg.norm((estimate - truth)[drives]) < 0.5 * np.linalg.norm(
        (linear - truth)[drives]
    )


@pytest.mark.parametrize("factor", [0.3, 4.0])
@pytest.mark.study
def test_other_starts_reach_the_same_optimum(
    study: tuple[Fit, Windows], refined: RefinedFit, factor: float
) -> None:
    fit, windows = study
    begin = fit.estimate.standard.copy()
    begin[20:] *= factor
    begin[:20] /= np.sqrt(factor)
    other = refine_fit(fit, [windows], replace(SERVO, delay=0.0), begin=begin)
    error = refined.fit.uncertainty.std_errors
    assert np.all(np.abs(other.fit.estimate.beta - refined.fit.estimate.beta) < 0.1 * error + 1e-9)


@pytest.mark.study
def test_a_link_stays_physically_consistent(refined: RefinedFit) -> None:
    assert all(link.inertia.is_consistent for link in refined.robot.model.links)


@pytest.mark.study
def test_the_result_says_that_it_was_refined(refined: RefinedFit) -> None:
    assert any("Refined by trajectories" in line for line in refined.fit.provenance)


@pytest.mark.study
def test_an_unknown_stiffness_keeps_to_its_error_by_torques(study: tuple[Fit, Windows]) -> None:
    fit, windows = study
    high = replace(SERVO, kp=tuple(1.2 * kp for kp in SERVO.kp), delay=0.0)
    moved = {
        spread: refine_fit(
            fit,
            [windows],
            high,
            free=ServoCoordinates(stiffness=True, delay=True, spread=spread),
        ).law.servo
        for spread in (1.0, 1e-3)
    }
    free, held = moved[1.0], moved[1e-3]
    assert free is not None
    assert held is not None
    assert free.kp[0] < 0.97 * high.kp[0]
    assert held.kp[0] == pytest.approx(high.kp[0], rel=5e-3)


@pytest.mark.parametrize(("lead", "late", "skew"), [(0.015, 0.004, 0.0), (0.0, 0.004, 0.02)])
@pytest.mark.study
def test_a_lead_is_told_from_times_that_are_skewed(lead: float, late: float, skew: float) -> None:
    """Smooth motion shows `delay - lead`; under steps a lead and late positions differ."""
    truth = servo_arm()
    servo = replace(SERVO, delay=late, lead=(lead, lead))
    recording = recorded_by_mujoco(truth, servo, duration=24.0, noise=2e-4, steps=0.1)
    moved = np.stack([np.interp(recording.t + skew, recording.t, x) for x in recording.q.T], axis=1)
    begun = replace(SERVO, delay=late - lead - skew)
    recording = drive_by_command(replace(recording, q=moved, qd=None), begun)
    chain = SignalChain(cutoff=8.0)
    fit = fit_samples(truth, [prepare_samples(recording, chain)], drive=DRIVE, method="entropic")
    whole = prepare_samples(recording, replace(chain, rests=True, parallel=False))
    found = refine_fit(
        fit,
        [cut_windows(recording, whole, 0.5)],
        begun,
        free=ServoCoordinates(delay=True, lead=True),
    )
    assert found.law.servo is not None
    assert found.law.servo.delay == pytest.approx(late - skew, abs=1.5e-3)
    np.testing.assert_allclose(found.law.servo.leads, lead, atol=2e-3)
    assert np.isfinite(found.law.lead_error) == (lead > 0.0)


def test_windows_of_a_recording_share_what_the_model_gets_wrong() -> None:
    """Scores that are the same in every window of a recording count as one."""
    rng = np.random.default_rng(1)
    sizes, per, p = [30] * 200, 30, 3
    own = rng.standard_normal((200 * per, p))
    shared = np.repeat(rng.standard_normal((200, p)), per, axis=0)
    data = np.diag(np.full(p, 200.0 * per))
    weights = Weights(np.ones(1), tuple(np.ones(each) for each in sizes))
    one_log = Weights(np.ones(1), (np.ones(200 * per),))

    def quadratic(scores: Array) -> Quadratic:
        return Quadratic(0.0, np.zeros(p), data, scores, data, (), 0.0)

    # independent windows vary by their information, and so do the sums of recordings
    assert score_inflation(quadratic(own), one_log) == pytest.approx(1.0, rel=0.05)
    assert score_inflation(quadratic(own), weights) == pytest.approx(1.0, rel=0.25)
    # the sum of m equal scores has m times the variance of m independent ones
    assert score_inflation(quadratic(shared), one_log) == pytest.approx(1.0, rel=0.25)
    assert score_inflation(quadratic(shared), weights) == pytest.approx(per, rel=0.25)
