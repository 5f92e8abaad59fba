"""Registry of the sections of a report."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from asbuilt.identification.calibration.payload import Payload
from asbuilt.registry import Registry
from asbuilt.validation import Recovery, Validation, recording_name
from asbuilt.workflow.study import Study


@dataclass(frozen=True, eq=False)
class Report:
    """Hold what a report shows: a study, the payload identified with it, and the command line.

    `recovery` compares the result with the truth of a virtual robot.
    """

    study: Study
    payload: Payload | None = None
    command: Sequence[str] = ()
    recovery: Recovery | None = None

    @cached_property
    def predictions(self) -> tuple[tuple[str, Validation], ...]:
        """Predictions with their names: of validation data, then of training data."""
        return (
            *(
                (recording_name(validation.source), validation)
                for validation in self.study.validations
            ),
            *((f"{recording_name(each.source)}, training", each) for each in self.study.training),
        )


@dataclass(frozen=True, slots=True)
class Section:
    """Describe one section of a report.

    Parameters
    ----------
    title
        Heading, and name in the contents.
    order
        Place on the page; sections with smaller numbers come first.
    template
        Text of a Jinja template; names are escaped.
    context
        Function from a `Report` to the fields of the template; None leaves the section out.
    folded
        Whether a reader opens it: what is no part of the decision.
    """

    title: str
    order: float
    template: str
    context: Callable[[Report], Mapping[str, Any] | None]
    folded: bool = False


sections: Registry[Section] = Registry(
    "report section", "asbuilt.writers.reports.sections", "asbuilt.report_sections"
)
"""Sections by identifier; another distribution adds its own by this entry point group."""
