"""One term of a drive's torque, linear in its parameters."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from asbuilt.description.model import DriveValues

Array = NDArray[np.float64]


class DriveTerm(ABC):
    """Add `sum_c columns[c](q, qd, qdd, load) * parameter_c` to the torque of one joint.

    A term is one file in this package: a frozen dataclass without arguments in its simplest form. What enters the columns
    non-linearly (a Stribeck velocity, the width of a smooth sign) is a field of the dataclass with a default, so that
    `dataclasses.replace` moves it. `position` places the term in the canonical order of parameters.
    """

    key: ClassVar[str]
    """Name used to select the term."""
    position: ClassVar[int]
    """Place in the canonical order; smaller comes first."""
    letters: ClassVar[tuple[str, ...]]
    """One per column; the joint number follows it in parameter names."""
    revolute_units: ClassVar[tuple[str, ...]]
    prismatic_units: ClassVar[tuple[str, ...]]
    needs_load: ClassVar[bool] = False
    """Whether the columns depend on the rigid-body torque of the joint."""

    @abstractmethod
    def evaluate(self, q: Array, qd: Array, qdd: Array, load: Array | None, out: Array) -> None:
        """Write the columns of one joint into `out`, shape (len(letters), n_samples); the inputs have shape (n_samples,).

        `load` is the rigid-body torque [N m or N], given to terms that set `needs_load`.
        """

    def units(self, *, revolute: bool) -> tuple[str, ...]:
        """Return the unit of each parameter."""
        return self.revolute_units if revolute else self.prismatic_units

    def values(self, drive: DriveValues) -> tuple[float | None, ...]:
        """Return what the description says of each parameter, None where it is silent."""
        stated: float | None = getattr(drive, self.key, None)
        return (stated,) if len(self.letters) == 1 else (None,) * len(self.letters)
