"""Sections of the prediction: torque over time, the error in itself, and simulated motion."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.tables import Column, Table, round_significant
from asbuilt.validation import Rollout, Validation
from asbuilt.writers.reports.page import section_markup, table_markup
from asbuilt.writers.reports.report import Report, Section, sections
from asbuilt.writers.tables.rollout_tables import tabulate_rollouts

TORQUE = """\
<div class="controls">
<label>Recording <select id="recording">{% for label in labels %}\
<option value="{{ loop.index0 }}">{{ label }}</option>{% endfor %}</select></label>
<div id="joints" role="group" aria-label="Joint">{% for joint in joints %}\
<button type="button" data-joint="{{ loop.index0 }}" aria-pressed="false">{{ joint }}</button>\
{% endfor %}</div>
</div>
<h3 id="torque-title"></h3>
<div id="torque-plot" class="plot tall"></div>
<p class="quiet" id="torque-note"></p>
"""
ERROR = """\
<div class="grid">
<figure><figcaption>Distribution in standard deviations; the line is a normal distribution\
</figcaption><div id="histogram-plot" class="plot"></div></figure>
<figure><figcaption>Autocorrelation; the band is the 95 % interval of white noise</figcaption>\
<div id="correlation-plot" class="plot"></div></figure>
<figure><figcaption>Torque of the drive against velocity</figcaption>\
<div id="friction-plot" class="plot"></div></figure>
</div>
{% for table in tables %}
<div class="scroll residuals" data-recording="{{ loop.index0 }}">{{ table }}</div>
{% endfor %}
"""


def _make_torque(report: Report) -> list[Markup]:
    labels = [label for label, _ in report.predictions]
    joints = report.study.result.joint_names
    return [section_markup(TORQUE, {"labels": labels, "joints": joints})] if labels else []


def _make_errors(report: Report) -> list[Markup]:
    tables = [
        table_markup(_build_residual_table(label, validation), f"residuals-{number}")
        for number, (label, validation) in enumerate(report.predictions)
    ]
    return [section_markup(ERROR, {"tables": tables})] if tables else []


def _build_residual_table(label: str, validation: Validation) -> Table:
    built = validation.metrics_as_built
    cad = validation.metrics_cad
    analysis = validation.residuals()
    return Table.of(
        range(len(validation.joint_names)),
        (
            Column("joint", of=lambda k: validation.joint_names[k]),
            Column("unit", of=lambda k: validation.units[k]),
            Column("RMS, CAD", "", "right", 3, of=lambda k: cad.rms[k]),
            Column("RMS, as built", "", "right", 3, of=lambda k: built.rms[k]),
            Column("largest", "", "right", 3, of=lambda k: built.max_abs[k]),
            Column(
                "of its torque",
                "%",
                "right",
                ".1f",
                of=lambda k: 100.0 * built.relative_error_per_joint[k],
            ),
            Column("R²", "", "right", ".4f", of=lambda k: built.r_squared[k]),
            Column("mean", "", "right", 2, of=lambda k: analysis.mean[k]),
            Column("Durbin-Watson", "", "right", ".2f", of=lambda k: analysis.durbin_watson[k]),
            Column("white", of=lambda k: "yes" if analysis.probability_white[k] > 0.05 else "no"),
            Column(
                "independent samples",
                align="right",
                of=lambda k: round_significant(analysis.effective_samples[k]),
            ),
        ),
        label,
    )


sections.register("torque", Section("Torque", 20, _make_torque))
sections.register(
    "error", Section("Error of the prediction as built", 30, _make_errors, folded=True)
)

ROLLOUT = """\
<div class="scroll">{{ table }}</div>
<p class="quiet">{{ note }}</p>
<div class="grid">{% for name, lines, extent, reach in joints %}
<figure><figcaption>{{ name }}, {{ extent }} over {{ seconds }} s; errors within {{ reach }}\
</figcaption>\
<svg viewBox="0 0 600 250" role="img" aria-label="motion of {{ name }} and its errors">\
{% for x in starts %}<line x1="{{ x }}" x2="{{ x }}" y1="0" y2="250" stroke="#8a8f98"\
 stroke-width="0.8" stroke-dasharray="2 4"/>{% endfor %}\
<line x1="0" x2="600" y1="210" y2="210" stroke="#8a8f98" stroke-width="0.8"/>\
{% for colour, width, pieces in lines %}{% for points in pieces %}<polyline fill="none"\
 stroke="{{ colour }}" stroke-width="{{ width }}" points="{{ points }}"/>{% endfor %}{% endfor %}\
</svg></figure>
{% endfor %}</div>
"""
COLOURS = {"measured": "#a4a9b1", "CAD": "#d98324", "as built": "#1f6feb"}
CUT = 10.0
"""Times the largest error as built at which errors by CAD are cut off."""


def _make_rollouts(report: Report) -> list[Markup]:
    rollouts = report.study.rollouts
    return [rollout_markup(report.study.result.model, rollouts)] if rollouts else []


def rollout_markup(model: RobotModel, rollouts: Sequence[Rollout]) -> Markup:
    """Return the errors of rollouts, and drawings of the motion of the longest."""
    shown = rollouts[-1]
    first = shown.motions[0].windows
    count = _count_windows(shown)
    fields = {
        "table": table_markup(tabulate_rollouts(model, rollouts), "rollouts"),
        "note": (
            f"Windows of {shown.horizon:g} s, one after another, driven by the"
            f" {shown.driven_by}: measured (grey), simulated by CAD (orange) and as built (blue)."
            " Each window starts in the measured state (dotted lines). Errors are below the motion,"
            f" cut off at {CUT:g} times the largest as built."
            + (f" The first {count} of {first.n_windows}." if count < first.n_windows else "")
        ),
        "joints": [
            _draw_joint(joint.name, shown, k, joint.unit) for k, joint in enumerate(model.joints)
        ],
        "seconds": f"{count * first.horizon:.3g}",
        "starts": [f"{600.0 * w / count:.1f}" for w in range(1, count)],
    }
    return section_markup(ROLLOUT, fields)


def _count_windows(rollout: Rollout) -> int:
    """Return how many windows of the first recording are drawn."""
    windows = rollout.motions[0].windows
    # Longest part of a recording that is drawn [s].
    return max(1, min(windows.n_windows, int(12.0 / windows.horizon)))


def _draw_joint(name: str, rollout: Rollout, k: int, unit: str) -> tuple[str, list[Any], str, str]:
    """Return name, lines, range and largest errors of a joint in the first recording."""
    motion = rollout.motions[0]
    count = _count_windows(rollout)
    paths = {"measured": motion.windows.q, "CAD": motion.cad, "as built": motion.as_built}
    there = {what: path[:count, :, k] for what, path in paths.items() if path is not None}
    measured = there["measured"]
    errors = {what: path - measured for what, path in there.items() if what != "measured"}
    largest = {what: float(np.nanmax(np.abs(x), initial=0.0)) for what, x in errors.items()}
    bound = min(CUT * largest.get("as built", np.inf), max(largest.values(), default=0.0)) or 1e-9
    reach = max(0.1 * float(np.ptp(measured)), 1.2 * largest.get("as built", 0.0), 1e-3)
    lower = float(measured.min()) - reach
    upper = float(measured.max()) + reach
    lines = [
        (
            COLOURS[what],
            3.5 if what == "measured" else 1.4,
            _draw_windows(path, lower, upper, 0.0, 160.0),
        )
        for what, path in there.items()
    ] + [
        (COLOURS[what], 1.6, _draw_windows(error, -bound, bound, 172.0, 248.0))
        for what, error in errors.items()
    ]
    texts = [
        _format_length(each, unit) + (" by CAD" if what == "CAD" else f" {what}")
        for what, each in reversed(largest.items())
    ]
    extent = f"{measured.min():.3g} to {measured.max():.3g} {unit}"
    return name, lines, extent, ", ".join(texts)


def _format_length(value: float, unit: str) -> str:
    """Return a distance in thousandths of its unit, or in the unit from one on.

    >>> _format_length(0.0123, "rad"), _format_length(6.07, "rad")
    ('12.3 mrad', '6.07 rad')
    """
    return f"{value:.3g} {unit}" if value >= 1.0 else f"{1e3 * value:.3g} m{unit}"


def _draw_windows(path: Array, lower: float, upper: float, top: float, bottom: float) -> list[str]:
    """Return the points of each window (W, L) between two heights, as far as they are finite."""
    count, length = path.shape
    # 600: points of a line.
    at = np.unique(np.linspace(0, length - 1, min(length, max(2, 600 // count))).astype(int))
    pieces = []
    for w, values in enumerate(path):
        x = 600.0 * (w + at / (length - 1)) / count
        share = np.clip((values[at] - lower) / (upper - lower), 0.0, 1.0)
        points = np.column_stack([x, bottom - share * (bottom - top)])
        there = points[np.isfinite(points[:, 1])].tolist()
        pieces.append(" ".join(f"{a:.1f},{b:.1f}" for a, b in there))
    return pieces


sections.register("rollout", Section("Rollout", 13, _make_rollouts))
