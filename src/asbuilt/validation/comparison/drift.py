"""Comparison of two results of one robot: two dates, or two models."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from asbuilt.arrays import Mask
from asbuilt.codec import make_plain
from asbuilt.errors import ResultError
from asbuilt.findings import join_names
from asbuilt.identification.result.result import IdentificationResult
from asbuilt.identification.result.summary import DROPPED, MOST_PARAMETERS
from asbuilt.tables import (
    Cell,
    Column,
    Shown,
    Table,
    format_deviation,
    format_estimate,
    round_beside,
    round_with_error,
    stack_tables,
    wrap_text,
)
from asbuilt.tables import format_share as percentage
from asbuilt.validation.comparison.compared_parameter import (
    FELT_AT,
    NAMES,
    RELEVANCE,
    ParameterTest,
    list_tests,
    make_torque_column,
    rank_by_torque,
)
from asbuilt.validation.comparison.comparison import FALSE_DISCOVERY_RATE, recording_name
from asbuilt.validation.comparison.equal_terms import Between, ComparedValues, put_on_equal_terms
from asbuilt.validation.comparison.significance import ChiSquare, compare_each
from asbuilt.validation.comparison.torque_change import (
    JointChange,
    derive_joint_changes,
    describe_torque_changes,
    tabulate_joint_changes,
)
from asbuilt.validation.prediction import derive_cad_values, torque_units

LARGEST_GROWTH = 3.0
"""Largest relative change given in percent; beyond it the first value was near zero."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ParameterChange(ParameterTest):
    """Hold one base parameter in two results; what is unknown is None.

    | attribute | meaning |
    |---|---|
    | `changed` | whether it changed significantly |
    | `dropped` | whether a result set it to zero, without an error; it is not tested |
    """

    before: float
    before_error: float
    after: float
    after_error: float
    changed: bool
    dropped: bool = False

    @property
    def error(self) -> float:
        """Standard error of the change."""
        return float(np.hypot(self.before_error, self.after_error))


def describe_other_drives(
    before: IdentificationResult, after: IdentificationResult, labels: tuple[str, ...]
) -> tuple[str, ...]:
    """Return a sentence if the results have different drive terms or nonlinear parameters."""
    one, two = (
        {term.key: str(term) for term in result.base.drive.terms} for result in (before, after)
    )
    if one == two:
        return ()
    alone = [
        (label, [key for key in terms_of if key not in others])
        for label, terms_of, others in zip(labels, (one, two), (two, one), strict=True)
    ]
    parts = [f"only {label} has {', '.join(keys)}" for label, keys in alone if keys]
    changed = ", ".join(key for key, term in one.items() if two.get(key, term) != term)
    if changed:
        parts.append(f"both have {changed}, with other nonlinear parameters or at other joints")
    missing = any(keys for _, keys in alone)
    # The richer set can describe both robots.
    richer = max(before.base.drive, after.base.drive, key=lambda drive: len(drive.terms))
    return (
        f"DIFFERENT DRIVE TERMS: {'; '.join(parts)}."
        f" {'Those that only one has are left out here. ' if missing else ''}What follows may be"
        f" the effect of these terms; identify both with {richer}.",
    )


def describe_dropped(dropped: Mask) -> tuple[str, ...]:
    """Return a sentence if parameters were dropped and so not tested."""
    sentence = (
        f"{np.count_nonzero(dropped)} parameters that one result or both dropped are not tested;"
        " their torque counts as change."
    )
    return (sentence,) if dropped.any() else ()


def describe_friction_changes(
    result: IdentificationResult,
    changes: Sequence[ParameterChange],
    models: tuple[str, ...] | None,
) -> tuple[str, ...]:
    """Return how the drive terms of every joint changed."""
    by_name = {change.name: change for change in changes if change.changed}
    named = {"Fc": "Coulomb friction", "Fv": "viscous friction", "Fo": "offset", "Ia": "armature"}
    found = []
    for number, joint in enumerate(result.joint_names, start=1):
        parts = [
            f"{what} {_describe_change(by_name[f'{symbol}{number}'], models)}"
            for symbol, what in named.items()
            if f"{symbol}{number}" in by_name
        ]
        if parts:
            found.append(f"{joint}: {', '.join(parts)}.")
    return tuple(found) or (f"No drive term {'differs' if models else 'changed'} significantly.",)


def _describe_change(change: ParameterChange, models: tuple[str, ...] | None) -> str:
    """Return both values of a parameter, by how much it grew, and with what it is correlated."""
    before, after = (
        round_with_error(value, error if error > 0 else None)[0]
        for value, error in (
            (change.before, change.before_error),
            (change.after, change.after_error),
        )
    )
    text = (
        f"{before} to {after} {change.unit}"
        if models is None
        else f"{before} ({models[0]}) against {after} {change.unit} ({models[1]})"
    )
    # Near zero a percentage says nothing.
    if change.before > 3 * change.before_error:
        growth = change.after / change.before - 1
        text += f" ({100 * growth:+.0f} %)" if abs(growth) <= LARGEST_GROWTH else ""
    return text + (
        f" (correlated with {join_names(change.shared_with)})" if change.shared_with else ""
    )


MOST_SENTENCES = 4


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Drift:
    """Hold what changed from one result to another of the same robot.

    | attribute | meaning |
    |---|---|
    | `parameters` | parameters of both |
    | `joints` | torque of the changes joint by joint; empty without cause data |
    | `sentences` | the outcome, joint by joint |
    | `of_models` | whether these are two models at one time, which differ, or two dates |
    """

    robot: str
    before: str
    after: str
    joint_names: tuple[str, ...]
    units: tuple[str, ...]
    parameters: tuple[ParameterChange, ...]
    chi_square: ChiSquare
    level: float
    sentences: tuple[str, ...]
    joints: tuple[JointChange, ...] = ()
    of_models: bool = False

    def __repr__(self) -> str:
        return f"<Drift of {self.robot} from {self.before} to {self.after}: {self.verdict()}>"

    def _repr_html_(self) -> str:
        return self.table().as_html()

    @property
    def n_changed(self) -> int:
        """Number of parameters that changed significantly."""
        return sum(parameter.changed for parameter in self.parameters)

    @property
    def n_compared(self) -> int:
        """Number of parameters that both determine with an error."""
        return sum(parameter.sigmas is not None for parameter in self.parameters)

    @property
    def ranked(self) -> tuple[ParameterChange, ...]:
        """The parameters, those whose change has the most torque first."""
        return rank_by_torque(self.parameters)

    def verdict(self) -> str:
        """Return the outcome in a sentence."""
        return (
            f"{self.n_changed} of {self.n_compared} parameters {self._changed} (false discovery"
            f" rate {percentage(self.level, 0)}); all at once: {self.chi_square.text}."
        )

    @property
    def _changed(self) -> str:
        return "differ" if self.of_models else "changed"

    def table(self, *, changed: bool | None = None) -> Table:
        """Return the parameters of both, those with the most torque first.

        Parameters
        ----------
        changed
            Only those that changed significantly, or only the others; None: all.
        """
        names = (self.before, self.after) if self.of_models else ("before", "after")
        change, which = ("difference", "second") if self.of_models else ("change", "later")
        columns = (
            *NAMES,
            Column(
                names[0],
                align="decimal",
                width=20,
                of=lambda change: Shown(change.before, round_beside(change.before, change.error)),
            ),
            Column(
                names[1],
                align="decimal",
                width=20,
                of=lambda change: format_estimate(change.after, change.error)[0],
            ),
            Column(
                "std err",
                align="decimal",
                of=lambda change: format_estimate(change.after, change.error)[1],
            ),
            Column(change, align="right", of=self._show_outcome),
            make_torque_column(self.units),
            FELT_AT,
            RELEVANCE,
        )
        note = (
            f"std err: of the {change}; torque: RMS over all joints on the validation motion of the"
            f" {which} result; joint: the one with the most. A {change} matters if it is"
            " significant and its own part is large compared with a joint's error; shared: the"
            " parameters named could make up for the rest."
        )
        title = {
            None: "Base parameters",
            True: f"Parameters that {self._changed} significantly",
            False: "Parameters within errors, or not tested",
        }
        shown = [parameter for parameter in self.ranked if changed in (None, parameter.changed)]
        # In a short text, changed parameters with the most torque, then others.
        order = sorted(range(len(shown)), key=lambda k: not shown[k].changed)
        return Table.of(
            shown,
            columns,
            title[changed],
            details=(note,),
            important=tuple(order[:MOST_PARAMETERS]) if changed is None else None,
        )

    def _show_outcome(self, change: ParameterChange) -> Cell:
        """Return whether a parameter changed, or by how many standard errors it is off."""
        if change.sigmas is None:
            return DROPPED if change.dropped else "not determined"
        outcome = format_deviation(change.sigmas, np.inf)
        if change.changed:
            outcome = "DIFFERS" if self.of_models else "CHANGED"
        return Shown(change.sigmas, outcome)

    def as_text(self, full: bool = False) -> str:
        """Return verdict, sentences and tables for a terminal.

        Parameters
        ----------
        full
            Show all sentences, parameters and notes; else what fits one screen of 80 columns.
        """
        shown = self.sentences if full else self.sentences[:MOST_SENTENCES]
        lines = [
            wrap_text(f"{self.robot}: {self.after} against {self.before}"),
            wrap_text(self.verdict()),
            *(wrap_text(line, lines=None if full else 3) for line in shown),
        ]
        if len(shown) < len(self.sentences):
            lines.append(f"... {len(self.sentences) - len(shown)} more sentences")
        tables = [self.table()]
        if self.joints:
            tables.insert(
                0, tabulate_joint_changes(self.joints, self.level, of_models=self.of_models)
            )
        return "\n".join(lines) + "\n\n" + stack_tables(tables, full)

    def as_document(self) -> dict[str, Any]:
        """Return plain numbers, lists and None, ready for JSON."""
        return {
            "robot": self.robot,
            "before": self.before,
            "after": self.after,
            "joints": list(self.joint_names),
            "false_discovery_rate": self.level,
            "n_changed": self.n_changed,
            "chi_square": asdict(self.chi_square),
            "verdict": self.verdict(),
            "sentences": list(self.sentences),
            "torque": [asdict(joint) for joint in self.joints],
            "parameters": [
                dict(make_plain(change)) | {"felt_at": change.felt_at} for change in self.ranked
            ],
        }


def compare_results(
    before: IdentificationResult,
    after: IdentificationResult,
    *,
    labels: tuple[str, str] | None = None,
    level: float = FALSE_DISCOVERY_RATE,
    of_models: bool = False,
) -> Drift:
    """Compare two results of one robot parameter by parameter.

    Values are from weighted least squares alone if both results have them, since bounds and
    regularisation shift values by what no covariance counts. Covariances are taken as independent.
    Drive terms that only one result has are left out, and the first sentence says so.

    Parameters
    ----------
    before, after
        The results.
    level
        False discovery rate up to which a parameter changed.
    labels
        Names of the two; None: their recordings.
    of_models
        Compare the values as identified, as two models of one robot at one time.

    Returns
    -------
    Drift
        Changes of parameters and of torque.

    Raises
    ------
    ResultError
        If the robots differ in joints or geometry.
    """
    # Raises where joints or geometry differ.
    derive_cad_values(before, after.model)
    names = [name for name in before.base.names if name in after.base.names]
    one, two = ([result.base.names.index(name) for name in names] for result in (before, after))
    for i, j in zip(one, two, strict=True):
        # One name may stand for other combinations where drive terms differ.
        if before.base.expressions[i] != after.base.expressions[j]:
            raise ResultError(
                f"{before.base.names[i]} stands for {before.base.expressions[i]} in one result and"
                f" for {after.base.expressions[j]} in the other; identify both with the same drive"
                " terms"
            )
    first, second, terms = (
        (ComparedValues.own(before), ComparedValues.own(after), ())
        if of_models
        else put_on_equal_terms(before, after)
    )
    first = first.at(one)
    second = second.at(two)
    between = Between(first, second)
    difference = between.difference
    error = between.std_errors
    dropped = first.dropped | second.dropped
    tested = first.determined & second.determined & ~dropped & (error > 0)
    tests = compare_each(difference, error, between.degrees_of_freedom, tested)
    changed = tests[2] <= level
    joints: tuple[JointChange, ...] = ()
    if after.cause_data is not None:
        joints = derive_joint_changes(
            after, names, difference, between.covariance, between.mean_degrees
        )
    changes = []
    for k, test in enumerate(list_tests(after, two, difference, tests)):
        # What may be no change at all neither matters nor is shared.
        if not changed[k] and "matters" in test:
            test |= {"matters": False, "shared_with": ()}
        changes.append(
            ParameterChange(
                before=float(first.estimates[k]),
                before_error=float(first.std_errors[k]),
                after=float(second.estimates[k]),
                after_error=float(second.std_errors[k]),
                changed=bool(changed[k]),
                dropped=bool(dropped[k]),
                **test,
            )
        )
    titles = labels or tuple(
        ", ".join(recording_name(source) for source in result.sources) for result in (before, after)
    )
    return Drift(
        robot=after.robot,
        before=titles[0],
        after=titles[1],
        joint_names=after.joint_names,
        units=torque_units(after.model),
        parameters=tuple(changes),
        chi_square=between.test(tested),
        level=level,
        sentences=(
            *describe_other_drives(before, after, titles),
            *describe_torque_changes(joints, level, of_models=of_models),
            *terms,
            *describe_dropped(dropped),
            *describe_friction_changes(after, changes, titles if of_models else None),
        ),
        joints=joints,
        of_models=of_models,
    )
