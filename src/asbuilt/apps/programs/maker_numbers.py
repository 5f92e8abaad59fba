"""Numbers as robot makers take them: principal axes, and decimals without exponents."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import permutations

import numpy as np

from asbuilt.arrays import Array

MILLIMETRES = 1000.0
"""Millimetres in a metre."""
ORDER = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
"""Places of the six numbers Ixx, Iyy, Izz, Ixy, Ixz, Iyz in the matrix of inertia."""


def format_decimals(value: float) -> str:
    """Return a number with eight digits and no exponent, which not every language reads.

    Examples
    --------
    >>> format_decimals(1.25e-6), format_decimals(-0.0), format_decimals(2)
    ('0.00000125', '0.0', '2.0')
    """
    return np.format_float_positional(value + 0.0, precision=8, fractional=False, trim="0")


def list_decimals(values: Iterable[float], separator: str = ", ") -> str:
    """Return numbers in a row.

    >>> list_decimals([0.5, -1.0])
    '0.5, -1.0'
    """
    return separator.join(map(format_decimals, values))


def list_inertia(inertia: Array) -> list[float]:
    """Return Ixx, Iyy, Izz, Ixy, Ixz, Iyz of a matrix (3, 3), off its diagonal with its signs."""
    return [float(inertia[place]) for place in ORDER]


def find_principal_axes(inertia: Array) -> tuple[Array, Array]:
    """Return the principal moments (3,) of a matrix (3, 3) and its axes, a rotation (3, 3).

    The columns are the axes. Of the 24 such rotations it is the one that turns least, so that a
    matrix without products has the identity.
    """
    moments, axes = np.linalg.eigh(inertia)
    best = np.eye(3)
    order = [0, 1, 2]
    least = -np.inf
    for chosen in permutations(range(3)):
        turned = axes[:, chosen] * np.where(np.diagonal(axes[:, chosen]) < 0.0, -1.0, 1.0)
        if np.linalg.det(turned) < 0.0:
            turned[:, int(np.argmin(np.diagonal(turned)))] *= -1.0
        if np.trace(turned) > least:
            best = turned
            order = [*chosen]
            least = float(np.trace(turned))
    return moments[order], best
