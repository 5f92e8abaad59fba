"""A loop on screen and as JSON: a line a round, the picture of promised against found."""

from __future__ import annotations

import json
import math
import shutil
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
from matplotlib.ticker import NullFormatter

from asbuilt import writers
from asbuilt.apps.run.loop import Outcome
from asbuilt.apps.run.options import RunOptions
from asbuilt.apps.run.rounds import Round
from asbuilt.codec import make_plain
from asbuilt.tables import format_share

VERDICTS = {"yes": "USE", "with care": "WITH CARE", "no": "NO USE", "cad": "(CAD)"}
HEAD = f"{'round':>5}  {'seconds':>7}  {'promised':>8}  {'found':>7}  {'verdict':<9}  learned"
LEARNED = HEAD.index("learned")
"""Column at which what a round taught begins."""
WIDEST = 80
PICTURE = 48
"""Columns of the picture, which has a label of 9 before it."""
MARGIN = 1.3
"""Factor by which the axis of the picture goes beyond its values."""


def format_round(made: Round) -> str:
    """Return the line of a round, folded in its last column."""
    promised = "-" if made.promised is None else format_share(made.promised)
    left = (
        f"{made.number:>5}  {made.seconds:>7.4g}  {promised:>8}  {_share(made.found):>7}"
        f"  {VERDICTS[made.verdict]:<9}  "
    )
    width = max(WIDEST, min(shutil.get_terminal_size().columns, 100)) - LEARNED
    lines = textwrap.wrap("; ".join(made.learned) or "nothing new", width) or [""]
    return left + f"\n{' ' * LEARNED}".join(lines)


def _share(value: float) -> str:
    return format_share(value) if math.isfinite(value) else "-"


def draw_promises(rounds: Sequence[Round], options: RunOptions) -> str:
    """Return a picture in text: promised (p) and found (f) error by round, `|` the wanted one."""
    until = options.until / 100.0
    rows = [
        (each.number, each.promised, each.found)
        for each in rounds
        if each.promised is not None and math.isfinite(each.found)
    ]
    if not rows:
        return ""
    values = [until, *(value for row in rows for value in row[1:] if value)]
    low = math.log(min(values) / MARGIN)
    high = math.log(max(values) * MARGIN)

    def place(value: float) -> int:
        return round((math.log(max(value, min(values))) - low) / (high - low) * (PICTURE - 1))

    lines = ["", "promised (p) and found (f) error, * where they agree, | wanted"]
    for number, promised, found in rows:
        cells = ["."] * PICTURE
        cells[place(until)] = "|"
        p = place(promised or 0.0)
        f = place(found)
        cells[p], cells[f] = "p", "f"
        if p == f:
            cells[p] = "*"
        lines.append(f"round {number:<3}{''.join(cells)}")
    left = format_share(math.exp(low))
    right = format_share(math.exp(high))
    lines.append(f"{'':9}{left}{right:>{PICTURE - len(left)}}  (logarithmic)")
    return "\n".join(lines)


def write_promise_figure(path: Path, rounds: Sequence[Round], options: RunOptions) -> Path | None:
    """Write promised against found error of each round as PNG; None without a tested round."""
    rows = [each for each in rounds if each.promised is not None and math.isfinite(each.found)]
    if not rows:
        return None
    numbers = [row.number for row in rows]
    figure, axes = plt.subplots(figsize=(6.4, 3.6), layout="constrained")
    axes.plot(numbers, [100 * (row.promised or 0.0) for row in rows], "o--", label="promised")
    axes.plot(numbers, [100 * row.found for row in rows], "s-", label="found")
    axes.axhline(options.until, color="0.5", lw=1.0, label="wanted")
    axes.set_yscale("log")
    # Numbers as the table has them: 0.2, not a power of ten.
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.set_xticks(numbers)
    what = "simulated motion" if options.purpose == "simulator" else "torque"
    axes.set_xlabel("round")
    axes.set_ylabel(f"error of the {what} [%]")
    axes.set_title("Promised before recording, found before learning")
    axes.legend()
    axes.grid(alpha=0.3)
    saved = writers.save_figure(figure, path)
    plt.close(figure)
    return saved


def round_document(made: Round) -> dict[str, Any]:
    """Return the JSON line of a round; errors are shares, those of joints N m or N."""
    return {
        "round": made.number,
        "motion": str(made.motion),
        "seconds": made.seconds,
        "promised": made.promised,
        "found": made.found,
        "verdict": made.verdict,
        "weakest": made.list_weakest(),
        "learned": list(made.learned),
        "goal": made.goal_error,
        "files": {"motion": str(made.motion), "recording": str(made.log)},
    }


def outcome_document(
    outcome: Outcome, robot: str, options: RunOptions, files: Mapping[str, Path]
) -> dict[str, Any]:
    """Return the last JSON line."""
    verdict = None if outcome.study is None else make_plain(outcome.study.verdict)
    return {
        "robot": robot,
        "purpose": options.purpose,
        "until": options.until / 100.0,
        "ending": outcome.ending,
        "text": outcome.text,
        "rounds": len(outcome.rounds),
        "seconds": outcome.seconds,
        "promised": outcome.rounds[-1].goal_error if outcome.rounds else None,
        "verdict": verdict,
        "files": {kind: str(path) for kind, path in files.items()},
    }


def format_json_line(document: Mapping[str, Any]) -> str:
    """Return a document as one line."""
    plain = make_plain(document)
    return json.dumps(_finite(plain), ensure_ascii=False, allow_nan=False)


def _finite(value: Any) -> Any:
    """Return plain data with None for numbers that JSON does not have."""
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, dict):
        return {key: _finite(each) for key, each in value.items()}
    return [_finite(each) for each in value] if isinstance(value, list) else value
