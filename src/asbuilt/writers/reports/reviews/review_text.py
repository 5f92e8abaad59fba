"""Text, table and document of a review of a robot description."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from asbuilt.findings import Finding, joined
from asbuilt.tables import (
    Cell,
    Column,
    Shown,
    Table,
    plus_minus,
    rounded,
    share,
    significant,
    wrapped,
)
from asbuilt.validation.comparison.comparison import recording_name
from asbuilt.validation.letter import LETTERS
from asbuilt.validation.review.claim import Claim
from asbuilt.validation.review.review import DETERMINED, DOUBTFUL, ORDER, RESOLUTION, Review

MOST_CLAIMS = 24
"""Claims in a short text."""
DRIVES = ("armature", "damping", "damping + kv", "friction loss", "kp", "kv", "forcerange")


def review_document(review: Review) -> dict[str, Any]:
    """Return plain numbers, lists and None, ready for JSON."""
    tolerance = review.tolerance
    return {
        "robot": review.robot,
        "recordings": list(review.sources),
        "headline": review_headline(review),
        "letter": review.letter,
        "error": review.error,
        "counts": {verdict: review.count(verdict) for verdict in ORDER},
        "false_discovery_rate": review.level,
        "misfit": review.misfit,
        "plausible": {
            "mass": tolerance.mass,
            "centre": tolerance.centre,
            "inertia": tolerance.inertia,
        },
        "claims": [claim.as_dict() for claim in review.claims],
        "warnings": [{"code": each.code, "message": each.text} for each in review.findings],
    }


def review_text(
    review: Review, *, full: bool = False, finding_text: Callable[[Finding], str] | None = None
) -> str:
    """Return verdict, warnings and table for a terminal; `full`: all claims and warnings."""
    head = wrapped(review_headline(review))
    said = [
        wrapped(finding_text(each))
        for each in review.findings
        if finding_text is not None and (full or each.code.startswith("servo_"))
    ]
    return "\n".join([head, *letter_lines(review), *said, review_table(review).as_text(full)])


def letter_lines(review: Review) -> list[str]:
    """Return the letter of the description with its rule; nothing if it has no masses."""
    if review.letter is None:
        return []
    sentence = (
        f"{review.letter}: the description predicts these recordings to {share(review.error)} of"
        f" the torque ({LETTERS.text})"
    )
    return [wrapped(sentence)]


def review_headline(review: Review) -> str:
    """Return what a user decides by: which claims the log contradicts, in a sentence."""
    against = [claim for claim in review.claims if claim.verdict == "contradicted"]
    logs = joined([recording_name(source) for source in review.sources], 2)
    rest = f"{review.count('supported')} are supported, {review.count('undetermined')} undetermined"
    if not against:
        return f"{logs} contradicts none of {len(review.claims)} claimed numbers: {rest}."
    worst = max(against, key=lambda claim: claim.torque or 0.0)
    value = "" if worst.estimate is None else plus_minus(worst.estimate, worst.std_error)
    return (
        f"{logs} contradicts {len(against)} of {len(review.claims)} claimed numbers, most of all"
        f" {worst.what} of {worst.joint}: {value} {worst.unit} for {significant(worst.claimed)};"
        f" {rest}."
    )


def review_table(review: Review) -> Table:
    """Return one row per claim, contradicted ones first; short: drives before bodies."""
    columns = (
        Column("verdict"),
        Column("number", width=13),
        Column("joint", width=22),
        Column("unit", detail=True),
        Column("claimed", align="decimal"),
        Column("log", align="decimal"),
        Column("std err", align="decimal"),
        Column("torque", "N m", "decimal"),
        Column("alias of", width=60, detail=True),
        Column("note", width=60, detail=True),
    )
    tolerance = review.tolerance
    plausible = (
        f"{share(tolerance.mass, 0)} of mass, {share(tolerance.centre, 0)} of the radius of"
        f" gyration for centres and {share(tolerance.inertia, 0)} of the mean moment"
    )
    return Table(
        columns,
        tuple(_row(claim) for claim in review.claims),
        title="Claimed numbers beside what the log says with nothing that pulls it to the claim",
        notes=(
            f"CONTRADICTED: off by more than {share(RESOLUTION, 0)} of its size, at a false"
            f" discovery rate of {share(review.level, 0)} over all numbers.",
            f"supported: standard error at most {share(DETERMINED, 0)} of its size, and the"
            f" difference at most {share(RESOLUTION, 0)} of it or by chance in {share(DOUBTFUL, 0)}"
            " of logs or more; undetermined: all others.",
            "Size: the claim itself, or 1 in its unit where it is 0, of drives and masses; of a"
            " centre the radius of gyration, of an inertia the mean moment of the link.",
            "torque: RMS of the difference over all joints.",
            f"Other numbers are free meanwhile: drives without limit, bodies within {plausible}.",
            *_widened(review),
        ),
        important=_important(review),
    )


def _widened(review: Review) -> tuple[str, ...]:
    if review.misfit <= 1.0:
        return ()
    return (
        "Standard errors are widened by the factor"
        f" {significant(review.misfit)}: no plausible numbers explain the log to its errors.",
    )


def _important(review: Review) -> tuple[int, ...]:
    """Return the places of the claims in a short text: contradicted, then drives, then bodies."""
    order = sorted(
        range(len(review.claims)),
        key=lambda j: (
            review.claims[j].verdict != "contradicted",
            review.claims[j].what not in DRIVES,
            j,
        ),
    )
    return tuple(sorted(order[:MOST_CLAIMS]))


def _row(claim: Claim) -> tuple[Cell, ...]:
    verdict = "CONTRADICTED" if claim.verdict == "contradicted" else claim.verdict
    estimate: Cell = None
    error: Cell = None
    if claim.estimate is not None:
        shown, uncertainty = rounded(claim.estimate, claim.std_error)
        estimate, error = Shown(claim.estimate, shown), Shown(claim.std_error, uncertainty)
    return (
        verdict,
        claim.what,
        claim.joint,
        claim.unit,
        Shown(claim.claimed, significant(claim.claimed)),
        estimate,
        error,
        None if claim.torque is None else Shown(claim.torque, significant(claim.torque)),
        ", ".join(claim.alias_of),
        claim.note,
    )
