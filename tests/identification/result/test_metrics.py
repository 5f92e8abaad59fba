"""Torque metrics against their definitions."""

from __future__ import annotations

import json

import numpy as np
import pytest

from asbuilt.codec import restore_dataclass
from asbuilt.errors import ResultError
from asbuilt.identification import TorqueMetrics, torque_metrics
from asbuilt.identification.result.torque_prediction import TorqueTally


def torques(n_samples=500, n=3, seed=0):
    rng = np.random.default_rng(seed)
    measured = 20.0 + rng.normal(scale=[1.0, 5.0, 0.1], size=(n_samples, n))
    return measured, measured + rng.normal(scale=0.3, size=(n_samples, n))


def test_metrics_follow_their_definitions():
    measured, predicted = torques()
    metrics = torque_metrics(measured, predicted, "bench", ("a", "b", "c"))
    error = measured - predicted
    assert metrics.n_samples == 500
    assert np.allclose(metrics.rms, np.sqrt(np.mean(error**2, axis=0)))
    assert np.allclose(metrics.max_abs, np.abs(error).max(axis=0))
    assert np.allclose(metrics.r_squared, 1 - error.var(axis=0) / measured.var(axis=0), atol=0.05)
    spread = ((measured - measured.mean(axis=0)) ** 2).sum(axis=0)
    assert np.allclose(metrics.r_squared, 1 - (error**2).sum(axis=0) / spread, rtol=1e-10)
    assert metrics.relative_error == pytest.approx(np.linalg.norm(error) / np.linalg.norm(measured))
    assert np.allclose(
        metrics.relative_error_per_joint,
        np.linalg.norm(error, axis=0) / np.linalg.norm(measured, axis=0),
    )


def test_batches_add_up_to_the_whole():
    measured, predicted = torques()
    tally = TorqueTally(("a", "b", "c"))
    for start in range(0, 500, 37):
        tally.add(measured[start : start + 37], predicted[start : start + 37])
    whole, parts = torque_metrics(measured, predicted, "x", ("a", "b", "c")), tally.metrics("x")
    for name in ("rms", "max_abs", "r_squared", "relative_error", "relative_error_per_joint"):
        assert np.allclose(getattr(parts, name), getattr(whole, name), rtol=1e-12)


def test_a_constant_torque_has_no_r_squared_and_survives_json():
    metrics = torque_metrics(np.full((10, 1), 3.0), np.full((10, 1), 2.5), "still")
    assert np.isnan(metrics.r_squared[0])
    text = json.dumps(metrics.as_dict(), allow_nan=False)
    again = restore_dataclass(TorqueMetrics, json.loads(text))
    assert json.dumps(again.as_dict()) == text
    assert np.isnan(again.r_squared[0])


def test_what_does_not_fit_is_refused():
    with pytest.raises(
        ResultError, match=r"measured torque has shape \(10, 3\) and predicted \(9, 3\)"
    ):
        torque_metrics(np.zeros((10, 3)), np.zeros((9, 3)), "x")
    with pytest.raises(ResultError, match="no samples"):
        TorqueTally(("a",)).metrics("x")
    with pytest.raises(ValueError, match="joints"):
        restore_dataclass(TorqueMetrics, {"source": "x"})
    whole = torque_metrics(np.eye(2), np.zeros((2, 2)), "x").as_dict()
    with pytest.raises(ResultError, match="one value for each"):
        restore_dataclass(TorqueMetrics, whole | {"rms": [1.0]})
