"""Elimination of the starts of windows from the least squares of their trajectories."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Array

WILD = 1e8
"""Derivative of weighted errors from which a motion is chaotic, such as stick and slip: a change of
a hundred millionth of a parameter or start moves it by its whole error."""


@dataclass(frozen=True, slots=True, eq=False)
class Eliminated:
    """Hold what w windows determine of p parameters, starts (s numbers each) at their best.

    `matrix` (p, p) is summed over windows, `scores` (w, p) are not. Starts move by `to_best` (w, s)
    less `by_parameters` (w, s, p) times the change of the parameters; `gain` is by how much the
    cost falls when they move there alone.
    """

    matrix: Array
    scores: Array
    to_best: Array
    by_parameters: Array
    gain: float


def eliminate_starts(J: Array, e: Array, stiff: Array, off: Array) -> Eliminated:
    """Eliminate the starts y from `|e - J (x, y)|^2 + stiff |off + y|^2` (Schur complement).

    Windows whose motion is wild (`WILD`) count nothing; their starts go back to the measured.

    Parameters
    ----------
    J
        Weighted derivatives by parameters and then start, (w, r, p + s).
    e
        Weighted errors (w, r).
    stiff
        Weights of the starts toward the measured ones, (s,).
    off
        Starts less the measured ones, (w, s).
    """
    s = len(stiff)
    p = J.shape[2] - s
    wild = np.max(np.abs(J), axis=(1, 2)) > WILD
    if np.any(wild):
        J, e = (np.where(wild.reshape(-1, *[1] * (x.ndim - 1)), 0.0, x) for x in (J, e))
    normal = J.transpose(0, 2, 1) @ J
    right = np.einsum("wrp,wr->wp", J, e)
    normal[:, range(p, p + s), range(p, p + s)] += stiff
    right[:, p:] -= stiff * off
    both = np.concatenate([right[:, p:, None], normal[:, p:, :p]], axis=2)
    solved = np.linalg.solve(normal[:, p:, p:], both)
    across = normal[:, :p, p:]
    to_best = solved[:, :, 0]
    by_parameters = solved[:, :, 1:]
    return Eliminated(
        np.sum(normal[:, :p, :p] - across @ by_parameters, axis=0),
        right[:, :p] - np.einsum("wps,ws->wp", across, to_best),
        to_best,
        by_parameters,
        0.5 * float(np.sum(right[:, p:] * to_best)),
    )
