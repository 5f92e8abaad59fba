"""Starts of windows eliminated, against least squares over parameters and starts together."""

from __future__ import annotations

import numpy as np
import pytest

from asbuilt.identification.trajectories.objective import eliminate_starts


def test_parameters_and_starts_are_those_of_one_least_squares_problem() -> None:
    rng = np.random.default_rng(0)
    w, r, p, s = 5, 12, 3, 4
    J, e = rng.standard_normal((w, r, p + s)), rng.standard_normal((w, r))
    stiff, off = rng.uniform(0.1, 2.0, s), rng.standard_normal((w, s))
    rows, aims = [], []
    for k in range(w):
        here = slice(p + k * s, p + (k + 1) * s)
        motion, held = np.zeros((r, p + w * s)), np.zeros((s, p + w * s))
        motion[:, :p], motion[:, here] = J[k, :, :p], J[k, :, p:]
        held[:, here] = np.diag(np.sqrt(stiff))
        rows += [motion, held]
        aims += [e[k], -np.sqrt(stiff) * off[k]]
    A, b = np.concatenate(rows), np.concatenate(aims)
    whole = np.linalg.lstsq(A, b)[0]
    found = eliminate_starts(J, e, stiff, off)
    x = np.linalg.solve(found.matrix, found.scores.sum(axis=0))
    np.testing.assert_allclose(x, whole[:p], rtol=1e-10)
    starts = found.to_best - found.by_parameters @ x
    np.testing.assert_allclose(starts.ravel(), whole[p:], rtol=1e-10)
    alone = np.linalg.lstsq(A[:, p:], b)[0]
    left = np.sum((b - A[:, p:] @ alone) ** 2)
    assert found.gain == pytest.approx(0.5 * (b @ b - left), rel=1e-10)


def test_a_chaotic_window_says_nothing() -> None:
    rng = np.random.default_rng(0)
    J, e = rng.standard_normal((3, 12, 5)), rng.standard_normal((3, 12))
    stiff, off = np.ones(2), np.zeros((3, 2))
    tame = eliminate_starts(J[:2], e[:2], stiff, off[:2])
    J[2] *= 1e50
    found = eliminate_starts(J, e, stiff, off)
    np.testing.assert_allclose(found.matrix, tame.matrix, rtol=1e-12)
    assert not np.any(found.scores[2])
    assert not np.any(found.to_best[2])
