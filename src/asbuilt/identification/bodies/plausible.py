"""Standard parameters closest to CAD within the uncertainty of base parameters."""

from __future__ import annotations

import numpy as np

from asbuilt.arrays import Array
from asbuilt.dynamics.base.base_parameters import BaseParameters
from asbuilt.dynamics.kernels.blas import use_one_blas_thread
from asbuilt.errors import IdentifiabilityError
from asbuilt.identification.bodies.body_bounds import bound_generously
from asbuilt.identification.bodies.cad_prior import CadPrior
from asbuilt.identification.bodies.entropic_fit import Coordinates
from asbuilt.identification.bodies.entropic_path import DESCENT, EntropicPath
from asbuilt.identification.information.triangular import triangular_factor

WEAKEST = 1e-4
"""Weight of CAD below which no parameters are within the uncertainty."""
CLOSE = 0.01
"""Relative distance of the chi-square from its limit at which the search for the weight ends."""
MOST_HALVINGS = 20


def find_plausible_parameters(
    cad: CadPrior, base: BaseParameters, beta: Array, information_root: Array, limit: float
) -> tuple[Array, float] | None:
    """Return the standard parameters closest to CAD within the uncertainty, and their chi-square.

    They have the least divergence from CAD with `|R (K chi - beta)|^2 <= limit`, within the bounds
    of `bound_generously`. The entropic fit to R has the minimum of the divergence under this limit
    at the weight of CAD that meets the limit; bisection finds it.

    Parameters
    ----------
    cad, base
        CAD values, and the base parameters.
    beta
        Base parameters (p,).
    information_root
        R (r, p) with `R^T R` the inverse covariance of beta.
    limit
        Largest chi-square.

    Returns
    -------
    tuple or None
        Standard parameters (n_standard,) and their chi-square; None if none are found.
    """
    p = len(beta)
    rows = np.column_stack([information_root, information_root @ beta])
    factor = triangular_factor(np.vstack([rows, np.zeros((1, p + 1))]))

    def chi_square(chi: Array) -> float:
        return float(np.sum((information_root @ (base.regrouping @ chi - beta)) ** 2))

    with use_one_blas_thread():
        try:
            path = EntropicPath.of(cad, Coordinates.of(base), bound_generously(cad))
            above, weight, found = np.inf, DESCENT[0], None
            while weight >= WEAKEST:
                (chi,) = path.unbarred(factor[None], weight)
                if chi_square(chi) <= limit:
                    found = chi
                    break
                above, weight = weight, weight / 10.0
            if found is None:
                return None
            below = weight
            for _ in range(MOST_HALVINGS if np.isfinite(above) else 0):
                if chi_square(found) >= (1.0 - CLOSE) * limit:
                    break
                weight = float(np.sqrt(above * below))
                (chi,) = path.unbarred(factor[None], weight)
                if chi_square(chi) <= limit:
                    below, found = weight, chi
                else:
                    above = weight
        except IdentifiabilityError:
            return None
    return found, chi_square(found)
