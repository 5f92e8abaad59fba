"""The drive terms chosen for a robot, in canonical order, and named sets of them."""

from __future__ import annotations

import difflib
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from asbuilt.arrays import Array, Mask
from asbuilt.description.model import DriveValues, JointKind
from asbuilt.dynamics.drives.term import TERMS, DriveTerm, NonlinearValue
from asbuilt.errors import UsageError

_PLAIN = ("armature", "viscous", "coulomb")
NAMED_SETS: Mapping[str, tuple[str, ...]] = {
    "bam-m1": _PLAIN,
    "bam-m2": (*_PLAIN, "stribeck"),
    "bam-m3": (*_PLAIN, "load_friction"),
    "bam-m4": (*_PLAIN, "stribeck", "load_friction", "load_stribeck"),
    "bam-m5": (*_PLAIN, "stribeck", "directional_load_friction", "directional_load_stribeck"),
    "bam-m6": (
        *_PLAIN,
        "stribeck",
        "directional_load_friction",
        "directional_load_stribeck",
        "quadratic_load_stribeck",
    ),
}
"""Friction models M1 to M6 of BAM, with the armature that BAM identifies with them.

Source: Duclusaud, Passault, Padois and Ly, Extended friction models for the physics simulation of
servo actuators, arXiv 2410.08650, 2024.
"""
STATED = ("velocity", "power")
"""Options that a set hands on to its terms that have them."""


NONE = "none"


def with_sets_expanded(entries: Sequence[Sequence[str]]) -> list[list[str]]:
    """Return entries (key, options) in which the terms of a set stand for its name.

    A set is named `bam-m4` or `bam:m4`; its options `velocity` and `power` go to all terms that
    fade with speed. Raises `UsageError` for a set that does not exist.
    """
    expanded = list[list[str]]()
    for entry in entries:
        by_colon = entry[0] == "bam" and len(entry) > 1
        key, *options = [f"bam-{entry[1]}", *entry[2:]] if by_colon else entry
        if key.startswith("bam") or f"bam-{key}" in NAMED_SETS:
            expanded += _list_term_options(key, options)
        else:
            expanded.append([key, *options])
    return expanded


def _list_term_options(key: str, options: Sequence[str]) -> list[list[str]]:
    if key not in NAMED_SETS:
        near = difflib.get_close_matches(key, NAMED_SETS, n=1, cutoff=0.5)
        guess = f"did you mean {near[0]!r}? " if near else ""
        raise UsageError(
            f"there is no set of drive terms {key!r}; {guess}available: {', '.join(NAMED_SETS)}"
        )
    names = [option.partition("=")[0].strip() for option in options]
    if unknown := [name for name in names if name not in STATED]:
        raise UsageError(f"a set of drive terms takes velocity and power, got {unknown[0]!r}")
    fading = [bool(TERMS[term].nonlinear) for term in NAMED_SETS[key]]
    if options and not any(fading):
        raise UsageError(f"no term of {key!r} fades with speed; it takes no {names[0]}")
    return [
        [term, *(options if fades else ())]
        for term, fades in zip(NAMED_SETS[key], fading, strict=True)
    ]


def available_terms() -> dict[str, DriveTerm]:
    """Return every registered drive term by key, in canonical order."""
    return dict(sorted(TERMS.items(), key=lambda item: (item[1].position, item[0])))


@dataclass(frozen=True, slots=True)
class DriveSet:
    """Choose drive terms; every joint gets all of them, in canonical order.

    Examples
    --------
    >>> drive = DriveSet.parse("coulomb,viscous")
    >>> drive.keys, drive.names(2)
    (('viscous', 'coulomb'), ('Fv2', 'Fc2'))
    """

    terms: tuple[DriveTerm, ...] = ()

    def __post_init__(self) -> None:
        keys = [term.key for term in self.terms]
        repeated = sorted({key for key in keys if keys.count(key) > 1})
        if repeated:
            raise UsageError(
                f"drive term {repeated[0]!r} is given {keys.count(repeated[0])} times; name each"
                " term once"
            )
        object.__setattr__(
            self, "terms", tuple(sorted(self.terms, key=lambda term: (term.position, term.key)))
        )

    @classmethod
    def parse(cls, text: str | Sequence[str]) -> DriveSet:
        """Read a comma-separated list of keys (or a sequence of them).

        "none" and the empty list choose no term. A key may state nonlinear parameters for all
        joints, as in `stribeck:velocity=0.05:power=1`, or for each, divided by slashes, as in
        `smooth_coulomb:width=0.02/0.01`; and the numbers of the joints that have the term, as in
        `spring:joints=2/5`. A set of terms with a name (`NAMED_SETS`), such as `bam-m4`, stands for
        its terms. Raises UsageError for terms and options that do not exist.
        """
        given = text.split(",") if isinstance(text, str) else list(text)
        chosen = [
            [part.strip() for part in entry.lower().split(":")] for entry in given if entry.strip()
        ]
        chosen = with_sets_expanded(chosen)
        if chosen == [[NONE]]:
            return cls()
        if [NONE] in chosen:
            raise UsageError(f"{NONE!r} excludes other drive terms, got {text!r}")
        return cls(tuple(_state_parameters(TERMS.find(key), options) for key, *options in chosen))

    @classmethod
    def default(cls, source: str) -> DriveSet:
        """Return the terms that a torque of this source calls for, as each term declares."""
        return cls(tuple(term for term in available_terms().values() if source in term.default_for))

    def __str__(self) -> str:
        return ",".join(self.specifications) or NONE

    def __bool__(self) -> bool:
        return bool(self.terms)

    @property
    def keys(self) -> tuple[str, ...]:
        """Keys of the chosen terms in canonical order; `parse` accepts them."""
        return tuple(term.key for term in self.terms)

    @property
    def specifications(self) -> tuple[str, ...]:
        """The chosen terms with their stated nonlinear parameters, as `parse` reads them."""
        return tuple(str(term) for term in self.terms)

    @property
    def symbols(self) -> tuple[str, ...]:
        """Parameter names of one joint without its number."""
        return tuple(symbol for term in self.terms for symbol in term.symbols)

    @property
    def columns_per_joint(self) -> int:
        """Number of drive parameters of one joint."""
        return sum(len(term.symbols) for term in self.terms)

    @property
    def needs_load(self) -> bool:
        """Whether a term needs the rigid-body torque of the joint."""
        return any(term.needs_load for term in self.terms)

    @property
    def of_motor(self) -> Mask:
        """Whether each column of a joint belongs to its motor, shape (columns_per_joint,)."""
        return np.array([term.of_motor for term in self.terms for _ in term.symbols], dtype=bool)

    @property
    def is_linear(self) -> bool:
        """Whether every nonlinear parameter has a value: none is left to be fitted."""
        return not any(term.free_nonlinear for term in self.terms)

    def at(self, joint: int) -> DriveSet:
        """Return the set of one joint (counted from 0), with one number per nonlinear parameter."""
        return DriveSet(tuple(term.at(joint) for term in self.terms))

    def with_term(self, term: DriveTerm) -> DriveSet:
        """Return the set with this term in place of the one of its key, or in addition."""
        return DriveSet((*(other for other in self.terms if other.key != term.key), term))

    def without(self, *keys: str) -> DriveSet:
        """Return the set without the terms of these keys."""
        return DriveSet(tuple(term for term in self.terms if term.key not in keys))

    def functions(self, joint: int) -> tuple[Mapping[Hashable, float], ...]:
        """Return each column of a joint (counted from 0) as a sum of elementary functions.

        See `DriveTerm.functions`.
        """
        empty: dict[Hashable, float] = {}
        return tuple(
            function if term.is_at(joint) else empty
            for term in self.terms
            for function in term.at(joint).functions()
        )

    def check_joints(self, n_joints: int) -> None:
        """Raise UsageError where nonlinear parameters are stated for another number of joints."""
        for term in self.terms:
            term.check_joints(n_joints)

    def names(self, joint_number: int) -> tuple[str, ...]:
        """Return the parameter names of one joint; numbers count from 1."""
        return tuple(f"{symbol}{joint_number}" for symbol in self.symbols)

    def units(self, kind: JointKind) -> tuple[str, ...]:
        """Return the parameter units of a joint of this kind."""
        return tuple(
            unit for term in self.terms for unit in term.units(revolute=kind != "prismatic")
        )

    def values(self, drive: DriveValues) -> tuple[float | None, ...]:
        """Return the value of each parameter of one joint in the description.

        The set must be taken `at` that joint. None where the description has no value, or other
        nonlinear parameters.
        """
        return tuple(value for term in self.terms for value in _read_described_values(term, drive))

    def evaluate(
        self,
        q: Array,
        qd: Array,
        qdd: Array,
        *,
        load: Array | None = None,
        out: Array | None = None,
        joint: int | None = None,
        motor: tuple[Array, Array, Array] | None = None,
    ) -> Array:
        """Return the columns of one joint, shape (columns_per_joint, n_samples).

        The inputs have shape (n_samples,), or all one other shape, such as one for several joints,
        which the result then has after its first axis. `load` is the rigid-body torque of the
        joint, for terms that need it; `out` is reused memory for the result; `joint` (counted from
        0) is needed if a nonlinear parameter has one value per joint; `motor` is position, velocity
        and acceleration of a motor that several joints turn, without which columns of terms
        `of_motor` are zero.
        Raises UsageError if a term needs a load and none is given.
        """
        columns = np.empty((self.columns_per_joint, *q.shape)) if out is None else out
        row = 0
        for shared in self.terms:
            term = shared if joint is None else shared.at(joint)
            own = columns[row : row + len(term.symbols)]
            if joint is not None and not term.is_at(joint):
                own[...] = 0.0
            elif not term.of_motor:
                term.evaluate(q, qd, qdd, load, own)
            elif motor is None:
                own[...] = 0.0
            else:
                term.evaluate(*motor, None, own)
            row += len(term.symbols)
        return columns


def _read_described_values(term: DriveTerm, drive: DriveValues) -> tuple[float | None, ...]:
    numbers = drive.terms.get(term.key)
    if numbers is None:
        return term.values(drive)
    if any(
        numbers.get(parameter.name, parameter.default) != term.value(parameter.name)
        for parameter in term.nonlinear
    ):
        return (None,) * len(term.symbols)
    return tuple(numbers.get(symbol) for symbol in term.symbols)


def _state_parameters(term: DriveTerm, options: Sequence[str]) -> DriveTerm:
    parameters: dict[str, NonlinearValue] = {}
    for option in options:
        name, equals, values = (part.strip() for part in option.partition("="))
        try:
            numbers = tuple(float(value) for value in values.split("/"))
        except ValueError:
            numbers = ()
        if not equals or not numbers:
            raise UsageError(
                f"option {option!r} of drive term {term.key!r} must read name=number, or"
                " name=number/number/... with one per joint"
            )
        if name == "joints":
            if any(not number.is_integer() or number < 1 for number in numbers):
                raise UsageError(
                    f"joints of drive term {term.key!r} are numbers from 1, such as joints=2/5, got"
                    f" {values!r}"
                )
            term = replace(term, joints=tuple(sorted({int(number) for number in numbers})))
        else:
            parameters[name] = numbers[0] if len(numbers) == 1 else numbers
    return term.with_nonlinear(parameters)


NO_DRIVE = DriveSet()
"""Rigid bodies only."""
