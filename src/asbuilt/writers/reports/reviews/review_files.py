"""Files of a review: page with figure, claims as tables, document."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import polars as pl

from asbuilt.codec import json_text
from asbuilt.tables import wrapped
from asbuilt.validation.comparison.comparison import recording_name
from asbuilt.validation.review.review import ORDER, Review
from asbuilt.writers.figures.figure_style import figure_address, save_figure
from asbuilt.writers.figures.review_figure import review_figure
from asbuilt.writers.files import atomic_write, path_texts
from asbuilt.writers.reports.page import page, table_markup
from asbuilt.writers.reports.report_verdict import Card
from asbuilt.writers.reports.reviews.review_text import review_document, review_table

MOODS = {"contradicted": "bad", "supported": "good", "undetermined": "neutral"}


def write_review(folder: Path, review: Review) -> dict[str, Path]:
    """Write review.json, claims.csv, claims.parquet, review.html and review.png.

    Returns the paths by kind. The tables have the fields of `Claim`, unrounded; `alias_of` is a
    list in Parquet, and joined by semicolons in CSV.
    """
    frame = claims_frame(review)
    stream = io.BytesIO()
    frame.write_parquet(stream)
    flat = frame.with_columns(pl.col("alias_of").list.join("; "))
    return {
        "review": atomic_write(folder / "review.json", json_text(review_document(review))),
        "table": atomic_write(folder / "claims.csv", flat.write_csv()),
        "parquet": atomic_write(folder / "claims.parquet", stream.getvalue()),
        "report": atomic_write(folder / "review.html", review_html(review)),
        "figure": save_figure(review_figure(review), folder / "review.png"),
    }


def claims_frame(review: Review) -> pl.DataFrame:
    """Return one row per claim, contradicted ones first, with the fields of `Claim`."""
    numbers = ("claimed", "estimate", "std_error", "torque", "p_value", "false_discovery")
    texts = ("what", "joint", "unit", "verdict", "note")
    return pl.DataFrame(
        [claim.as_dict() for claim in review.claims],
        schema_overrides={
            **dict.fromkeys(numbers, pl.Float64),
            **dict.fromkeys(texts, pl.String),
            "alias_of": pl.List(pl.String),
            "alike": pl.Boolean,
        },
    )


def with_files(review: Review, files: Mapping[str, Path]) -> dict[str, Any]:
    """Return the JSON document of a review with the paths of what was written."""
    return {**review_document(review), **({"files": path_texts(files)} if files else {})}


def review_html(review: Review) -> str:
    """Return the page of a review as text."""
    table = review_table(review)
    return page(
        "review.html.j2",
        title=f"{review.robot}: review",
        heading=review.robot,
        subject=f"{len(review.claims)} claimed numbers",
        subtitle="Against " + ", ".join(map(recording_name, review.sources)),
        contents=[("verdict", "Verdict"), ("drives", "Drives"), ("claims", "All numbers")],
        cards=[
            Card(MOODS[verdict], str(review.count(verdict)), verdict)  # type: ignore[arg-type]
            for verdict in ORDER
        ],
        sentences=table.notes,
        findings=[wrapped(each.text) for each in review.findings],
        image=figure_address(review_figure(review)),
        claims_table=table_markup(table, "claims-table"),
    )
