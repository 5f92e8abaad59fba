"""Payload at the flange.

The ten inertial parameters of a payload, from a loaded recording and a model of the bare arm.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import clarabel
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

from asbuilt.arrays import Array
from asbuilt.description.inertia import LinkInertia, shift_matrix
from asbuilt.description.model import RobotModel
from asbuilt.description.rotation import invert_placement
from asbuilt.dynamics.kernels.blas import use_one_blas_thread
from asbuilt.errors import IdentifiabilityError, UsageError
from asbuilt.experiment.recording import TorqueSource
from asbuilt.experiment.signal.samples import Samples
from asbuilt.findings import Cure, join_names
from asbuilt.identification.bodies.cad_prior import IDENTITY_SVEC, PSEUDO_INERTIA_SVEC
from asbuilt.identification.bodies.conic_fit import solve_cone_program
from asbuilt.identification.calibration.payload_rows import (
    PayloadRows,
    derive_gain_errors,
    gain_covariance,
    name_doubtful_gains,
    solve_without_blocks,
    split_by_joint,
)
from asbuilt.identification.information.triangular import solve_factor, triangular_factor
from asbuilt.identification.result.as_built_parameters import scale_covariance
from asbuilt.identification.result.result import IdentificationResult
from asbuilt.identification.result.torque_prediction import (
    TorqueMetrics,
    predict_torque,
    torque_metrics,
)
from asbuilt.scaled import Scaled
from asbuilt.statistics import jackknife_covariance
from asbuilt.tables import (
    SIGNIFICANT_SIGMAS,
    Column,
    Table,
    format_plus_minus,
    round_with_error,
)

Arm = Literal["refined", "frozen"]

PAYLOAD_NAMES = ("mass", "com_x", "com_y", "com_z", "Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz")
"""Mass [kg], centre of mass [m] and inertia about it [kg m^2]."""
FLANGES = ("flange", "tool0", "tool", "ee", "tcp")
"""Words in the name of the frame that carries the payload, most specific first."""


# Hold scales and weights of the fit of a payload.

PAYLOAD_SHORT_WORD = 3  # Words of at most so many characters must be separate: "sleeve" is no "ee"
# Least scale of a centre of mass [m]: with 1 cm of standard error it is determined
PAYLOAD_COM_SCALE = 0.04
PAYLOAD_VAGUE_ARM = 0.5  # Distance from the flange [m] of the prior standard deviation of a payload
PAYLOAD_LOAD_ITERATIONS = 4  # Iterations of load-dependent friction with the payload
# Singular value, relative to the largest, below which the arm's prior has no information
PAYLOAD_OPEN = 1e-12
# Least eigenvalue of the payload's pseudo-inertia, as a fraction of its trace
PAYLOAD_INTERIOR = 1e-6


LARGEST_ERROR = 0.25
"""Standard error of a determined parameter, relative to its own scale or the payload's."""
FEWEST_BLOCKS = 4


@dataclass(frozen=True, slots=True, eq=False)
class Payload:
    """Hold an identified payload.

    Parameters
    ----------
    robot, frame, placement, link
        Robot, frame that carries the payload, its placement (4, 4) on link number `link`.
    parameters, covariance
        Physically consistent parameters (10,) in `frame`, in the order of `LinkInertia`, and their
        covariance (10, 10).
    values, std_errors
        Mass, centre and inertia (10,) in the order of `names`, with standard errors.
    noise_errors, gain_errors
        Parts of the standard errors by the scatter of time blocks, and by uncertain gains.
    gain_slopes
        Change of each value per relative change of a joint's torque in all recordings, (10, n).
    gain_uncertainty
        Standard deviations of the gains as fractions (n,).
    gains_by_evidence
        Whether the slopes are exact, by the cause data of the result; else they assume that the arm
        was identified along the present motion, which may understate the error of the centre.
    gains_in_doubt
        Joints whose gravity torque in the result is so far from CAD's that gains are doubted.
    projected
        Whether the least-squares estimate was inconsistent and the nearest consistent one replaced
        it.
    determined, not_determined
        Names with and without a small standard error.
    arm
        Base parameters of the arm that were used (p,).
    n_samples, torque_source
        Of the loaded recordings.
    frames
        Placement (4, 4) in `frame` of the other frames of the same link, by name: makers take a
        payload in one of them.
    metrics, metrics_bare
        Torque errors on each recording with the payload, and of the arm alone.
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
    gains_in_doubt: tuple[str, ...]
    projected: bool
    determined: tuple[str, ...]
    not_determined: tuple[str, ...]
    arm: Array
    n_samples: int
    torque_source: TorqueSource
    metrics: tuple[TorqueMetrics, ...]
    metrics_bare: tuple[TorqueMetrics, ...]
    names: tuple[str, ...] = PAYLOAD_NAMES
    frames: Mapping[str, Array] = field(default_factory=dict)

    def __repr__(self) -> str:
        shown = ", ".join(
            f"{name} {format_plus_minus(value, error)}"
            for name, value, error in zip(
                self.names[:4], self.values.tolist(), self.std_errors.tolist(), strict=False
            )
        )
        return f"Payload({self.robot} at {self.frame}: {shown})"

    def _repr_html_(self) -> str:
        """Return a table of all values with their standard errors for notebooks."""
        rows = zip(self.names, self.values.tolist(), self.std_errors.tolist(), strict=True)
        cells = tuple(
            (name, *round_with_error(value, error), "yes" if name in self.determined else "NO")
            for name, value, error in rows
        )
        heads = (
            Column("parameter"),
            Column("estimate", "SI", "decimal"),
            Column("std err", align="decimal"),
            Column("determined"),
        )
        return Table(heads, cells, f"{self.robot}: payload at {self.frame}").as_html()

    @property
    def inertia(self) -> LinkInertia:
        """Inertial parameters of the payload in its frame."""
        return LinkInertia(self.parameters)


def choose_payload_frame(model: RobotModel, name: str | None = None) -> tuple[str, int, Array]:
    """Return name, link and placement of the frame that carries the payload.

    By default the flange, or the link that carries a tool (`RobotModel.tool_link`). Raises
    `UsageError` if no moving link or frame has that name.
    """
    frames = model.moving_places
    if name is not None:
        if name not in frames:
            raise UsageError(
                f"{model.name} has no moving link or frame {name!r}; available: {', '.join(frames)}"
            )
        return name, *frames[name]
    last = model.tool_link
    for word in FLANGES:
        for frame, (link, placement) in frames.items():
            if link == last and word in (
                re.split(r"[^a-z0-9]+", frame.lower())
                if len(word) <= PAYLOAD_SHORT_WORD
                else frame.lower()
            ):
                return frame, link, placement
    return model.link_names[last], last, np.eye(4)


def identify_payload_samples(
    result: IdentificationResult,
    loaded: Samples | Sequence[Samples],
    *,
    unloaded: Sequence[Samples] = (),
    frame: str | None = None,
    arm: Arm = "refined",
    validation: Sequence[Samples] = (),
    gain_uncertainty: ArrayLike | None = None,
) -> Payload:
    """Identify the payload at the flange from samples under load.

    The loaded torque is `tau = Y_b beta + Y_l S pi`: base parameters of the arm, and the ten
    parameters of the payload as part of the last link. Rows are weighted by the result's noise per
    joint. The covariance is the sum of a delete-one-block jackknife, which allows for correlated
    residuals (Efron & Stein, Annals of Statistics 9, 1981), of the result's covariance, and of
    uncertain gains, which recordings without a known load do not determine. An inconsistent
    estimate is replaced by the nearest consistent one in the metric of the covariance, by a
    semidefinite program. Load-dependent friction includes the payload.

    Parameters
    ----------
    result
        The identified arm.
    loaded, unloaded
        Samples with the payload, and further ones of the bare arm.
    frame
        Frame that carries the payload, by default the flange.
    arm
        `"frozen"` takes beta from the result; `"refined"` estimates beta and pi together, with the
        result and its covariance as prior.
    validation
        Samples for the torque errors, by default the loaded ones.
    gain_uncertainty
        Standard deviation of the gains as a fraction, one or one per joint; the default depends on
        the torque source, zero for sensors.

    Raises
    ------
    UsageError
        If there are no samples, no frame of that name, or invalid uncertainties.
    IdentifiabilityError
        If there are fewer samples than unknowns, or the motion does not determine a mass.
    """
    batches = [loaded] if not isinstance(loaded, Sequence) else list(loaded)
    if not batches:
        raise UsageError(
            f"no samples of {result.robot} under load are given; expected at least one recording"
        )
    source = batches[0].torque_source
    uncertainty = derive_gain_errors(result, source, gain_uncertainty)
    name, link, placement = choose_payload_frame(result.model, frame)
    p = result.n_base
    problem = _Problem.of(result, arm)
    x = np.concatenate([result.estimates, np.zeros(10)])
    for _ in range(PAYLOAD_LOAD_ITERATIONS if result.base.drive.needs_load else 1):
        rows = PayloadRows.of(result, batches, unloaded, link, shift_matrix(placement), x)
        with use_one_blas_thread():
            x, carried = problem.solve(rows.blocks)
    with use_one_blas_thread():
        noise = problem.jackknife(rows.blocks) + carried
        slopes = problem.derive_gain_slopes(result, rows)
    gains = slopes @ gain_covariance(uncertainty) @ slopes.T
    beta = x[:p]
    estimate = x[p:]
    if not estimate[9] > 0:
        raise _refuse_mass(result.robot, name, estimate, np.sqrt(np.diag(noise + gains)))
    parameters, projected = _find_nearest_body(estimate, noise + gains)
    values, reported = _derive_reported_values(parameters, noise + gains)
    errors, noise_errors, gain_errors = (
        np.sqrt(np.maximum(np.diag(reported @ part @ reported.T), 0.0))
        for part in (noise + gains, noise, gains)
    )
    determined = tuple(np.array(PAYLOAD_NAMES)[_find_determined(values, errors)].tolist())
    added = np.zeros(10 * result.model.n_links)
    added[10 * link : 10 * link + 10] = shift_matrix(placement) @ parameters
    tested = list(validation) or batches
    return Payload(
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
        gains_in_doubt=name_doubtful_gains(result, source) if gain_uncertainty is None else (),
        projected=projected,
        determined=determined,
        not_determined=tuple(name for name in PAYLOAD_NAMES if name not in determined),
        arm=beta,
        n_samples=rows.n_samples,
        torque_source=source,
        metrics=tuple(_measure_torque_error(result, samples, beta, added) for samples in tested),
        metrics_bare=tuple(
            _measure_torque_error(result, samples, result.estimates, None) for samples in tested
        ),
        frames=_place_other_frames(result.model, name, link, placement),
    )


def _place_other_frames(
    model: RobotModel, name: str, link: int, placement: Array
) -> dict[str, Array]:
    """Return the placements (4, 4) of the link's other frames in the frame of the payload."""
    back = invert_placement(placement)
    return {
        frame.name: back @ frame.placement
        for frame in model.frames
        if frame.link == link and frame.name != name
    }


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    """Find what rows `[W | P | tau]` leave unknown: arm and payload, or a frozen arm's payload.

    Parameters
    ----------
    estimates
        The arm by the result (p,).
    prior, vague
        Rows (m, p + 11) of the result as prior of the arm, and (10, p + 11) of the payload.
    frozen
        Whether the arm is the result's.
    """

    estimates: Array
    prior: Array
    vague: Array
    frozen: bool

    @classmethod
    def of(cls, result: IdentificationResult, arm: Arm) -> _Problem:
        """Return the problem of a result's arm.

        The result is a prior of the arm in units of its standard errors; dropped parameters, whose
        columns are zero elsewhere, are held at zero. The payload is zero +- the arm's mass at half
        a metre: it matters only in undetermined directions, whose errors become as large.
        """
        p = result.n_base
        determined = scale_covariance(result).inverse_root.T
        root = np.vstack([determined, np.eye(p)[result.dropped]])
        prior = np.column_stack([root, np.zeros((len(root), 10)), root @ result.estimates])
        mass = float(np.abs(result.model.parameters[9::10]).sum()) or 1.0
        size = mass * np.repeat([PAYLOAD_VAGUE_ARM**2, PAYLOAD_VAGUE_ARM, 1.0], [6, 3, 1])
        vague = np.column_stack([np.zeros((10, p)), np.diag(1.0 / size), np.zeros(10)])
        return cls(result.estimates, prior, vague, arm == "frozen")

    @property
    def held(self) -> Array:
        """Rows of what is unknown that hold it beforehand."""
        return self.reduce(self.vague if self.frozen else np.vstack([self.prior, self.vague]))

    def reduce(self, rows: Array) -> Array:
        """Return rows of what is unknown; the torque of a frozen arm is subtracted."""
        if not self.frozen:
            return rows
        p = len(self.estimates)
        return np.column_stack([rows[:, p:-1], rows[:, -1] - rows[:, :p] @ self.estimates])

    def solve(self, blocks: Sequence[Array]) -> tuple[Array, Array]:
        """Return [beta, pi], and the covariance (10, 10) of pi by the priors.

        Undetermined directions of the arm stay at the result's estimates.
        """
        p = len(self.estimates)
        data = triangular_factor(np.vstack(blocks))
        rows = self.reduce(data)
        self._check_determined(data)
        start = np.zeros(10) if self.frozen else np.append(self.estimates, np.zeros(10))
        solution = solve_factor(triangular_factor(np.vstack([self.held, rows])), len(data), start)
        spread = solution.inverse_root @ solution.inverse_root.T
        carried = (spread @ self.held[:, :-1].T)[-10:]
        if self.frozen:
            of_arm = data[:, :p] @ np.linalg.pinv(self.prior[:, :p])
            carried = np.column_stack([spread @ rows[:, :-1].T @ of_arm, carried])
        arm = self.estimates if self.frozen else solution.x[:p]
        return np.concatenate([arm, solution.x[-10:]]), carried @ carried.T

    def _check_determined(self, data: Array) -> None:
        """Raise `IdentifiabilityError` if rows determine less than a mass and its centre."""
        p = len(self.estimates)

        def find_rank(rows: Array) -> int:
            return solve_factor(triangular_factor(rows), len(data)).rank

        if self.frozen:
            _check_known_arm(data[:, :p], self.prior[:, :p])
            rank = find_rank(self.reduce(data))
        else:
            both = np.vstack([self.prior, data])
            rank = find_rank(both) - find_rank(np.delete(both, slice(p, p + 10), axis=1))
        if rank < 4:
            raise IdentifiabilityError(
                f"the recording under load determines {max(rank, 0)} of the payload's ten"
                " parameters, fewer than its mass and centre",
                cure=Cure(
                    "move the arm through different poses, so that the payload's weight acts on"
                    " several joints"
                ),
            )

    def jackknife(self, blocks: Sequence[Array]) -> Array:
        """Return the covariance (10, 10) of pi from leaving out one time block at a time."""
        n = len(blocks)
        if n < FEWEST_BLOCKS:
            raise IdentifiabilityError(
                f"{n} time blocks are too few for the errors of a payload, {FEWEST_BLOCKS} are"
                " needed",
                cure=Cure("record longer"),
            )
        without = solve_without_blocks([self.reduce(block) for block in blocks], self.held)
        return jackknife_covariance(without)[-10:, -10:]

    def derive_gain_slopes(self, result: IdentificationResult, rows: PayloadRows) -> Array:
        """Return the change of pi (10, n) per relative change of each joint's torque everywhere.

        pi is linear in all torques; joint k's enters the result's beta, and the rows of joint k.
        """
        p = result.n_base
        of_arm = split_by_joint(result, rows.joints, result.weights)
        sides = np.column_stack([joint[:, :-1].T @ joint[:, -1] for joint in rows.joints])
        grams = [block[:, :-1].T @ block[:, :-1] for block in (*rows.blocks, self.vague)]
        matrix = np.sum(grams, axis=0)
        if self.frozen:
            return Scaled(matrix[p:, p:]).solve(sides[p:] - matrix[p:, :p] @ of_arm)
        held = self.prior[:, :-1].T @ self.prior[:, :-1]
        return Scaled(matrix + held).solve(sides + held[:, :p] @ of_arm)[p:]


def _refuse_mass(robot: str, frame: str, estimate: Array, errors: Array) -> IdentifiabilityError:
    """Return why a payload (10,) with these standard errors has no mass.

    A mass that is zero within its error is undetermined, as at a wrist whose position the weight
    does not change: then it is said what is determined. One that is surely negative is an error of
    the log or of the arm.
    """
    size = f"{format_plus_minus(estimate[9], errors[9])} kg"
    if -estimate[9] > SIGNIFICANT_SIGMAS * errors[9]:
        return IdentifiabilityError(
            f"the payload of {robot} at {frame} has an estimated mass of {size}; expected a"
            " positive mass",
            cure=Cure(
                "check that the recording is loaded, and that torque sign, gains and units agree"
                " with the arm's result"
            ),
        )
    moments = [
        f"m{axis} {format_plus_minus(1e3 * moment, 1e3 * error)} g m"
        for axis, moment, error in zip("xyz", estimate[6:9], errors[6:9], strict=True)
        if abs(moment) > SIGNIFICANT_SIGMAS * error
    ]
    seen = f"its first moments are: {join_names(moments)}" if moments else "nor its first moments"
    return IdentifiabilityError(
        f"the recording does not determine the mass of the payload of {robot} at {frame}"
        f" ({size}); {seen}",
        cure=Cure(
            "ask for what a weight adds to the first moments of a link",
            settings={"moments": True},
            call="workflow.identify_moments",
        ),
    )


def _check_known_arm(rows: Array, prior: Array) -> None:
    """Raise `IdentifiabilityError` if rows (m, p) excite what the prior (k, p) leaves free."""
    size = np.linalg.norm(np.vstack([prior, rows]), axis=0)
    scaled = np.where(size > 0.0, size, 1.0)
    _, s, vt = np.linalg.svd(prior / scaled)
    free = vt[int(np.sum(s > PAYLOAD_OPEN * s.max(initial=0.0))) :]
    if np.linalg.norm(rows / scaled @ free.T) > np.sqrt(PAYLOAD_OPEN) * np.linalg.norm(
        rows / scaled
    ):
        raise IdentifiabilityError(
            "the recording under load excites directions that the result of the arm does not"
            " determine, so that a frozen arm cannot predict it",
            cure=Cure(
                "refine the arm, or identify it again from a motion with more excitation",
                settings={"arm": "refined"},
            ),
        )


def _find_nearest_body(estimate: Array, covariance: Array) -> tuple[Array, bool]:
    """Return the nearest consistent parameters by the covariance, and whether they differ."""
    if LinkInertia(estimate).is_consistent:
        return estimate, False
    own = Scaled(covariance).raised()
    root = own.inverse_root.T
    scale = own.size
    floor = PAYLOAD_INTERIOR * float(np.abs(estimate[9]))
    solution = solve_cone_program(
        -2.0 * (root * scale).T @ (root @ estimate),
        -PSEUDO_INERTIA_SVEC * scale,
        -floor * IDENTITY_SVEC,
        [clarabel.PSDTriangleConeT(4)],
        quadratic=sparse.csc_matrix(np.triu(2.0 * (root * scale).T @ (root * scale))),
    )
    if not solution.is_solved:
        raise IdentifiabilityError(
            f"the consistent fit of the payload estimate {estimate.tolist()} failed with solver"
            f" status {solution.status}"
        )
    return solution.x * scale, True


def _derive_reported_values(parameters: Array, covariance: Array) -> tuple[Array, Array]:
    """Return mass, centre and inertia about it (10,), and their derivatives (10, 10)."""

    def report(pi: Array) -> Array:
        body = LinkInertia(pi)
        return np.concatenate([[body.mass], body.com, body.inertia_about_com[np.triu_indices(3)]])

    step = 1e-6 * np.maximum(np.sqrt(np.diag(covariance)), 1e-9)
    slope = np.column_stack(
        [
            (report(parameters + h) - report(parameters - h)) / (2 * h[k])
            for k, h in enumerate(np.diag(step))
        ]
    )
    return report(parameters), slope


def _find_determined(values: Array, errors: Array) -> NDArray[np.bool_]:
    centre = np.maximum(np.linalg.norm(values[1:4]), PAYLOAD_COM_SCALE)
    principal = np.max(np.abs(values[[4, 7, 9]]))
    size = np.concatenate([[values[0]], np.full(3, centre), np.full(6, principal)])
    return errors <= LARGEST_ERROR * size


def _measure_torque_error(
    result: IdentificationResult, samples: Samples, beta: Array, added: Array | None
) -> TorqueMetrics:
    """Return the torque error of an arm (and of parameters added to its links) on a recording."""
    prediction = predict_torque(result.model, result.base, beta, samples, added=added)
    return torque_metrics(
        prediction.measured, prediction.predicted, samples.source, result.joint_names
    )
