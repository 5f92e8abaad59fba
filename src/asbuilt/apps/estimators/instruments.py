"""Instrumental variables from a simulated motion without the noise of the recorded one."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from asbuilt.arrays import Array
from asbuilt.description import RobotModel
from asbuilt.dynamics import BaseParameters, mass_matrix, use_one_blas_thread
from asbuilt.experiment import Samples
from asbuilt.identification import (
    JOINT_WEIGHTS,
    ROWS_AT_ONCE,
    Estimate,
    EstimationData,
    GrowingFactor,
    RowBlock,
    Rows,
    estimate_wls,
    estimator,
    expand_parameters,
    fit_least_squares,
    reduce_rows,
    solve_factor,
    triangular_factor,
)

# Hold how the instruments are simulated, and when the iteration ends.

# Bandwidth of the simulated controller, in bandwidths of the motion's velocity
SIMULATION_BANDWIDTHS = 3.0
SIMULATION_LOWEST = 2.0  # Lowest bandwidth of the controller [Hz]
# Largest simulation step, in units of 1 / the controller's angular frequency
SIMULATION_STEP = 0.05
SIMULATION_LED_IN = 1.0  # Time [s] that each segment is simulated before it counts
# Smallest eigenvalue of a positive definite mass matrix, in mean inertias of the joints
SIMULATION_LEAST_INERTIA = 0.01
SIMULATION_SEGMENTS = 64  # Segments of a recording that are simulated side by side
SIMULATION_MOST_ITERATIONS = 4  # Most simulations, one for each estimate
# Change of the estimate, in standard errors, at which the iteration ends
SIMULATION_CONVERGENCE = 1e-2


@estimator(
    "iv",
    "instrumental variables",
    "noise in the motion, by a simulated motion without it",
    needs="simulation",
    held_fixed=(JOINT_WEIGHTS, "the simulated motion"),
)
def estimate_iv(data: EstimationData) -> Estimate:
    """Solve `Z^T (tau - W beta) = 0` with Z the regressor along a simulated motion.

    Noise in the recorded motion biases least squares toward zero; errors of Z are independent of
    it, so that the estimate is consistent (IDIM-IV: Janot, Vandanjon & Gautier, IEEE Trans. Control
    Systems Technology 22, 2014). There the simulation follows the commanded motion under the
    robot's controller. Recordings hold neither, so the identified model follows the recorded
    positions q under a joint controller that compensates gravity, Coriolis torques and drives,
    `M(q_s) qdd_s = J (w^2 (q - q_s) + 2 w (qd - qd_s))`, J the mean inertia of each joint. It
    passes the motion and little noise above w, three bandwidths of the motion; the bias by noise
    below w remains. Rows are weighted joint by joint. Simulation and estimation alternate to
    convergence.
    """
    base = data.base
    start = estimate_wls(data)
    estimate = start
    moves = np.inf
    iterations = 0
    hertz = max(
        SIMULATION_LOWEST,
        SIMULATION_BANDWIDTHS * max(_measure_bandwidth(samples) for samples in data.batches),
    )
    while moves > SIMULATION_CONVERGENCE and iterations < SIMULATION_MOST_ITERATIONS:
        simulated = [
            follow(data.model, base, estimate.beta, samples, hertz) for samples in data.batches
        ]
        renewed = _fit_two_stages(data, start, data.rows_of(simulated))
        errors = np.maximum(renewed.std_errors, np.finfo(np.float64).tiny)
        moves = float(np.max(np.abs(renewed.beta - estimate.beta) / errors))
        estimate = renewed
        iterations = iterations + 1
    shift = np.abs(estimate.beta - start.beta)
    errors = estimate.std_errors
    shift = np.divide(shift, errors, out=np.zeros_like(shift), where=errors > 0)
    largest = int(np.argmax(shift))
    note = (
        f"Instruments from {iterations} simulations that follow the recorded positions up to"
        f" {hertz:.3g} Hz. The largest change from wls is of {base.names[largest]},"
        f" {shift[largest]:.2g} textbook standard errors."
    )
    return replace(
        estimate, method="iv", iterations=iterations, converged=moves <= 1.0, notes=(note,)
    )


def follow(
    model: RobotModel, base: BaseParameters, beta: Array, samples: Samples, bandwidth: float
) -> Samples:
    """Return the samples with the motion of a simulated robot that follows their positions.

    Torques stay. Linearly implicit Euler steps, many segments side by side, each led in by a
    second. If the mass matrix of beta is not positive definite, the design's serves, or unit
    inertias.
    """
    samples = samples.compact()
    links, armature, inertia = _estimate_inertia(
        model, base, beta, samples.q[:: max(1, samples.n_samples // 200)]
    )
    w = 2.0 * np.pi * bandwidth
    substeps = max(1, int(np.ceil(w / samples.rate / SIMULATION_STEP)))
    h = 1.0 / (samples.rate * substeps)
    q, qd, qdd = (np.array(x) for x in (samples.q, samples.qd, samples.qdd))
    first, length, lead = _split_segments(samples)
    at = np.maximum(first - lead, 0)
    state = samples.q[at].copy()
    rate = samples.qd[at].copy()
    identity = np.eye(model.n_joints)
    for step in range(int((length + lead).max())):
        index = np.minimum(first - lead + step, first + length - 1)
        before = np.maximum(index - 1, 0)
        counts = (step >= lead) & (step < lead + length)
        acceleration = np.zeros_like(state)
        for part in range(substeps if step else 1):
            target, wanted = (
                x[before] + (x[index] - x[before]) * ((part + 1) / substeps)
                for x in (samples.q, samples.qd)
            )
            mass = mass_matrix(model, state, parameters=links) + armature * identity
            force = inertia * (
                w**2 * (target - state - (h * rate if step else 0.0)) + 2.0 * w * (wanted - rate)
            )
            lhs = mass + (2.0 * w * h + (w * h) ** 2) * inertia * identity
            acceleration = np.linalg.solve(lhs, force[:, :, None])[:, :, 0]
            if step:
                rate = rate + h * acceleration
                state = state + h * rate
        for own, found in ((q, state), (qd, rate), (qdd, acceleration)):
            own[index[counts]] = found[counts]
    return replace(samples, q=q, qd=qd, qdd=qdd)


def _estimate_inertia(
    model: RobotModel, base: BaseParameters, beta: Array, postures: Array
) -> tuple[Array, Array, Array]:
    """Return inertial parameters, armatures and mean joint inertias of the simulated robot."""
    chi = expand_parameters(base, beta)
    found = dict(zip(base.standard_names, chi, strict=True))
    armature = np.array([found.get(f"Ia{k + 1}", 0.0) for k in range(model.n_joints)])
    for links, rotors in (
        (chi[: 10 * model.n_links], armature),
        (model.parameters, np.maximum(armature, 0.0)),
    ):
        mass = mass_matrix(model, postures, parameters=links) + rotors * np.eye(model.n_joints)
        inertia = np.diagonal(mass, axis1=1, axis2=2).mean(axis=0)
        if (
            inertia.min() > 0
            and np.linalg.eigvalsh(mass / np.sqrt(np.outer(inertia, inertia))).min()
            > SIMULATION_LEAST_INERTIA
        ):
            return links, rotors, inertia
    return np.zeros(10 * model.n_links), np.ones(model.n_joints), np.ones(model.n_joints)


def _split_segments(
    samples: Samples,
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return first sample, length and lead-in of each segment, none across a gap."""
    longest = max(1, -(-samples.n_samples // SIMULATION_SEGMENTS))
    parts = [
        (a, min(longest, stop - a), min(a - start, round(SIMULATION_LED_IN * samples.rate)))
        for start, stop in samples.segments
        for a in range(start, stop, longest)
    ]
    first, length, lead = np.array(parts).T
    return first, length, lead


def _measure_bandwidth(samples: Samples) -> float:
    """Return the frequency [Hz] below which 95 % of the velocity's power lies (longest segment)."""
    start, stop = max(samples.segments, key=lambda segment: segment[1] - segment[0])
    velocity = samples.qd[start:stop] - samples.qd[start:stop].mean(axis=0)
    scaled = velocity / np.maximum(velocity.std(axis=0), 1e-9)
    power = np.sum(np.abs(np.fft.rfft(scaled, axis=0)) ** 2, axis=1)
    place = np.searchsorted(np.cumsum(power), 0.95 * power.sum())
    return float(np.fft.rfftfreq(stop - start, 1.0 / samples.rate)[place])


@use_one_blas_thread()
def _fit_two_stages(data: EstimationData, start: Estimate, instruments: Rows) -> Estimate:
    """Return the estimate by two-stage least squares: W projected on Z, then the torque on that."""
    information = data.information
    rows = data.rows
    base = data.base
    p = base.n_base
    n = information.n_joints
    weights = start.weights
    growing = GrowingFactor(2 * p + 1, ROWS_AT_ONCE)
    for z, block in zip(instruments, rows, strict=True):
        for k, support in enumerate(rows.support):
            both = np.zeros((2 * p + 1, block.time.n_samples))
            both[support] = z.rows[k][:-1]
            both[np.append(p + support, -1)] = block.rows[k]
            growing.append(weights[k] * both)
    factor = growing.factor()
    zz = factor[:p, :p]
    zw = factor[:p, p:]
    excited = np.abs(np.diag(zz)) > 1e-10 * np.linalg.norm(zz, axis=0)
    projection = np.linalg.lstsq(zz[:, excited], zw[:, :-1], rcond=1e-12)[0]
    beta = solve_factor(
        triangular_factor(zw[excited]), information.n_samples * n, data.prior_values
    ).x

    def project_rows() -> Iterator[RowBlock]:
        for z, block in zip(instruments, rows, strict=True):
            made = []
            for k, support in enumerate(rows.support):
                full = np.zeros((p, block.time.n_samples))
                full[support] = z.rows[k][:-1]
                stage = projection.T @ full[excited]
                error = block.rows[k][-1] - beta[support] @ block.rows[k][:-1]
                made.append(np.vstack([stage, error + beta @ stage]))
            yield RowBlock(tuple(made), block.time, block.seconds)

    solved = reduce_rows(base, information.joint_names, [np.arange(p)] * n, project_rows())
    return replace(
        fit_least_squares(
            solved, weights=weights, prior=data.prior, undetermined=data.undetermined
        ),
        information=solved,
    )
