"""Drive terms that the model lacks: friction of another form, springs, balancers, cables."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from asbuilt.arrays import Array
from asbuilt.dynamics import DriveSet, DriveTerm, available_terms, drive_columns
from asbuilt.identification.drives.nonlinear_parameters import credible_range
from asbuilt.identification.effects.effect import (
    EFFECTS,
    Described,
    Effect,
    FoundEffect,
    Motion,
    Variant,
)
from asbuilt.identification.effects.gathering import Candidate

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
"""Forms in which terms are searched. A cable and a force between two points have four columns each,
so that the better curve has the name."""
NAMED_ONLY = ("cable",)
"""Terms that are in a model if stated: a power series once predicted another motion with 290 % of
error where a balancer acted."""


class DriveEffect(Effect):
    """Add a drive term at a joint."""

    def __init__(self, term: DriveTerm) -> None:
        """Take the term at every joint, its nonlinear parameters free."""
        self.forms = [term.with_nonlinear(form) for form in FORMS.get(term.key, ({},))]
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
        # Terms by the command or the motor need a log that has it; those of position act in every
        # one.
        if not term.can_be_found or not (term.by_construction or robot.source in term.tried_for):
            return
        described = [
            other
            for other in robot.drive.terms
            if other.key == term.key or (other.by_construction and term.by_construction)
        ]
        joints = tuple(
            k for k in range(robot.model.n_joints) if not any(other.is_at(k) for other in described)
        )
        if not joints:
            return
        for form in self.forms:
            # A constant among the functions is zero by a stated parameter.
            n_columns = sum(bool(function) for function in form.functions())
            for trial in _list_trials(form, robot):
                yield Variant(self, n_columns, local=True, joints=joints, term=trial)

    def columns(self, variant: Variant, motion: Motion) -> list[Array]:
        """Return the term's columns at every joint's own state."""
        term = variant.term
        n = motion.q.shape[1]
        load = motion.torques[0] if self.term.needs_load else None
        drive = DriveSet((self.term if term is None else term,))
        # Every joint's column is evaluated, as the joints share a slot; a candidate takes its own.
        joint_columns = [
            drive_columns(drive, k, motion.q, motion.qd, motion.qdd, load=load) for k in range(n)
        ]
        return [
            np.stack([columns[c] for columns in joint_columns], axis=1)
            for c in range(variant.n_columns)
        ]


def _list_trials(term: DriveTerm, robot: Described) -> Iterator[DriveTerm]:
    """Yield the term with trial values of its first free nonlinear parameter."""
    if not term.free_nonlinear:
        yield term
        return
    parameter = term.free_nonlinear[0]
    lowest, highest = credible_range(robot.model, parameter, [np.abs(s) for s in robot.speeds])
    # A joint at rest has the range 0, which has no ratios.
    edges = np.geomspace(np.maximum(lowest, 1e-9), np.maximum(highest, 1e-9), 2 * TRIALS + 1)
    # Odd edges of the doubled grid are the middles of equal ratios: no trial is at an extreme.
    for values in edges[1::2]:
        yield term.with_nonlinear({parameter.name: tuple(values.tolist())})


def with_terms(drive: DriveSet, candidates: Sequence[Candidate], n_joints: int) -> DriveSet:
    """Return drive terms with the terms of candidates, in place of simpler ones they replace."""
    for effect in dict.fromkeys(candidate.effect for candidate in candidates):
        assert isinstance(effect, DriveEffect)
        forms = {e.joint: e.term for e in candidates if e.effect is effect and e.joint is not None}
        added = set(forms)
        term = effect.term
        had = next((other for other in drive.terms if other.key == term.key), None)
        joints = added | {k for k in range(n_joints) if had is not None and had.is_at(k)}
        drive = drive.with_term(
            _place_term(_take_forms(had or term, forms, n_joints), joints, n_joints)
        )
        simple = next((other for other in drive.terms if other.key == term.stands_for), None)
        if simple is not None:
            # Where the simpler term was not replaced it stays.
            left = {k for k in range(n_joints) if simple.is_at(k)} - added
            drive = drive.without(simple.key)
            drive = drive.with_term(_place_term(simple, left, n_joints)) if left else drive
    return drive


def drop_terms(
    drive: DriveSet, places: Collection[tuple[str, str]], joint_names: Sequence[str]
) -> DriveSet:
    """Return drive terms without those of some keys at some joints, by name.

    The simpler term that one replaces takes its place again.
    """
    n_joints = len(joint_names)
    for key, joint in places:
        term = next(term for term in drive.terms if term.key == key)
        left = {k for k, name in enumerate(joint_names) if term.is_at(k) and name != joint}
        drive = drive.without(key)
        drive = drive.with_term(_place_term(term, left, n_joints)) if left else drive
        if term.stands_for is not None:
            had = next((other for other in drive.terms if other.key == term.stands_for), None)
            there = {k for k in range(n_joints) if had is not None and had.is_at(k)}
            simple = had or available_terms()[term.stands_for]
            drive = drive.with_term(
                _place_term(simple, there | {joint_names.index(joint)}, n_joints)
            )
    return drive


def takes_place_of_simpler(effect: FoundEffect) -> bool:
    """Return whether an effect is a drive term in place of a simpler one."""
    term = getattr(EFFECTS[effect.effect], "term", None)
    return term is not None and term.stands_for is not None


def _take_forms(term: DriveTerm, found: Mapping[int, DriveTerm | None], n_joints: int) -> DriveTerm:
    """Return a term in the form in which it was found at each joint."""
    for parameter in term.nonlinear:
        # A joint where the term was not found keeps what it had.
        there = [(found.get(k) or term).at(k).value(parameter.name) for k in range(n_joints)]
        # Fitted parameters get their values later; forms differ in those that stay as stated.
        if not parameter.fitted and set(there) != {parameter.default}:
            term = term.with_nonlinear({parameter.name: tuple(there)})
    return term


def _place_term(term: DriveTerm, joints: Collection[int], n_joints: int) -> DriveTerm:
    numbers = tuple(sorted(k + 1 for k in joints))
    # `None` is every joint: the drive of a whole robot is then written without a list.
    return replace(term, joints=None if len(numbers) == n_joints else numbers)


for _term in available_terms().values():
    if _term.by_construction or _term.tried_for:
        EFFECTS.register(_term.key, DriveEffect(_term))
