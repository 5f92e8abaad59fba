"""A designed motion: its information about base parameters, what was maximised, and findings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics import BaseParameters, TorqueModel, described_drive
from asbuilt.errors import UsageError
from asbuilt.excitation.collision.constraint import skeleton_distance
from asbuilt.excitation.design.design_options import DesignOptions
from asbuilt.excitation.design.interior_point import Evaluation, MotionProgram
from asbuilt.excitation.design.static_poses import StaticDesign
from asbuilt.excitation.information.information import (
    Criterion,
    Information,
    mean_information,
)
from asbuilt.excitation.information.information_bound import InformationBound
from asbuilt.excitation.limits import (
    LimitReport,
    MotionBounds,
    check_motion,
    complete_limits,
)
from asbuilt.excitation.motions.motion import JUMPING, Motion, check_limit_array
from asbuilt.excitation.motions.parametrisation import Parametrisation
from asbuilt.excitation.motions.point_to_point import CHECK_RATE
from asbuilt.excitation.state_constraint import PowerLimit, StateConstraint, smallest_distance
from asbuilt.findings import Cure, Finding, join_names, rank_findings
from asbuilt.scaled import Scaled


@dataclass(frozen=True, eq=False)
class Objective:
    """Evaluate `criterion(S (n_samples mean + prior) S)`, S the diagonal of `scale`.

    `scale` (p,) are units for the parameters, `n_samples` the independent samples of the motion,
    `prior` (p, p) information from earlier recordings.
    """

    information: Information
    criterion: Criterion
    scale: Array
    n_samples: float
    prior: Array | None = None

    def scaled(self, mean: Array) -> Array:
        """Return the whole information in units of `scale`."""
        total = self.n_samples * mean
        if self.prior is not None:
            total = total + self.prior
        return total * np.outer(self.scale, self.scale)

    def value(self, mean: Array) -> float:
        """Return the criterion of the mean information per sample (p, p)."""
        return self.criterion.value(self.scaled(mean))

    def value_and_gradient(self, mean: Array) -> tuple[float, Array]:
        """Return the criterion and its derivative with respect to the mean information."""
        value, gradient = self.criterion.value_and_gradient(self.scaled(mean))
        # Chain rule through scaling: d f / d mean.
        return value, self.n_samples * gradient * np.outer(self.scale, self.scale)


class DesignProgram(MotionProgram):
    """Maximise an objective over the coefficients of a family of motions.

    Nodes are the midpoints of equal intervals.
    """

    def __init__(
        self,
        objective: Objective,
        family: Parametrisation,
        bounds: MotionBounds,
        n_nodes: int,
        constraints: tuple[StateConstraint, ...] = (),
        tightening: float = 0.0,
        margin: float = 0.0,
    ) -> None:
        self.objective = objective
        self.family = family
        self.constraints = constraints
        self.margin = margin
        # Midpoints: no node counts the end of a period twice.
        t = (np.arange(n_nodes) + 0.5) * family.span / n_nodes
        # Without limits of jerk its basis is not needed.
        orders = range(4 if np.any(np.isfinite(bounds.jerk)) else 3)
        self.bases = tuple(family.basis(t, order) for order in orders)
        symmetric = np.stack([bounds.velocity, bounds.acceleration, bounds.jerk])[
            # Derivatives have symmetric limits, positions a range about its centre.
            : len(self.bases) - 1
        ]
        self.half = (1 - tightening) * np.vstack([(bounds.upper - bounds.lower) / 2, symmetric])
        self.centre = np.vstack([(bounds.upper + bounds.lower) / 2, np.zeros_like(symmetric)])

    def evaluate(self, q: Array, qd: Array, qdd: Array) -> Evaluation:
        """Return the objective of the motion."""
        information = self.objective.information
        rows = information.rows(q, qd, qdd)
        value, sensitivity = self.objective.value_and_gradient(
            # The mean per sample: information does not grow with the nodes.
            information.matrix(rows, len(q)) / len(q)
        )
        return Evaluation(
            value, lambda: information.state_gradient(q, qd, qdd, rows, sensitivity / len(q))
        )


@dataclass(frozen=True, slots=True)
class DurationTrial:
    """A duration that was tried, and the precision that its motion would give."""

    duration: float
    size: int
    periods: int
    precision: float


@dataclass(frozen=True, eq=False, repr=False)
class Design:
    """A designed motion, its margins and its information about the base parameters.

    | field | meaning |
    |---|---|
    | `model`, `base`, `options`, `motion` | robot, base parameters, options as used, motion |
    | `noise` (n,) | standard deviation of the torque [N m or N] |
    | `size`, `size_name` | harmonics or points of the motion |
    | `mean_information` (p, p) | mean of `Y^T S^-1 Y` on a 1 kHz grid, exact drive columns |
    | `prior` (p, p) | information from earlier recordings |
    | `bound`, `family_bound` | bounds over all states, and over states of a Fourier series |
    | `limits`, `assumed` | margins on the grid; limits that the description lacks |
    | `collision_distance` | smallest distance between bodies [m], None if unchecked |
    | `value`, `candidates` | criterion of the motion and of all local optima |
    | `solve_seconds`, `interrupted`, `notes` | how the search went |
    | `trials` | durations tried for a wanted precision |
    """

    model: RobotModel
    base: BaseParameters
    options: DesignOptions
    motion: Motion
    noise: Array
    size: int
    size_name: str
    mean_information: Array
    prior: Array | None
    bound: InformationBound | None
    family_bound: InformationBound | None
    limits: LimitReport
    assumed: tuple[str, ...]
    collision_distance: float | None
    value: float
    candidates: tuple[float, ...]
    solve_seconds: float
    interrupted: bool
    notes: tuple[str, ...] = field(default=())
    trials: tuple[DurationTrial, ...] = field(default=())

    def __repr__(self) -> str:
        return (
            f"Design({self.model.name!r}, {self.options.parametrisation!r},"
            f" duration={self.motion.duration:g}, {self.size_name}={self.size},"
            f" log_det={self.log_det:.2f}, limits_kept={self.limits.is_respected})"
        )

    @property
    def n_samples(self) -> float:
        """Independent torque samples of each joint."""
        return self.motion.duration * self.options.information_rate

    @property
    def d_efficiency(self) -> float | None:
        """Information efficiency `exp((log det M - log det M_bound) / p)` per sample.

        The bound is an upper bound that no motion reaches; None without a bound.
        """
        return None if self.bound is None else self.bound.efficiency(self.mean_information)

    @property
    def family_efficiency(self) -> float | None:
        """Information efficiency relative to the bound for motions with these harmonics."""
        bound = self.family_bound
        return None if bound is None else bound.efficiency(self.mean_information)

    @property
    def information(self) -> Array:
        """Information of the whole motion (p, p), without the prior."""
        return self.n_samples * self.mean_information

    @property
    def log_det(self) -> float:
        """`log det` of the information of the whole motion."""
        return float(np.linalg.slogdet(self.information)[1])

    @property
    def condition_number(self) -> float:
        """Condition number of the weighted observation matrix."""
        # The information is the square of the matrix: so is its condition.
        return float(np.sqrt(np.linalg.cond(self.mean_information)))

    @property
    def scaled_condition_number(self) -> float:
        """Condition number of the weighted observation matrix with columns of unit length."""
        return float(np.sqrt(Scaled(self.mean_information).condition))

    @property
    def std_errors(self) -> Array:
        """Predicted standard errors of the base parameters (p,), prior included.

        Infinite for parameters that remain undetermined.
        """
        total = Scaled(self.information if self.prior is None else self.information + self.prior)
        return np.where(total.determined, np.sqrt(total.inverse_diagonal), np.inf)

    @cached_property
    def torque_effects(self) -> Array:
        """`std_i rms(column_i) / rms(torque)` of every base parameter (p,).

        Torques follow from the description, in units of the noise; NaN if it gives no masses.
        Unlike a relative error it is defined for parameters near zero.
        """
        # Rate at which the torque of a motion is evaluated for `torque_effects` [Hz].
        state = self.motion.at(self.motion.sample_times(100.0))
        torque = TorqueModel(self.model, *described_drive(self.model))(*state) / self.noise
        # All joints together, each in units of its noise.
        size = float(np.sqrt(np.mean((torque**2).sum(axis=1))))
        effects: Array = self.std_errors * np.sqrt(np.diag(self.mean_information))
        return effects / size if size > 0 else np.full_like(effects, np.nan)

    @property
    def precision(self) -> float:
        """Largest of `torque_effects`, over the parameters in focus if there is a focus.

        Raises `UsageError` if the description gives no masses.
        """
        effects = self.torque_effects
        if np.any(np.isnan(effects)):
            raise UsageError(
                f"the description of {self.model.name} gives no masses, so a precision relative to"
                " its torque is not defined"
            )
        chosen = [locate_base_parameter(self.base, name) for name in self.options.focus] or slice(
            None
        )
        return float(effects[chosen].max())


def describe_design(
    options: DesignOptions,
    family: Parametrisation,
    motion: Motion,
    objective: Objective,
    *,
    constraints: Sequence[StateConstraint],
    bound: InformationBound | None,
    family_bound: InformationBound | None,
    value: float,
    candidates: tuple[float, ...],
    seconds: float,
    interrupted: bool,
    notes: tuple[str, ...],
) -> Design:
    """Return the design of this motion, evaluated at 1 kHz with exact drive columns."""
    model = objective.information.model
    limited, assumed = complete_limits(model)
    count = max(1, int(motion.duration * CHECK_RATE))
    # A finer grid than the search's, so that nothing between its nodes is missed.
    states = motion.at((np.arange(count) + 0.5) * motion.duration / count)
    mean = mean_information(objective.information, *states)
    checked = [*constraints]
    if options.power:
        # Limits in front: their notes come first.
        limit = check_limit_array(options.power, model.n_joints, "power")
        checked.insert(0, PowerLimit(model, limit))
    return Design(
        model=model,
        base=objective.information.base,
        options=replace(options, duration=motion.duration),
        motion=motion,
        noise=objective.information.noise,
        size=family.size,
        size_name=family.size_name,
        mean_information=mean,
        bound=bound,
        family_bound=family_bound,
        prior=objective.prior,
        limits=check_motion(limited, motion, CHECK_RATE),
        assumed=assumed,
        collision_distance=smallest_distance(constraints, states[0]),
        value=value,
        candidates=candidates,
        solve_seconds=seconds,
        interrupted=interrupted,
        notes=(*notes, *(note for constraint in checked for note in constraint.notes(*states))),
    )


def locate_base_parameter(base: BaseParameters, name: str) -> int:
    """Return the position of a base parameter by name or id; raises `UsageError` if unknown."""
    text = name.strip()
    if text in base.names:
        return base.names.index(text)
    if text.isdigit() and int(text) in base.ids:
        return int(np.flatnonzero(base.ids == int(text))[0])
    raise UsageError(
        f"{base.robot} has no base parameter {text!r}; available:"
        f" {', '.join(f'{i} {n}' for i, n in zip(base.ids, base.names, strict=True))}"
    )


def design_findings(design: Design | StaticDesign) -> tuple[Finding, ...]:
    """Return the findings about a designed motion or static poses, the most severe first."""
    found = [
        Finding("limit_violated", "error", str(margin), joint=margin.joint, time=margin.time)
        for margin in design.limits.violations
    ]
    found.append(_report_collisions(design))
    found += [
        Finding("design_note", "warning" if note.startswith("NOT CHECKED") else "info", note)
        for note in design.notes
    ]
    found += _report_motion(design) if isinstance(design, Design) else _report_poses(design)
    return rank_findings(found)


def _report_collisions(design: Design | StaticDesign) -> Finding:
    distance = design.collision_distance
    if distance is not None:
        text = f"smallest distance between bodies {1000 * distance:.0f} mm"
        return Finding("smallest_distance", "info", text)
    text = "NOT CHECKED FOR COLLISIONS with itself, the floor or anything else"
    # Rate at which the skeleton of an unchecked motion is tested for collisions [Hz].
    poses = design.motion.derivative(design.motion.sample_times(100.0))
    own = skeleton_distance(design.model, poses)
    if own is not None:
        verb = "overlaps itself by" if own < 0 else "keeps this distance from itself:"
        text += f"; the robot's skeleton, as capsules, {verb} {abs(1000 * own):.0f} mm"
    cure = Cure("check them in the design", {"collision": "skeleton"})
    return Finding("collisions_unchecked", "warning", text, cure)


def _report_motion(design: Design) -> list[Finding]:
    undetermined = np.flatnonzero(~np.isfinite(design.std_errors))
    names = join_names([design.base.names[k] for k in undetermined])
    possible = (
        (
            undetermined.size,
            Finding(
                "parameters_undetermined",
                "warning",
                f"{undetermined.size} parameters UNDETERMINED by this motion: {names}",
                Cure(f"use more {design.size_name}, a longer motion or fewer drive terms"),
            ),
        ),
        (
            design.interrupted,
            Finding(
                "design_interrupted",
                "warning",
                f"INTERRUPTED: best of the {len(design.candidates)} searches until then",
            ),
        ),
        (
            design.assumed,
            Finding(
                "limits_assumed",
                "warning",
                f"the description lacks limits of {join_names(design.assumed)} for some joints",
                Cure("the usual ones were assumed; add the robot's own limits to the description"),
            ),
        ),
        (
            design.motion.parametrisation in JUMPING,
            Finding(
                "acceleration_jumps",
                "info",
                "the acceleration jumps; the jerk depends on the controller",
            ),
        ),
    )
    tried = [
        Finding(
            "duration_tried",
            "info",
            f"{trial.duration:g} s with {trial.size} {design.size_name}"
            + ("" if trial.periods == 1 else f" in {trial.periods} periods")
            + f" give a precision of {trial.precision:.3g} of the torque",
        )
        for trial in design.trials
    ]
    return [*(finding for holds, finding in possible if holds), *tried]


def _report_poses(design: StaticDesign) -> list[Finding]:
    # Difference in every joint below which poses are the same [rad or m].
    equal = np.ptp(design.poses, axis=0).max() < 1e-6
    turns = f"the route turns at {design.turns} further poses, without rest, to avoid obstacles"
    alike = "the poses are all the same, because gravity acts alike in every pose of this robot"
    possible = (
        (design.turns, Finding("route_turns", "info", turns)),
        (equal, Finding("poses_equal", "info", alike)),
    )
    return [finding for holds, finding in possible if holds]
