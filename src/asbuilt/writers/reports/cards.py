"""Cards of pages: prediction, consistency, determination and differences at a glance."""

from __future__ import annotations

from asbuilt.identification import Determination, IdentificationResult, non_passive_drives
from asbuilt.tables import format_share
from asbuilt.validation import Comparison, position_unit
from asbuilt.validation.verdicts.reasons import Use
from asbuilt.validation.verdicts.verdict import Verdict
from asbuilt.workflow.study_result import Study
from asbuilt.writers.reports.page import Card, Mood

MOODS: dict[Use, Mood] = {
    "yes": "good",
    "with care": "neutral",
    "no": "bad",
    "untested": "neutral",
}


def make_study_cards(study: Study) -> tuple[Card, ...]:
    """Return the cards of a study."""
    return (
        make_error_card(study.verdict, position_unit(study.result.model)),
        make_consistency_card(study.result),
        make_determination_card(study.determination),
        make_difference_card(study.comparison),
    )


def make_error_card(found: Verdict, unit: str) -> Card:
    """Return the deciding error of the exported robot, compared with CAD's; `unit` of positions."""
    measured = "torque" if found.measure == "torque" else "simulation"

    def text(value: float | None) -> str:
        if measured == "torque" or value is None:
            return format_share(value)
        return f"{1e3 * value:.3g} {unit}"

    cad = "" if found.error.cad is None else f", CAD {text(found.error.cad)}"
    label = f"{measured} error of the exported robot{cad}"
    shown = "untested" if found.use == "untested" else text(found.error.decisive)
    return Card(MOODS[found.use], shown, label)


def make_torque_card(comparison: Comparison) -> Card:
    """Return how well torque is predicted as built, compared with CAD if that is known."""
    cad, built = comparison.torque[0]
    label = "torque error as built"
    error = format_share(built.relative_error)
    if cad is None:
        return Card("neutral", error, label)
    mood: Mood = "good" if built.relative_error < cad.relative_error else "bad"
    return Card(mood, error, f"{label}, CAD {format_share(cad.relative_error)}")


def make_consistency_card(result: IdentificationResult) -> Card:
    """Return whether physically consistent links and passive drives have the parameters."""
    if result.physically_consistent is None:
        return Card("neutral", "not checked", "physical consistency")
    if result.physically_consistent:
        return Card("good", "consistent", "physically")
    negative = ", ".join(non_passive_drives(result.base, result.estimates))
    return Card("bad", "inconsistent", f"physically{f', negative {negative}' if negative else ''}")


def make_determination_card(found: Determination) -> Card:
    """Return how many parameters the recordings determine to half their value."""
    classes = (found.well, found.fairly, found.hardly, found.not_at_all, found.dropped)
    good = len(found.well) + len(found.fairly)
    total = sum(map(len, classes))
    mood: Mood = "bad" if found.not_at_all else "good" if good == total else "neutral"
    return Card(mood, f"{good} of {total}", "parameters determined to 50 % or better")


def make_difference_card(comparison: Comparison) -> Card:
    """Return how many parameters differ from CAD."""
    label = f"base parameters contradict CAD{comparison.relevance()}"
    return Card("neutral", f"{comparison.n_differing} of {comparison.n_compared}", label)
