"""Physically consistent standard parameters for many draws of base parameters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Array
from asbuilt.dynamics.base.base_parameters import BaseParameters
from asbuilt.dynamics.kernels.blas import one_blas_thread
from asbuilt.errors import IdentifiabilityError
from asbuilt.executor import Workers, results_in_order
from asbuilt.identification.bodies.body_bounds import generous_bounds
from asbuilt.identification.bodies.cad_prior import CadPrior
from asbuilt.identification.bodies.entropic_fit import Coordinates
from asbuilt.identification.bodies.entropic_path import DESCENT, EntropicPath
from asbuilt.identification.bodies.plausible import WEAKEST
from asbuilt.identification.information.triangular import triangular_factor

FAITHFUL = 0.1
"""Distance of a fit from its draw, in standard errors, that changes no distribution; and share of
its distance by which the robot next to an impossible draw may be farther."""
AT_ONCE = 50
"""Draws that are fitted together, whoever does it, so that the numbers do not depend on that."""


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    """Draws to fit together."""

    cad: CadPrior
    base: BaseParameters
    drawn: Array
    information_root: Array


def consistent_draws(
    cad: CadPrior,
    base: BaseParameters,
    drawn: Array,
    information_root: Array,
    *,
    workers: Workers | None = None,
) -> tuple[Array, Array]:
    """Return the consistent parameters next to many draws, and their chi-squares.

    Draw i is `min |R (K chi - beta_i)|^2 / 2 + weight D(chi || CAD)` with the largest weight of CAD
    at which it is not a tenth of a standard error, or of its distance, farther from its draw than
    without CAD. Where physics does not allow a draw (a negative friction, an impossible link), the
    nearest possible one takes its place. What the recordings do not determine stays that of CAD.

    Parameters
    ----------
    cad, base
        CAD values, and the base parameters.
    drawn
        Base parameters (N, p).
    information_root
        R (r, p) with `R^T R` the inverse covariance.
    workers
        Share the parts, to the same bits; None: this process.

    Returns
    -------
    tuple
        Standard parameters (N, n_standard), and chi-squares `|R (K chi - beta_i)|^2` (N,).

    Raises
    ------
    IdentifiabilityError
        If no fit converges.
    """
    parts = [
        _Part(cad, base, drawn[first : first + AT_ONCE], information_root)
        for first in range(0, len(drawn), AT_ONCE)
    ]
    chi, chi_square = zip(*results_in_order(_fitted, parts, workers), strict=True)
    return np.concatenate(chi), np.concatenate(chi_square)


def _fitted(part: _Part) -> tuple[Array, Array]:
    """Return the consistent parameters next to the draws of a part, and their chi-squares."""
    cad, base, drawn, information_root = part.cad, part.base, part.drawn, part.information_root
    factors = np.stack([_factor(information_root, beta) for beta in drawn])
    weights = [*DESCENT]
    while weights[-1] > WEAKEST * 1.5:
        weights.append(weights[-1] / 10.0)
    fits, distances = list[Array](), list[Array]()
    with one_blas_thread():
        path = EntropicPath.of(cad, Coordinates.of(base), generous_bounds(cad))
        for weight in weights:
            try:
                chi = path.unbarred(factors, weight)
            except IdentifiabilityError:
                continue
            moved = (chi @ base.regrouping.T - drawn) @ information_root.T
            fits.append(chi)
            distances.append(np.linalg.norm(moved, axis=1))
            if np.max(distances[-1]) <= FAITHFUL:
                break
    if not fits:
        raise IdentifiabilityError(
            f"no physically consistent parameters of {base.robot} were found for the draws"
        )
    distance = np.stack(distances)
    nearest = distance.min(axis=0)
    first = np.argmax(distance <= nearest + FAITHFUL * np.maximum(nearest, 1.0), axis=0)
    every = np.arange(len(drawn))
    return np.stack(fits)[first, every], distance[first, every] ** 2


def _factor(root: Array, beta: Array) -> Array:
    """Return the triangular factor of [R | R beta], shape (p + 1, p + 1)."""
    rows = np.column_stack([root, root @ beta])
    return triangular_factor(np.vstack([rows, np.zeros((1, len(beta) + 1))]))
