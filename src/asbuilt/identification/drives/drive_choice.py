"""Choice of drive terms that a recording supports: credible, and better on held-out blocks."""

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
from asbuilt.identification.estimators.least_squares import LARGE_CONDITION, fit_least_squares
from asbuilt.identification.information.estimate import noise_floor
from asbuilt.identification.information.held_out import held_out_errors
from asbuilt.identification.information.square_root_information import accumulate_stream
from asbuilt.identification.result.torque_prediction import carrying

if TYPE_CHECKING:
    from asbuilt.experiment.signal.samples import Samples


AUTO = "auto"
FOLDS = 8
OUTER_FOLDS = 6
"""Folds of the nested validation, on which the whole choice is repeated."""
FEWEST_BLOCKS = 6
"""Time blocks below which the defaults stay."""
WORTH = 0.005
"""Least fraction by which a term lowers the held-out error of its joint."""
CERTAIN = 2.0
"""Least gain of a term in standard errors over folds, at the joint and over all joints."""
CERTAIN_TOGETHER = 1.0
"""Least gain of the whole choice in standard errors of the nested validation."""
MOST_PER_JOINT = 4
LOADS = 3
"""Iterations of the load of load-dependent friction."""


@dataclass(frozen=True, slots=True, eq=False)
class Gain:
    """Hold the decrease of the log RMS error on held-out blocks, with standard error over folds."""

    log: float
    std_error: float

    @classmethod
    def between(cls, before: Array, after: Array) -> Gain:
        """Return the gain from squared errors before and after, (folds,) or (folds, n).

        Joints without torque have no error, and no part in it.
        """
        seen = np.broadcast_to(np.any(before > 0.0, axis=0), before.shape)
        ratio = (before[seen] / after[seen]).reshape(len(before), -1)
        logs = 0.5 * np.log(ratio).mean(axis=1)
        return cls(float(logs.mean()), float(np.std(logs, ddof=1) / np.sqrt(len(logs))))

    @property
    def fraction(self) -> float:
        """Fraction of the error."""
        return -float(np.expm1(-self.log))

    def exceeds(self, errors: float) -> bool:
        """Return whether the gain exceeds so many of its standard errors."""
        return self.log > errors * self.std_error

    def __str__(self) -> str:
        return f"{100 * self.fraction:.1f} +- {100 * self.std_error * (1.0 - self.fraction):.1f} %"


@dataclass(frozen=True, slots=True, eq=False)
class Addition:
    """Hold a tried term at a joint (from 0), its gain there, any objection, and if it was taken."""

    joint: int
    term: str
    gain: Gain
    objection: str | None
    taken: bool


@dataclass(frozen=True, slots=True, eq=False)
class DriveChoice:
    """Hold chosen drive terms with values of all nonlinear parameters.

    Parameters
    ----------
    drive
        The chosen terms.
    sentences, findings
        Reasons, and what is wrong with the choice.
    gain
        Gain of the whole choice in nested validation; None without choice.
    additions
        Terms that were tried beside the defaults and lowered the error.
    fitted
        Nonlinear parameters that the data determine.
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

    Parameters
    ----------
    model, samples
        Robot and recordings.
    drive
        None for the usual terms of robot and torque source; a set, whose free nonlinear parameters
        are fitted and compared on held-out blocks with the set without them; or text such as
        "auto" or "auto,spring:joints=2" to choose, with the listed terms in any case.
    """
    default = usual_drive(model, samples[0].torque_source)
    if drive is None:
        return DriveChoice(default)
    if isinstance(drive, str):
        return choose_drive(model, samples, default=default_with(default, drive))
    return DriveChoice(drive) if drive.is_linear else _fitted_nonlinear(model, samples, drive)


def is_auto(text: str) -> bool:
    """Return whether a list of drive terms contains "auto"."""
    return AUTO in [part.strip().lower() for part in text.split(",")]


def default_with(default: DriveSet, text: str) -> DriveSet:
    """Return the default set with the terms listed beside auto; `UsageError` without auto."""
    parts = [part.strip() for part in text.split(",")]
    if not is_auto(text):
        raise UsageError(
            f"drive terms {text!r} do not leave a choice; expected a DriveSet, or {AUTO!r} in it"
        )
    for term in DriveSet.parse([part for part in parts if part.lower() != AUTO]).terms:
        default = default.with_term(term)
    return default


def choose_drive(
    model: RobotModel, samples: Sequence[Samples], *, default: DriveSet | None = None
) -> DriveChoice:
    """Choose drive terms joint by joint, beside those usual for the torque source.

    A term is credible if it declares itself so for the torque source (springs and balancers never
    do), its nonlinear parameter is inside its credible range, and its friction is dissipative:
    every parameter positive by two standard errors, and no other one made negative by two. It must
    lower the held-out error of the joint and of all joints by two standard errors over folds. In a
    nested validation the whole choice must lower the error by more than one standard error, or the
    defaults stay (one-standard-error rule: the simplest of equivalent models). They also stay if
    the motion hardly separates them (scaled condition number above 200), or the recording is too
    short.

    Source: Breiman, Friedman, Olshen and Stone, Classification and Regression Trees, 1984, section
    3.4 (one standard error); Varma and Simon, BMC Bioinformatics 7, 2006 (nested choice).
    """
    start = default if default is not None else usual_drive(model, samples[0].torque_source)
    fit = None if start.is_linear else fit_nonlinear(model, start, samples)
    start, determined = (start, ()) if fit is None else (fit.drive, fit.places)
    n_blocks = len(thinned(model, samples))
    if n_blocks < FEWEST_BLOCKS:
        said = (
            f"drive terms {_named(start)} kept: {n_blocks} time blocks are too few to choose"
            f" others, {FEWEST_BLOCKS} are needed"
        )
        return DriveChoice(start, (said,), fitted=determined)
    plain = accumulate_stream(model, find_base_parameters(model, start), samples)
    fitted = fit_least_squares(plain, weights="joint", prior=np.zeros(plain.base.n_base))
    condition = fitted.solution.scaled_condition_number
    if not condition <= LARGE_CONDITION:
        said = (
            f"drive terms {_named(start)} kept: the scaled condition number {condition:.3g} is"
            f" above {LARGE_CONDITION:g}, so others were not tried; record more excitation"
        )
        return DriveChoice(start, (said,), fitted=determined)
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
            arm = columns.fitted(choice, columns.blocks)[: plain.base.n_base]
        gain = _nested_gain(columns) if choice else None
    chosen, undetermined, refined = _refined(loaded, samples, start, columns, choice)
    additions = [
        (
            replace(each, taken=False, objection="its nonlinear parameter is undetermined")
            if (each.joint, each.term) in undetermined
            else each
        )
        for each in additions
    ]
    concluded = _concluded(
        loaded.joint_names, start, chosen, len(tried), gain if chosen != start else None, additions
    )
    return replace(
        concluded, fitted=(*determined, *refined) if concluded.drive == chosen else determined
    )


def _chosen(columns: CandidateColumns, blocks: Indices) -> tuple[Choice, list[Addition]]:
    """Return the candidates that these blocks support, and all that were tried."""
    folds = Folds(columns, blocks, FOLDS)
    choice: Choice = ()
    tried_terms: dict[tuple[int, str], Addition] = {}
    open_joints = list(range(columns.model.n_joints))
    for _ in range(MOST_PER_JOINT):
        found = [_best_at(columns, folds, choice, k, tried_terms) for k in open_joints]
        added = tuple(placed for placed in found if placed is not None)
        choice, open_joints = (*choice, *added), [joint for joint, _ in added]
    return choice, list(tried_terms.values())


def _best_at(
    columns: CandidateColumns,
    folds: Folds,
    choice: Choice,
    joint: int,
    tried_terms: dict[tuple[int, str], Addition],
) -> Placed | None:
    """Return the credible term that lowers a joint's held-out error most, if any."""
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
        tried_terms[joint, key] = Addition(joint, key, own, objection, False)
        if (
            objection is None
            and own.exceeds(CERTAIN)
            and together.exceeds(CERTAIN)
            and (best is None or together.log > best[0])
        ):
            best = (together.log, placed, key)
    if best is None:
        return None
    tried_terms[joint, best[2]] = replace(tried_terms[joint, best[2]], taken=True)
    return best[1]


def _objection(
    columns: CandidateColumns, before: Array, after: Array, placed: Placed
) -> str | None:
    """Return why a term is not credible, from parameters (folds, P) without and with it."""
    candidate = columns.tried[placed[1]]
    if candidate.at_bound:
        nonlinear = candidate.term.free_nonlinear or candidate.term.nonlinear
        return f"its best {nonlinear[0].name} lies at an end of the credible range"
    if not np.all(surely_positive(after[:, columns.own_places(placed)])):
        return "its parameters are not positive"
    for term, places in columns.drive_places[placed[0]]:
        if term.non_negative and np.any(
            surely_positive(-after[:, places]) & ~surely_positive(-before[:, places])
        ):
            return f"{term.key} would become negative beside it"
    return None


def surely_positive(parameters: Array) -> NDArray[np.bool_]:
    """Return which parameters (folds, m) are positive by two jackknife standard errors."""
    folds, mean = len(parameters), parameters.mean(axis=0)
    errors = np.sqrt((folds - 1) / folds * np.sum((parameters - mean) ** 2, axis=0))
    return np.asarray(mean > CERTAIN * errors)


def _nested_gain(columns: CandidateColumns) -> Gain:
    """Return the gain on held-out blocks of the choice repeated on the others."""
    before: list[Array] = []
    after: list[Array] = []
    for fold in np.array_split(columns.blocks, OUTER_FOLDS):
        rest = np.setdiff1d(columns.blocks, fold)
        before.append(columns.squared_error(columns.fitted((), rest), fold))
        after.append(columns.squared_error(columns.fitted(_chosen(columns, rest)[0], rest), fold))
    return Gain.between(np.array(before), np.array(after))


def _concluded(
    names: Sequence[str],
    start: DriveSet,
    chosen: DriveSet,
    n_tried: int,
    gain: Gain | None,
    additions: Sequence[Addition],
) -> DriveChoice:
    """Return the choice with its reasons; `gain` is None if nothing was chosen."""
    refused = [
        f"{each.term} at {names[each.joint]} ({each.gain}; {each.objection})"
        for each in additions
        if each.objection is not None and each.gain.exceeds(CERTAIN)
    ]
    objections = (f"not credible, so left out: {'; '.join(refused)}",) if refused else ()
    if gain is None:
        said = (
            f"drive terms {_named(start)} kept: none of {n_tried} others is credible and"
            " significantly lowers the torque error on held-out blocks"
        )
        return DriveChoice(start, (said, *objections), (), None, tuple(additions))
    added = ", ".join(
        f"{each.term} at {names[each.joint]} ({each.gain})"
        for each in sorted(additions, key=lambda a: a.joint)
        if each.taken
    )
    if not gain.exceeds(CERTAIN_TOGETHER):
        said = (
            f"drive terms {_named(start)} kept: in nested validation others lower the torque error"
            f" by only {gain} ({added})"
        )
        return DriveChoice(
            start,
            (said, *objections),
            (),
            gain,
            tuple(replace(each, taken=False) for each in additions),
        )
    sentences = [
        f"drive terms {_named(chosen)} chosen beside {_named(start)}; decrease of the torque error"
        f" on held-out blocks: {added}; of all joints in nested validation: {gain}"
    ]
    nonlinear = [
        f"{parameter.name} of {term.key} "
        + ", ".join(
            _nonlinear_at(term, parameter, k, names) for k in range(len(names)) if term.is_at(k)
        )
        for term in chosen.terms
        for parameter in term.nonlinear
    ]
    sentences += [f"fitted parameters: {'; '.join(nonlinear)}"] if nonlinear else []
    return DriveChoice(chosen, (*sentences, *objections), (), gain, tuple(additions))


def _nonlinear_at(
    term: DriveTerm, parameter: NonlinearParameter, joint: int, names: Sequence[str]
) -> str:
    value = f"{names[joint]} {term.at(joint).value(parameter.name):.3g}"
    return f"{value} {parameter.unit}" if parameter.unit else value


def _refined(
    loaded: RobotModel,
    samples: Sequence[Samples],
    start: DriveSet,
    columns: CandidateColumns,
    choice: Choice,
) -> tuple[DriveSet, set[tuple[int, str]], tuple[NonlinearPlace, ...]]:
    """Return the set of a choice with refined nonlinear parameters.

    Terms, by joint and key, whose nonlinear parameter is undetermined are left out and returned
    too, then the determined nonlinear parameters.
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
    undetermined = {
        (k, found.term)
        for found in fitted
        for k, c in choice
        if columns.tried[c].key == found.term and not found.determined[k]
    }
    chosen = chosen_drive(
        start,
        columns.tried,
        tuple((k, c) for k, c in choice if (k, columns.tried[c].key) not in undetermined),
        n,
    )
    for found in fitted:
        for term in chosen.terms:
            if term.key == found.term:
                chosen = chosen.with_term(term.with_nonlinear({found.parameter.name: found.values}))
    return (
        chosen,
        undetermined,
        tuple(place for place in found_all.places if (place.joint, place.term) not in undetermined),
    )


def _fitted_nonlinear(
    model: RobotModel, samples: Sequence[Samples], drive: DriveSet
) -> DriveChoice:
    """Return a set with fitted nonlinear parameters, compared with the set without these terms."""
    nonlinear = [term for term in drive.terms if term.free_nonlinear]
    plain = drive.without(*(term.key for term in nonlinear))
    for term in nonlinear:
        if term.stands_for is not None and term.stands_for not in plain.keys:
            plain = plain.with_term(available_terms()[term.stands_for])
    found = fit_nonlinear(model, drive, samples)
    findings = found.findings(model.joint_names)
    both = [_held_out(model, samples, each) for each in (plain, found.drive)]
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


def _held_out(model: RobotModel, samples: Sequence[Samples], drive: DriveSet) -> Array | None:
    """Return squared errors per held-out sample (folds, n); None with too few blocks."""
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
