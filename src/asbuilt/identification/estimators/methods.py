"""The registry of estimators: each module of this package registers its own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, TypeVar

from asbuilt.registry import Registry

if TYPE_CHECKING:
    from asbuilt.identification.information.estimate import Estimate, EstimationData

Needs = Literal["information", "samples", "simulation"]
Estimation = Callable[["EstimationData"], "Estimate"]
E = TypeVar("E", bound=Estimation)

JOINT_WEIGHTS = "the weights of the joints"
ROW_WEIGHTS = "the weights of joints and rows"
REGULARISATION = "the regularisation toward CAD"


@dataclass(frozen=True, slots=True)
class Estimator:
    """Describe an estimator.

    Parameters
    ----------
    name
        Key in `methods`.
    title
        Heading of a summary.
    description
        One line of help.
    estimate
        Function that estimates; raises `IdentifiabilityError` if the data do not suffice.
    needs
        `"information"`: the square-root information alone, milliseconds; `"samples"`: further
        passes over the rows; `"simulation"`: a simulation of the robot as well.
    held_fixed
        What the estimator chooses from the data and bootstrap fits keep.
    regularised
        Whether the estimate is regularised toward CAD.
    """

    name: str
    title: str
    description: str
    estimate: Estimation
    needs: Needs = "information"
    held_fixed: tuple[str, ...] = (JOINT_WEIGHTS,)
    regularised: bool = False


methods: Registry[Estimator] = Registry(
    "estimator", "asbuilt.identification.estimators", "asbuilt.estimators"
)


def estimator(
    name: str,
    title: str,
    description: str,
    *,
    needs: Needs = "information",
    held_fixed: tuple[str, ...] = (JOINT_WEIGHTS,),
    regularised: bool = False,
) -> Callable[[E], E]:
    """Register the decorated function as an estimator, with the fields of `Estimator`."""

    def register(estimate: E) -> E:
        methods.register(
            name, Estimator(name, title, description, estimate, needs, held_fixed, regularised)
        )
        return estimate

    return register


def method_title(name: str) -> str:
    """Return the title of an estimator, or its name if no estimator of that name is installed."""
    return methods[name].title if name in methods else name
