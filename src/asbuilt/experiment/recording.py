"""What a robot logged: time, joint positions, torques and whatever else the controller wrote down."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from asbuilt.arrays import Array
from asbuilt.errors import RecordingError

TorqueSource = Literal["sensor", "motor", "current", "unknown"]
TORQUE_SOURCES: tuple[TorqueSource, ...] = ("sensor", "motor", "current", "unknown")


@dataclass(frozen=True, eq=False)
class Recording:
    """Hold one recording as the robot logged it, before any filtering.

    `t` (N,) s; `q`, `tau` and, where logged, `qd`, `qdd` (N, n) in rad or m, N m or N, and their
    derivatives, column k belonging to `joint_names[k]`; `tau` is positive in the direction in which
    the drive pushes the joint. `torque_source` says what measured it: a joint torque "sensor", a
    "motor"-side estimate, a "current" (times a gain) or "unknown". `extra` keeps other quantities
    of shape (N,) or (N, m) under their role names, such as `tau_ext`. `notes` says in sentences
    what the reader assumed or changed. `gains` is what the logged torques were multiplied by, one
    per joint, None where they were left as logged; signs are not among them.

    Values may be NaN and times may run back: that is what `check_recording` looks for.

    Raises
    ------
    RecordingError
        If shapes do not agree, names repeat or there is no sample.

    Examples
    --------
    >>> recording = Recording(t=[0.0, 0.01], q=[[0.0], [0.1]], tau=[[1.0], [2.0]], joint_names=("elbow",), source="log.csv")
    >>> recording.n_samples, round(recording.rate), recording.flipped().tau[1, 0].item()
    (2, 100, -2.0)
    """

    t: Array
    q: Array
    tau: Array
    qd: Array | None = None
    qdd: Array | None = None
    joint_names: tuple[str, ...] = ()
    source: str = "recording"
    torque_source: TorqueSource = "unknown"
    notes: tuple[str, ...] = ()
    extra: Mapping[str, Array] = field(default_factory=dict)
    gains: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        t = _read_only(self.t, "t", self.source)
        if t.ndim != 1 or t.size == 0:
            raise RecordingError(
                f"{self.source}: t must be a vector of at least one time, got shape {t.shape}"
            )
        q = _read_only(self.q, "q", self.source)
        if q.ndim != 2 or q.shape[0] != t.size or q.shape[1] == 0:
            raise RecordingError(
                f"{self.source}: q must have shape ({t.size}, n_joints) to go with {t.size} times,"
                f" got {q.shape}"
            )
        object.__setattr__(self, "t", t)
        object.__setattr__(self, "q", q)
        for name in ("tau", "qd", "qdd"):
            value = getattr(self, name)
            if value is None and name != "tau":
                continue
            array = _read_only(value, name, self.source)
            if array.shape != q.shape:
                raise RecordingError(
                    f"{self.source}: {name} must have the shape of q, {q.shape}, got {array.shape}"
                )
            object.__setattr__(self, name, array)
        names = tuple(self.joint_names) or tuple(f"joint_{k}" for k in range(1, q.shape[1] + 1))
        if len(names) != q.shape[1]:
            raise RecordingError(
                f"{self.source}: {q.shape[1]} columns in q but {len(names)} joint names:"
                f" {', '.join(names)}"
            )
        repeated = sorted({name for name in names if names.count(name) > 1})
        if repeated:
            raise RecordingError(
                f"{self.source}: joint name {repeated[0]!r} is used {names.count(repeated[0])}"
                " times; each joint needs its own"
            )
        if self.torque_source not in TORQUE_SOURCES:
            raise RecordingError(
                f"{self.source}: torque_source {self.torque_source!r} is not one of"
                f" {', '.join(TORQUE_SOURCES)}"
            )
        extra = {name: _read_only(value, name, self.source) for name, value in self.extra.items()}
        for name, array in extra.items():
            if array.ndim not in (1, 2) or array.shape[0] != t.size:
                raise RecordingError(
                    f"{self.source}: {name} has shape {array.shape} but there are {t.size} times"
                )
        object.__setattr__(self, "joint_names", names)
        object.__setattr__(self, "notes", tuple(self.notes))
        object.__setattr__(self, "extra", MappingProxyType(extra))

    @property
    def n_samples(self) -> int:
        """Number of samples."""
        return int(self.t.size)

    @property
    def n_joints(self) -> int:
        """Number of joints."""
        return int(self.q.shape[1])

    @property
    def rate(self) -> float:
        """Sampling rate [Hz]: the inverse of the median positive time step.

        NaN where there is none.
        """
        return median_rate(self.t)

    @property
    def duration(self) -> float:
        """Time from the earliest to the latest sample [s]."""
        return time_span(self.t)

    def flipped(self) -> Recording:
        """Return the recording with the opposite torque sign (also of extra torques), for
        controllers that log the load's torque.
        """
        extra = {
            name: -value if name.startswith("tau") else value for name, value in self.extra.items()
        }
        return replace(
            self,
            tau=-self.tau,
            extra=extra,
            notes=(*self.notes, "the sign of every torque was flipped"),
        )

    def scaled(self, gain: ArrayLike) -> Recording:
        """Return the recording with each joint's torque column multiplied by `gain`, one number or
        one per joint, e.g. N m per ampere.
        """
        gains = np.atleast_1d(np.asarray(gain, dtype=np.float64))
        if gains.ndim != 1 or gains.size not in (1, self.n_joints):
            raise RecordingError(
                f"{self.source}: {gains.size} gains for {self.n_joints} joints"
                f" ({', '.join(self.joint_names)}); give one, or one per joint"
            )
        if not np.all(np.isfinite(gains)) or np.any(gains == 0):
            raise RecordingError(
                f"{self.source}: gains must be finite and not zero, got {gains.tolist()}"
            )
        listed = ", ".join(f"{g:g}" for g in gains)
        total = tuple(
            (gains * np.ones(self.n_joints) * (1.0 if self.gains is None else self.gains)).tolist()
        )
        return replace(
            self,
            tau=self.tau * gains,
            notes=(*self.notes, f"torques were multiplied by {listed}"),
            gains=total,
        )

    def reordered(self, names: Sequence[str]) -> Recording:
        """Return the recording with columns in the order of `names`, every one of which it must
        have; other joints are dropped.
        """
        missing = [name for name in names if name not in self.joint_names]
        if missing:
            raise RecordingError(
                f"{self.source} has no joint {missing[0]!r}; it has {', '.join(self.joint_names)}"
            )
        order = [self.joint_names.index(name) for name in names]
        extra = {
            k: v[:, order] if v.ndim == 2 and v.shape[1] == self.n_joints else v
            for k, v in self.extra.items()
        }
        return replace(
            self,
            q=self.q[:, order],
            tau=self.tau[:, order],
            qd=None if self.qd is None else self.qd[:, order],
            qdd=None if self.qdd is None else self.qdd[:, order],
            joint_names=tuple(names),
            extra=extra,
            gains=None if self.gains is None else tuple(self.gains[k] for k in order),
        )

    def between(self, start: float, stop: float) -> Recording:
        """Return the samples with `start <= t < stop` [s]."""
        return self.taken(
            (self.t >= start) & (self.t < stop), f"no sample between {start:g} s and {stop:g} s"
        )

    def taken(self, keep: NDArray[np.bool_] | slice, empty: str = "no sample is left") -> Recording:
        """Return the samples that the mask or slice `keep` selects."""
        if not self.t[keep].size:
            raise RecordingError(
                f"{self.source}: {empty}; it runs from {np.nanmin(self.t):g} s to"
                f" {np.nanmax(self.t):g} s"
            )
        return replace(
            self,
            t=self.t[keep],
            q=self.q[keep],
            tau=self.tau[keep],
            qd=None if self.qd is None else self.qd[keep],
            qdd=None if self.qdd is None else self.qdd[keep],
            extra={name: value[keep] for name, value in self.extra.items()},
        )


def median_rate(t: Array) -> float:
    """Return the sampling rate [Hz] of times (N,) [s]: the inverse of the median positive step.

    NaN where there is none.
    """
    steps = np.diff(t)
    steps = steps[np.isfinite(steps) & (steps > 0)]
    return float(1.0 / np.median(steps)) if steps.size else float("nan")


def time_span(t: Array) -> float:
    """Return the time from the earliest to the latest of times (N,) [s]."""
    return float(np.nanmax(t) - np.nanmin(t)) if np.any(np.isfinite(t)) else float("nan")


def _read_only(value: ArrayLike, name: str, source: str) -> Array:
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise RecordingError(f"{source}: {name} is not an array of numbers ({error})") from error
    if array.flags.writeable:
        array = array.copy() if array is value or array.base is not None else array
        array.setflags(write=False)
    return array
