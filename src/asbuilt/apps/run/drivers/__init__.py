"""Drivers: what moves a robot along a motion and returns the log.

A driver has two methods, `record` and `describe`. Another distribution adds one with an entry point
of the group `asbuilt.drivers`: a module that registers a function from `DriverRequest` to `Driver`.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from asbuilt import Recording, RobotModel
from asbuilt.errors import UsageError
from asbuilt.excitation import Motion
from asbuilt.registry import Registry


class Driver(Protocol):
    """Move a robot along a motion and return what it logged.

    A driver may have the attribute `moves_metal`. Where it is missing or true, every motion is
    confirmed before it is sent.
    """

    def record(self, motion: Motion) -> Recording:
        """Move along the motion; return positions and torques, currents or commands."""
        ...

    def describe(self) -> str:
        """Return what is moved and what logs, in one phrase."""
        ...


@dataclass(frozen=True, kw_only=True)
class DriverRequest:
    """Hold what a driver is made from.

    Parameters
    ----------
    model
        The robot as described.
    argument
        The text after the colon, such as `lab` of `virtual:lab`; empty without one.
    seed
        Seed of random numbers.
    programs
        Formats of controller programs that the user wants.
    collision
        Bodies whose distance the programs check.
    stopped
        Returns whether the user wants the loop to end; a driver that waits asks it.
    """

    model: RobotModel
    argument: str = ""
    seed: int = 0
    programs: tuple[str, ...] = ()
    collision: str | None = None
    stopped: Callable[[], bool] = lambda: False

    @property
    def folder(self) -> Path:
        """The argument as a folder; raises `UsageError` without one."""
        if not self.argument:
            raise UsageError("the driver files needs a folder: files:DIR")
        # Shells leave a ~ after the colon as it is.
        return Path(os.path.expanduser(self.argument))


DRIVERS: Registry[Callable[[DriverRequest], Driver]] = Registry(
    "driver", "asbuilt.apps.run.drivers", "asbuilt.drivers"
)
"""Makers of drivers by name."""


def open_driver(name: str, request: DriverRequest) -> Driver:
    """Return the driver of a name such as `virtual`; raises `UsageError` if there is none."""
    return DRIVERS.find(name)(request)


def moves_metal(driver: Driver) -> bool:
    """Return whether a driver moves a real robot, which it does unless it says otherwise."""
    return bool(getattr(driver, "moves_metal", True))
