"""Mass, centre of mass and inertia of one rigid link, in every form the field uses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array, read_only
from asbuilt.errors import InertiaError, UsageError

PARAMETER_NAMES = ("Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz", "mx", "my", "mz", "m")
"""The ten standard inertial parameters of a link about its origin, in the order used everywhere in
asbuilt.
"""

PARAMETER_UNITS = ("kg m^2",) * 6 + ("kg m",) * 3 + ("kg",)

CONSISTENCY_TOLERANCE = 1e-9
"""A moment may miss a condition of physical consistency by this much of the link's trace of
inertia: the trace of rounding, not of physics.
"""

_PINOCCHIO_ORDER = np.array([9, 6, 7, 8, 0, 1, 3, 2, 4, 5])
_TRIANGLES = (("Ixx", "Iyy", "Izz"), ("Iyy", "Izz", "Ixx"), ("Izz", "Ixx", "Iyy"))


@dataclass(frozen=True, eq=False)
class LinkInertia:
    """Hold the ten inertial parameters of a link about its origin, in link axes.

    `Ixx Ixy Ixz Iyy Iyz Izz mx my mz m` [kg m^2, kg m, kg].

    Raises `InertiaError` for another number of them, and for one that is not finite.
    """

    parameters: Array

    def __post_init__(self) -> None:
        parameters = read_only(self.parameters)
        if parameters.shape != (10,):
            raise InertiaError(
                f"inertial parameters must be 10 numbers ({' '.join(PARAMETER_NAMES)}), got shape"
                f" {parameters.shape}"
            )
        if not np.all(np.isfinite(parameters)):
            bad = PARAMETER_NAMES[int(np.argmin(np.isfinite(parameters)))]
            raise InertiaError(f"inertial parameter {bad} is not finite: {parameters.tolist()}")
        object.__setattr__(self, "parameters", parameters)

    @classmethod
    def from_com(cls, mass: float, com: ArrayLike, inertia_about_com: ArrayLike) -> LinkInertia:
        """Build from mass [kg], centre of mass [m] and 3 x 3 inertia about it [kg m^2].

        All are in link axes.

        Huygens-Steiner: `I_origin = I_com + m (c.c 1 - c c^T)`.
        """
        c = np.asarray(com, dtype=np.float64)
        tensor = np.asarray(inertia_about_com, dtype=np.float64)
        return cls.from_origin(mass, mass * c, tensor + mass * (c @ c * np.eye(3) - np.outer(c, c)))

    @classmethod
    def from_origin(cls, mass: float, first_moment: ArrayLike, inertia: ArrayLike) -> LinkInertia:
        """Build from mass [kg], first moment [kg m] and inertia about the link origin [kg m^2].

        The first moment is `m c` (3,), the inertia 3 x 3.
        """
        h = np.asarray(first_moment, dtype=np.float64)
        i = np.asarray(inertia, dtype=np.float64)
        return cls(
            np.array([i[0, 0], i[0, 1], i[0, 2], i[1, 1], i[1, 2], i[2, 2], h[0], h[1], h[2], mass])
        )

    @classmethod
    def zero(cls) -> LinkInertia:
        """Return the inertia of a massless link."""
        return cls(np.zeros(10))

    def __repr__(self) -> str:
        com, moments = (
            "[" + ", ".join(f"{value:.3g}" for value in values) + "]"
            for values in (self.com, self.principal_moments)
        )
        return f"LinkInertia(mass={self.mass:.4g}, com={com}, moments={moments})"

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

    @property
    def com(self) -> Array:
        """Centre of mass [m], shape (3,); the origin where the link has no mass."""
        return self.first_moment / self.mass if self.mass != 0.0 else np.zeros(3)

    @property
    def inertia_about_com(self) -> Array:
        """Inertia tensor about the centre of mass, in link axes [kg m^2], shape (3, 3)."""
        c = self.com
        return self.inertia - self.mass * (c @ c * np.eye(3) - np.outer(c, c))

    @property
    def principal_moments(self) -> Array:
        """Principal moments of inertia about the centre of mass, ascending [kg m^2], shape (3,)."""
        return np.linalg.eigvalsh(self.inertia_about_com).astype(np.float64)

    @property
    def principal_axes(self) -> tuple[Array, Array]:
        """The principal moments, ascending, and the right-handed axes (3, 3) as columns."""
        moments, axes = np.linalg.eigh(self.inertia_about_com)
        if np.linalg.det(axes) < 0:
            axes[:, 0] *= -1.0
        return moments, axes

    @property
    def pseudo_inertia(self) -> Array:
        """Pseudo-inertia `[[Sigma, h], [h^T, m]]` with `Sigma = tr(I)/2 1 - I`, shape (4, 4).

        Source: Wensing, Kim and Slotine, 2018, eq. 10.
        """
        return pseudo_inertias(self.parameters)

    @classmethod
    def from_pseudo_inertia(cls, pseudo_inertia: ArrayLike) -> LinkInertia:
        """Build from the 4 x 4 pseudo-inertia.

        `I = tr(Sigma) 1 - Sigma` (Wensing, Kim and Slotine, 2018).

        Raises `InertiaError` for another shape and for a matrix that is not symmetric.
        """
        J = np.asarray(pseudo_inertia, dtype=np.float64)
        if J.shape != (4, 4):
            raise InertiaError(f"a pseudo-inertia is a 4 x 4 matrix, got shape {J.shape}")
        asymmetry = float(np.abs(J - J.T).max())
        if asymmetry > CONSISTENCY_TOLERANCE * max(float(np.abs(J).max()), np.finfo(float).tiny):
            raise InertiaError(
                "a pseudo-inertia is symmetric; this one differs from its transpose by"
                f" {asymmetry:.3g}"
            )
        return cls(_extract_parameters(J))

    def to_pinocchio_order(self) -> Array:
        """Return the ten parameters as Pinocchio's `toDynamicParameters` has them.

        `m mx my mz Ixx Ixy Iyy Ixz Iyz Izz` (about the origin).
        """
        return np.take(self.parameters, _PINOCCHIO_ORDER)

    @classmethod
    def from_pinocchio_order(cls, parameters: ArrayLike) -> LinkInertia:
        """Build from `m mx my mz Ixx Ixy Iyy Ixz Iyz Izz`, the inverse of `to_pinocchio_order`.

        Raises `InertiaError` for another shape.
        """
        given = np.asarray(parameters, dtype=np.float64)
        if given.shape != (10,):
            raise InertiaError(
                f"Pinocchio's dynamic parameters are 10 numbers, got shape {given.shape}"
            )
        ordered = np.empty(10)
        ordered[_PINOCCHIO_ORDER] = given
        return cls(ordered)

    def moved(self, placement: ArrayLike) -> LinkInertia:
        """Return the same body seen from another frame.

        `placement` (4, 4) is the pose of the present frame in the new one: `J' = T J T^T`.
        """
        T = np.asarray(placement, dtype=np.float64)
        return LinkInertia(_extract_parameters(T @ self.pseudo_inertia @ T.T))

    def __add__(self, other: LinkInertia) -> LinkInertia:
        """Return the inertia of two bodies welded together, both given in the same frame."""
        return LinkInertia(self.parameters + other.parameters)

    def __sub__(self, other: LinkInertia) -> LinkInertia:
        """Return what is left when a part, given in the same frame, is taken off."""
        return LinkInertia(self.parameters - other.parameters)

    def inconsistency(self) -> str | None:
        """Return why no rigid body has these parameters, with the amount, or None where one has.

        The pseudo-inertia must be positive semidefinite, that is: mass >= 0, and the moments about
        the centre of mass are non-negative and satisfy the triangle inequalities in every axes
        (Wensing, Kim and Slotine, 2018).
        """
        if not self.parameters.any():
            return None
        if self.mass <= 0.0:
            return f"mass is {self.mass:.4g} kg; it must be positive"
        slack = CONSISTENCY_TOLERANCE * float(np.trace(np.abs(self.inertia)))
        moments = dict(zip(("Ixx", "Iyy", "Izz"), np.diag(self.inertia_about_com), strict=True))
        for name, moment in moments.items():
            if moment < -slack:
                return (
                    f"{name} about the centre of mass is {moment:.3g} kg m^2; it must not be"
                    " negative"
                )
        for one, two, three in _TRIANGLES:
            excess = moments[three] - moments[one] - moments[two]
            if excess > slack:
                return f"{one} + {two} < {three} by {excess:.2g} kg m^2 (about the centre of mass)"
        small, middle, large = self.principal_moments
        if small < -slack:
            return (
                f"a principal moment of inertia about the centre of mass is {small:.3g} kg m^2; it"
                " must not be negative"
            )
        if large - small - middle > slack:
            return (
                f"of the principal moments about the centre of mass ({small:.4g}, {middle:.4g},"
                f" {large:.4g} kg m^2) the largest exceeds the sum of the others by"
                f" {large - small - middle:.2g}"
            )
        return None

    @property
    def is_consistent(self) -> bool:
        """Whether the parameters are physically consistent.

        The pseudo-inertia is then positive semidefinite.
        """
        return self.inconsistency() is None


def pseudo_inertias(parameters: ArrayLike) -> Array:
    """Return the pseudo-inertias of ten-vectors, shape (..., 10) -> (..., 4, 4).

    Source: Wensing, Kim and Slotine, 2018.
    """
    chi = np.asarray(parameters, dtype=np.float64)
    xx, xy, xz, yy, yz, zz, mx, my, mz, m = np.moveaxis(chi, -1, 0)
    rows = (
        ((yy + zz - xx) / 2.0, -xy, -xz, mx),
        (-xy, (xx + zz - yy) / 2.0, -yz, my),
        (-xz, -yz, (xx + yy - zz) / 2.0, mz),
        (mx, my, mz, m),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _extract_parameters(J: Array) -> Array:
    """Return the ten-vectors (..., 10) of pseudo-inertias (..., 4, 4)."""
    a = J[..., 0, 0]
    b = J[..., 1, 1]
    c = J[..., 2, 2]
    entries = (
        b + c,
        -J[..., 0, 1],
        -J[..., 0, 2],
        a + c,
        -J[..., 1, 2],
        a + b,
        J[..., 0, 3],
        J[..., 1, 3],
        J[..., 2, 3],
        J[..., 3, 3],
    )
    return np.stack(entries, axis=-1)


def shift_matrix(placement: ArrayLike) -> Array:
    """Return the 10 x 10 matrix S with `chi_parent = S chi_child`.

    The child frame is at `placement` (4, 4) in its parent.

    `S` is the map `J -> T J T^T` of pseudo-inertias, written for ten-vectors; it holds
    Huygens-Steiner and the rotation of the tensor.
    """
    T = np.asarray(placement, dtype=np.float64)
    return _extract_parameters(T @ pseudo_inertias(np.eye(10)) @ T.T).T


DENSITY = 2700.0
"""Of aluminium [kg/m^3]: gives a tool its size."""


def tool_from_text(text: str) -> LinkInertia:
    """Return a ball of aluminium of mass `KG` centred at `X,Y,Z` [m].

    The text is `KG@X,Y,Z`, or `KG` alone for a ball at the origin.

    Raises `UsageError` for any other text.

    Examples
    --------
    >>> tool = tool_from_text("2.5@0,0,0.08")
    >>> tool.mass, tool.com.tolist()
    (2.5, [0.0, 0.0, 0.08])
    """
    weight, _, place = text.partition("@")
    try:
        mass = float(weight)
        com = [float(part) for part in place.split(",")] if place else [0.0, 0.0, 0.0]
    except ValueError:
        mass = np.nan
        com = []
    if not (np.isfinite(mass) and mass > 0.0 and len(com) == 3 and np.all(np.isfinite(com))):
        raise UsageError(
            "a tool is KG@X,Y,Z: a positive mass and its centre in metres, for example"
            f" 2.5@0,0,0.08; got {text!r}"
        )
    radius = (0.75 * mass / (np.pi * DENSITY)) ** (1.0 / 3.0)
    return LinkInertia.from_com(mass, com, 0.4 * mass * radius**2 * np.eye(3))
