"""Stribeck friction of a virtual servo arm that MuJoCo moves, sought in simulated windows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.identification.trajectories.arms import SERVO, recorded_by_mujoco, servo_arm

from asbuilt.arrays import Array
from asbuilt.dynamics import DriveSet, available_terms, parameter_values
from asbuilt.experiment import SignalChain, prepare_samples
from asbuilt.experiment.command.torque import drive_by_command
from asbuilt.identification.identify import fit_samples
from asbuilt.identification.trajectories.refined_fit import (
    RefinedFit,
    build_simulated_prior,
    predict_fall,
    refine_fit,
    widen_parameters,
)
from asbuilt.identification.trajectories.windows import cut_windows

pytest.importorskip("mujoco")
PLAIN = DriveSet.parse("armature,viscous,coulomb")
TERM = available_terms()["stribeck"].with_nonlinear({"velocity": 0.1})
SLOW = replace(SERVO, kp=(12.0, 8.0), kd=(0.0, 0.0))


def refined(stribeck: float, drive: DriveSet, begin: Array | None = None) -> RefinedFit:
    """Return the refined fit of an arm whose soft servos move it slowly now and then."""
    recording = recorded_by_mujoco(servo_arm(), SLOW, duration=24.0, noise=1e-3, stribeck=stribeck)
    recording = drive_by_command(replace(recording, qd=None), SLOW)
    chain = SignalChain(cutoff=8.0)
    samples = prepare_samples(recording, chain)
    fit = fit_samples(servo_arm(), [samples], drive=drive, method="entropic")
    whole = prepare_samples(recording, replace(chain, rests=True, parallel=False))
    return refine_fit(fit, [cut_windows(recording, whole, 0.5)], SLOW, begin=begin)


def test_columns_of_a_wider_set_begin_at_zero() -> None:
    found = widen_parameters(np.arange(26.0), PLAIN, PLAIN.with_term(TERM), 2)
    assert found[:20].tolist() == list(range(20))
    assert found[20:].tolist() == [20.0, 21.0, 22.0, 0.0, 23.0, 24.0, 25.0, 0.0]


def test_friction_near_rest_is_bounded_where_it_is_simulated() -> None:
    drive = PLAIN.with_term(TERM)
    assert build_simulated_prior(servo_arm(), drive).non_negative.tolist() == list(range(20, 28))


@pytest.mark.study
@pytest.mark.parametrize("stribeck", [0.0, 0.2])
def test_trajectories_promise_stribeck_friction_where_it_is(stribeck: float) -> None:
    found = refined(stribeck, PLAIN)
    promised = predict_fall(found.objective, found.refinement, TERM)
    assert (promised > 4.0) == (stribeck > 0.0)
    if stribeck:
        drive = PLAIN.with_term(TERM)
        begin = widen_parameters(found.refinement.point.chi, PLAIN, drive, 2)
        wider = refined(stribeck, drive, begin)
        truth = parameter_values(servo_arm(), PLAIN)[20:].reshape(2, 3)
        expected = np.column_stack([truth, np.full(2, stribeck)])[:, 1:]
        off = np.abs(wider.robot.values[:, 1:] - expected)
        assert np.all(off < 3.0 * wider.value_errors[:, 1:] + 0.1 * expected)
        assert wider.value_errors[1, 3] < 0.1 * stribeck, "the light joint is slow often enough"
