"""Effects: what a description can lack, the torque that each would add, and what was found."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics import BaseParameters, DriveSet, DriveTerm
from asbuilt.experiment.signal.samples import Samples
from asbuilt.findings import Cure, Finding
from asbuilt.identification.result.torque_prediction import parameter_torque
from asbuilt.registry import Registry
from asbuilt.tables import format_plus_minus, round_significant

CORRECT = Cure("check the log, and correct it in a recording sheet")


@dataclass(frozen=True, slots=True)
class FoundEffect:
    """Hold an effect that the description lacks and the recordings show.

    Parameters
    ----------
    effect, joint
        Key of the effect, and the joint it acts at; None: the whole robot.
    estimate, std_error, unit
        Its size; of several parameters the length of their vector. Without a standard error where
        the recordings do not determine it by itself: then it is what was chosen.
    in_model
        Whether the model of the result has it.
    torque
        RMS torque that it adds at its joint, of all joints together without one [N m or N].
    error_before, error_after
        Relative torque error on held-out groups of different motion, without and with it.
    alternatives
        Other effects that explain the recordings as well: such as `spring at elbow`.
    text
        A sentence.
    feasible
        Least and greatest size over physically consistent bodies, where it is not determined.
    confounded_with
        Standard parameters that take its place unseen.
    """

    effect: str
    joint: str | None
    estimate: float
    std_error: float | None
    unit: str
    in_model: bool
    torque: float
    error_before: float
    error_after: float
    alternatives: tuple[str, ...]
    text: str
    feasible: tuple[float, float] | None = None
    confounded_with: tuple[str, ...] = ()

    @property
    def improvement(self) -> str:
        """The torque error without and with it, as text."""
        before, after = (
            round_significant(100 * error, 2) for error in (self.error_before, self.error_after)
        )
        return f"torque error {before} -> {after} %"


@dataclass(frozen=True, eq=False)
class Described:
    """Hold the robot whose effects are searched: model, drive terms, values and torque source.

    `base` are its base parameters with its drive terms, `chi` standard parameters near the
    recording in their order, `speeds` the velocities recorded, each (N, n), `largest` (n,) the
    torques that nearly all samples keep, `clock_bound` the share by which velocities let the clock
    be wrong.
    """

    model: RobotModel
    base: BaseParameters
    chi: Array
    source: str
    speeds: tuple[Array, ...]
    largest: Array
    clock_bound: float = np.inf

    @property
    def drive(self) -> DriveSet:
        """The drive terms."""
        return self.base.drive


@dataclass(frozen=True, eq=False)
class Motion:
    """Hold states (L, n) of a robot on a span of samples, and what its model makes of them.

    `elapsed` (L,) runs from -1/2 at the start of the recording to 1/2 at its end; the samples, at
    `rate` [Hz], are without gaps.
    """

    robot: Described
    rate: float
    q: Array
    qd: Array
    qdd: Array
    elapsed: Array

    def torque_of(self, q: Array, qd: Array, qdd: Array) -> tuple[Array, Array]:
        """Return the torque of the rigid bodies and of the whole model in other states, (L, n)."""
        robot = self.robot
        return parameter_torque(robot.model, robot.drive, robot.chi, q, qd, qdd)

    @cached_property
    def torques(self) -> tuple[Array, Array]:
        """Torque of the rigid bodies and of the whole model, (L, n) each."""
        return self.torque_of(self.q, self.qd, self.qdd)

    def within(self, span: slice) -> Motion:
        """Return the motion on a part of the span, whose torques are taken from here."""
        state = self.q[span], self.qd[span], self.qdd[span]
        part = Motion(self.robot, self.rate, *state, self.elapsed[span])
        rigid, whole = self.torques
        # A cached property reads the instance's dict first: filled here, a part costs no recursion.
        vars(part)["torques"] = rigid[span], whole[span]
        return part


@dataclass(frozen=True, slots=True, eq=False)
class Variant:
    """Describe an effect with its nonlinear parameters at trial values.

    A variant with `joint` None and `local` is tried at every joint in `joints` by columns that
    hold each joint's own values; other columns act on the torques of all joints.
    """

    effect: Effect
    n_columns: int
    local: bool
    joint: int | None = None
    joints: tuple[int, ...] = ()
    term: DriveTerm | None = None
    trial: float = 0.0


class Effect(ABC):
    """Describe a family of effects: where it can act, and by which columns of torque.

    The torque that the model lacks is `columns @ values`; a nonlinear effect is linearised about
    the present estimate.
    """

    key: ClassVar[str]
    """Name in `--effects`, JSON and texts."""
    title: ClassVar[str]
    """Name in sentences."""
    kind: ClassVar[str] = ""
    """What it is a form of, such as torque over position; a joint has one effect of a kind."""
    imitators: ClassVar[tuple[str, ...]] = ()
    """Kinds that imitate, at its joint and the one before, what its columns leave of it."""
    in_model: ClassVar[bool] = False
    """Whether a model can have it; others are named."""
    of_log: ClassVar[bool] = False
    """Whether the log is wrong rather than the model."""
    usual: ClassVar[float] = 0.0
    """Size of each value that any robot may have, whether its log shows one or not; 0: it has none
    that the log does not show."""
    least: ClassVar[float] = 0.0
    """Size below which it is of no account."""
    positive: ClassVar[bool] = False
    """Whether only positive values are physical."""
    removable: ClassVar[bool] = False
    """Whether robot or log can be had without it (`without`): Newton's steps then find its values,
    since its columns hold for small ones alone."""
    of_shares: ClassVar[bool] = False
    """Whether its value is a share, so that steps multiply."""
    settled: ClassVar[float] = 1e-3
    """Step [rad, m or share] after which the next is of its square."""
    farthest: ClassVar[float] = np.inf
    """Largest size that a robot in use can have."""
    shown: ClassVar[float] = 0.0
    """Size that every log should show; 0: no finding reports that it is unseen."""
    by_span: ClassVar[bool] = False
    """Whether its columns at an instant depend on the samples of the span around it."""
    starts: ClassVar[tuple[float, ...]] = ()
    """Further values from which it is searched, where it can be off by factors."""
    units: ClassVar[tuple[str, str]] = ("", "")
    """Unit of its size at a revolute and at a prismatic joint."""

    def size(self, values: Array, covariance: Array, *, revolute: bool) -> tuple[float, float, str]:
        """Return size, standard error and unit of its values (m,) with their covariance."""
        # One parameter keeps its sign; several have only a length.
        size = float(np.linalg.norm(values)) if len(values) > 1 else float(values[0])
        # Gradient of the length, for the error to first order; at zero every direction is as good.
        slope = values / size if size else np.ones(len(values)) / len(values)
        # Rounding can leave the variance of a nearly undetermined size just below zero.
        variance = max(float(slope @ covariance @ slope), 0.0)
        return size, float(np.sqrt(variance)), self.unit(revolute)

    def found(
        self,
        joint: str | None,
        values: Array,
        covariance: Array,
        *,
        revolute: bool,
        in_model: bool,
        torque: float,
        errors: tuple[float, float],
        alternatives: tuple[str, ...] = (),
        parts: Sequence[str] = (),
    ) -> FoundEffect:
        """Return what was found of it; `errors` are torque errors without and with it.

        `parts` name its values, where they have names (`name_parts`).
        """
        size = self.size(values, covariance, revolute=revolute)
        bare = FoundEffect(self.key, joint, *size, in_model, torque, *errors, alternatives, text="")
        where = f"{self.title} at {joint}" if joint else self.title
        text = self.size_text(values, covariance, revolute=revolute)
        errors_of_parts = np.sqrt(np.maximum(np.diag(covariance), 0.0)).tolist()
        named = zip(parts, values.tolist(), errors_of_parts, strict=True) if parts else ()
        listed = ", ".join(filter(None, (self.part_text(*part) for part in named)))
        return replace(
            bare, text=f"{where} {text}{f' ({listed})' if listed else ''}: {bare.improvement}"
        )

    def name_parts(self, joint_names: Sequence[str], joint: int | None) -> tuple[str, ...]:
        """Return the names of its values at a joint (from 0), if they have any."""
        return ()

    def part_text(self, name: str, value: float, error: float) -> str:
        """Return one of its values with its name as text, empty where it is of no account."""
        return ""

    def size_text(self, values: Array, covariance: Array, *, revolute: bool) -> str:
        """Return the size with its standard error and unit as text."""
        size, error, _ = self.size(values, covariance, revolute=revolute)
        return self.text_of(size, error, revolute=revolute)

    def text_of(self, size: float, error: float | None, *, revolute: bool) -> str:
        """Return a size with its standard error, else with two digits, and unit as text."""
        scale, unit = self.shown_in(revolute)
        size *= scale
        text = (
            round_significant(size, 2) if error is None else format_plus_minus(size, scale * error)
        )
        return f"{text} {unit}".rstrip()

    def shown_in(self, revolute: bool) -> tuple[float, str]:
        """Return the factor and the unit in which its size is read: shares in percent."""
        return (100.0, "%") if self.of_shares else (1.0, self.unit(revolute))

    def unit(self, revolute: bool) -> str:
        """Return the unit of its size at a revolute or prismatic joint."""
        return self.units[not revolute]

    def is_possible(self, values: Array, joint: int | None, robot: Described) -> bool:
        """Return whether a robot in use can have these values, large enough to matter."""
        # The norm is at least 0 even for a negative parameter: its sign is asked for apart.
        size = float(np.linalg.norm(values))
        positive = not self.positive or bool(np.all(values > 0.0))
        return self.least <= size <= self.farthest and positive

    def without(
        self, model: RobotModel, samples: Sequence[Samples], joint: int | None, values: Array
    ) -> tuple[RobotModel, list[Samples]]:
        """Return a robot and samples without the effect of these values at a joint (from 0)."""
        raise NotImplementedError

    def advanced(self, values: Array, step: Array) -> Array:
        """Return the values after a step about what they leave."""
        # Columns of a share are per relative change of what earlier steps left: steps multiply.
        return np.asarray((1.0 + values) * (1.0 + step) - 1.0 if self.of_shares else values + step)

    def finding(self, found: FoundEffect, model: RobotModel) -> Finding | None:
        """Return what can be done about the effect where a model cannot have it, if anything."""
        if not self.of_log:
            return None
        message = f"Not in the model: {found.text}"
        return Finding("effect_found", "warning", message, CORRECT, joint=found.joint)

    def unseen(self, sizes: str) -> Finding:
        """Return the finding that a log does not show it below some sizes."""
        raise NotImplementedError

    @abstractmethod
    def variants(self, robot: Described) -> Iterator[Variant]:
        """Yield the variants that this robot can have."""

    @abstractmethod
    def columns(self, variant: Variant, motion: Motion) -> list[Array]:
        """Return the columns of a variant on a span, (L, n) each."""


EFFECTS: Registry[Effect] = Registry(
    "effect", "asbuilt.identification.effects.families", "asbuilt.effects"
)


def effect(family: type[Effect]) -> type[Effect]:
    """Register a family of effects."""
    # A family that imitates no other is a kind of its own.
    family.kind = family.kind or family.key
    EFFECTS.register(family.key, family())
    return family
