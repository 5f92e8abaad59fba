"""Plain weighted least squares on Pinocchio's regressor: the textbook, without any tool."""

from __future__ import annotations

from adapter import Estimate, Facts, Fit
from flyer import Flyer
from loops import regression_of

PACKAGE = "pin"
REQUIRES = ["pin>=3.4", "scipy"]
TITLE = "weighted least squares, Pinocchio"
ADDRESS = "https://github.com/stack-of-tasks/pinocchio"


def fit(facts: Facts) -> Fit:
    """Identify base parameters."""
    return regression_of(facts).weighted_fit()


def payload(facts: Facts) -> list[Estimate]:
    """Weigh what the last link carries."""
    return [regression_of(facts).payload()]


def weights(facts: Facts) -> list[Estimate]:
    """Return the first moments of what a body carries, log by log."""
    return regression_of(facts).moments()


def fit_legs(facts: Facts) -> Fit:
    """Identify base parameters of a robot with a free base."""
    return Flyer(facts).weighted_fit()
