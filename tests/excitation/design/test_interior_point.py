from __future__ import annotations

import cvxpy as cp
import numpy as np

from asbuilt.excitation.design.interior_point import (
    Evaluation,
    MotionProgram,
    solve,
)
from asbuilt.excitation.state_constraint import StateConstraint


class Disc(StateConstraint):
    """Keep the positions at every node in a disc: `|q - c|^2 / r^2 < 1`."""

    name = "disc"
    two_sided = False

    def __init__(self, centre, radius) -> None:
        self.centre, self.radius = np.array(centre), radius

    def values(self, q, qd, qdd):
        return (((q - self.centre) ** 2).sum(axis=1) / self.radius**2)[:, None]

    def slopes(self, q, qd, qdd):
        return (2 * (q - self.centre) / self.radius**2)[:, None, :, None]


class Nearest(MotionProgram):
    """Come as near as possible to wanted states."""

    def __init__(self, seed: int, constraints=()) -> None:
        rng = np.random.default_rng(seed)
        self.bases = tuple(rng.normal(size=(15, 4)) for _ in range(3))
        self.wanted = [rng.normal(size=(15, 2)) * 3 for _ in range(3)]
        self.centre = np.zeros((3, 2))
        self.half = np.array([[1.0, 2.0], [1.5, np.inf], [2.0, 2.5]])
        self.constraints = tuple(constraints)
        self.margin = 0.0

    def evaluate(self, q, qd, qdd) -> Evaluation:
        away = [x - w for x, w in zip((q, qd, qdd), self.wanted, strict=True)]
        return Evaluation(
            -sum(float((x**2).sum()) for x in away), lambda: tuple(-2 * x for x in away)
        )


def by_cvxpy(program: Nearest, disc: Disc | None = None) -> float:
    c = cp.Variable((4, 2))
    cost = sum(
        cp.sum_squares(basis @ c - wanted)
        for basis, wanted in zip(program.bases, program.wanted, strict=True)
    )
    limits = [
        cp.abs(basis @ c[:, j]) <= half[j]
        for basis, half in zip(program.bases, program.half, strict=True)
        for j in range(2)
        if np.isfinite(half[j])
    ]
    if disc is not None:
        limits += [cp.norm(program.bases[0][k] @ c - disc.centre) <= disc.radius for k in range(15)]
    return -float(cp.Problem(cp.Minimize(cost), limits).solve(solver=cp.CLARABEL))


def test_convex_programs_end_where_clarabel_ends() -> None:
    for seed in range(5):
        program = Nearest(seed)
        found = solve(program, np.zeros((4, 2)), barrier=(1.0, 1e-7), most_iterations=500)
        best = by_cvxpy(program)
        assert abs(found.value - best) < 1e-4 * abs(best)
        assert program.smallest_margin(found.coefficients) > 0


def test_curved_constraints_end_where_clarabel_ends() -> None:
    disc = Disc([0.1, -0.2], 0.9)
    for seed in range(3):
        program = Nearest(seed, [disc])
        found = solve(program, np.zeros((4, 2)), barrier=(1.0, 1e-7), most_iterations=500)
        best = by_cvxpy(program, disc)
        assert abs(found.value - best) < 1e-4 * abs(best)


def test_nothing_is_evaluated_outside_the_constraints() -> None:
    disc = Disc([0.0, 0.0], 1.0)
    seen = []

    class Watched(Nearest):
        def evaluate(self, q, qd, qdd) -> Evaluation:
            used = [np.abs(x) / half for x, half in zip((q, qd, qdd), self.half, strict=True)]
            seen.append(max(float(share.max()) for share in (*used, disc.values(q, qd, qdd))))
            return super().evaluate(q, qd, qdd)

    solve(Watched(0, [disc]), np.zeros((4, 2)))
    assert len(seen) > 5
    assert max(seen) < 1


def test_an_infeasible_start_is_no_start_and_a_stop_keeps_the_start() -> None:
    program = Nearest(0)
    assert solve(program, np.full((4, 2), 100.0)) is None
    stopped = solve(program, np.zeros((4, 2)), cancelled=lambda: True)
    assert np.array_equal(stopped.coefficients, np.zeros((4, 2)))
