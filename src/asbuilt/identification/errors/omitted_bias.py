"""Bias of the estimates by effects that the recording shows and the model lacks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Array
from asbuilt.identification.information.estimate import Estimate
from asbuilt.identification.information.square_root_information import SquareRootInformation


@dataclass(frozen=True, slots=True, eq=False)
class OmittedBias:
    """Hold the bias of base parameters and its second moment, which adds to covariances.

    A bias b with covariance V has `b b^T + V`. An estimate that is not corrected for a known bias
    has the root of the sum of squares of bias and standard error as its error (Phillips, Eberhardt
    and Parry, J. Research NIST 102, 1997; JCGM 100:2008, F.2.4.5).

    Parameters
    ----------
    bias, covariance
        Bias (p,) and second moment (p, p) of the estimate, such as a regularised one.
    free_bias, free_covariance
        Those of weighted least squares.
    effects
        The effects, as text.
    """

    bias: Array
    covariance: Array
    free_bias: Array
    free_covariance: Array
    effects: str

    @property
    def sentence(self) -> str:
        """A note that names the effects, empty if all are in the model."""
        if not self.effects:
            return ""
        return f"Standard errors include the bias by what the model may lack: {self.effects}."


def shrunken(effects: Array, covariance: Array, size: Array) -> tuple[Array, Array]:
    """Return mean (m,) and covariance (m, m) of effects of a usual size (m,).

    Effects are normal around zero with that standard deviation: `T (V + T)^-1 g` and `V - V (V +
    T)^-1 V` for the estimates g with covariance V (Efron and Morris, J. American Statistical
    Association 70, 1975).

    >>> mean, spread = shrunken(np.array([2.0]), np.array([[1.0]]), np.array([1.0]))
    >>> mean.tolist(), spread.tolist()
    ([1.0], [[0.5]])
    """
    T = np.diag(size**2)
    gain = covariance @ np.linalg.pinv(covariance + T, hermitian=True)
    spread = covariance - gain @ covariance
    return np.asarray(effects - gain @ effects), np.asarray(0.5 * (spread + spread.T))


def moved_estimate(information: SquareRootInformation, estimate: Estimate) -> Array:
    """Return how an estimate moves (p, p) where weighted least squares moves.

    An estimate with inverse root S moves by `S S^T W^T W b` where weighted least squares moves by
    b: regularisation holds part of it back.
    """
    seen = (estimate.information or information).stacked(estimate.weights)[:-1, :-1]
    root = estimate.solution.inverse_root
    return np.asarray(root @ (seen @ root).T @ seen)
