"""Noise of equations is found from residuals whose contact forces were projected away."""

from __future__ import annotations

import numpy as np
import pytest

from asbuilt.identification.uncertainty.pose_noise import solve_equation_variances


def test_variances_of_drawn_noise_are_found() -> None:
    """The draws are projected sample by sample, each along other directions."""
    rng = np.random.default_rng(0)
    sigma = np.repeat([4.0, 0.3, 1.0], [3, 3, 12])
    J = rng.normal(size=(4000, 6, 18))
    P = np.eye(18) - np.linalg.pinv(J) @ J
    residual = np.einsum("sij,sj->si", P, sigma * rng.normal(size=(4000, 18)))
    shares = np.mean(P**2, axis=0) @ np.eye(3)[np.repeat([0, 1, 2], [3, 3, 12])]
    found = solve_equation_variances(shares, np.mean(residual**2, axis=0))
    assert np.sqrt(found) == pytest.approx([4.0, 0.3, 1.0], rel=0.1)
