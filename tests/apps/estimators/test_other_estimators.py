"""Ridge, total least squares, joint noise, instruments and essential parameters, each by a second
road.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from three_links import DRIVE, RATE, full_rows, recording

from asbuilt.apps.estimators.ridge import RIDGES
from asbuilt.dynamics import parameter_values
from asbuilt.errors import IdentifiabilityError
from asbuilt.identification import EstimationData, accumulate_stream, methods


def data_of(robot, samples, prior=None):
    model, base, _ = robot
    return EstimationData(model, accumulate_stream(model, base, [samples]), [samples], prior)


def weighted_stack(robot, samples, weights):
    model, base, _ = robot
    joints = full_rows(model, base, samples)
    W = np.vstack([w * rows for (rows, _), w in zip(joints, weights, strict=True)])
    return W, np.concatenate([w * tau for (_, tau), w in zip(joints, weights, strict=True)])


def drive_rows(robot, samples):
    """Rows `sqrt(10) / s`: s is the RMS torque of a joint in columns of its term at all joints."""
    model, base, _ = robot
    joints = full_rows(model, base, samples)
    torque = [np.sqrt(np.mean(tau**2)) for _, tau in joints]
    drives = [j for j, name in enumerate(base.names) if name[:2] in ("Fv", "Fc", "Fo")]
    weights = []
    for j in drives:
        alike = [k for k in drives if base.names[k][:2] == base.names[j][:2]]
        columns = [rows[:, k] for rows, _ in joints for k in alike if np.any(rows[:, k])]
        typical = np.sqrt(np.mean(np.concatenate(columns) ** 2))
        weights.append(np.sqrt(10.0) * typical / torque[int(base.names[j][2:]) - 1])
    return np.eye(base.n_base)[drives] * np.array(weights)[:, None], weights


def test_ridge_is_tikhonov_toward_cad_at_one_of_its_weights(robot):
    model, base, beta = robot
    cad = base.values(np.nan_to_num(parameter_values(model, DRIVE)))
    samples = recording(model, base, beta, noise=3.0, seconds=10.0, seed=8)
    data = data_of(robot, samples, cad)
    estimate = methods["ridge"].estimate(data)
    W, tau = weighted_stack(robot, samples, estimate.weights)
    drives, weights = drive_rows(robot, samples)
    size = np.linalg.norm(np.vstack([W, drives]), axis=0)
    distance = []
    for ridge in RIDGES:
        A = np.vstack([W, np.sqrt(ridge) * np.diag(size), drives])
        b = np.concatenate([tau, np.sqrt(ridge) * size * cad, np.zeros(len(weights))])
        x = np.linalg.lstsq(A / size, b, rcond=None)[0] / size
        distance.append(np.max(np.abs(x - estimate.beta)))
    assert min(distance) < 1e-9
    assert np.argmin(distance) > 0


@pytest.mark.parametrize("believed", [None, 1.0, -3.0])
def test_total_least_squares_is_that_of_the_singular_vector(robot, believed):
    """With every column noisy.

    The right singular vector of the scaled stack that belongs to its smallest singular value,
    whatever CAD says.
    """
    model, base, beta = robot
    samples = recording(model, base, beta, noise=0.5, seed=9)
    estimate = methods["total"].estimate(
        data_of(robot, samples, None if believed is None else believed * beta)
    )
    W, tau = weighted_stack(robot, samples, estimate.weights)
    size, length = np.linalg.norm(W, axis=0), np.linalg.norm(tau)
    exact = np.array([name.startswith("Fo") for name in base.names])
    basis, _ = np.linalg.qr(W[:, exact])

    def away(x):
        return x - basis @ (basis.T @ x)

    stack = np.column_stack([away(W[:, ~exact] / size[~exact]), away(tau / length)])
    v = np.linalg.svd(stack, full_matrices=False)[2][-1]
    x = -v[:-1] / v[-1] * length / size[~exact]
    rest = np.linalg.lstsq(W[:, exact], tau - W[:, ~exact] @ x, rcond=None)[0]
    np.testing.assert_allclose(estimate.beta[~exact], x, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(estimate.beta[exact], rest, rtol=1e-6, atol=1e-8)


def test_total_least_squares_keeps_to_cad_what_no_sample_tells(robot):
    model, base, beta = robot
    samples = recording(model, base, beta, noise=0.3, still=(2,), seed=4)
    cad = base.values(np.nan_to_num(parameter_values(model, DRIVE))) + 0.1
    estimate = methods["total"].estimate(data_of(robot, samples, cad))
    W, _ = weighted_stack(robot, samples, estimate.weights)
    size = np.linalg.norm(W, axis=0)
    never = size == 0
    assert never.any()
    np.testing.assert_allclose(estimate.beta[never], cad[never], rtol=1e-9)
    s, vt = np.linalg.svd(W[:, ~never] / size[~never], full_matrices=False)[1:]
    untold = vt[s < 1e-9 * s[0]]
    np.testing.assert_allclose(
        untold @ (size * estimate.beta)[~never],
        untold @ (size * cad)[~never],
        atol=1e-6 * np.abs(size * cad).max(),
    )


def test_total_least_squares_without_a_solution_is_refused(robot):
    model, base, beta = robot
    samples = recording(model, base, beta, noise=5.0, seconds=1.0, seed=2, parallel=False)
    with pytest.raises(IdentifiabilityError, match="total least squares has no reliable solution"):
        methods["total"].estimate(data_of(robot, samples))


def shared_noise(robot, seed, seconds=20.0):
    """Noise of joint 2 is that of joint 1 with a little of its own."""
    model, base, beta = robot
    clean = recording(model, base, beta, seconds=seconds, seed=11, parallel=False)
    rng = np.random.default_rng(seed)
    common = rng.normal(size=len(clean.t))
    noise = np.column_stack(
        [common, common + 0.1 * rng.normal(size=len(clean.t)), rng.normal(size=len(clean.t))]
    )
    return replace(clean, tau=clean.tau + noise, tau_raw=np.empty((0, 0)))


def test_maximum_likelihood_is_generalised_least_squares_at_its_own_covariance(robot):
    model, base, _beta = robot
    samples = shared_noise(robot, 0)
    estimate = methods["ml"].estimate(data_of(robot, samples))
    joints = full_rows(model, base, samples)
    errors = np.array([tau - W @ estimate.beta for W, tau in joints])
    root = np.linalg.inv(np.linalg.cholesky(errors @ errors.T))
    W = np.einsum("ik,ktp->itp", root, np.array([W for W, _ in joints])).reshape(-1, base.n_base)
    tau = (root @ np.array([tau for _, tau in joints])).ravel()
    np.testing.assert_allclose(
        estimate.beta, np.linalg.lstsq(W, tau, rcond=None)[0], rtol=1e-5, atol=1e-6
    )


def test_maximum_likelihood_beats_separate_weights_where_noise_is_shared(robot):
    _, _, beta = robot
    separate, together, scaled = [], [], []
    for seed in range(12):
        data = data_of(robot, shared_noise(robot, seed))
        separate.append(methods["wls"].estimate(data).beta - beta)
        estimate = methods["ml"].estimate(data)
        together.append(estimate.beta - beta)
        scaled.append((estimate.beta - beta) / estimate.std_errors)
    gain, size = (
        np.sqrt(np.mean(np.square(x), axis=0)) for x in (np.array(together), np.array(scaled))
    )
    assert np.median(gain / np.sqrt(np.mean(np.square(separate), axis=0))) < 0.6
    assert 0.7 < np.median(size) < 1.3


def noisy_motion(robot, seed, noise=0.001):
    """A recording whose positions are noisy, velocities and accelerations filtered differences of
    them.
    """
    from scipy.signal import butter, filtfilt

    model, base, beta = robot
    exact = recording(model, base, beta, seconds=60.0, seed=12, parallel=False)
    rng = np.random.default_rng(seed)
    b, a = butter(2, 12.0, fs=RATE)
    q = filtfilt(b, a, exact.q + noise * rng.normal(size=exact.q.shape), axis=0)
    qd = np.gradient(q, 1 / RATE, axis=0)
    qdd = np.gradient(qd, 1 / RATE, axis=0)
    tau = exact.tau + 0.05 * rng.normal(size=exact.tau.shape)
    return replace(exact, q=q, qd=qd, qdd=qdd, tau=tau, tau_raw=np.empty((0, 0)))


@pytest.mark.study
def test_instruments_take_most_of_the_bias_that_noise_in_the_motion_causes(robot):
    _, base, beta = robot
    bias = {"wls": [], "iv": []}
    for seed in range(4):
        data = data_of(robot, noisy_motion(robot, seed))
        for method, errors in bias.items():
            errors.append(methods[method].estimate(data).beta - beta)
    inertial = np.array([name.startswith("I") for name in base.names])
    plain, instrumented = (
        np.linalg.norm(np.mean(bias[method], axis=0)[inertial]) for method in ("wls", "iv")
    )
    assert instrumented < 0.35 * plain


def test_instrumented_equations_hold(robot):
    """With as many instruments as parameters the solution is that of Z^T (tau - W beta) = 0."""
    from asbuilt.apps.estimators.instruments import follow

    model, base, _ = robot
    samples = noisy_motion(robot, 1)
    data = data_of(robot, samples)
    estimate = methods["iv"].estimate(data)
    assert estimate.information is not None
    W, tau = weighted_stack(robot, samples, estimate.weights)
    hertz = float(estimate.notes[0].split("up to ")[1].split(" Hz")[0])
    Z, _ = weighted_stack(
        robot, follow(model, base, estimate.beta, samples, hertz), estimate.weights
    )
    solved = np.linalg.solve(Z.T @ W, Z.T @ tau)
    np.testing.assert_allclose(estimate.beta, solved, atol=0.05 * np.abs(estimate.std_errors).max())


def test_essential_parameters_leave_out_what_is_zero(robot):
    model, base, beta = robot
    absent = [j for j, name in enumerate(base.names) if name in ("Fo1", "Fo2", "Fv3")]
    beta = beta.copy()
    beta[absent] = 0.0
    samples = recording(model, base, beta, noise=1.0, seconds=60.0, seed=13, parallel=False)
    data = data_of(robot, samples)
    full, essential = (methods[method].estimate(data) for method in ("wls", "essential"))
    dropped = np.flatnonzero(essential.beta == 0.0)
    assert len(set(absent) & set(dropped)) >= 2
    assert len(dropped) < base.n_base / 2
    kept = np.setdiff1d(np.arange(base.n_base), dropped)
    W, tau = weighted_stack(robot, samples, full.weights)
    np.testing.assert_allclose(
        essential.beta[kept], np.linalg.lstsq(W[:, kept], tau, rcond=None)[0], rtol=1e-7, atol=1e-9
    )
    rise = np.sum((tau - W @ essential.beta) ** 2) - np.sum((tau - W @ full.beta) ** 2)
    variance = np.sum((tau - W @ full.beta) ** 2) / (len(tau) - base.n_base)
    assert rise / len(dropped) / variance < 1.5 * stats.f.ppf(
        0.95, len(dropped), len(tau) - base.n_base
    )
    assert np.all(essential.std_errors[dropped] == 0)
