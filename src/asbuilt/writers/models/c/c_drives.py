"""The drive terms of a robot as straight-line arithmetic in C."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Array
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.dynamics.drives.term import DriveTerm
from asbuilt.errors import UsageError
from asbuilt.writers.models.c.c_dynamics import Mechanism
from asbuilt.writers.models.c.c_expressions import ONE, ZERO, StraightLine, Term


@dataclass(frozen=True, slots=True)
class DriveState:
    """Hold what the columns of a drive term are written from.

    The motion of the joint, or of a motor that several joints turn, and the load of the joint.
    """

    code: StraightLine
    term: DriveTerm
    q: Term
    qd: Term
    qdd: Term
    load: Term

    @property
    def sign(self) -> Term:
        """Sign of the velocity, 0 at standstill."""
        return self.given("(double)(({qd} > 0.0) - ({qd} < 0.0))")

    def given(self, text: str) -> Term:
        """Define a variable by a C expression in `{q}`, `{qd}` and `{load}` and the nonlinear parameters of the
        term.
        """
        parameters = {
            parameter.name: repr(float(self.term.value(parameter.name)))
            for parameter in self.term.nonlinear
        }
        names = {name: getattr(self, name) for name in ("q", "qd", "load") if f"{{{name}}}" in text}
        written = text.format(
            **parameters, **{name: term.written() for name, term in names.items()}
        )
        return self.code.given(written, *(term.name for term in names.values()))

    def signed(self, text: str) -> Term:
        """Return the sign of the velocity times a C expression."""
        return self.code.total((self.sign, self.given(text)))


COLUMNS: dict[str, Callable[[DriveState], tuple[Term, ...]]] = {
    "armature": lambda at: (at.qdd,),
    "motor_armature": lambda at: (at.qdd,),
    "viscous": lambda at: (at.qd,),
    "motor_viscous": lambda at: (at.qd,),
    "asymmetric_viscous": lambda at: (
        at.given("{qd} > 0.0 ? {qd} : 0.0"),
        at.given("{qd} < 0.0 ? {qd} : 0.0"),
    ),
    "quadratic": lambda at: (at.given("{qd} > 0.0 ? {qd}*{qd} : -({qd}*{qd})"),),
    "cubic": lambda at: (at.given("{qd}*{qd}*{qd}"),),
    "power": lambda at: (at.signed("pow(fabs({qd}), {exponent})"),),
    "coulomb": lambda at: (at.sign,),
    "motor_coulomb": lambda at: (at.sign,),
    "asymmetric_coulomb": lambda at: (
        at.given("(double)({qd} > 0.0)"),
        -at.given("(double)({qd} < 0.0)"),
    ),
    "smooth_coulomb": lambda at: (at.given("tanh({qd}/{width})"),),
    "stribeck": lambda at: (at.signed("exp(-pow(fabs({qd})/{velocity}, {power}))"),),
    "load_friction": lambda at: (at.signed("fabs({load})"),),
    "spring": lambda at: (at.q,),
    "balancer": lambda at: (at.given("sin({q})"), at.given("cos({q})")),
    "offset": lambda at: (ONE,),
}
"""The columns of each drive term."""


def drive_entries(
    mechanism: Mechanism, drive: DriveSet, parameters: Array
) -> list[dict[int, Term]]:
    """Return for each drive parameter, joint by joint, the joints that it acts on and its column
    there; motors that several joints turn act on all of these.

    `parameters` (10 n,) of the links give the load of terms that depend on it. Raises UsageError
    for a term that is not among `COLUMNS`.
    """
    code, shares = mechanism.code, mechanism.model.motor_shares
    loads = mechanism.torques(parameters) if drive.needs_load else [ZERO] * mechanism.model.n_joints
    entries: list[dict[int, Term]] = []
    for k, load in enumerate(loads):
        for term in drive.at(k).terms:
            if term.key not in COLUMNS:
                raise UsageError(
                    f"drive term {term.key!r} cannot be written as C yet; written are"
                    f" {', '.join(COLUMNS)}"
                )
            acts_on = shares[k] if term.of_motor else np.eye(len(loads))[k]
            if not term.is_at(k) or not acts_on.any():
                entries += [{} for _ in term.symbols]
                continue
            q, qd, qdd = (
                code.sum(*[Term(float(share), f"{array}[{j}]") for j, share in enumerate(acts_on)])
                for array in ("q", "qd", "qdd")
            )
            columns = COLUMNS[term.key](DriveState(code, term, q, qd, qdd, load))
            entries += [
                {
                    int(j): code.total((Term(float(acts_on[j])), column))
                    for j in np.flatnonzero(acts_on)
                }
                for column in columns
            ]
    return entries
