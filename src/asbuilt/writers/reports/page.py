"""HTML pages from templates: texts escaped, one style, nothing asked of the network."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from asbuilt.tables import Table, share

CITATION = (
    "A. A. Hayat, V. Abhishek and S. K. Saha, Dynamic identification of manipulator: comparison"
    " between CAD and actual parameters, iNaCoMM 2015."
)


def page(template: str, **fields: Any) -> str:
    """Return a template of this package filled with fields; all text but `Markup` is escaped."""
    return (
        _environment()
        .get_template(template)
        .render(version=_version(), citation=CITATION, style=resource("report.css"), **fields)
    )


def section_markup(template: str, fields: Mapping[str, Any]) -> Markup:
    """Return the text of a template filled with fields; all text but `Markup` is escaped."""
    return Markup(_environment().from_string(template).render(**fields))


def table_markup(table: Table, identifier: str) -> Markup:
    """Return a table as HTML that is not escaped again."""
    return Markup(table.as_html(identifier))


def resource(name: str) -> Markup:
    """Return the text of a file beside the templates, unescaped."""
    return Markup((Path(__file__).parent / "templates" / name).read_text(encoding="utf-8"))


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("asbuilt.writers.reports", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["share"] = share
    return environment


def _version() -> str:
    try:
        return version("asbuilt")
    except PackageNotFoundError:
        return "unknown version"
