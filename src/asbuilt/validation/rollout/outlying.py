"""Windows in which something acts that the model lacks: contact, a servo limit, a load."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from asbuilt.arrays import Array, Indices

if TYPE_CHECKING:
    from asbuilt.identification.trajectories.windows import Windows

OUTLYING = 2.5
"""Error of a window, in medians of all windows, beyond which it is outlying: own choice."""
FEWEST = 8
"""Fewest windows that have a usual error."""


@dataclass(frozen=True, slots=True)
class OutlyingWindow:
    """Name a window: recording, time of its start [s], error [rad or m] and its largest joint."""

    source: str
    start: float
    rms: float
    joint: str

    def as_dict(self) -> dict[str, Any]:
        """Return plain data."""
        return {
            "source": self.source,
            "start": self.start,
            "rms": self.rms if np.isfinite(self.rms) else None,
            "joint": self.joint,
        }


def find_outlying_windows(
    windows: Sequence[Windows], simulated: Sequence[Array], joint_names: Sequence[str]
) -> tuple[tuple[OutlyingWindow, ...], list[Indices]]:
    """Return the outlying windows, and for each recording the indices of the others."""
    errors = [
        np.sqrt(np.mean((path - cut.q)[:, 1:] ** 2, axis=1))
        for cut, path in zip(windows, simulated, strict=True)
    ]
    size = [np.sqrt(np.mean(error**2, axis=1)) for error in errors]
    every = np.concatenate(size)
    limit = OUTLYING * float(np.nanmedian(every)) if len(every) >= FEWEST else np.inf
    found, regular = list[OutlyingWindow](), list[Indices]()
    for cut, error, own in zip(windows, errors, size, strict=True):
        usual = own <= limit if np.isfinite(limit) else np.ones(len(own), dtype=np.bool_)
        regular.append(np.flatnonzero(usual))
        found += [
            OutlyingWindow(
                cut.source,
                float(cut.starts[w]),
                float(own[w]),
                joint_names[int(np.argmax(np.nan_to_num(error[w], nan=np.inf)))],
            )
            for w in np.flatnonzero(~usual)
        ]
    return tuple(found), regular
