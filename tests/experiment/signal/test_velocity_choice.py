import numpy as np
import pytest

from asbuilt.experiment.signal.band_choice import motion_bandwidth
from asbuilt.experiment.signal.differentiation import compare_velocities

T = np.arange(0, 40, 0.01)
NOISE = np.random.default_rng(0).normal(size=(T.size, 2))


def speeds(lag=0.0, gain=1.0):
    return gain * np.cos(np.outer(T - lag, 2 * np.pi * np.array([0.2, 0.3])))


@pytest.mark.parametrize(
    ("lag", "gain", "noise", "helps"),
    [(0, 1, 0.2, True), (0.01, 1, 0.2, False), (0, 1.05, 0.2, False), (0, 1, 0.8, False)],
)
def test_lag_gain_and_noise_are_measured_and_each_can_disqualify(lag, gain, noise, helps):
    v, w = speeds(), speeds(lag, gain)
    verdict = compare_velocities([(v, w, v + 0.01 * NOISE, w + 0.01 * noise * NOISE[::-1])], 100.0)
    assert verdict.lag == pytest.approx(lag, abs=2e-4)
    assert verdict.gain == pytest.approx(gain, abs=2e-3)
    assert verdict.noise == pytest.approx(noise, rel=0.05)
    assert verdict.helps is helps
    assert str(verdict).startswith(
        "logged velocities used" if helps else "logged velocities not used"
    )


def test_bandwidth_is_that_of_the_fastest_moving_joint():
    q = np.column_stack(
        [np.sin(2 * np.pi * 0.3 * T), 0.1 * np.sin(2 * np.pi * 2.0 * T), 1e-6 * NOISE[:, 0]]
    )
    assert motion_bandwidth([q], 100.0) == pytest.approx(2.0, abs=0.11)
    assert motion_bandwidth([q[:, :1], q[:2500, :1]], 100.0) == pytest.approx(0.3, abs=0.11)
    assert motion_bandwidth([np.zeros((500, 2))], 100.0) > 0


@pytest.mark.parametrize("rate", [100.0, 500.0, 1733.0])
@pytest.mark.parametrize("noise", [0.0, 1e-4, 1e-3])
def test_noise_of_positions_is_no_motion(rate, noise):
    """White noise of 0.1 mrad makes most of the velocity's power at 1 kHz.

    The motion ends where it did.
    """
    t = np.arange(round(25.0 * rate)) / rate
    q = np.column_stack(
        [np.sin(2 * np.pi * 0.3 * t), 0.5 * np.sin(2 * np.pi * 2.0 * t), np.zeros_like(t)]
    )
    q = q + noise * np.random.default_rng(0).normal(size=q.shape)
    assert motion_bandwidth([q], rate) == pytest.approx(2.0, abs=0.11)
