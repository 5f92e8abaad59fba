"""Two results of one robot held against each other.

Two dates, two tools, the maker's model and the robot.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from asbuilt.errors import ResultError
from asbuilt.identification.result.summary import DROPPED
from asbuilt.tables import (
    Cell,
    Column,
    Shown,
    Table,
    beside,
    deviation,
    rounded,
    significant,
    stacked,
)
from asbuilt.tables import share as percentage
from asbuilt.validation.comparison.compared_parameter import matters_text
from asbuilt.validation.comparison.comparison import FALSE_DISCOVERY_RATE, recording_name
from asbuilt.validation.comparison.equal_terms import ComparedValues, on_equal_terms
from asbuilt.validation.comparison.parameter_text import in_words
from asbuilt.validation.comparison.significance import (
    ChiSquare,
    benjamini_hochberg,
    chi_square,
    holm,
    probability_text,
    two_sided_probability,
)
from asbuilt.validation.comparison.torque_change import (
    JointChange,
    joint_changes,
    joint_table,
    torque_sentence,
)
from asbuilt.validation.comparison.torque_cost import torque_cost
from asbuilt.validation.prediction import design_values, torque_units

if TYPE_CHECKING:
    from asbuilt.identification.result.result import IdentificationResult


TELLING_GROWTH = 3.0
"""Relative change beyond which it is said in numbers alone.

What was next to nothing has grown beyond measure.
"""


@dataclass(frozen=True, slots=True)
class ParameterChange:
    """One base parameter in two results.

    Values, errors, their difference in its standard errors, tests, and the RMS torque it makes
    (None without cause data).

    `changed` says that it did beyond doubt, `matters` that some joint notices what of its change no
    other parameter could make up for; where a joint notices only the whole, `shared_with` names the
    parameters that could. `dropped` says that one of the results set it to zero as needless,
    without an error: it is not tested.
    """

    id: int
    name: str
    expression: str
    unit: str
    before: float
    before_error: float
    after: float
    after_error: float
    sigmas: float | None
    p_value: float | None
    false_discovery: float | None
    holm: float | None
    torque_total: float | None
    felt_at: int | None
    changed: bool
    matters: bool | None
    words: str = ""
    dropped: bool = False
    shared_with: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Drift:
    """Hold what changed from one result to another of the same robot.

    `sentences` say it joint by joint, `joints` what it does to the torque (empty without cause data).

    `of_models` says that the two are models of one robot at one time, which differ where those of
    two dates have changed.
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

    @property
    def n_changed(self) -> int:
        """Number of parameters that changed beyond doubt."""
        return sum(parameter.changed for parameter in self.parameters)

    @property
    def ranked(self) -> tuple[ParameterChange, ...]:
        """The parameters, those whose change makes the most torque first."""
        return tuple(
            sorted(self.parameters, key=lambda change: (-(change.torque_total or 0.0), change.id))
        )

    def verdict(self) -> str:
        """Return the outcome in a sentence."""
        compared = sum(parameter.sigmas is not None for parameter in self.parameters)
        together = (
            f"all at once: chi-square {significant(self.chi_square.statistic)} with"
            f" {self.chi_square.degrees} degrees of freedom, p"
            f" {probability_text(self.chi_square.probability)}"
        )
        return (
            f"{self.n_changed} of {compared} parameters {self._changed} (false discovery rate"
            f" {percentage(self.level, 0)}); {together}."
        )

    @property
    def _changed(self) -> str:
        return "differ" if self.of_models else "changed"

    def table(self, *, changed: bool | None = None) -> Table:
        """Return the parameters of both, what changed most in torque first.

        All, or only those that `changed` beyond doubt or did not.
        """
        heads = (
            Column("id", align="right"),
            Column("parameter", width=28),
            Column("what it is"),
            Column("unit"),
            *(
                Column(name, align="decimal")
                for name in ((self.before, self.after) if self.of_models else ("before", "after"))
            ),
            Column("std err", align="decimal"),
            Column("difference" if self.of_models else "change", align="right"),
            Column("torque", align="decimal"),
            Column("joint", align="right"),
            Column("matters"),
        )
        rows: list[tuple[Cell, ...]] = []
        beyond_doubt = "DIFFERS" if self.of_models else "CHANGED"
        for each in self.ranked:
            if changed is not None and each.changed is not changed:
                continue
            error = float(np.hypot(each.before_error, each.after_error))
            outcome = (
                beyond_doubt
                if each.changed
                else (
                    DROPPED
                    if each.dropped
                    else "not determined"
                    if each.sigmas is None
                    else deviation(each.sigmas, np.inf)
                )
            )
            rows.append(
                (
                    each.id,
                    each.expression,
                    each.words,
                    each.unit,
                    Shown(each.before, beside(each.before, error)),
                    Shown(each.after, rounded(each.after, error)[0]),
                    Shown(error, rounded(each.after, error)[1]),
                    Shown(each.sigmas, outcome) if each.sigmas is not None else outcome,
                    Shown(each.torque_total, significant(each.torque_total)),
                    each.felt_at if each.felt_at is not None else "",
                    matters_text(each.matters, each.shared_with),
                )
            )
        change, judged = ("difference", "second") if self.of_models else ("change", "later")
        note = (
            "std err: of the difference, both errors together; torque: RMS over all joints that"
            f" the {change} makes on the motion the {judged} result was judged by; joint: the one"
            f" that notices most. A {change} matters where it is beyond doubt and its own part is"
            " noticed; shared: those named could make up for the rest, and this recording hardly"
            " tells them apart."
        )
        title = {
            None: "Base parameters",
            True: f"Parameters that {self._changed} beyond doubt",
            False: "Parameters within errors, or not tested",
        }
        return Table(heads, tuple(rows), title=title[changed], notes=(note,))

    def as_text(self) -> str:
        """Return verdict, sentences and table for a terminal."""
        head = [
            f"{self.robot}: {self.after} against {self.before}",
            self.verdict(),
            *self.sentences,
        ]
        return (
            "\n".join(head)
            + "\n\n"
            + stacked(
                [
                    *(
                        [joint_table(self.joints, self.level, of_models=self.of_models)]
                        if self.joints
                        else []
                    ),
                    self.table(),
                ]
            )
        )

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
                asdict(change) | {"shared_with": list(change.shared_with)} for change in self.ranked
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
    """Compare two results of one robot parameter by parameter, each with its own covariance, taken
    as independent.

    Two dates are compared on equal terms, by the `free` values of both, whatever estimators the
    results are by: bounds and pulls shift values by what no covariance counts, the same way in both
    or not. `of_models` takes the values as they were identified, and words it as of two models of
    one robot. Drive terms that only one of them has are left out, and the first sentence says that
    what is found may be the choice of terms alone. Raises ResultError where the robots differ in
    joints or geometry.
    """
    design_values(before, after.model)
    names = [name for name in before.base.names if name in after.base.names]
    one, two = ([result.base.names.index(name) for name in names] for result in (before, after))
    for i, j in zip(one, two, strict=True):
        if before.base.expressions[i] != after.base.expressions[j]:
            raise ResultError(
                f"{before.base.names[i]} stands for {before.base.expressions[i]} in one result and"
                f" for {after.base.expressions[j]} in the other; identify both with the same drive"
                " terms"
            )
    first, second, terms = (
        (ComparedValues.own(before), ComparedValues.own(after), ())
        if of_models
        else on_equal_terms(before, after)
    )
    difference = second.estimates[two] - first.estimates[one]
    covariance = first.covariance[np.ix_(one, one)] + second.covariance[np.ix_(two, two)]
    together = first.even_covariance[np.ix_(one, one)] + second.even_covariance[np.ix_(two, two)]
    error = np.sqrt(np.diag(covariance))
    dropped = first.dropped[one] | second.dropped[two]
    determined = first.determined[one] & second.determined[two]
    tested = determined & ~dropped & (error > 0)
    sigmas = difference[tested] / error[tested]
    p_values = two_sided_probability(sigmas)
    tests = np.full((4, len(names)), np.nan)
    tests[:, tested] = sigmas, p_values, benjamini_hochberg(p_values), holm(p_values)
    cost = left = None
    joints: tuple[JointChange, ...] = ()
    if after.cause_data is not None:
        whole = np.zeros(after.n_base)
        whole[two] = difference
        cost = torque_cost(after.cause_data, after.base, whole)
        left = after.cause_data.error_of(after.base.names, after.estimates)
        joints = joint_changes(after, names, difference, covariance)
    words = in_words(after.base)
    changed = tests[2] <= level
    own = np.zeros(len(names), dtype=bool)
    if cost is not None and left is not None:
        own = cost.noticed(left, alone=True)[two]
    changes = tuple(
        ParameterChange(
            id=int(after.base.ids[j]),
            name=name,
            expression=after.base.expressions[j],
            unit=after.base.units[j],
            before=float(first.estimates[i]),
            before_error=float(first.std_errors[i]),
            after=float(second.estimates[j]),
            after_error=float(second.std_errors[j]),
            sigmas=_number(tests[0, place]),
            p_value=_number(tests[1, place]),
            false_discovery=_number(tests[2, place]),
            holm=_number(tests[3, place]),
            torque_total=None if cost is None else float(cost.total[j]),
            felt_at=(
                None
                if cost is None or not cost.torque[j].any()
                else 1 + int(np.argmax(cost.torque[j]))
            ),
            changed=bool(changed[place]),
            matters=None if cost is None else bool(changed[place] and own[place]),
            words=words[j],
            dropped=bool(dropped[place]),
            shared_with=(
                ()
                if cost is None or left is None or not changed[place]
                else cost.shared_with(int(j), left, after.base.names)
            ),
        )
        for place, (name, i, j) in enumerate(zip(names, one, two, strict=True))
    )
    said = labels or tuple(
        ", ".join(recording_name(source) for source in result.sources) for result in (before, after)
    )
    return Drift(
        robot=after.robot,
        before=said[0],
        after=said[1],
        joint_names=after.joint_names,
        units=torque_units(after.model),
        parameters=changes,
        chi_square=chi_square(difference[tested], together[np.ix_(tested, tested)]),
        level=level,
        sentences=(
            *_other_drives(before, after, said),
            *torque_sentence(joints, level, of_models=of_models),
            *terms,
            *_dropping(dropped),
            *_friction(after, changes, said if of_models else None),
        ),
        joints=joints,
        of_models=of_models,
    )


def _other_drives(
    before: IdentificationResult, after: IdentificationResult, labels: tuple[str, ...]
) -> tuple[str, ...]:
    """Say first of all where the two have other drive terms, or the same with other nonlinear parameters or at
    other joints: each makes up for what it lacks with what it has.
    """
    one, two = (
        {term.key: str(term) for term in result.base.drive.terms} for result in (before, after)
    )
    if one == two:
        return ()
    alone = [
        (label, [key for key in own if key not in others])
        for label, own, others in zip(labels, (one, two), (two, one), strict=True)
    ]
    parts = [f"only {label} has {', '.join(keys)}" for label, keys in alone if keys]
    changed = [key for key, term in one.items() if two.get(key, term) != term]
    parts += (
        [f"both have {', '.join(changed)}, with other nonlinear parameters or at other joints"]
        if changed
        else []
    )
    left_out = (
        "Terms that only one has are left out here, and the others make up for them"
        if len(parts) > len(changed[:1])
        else "The other terms make up for that"
    )
    richer = max(before.base.drive, after.base.drive, key=lambda drive: len(drive.terms))
    return (
        (
            f"DIFFERENT DRIVE TERMS: {'; '.join(parts)}. {left_out}: all that follows may be the"
            " choice of terms and no change of the robot. Identify both with the same: --drive"
            f" {richer}"
        ),
    )


def _dropping(dropped: NDArray[np.bool_]) -> tuple[str, ...]:
    """Say that parameters without an error were not tested, but make torque all the same."""
    if not dropped.any():
        return ()
    return (
        (
            f"{np.count_nonzero(dropped)} parameters were dropped as needless in one result or"
            " both: they are not tested, and the torque that dropping them costs counts as change,"
            " beyond what errors allow."
        ),
    )


def _friction(
    result: IdentificationResult,
    changes: tuple[ParameterChange, ...],
    models: tuple[str, ...] | None,
) -> tuple[str, ...]:
    """Say of every joint how its drive terms changed, or in which of two named models they are
    what.
    """
    by_name = {change.name: change for change in changes}
    words = {"Fc": "Coulomb friction", "Fv": "viscous friction", "Fo": "offset", "Ia": "armature"}
    found = []
    for k, joint in enumerate(result.joint_names):
        parts = []
        for symbol, what in words.items():
            change = by_name.get(f"{symbol}{k + 1}")
            if change is None or not change.changed:
                continue
            growth = (
                change.after / change.before - 1
                if change.before > 3 * change.before_error
                else np.inf
            )
            relative = f" ({100 * growth:+.0f} %)" if abs(growth) <= TELLING_GROWTH else ""
            traded = (
                f", some of which {' and '.join(change.shared_with)} could make up for"
                if change.shared_with
                else ""
            )
            before, after = (
                _shown(change.before, change.before_error),
                _shown(change.after, change.after_error),
            )
            values = (
                f"{before} to {after} {change.unit}"
                if models is None
                else f"{before} ({models[0]}) against {after} {change.unit} ({models[1]})"
            )
            parts.append(f"{what} {values}{relative}{traded}")
        if parts:
            found.append(f"{joint}: {', '.join(parts)}.")
    return tuple(found) or (f"No drive term {'differs' if models else 'changed'} beyond doubt.",)


def _shown(value: float, error: float) -> str:
    return rounded(value, error if error > 0 else None)[0]


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
