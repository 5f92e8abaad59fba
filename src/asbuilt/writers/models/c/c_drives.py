"""The drive terms of a robot as straight-line arithmetic in C."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from asbuilt.arrays import Array
from asbuilt.dynamics.drives.formula import Formula
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.writers.models.c.c_dynamics import Mechanism
from asbuilt.writers.models.c.c_expressions import ZERO, StraightLine, Term

FUNCTIONS = {
    "divide": "{0}/({1})",
    "power": "pow({0}, {1})",
    "minimum": "fmin({0}, {1})",
    "maximum": "fmax({0}, {1})",
    "abs": "fabs({0})",
    "sign": "(double)(({0} > 0.0) - ({0} < 0.0))",
    **{name: f"{name}({{0}})" for name in ("exp", "log", "sqrt", "sin", "cos", "tanh", "atan")},
}
"""Operations of formulas that are not sums or products."""


def written(code: StraightLine, formula: str, values: Mapping[str, Term]) -> Term:
    """Return a formula of a drive term as C, each name replaced by its value."""

    def apply(operation: str, *operands: Term) -> Term:
        match operation:
            case "add":
                return code.sum(*operands)
            case "subtract":
                return code.sum(operands[0], -operands[1])
            case "negative":
                return -operands[0]
            case "multiply":
                return code.total(operands)
        text = FUNCTIONS[operation].format(*(operand.written() for operand in operands))
        return code.given(text, *(operand.name for operand in operands))

    return Formula(formula).fold(Term, values.__getitem__, apply)


def drive_entries(
    mechanism: Mechanism, drive: DriveSet, parameters: Array
) -> list[dict[int, Term]]:
    """Return for each drive parameter, joint by joint, its column at each joint that it acts on.

    Motors that several joints turn act on all of these. `parameters` (10 n,) of the links give the
    load of terms that depend on it.
    """
    code, shares = mechanism.code, mechanism.model.motor_shares
    loads = mechanism.torques(parameters) if drive.needs_load else [ZERO] * mechanism.model.n_joints
    entries: list[dict[int, Term]] = []
    for k, load in enumerate(loads):
        for term in drive.at(k).terms:
            acts_on = shares[k] if term.of_motor else np.eye(len(loads))[k]
            if not term.is_at(k) or not acts_on.any():
                entries += [{} for _ in term.symbols]
                continue
            state = {"q": mechanism.q, "qd": mechanism.qd, "qdd": mechanism.qdd}
            values = {
                array: code.sum(
                    *[
                        Term(float(share) * term.factor, term.name)
                        for share, term in zip(acts_on, terms, strict=True)
                    ]
                )
                for array, terms in state.items()
            }
            values |= {
                name: Term(term.value(name)) for name in (each.name for each in term.nonlinear)
            }
            columns = [written(code, column, {**values, "load": load}) for column in term.columns]
            entries += [
                {
                    int(j): code.total((Term(float(acts_on[j])), column))
                    for j in np.flatnonzero(acts_on)
                }
                for column in columns
            ]
    return entries
