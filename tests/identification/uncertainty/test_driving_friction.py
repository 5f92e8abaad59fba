"""Friction that takes other shares of the load in both directions: the errors hold it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from asbuilt.description import bundled_robot
from asbuilt.dynamics import DriveSet, inverse_dynamics
from asbuilt.excitation import random_fourier
from asbuilt.experiment import VirtualRobot, prepare_samples
from asbuilt.identification.identify import fit_samples
from asbuilt.identification.uncertainty.bias import doubt_driving_friction

DRIVE = DriveSet.parse("viscous,coulomb,offset,load_friction")
MODEL = bundled_robot("ur10e")


def fitted(driving, driven):
    """Return base parameters of a fit, the truth, and the doubt."""
    motion = random_fourier(MODEL, rng=2, duration=20.0)
    machine = VirtualRobot.ideal(MODEL).with_drive(
        DriveSet.parse("viscous,coulomb,offset"), np.tile([1.0, 2.0, 0.3], 6)
    )
    log = machine.record(motion, rate=100.0).recording
    state = motion.sample(100.0)
    load = inverse_dynamics(MODEL, state.q, state.qd, state.qdd)[: log.n_samples]
    sign = np.sign(state.qd)[: log.n_samples]
    share = np.where(load * sign > 0.0, driving, driven)
    data = prepare_samples(replace(log, tau=log.tau + share * np.abs(load) * sign))
    fit = fit_samples(MODEL, [data], drive=DRIVE)
    doubt = doubt_driving_friction(fit.information, fit.estimate)
    return fit.base, fit.estimate.beta, doubt


@pytest.mark.study
def test_a_factor_on_all_loads_lies_within_the_doubt() -> None:
    base, same, _ = fitted(0.05, 0.05)
    _, other, doubt = fitted(0.08, 0.02)
    links = np.flatnonzero(base.columns < 10 * base.n_links)
    large = links[np.abs(same[links]) > 0.05 * np.abs(same[links]).max()]
    # Half the difference of the shares is the factor: 3 % more of every link.
    np.testing.assert_allclose(other[large] / same[large], 1.03, atol=0.01)
    spread = np.sqrt(np.diag(doubt.covariance))
    assert np.all(np.abs(other - same)[large] < 1.96 * spread[large])
    assert "confounded with a torque gain" in doubt.effects


@pytest.mark.study
def test_without_load_friction_there_is_no_doubt() -> None:
    data = prepare_samples(
        VirtualRobot.ideal(MODEL).record(random_fourier(MODEL, rng=2, duration=5.0)).recording
    )
    fit = fit_samples(MODEL, [data], drive=DriveSet.parse("viscous,coulomb"))
    assert doubt_driving_friction(fit.information, fit.estimate) is None
