"""Steps of positions: rounded, noisy before or after the rounding, interpolated, continuous."""

import numpy as np
import pytest

from asbuilt.experiment.quality.position_checks import find_position_steps

T = np.arange(0.0, 20.0, 0.001)
RNG = np.random.default_rng(4)


def rounded(step, amplitude, noise=0.0):
    q = amplitude * np.sin(2 * np.pi * 0.2 * T) + noise * RNG.standard_normal(T.size)
    return np.round(q / step) * step


@pytest.mark.parametrize("step", [1e-3, 2 * np.pi / 4096])
@pytest.mark.parametrize("amplitude", [0.02, 0.3, 3.0])
@pytest.mark.parametrize("noise", [0.0, 0.4])
def test_step_of_rounded_positions(step, amplitude, noise):
    q = rounded(step, amplitude, noise * step)
    assert find_position_steps([q[:, None]])[0] == pytest.approx(step, rel=1e-3)
    parts = [q[:9000, None], q[11000:, None]]
    assert find_position_steps(parts)[0] == pytest.approx(step, rel=1e-3)


def test_a_tenth_of_the_samples_may_be_interpolated():
    q = rounded(1e-3, 3.0)
    lost = RNG.random(T.size) < 0.1
    lost[[0, -1]] = False
    q[lost] = np.interp(T[lost], T[~lost], q[~lost])
    assert find_position_steps([q[:, None]])[0] == pytest.approx(1e-3, rel=1e-3)


def test_each_joint_has_its_own_step_or_none():
    constant_speed = 1e-3 * np.arange(T.size) + 2e-5 * RNG.standard_normal(T.size)
    q = np.column_stack([rounded(1e-3, 1.0), np.sin(T), constant_speed, np.zeros(T.size)])
    q = np.column_stack([q, np.sin(T) + 1e-4 * RNG.standard_normal(T.size)])
    assert find_position_steps([q]).round(6).tolist() == [1e-3, 0, 0, 0, 0]
