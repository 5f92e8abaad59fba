"""C files of an observer, compiled and called."""

from __future__ import annotations

import ctypes
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from asbuilt import Thresholds
from asbuilt.identification import IdentificationResult
from asbuilt.writers.models.export import write_observer

FLAGS = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O1")


class Compiled:
    """A shared library made from a C file, whose functions begin with `prefix`."""

    def __init__(self, source: Path, prefix: str) -> None:
        library = source.with_suffix(".so")
        subprocess.run(
            ["gcc", *FLAGS, "-shared", "-fPIC", str(source), "-o", str(library), "-lm"], check=True
        )
        self.library, self.prefix = ctypes.CDLL(str(library)), prefix

    def call(self, function: str, *values: Any) -> Any:
        """Call a function with arrays, which it may fill, and numbers."""
        given = [
            x.ctypes.data_as(ctypes.POINTER(ctypes.c_double)) if isinstance(x, np.ndarray) else x
            for x in values
        ]
        return getattr(self.library, f"{self.prefix}_{function}")(*given)

    def filled(self, function: str, size: int | tuple[int, ...], *given: np.ndarray) -> np.ndarray:
        """Return the array that a function fills from other arrays."""
        out = np.full(size, np.nan)
        self.call(function, *(np.ascontiguousarray(x) for x in given), out)
        return out


class CompiledObserver:
    """The observer of a robot in C with the interface of the one in Python."""

    def __init__(
        self, folder: Path, result: IdentificationResult, thresholds: Thresholds | None = None
    ) -> None:
        source, header = write_observer(folder / "watch.c", result, thresholds=thresholds)
        self.text = source.read_text()
        prefix = header.read_text().split("_JOINTS")[0].split("#define ")[-1].lower()
        self.code, self.names = Compiled(source, prefix), result.model.joint_names
        self.n, self.last = len(self.names), -np.inf
        self.state = np.zeros(11 * self.n + 1)
        self.code.call("observer_restart", self.state)

    def update(self, t: float, q: np.ndarray, tau: np.ndarray, qd: np.ndarray) -> np.ndarray:
        step = ctypes.c_double(t - self.last if np.isfinite(self.last) else 0.0)
        q, qd, tau = (np.ascontiguousarray(x) for x in (q, qd, tau))
        self.code.call("observer_update", self.state, step, q, qd, tau)
        self.last = t
        return self.state[: self.n]

    def threshold(self, q: np.ndarray) -> np.ndarray:
        out = np.full(self.n, np.nan)
        self.code.call("observer_threshold", self.state, np.ascontiguousarray(q), out)
        return out

    def alarms(self, threshold: np.ndarray) -> Sequence[str]:
        bits = self.code.call("observer_alarms", self.state, threshold)
        return tuple(name for j, name in enumerate(self.names) if bits >> j & 1)
