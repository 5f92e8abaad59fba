"""Effects: what a description can lack, the torque that each would add, and which a user wants."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Literal, cast

import numpy as np

from asbuilt.arrays import Array, Indices
from asbuilt.description.model import RobotModel
from asbuilt.dynamics import BaseParameters, DriveSet, DriveTerm
from asbuilt.dynamics.drives.drive_set import NO_DRIVE, available_terms
from asbuilt.errors import UsageError
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
    """Whether a model can have it; others are named. A family with columns of its own is put into a
    model only as a drive term (`DriveEffect`, made of every term), or if it is `removable`."""
    in_bodies: ClassVar[bool] = False
    """Whether it is a part of the bodies, which every model has, without columns of its own."""
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
    """Register a family of effects.

    Raises
    ------
    UsageError
        If it would be in a model that has no place for its columns.
    """
    if family.in_model and not (family.removable or family.in_bodies):
        raise UsageError(
            f"effect {family.key!r} is to be in the model (in_model), which has no place for its"
            " columns: register a drive term instead, or leave in_model out, so that it is named",
            value=family.key,
        )
    # A family that imitates no other is a kind of its own.
    family.kind = family.kind or family.key
    EFFECTS.register(family.key, family())
    return family


LINKS = "links"
GROUPS: dict[str, str] = {
    "friction": "friction",
    "offset": "torque offset",
    "armature": "armature",
    LINKS: "mass distribution of the links",
}
"""Names of effects that are no family of their own, but parameters that every model has."""


def name_group(key: str) -> str:
    """Return the name of a group or an effect in sentences.

    >>> name_group("links"), name_group("tilt")
    ('mass distribution of the links', 'base tilt')
    """
    return GROUPS[key] if key in GROUPS else EFFECTS[key].title if key in EFFECTS else key


def find_group(term: DriveTerm) -> str:
    """Return the group of a drive term: what acts over position is an effect of its own."""
    return term.cause or (term.key if term.by_position else "friction")


def find_places(base: BaseParameters, key: str | None, k: int) -> Indices:
    """Return the positions of a drive term's base parameters at a joint (from 0)."""
    symbols = [s for term in base.drive.terms if term.key == key for s in term.symbols]
    names = {f"{symbol}{k + 1}" for symbol in symbols}
    return np.array([j for j, name in enumerate(base.names) if name in names], dtype=np.int64)


def locate_drive_parameters(base: BaseParameters, joint: int) -> dict[str, list[int]]:
    """Return where the drive parameters of a joint (from 0) are among the base parameters."""
    groups: dict[str, list[int]] = {}
    for term in base.drive.terms:
        groups.setdefault(find_group(term), []).extend(find_places(base, term.key, joint).tolist())
    return {group: places for group, places in groups.items() if places}


TILT = "tilt"
Choice = Literal["auto", "find", "none", "list"]


@dataclass(frozen=True, slots=True)
class EffectsWanted:
    """Say which effects become part of the model.

    Parameters
    ----------
    choice
        All that the recordings show ("auto"), none but these are named ("find"), none ("none"), or
        what is listed ("list").
    drive
        Drive terms of a list.
    tilt
        Whether a list has the base tilt.
    """

    choice: Choice = "auto"
    drive: DriveSet = NO_DRIVE
    tilt: bool = False

    @property
    def named(self) -> bool:
        """Whether what the recordings show is named."""
        return self.choice != "none"

    @classmethod
    def parse(cls, text: str) -> EffectsWanted:
        """Read "auto", "find", "none" or a list of effects, with joints where they have some.

        >>> EffectsWanted.parse("spring:joints=2,tilt")
        EffectsWanted(choice='list', drive=..., tilt=True)

        Raises
        ------
        UsageError
            For effects that a model cannot have.
        """
        word = text.strip().lower()
        if word in ("auto", "find", "none"):
            return cls(cast(Choice, word))
        parts = [part.strip() for part in word.split(",") if part.strip()]
        terms = [part for part in parts if part != TILT]
        if not parts or "none" in parts or "find" in parts or "auto" in parts:
            raise UsageError(
                f"effects {text!r} are neither auto, find or none nor a list of effects, such as"
                " spring:joints=2,tilt",
                value=text,
            )
        for part in terms:
            _refuse_without_place(part.partition(":")[0])
        return cls("list", DriveSet.parse(terms) if terms else DriveSet(), TILT in parts)

    def __str__(self) -> str:
        listed = (*self.drive.specifications, *([TILT] if self.tilt else []))
        return ",".join(listed) if self.choice == "list" else self.choice


def _refuse_without_place(key: str) -> None:
    """Refuse an effect that no list can put into a model, with where it belongs."""
    if key in available_terms():
        return

    effect = EFFECTS.get(key)
    if effect is None:
        return
    if key == TILT:
        why = "is one of the whole robot, and takes no joints"
    elif effect.of_log:
        why = "is an error of the log, which no model has; correct it in a recording sheet"
    elif effect.in_model:
        why = "is part of the bodies, which every model has; it is named where CAD lacks it"
    else:
        why = "has no place in a model; it is named where recordings show it"
    raise UsageError(f"effect {key!r} ({effect.title}) {why}", value=key)
