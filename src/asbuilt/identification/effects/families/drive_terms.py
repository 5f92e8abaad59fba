"""Drive terms that the model lacks: friction of another form, springs, balancers, cables."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from asbuilt.arrays import Array
from asbuilt.dynamics.drives.selection import DriveSet, available_terms
from asbuilt.dynamics.drives.term import DriveTerm
from asbuilt.dynamics.drives.torque import drive_columns
from asbuilt.identification.drives.nonlinear_parameters import credible_range
from asbuilt.identification.effects.effect import EFFECTS, Described, Effect, Motion, Variant

TRIALS = 4
"""Trial values of a nonlinear parameter, in equal ratios within its credible range."""

TITLES = {
    "spring": "torsion spring",
    "balancer": "gravity spring or balancer",
    "cable": "cable or other torque over position",
}
"""Names of effects that stand for more than the term does."""
FORMS: dict[str, tuple[dict[str, float], ...]] = {
    "cable": ({"order": 4.0},),
    "balancer": ({"harmonics": 1.0}, {"harmonics": 2.0}),
}
"""Forms in which terms are sought. A cable and a force between two points have four columns each,
so that the better curve has the name."""
NAMED_ONLY = ("cable",)
"""Terms that are in a model if stated: a power series once predicted another motion with 290 % of
error where a balancer acted."""


class DriveEffect(Effect):
    """Add a drive term at a joint."""

    def __init__(self, term: DriveTerm) -> None:
        """Take the term at every joint, its nonlinear parameters free."""
        self.forms = [term.with_nonlinear(each) for each in FORMS.get(term.key, ({},))]
        self.term = self.forms[0]
        self.in_model = term.key not in NAMED_ONLY  # type: ignore[misc]
        self.key = term.key  # type: ignore[misc]
        self.title = TITLES.get(term.key, term.title)  # type: ignore[misc]
        self.kind = (  # type: ignore[misc]
            "position" if term.by_position else "load" if term.needs_load else "friction"
        )
        self.positive = not term.by_construction or term.key == "spring"  # type: ignore[misc]

    def unit(self, revolute: bool) -> str:
        """Return the unit of the term's first parameter."""
        return self.term.units(revolute=revolute)[0]

    def variants(self, robot: Described) -> Iterator[Variant]:
        """Yield the term at trial values of its nonlinear parameter, where it is not described.

        Columns that are zero by a stated parameter, which come last, are left out. A joint whose
        torque over position is described has no second one of another form.
        """
        term = self.term
        if not term.can_be_found or not (term.by_construction or robot.source in term.tried_for):
            return
        own = [
            each
            for each in robot.drive.terms
            if each.key == term.key or (each.by_construction and term.by_construction)
        ]
        joints = tuple(
            k for k in range(robot.model.n_joints) if not any(each.is_at(k) for each in own)
        )
        if not joints:
            return
        for form in self.forms:
            n_columns = sum(bool(function) for function in form.functions())
            for trial in _list_trials(form, robot):
                yield Variant(self, n_columns, local=True, joints=joints, term=trial)

    def columns(self, variant: Variant, motion: Motion) -> list[Array]:
        """Return the term's columns at every joint's own state."""
        term, n = variant.term, motion.q.shape[1]
        load = motion.torques[0] if self.term.needs_load else None
        drive = DriveSet((self.term if term is None else term,))
        each = [
            drive_columns(drive, k, motion.q, motion.qd, motion.qdd, load=load) for k in range(n)
        ]
        return [np.stack([own[c] for own in each], axis=1) for c in range(variant.n_columns)]


def _list_trials(term: DriveTerm, robot: Described) -> Iterator[DriveTerm]:
    """Yield the term with trial values of its first free nonlinear parameter."""
    if not term.free_nonlinear:
        yield term
        return
    parameter = term.free_nonlinear[0]
    lowest, highest = credible_range(robot.model, parameter, [np.abs(s) for s in robot.speeds])
    edges = np.geomspace(np.maximum(lowest, 1e-9), np.maximum(highest, 1e-9), 2 * TRIALS + 1)
    for values in edges[1::2]:
        yield term.with_nonlinear({parameter.name: tuple(values.tolist())})


for _term in available_terms().values():
    if _term.by_construction or _term.tried_for:
        EFFECTS.register(_term.key, DriveEffect(_term))
