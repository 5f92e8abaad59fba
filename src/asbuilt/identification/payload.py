"""What the flange carries: the ten inertial parameters of a payload, from a loaded recording and a model of the bare arm."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import clarabel
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

from asbuilt.description.inertia import LinkInertia, shift_matrix
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.blas import one_blas_thread
from asbuilt.dynamics.newton_euler import inverse_dynamics
from asbuilt.errors import IdentifiabilityError, UsageError
from asbuilt.experiment.recording import TorqueSource
from asbuilt.identification.consistency import PSEUDO_INERTIA
from asbuilt.identification.least_squares import solve_factor
from asbuilt.identification.metrics import TorqueMetrics, torque_metrics
from asbuilt.identification.result import IdentificationResult
from asbuilt.identification.square_root_information import accumulate_stream
from asbuilt.identification.torque_prediction import predict_torque
from asbuilt.identification.triangular import triangular_factor

if TYPE_CHECKING:
    from asbuilt.experiment.samples import Samples

Array = NDArray[np.float64]
Arm = Literal["refined", "frozen"]

PAYLOAD_NAMES = ("mass", "com_x", "com_y", "com_z", "Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz")
"""What is reported: mass [kg], centre of mass [m], inertia about it [kg m^2]."""
FLANGES = ("flange", "tool0", "tool", "ee", "tcp")
"""Words in a frame's name that make it the frame of the payload, most fitting first."""
WELL_TOLD = 0.25
"""Standard error, as a fraction of what the parameter is measured by (its own size, or the payload's), up to which a motion is said to tell it."""
COM_SCALE = 0.04
"""Least size by which a centre of mass is judged [m]: 1 cm of standard error counts as told."""
VAGUE_ARM = 0.5
"""Distance from the flange [m] at which nothing is known of a payload's mass."""
FEWEST_BLOCKS = 4
INTERIOR = 1e-6
"""Least eigenvalue of the payload's pseudo-inertia, as a fraction of its trace."""


@dataclass(frozen=True, slots=True, eq=False)
class Payload:
    """Hold the payload as found: `parameters` (10,) about the origin of `frame`, in its axes, in the order of `LinkInertia`, with `covariance` (10, 10).

    They are always those of a possible body; `projected` says that the least-squares estimate was not and the nearest body stands in. `values` and
    `std_errors` (10,) are those of `names`; `determined` are the names that this motion tells. `arm` (p,) are the base parameters of the arm that were used.
    `metrics` has the torque errors with payload on each recording, `metrics_bare` those of the arm alone.
    """

    robot: str
    frame: str
    placement: Array
    link: int
    parameters: Array
    covariance: Array
    values: Array
    std_errors: Array
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
    """Return name, link and placement of the frame that carries the payload: the one named, else the flange, else the last link's.

    Raises UsageError where no moving link or frame has that name.
    """
    frames = {link: (i, np.eye(4)) for i, link in enumerate(model.link_names)}
    frames |= {frame.name: (frame.link, np.array(frame.placement)) for frame in model.frames if frame.link >= 0}
    if name is not None:
        if name not in frames:
            raise UsageError(f"{model.name} has no moving link or frame {name!r} to carry a payload; it has {', '.join(frames)}")
        return name, *frames[name]
    last = model.n_joints - 1
    for word in FLANGES:
        for frame, (link, placement) in frames.items():
            if word in frame.lower() and link == last:
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
    block_seconds: float | None = None,
) -> Payload:
    """Identify what the flange carries from recordings under load.

    The loaded torque is `tau = Y_b beta + Y_l S pi`: the arm's base parameters, and the ten of the payload seen as part of the last link. `arm` "frozen" takes
    beta from the result; "refined" estimates beta and pi together, the result (with its covariance) and recordings of the bare arm (`unloaded`) holding beta.
    Rows are weighted by the result's noise per joint. The covariance is the sum of a delete-one-block jackknife, which allows for correlated residuals
    (Efron & Stein, Annals of Statistics 9, 1981), and of what the result's own covariance carries over. Where the estimate is impossible for a body, the
    nearest possible one in the metric of the covariance is taken, by a semidefinite program.

    Raises
    ------
    IdentifiabilityError
        If there are fewer samples than unknowns, or no motion that tells a mass.
    """
    batches = [loaded] if not isinstance(loaded, Sequence) else list(loaded)
    name, link, placement = payload_frame(result.model, frame)
    shift = shift_matrix(placement)
    weights = 1.0 / np.maximum(result.sigma, np.finfo(np.float64).tiny)
    link_columns = np.arange(10 * link, 10 * link + 10)
    columns = np.union1d(result.base.columns, link_columns)
    under_load = accumulate_stream(result.model, replace(result.base, columns=columns), batches, block_seconds=block_seconds)
    own, carried_columns = np.searchsorted(columns, result.base.columns), np.searchsorted(columns, link_columns)
    bare = accumulate_stream(result.model, result.base, list(unloaded), block_seconds=block_seconds) if unloaded else None
    p = result.n_base
    factors = [under_load.block_stacked(b, weights) for b in range(under_load.n_blocks)]
    blocks = [np.column_stack([factor[:, own], factor[:, carried_columns] @ shift, factor[:, -1]]) for factor in factors]
    blocks += [_widened(bare.block_stacked(b, weights), p) for b in range(bare.n_blocks)] if bare is not None else []
    prior, vague = _prior(result), _vague(result.model)
    with one_blas_thread():
        x, carried = _solved(blocks, prior, vague, p, arm)
        spread = _jackknife(blocks, prior, vague, p, arm)
    covariance = spread + carried
    beta, estimate = x[:p], x[p:]
    if not estimate[9] > 0:
        raise IdentifiabilityError(
            f"the recording under load says that {result.robot} carries {estimate[9]:.3g} kg at {name}; is it really loaded, "
            "and are torque sign, gains and the arm's result of the same robot and units?"
        )
    parameters, projected = _nearest_body(estimate, covariance)
    values, errors = _reported(parameters, covariance)
    told = _told(values, errors)
    payload = Payload(
        robot=result.robot,
        frame=name,
        placement=placement,
        link=link,
        parameters=parameters,
        covariance=covariance,
        values=values,
        std_errors=errors,
        projected=projected,
        determined=tuple(item for item, well in zip(PAYLOAD_NAMES, told, strict=True) if well),
        not_determined=tuple(item for item, well in zip(PAYLOAD_NAMES, told, strict=True) if not well),
        arm=beta,
        n_samples=under_load.n_samples,
        torque_source=batches[0].torque_source,
        metrics=(),
        metrics_bare=(),
    )
    judged = list(validation) or batches
    return replace(
        payload,
        metrics=tuple(_metrics(result, payload, samples, carried=True) for samples in judged),
        metrics_bare=tuple(_metrics(result, payload, samples, carried=False) for samples in judged),
    )


def loaded_torque(result: IdentificationResult, payload: Payload, samples: Samples) -> Array:
    """Return the torque that the payload adds, on the filtered grid of the samples, shape (n_filtered, n)."""
    model = result.model
    chi = np.zeros(10 * model.n_joints)
    chi[10 * payload.link : 10 * payload.link + 10] = shift_matrix(payload.placement) @ payload.parameters
    return samples.filtered(inverse_dynamics(model, samples.q, samples.qd, samples.qdd, parameters=chi))


def _widened(factor: Array, p: int) -> Array:
    """Return a factor of the bare arm with ten zero columns for the payload."""
    return np.concatenate([factor[:, :p], np.zeros((len(factor), 10)), factor[:, p:]], axis=1)


def _prior(result: IdentificationResult) -> Array:
    """Return rows (p, p + 11) that hold beta at the result, in units of its standard errors."""
    p = result.n_base
    scale = np.sqrt(np.maximum(np.diag(result.covariance), np.finfo(np.float64).tiny))
    values, axes = np.linalg.eigh(result.covariance / np.outer(scale, scale))
    root = (axes / np.sqrt(np.maximum(values, 1e-12 * values.max()))).T / scale
    return np.concatenate([root, np.zeros((p, 10)), (root @ result.estimates)[:, None]], axis=1)


def _vague(model: RobotModel) -> Array:
    """Return rows (10, 11) that say next to nothing of a payload: zero, give or take the whole arm's mass half a metre away.

    They matter only in directions that the motion leaves open, whose errors then come out as large as this ignorance.
    """
    mass = float(np.abs(model.parameters[9::10]).sum()) or 1.0
    size = np.concatenate([np.full(6, mass * VAGUE_ARM**2), np.full(3, mass * VAGUE_ARM), [mass]])
    return np.column_stack([np.diag(1.0 / size), np.zeros(10)])


def _arm_taken_out(factor: Array, beta: Array) -> Array:
    """Return a factor's rows (m, 11) of the payload alone, the torque of the arm subtracted."""
    p = len(beta)
    return np.column_stack([factor[:, p:-1], factor[:, -1] - factor[:, :p] @ beta])


def _solved(blocks: Sequence[Array], prior: Array, vague: Array, p: int, arm: Arm) -> tuple[Array, Array]:
    """Return [beta, pi], and the covariance (10, 10) of pi that comes from the result and from ignorance of the payload."""
    data = triangular_factor(np.vstack(blocks))
    ignorance = np.concatenate([np.zeros((10, p)), vague], axis=1)
    if arm == "frozen":
        root = np.linalg.pinv(prior[:, :p])
        beta = root @ prior[:, -1]
        own = _arm_taken_out(data, beta)
        _demand(solve_factor(triangular_factor(own), len(own)).rank)
        solution = solve_factor(triangular_factor(np.vstack([vague, own])), len(own))
        spread = solution.inverse_root @ solution.inverse_root.T
        carried = np.column_stack([spread @ own[:, :-1].T @ data[:, :p] @ root, spread @ vague[:, :-1].T])
        return np.concatenate([beta, solution.x]), carried @ carried.T
    _demand(solve_factor(triangular_factor(np.vstack([prior, data])), len(data)).rank - p)
    solution = solve_factor(triangular_factor(np.vstack([prior, ignorance, data])), len(data))
    held = np.vstack([prior, ignorance])[:, :-1]
    carried = (solution.inverse_root @ solution.inverse_root.T @ held.T)[p:]
    return solution.x, carried @ carried.T


def _demand(rank: int) -> None:
    if rank < 4:
        raise IdentifiabilityError(
            f"the recording under load tells {max(rank, 0)} of the payload's ten parameters, not even its mass and centre; move the arm through "
            "different poses, so that the payload's weight acts on several joints"
        )


def _jackknife(blocks: Sequence[Array], prior: Array, vague: Array, p: int, arm: Arm) -> Array:
    """Return the covariance (10, 10) of pi from leaving out one time block at a time."""
    n = len(blocks)
    if n < FEWEST_BLOCKS:
        raise IdentifiabilityError(
            f"{n} time blocks are too few to judge the errors of a payload, {FEWEST_BLOCKS} are needed; record longer"
        )
    if arm == "frozen":
        beta: Array = np.asarray(np.linalg.lstsq(prior[:, :p], prior[:, -1], rcond=None)[0], dtype=np.float64)
        rows, held = [_arm_taken_out(block, beta) for block in blocks], vague
    else:
        rows, held = list(blocks), np.vstack([prior, np.concatenate([np.zeros((10, p)), vague], axis=1)])
    total = sum((row.T @ row for row in rows), start=held.T @ held)
    scale = np.sqrt(np.diag(total))[:-1]
    estimates = []
    for row in rows:
        rest = total - row.T @ row
        solved = np.linalg.lstsq(rest[:-1, :-1] / np.outer(scale, scale), rest[:-1, -1] / scale, rcond=1e-14)[0] / scale
        estimates.append(solved[-10:])
    deviations: Array = np.array(estimates) - np.mean(estimates, axis=0)
    return np.asarray((n - 1) / n * deviations.T @ deviations, dtype=np.float64)


def _nearest_body(estimate: Array, covariance: Array) -> tuple[Array, bool]:
    """Return the parameters of a possible body nearest to the estimate in the metric of its covariance, and whether it is another."""
    if LinkInertia(estimate).is_consistent:
        return estimate, False
    scale = np.sqrt(np.diag(covariance))
    values, axes = np.linalg.eigh(covariance / np.outer(scale, scale))
    root = (axes / np.sqrt(np.maximum(values, 1e-10 * values.max()))).T / scale
    floor = INTERIOR * float(np.abs(estimate[9]))
    quadratic = sparse.csc_matrix(np.triu(2.0 * (root * scale).T @ (root * scale)))
    linear = -2.0 * (root * scale).T @ (root @ estimate)
    constraint = sparse.csc_matrix(-PSEUDO_INERTIA * scale)
    bound = -floor * np.array([1.0, 0, 1.0, 0, 0, 1.0, 0, 0, 0, 1.0])
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_threads = 1
    solution = clarabel.DefaultSolver(quadratic, linear, constraint, bound, [clarabel.PSDTriangleConeT(4)], settings).solve()
    if str(solution.status) not in ("Solved", "AlmostSolved"):
        raise IdentifiabilityError(
            f"no possible body was found near the payload estimate {estimate.tolist()}: the solver says {solution.status}"
        )
    return np.array(solution.x, dtype=np.float64) * scale, True


def _reported(parameters: Array, covariance: Array) -> tuple[Array, Array]:
    """Return mass, centre of mass and inertia about it with standard errors to first order, two (10,)."""

    def report(pi: Array) -> Array:
        body = LinkInertia(pi)
        about = body.inertia_about_com
        return np.concatenate([[body.mass], body.com, about[np.triu_indices(3)]])

    step = 1e-6 * np.maximum(np.sqrt(np.diag(covariance)), 1e-9)
    slope = np.column_stack([(report(parameters + h) - report(parameters - h)) / (2 * h[k]) for k, h in enumerate(np.diag(step))])
    return report(parameters), np.sqrt(np.maximum(np.diag(slope @ covariance @ slope.T), 0.0))


def _told(values: Array, errors: Array) -> NDArray[np.bool_]:
    centre = np.maximum(np.linalg.norm(values[1:4]), COM_SCALE)
    principal = np.max(np.abs(values[[4, 7, 9]]))
    size = np.concatenate([[values[0]], np.full(3, centre), np.full(6, principal)])
    return errors <= WELL_TOLD * size


def _metrics(result: IdentificationResult, payload: Payload, samples: Samples, *, carried: bool) -> TorqueMetrics:
    bare = predict_torque(result.model, result.base, payload.arm if carried else result.estimates, samples)
    predicted: ArrayLike = bare.predicted + loaded_torque(result, payload, samples) if carried else bare.predicted
    return torque_metrics(bare.measured, predicted, samples.source, result.joint_names)
