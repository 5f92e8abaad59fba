"""Section: all base parameters with their intervals, next to CAD."""

from __future__ import annotations

import math
from typing import Any

from markupsafe import Markup

from asbuilt.tables import format_percent, round_beside, round_with_error
from asbuilt.validation.comparison.compared_parameter import ComparedParameter
from asbuilt.writers.reports.page import section_markup
from asbuilt.writers.reports.report import Report, Section, sections

TEMPLATE = """\
<p>{{ verdict }}</p>
<div class="controls">
<label>Find <input id="find" type="search" placeholder="Izz4, Fv, m7 ..." \
autocomplete="off"></label>
<label>Show <select id="show"><option value="">all</option>\
{% for verdict in verdicts %}<option value="{{ verdict }}">{{ verdict }}</option>{% endfor %}\
</select></label>
<span class="quiet" id="count" aria-live="polite"></span>
</div>
<div class="scroll">
<table class="numbers" id="parameter-table">
<thead><tr>
<th scope="col" class="number" aria-sort="ascending"><button type="button">id</button></th>
<th scope="col"><button type="button">parameter</button></th>
<th scope="col" class="minor"><button type="button">unit</button></th>
<th scope="col" class="number"><button type="button">CAD</button></th>
<th scope="col" class="number"><button type="button">as built</button></th>
<th scope="col" class="number"><button type="button">std err</button></th>
<th scope="col" class="number minor"><button type="button">%</button></th>
<th scope="col"><span class="key"><i class="ring"></i>CAD <i class="dot"></i>\
as built, 95 %</span></th>
<th scope="col" class="number"><button type="button">vs CAD</button></th>
</tr></thead>
<tbody>
{% for row in rows %}
<tr data-verdict="{{ row.verdict }}">
<td class="number" data-value="{{ row.id }}">{{ row.id }}</td>
<td class="expression">{{ row.expression }}<span class="words">{{ row.words }}</span></td>
<td class="minor">{{ row.unit | replace("^2", "²") }}</td>
<td class="number" data-value="{{ row.cad_value }}">{{ row.cad }}</td>
<td class="number strong" data-value="{{ row.built_value }}">{{ row.built }}</td>
<td class="number" data-value="{{ row.error_value }}">{{ row.error }}</td>
<td class="number minor" data-value="{{ row.percent_value }}">{{ row.percent }}</td>
<td class="interval"><svg viewBox="0 0 170 30" width="170" height="30" role="img" aria-label="CAD \
{{ row.cad }}, as built {{ row.built }}, standard error {{ row.error }}">\
<path class="scale" d="M0 17H170{% for x, _ in row.ticks %}M{{ x }} 14v6{% endfor %}"/>\
{% for x, text in row.ticks %}<text x="{{ x }}" y="29">{{ text }}</text>{% endfor %}\
<path class="bar" d="M{{ row.low }} 8H{{ row.high }}"/>\
{% if row.x_cad is not none %}<circle class="cad" cx="{{ row.x_cad }}" cy="8" r="5"/>{% endif %}\
<circle class="built" cx="{{ row.x }}" cy="8" r="3.5"/></svg></td>
<td class="number {{ row.verdict | replace(" ", "-") }}" data-value="{{ row.sigmas }}" \
title="{{ row.sigma_text }}">{{ row.outcome }}</td>
</tr>
{% endfor %}
</tbody>
</table>
</div>
<p class="quiet">Each drawing has its own scale. DIFFERS: {{ rule }} over all parameters (Benjamini\
 and Hochberg). {{ errors }}</p>
"""

WIDTH = 170.0
MARGIN = 12.0
"""Size of a drawing, and space left of its smallest and right of its largest value."""


def _make_parameters(report: Report) -> list[Markup]:
    comparison = report.study.comparison
    fields = {
        "verdict": comparison.verdict(),
        "verdicts": list(dict.fromkeys(parameter.verdict for parameter in comparison.parameters)),
        "rows": [_build_row(parameter) for parameter in comparison.parameters],
        "rule": comparison.rule(),
        "errors": comparison.errors,
    }
    return [section_markup(TEMPLATE, fields)]


def _build_row(parameter: ComparedParameter) -> dict[str, Any]:
    """Return texts, sort keys and the drawing of one parameter."""
    cad = parameter.cad
    value = parameter.estimate
    error = parameter.std_error
    shown, uncertainty = round_with_error(value, error)
    return {
        "id": parameter.id,
        "expression": parameter.expression,
        "words": parameter.words,
        "unit": parameter.unit,
        "cad": "-" if cad is None else round_beside(cad, error),
        "cad_value": _choose_key(cad),
        "built": shown,
        "built_value": value,
        "error": "dropped" if parameter.verdict == "dropped" else uncertainty,
        "error_value": _choose_key(error),
        "percent": format_percent(value, error),
        "percent_value": _choose_key(None if error is None or not value else abs(error / value)),
        "verdict": parameter.verdict,
        "outcome": parameter.outcome,
        "sigmas": _choose_key(None if parameter.sigmas is None else abs(parameter.sigmas)),
        "sigma_text": "" if parameter.sigmas is None else f"{parameter.sigmas:+.1f} sigma",
        **place_interval(value, 1.96 * (error or 0.0), cad),
    }


def place_interval(value: float, half: float, cad: float | None) -> dict[str, Any]:
    """Return where an interval, its CAD value and two to four ticks are drawn."""
    ends = [value - half, value + half, *([] if cad is None else [cad])]
    low = min(ends)
    high = max(ends)
    if high - low <= 1e-9 * max(abs(low), abs(high)):
        low, high = (min(0.0, low), max(0.0, high)) if high or low else (-1.0, 1.0)

    def place(x: float) -> float:
        return round(MARGIN + (WIDTH - 2 * MARGIN) * (x - low) / (high - low), 1)

    power = 10.0 ** math.floor(math.log10((high - low) / 2))
    step = next(f * power for f in (5.0, 2.0, 1.0) if f * power <= (high - low) / 2 or f == 1.0)
    first = math.ceil(low / step - 1e-9)
    last = math.floor(high / step + 1e-9)
    ticks = [k * step for k in range(first, last + 1)]
    return {
        "x": place(value),
        "low": place(value - half),
        "high": place(value + half),
        "x_cad": None if cad is None else place(cad),
        "ticks": [(place(x), f"{x + 0.0:.6g}") for x in ticks[:: max(1, len(ticks) // 2)]],
    }


def _choose_key(value: float | None) -> float | str:
    return "" if value is None else value


sections.register("parameters", Section("Parameters", 60, _make_parameters, folded=True))
