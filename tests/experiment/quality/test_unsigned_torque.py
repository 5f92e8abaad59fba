"""Torques without a sign are found."""

import dataclasses

import numpy as np

from asbuilt.description.catalogue import bundled_robot
from asbuilt.excitation.motions.random_motion import random_fourier
from asbuilt.experiment.quality.checks import check_recording
from asbuilt.experiment.virtual.simulation import simulate_recording


def test_magnitudes_of_torques_are_found():
    model = bundled_robot("two-link")
    log = simulate_recording(model, random_fourier(model, rng=1), rate=100.0)
    assert "torque_unsigned" not in check_recording(model, log).codes
    magnitudes = dataclasses.replace(log, tau=np.abs(log.tau))
    assert "torque_unsigned" in check_recording(model, magnitudes).codes
