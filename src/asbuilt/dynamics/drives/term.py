"""One term of a drive's torque, linear in its parameters; what enters otherwise is a nonlinear parameter."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Hashable, Mapping
from dataclasses import KW_ONLY, dataclass, replace
from typing import Any, ClassVar, Self, cast

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import DriveValues
from asbuilt.errors import UsageError

NonlinearValue = float | tuple[float, ...] | None
"""One number for all joints, one per joint, or None: to be fitted, the default until then."""

ALL_SOURCES = ("sensor", "motor", "current", "unknown")
MOTOR_SOURCES = ("motor", "current")


@dataclass(frozen=True, slots=True)
class NonlinearParameter:
    """A number that enters the columns of a term non-linearly.

    Its name, where a fit starts, and the range it may take.

    `lower` and `upper` bound what may be stated, `credible` where a fit looks: values for which the
    term is the physics that it is named after, as fractions of the joint's top speed where the
    nonlinear parameter is a `speed`. `fitted` False keeps the default unless another value is stated. `typical`
    is a value at which the columns stand out at speeds of some rad/s, for questions of structure;
    None where the value itself decides them.
    """

    name: str
    default: float
    lower: float
    upper: float
    unit: str
    fitted: bool = True
    typical: float | None = None
    speed: bool = False
    credible: tuple[float, float] = (0.0, np.inf)


@dataclass(frozen=True, slots=True)
class DriveTerm(ABC):
    """Add `sum_c columns[c](q, qd, qdd, load) * parameter_c` to the torque of one joint.

    A term is one file in this package: a frozen dataclass without arguments in its simplest form.
    What enters the columns non-linearly (a Stribeck velocity, the width of a smooth sign) is
    declared in `nonlinear` and is a field of the same name, None by default, so that
    `dataclasses.replace` moves it. `position` places the term in the canonical order of parameters.
    `joints` are the numbers (from 1) of the joints that have the term, None for all; the parameters
    of the others never act.
    """

    _: KW_ONLY
    joints: tuple[int, ...] | None = None

    key: ClassVar[str]
    """Name used to select the term."""
    position: ClassVar[int]
    """Place in the canonical order; smaller comes first."""
    symbols: ClassVar[tuple[str, ...]]
    """One per column; the joint number follows it in parameter names."""
    revolute_units: ClassVar[tuple[str, ...]]
    prismatic_units: ClassVar[tuple[str, ...]]
    formula: ClassVar[str] = ""
    """The torque, in symbols."""
    nonlinear: ClassVar[tuple[NonlinearParameter, ...]] = ()
    default_for: ClassVar[tuple[str, ...]] = ()
    """Torque sources for which the term is among the defaults."""
    tried_for: ClassVar[tuple[str, ...]] = ()
    """Torque sources for which the term is tried beside the defaults when terms are chosen by the
    recording; its parameters are then positive.
    """
    stands_for: ClassVar[str | None] = None
    """Key of the simpler term whose place it takes then."""
    by_construction: ClassVar[bool] = False
    """Whether a robot was built with it or has it not, whatever a recording seems to say.

    It is never chosen, and part of the usual terms where the description has it.
    """
    non_negative: ClassVar[bool] = False
    """Whether no drive has parameters of it below zero.

    It is inertia, or friction that nothing beside it can take back.
    """
    ratio_powers: ClassVar[tuple[float, ...]] = ()
    """By which power of the gear ratio each parameter shrinks on its way to the motor, where that
    is not one as for torques; see `powers_of_ratio`.
    """
    turns_over: ClassVar[bool] = False
    """Whether its parameters change their sign on the way to a motor that turns against its joint.

    A torque with a direction of its own, whatever the motion.
    """
    needs_load: ClassVar[bool] = False
    """Whether the columns depend on the rigid-body torque of the joint."""
    of_motor: ClassVar[bool] = False
    """Whether the term belongs to a motor that moves several joints.

    It follows the motor's motion and enters all their torques.
    """

    @abstractmethod
    def evaluate(self, q: Array, qd: Array, qdd: Array, load: Array | None, out: Array) -> None:
        """Write the columns of one joint into `out`, shape (len(symbols), n_samples).

        The inputs have shape (n_samples,).

        `load` is the rigid-body torque [N m or N], given to terms that set `needs_load`. A term
        `of_motor` gets the motor's motion.
        """

    def functions(self) -> tuple[Mapping[Hashable, float], ...]:
        """Return each column as a sum of elementary functions, by which the base parameters know
        what different terms have in common.

        The link dynamics can imitate "qdd", "1", "sin q" and "cos q" alone; other names only tell
        terms apart.
        """
        return tuple(
            {(self.key, symbol, *(self.value(parameter.name) for parameter in self.nonlinear)): 1.0}
            for symbol in self.symbols
        )

    def units(self, *, revolute: bool) -> tuple[str, ...]:
        """Return the unit of each parameter."""
        return self.revolute_units if revolute else self.prismatic_units

    def values(self, drive: DriveValues) -> tuple[float | None, ...]:
        """Return what the description says of each parameter, None where it is silent."""
        stated: float | None = getattr(drive, self.key, None)
        return (stated,) if len(self.symbols) == 1 else (None,) * len(self.symbols)

    def powers_of_ratio(self) -> tuple[float, ...]:
        """Return by which power of the gear ratio N each parameter shrinks on its way to the motor,
        with `theta = N q` and `tau_joint = N tau_motor`.
        """
        return self.ratio_powers or (1.0,) * len(self.symbols)

    @property
    def free_nonlinear(self) -> tuple[NonlinearParameter, ...]:
        """The nonlinear parameters that a fit may move, since no value is stated."""
        return tuple(
            parameter
            for parameter in self.nonlinear
            if parameter.fitted and getattr(self, parameter.name) is None
        )

    def value(self, name: str) -> float:
        """Return the value of a nonlinear parameter: the stated one, or the default.

        A term with one value per joint must be taken `at` a joint first, or raises UsageError.
        """
        stated: NonlinearValue = getattr(self, name)
        if stated is None:
            return next(parameter.default for parameter in self.nonlinear if parameter.name == name)
        if isinstance(stated, tuple):
            raise UsageError(
                f"{self} has one {name} per joint; say of which joint its columns are wanted"
            )
        return stated

    def is_at(self, joint: int) -> bool:
        """Whether a joint (counted from 0) has the term."""
        return self.joints is None or joint + 1 in self.joints

    def at(self, joint: int) -> Self:
        """Return the term of one joint (counted from 0), with one number per nonlinear parameter."""
        own = {parameter.name: getattr(self, parameter.name) for parameter in self.nonlinear}
        several = {name: values for name, values in own.items() if isinstance(values, tuple)}
        return (
            self._with({name: values[joint] for name, values in several.items()})
            if several
            else self
        )

    def typical(self) -> Self:
        """Return the term with nonlinear parameters at which its columns stand out, where they do not decide its
        structure.
        """
        values = {
            parameter.name: parameter.typical
            for parameter in self.nonlinear
            if parameter.typical is not None
        }
        return self._with(values) if values else self

    def check_joints(self, n_joints: int) -> None:
        """Raise UsageError where a nonlinear parameter is given for another number of joints, or a joint does not
        exist.
        """
        outside = [number for number in self.joints or () if not 1 <= number <= n_joints]
        if outside:
            raise UsageError(
                f"{self} names joint {outside[0]}; the robot has joints 1 to {n_joints}"
            )
        for parameter in self.nonlinear:
            stated = getattr(self, parameter.name)
            if isinstance(stated, tuple) and len(stated) != n_joints:
                raise UsageError(
                    f"{self} states {len(stated)} values of {parameter.name}, one per joint; the robot"
                    f" has {n_joints} joints"
                )

    def with_nonlinear(self, values: Mapping[str, NonlinearValue]) -> Self:
        """Return the term with these nonlinear parameters stated.

        Raises UsageError for a name or a value that it does not take.
        """
        known = {parameter.name: parameter for parameter in self.nonlinear}
        for name, stated in values.items():
            if name not in known:
                there = f"it has {', '.join(known)}" if known else "it has none"
                raise UsageError(f"drive term {self.key!r} has no option {name!r}; {there}")
            parameter = known[name]
            for number in (
                () if stated is None else stated if isinstance(stated, tuple) else (stated,)
            ):
                if not parameter.lower <= number <= parameter.upper:
                    raise UsageError(
                        f"{name} of drive term {self.key!r} must lie between {parameter.lower:g} and"
                        f" {parameter.upper:g} {parameter.unit}".rstrip()
                        + f", got {number:g}"
                    )
        return self._with(values)

    def _with(self, fields: Mapping[str, Any]) -> Self:
        return cast(Self, replace(cast(Any, self), **fields))

    def __str__(self) -> str:
        parts = [self.key]
        if self.joints is not None:
            parts.append(f"joints={'/'.join(map(str, self.joints))}")
        for parameter in self.nonlinear:
            stated = getattr(self, parameter.name)
            if stated is not None:
                parts.append(
                    f"{parameter.name}={'/'.join(map(repr, stated if isinstance(stated, tuple) else (stated,)))}"
                )
        return ":".join(parts)
