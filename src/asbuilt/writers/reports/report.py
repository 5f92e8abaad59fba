"""Report of an identification: one self-contained HTML page made of registered sections.

The page asks the network for nothing; every name in it may come from a stranger's file and is
escaped.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from asbuilt.codec import plain
from asbuilt.identification.calibration.payload import Payload
from asbuilt.validation.comparison.comparison import recording_name
from asbuilt.workflow.study import Study
from asbuilt.writers.files import atomic_write
from asbuilt.writers.reports.page import Block, page, resource, section_markup
from asbuilt.writers.reports.plot_data import plot_data
from asbuilt.writers.reports.section import Report, sections


def write_report(
    path: str | os.PathLike[str],
    study: Study,
    *,
    payload: Payload | None = None,
    command: Sequence[str] = (),
) -> Path:
    """Write the report of a study.

    Parameters
    ----------
    path
        File to write.
    study
        The study; it is shown as it is, and nothing is computed anew.
    payload
        The payload identified with it.
    command
        Command line that repeats the study.

    Returns
    -------
    Path
        The file written.
    """
    return atomic_write(path, report_html(study, payload=payload, command=command))


def report_html(
    study: Study, *, payload: Payload | None = None, command: Sequence[str] = ()
) -> str:
    """Return the report of a study as text; see `write_report`."""
    report = Report(study, payload, command)
    shown = []
    for identifier, section in sorted(sections.items(), key=lambda item: item[1].order):
        context = section.context(report)
        if context is not None:
            body = section_markup(section.template, context)
            shown.append(Block(identifier, section.title, (body,), folded=section.folded))
    robot = study.result.robot
    sources = ", ".join(recording_name(source) for source in study.result.sources)
    return page(
        robot,
        "as built",
        shown,
        title=f"{robot}, as built",
        subtitle=f"Identified from {sources}",
        data=plain(plot_data(report)),
        script=resource("report.js"),
    )
