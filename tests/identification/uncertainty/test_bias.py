"""How estimates move with a bias, and its shrinkage by sampling."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from asbuilt.identification.uncertainty.bias import (
    derive_estimate_moves,
    shrink_effects,
)


def test_a_regularised_estimate_moves_as_its_own_normal_equations_do() -> None:
    rng = np.random.default_rng(1)
    W, weight = rng.normal(size=(40, 4)), 15.0
    bias = np.array([1.0, -2.0, 0.5, 3.0])
    root = np.linalg.inv(np.linalg.cholesky(W.T @ W + weight * np.eye(4))).T
    R = np.zeros((5, 5))
    R[:-1, :-1] = np.linalg.qr(W)[1]
    information: Any = SimpleNamespace(stacked=lambda weights: R)
    estimate: Any = SimpleNamespace(
        information=None, weights=None, solution=SimpleNamespace(inverse_root=root)
    )
    moved = np.linalg.solve(W.T @ W + weight * np.eye(4), W.T @ (W @ bias))
    np.testing.assert_allclose(
        derive_estimate_moves(information, estimate) @ bias, moved, rtol=1e-10
    )


def test_shrunken_effects_are_the_draws_that_explain_what_was_estimated() -> None:
    rng = np.random.default_rng(2)
    V, size = np.array([[1.0, 0.6], [0.6, 2.0]]), np.array([1.5, 0.7])
    g = np.array([1.0, -0.5])
    truth = size * rng.normal(size=(400_000, 2))
    off = g - truth
    chance = np.exp(-0.5 * np.einsum("ij,jk,ik->i", off, np.linalg.inv(V), off))
    mean = chance @ truth / chance.sum()
    second = (chance[:, None] * (truth - mean)).T @ (truth - mean) / chance.sum()
    found, spread = shrink_effects(g, V, size)
    np.testing.assert_allclose(found, mean, atol=0.01)
    np.testing.assert_allclose(spread, second, atol=0.01)
