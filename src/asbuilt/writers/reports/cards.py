"""Cards of pages: prediction, consistency, determination and differences at a glance."""

from __future__ import annotations

from asbuilt.identification import Determination, IdentificationResult, non_passive_drives
from asbuilt.tables import format_share
from asbuilt.validation import Comparison, position_unit
from asbuilt.validation.verdicts.verdict import Use, Verdict
from asbuilt.workflow.study import Study
from asbuilt.writers.reports.page import Card, Mood

MOODS: dict[Use, Mood] = {"yes": "good", "with care": "neutral", "no": "bad"}


def study_cards(study: Study) -> tuple[Card, ...]:
    """Return the cards of a study."""
    return (
        error_card(study.verdict, position_unit(study.result.model)),
        consistency_card(study.result),
        determination_card(study.determination),
        difference_card(study.comparison),
    )


def error_card(found: Verdict, unit: str) -> Card:
    """Return the deciding error of the exported robot, compared with CAD's; `unit` of positions."""

    def text(value: float | None) -> str:
        if found.measure == "torque" or value is None:
            return format_share(value)
        return f"{1e3 * value:.3g} {unit}"

    cad = "" if found.error.cad is None else f", CAD {text(found.error.cad)}"
    measured = "torque error" if found.measure == "torque" else "simulation error"
    return Card(
        MOODS[found.use], text(found.error.decisive), f"{measured} of the exported robot{cad}"
    )


def torque_card(comparison: Comparison) -> Card:
    """Return how well torque is predicted as built, compared with CAD if that is known."""
    cad, built = comparison.torque[0]
    error, label = format_share(built.relative_error), "torque error as built"
    if cad is None:
        return Card("neutral", error, label)
    better = built.relative_error < cad.relative_error
    return Card(
        "good" if better else "bad", error, f"{label}, CAD {format_share(cad.relative_error)}"
    )


def consistency_card(result: IdentificationResult) -> Card:
    """Return whether physically consistent links and passive drives have the parameters."""
    if result.physically_consistent is None:
        return Card("neutral", "not checked", "physical consistency")
    if result.physically_consistent:
        return Card("good", "consistent", "physically")
    negative = ", ".join(non_passive_drives(result.base, result.estimates))
    return Card("bad", "inconsistent", f"physically{f', negative {negative}' if negative else ''}")


def determination_card(found: Determination) -> Card:
    """Return how many parameters the recordings determine to half their value."""
    classes = (found.well, found.fairly, found.hardly, found.not_at_all, found.dropped)
    good, total = len(found.well) + len(found.fairly), sum(map(len, classes))
    mood: Mood = "bad" if found.not_at_all else "good" if good == total else "neutral"
    return Card(mood, f"{good} of {total}", "parameters determined to 50 % or better")


def difference_card(comparison: Comparison) -> Card:
    """Return how many parameters differ from CAD."""
    matter = comparison.n_mattering
    verb = "matters" if matter == 1 else "matter"
    label = "parameters differ from CAD" + (
        "" if matter is None else f", {matter} {verb} to the torque"
    )
    return Card("neutral", f"{comparison.n_differing} of {comparison.n_compared}", label)
