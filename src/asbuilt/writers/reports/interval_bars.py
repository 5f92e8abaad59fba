"""A bar for each feasible interval, with CAD, the chosen value and the truth in it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from markupsafe import Markup

from asbuilt.identification import FeasibleInterval
from asbuilt.tables import round_significant, shorten_text

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
