"""The estimators by name: one table, one way to call them."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Literal

from asbuilt.errors import UsageError

if TYPE_CHECKING:
    from asbuilt.identification.evidence import Evidence
    from asbuilt.identification.least_squares import Estimate

Needs = Literal["information", "samples", "simulation"]


@dataclass(frozen=True, slots=True)
class Method:
    """Name an estimator: `title` in a heading, `description` in one line, and what it `needs` beside the square-root information.

    `"information"` is the square-root information alone, milliseconds; `"samples"` are further passes over the rows; `"simulation"` simulates the robot too.
    `home` is the module and the function of this room, imported on first use.
    """

    name: str
    title: str
    description: str
    needs: Needs
    home: str

    def estimate(self, evidence: Evidence) -> Estimate:
        """Return the estimate from the evidence; raises `IdentifiabilityError` where that does not suffice."""
        module, function = self.home.split(":")
        estimate: Estimate = getattr(import_module(f"asbuilt.identification.{module}"), function)(evidence)
        return estimate


methods: dict[str, Method] = {
    method.name: method
    for method in (
        Method("ols", "ordinary least squares", "every torque counts alike", "information", "least_squares:estimate_ols"),
        Method("wls", "weighted least squares", "a weight per joint, from its own noise", "information", "least_squares:estimate_wls"),
    )
}
"""All estimators, in the order in which they are listed."""


def find_method(name: str) -> Method:
    """Return the estimator of this name; raises `UsageError`, listing all, where there is none."""
    if name not in methods:
        raise UsageError(f"there is no estimator {name!r}; there are {', '.join(methods)}")
    return methods[name]


def method_title(name: str) -> str:
    """Return the title of an estimator, its name where it is unknown (as in results of other versions)."""
    return methods[name].title if name in methods else name
