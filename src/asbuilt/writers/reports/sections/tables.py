"""Sections made of tables: torque errors, masses, payload, causes of the CAD error."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from markupsafe import Markup

from asbuilt.identification import FeasibleInterval, feasible_intervals
from asbuilt.identification.calibration.encoders import EncoderPair
from asbuilt.tables import Column, Table, format_plus_minus, round_significant, shorten_text
from asbuilt.writers.reports.compare_files import draw_shares
from asbuilt.writers.reports.page import (
    list_markup,
    paragraph_markup,
    table_markup,
)
from asbuilt.writers.reports.report import Report, Section, sections
from asbuilt.writers.tables.payload_tables import tabulate_payload, tabulate_payload_torques
from asbuilt.writers.tables.tabular import exported_masses, feasible_table, mass_table

ROOM = 2.5
"""Length of the axis in the largest known value; a bar that goes on ends in an arrow."""
WIDTH = 640
LEFT = 150
RIGHT = 12
ROW = 22
FOOT = 46
"""Sizes of the drawing: whole, names, margin, height of a bar's row, and axis with legend."""
NAME = 22
"""Characters of a name."""


def draw_intervals(
    intervals: Sequence[FeasibleInterval], truth: Mapping[str, float], title: str
) -> Markup:
    """Return a drawing of intervals that have one unit; `truth` has true values where known."""
    known = [
        (interval.cad, interval.chosen, truth.get(interval.quantity)) for interval in intervals
    ]
    shown = [value for values in known for value in values if value is not None]
    high = ROOM * max((abs(value) for value in shown), default=1.0) or 1.0
    low = min(0.0, 1.2 * min(shown, default=0.0))
    bottom = ROW * len(intervals)

    def x(value: float) -> float:
        share = (min(max(value, low), high) - low) / (high - low)
        return LEFT + share * (WIDTH - LEFT - RIGHT)

    def parts() -> Iterator[Markup]:
        for row, (each, (cad, chosen, true)) in enumerate(zip(intervals, known, strict=True)):
            y = ROW * row + ROW / 2
            name = shorten_text(each.quantity.partition(":")[2] or "all links", NAME)
            yield Markup('<text class="end" x="{}" y="{}">{}</text>').format(LEFT - 8, y + 4, name)
            left = x(each.least)
            right = x(each.greatest)
            yield Markup('<rect x="{:.1f}" y="{}" width="{:.1f}" height="12"/>').format(
                left, y - 6, max(right - left, 1.0)
            )
            if each.greatest > high:
                yield _mark("more", f"M{right:.1f} {y - 5} l8 5 l-8 5 z")
            if each.least < low:
                yield _mark("more", f"M{left:.1f} {y - 5} l-8 5 l8 5 z")
            if chosen is not None:
                yield _mark("chosen", f"M{x(chosen) - 4:.1f} {y} a4 4 0 1 0 8 0 a4 4 0 1 0 -8 0 z")
            if cad is not None:
                yield _mark("cad", f"M{x(cad):.1f} {y - 9} v18")
            if true is not None:
                yield _mark("true", f"M{x(true) - 4:.1f} {y - 4} l8 8 m0 -8 l-8 8")
        yield _mark("axis", f"M{LEFT} {bottom} H{WIDTH - RIGHT}")
        for value in (low, high) if low < 0.0 else (0.0, high / 2.0, high):
            yield Markup('<text class="middle" x="{:.1f}" y="{}">{}</text>').format(
                x(value), bottom + 16, round_significant(value, 2)
            )
        yield from _draw_legend(bottom + 36, with_truth=bool(truth))
        yield Markup('<text class="end" x="{}" y="{}">{} [{}]</text>').format(
            WIDTH - RIGHT, bottom + 40, title, intervals[0].unit
        )

    label = f"{title}: a bar for each feasible interval; the numbers are in the table below"
    return Markup(
        '<svg class="intervals" viewBox="0 0 {} {}" role="img" aria-label="{}">{}</svg>'
    ).format(WIDTH, bottom + FOOT, label, Markup("").join(parts()))


def _mark(kind: str, path: str) -> Markup:
    return Markup('<path class="{}" d="{}"/>').format(kind, path)


def _draw_legend(y: int, *, with_truth: bool) -> Iterator[Markup]:
    """Yield what the marks stand for."""
    signs = {
        "chosen": ("chosen", "a4 4 0 1 0 8 0 a4 4 0 1 0 -8 0 z"),
        "cad": ("CAD", "m4 -7 v14"),
        "true": ("truth", "m0 -4 l8 8 m0 -8 l-8 8"),
    }
    for place, (kind, (name, path)) in enumerate(signs.items()):
        if kind != "true" or with_truth:
            at = LEFT + 90 * place
            yield _mark(kind, f"M{at} {y} {path}")
            yield Markup('<text x="{}" y="{}">{}</text>').format(at + 14, y + 4, name)


def _make_comparison(report: Report) -> list[Markup]:
    comparison = report.study.comparison
    return [
        paragraph_markup(comparison.verdict(), ""),
        table_markup(comparison.torque_table(), "torque-table"),
    ]


def _make_masses(report: Report) -> list[Markup]:
    result = report.study.result
    recovery = report.recovery
    masses = exported_masses(result)
    if masses is None:
        return []
    truth = {} if recovery is None else recovery.true_values
    tables = {"mass-table": mass_table(masses)}
    bars = {"Masses": (*masses.links, masses.total)}
    if "armature" in result.base.drive.keys:
        bars["Armatures"] = feasible_intervals(result, ("armature",))
        tables["armature-table"] = feasible_table(bars["Armatures"])
    if recovery is not None:
        tables["truth-table"] = recovery.interval_table()
    return [
        *(draw_intervals(bar, truth, title) for title, bar in bars.items()),
        *(table_markup(table, name) for name, table in tables.items()),
    ]


def _make_payload(report: Report) -> list[Markup]:
    payload = report.payload
    if payload is None:
        return []
    return [
        table_markup(tabulate_payload(payload), "payload-values"),
        table_markup(tabulate_payload_torques(payload), "payload-torque"),
    ]


def _make_causes(report: Report) -> list[Markup]:
    attribution = report.study.attribution
    if attribution is None:
        return []
    return [
        list_markup((*attribution.sentences, *attribution.findings)),
        draw_shares(attribution),
        table_markup(attribution.share_table(), "shares"),
    ]


sections.register("masses", Section("Masses", 22, _make_masses))
sections.register("comparison", Section("CAD and as built", 24, _make_comparison))
sections.register("causes", Section("Causes of the CAD error", 40, _make_causes, folded=True))
sections.register("payload", Section("Payload", 50, _make_payload))

ENCODERS = (
    "Lag of the link's encoder, and the spring between motor and link. The rotor is the inertia"
    " that the motor's torque moves without the link; hysteresis is what the difference of the"
    " encoders changes by as the joint reverses. A dash: not determined."
)


def _make_encoders(report: Report) -> list[Markup]:
    pairs = report.study.result.encoders
    if not pairs:
        return []
    columns = (
        Column("joint"),
        Column("lag", "ms", "right"),
        Column("stiffness", "N m/rad, N/m", "right"),
        Column("damping", "N m s/rad, N s/m", "right"),
        Column("rotor", "kg m^2, kg", "right"),
        Column("hysteresis", "mdeg, um", "right"),
        Column("rest", "mdeg, um", "right"),
    )
    table = Table(columns, tuple(map(_build_row, pairs)))
    return [paragraph_markup(ENCODERS), table_markup(table, "encoders")]


def _build_row(pair: EncoderPair) -> tuple[str, ...]:
    scale = 1e3 * float(np.rad2deg(1.0)) if pair.revolute else 1e6
    rotor = None if pair.rotor is None else (pair.rotor, pair.rotor_error or 0.0)
    return (
        pair.joint,
        format_plus_minus(1e3 * pair.lag, 1e3 * pair.lag_error),
        *(
            "-" if estimate is None else format_plus_minus(*estimate)
            for estimate in (pair.stiffness, pair.damping, rotor)
        ),
        format_plus_minus(scale * pair.hysteresis, scale * pair.hysteresis_error),
        round_significant(scale * pair.rest, 2),
    )


sections.register("encoders", Section("Two encoders", 14, _make_encoders))
