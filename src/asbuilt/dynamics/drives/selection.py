"""The drive terms chosen for a robot, in canonical order."""

from __future__ import annotations

import difflib
import importlib
import inspect
import pkgutil
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from asbuilt.description.model import DriveValues, JointKind
from asbuilt.dynamics import drives
from asbuilt.dynamics.drives.term import Array, DriveTerm
from asbuilt.errors import UsageError

NONE = "none"


@cache
def available_terms() -> dict[str, DriveTerm]:
    """Return every drive term of this package by key, in canonical order."""
    found: dict[str, DriveTerm] = {}
    for module_name in sorted(module.name for module in pkgutil.iter_modules(drives.__path__)):
        module = importlib.import_module(f"{drives.__name__}.{module_name}")
        for _, kind in inspect.getmembers(module, inspect.isclass):
            if issubclass(kind, DriveTerm) and not inspect.isabstract(kind):
                found[kind.key] = kind()
    return dict(sorted(found.items(), key=lambda item: (item[1].position, item[0])))


@dataclass(frozen=True, slots=True)
class DriveSet:
    """Choose drive terms; every joint gets all of them, in canonical order whatever the order given.

    >>> drive = DriveSet.parse("coulomb,viscous")
    >>> drive.keys, drive.names(2)
    (('viscous', 'coulomb'), ('Fv2', 'Fc2'))
    """

    terms: tuple[DriveTerm, ...] = ()

    def __post_init__(self) -> None:
        keys = [term.key for term in self.terms]
        repeated = sorted({key for key in keys if keys.count(key) > 1})
        if repeated:
            raise UsageError(f"drive term {repeated[0]!r} is given {keys.count(repeated[0])} times; name each term once")
        object.__setattr__(self, "terms", tuple(sorted(self.terms, key=lambda term: (term.position, term.key))))

    @classmethod
    def parse(cls, text: str | Sequence[str]) -> DriveSet:
        """Read a comma-separated list of keys (or a sequence of keys); "none" and the empty list choose no term."""
        given = text.split(",") if isinstance(text, str) else list(text)
        keys = [key.strip().lower() for key in given if key.strip()]
        if keys == [NONE]:
            return cls()
        known = available_terms()
        for key in keys:
            if key not in known:
                near = difflib.get_close_matches(key, known, n=1, cutoff=0.5)
                hint = f"did you mean {near[0]!r}? " if near else ""
                if key == NONE:
                    hint = f"{NONE!r} stands alone; "
                raise UsageError(f"unknown drive term {key!r}; {hint}available: {', '.join(known)}, or {NONE}")
        return cls(tuple(known[key] for key in keys))

    def __str__(self) -> str:
        return ",".join(self.keys) or NONE

    def __bool__(self) -> bool:
        return bool(self.terms)

    @property
    def keys(self) -> tuple[str, ...]:
        """Keys of the chosen terms in canonical order; `parse` accepts them."""
        return tuple(term.key for term in self.terms)

    @property
    def letters(self) -> tuple[str, ...]:
        """Parameter names of one joint without its number."""
        return tuple(letter for term in self.terms for letter in term.letters)

    @property
    def columns_per_joint(self) -> int:
        """Number of drive parameters of one joint."""
        return sum(len(term.letters) for term in self.terms)

    @property
    def needs_load(self) -> bool:
        """Whether a term needs the rigid-body torque of the joint."""
        return any(term.needs_load for term in self.terms)

    def names(self, joint_number: int) -> tuple[str, ...]:
        """Return the parameter names of one joint; numbers count from 1."""
        return tuple(f"{letter}{joint_number}" for letter in self.letters)

    def units(self, kind: JointKind) -> tuple[str, ...]:
        """Return the parameter units of a joint of this kind."""
        return tuple(unit for term in self.terms for unit in term.units(revolute=kind != "prismatic"))

    def values(self, drive: DriveValues) -> tuple[float | None, ...]:
        """Return what the description says of each parameter of one joint, None where it is silent."""
        return tuple(value for term in self.terms for value in term.values(drive))

    def evaluate(self, q: Array, qd: Array, qdd: Array, *, load: Array | None = None, out: Array | None = None) -> Array:
        """Return the columns of one joint, shape (columns_per_joint, n_samples), from inputs of shape (n_samples,).

        `load` is the rigid-body torque of the joint, for terms that need it; `out` is reused memory for the result.
        """
        columns = np.empty((self.columns_per_joint, q.shape[0])) if out is None else out
        if load is None and self.needs_load:
            needy = next(term.key for term in self.terms if term.needs_load)
            raise UsageError(f"drive term {needy!r} needs the rigid-body torque of the joint; pass load, shape {q.shape}")
        row = 0
        for term in self.terms:
            term.evaluate(q, qd, qdd, load, columns[row : row + len(term.letters)])
            row += len(term.letters)
        return columns


NO_DRIVE = DriveSet()
"""Rigid bodies only."""
