"""What the flange carries.

The ten inertial parameters of a payload, from a loaded recording and a model of the bare arm.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import clarabel
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

from asbuilt.arrays import Array
from asbuilt.description.inertia import LinkInertia, shift_matrix
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.kernels.blas import one_blas_thread
from asbuilt.errors import IdentifiabilityError, UsageError
from asbuilt.experiment.recording import TorqueSource
from asbuilt.identification.bodies.cad_prior import IDENTITY_SVEC, PSEUDO_INERTIA_SVEC
from asbuilt.identification.bodies.cone_program import solve_cone_program
from asbuilt.identification.calibration.gain_uncertainty import (
    arm_by_joint,
    gain_covariance,
    relative_gain_errors,
)
from asbuilt.identification.calibration.payload_rows import PayloadRows
from asbuilt.identification.estimators.least_squares import solve_factor
from asbuilt.identification.information.known_information import determined_directions
from asbuilt.identification.information.triangular import triangular_factor
from asbuilt.identification.result.metrics import TorqueMetrics, torque_metrics
from asbuilt.identification.result.result import IdentificationResult
from asbuilt.identification.result.torque_prediction import predict_torque

if TYPE_CHECKING:
    from asbuilt.experiment.signal.samples import Samples

Arm = Literal["refined", "frozen"]

PAYLOAD_NAMES = ("mass", "com_x", "com_y", "com_z", "Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz")
"""What is reported: mass [kg], centre of mass [m], inertia about it [kg m^2]."""
FLANGES = ("flange", "tool0", "tool", "ee", "tcp")
"""Words in a frame's name that make it the frame of the payload, most fitting first."""
SHORT_WORD = 3
"""Words of so few letters must stand by themselves: there is no hand in a sleeve."""
WELL_TOLD = 0.25
"""Standard error, as a fraction of what the parameter is measured by (its own size, or the
payload's), up to which a motion is said to tell it.
"""
COM_SCALE = 0.04
"""Least size by which a centre of mass is judged [m]: 1 cm of standard error counts as told."""
VAGUE_ARM = 0.5
"""Distance from the flange [m] at which nothing is known of a payload's mass."""
FEWEST_BLOCKS = 4
LOAD_ITERATIONS = 4
"""Times that the load, of which friction may depend, is renewed with the payload."""
OPEN = 1e-12
"""Singular value, relative to the largest, below which what is known of the arm leaves a direction
open.
"""
INTERIOR = 1e-6
"""Least eigenvalue of the payload's pseudo-inertia, as a fraction of its trace."""


@dataclass(frozen=True, slots=True, eq=False)
class Payload:
    """Hold the payload as found.

    `parameters` (10,) about the origin of `frame`, in its axes, in the order of `LinkInertia`, with
    `covariance` (10, 10).

    They are always those of a possible body; `projected` says that the least-squares estimate was
    not and the nearest body stands in. `values` and `std_errors` (10,) are those of `names`;
    `determined` are the names that they tell. `arm` (p,) are the base parameters of the arm that
    were used. `noise_errors` (10,) are the part of the standard errors that the recordings show,
    `gain_errors` (10,) that of gains known no better than `gain_uncertainty` (n,), as fractions;
    `gain_slopes` (10, n) is how much each value changes per fraction by which the torque of a joint
    changes, in all recordings of the arm: exact where the result kept its cause data
    (`gains_by_evidence`), else as if the arm had been identified along the motion at hand, which
    may leave the centre too sure. `metrics` has the torque errors with payload on each recording,
    `metrics_bare` those of the arm alone.
    """

    robot: str
    frame: str
    placement: Array
    link: int
    parameters: Array
    covariance: Array
    values: Array
    std_errors: Array
    noise_errors: Array
    gain_errors: Array
    gain_slopes: Array
    gain_uncertainty: Array
    gains_by_evidence: bool
    projected: bool
    determined: tuple[str, ...]
    not_determined: tuple[str, ...]
    arm: Array
    n_samples: int
    torque_source: TorqueSource
    metrics: tuple[TorqueMetrics, ...]
    metrics_bare: tuple[TorqueMetrics, ...]
    names: tuple[str, ...] = PAYLOAD_NAMES

    @property
    def inertia(self) -> LinkInertia:
        """The payload as a body in the payload frame."""
        return LinkInertia(self.parameters)


def payload_frame(model: RobotModel, name: str | None = None) -> tuple[str, int, Array]:
    """Return name, link and placement of the frame that carries the payload.

    The one named, else the flange, else the last link's.

    Raises UsageError where no moving link or frame has that name.
    """
    frames = {link: (i, np.eye(4)) for i, link in enumerate(model.link_names)}
    frames |= {
        frame.name: (frame.link, np.array(frame.placement))
        for frame in model.frames
        if frame.link >= 0
    }
    if name is not None:
        if name not in frames:
            raise UsageError(
                f"{model.name} has no moving link or frame {name!r} to carry a payload; it has"
                f" {', '.join(frames)}"
            )
        return name, *frames[name]
    last = model.n_joints - 1
    for word in FLANGES:
        for frame, (link, placement) in frames.items():
            if link == last and word in (
                re.split(r"[^a-z0-9]+", frame.lower()) if len(word) <= SHORT_WORD else frame.lower()
            ):
                return frame, link, placement
    return model.link_names[last], last, np.eye(4)


def identify_payload(
    result: IdentificationResult,
    loaded: Samples | Sequence[Samples],
    *,
    unloaded: Sequence[Samples] = (),
    frame: str | None = None,
    arm: Arm = "refined",
    validation: Sequence[Samples] = (),
    gain_uncertainty: ArrayLike | None = None,
    block_seconds: float | None = None,
) -> Payload:
    """Identify what the flange carries from recordings under load.

    The loaded torque is `tau = Y_b beta + Y_l S pi`: the arm's base parameters, and the ten of the
    payload seen as part of the last link. `arm` "frozen" takes beta from the result; "refined"
    estimates beta and pi together, the result (with its covariance) and recordings of the bare arm
    (`unloaded`) holding beta. Rows are weighted by the result's noise per joint. The covariance is
    the sum of a delete-one-block jackknife, which allows for correlated residuals (Efron & Stein,
    Annals of Statistics 9, 1981), of what the result's own covariance carries over, and of what
    unknown gains leave open: torque from currents is as good as the torque per ampere of each
    joint, which no recording without a known load tells, `gain_uncertainty` (one fraction, or one
    per joint; by default what is usual for the torque source, none for sensors). Where the estimate
    is impossible for a body, the nearest possible one in the metric of the covariance is taken, by
    a semidefinite program. Friction that depends on load feels the payload too.

    Raises
    ------
    UsageError
        If there are no samples, no frame of that name, or uncertainties that are no fractions.
    IdentifiabilityError
        If there are fewer samples than unknowns, or no motion that tells a mass.
    """
    batches = [loaded] if not isinstance(loaded, Sequence) else list(loaded)
    if not batches:
        raise UsageError(
            f"no samples are given of {result.robot} under load; pass at least one prepared"
            " recording"
        )
    source = batches[0].torque_source
    uncertainty = relative_gain_errors(source, result.model.n_joints, gain_uncertainty)
    name, link, placement = payload_frame(result.model, frame)
    p = result.n_base
    prior, vague = _prior(result), _vague(result.model)
    x = np.concatenate([result.estimates, np.zeros(10)])
    for _ in range(LOAD_ITERATIONS if result.base.drive.needs_load else 1):
        rows = PayloadRows.of(
            result, batches, list(unloaded), link, shift_matrix(placement), x, block_seconds
        )
        with one_blas_thread():
            x, carried = _solved(rows.blocks, prior, vague, result.estimates, arm)
    with one_blas_thread():
        noise = _jackknife(rows.blocks, prior, vague, result.estimates, arm) + carried
        slopes = _gain_slopes(result, rows, prior, vague, arm)
    gains = slopes @ gain_covariance(uncertainty) @ slopes.T
    beta, estimate = x[:p], x[p:]
    if not estimate[9] > 0:
        raise IdentifiabilityError(
            f"the recording under load says that {result.robot} carries {estimate[9]:.3g} kg at"
            f" {name}; is it really loaded, and are torque sign, gains and the arm's result of the"
            " same robot and units?"
        )
    parameters, projected = _nearest_body(estimate, noise + gains)
    values, reported = _reported(parameters, noise + gains)
    errors, noise_errors, gain_errors = (
        _deviations(reported @ part @ reported.T) for part in (noise + gains, noise, gains)
    )
    told = _told(values, errors)
    payload = Payload(
        robot=result.robot,
        frame=name,
        placement=placement,
        link=link,
        parameters=parameters,
        covariance=noise + gains,
        values=values,
        std_errors=errors,
        noise_errors=noise_errors,
        gain_errors=gain_errors,
        gain_slopes=reported @ slopes,
        gain_uncertainty=uncertainty,
        gains_by_evidence=result.cause_data is not None,
        projected=projected,
        determined=tuple(item for item, well in zip(PAYLOAD_NAMES, told, strict=True) if well),
        not_determined=tuple(
            item for item, well in zip(PAYLOAD_NAMES, told, strict=True) if not well
        ),
        arm=beta,
        n_samples=rows.n_samples,
        torque_source=source,
        metrics=(),
        metrics_bare=(),
    )
    judged = list(validation) or batches
    return replace(
        payload,
        metrics=tuple(_metrics(result, samples, beta, payload) for samples in judged),
        metrics_bare=tuple(_metrics(result, samples, result.estimates, None) for samples in judged),
    )


def _gain_slopes(
    result: IdentificationResult, rows: PayloadRows, prior: Array, vague: Array, arm: Arm
) -> Array:
    """Return how pi changes per fraction by which the torque of each joint changes in all
    recordings, those behind the result too, (10, n).

    pi is linear in all torques; that of joint k enters the result's beta, and the rows of joint k.
    """
    p = result.n_base
    of_arm = arm_by_joint(result, rows.joints, result.weights)
    sides = np.column_stack([joint[:, :-1].T @ joint[:, -1] for joint in rows.joints])
    matrix = sum(
        (block[:, :-1].T @ block[:, :-1] for block in rows.blocks), start=np.zeros((p + 10, p + 10))
    )
    matrix[p:, p:] += vague[:, :-1].T @ vague[:, :-1]
    if arm == "frozen":
        return np.asarray(_solved_symmetric(matrix[p:, p:], sides[p:] - matrix[p:, :p] @ of_arm))
    held = prior[:, :-1].T @ prior[:, :-1]
    return np.asarray(_solved_symmetric(matrix + held, sides + held[:, :p] @ of_arm)[p:])


def _solved_symmetric(matrix: Array, sides: Array) -> Array:
    scale = _lengths(matrix)
    return np.asarray(
        np.linalg.lstsq(matrix / np.outer(scale, scale), sides / scale[:, None], rcond=1e-14)[0]
        / scale[:, None]
    )


def _lengths(gram: Array) -> Array:
    """Return the lengths of the columns of a Gram matrix, 1 for those that nothing tells."""
    length = np.sqrt(np.diag(gram))
    return np.where(length > 0.0, length, 1.0)


def _prior(result: IdentificationResult) -> Array:
    """Return rows (m, p + 11) that hold beta at the result, in units of its standard errors, where
    the result knows it; what it dropped, whose columns are zero elsewhere, at zero.
    """
    scale, variances, directions = determined_directions(result)
    root = np.vstack(
        [(directions / np.sqrt(variances)).T * scale, np.eye(result.n_base)[result.dropped]]
    )
    return np.concatenate(
        [root, np.zeros((len(root), 10)), (root @ result.estimates)[:, None]], axis=1
    )


def _vague(model: RobotModel) -> Array:
    """Return rows (10, 11) that say next to nothing of a payload.

    Zero, give or take the whole arm's mass half a metre away.

    They matter only in directions that the motion leaves open, whose errors then come out as large
    as this ignorance.
    """
    mass = float(np.abs(model.parameters[9::10]).sum()) or 1.0
    size = np.concatenate([np.full(6, mass * VAGUE_ARM**2), np.full(3, mass * VAGUE_ARM), [mass]])
    return np.column_stack([np.diag(1.0 / size), np.zeros(10)])


def _arm_taken_out(factor: Array, beta: Array) -> Array:
    """Return a factor's rows (m, 11) of the payload alone, the torque of the arm subtracted."""
    p = len(beta)
    return np.column_stack([factor[:, p:-1], factor[:, -1] - factor[:, :p] @ beta])


def _solved(
    blocks: Sequence[Array], prior: Array, vague: Array, estimates: Array, arm: Arm
) -> tuple[Array, Array]:
    """Return [beta, pi], and the covariance (10, 10) of pi that comes from the result and from
    ignorance of the payload.

    What of the arm neither the result nor the recordings tell stays at the result's `estimates`
    (p,).
    """
    p = len(estimates)
    data = triangular_factor(np.vstack(blocks))
    ignorance = np.concatenate([np.zeros((10, p)), vague], axis=1)
    if arm == "frozen":
        root, beta = np.linalg.pinv(prior[:, :p]), estimates
        _demand_known_arm(data[:, :p], prior[:, :p])
        own = _arm_taken_out(data, beta)
        _demand(solve_factor(triangular_factor(own), len(own)).rank)
        solution = solve_factor(triangular_factor(np.vstack([vague, own])), len(own))
        spread = solution.inverse_root @ solution.inverse_root.T
        carried = np.column_stack(
            [spread @ own[:, :-1].T @ data[:, :p] @ root, spread @ vague[:, :-1].T]
        )
        return np.concatenate([beta, solution.x]), carried @ carried.T
    both = np.vstack([prior, data])
    without = np.delete(both, slice(p, p + 10), axis=1)
    _demand(
        solve_factor(triangular_factor(both), len(data)).rank
        - solve_factor(triangular_factor(without), len(data)).rank
    )
    solution = solve_factor(
        triangular_factor(np.vstack([prior, ignorance, data])),
        len(data),
        np.append(estimates, np.zeros(10)),
    )
    held = np.vstack([prior, ignorance])[:, :-1]
    carried = (solution.inverse_root @ solution.inverse_root.T @ held.T)[p:]
    return solution.x, carried @ carried.T


def _demand(rank: int) -> None:
    if rank < 4:
        raise IdentifiabilityError(
            f"the recording under load tells {max(rank, 0)} of the payload's ten parameters, not"
            " even its mass and centre; move the arm through different poses, so that the"
            " payload's weight acts on several joints"
        )


def _demand_known_arm(rows: Array, prior: Array) -> None:
    """Raise `IdentifiabilityError` where rows (m, p) of the arm feel what the rows (k, p) of the
    prior leave open.
    """
    size = np.linalg.norm(np.vstack([prior, rows]), axis=0)
    scaled = np.where(size > 0.0, size, 1.0)
    _, s, vt = np.linalg.svd(prior / scaled)
    free = vt[int(np.sum(s > OPEN * s.max(initial=0.0))) :]
    if np.linalg.norm(rows / scaled @ free.T) > np.sqrt(OPEN) * np.linalg.norm(rows / scaled):
        raise IdentifiabilityError(
            "the recording under load moves what the result of the arm leaves open (joints that"
            " stood still, say), so that a frozen arm does not predict it; take the arm refined, or"
            " identify it again from richer motion"
        )


def _jackknife(
    blocks: Sequence[Array], prior: Array, vague: Array, estimates: Array, arm: Arm
) -> Array:
    """Return the covariance (10, 10) of pi from leaving out one time block at a time."""
    n, p = len(blocks), len(estimates)
    if n < FEWEST_BLOCKS:
        raise IdentifiabilityError(
            f"{n} time blocks are too few to judge the errors of a payload, {FEWEST_BLOCKS} are"
            " needed; record longer"
        )
    if arm == "frozen":
        rows, held = [_arm_taken_out(block, estimates) for block in blocks], vague
    else:
        rows, held = (
            list(blocks),
            np.vstack([prior, np.concatenate([np.zeros((10, p)), vague], axis=1)]),
        )
    total = sum((row.T @ row for row in rows), start=held.T @ held)
    scale = _lengths(total)[:-1]
    found = []
    for row in rows:
        rest = total - row.T @ row
        solved = (
            np.linalg.lstsq(
                rest[:-1, :-1] / np.outer(scale, scale), rest[:-1, -1] / scale, rcond=1e-14
            )[0]
            / scale
        )
        found.append(solved[-10:])
    deviations: Array = np.array(found) - np.mean(found, axis=0)
    return np.asarray((n - 1) / n * deviations.T @ deviations, dtype=np.float64)


def _nearest_body(estimate: Array, covariance: Array) -> tuple[Array, bool]:
    """Return the parameters of a possible body nearest to the estimate in the metric of its
    covariance, and whether it is another.
    """
    if LinkInertia(estimate).is_consistent:
        return estimate, False
    scale = np.sqrt(np.diag(covariance))
    values, axes = np.linalg.eigh(covariance / np.outer(scale, scale))
    root = (axes / np.sqrt(np.maximum(values, 1e-10 * values.max()))).T / scale
    floor = INTERIOR * float(np.abs(estimate[9]))
    quadratic = sparse.csc_matrix(np.triu(2.0 * (root * scale).T @ (root * scale)))
    linear = -2.0 * (root * scale).T @ (root @ estimate)
    constraint = sparse.csc_matrix(-PSEUDO_INERTIA_SVEC * scale)
    solution = solve_cone_program(
        quadratic, linear, constraint, -floor * IDENTITY_SVEC, [clarabel.PSDTriangleConeT(4)]
    )
    if not solution.is_solved:
        raise IdentifiabilityError(
            f"no possible body was found near the payload estimate {estimate.tolist()}: the solver"
            f" says {solution.status}"
        )
    return solution.x * scale, True


def _reported(parameters: Array, covariance: Array) -> tuple[Array, Array]:
    """Return mass, centre of mass and inertia about it (10,), and their slopes (10, 10) in the
    parameters; differences are small against the errors.
    """

    def report(pi: Array) -> Array:
        body = LinkInertia(pi)
        about = body.inertia_about_com
        return np.concatenate([[body.mass], body.com, about[np.triu_indices(3)]])

    step = 1e-6 * np.maximum(np.sqrt(np.diag(covariance)), 1e-9)
    slope = np.column_stack(
        [
            (report(parameters + h) - report(parameters - h)) / (2 * h[k])
            for k, h in enumerate(np.diag(step))
        ]
    )
    return report(parameters), slope


def _deviations(covariance: Array) -> Array:
    return np.asarray(np.sqrt(np.maximum(np.diag(covariance), 0.0)))


def _told(values: Array, errors: Array) -> NDArray[np.bool_]:
    centre = np.maximum(np.linalg.norm(values[1:4]), COM_SCALE)
    principal = np.max(np.abs(values[[4, 7, 9]]))
    size = np.concatenate([[values[0]], np.full(3, centre), np.full(6, principal)])
    return errors <= WELL_TOLD * size


def _metrics(
    result: IdentificationResult, samples: Samples, beta: Array, payload: Payload | None
) -> TorqueMetrics:
    """Return the torque error of an arm (and what it carries) on a recording."""
    added = None
    if payload is not None:
        added = np.zeros(10 * result.model.n_joints)
        added[10 * payload.link : 10 * payload.link + 10] = (
            shift_matrix(payload.placement) @ payload.parameters
        )
    prediction = predict_torque(result.model, result.base, beta, samples, added=added)
    return torque_metrics(
        prediction.measured, prediction.predicted, samples.source, result.joint_names
    )
