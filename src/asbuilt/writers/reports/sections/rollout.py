"""Section: measured motion beside the motion simulated from the measured state."""

from __future__ import annotations

from typing import Any

import numpy as np

from asbuilt.arrays import Array
from asbuilt.validation.rollout.rollout import Rollout
from asbuilt.writers.reports.page import table_markup
from asbuilt.writers.reports.section import Report, Section, sections
from asbuilt.writers.tables.rollout_tables import position_unit, rollout_table

TEMPLATE = """\
<div class="scroll">{{ table }}</div>
<p class="quiet">{{ note }}</p>
<div class="grid">{% for name, lines, lower, upper in joints %}
<figure><figcaption>{{ name }}, {{ lower }} to {{ upper }} {{ unit }} over {{ seconds }} s\
</figcaption><svg viewBox="0 0 600 160" role="img" aria-label="motion of {{ name }}">\
{% for colour, width, points in lines %}<polyline fill="none" stroke="{{ colour }}"\
 stroke-width="{{ width }}" points="{{ points }}"/>{% endfor %}</svg></figure>
{% endfor %}</div>
"""
COLOURS = {"measured": "#8a8f98", "CAD": "#d98324", "as built": "#1f6feb"}
POINTS = 1500
"""Points of a line."""


def _context(report: Report) -> dict[str, Any] | None:
    rollouts = report.study.rollouts
    if not rollouts:
        return None
    model, shown = report.study.result.model, rollouts[-1]
    first = shown.motions[0]
    count = first.windows.n_windows * first.windows.n_samples
    return {
        "table": table_markup(rollout_table(model, rollouts), "rollouts"),
        "note": (
            f"Windows of {shown.horizon:g} s, one after another, driven by the"
            f" {shown.driven_by}: measured (grey), simulated by CAD (orange) and as built (blue)."
            " Each window starts in the measured state."
        ),
        "joints": [_joint(model.joint_names[k], shown, k) for k in range(model.n_joints)],
        "unit": position_unit(model).removeprefix("m").replace(" mm", " m"),
        "seconds": f"{count / first.windows.rate:.3g}",
    }


def _joint(name: str, rollout: Rollout, k: int) -> tuple[str, list[Any], str, str]:
    """Return name, lines and range of a joint in the first recording."""
    motion = rollout.motions[0]
    paths = {"measured": motion.windows.q, "CAD": motion.cad, "as built": motion.as_built}
    measured = motion.windows.q[..., k]
    reach = 0.1 * float(np.ptp(measured)) or 1e-3
    lower, upper = float(measured.min()) - reach, float(measured.max()) + reach
    lines = [
        (COLOURS[what], 2.5 if what == "measured" else 1.2, _points(path[..., k], lower, upper))
        for what, path in paths.items()
        if path is not None
    ]
    return name, lines, f"{lower:.3g}", f"{upper:.3g}"


def _points(path: Array, lower: float, upper: float) -> str:
    values = path.reshape(-1)
    at = np.unique(np.linspace(0, len(values) - 1, min(len(values), POINTS)).astype(int))
    x = 600.0 * at / max(len(values) - 1, 1)
    y = 160.0 * (1.0 - np.clip((values[at] - lower) / (upper - lower), 0.0, 1.0))
    return " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True) if np.isfinite(b))


sections.register("rollout", Section("Rollout", 25, TEMPLATE, _context))
