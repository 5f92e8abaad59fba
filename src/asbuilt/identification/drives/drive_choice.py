"""Which drive terms a recording supports.

Credible as physics, and worth it on time blocks held out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from asbuilt.arrays import Array, Indices
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import find_base_parameters
from asbuilt.dynamics.drives.defaults import usual_drive
from asbuilt.dynamics.drives.selection import DriveSet, available_terms
from asbuilt.dynamics.drives.term import DriveTerm, NonlinearParameter
from asbuilt.dynamics.kernels.blas import one_blas_thread
from asbuilt.errors import UsageError
from asbuilt.findings import Cure, Finding
from asbuilt.identification.drives.drive_candidates import (
    CandidateColumns,
    Choice,
    Folds,
    Placed,
    candidates,
    chosen_drive,
)
from asbuilt.identification.drives.nonlinear_parameters import fit_nonlinear, thinned
from asbuilt.identification.errors.nonlinear_errors import NonlinearPlace
from asbuilt.identification.estimators.least_squares import (
    LARGE_CONDITION,
    fit_least_squares,
    noise_floor,
)
from asbuilt.identification.information.held_out import held_out_errors
from asbuilt.identification.information.square_root_information import accumulate_stream
from asbuilt.identification.result.torque_prediction import carrying

if TYPE_CHECKING:
    from asbuilt.experiment.signal.samples import Samples


AUTO = "auto"
FOLDS = 8
OUTER_FOLDS = 6
"""Folds on which the whole choice is repeated and judged."""
FEWEST_BLOCKS = 6
"""With fewer time blocks nothing can be held out twice and the defaults stay."""
WORTH = 0.005
"""A term is worth taking at a joint where it lowers the joint's held-out error by this fraction,"""
CERTAIN = 2.0
"""and by this many standard errors from fold to fold, at the joint and over all joints;"""
CERTAIN_TOGETHER = 1.0
"""all terms together are worth taking where the choice, repeated without blocks that then judge it,
lowers the error by one standard error.
"""
MOST_PER_JOINT = 4
LOADS = 3
"""Times that the load, of which friction may depend, is taken from the arm as fitted so far."""


@dataclass(frozen=True, slots=True, eq=False)
class Gain:
    """By how much something lowers the torque error on blocks held out.

    The fall of the logarithm of the RMS error, its mean over folds (and joints) and the standard
    error from fold to fold.
    """

    log: float
    std_error: float

    @classmethod
    def between(cls, before: Array, after: Array) -> Gain:
        """Return the gain from squared errors before and after, (folds,) or (folds, n)."""
        logs = 0.5 * np.log(before / after).reshape(len(before), -1).mean(axis=1)
        return cls(float(logs.mean()), float(np.std(logs, ddof=1) / np.sqrt(len(logs))))

    @property
    def fraction(self) -> float:
        """Part of the error that it takes away."""
        return -float(np.expm1(-self.log))

    def exceeds(self, errors: float) -> bool:
        """Whether the gain is larger than so many of its standard errors."""
        return self.log > errors * self.std_error

    def __str__(self) -> str:
        return f"{100 * self.fraction:.1f} +- {100 * self.std_error * (1.0 - self.fraction):.1f} %"


@dataclass(frozen=True, slots=True, eq=False)
class Addition:
    """A term at a joint (from 0) that was looked at, what it gains the joint there, and why it is
    not credible, if so; `taken` says whether it was.
    """

    joint: int
    term: str
    gain: Gain
    objection: str | None
    taken: bool


@dataclass(frozen=True, slots=True, eq=False)
class DriveChoice:
    """The drive terms chosen, with nonlinear parameters stated.

    `sentences` say why, `findings` what is wrong with them.

    `gain` is what the choice as a whole gains on blocks that had no part in it, None where nothing
    was chosen among; `additions` are the terms that were looked at beside the defaults and seemed
    to help; `fitted` are the nonlinear parameters whose values the data told.
    """

    drive: DriveSet
    sentences: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()
    gain: Gain | None = None
    additions: tuple[Addition, ...] = ()
    fitted: tuple[NonlinearPlace, ...] = ()


def settle_drive(
    model: RobotModel, samples: Sequence[Samples], drive: DriveSet | str | None = None
) -> DriveChoice:
    """Return the drive terms to identify with.

    The usual ones of robot and torque source where `drive` is None, as given with its nonlinear parameters
    fitted, or chosen where it is text such as "auto".

    "auto,spring:joints=2" has the terms beside auto in any case. Fitted nonlinear parameters are judged on
    held-out blocks against the set without them, and stay whatever comes of it; a warning says
    where they are worse.
    """
    default = usual_drive(model, samples[0].torque_source)
    if drive is None:
        return DriveChoice(default)
    if isinstance(drive, str):
        return choose_drive(model, samples, default=default_with(default, drive))
    return DriveChoice(drive) if drive.is_linear else _fitted_nonlinear(model, samples, drive)


def is_auto(text: str) -> bool:
    """Whether a list of drive terms leaves the choice to the recording."""
    return AUTO in [part.strip().lower() for part in text.split(",")]


def default_with(default: DriveSet, text: str) -> DriveSet:
    """Return the default set with the terms that stand beside auto in a list.

    Raises UsageError where the list is not one of auto.
    """
    parts = [part.strip() for part in text.split(",")]
    if not is_auto(text):
        raise UsageError(
            f"drive terms {text!r} do not leave a choice; give a DriveSet, or {AUTO!r}"
        )
    for term in DriveSet.parse([part for part in parts if part.lower() != AUTO]).terms:
        default = default.with_term(term)
    return default


def choose_drive(
    model: RobotModel, samples: Sequence[Samples], *, default: DriveSet | None = None
) -> DriveChoice:
    """Choose drive terms joint by joint.

    Those that are credible there and lower the error on held-out time blocks, beside those the
    torque source calls for.

    Credible are the terms that declare themselves so for the torque source (springs and balancers
    never do: a robot has them or not), with nonlinear parameters inside their credible range (where the best
    value lies at its end, the term is not what its name says) and friction that brakes: every
    parameter of the term positive by two standard errors, and none of the others turned negative by
    two. The term must lower the joint's error and that of all joints by two standard errors from
    fold to fold. Then the whole choice is repeated without some blocks, which judge it: unless the
    error falls by more than one standard error there, the defaults stay (the one-standard-error
    rule: of models that cannot be told apart, the simplest). Where the motion hardly tells the
    defaults apart (scaled condition number above 200), or the recording is too short, they stay
    too.

    Source: Breiman, Friedman, Olshen and Stone, Classification and Regression Trees, 1984, section
    3.4 (one standard error); Varma and Simon, BMC Bioinformatics 7, 2006 (nested choice).
    """
    start = default if default is not None else usual_drive(model, samples[0].torque_source)
    fit = None if start.is_linear else fit_nonlinear(model, start, samples)
    start, told = (start, ()) if fit is None else (fit.drive, fit.places)
    n_blocks = len(thinned(model, samples))
    if n_blocks < FEWEST_BLOCKS:
        said = (
            f"drive terms {_named(start)} kept: {n_blocks} time blocks are too few to choose among"
            " more by holding some out"
        )
        return DriveChoice(start, (said,), fitted=told)
    plain = accumulate_stream(model, find_base_parameters(model, start), samples)
    fitted = fit_least_squares(plain, weights="joint", prior=np.zeros(plain.base.n_base))
    condition = fitted.solution.scaled_condition_number
    if not condition <= LARGE_CONDITION:
        said = (
            f"drive terms {_named(start)} kept: the motion hardly tells these apart (scaled"
            f" condition number {condition:.3g}, above {LARGE_CONDITION:g}), so richer sets were"
            " not tried; record a richer motion"
        )
        return DriveChoice(start, (said,), fitted=told)
    tried = candidates(model, start, samples[0].torque_source, samples)
    arm = fitted.beta
    choice: Choice = ()
    with one_blas_thread():
        for _ in range(LOADS):
            loaded, before = carrying(model, plain.base, arm), choice
            columns = CandidateColumns(
                loaded,
                plain.base,
                tried,
                samples,
                1.0 / np.where(fitted.sigma > 0.0, fitted.sigma, noise_floor(plain)),
            )
            choice, additions = _chosen(columns, columns.blocks)
            if choice == before or not any(tried[c].term.needs_load for _, c in choice):
                break
            arm = columns.learnt(choice, columns.blocks)[: plain.base.n_base]
        gain = _nested_gain(columns) if choice else None
    chosen, untold, refined = _refined(loaded, samples, start, columns, choice)
    additions = [
        (
            replace(each, taken=False, objection="its nonlinear parameter is not told")
            if (each.joint, each.term) in untold
            else each
        )
        for each in additions
    ]
    concluded = _concluded(
        loaded.joint_names, start, chosen, len(tried), gain if chosen != start else None, additions
    )
    return replace(concluded, fitted=(*told, *refined) if concluded.drive == chosen else told)


def _chosen(columns: CandidateColumns, blocks: Indices) -> tuple[Choice, list[Addition]]:
    """Return the candidates that these blocks support, and what was looked at on the way."""
    folds = Folds(columns, blocks, FOLDS)
    choice: Choice = ()
    looked: dict[tuple[int, str], Addition] = {}
    open_joints = list(range(columns.model.n_joints))
    for _ in range(MOST_PER_JOINT):
        found = [_best_at(columns, folds, choice, k, looked) for k in open_joints]
        added = tuple(placed for placed in found if placed is not None)
        choice, open_joints = (*choice, *added), [joint for joint, _ in added]
    return choice, list(looked.values())


def _best_at(
    columns: CandidateColumns,
    folds: Folds,
    choice: Choice,
    joint: int,
    looked: dict[tuple[int, str], Addition],
) -> Placed | None:
    """Return the credible term that lowers the held-out error most at a joint, None where none is
    worth it; what was looked at is noted.
    """
    before = folds.fit(choice)
    there = [columns.tried[c].term for k, c in choice if k == joint]
    taken = {term.key for term in there} | {term.stands_for for term in there if term.stands_for}
    best: tuple[float, Placed, str] | None = None
    for key in dict.fromkeys(each.key for each in columns.tried):
        nonlinear = [c for c, each in enumerate(columns.tried) if each.key == key]
        stands_for = columns.tried[nonlinear[0]].term.stands_for
        if key in taken or stands_for in taken:
            continue
        placed = min(
            ((joint, c) for c in nonlinear),
            key=lambda at: float(np.log(folds.fit((*choice, at)).held_out).mean()),
        )
        after = folds.fit((*choice, placed))
        own = Gain.between(before.held_out[:, joint], after.held_out[:, joint])
        together = Gain.between(before.held_out, after.held_out)
        if own.fraction < WORTH or not own.exceeds(CERTAIN_TOGETHER):
            continue
        objection = _objection(columns, before.parameters, after.parameters, placed)
        looked[joint, key] = Addition(joint, key, own, objection, False)
        if (
            objection is None
            and own.exceeds(CERTAIN)
            and together.exceeds(CERTAIN)
            and (best is None or together.log > best[0])
        ):
            best = (together.log, placed, key)
    if best is None:
        return None
    looked[joint, best[2]] = replace(looked[joint, best[2]], taken=True)
    return best[1]


def _objection(
    columns: CandidateColumns, before: Array, after: Array, placed: Placed
) -> str | None:
    """Say why a term at a joint is not credible.

    `before` and `after` (folds, P) are the parameters learnt without and with it.
    """
    candidate = columns.tried[placed[1]]
    if candidate.at_bound:
        nonlinear = candidate.term.free_nonlinear or candidate.term.nonlinear
        return f"its best {nonlinear[0].name} lies at an end of the credible range"
    if not np.all(surely_positive(after[:, columns.own_places(placed)])):
        return "its parameters do not come out positive"
    for term, places in columns.drive_places[placed[0]]:
        if term.non_negative and np.any(
            surely_positive(-after[:, places]) & ~surely_positive(-before[:, places])
        ):
            return f"{term.key} would become negative beside it"
    return None


def surely_positive(parameters: Array) -> NDArray[np.bool_]:
    """Return which parameters (folds, m), each learnt without one fold, are positive by two
    standard errors of a jackknife over the folds.
    """
    folds, mean = len(parameters), parameters.mean(axis=0)
    errors = np.sqrt((folds - 1) / folds * np.sum((parameters - mean) ** 2, axis=0))
    return np.asarray(mean > CERTAIN * errors)


def _nested_gain(columns: CandidateColumns) -> Gain:
    """Return what the choice gains on blocks that have no part in it, the choice repeated on the
    others.
    """
    before: list[Array] = []
    after: list[Array] = []
    for fold in np.array_split(columns.blocks, OUTER_FOLDS):
        rest = np.setdiff1d(columns.blocks, fold)
        before.append(columns.squared_error(columns.learnt((), rest), fold))
        after.append(columns.squared_error(columns.learnt(_chosen(columns, rest)[0], rest), fold))
    return Gain.between(np.array(before), np.array(after))


def _concluded(
    names: Sequence[str],
    start: DriveSet,
    chosen: DriveSet,
    n_tried: int,
    gain: Gain | None,
    additions: Sequence[Addition],
) -> DriveChoice:
    """Return the choice with what is to be said of it; `gain` None where nothing was chosen."""
    refused = [
        f"{each.term} at {names[each.joint]} ({each.gain}; {each.objection})"
        for each in additions
        if each.objection is not None and each.gain.exceeds(CERTAIN)
    ]
    objections = (f"not credible, so left out: {'; '.join(refused)}",) if refused else ()
    if gain is None:
        said = (
            f"drive terms {_named(start)} kept: of {n_tried} others none is credible and surely"
            " lowers the torque error on held-out blocks"
        )
        return DriveChoice(start, (said, *objections), (), None, tuple(additions))
    added = ", ".join(
        f"{each.term} at {names[each.joint]} ({each.gain})"
        for each in sorted(additions, key=lambda a: a.joint)
        if each.taken
    )
    if not gain.exceeds(CERTAIN_TOGETHER):
        said = (
            f"drive terms {_named(start)} kept: chosen anew without some blocks, richer ones lower"
            f" the torque error there by {gain} only ({added})"
        )
        return DriveChoice(
            start,
            (said, *objections),
            (),
            gain,
            tuple(replace(each, taken=False) for each in additions),
        )
    sentences = [
        f"drive terms {_named(chosen)} chosen beside {_named(start)}; each lowers its joint's"
        f" torque error on held-out blocks: {added}; the choice made anew without the blocks that"
        f" judge it, all joints: {gain}"
    ]
    nonlinear = [
        f"{parameter.name} of {term.key}"
        f" {', '.join(_nonlinear_at(term, parameter, k, names) for k in range(len(names)) if term.is_at(k))}"
        for term in chosen.terms
        for parameter in term.nonlinear
    ]
    sentences += [f"fitted parameters: {'; '.join(nonlinear)}"] if nonlinear else []
    return DriveChoice(chosen, (*sentences, *objections), (), gain, tuple(additions))


def _nonlinear_at(
    term: DriveTerm, parameter: NonlinearParameter, joint: int, names: Sequence[str]
) -> str:
    return (
        f"{names[joint]}"
        f" {term.at(joint).value(parameter.name):.3g}{f' {parameter.unit}' if parameter.unit else ''}"
    )


def _refined(
    loaded: RobotModel,
    samples: Sequence[Samples],
    start: DriveSet,
    columns: CandidateColumns,
    choice: Choice,
) -> tuple[DriveSet, set[tuple[int, str]], tuple[NonlinearPlace, ...]]:
    """Return the set of a choice with its nonlinear parameters refined between the values tried, less the terms,
    by joint and key, whose nonlinear parameter all blocks together do not tell; and the nonlinear parameters told.
    """
    n = loaded.n_joints
    rough = chosen_drive(start, columns.tried, choice, n)
    free = DriveSet(
        tuple(
            (
                term
                if term.key in start.keys
                else replace(available_terms()[term.key], joints=term.joints)
            )
            for term in rough.terms
        )
    )
    if free.is_linear:
        return rough, set(), ()
    found_all = fit_nonlinear(loaded, free, samples)
    fitted = found_all.nonlinear
    untold = {
        (k, found.term)
        for found in fitted
        for k, c in choice
        if columns.tried[c].key == found.term and not found.told[k]
    }
    chosen = chosen_drive(
        start,
        columns.tried,
        tuple((k, c) for k, c in choice if (k, columns.tried[c].key) not in untold),
        n,
    )
    for found in fitted:
        for term in chosen.terms:
            if term.key == found.term:
                chosen = chosen.with_term(term.with_nonlinear({found.parameter.name: found.values}))
    return (
        chosen,
        untold,
        tuple(place for place in found_all.places if (place.joint, place.term) not in untold),
    )


def _fitted_nonlinear(
    model: RobotModel, samples: Sequence[Samples], drive: DriveSet
) -> DriveChoice:
    """Return a set with its nonlinear parameters fitted, and what held-out blocks say of that against the set
    without these terms.
    """
    nonlinear = [term for term in drive.terms if term.free_nonlinear]
    plain = drive.without(*(term.key for term in nonlinear))
    for term in nonlinear:
        if term.stands_for is not None and term.stands_for not in plain.keys:
            plain = plain.with_term(available_terms()[term.stands_for])
    found = fit_nonlinear(model, drive, samples)
    findings = found.findings(model.joint_names)
    both = [_judged(model, samples, each) for each in (plain, found.drive)]
    if both[0] is None or both[1] is None:
        return DriveChoice(
            found.drive, found.sentences(model.joint_names), findings, fitted=found.places
        )
    gain = Gain.between(both[0], both[1])
    change = (
        f"torque error on held-out blocks {-100 * gain.fraction:+.1f} % against {_named(plain)}"
    )
    if gain.fraction < 0:
        listed = ", ".join(term.key for term in nonlinear)
        finding = Finding(
            "nonlinear_parameters",
            "warning",
            f"Fitted {listed} do not lower the torque error: {change}",
            Cure("leave them out, or state their parameters"),
        )
        findings = (*findings, finding)
    return DriveChoice(
        found.drive,
        (*found.sentences(model.joint_names), change),
        findings,
        gain,
        fitted=found.places,
    )


def _judged(model: RobotModel, samples: Sequence[Samples], drive: DriveSet) -> Array | None:
    """Return squared errors per sample on held-out folds, (folds, n), None where there are too few
    blocks.
    """
    information = accumulate_stream(model, find_base_parameters(model, drive), samples)
    if information.n_blocks < FEWEST_BLOCKS:
        return None
    prior = np.zeros(information.base.n_base)
    weights = 1.0 / fit_least_squares(information, weights="joint", prior=prior).sigma
    groups = np.array_split(np.arange(information.n_blocks), min(FOLDS, information.n_blocks))
    return held_out_errors(
        information,
        lambda part: fit_least_squares(part, weights=weights, prior=prior).beta,
        groups,
    )[0]


def _named(drive: DriveSet) -> str:
    """Return the keys of a set, with the joints of terms that only some have."""
    return ", ".join(
        term.key
        + (
            ""
            if term.joints is None
            else f" (joint{'s' if len(term.joints) > 1 else ''} {', '.join(map(str, term.joints))})"
        )
        for term in drive.terms
    )
