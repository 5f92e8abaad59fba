"""HTML pages of blocks: texts escaped, one style, nothing asked of the network."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from asbuilt.tables import Table

CITATION = (
    "A. A. Hayat, V. Abhishek and S. K. Saha, Dynamic identification of manipulator: comparison"
    " between CAD and actual parameters, iNaCoMM 2015."
)

REPORT_TEMPLATES = Path(__file__).parent / "templates"
"""Folder of the templates, styles and scripts of reports, some of which other pages share."""

ENVIRONMENT = Environment(
    loader=PackageLoader("asbuilt.writers.reports", "templates"),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)

Mood = Literal["good", "bad", "neutral"]


@dataclass(frozen=True, slots=True)
class Card:
    """Hold one statement: a number and its label."""

    mood: Mood
    figure: str
    label: str


@dataclass(frozen=True, slots=True)
class Block:
    """Hold a part of a page under a heading; `short` is its name in the contents.

    A folded block is opened by the reader, and not in the contents.
    """

    identifier: str
    heading: str
    parts: Sequence[Markup]
    short: str = ""
    folded: bool = False


def render_page(heading: str, subject: str, blocks: Iterable[Block], **fields: Any) -> str:
    """Return a page; blocks without parts are left out.

    `fields` belong to the template: `title`, `subtitle`, and for plots `script` and `data`.
    """
    own = {
        "heading": heading,
        "subject": subject,
        "title": f"{heading}: {subject}",
        "blocks": [block for block in blocks if any(block.parts)],
        "version": version("asbuilt"),
        "citation": CITATION,
        "style": read_resource("report.css"),
    }
    return ENVIRONMENT.get_template("page.html.j2").render(own | fields)


def section_markup(template: str, fields: Mapping[str, Any]) -> Markup:
    """Return the text of a template filled with fields; all text but `Markup` is escaped."""
    return Markup(ENVIRONMENT.from_string(template).render(**fields))


def cards_markup(cards: Sequence[Card]) -> Markup:
    """Return numbers with their labels, side by side."""
    return section_markup('{% include "cards.html.j2" %}', {"cards": cards})


def list_markup(items: Iterable[str | tuple[str, str]], heading: str = "") -> Markup:
    """Return texts as a list; of a pair the first is the class of the line, such as a severity.

    Nothing, and no heading, where there are none.
    """
    lines = [("", item) if isinstance(item, str) else item for item in items]
    return section_markup(LINES, {"lines": lines, "heading": heading}) if lines else Markup("")


LINES = """\
{% if heading %}
<h3>{{ heading }}</h3>
{% endif %}
<ul class="sentences">
{% for kind, text in lines %}
<li{% if kind %} class="{{ kind }}"{% endif %}>{{ text }}</li>
{% endfor %}
</ul>
"""


def facts_markup(facts: Iterable[tuple[str, str]]) -> Markup:
    """Return names with their texts, in columns."""
    pairs = (Markup("<div><dt>{}</dt><dd>{}</dd></div>").format(*fact) for fact in facts)
    return Markup('<dl class="facts">{}</dl>').format(Markup("").join(pairs))


def paragraph_markup(text: str, kind: str = "quiet") -> Markup:
    """Return a paragraph of a class of the style, such as `quiet` or `verdict bad`."""
    return Markup('<p class="{}">{}</p>').format(kind, text)


def image_markup(address: str, words: str, narrow: str = "") -> Markup:
    """Return a drawing with its description, and another one for narrow screens."""
    image = Markup('<img class="drawn" src="{}" alt="{}">').format(address, words)
    source = Markup('<source media="(max-width: 40rem)" srcset="{}">').format(narrow)
    return Markup("<picture>{}{}</picture>").format(source, image) if narrow else image


def table_markup(table: Table, identifier: str, kind: str = "scroll") -> Markup:
    """Return a table, which scrolls where the page is narrow."""
    return Markup('<div class="{}">{}</div>').format(kind, Markup(table.as_html(identifier)))


def read_resource(name: str) -> Markup:
    """Return the text of a file in the folder of templates, unescaped."""
    return Markup((Path(__file__).parent / "templates" / name).read_text(encoding="utf-8"))
