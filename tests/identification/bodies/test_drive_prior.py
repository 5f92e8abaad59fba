"""Drive parameters without evidence stay at a scale of their own; others keep their values."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from asbuilt.arrays import Array
from asbuilt.description import load_robot
from asbuilt.dynamics import DriveSet, find_base_parameters, inverse_dynamics
from asbuilt.excitation import random_fourier
from asbuilt.experiment import Samples
from asbuilt.identification import (
    build_cad_prior,
    estimate_block_uncertainty,
    identify_samples,
    with_drive_scale,
)
from asbuilt.identification.estimators.consistent_fit import fit_consistent, fit_toward_cad
from asbuilt.identification.information.square_root_information import accumulate
from asbuilt.validation import validate_samples
from studied_cases import first_of

DRIVE = DriveSet.parse("viscous,coulomb,offset")
MODEL = load_robot("kuka-iiwa7-r800")
FRICTION = np.array([1.5, 1.5, 1.0, 1.0, 0.6, 0.4, 0.3])
STILL = 5


def samples(seed: int, *, still: bool = False) -> Samples:
    """An arm with friction and noise; joint 6 may move by a few milliradians only."""
    rng = np.random.default_rng(seed)
    motion = random_fourier(MODEL, rng=seed, duration=20.0).sample(20.0)
    t, q, qd, qdd = (np.array(each) for each in (motion.t, motion.q, motion.qd, motion.qdd))
    if still:
        middle = q[:, STILL].mean()
        share = 0.004 / np.max(np.abs(q[:, STILL] - middle))
        q[:, STILL] = middle + share * (q[:, STILL] - middle)
        qd[:, STILL] *= share
        qdd[:, STILL] *= share
    tau = inverse_dynamics(MODEL, q, qd, qdd) + FRICTION * (qd + np.sign(qd))
    tau += 0.1 * rng.normal(size=tau.shape)
    return Samples(t, q, qd, qdd, tau, rate=20.0, joint_names=MODEL.joint_names)


def friction_of(result, joint: int) -> dict[str, float]:
    names = (f"Fv{joint + 1}", f"Fc{joint + 1}")
    return {each.name: each.estimate for each in result.parameters if each.name in names}


def test_the_scale_is_torque_over_the_usual_column() -> None:
    base, own = find_base_parameters(MODEL, DRIVE), samples(1)
    prior = with_drive_scale(build_cad_prior(MODEL, DRIVE), accumulate(MODEL, base, own))
    torque = np.sqrt(np.mean(own.tau**2, axis=0))
    speed = np.sqrt(np.mean(own.qd**2))
    scale = prior.drive_scale.reshape(7, 3)
    np.testing.assert_allclose(scale[:, 0], torque / speed, rtol=1e-9)
    np.testing.assert_allclose(scale[:, 2], torque, rtol=1e-9)


@pytest.mark.parametrize("fit", [fit_consistent, lambda a, b: fit_toward_cad(a, b, weight=50.0)])
def test_what_the_data_determine_stays(fit) -> None:
    base, own = find_base_parameters(MODEL, DRIVE), samples(2)
    information, plain = accumulate(MODEL, base, own), build_cad_prior(MODEL, DRIVE)
    before, after = fit(information, plain), fit(information, with_drive_scale(plain, information))
    errors = estimate_block_uncertainty(information, before).std_errors
    moved: Array = np.abs(after.beta - before.beta) / errors
    assert moved.max() < 0.1


@pytest.mark.parametrize("method", first_of(2, ["auto", "consistent", "entropic", "ridge"]))
def test_friction_of_a_joint_that_hardly_moves_predicts_no_torque(method: str) -> None:
    """The error of that joint on other motion is its friction, which nothing determines."""
    result = identify_samples(MODEL, samples(3, still=True), drive=DRIVE, method=method)
    other = samples(4)
    rms = validate_samples(result, other).metrics_as_built.rms
    unknown = np.sqrt(np.mean((FRICTION[STILL] * (other.qd + np.sign(other.qd))[:, STILL]) ** 2))
    assert rms[STILL] < 1.5 * unknown
    whole = identify_samples(MODEL, samples(3), drive=DRIVE, method=method)
    assert friction_of(whole, STILL)["Fv6"] == pytest.approx(FRICTION[STILL], rel=0.1)


def test_a_joint_without_torque_has_no_friction() -> None:
    own = samples(5)
    dead = replace(own, slowest=tuple(np.where(np.arange(7) == STILL, np.inf, 0.0).tolist()))
    result = identify_samples(MODEL, dead, drive=DRIVE, method="consistent")
    scale = np.sqrt(np.max(np.mean(own.tau**2, axis=0)))
    assert all(abs(value) < 0.1 * scale for value in friction_of(result, STILL).values())
