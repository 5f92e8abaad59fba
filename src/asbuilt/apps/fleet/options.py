"""Options of fleets, without what computes: a command states them before it reads anything."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from asbuilt.errors import UsageError
from asbuilt.findings import Cure
from asbuilt.identification import methods
from asbuilt.ranges import Range, check_ranges, option
from asbuilt.workflow import StudyOptions


@dataclass(frozen=True, slots=True, kw_only=True)
class FleetOptions:
    """Say who reduces logs.

    Parameters
    ----------
    workers
        Number of processes; None: one for each core. 0 reduces in this process.
    scheduler
        Address of a Dask scheduler whose workers reduce the logs in their place.
    """

    # Processes of one machine.
    workers: int | None = option(
        None, "N", "processes that reduce logs (default: one for each core)", range=Range(0, 1024)
    )
    scheduler: str | None = option(
        None,
        "ADDRESS",
        "Dask scheduler whose workers reduce the logs, such as tcp://10.0.0.1:8786",
        parse=str,
    )

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.workers is not None and self.scheduler is not None:
            raise UsageError(
                "the workers of a scheduler are not counted here; give workers or a scheduler",
                cure=Cure("start as many Dask workers as you want"),
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class FleetIdentification:
    """Configure `fleet_identify`.

    Parameters
    ----------
    method
        The estimator; one that needs no more than information.
    undetermined
        Directions that no motion excites stay at CAD and are named, or are refused.
    prior
        `"siblings"`: the other robots of the type in the ledger are the prior
        (`build_sibling_prior`), unless the robot is unlike them; the estimator is then least
        squares with this prior.

    Raises
    ------
    UsageError
        If the estimator is unknown, or needs the samples.
    """

    method: str = option(
        "consistent",
        "NAME",
        "estimator that needs no samples, such as consistent, entropic or wls",
        parse=lambda text: methods.find(text).name,
    )
    undetermined: Literal["toward_prior", "refuse"] = field(
        default="toward_prior", metadata=StudyOptions.__dataclass_fields__["undetermined"].metadata
    )
    prior: Literal["none", "siblings"] = option(
        "none",
        "NAME",
        "siblings: mean and spread of the other robots of its type, for short logs",
        choices=("none", "siblings"),
    )

    def __post_init__(self) -> None:
        if methods.find(self.method).needs != "information":
            known = [name for name in methods if methods[name].needs == "information"]
            raise UsageError(
                f"the estimator {self.method} needs samples, and a ledger has their information;"
                f" those that need no samples are {', '.join(known)}",
                value=self.method,
                available=known,
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class FleetDriftOptions:
    """Configure `fleet_drift`.

    Parameters
    ----------
    false_discovery_rate
        Share of the robots named that are expected not to have changed.

    Raises
    ------
    UsageError
        If it is not between 0 and 1.
    """

    # 0.05: usual share of the robots named that may not have changed.
    false_discovery_rate: float = option(
        0.05,
        "SHARE",
        "share of the robots named that may not have changed",
        range=Range(1e-12, 0.999),
    )

    def __post_init__(self) -> None:
        check_ranges(self)
