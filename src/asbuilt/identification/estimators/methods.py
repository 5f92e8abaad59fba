"""The estimators by name: one table, one way to call them."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Literal

from asbuilt.errors import UsageError

if TYPE_CHECKING:
    from asbuilt.identification.estimators.least_squares import Estimate
    from asbuilt.identification.information.estimation_data import EstimationData

Needs = Literal["information", "samples", "simulation"]


@dataclass(frozen=True, slots=True)
class Method:
    """Name an estimator: `title` in a heading, `description` in one line, and what it `needs`
    beside the square-root information.

    `"information"` is the square-root information alone, milliseconds; `"samples"` are further
    passes over the rows; `"simulation"` simulates the robot too. `home` is the module and the
    function of this room, imported on first use.
    """

    name: str
    title: str
    description: str
    needs: Needs
    home: str

    def estimate(self, data: EstimationData) -> Estimate:
        """Return the estimate from the data.

        Raises `IdentifiabilityError` where that does not suffice.
        """
        module, function = self.home.split(":")
        estimate: Estimate = getattr(
            import_module(f"asbuilt.identification.estimators.{module}"), function
        )(data)
        return estimate


methods: dict[str, Method] = {
    method.name: method
    for method in (
        Method(
            "ols",
            "ordinary least squares",
            "every torque counts alike",
            "information",
            "least_squares:estimate_ols",
        ),
        Method(
            "wls",
            "weighted least squares",
            "a weight per joint, from its own noise",
            "information",
            "least_squares:estimate_wls",
        ),
        Method(
            "auto",
            "picked automatically",
            "wls, huber, ridge, consistent or entropic, by rules that the summary states",
            "samples",
            "auto:estimate_auto",
        ),
        Method(
            "ridge",
            "ridge toward CAD",
            "drawn toward CAD as far as held-out blocks ask for",
            "information",
            "ridge:estimate_ridge",
        ),
        Method(
            "huber",
            "Huber's robust fit",
            "outliers pull with bounded force",
            "samples",
            "robust:estimate_huber",
        ),
        Method(
            "bisquare",
            "Tukey's robust fit",
            "gross outliers, collisions and contacts, do not pull at all",
            "samples",
            "robust:estimate_bisquare",
        ),
        Method(
            "ml",
            "maximum likelihood",
            "noise that joints share, its covariance estimated along",
            "samples",
            "maximum_likelihood:estimate_ml",
        ),
        Method(
            "total",
            "total least squares",
            "errors in positions and their derivatives too",
            "information",
            "total_least_squares:estimate_total",
        ),
        Method(
            "iv",
            "instrumental variables",
            "noise in the motion, by a simulated motion without it",
            "simulation",
            "instruments:estimate_iv",
        ),
        Method(
            "essential",
            "weighted least squares, essential parameters",
            "parameters that an F-test does not miss set to zero",
            "information",
            "essential:estimate_essential",
        ),
        Method(
            "consistent",
            "physically consistent least squares",
            "the real bodies and passive drives that fit best, by conic program",
            "information",
            "consistent_fit:estimate_consistent",
        ),
        Method(
            "entropic",
            "physically consistent, with an entropic CAD prior",
            "real bodies near CAD; the weight of CAD from held-out time blocks",
            "information",
            "consistent_fit:estimate_entropic",
        ),
        Method(
            "euclidean",
            "physically consistent, with a quadratic CAD prior",
            "the same with a quadratic distance from CAD",
            "information",
            "consistent_fit:estimate_euclidean",
        ),
    )
}
"""All estimators, in the order in which they are listed."""


def find_method(name: str) -> Method:
    """Return the estimator of this name; raises `UsageError`, listing all, where there is none."""
    if name not in methods:
        raise UsageError(f"there is no estimator {name!r}; there are {', '.join(methods)}")
    return methods[name]


def method_title(name: str) -> str:
    """Return the title of an estimator, its name where it is unknown (as in results of other
    versions).
    """
    return methods[name].title if name in methods else name
