"""Mass, centre of mass and inertia of one rigid link, in every form the field uses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from asbuilt.errors import InertiaError

Array = NDArray[np.float64]

PARAMETER_NAMES = ("Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz", "mx", "my", "mz", "m")
"""The ten standard inertial parameters of a link about its origin, in the order used everywhere in asbuilt."""

PARAMETER_UNITS = ("kg m^2",) * 6 + ("kg m",) * 3 + ("kg",)


@dataclass(frozen=True, eq=False)
class LinkInertia:
    """Hold the ten inertial parameters of a link about its origin, in link axes: `Ixx Ixy Ixz Iyy Iyz Izz mx my mz m`."""

    parameters: Array

    def __post_init__(self) -> None:
        parameters = np.array(self.parameters, dtype=np.float64)
        if parameters.shape != (10,):
            raise InertiaError(f"inertial parameters must be 10 numbers ({' '.join(PARAMETER_NAMES)}), got shape {parameters.shape}")
        if not np.all(np.isfinite(parameters)):
            bad = PARAMETER_NAMES[int(np.argmin(np.isfinite(parameters)))]
            raise InertiaError(f"inertial parameter {bad} is not finite: {parameters.tolist()}")
        parameters.setflags(write=False)
        object.__setattr__(self, "parameters", parameters)

    @classmethod
    def from_com(cls, mass: float, com: ArrayLike, inertia_about_com: ArrayLike) -> LinkInertia:
        """Build from mass [kg], centre of mass [m] and the 3 x 3 inertia about it [kg m^2], all in link axes.

        Huygens-Steiner: `I_origin = I_com + m (c.c 1 - c c^T)`.
        """
        c = np.asarray(com, dtype=np.float64)
        tensor = np.asarray(inertia_about_com, dtype=np.float64)
        at_origin = tensor + mass * (c @ c * np.eye(3) - np.outer(c, c))
        return cls.from_origin(mass, mass * c, at_origin)

    @classmethod
    def from_origin(cls, mass: float, first_moment: ArrayLike, inertia: ArrayLike) -> LinkInertia:
        """Build from mass [kg], first moment `m c` [kg m] and the 3 x 3 inertia about the link origin [kg m^2]."""
        h = np.asarray(first_moment, dtype=np.float64)
        i = np.asarray(inertia, dtype=np.float64)
        return cls(np.array([i[0, 0], i[0, 1], i[0, 2], i[1, 1], i[1, 2], i[2, 2], h[0], h[1], h[2], mass]))

    @classmethod
    def zero(cls) -> LinkInertia:
        """Return the inertia of a massless link."""
        return cls(np.zeros(10))

    @property
    def mass(self) -> float:
        """Mass [kg]."""
        return float(self.parameters[9])

    @property
    def first_moment(self) -> Array:
        """First moment `m c` [kg m], shape (3,)."""
        return self.parameters[6:9]

    @property
    def inertia(self) -> Array:
        """Inertia tensor about the link origin [kg m^2], shape (3, 3)."""
        xx, xy, xz, yy, yz, zz = self.parameters[:6]
        return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
