"""Conic programs, solved by Clarabel on one thread without output."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import clarabel
import numpy as np
from scipy import sparse

from asbuilt.arrays import Array


@dataclass(frozen=True, slots=True, eq=False)
class ConeSolution:
    """Hold the solver's status, its last point and the number of iterations."""

    status: str
    x: Array
    iterations: int

    @property
    def is_solved(self) -> bool:
        """Whether `x` is the minimiser, at least to reduced precision."""
        return self.status in ("Solved", "AlmostSolved")


def solve_cone_program(
    quadratic: sparse.csc_matrix,
    linear: Array,
    constraints: sparse.csc_matrix,
    right: Array,
    cones: list[Any],
    **settings: float | bool,
) -> ConeSolution:
    """Minimise `x^T P x / 2 + c^T x` subject to `A x + s = b`, s in the cones.

    P is upper triangular, `settings` have Clarabel's names, and semidefinite cones take the `svec`
    of a matrix. Source: Goulart & Chen, Clarabel: an interior-point solver for conic programs,
    2024.
    """
    chosen = clarabel.DefaultSettings()
    chosen.verbose = False
    chosen.max_threads = 1
    for name, value in settings.items():
        setattr(chosen, name, value)
    try:
        found = clarabel.DefaultSolver(quadratic, linear, constraints, right, cones, chosen).solve()
    except (
        BaseException
    ) as problem:  # a panic of the solver, whose type nothing exports, is no Exception
        if type(problem).__name__ != "PanicException":
            raise
        return ConeSolution(f"Panic ({problem})", np.full(len(linear), np.nan), 0)
    return ConeSolution(
        str(found.status), np.array(found.x, dtype=np.float64), int(found.iterations)
    )
