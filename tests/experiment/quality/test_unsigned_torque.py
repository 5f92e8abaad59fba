"""Torques without a sign are found."""

import dataclasses

import numpy as np

from asbuilt.description import bundled_robot
from asbuilt.excitation import random_fourier
from asbuilt.experiment import check_recording, simulate_recording

CODE = "torque_unsigned"


def test_magnitudes_of_torques_are_found():
    model = bundled_robot("two-link")
    log = simulate_recording(model, random_fourier(model, rng=1), rate=100.0)
    assert "torque_unsigned" not in check_recording(model, log).codes
    magnitudes = dataclasses.replace(log, tau=np.abs(log.tau))
    assert "torque_unsigned" in check_recording(model, magnitudes).codes


def test_magnitudes_of_a_motion_one_way_are_no_finding():
    model = bundled_robot("two-link")
    log = simulate_recording(model, random_fourier(model, rng=1), rate=100.0)
    turned = np.cumsum(np.abs(np.diff(log.q, axis=0, prepend=log.q[:1])), axis=0)
    one_way = dataclasses.replace(log, q=turned, qd=None, tau=np.abs(log.tau))
    assert "torque_unsigned" not in check_recording(model, one_way).codes


def test_motor_currents_without_a_sign_get_theirs_from_the_command():
    model = bundled_robot("two-link")
    log = simulate_recording(model, random_fourier(model, rng=1), rate=100.0)
    command = log.q + 0.05 * np.asarray(log.tau)
    found = dataclasses.replace(log, tau=np.abs(log.tau), command=command)
    (finding,) = [each for each in check_recording(model, found).findings if each.code == CODE]
    assert "are motor currents" in finding.message
    assert 'sign = "command"' in str(finding.cure)
