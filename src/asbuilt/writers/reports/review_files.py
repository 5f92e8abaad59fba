"""Review of a robot description: text, tables, document, page and files."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import polars as pl

from asbuilt.codec import format_json, make_plain
from asbuilt.findings import Cure, join_names, list_findings, list_warnings
from asbuilt.identification.screen import format_effects
from asbuilt.tables import (
    Cell,
    Column,
    Table,
    format_estimate,
    format_plus_minus,
    format_share,
    round_significant,
    wrap_text,
)
from asbuilt.validation import Claim, recording_name
from asbuilt.validation.comparison.comparison import FALSE_DISCOVERY_RATE
from asbuilt.validation.comparison.significance import RESOLUTION
from asbuilt.validation.prediction import describe_letters, name_torque_unit, torque_units
from asbuilt.validation.review.review import DETERMINED, DOUBTFUL, ORDER, Review
from asbuilt.writers.figures.comparison_figures import review_figure
from asbuilt.writers.figures.figure_style import encode_figure, save_figure
from asbuilt.writers.reports.page import (
    Block,
    Card,
    Mood,
    cards_markup,
    image_markup,
    list_markup,
    render_page,
    table_markup,
)
from asbuilt.writing import atomic_write

DRIVES = ("armature", "damping", "damping + kv", "friction loss", "kp", "kv", "forcerange")


def review_document(review: Review) -> dict[str, Any]:
    """Return plain numbers, lists and None, ready for JSON."""
    wrong, tested = review.contradicted_sums
    return {
        "robot": review.robot,
        "recordings": list(review.sources),
        "headline": review_headline(review),
        "letter": review.letter,
        "error": review.error,
        "counts": {verdict: review.count(verdict) for verdict in ORDER},
        "base_parameters": {"contradicted": wrong, "tested": tested},
        "false_discovery_rate": FALSE_DISCOVERY_RATE,
        "misfit": review.misfit,
        "plausible": asdict(review.tolerance),
        "claims": make_plain(review.claims),
        "effects": make_plain(review.result.effects),
        "warnings": list_warnings(review.findings),
    }


def review_text(
    review: Review, *, full: bool = False, cure_text: Callable[[Cure], str] = str
) -> str:
    """Return verdict, warnings and table for a terminal; `full`: all claims and warnings."""
    letter = (
        f"{review.letter}: the description predicts these recordings to"
        f" {format_share(review.error)} of the torque ({describe_letters()})"
    )
    shown = review.findings if full else review.first_findings
    return "\n".join(
        [
            wrap_text(review_headline(review)),
            *([] if review.letter is None else [wrap_text(letter)]),
            *list_findings(shown, cure_text, full=full),
            *format_effects(review.result.effects),
            review_table(review).as_text(full),
        ]
    )


def review_headline(review: Review) -> str:
    """Return what a user decides by: which claims the log contradicts, in a sentence."""
    against = [claim for claim in review.claims if claim.verdict == "contradicted"]
    logs = join_names([recording_name(source) for source in review.sources], 2)
    rest = f"{review.count('supported')} are supported, {review.count('undetermined')} undetermined"
    wrong, tested = review.contradicted_sums
    sums = f"{wrong} of {tested} base parameters, which are sums of them"
    if not against:
        lost = f"; it contradicts {sums}: which number is wrong is undetermined" if wrong else ""
        return f"{logs} contradicts none of {len(review.claims)} claimed numbers: {rest}{lost}."
    worst = max(against, key=lambda claim: claim.torque or 0.0)
    value = "" if worst.estimate is None else format_plus_minus(worst.estimate, worst.std_error)
    return (
        f"{logs} contradicts {len(against)} of {len(review.claims)} claimed numbers, most of all"
        f" {worst.what} of {worst.joint}: {value} {worst.unit} for"
        f" {round_significant(worst.claimed)}; {rest}" + (f"; and {sums}." if wrong else ".")
    )


CLAIMS = (
    Column(
        "verdict",
        of=lambda c: "CONTRADICTED" if c.verdict == "contradicted" else c.verdict,
    ),
    Column("number", width=13, of="what"),
    Column("joint", width=22, of="joint"),
    Column("unit", detail=True, of="unit"),
    Column("claimed", align="decimal", style=3, of="claimed"),
    Column("log", align="decimal", of=lambda c: _show_estimate(c)[0]),
    Column("std err", align="decimal", of=lambda c: _show_estimate(c)[1]),
)
REMARKS = (
    Column("alias of", width=60, detail=True, of=lambda c: ", ".join(c.alias_of)),
    Column("note", width=60, detail=True, of="note"),
)


def review_table(review: Review) -> Table:
    """Return one row per claim, contradicted ones first; short: drives before bodies."""
    tolerance = review.tolerance
    plausible = (
        f"{format_share(tolerance.mass, 0)} of mass, {format_share(tolerance.centre, 0)} of the"
        " radius of"
        f" gyration for centres and {format_share(tolerance.inertia, 0)} of the mean moment"
    )
    widened = (
        f"Standard errors are widened by the factor {round_significant(review.misfit)}: no"
        " plausible"
        " numbers explain the log to its errors."
    )
    unit = name_torque_unit(torque_units(review.result.model))
    return Table.of(
        review.claims,
        (*CLAIMS, Column("torque", unit, "decimal", style=3, of="torque"), *REMARKS),
        title="Claimed numbers, and estimates from the log not regularised toward them",
        notes=(
            f"CONTRADICTED: off by more than {format_share(RESOLUTION, 0)} of its size, at a false"
            f" discovery rate of {format_share(FALSE_DISCOVERY_RATE, 0)} over all numbers.",
            f"supported: standard error at most {format_share(DETERMINED, 0)} of its size, and the"
            f" difference at most {format_share(RESOLUTION, 0)} of it or by chance in"
            f" {format_share(DOUBTFUL, 0)}"
            " of logs or more; undetermined: all others.",
            "Size: the claim itself, or 1 in its unit where it is 0, of drives and masses; of a"
            " centre the radius of gyration, of an inertia the mean moment of the link.",
            "torque: RMS of the difference over all joints.",
            f"Other numbers are free meanwhile: drives without limit, bodies within {plausible}.",
            *([widened] if review.misfit > 1.0 else []),
        ),
        important=_select_important(review.claims),
    )


def _select_important(claims: Sequence[Claim]) -> tuple[int, ...]:
    """Return the places of the claims in a short text: contradicted, then drives, then bodies."""
    ranks = [(claim.verdict != "contradicted", claim.what not in DRIVES) for claim in claims]
    order = sorted(range(len(claims)), key=ranks.__getitem__)
    return tuple(sorted(order[:24]))


def _show_estimate(claim: Claim) -> tuple[Cell, ...]:
    return (
        (None, None) if claim.estimate is None else format_estimate(claim.estimate, claim.std_error)
    )


MOODS: dict[str, Mood] = {"contradicted": "bad", "supported": "good", "undetermined": "neutral"}


def write_review(folder: Path, review: Review) -> dict[str, Path]:
    """Write review.json, claims.csv, claims.parquet, review.html and review.png.

    Returns the paths by kind. The tables have the fields of `Claim`, unrounded; `alias_of` is a
    list in Parquet, and joined by semicolons in CSV.
    """
    frame = tabulate_claims(review)
    stream = io.BytesIO()
    frame.write_parquet(stream)
    flat = frame.with_columns(pl.col("alias_of").list.join("; "))
    return {
        "review": atomic_write(folder / "review.json", format_json(review_document(review))),
        "table": atomic_write(folder / "claims.csv", flat.write_csv()),
        "parquet": atomic_write(folder / "claims.parquet", stream.getvalue()),
        "report": atomic_write(folder / "review.html", review_html(review)),
        "figure": save_figure(review_figure(review), folder / "review.png"),
    }


def tabulate_claims(review: Review) -> pl.DataFrame:
    """Return one row per claim, contradicted ones first, with the fields of `Claim`."""
    return pl.DataFrame(
        make_plain(review.claims),
        schema_overrides={
            **dict.fromkeys(
                ("claimed", "estimate", "std_error", "torque", "p_value", "false_discovery"),
                pl.Float64,
            ),
            **dict.fromkeys(("what", "joint", "unit", "verdict", "note"), pl.String),
            "alias_of": pl.List(pl.String),
            "alike": pl.Boolean,
        },
    )


def review_html(review: Review) -> str:
    """Return the page of a review as text."""
    table = review_table(review)
    cards = [Card(MOODS[verdict], str(review.count(verdict)), verdict) for verdict in ORDER]
    drawn = image_markup(
        encode_figure(review_figure(review)),
        "Armature, damping, friction loss and stiffness of each joint as the log has them, with"
        " bars of two standard errors, next to what the description claims; the numbers are in the"
        " table below",
    )
    found = list_markup((finding.severity, finding.text) for finding in review.findings)
    return render_page(
        review.robot,
        f"{len(review.claims)} claimed numbers",
        [
            Block("verdict", "Verdict", (cards_markup(cards), list_markup(table.notes))),
            Block("drives", "Numbers of the drives", (drawn,), "Drives"),
            Block("claims", "All numbers", (table_markup(table, "claims-table"),)),
            Block("found", "What the identification found", (found,), folded=True),
        ],
        title=f"{review.robot}: review",
        subtitle="Against " + ", ".join(map(recording_name, review.sources)),
    )
