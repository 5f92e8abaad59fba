"""Recording: what a robot logged, before any filtering."""

from __future__ import annotations

import html
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array, Indices, Mask, find_true_rows, read_only
from asbuilt.dynamics.drives.position_servo import PositionServo
from asbuilt.errors import RecordingError
from asbuilt.findings import Cure, join_names

if TYPE_CHECKING:
    from asbuilt.dynamics.reactions import Reactions

TorqueSource = Literal["sensor", "motor", "current", "command", "unknown"]
TORQUE_SOURCES: tuple[TorqueSource, ...] = ("sensor", "motor", "current", "command", "unknown")
OF_JOINTS = ("q", "tau", "qd", "qdd", "command")
"""Channels of a recording with a column for each joint."""
EncoderSide = Literal["motor", "link"]
ENCODERS: Mapping[str, str] = {"motor": "q_motor", "link": "q_link"}
"""Positions of a second encoder of each joint, by the side of the drive train that it is on."""


FLIPPED = "the sign of every torque was flipped"
FLIPPED_TWICE = "the sign of every torque was flipped twice, so that it is again as logged"
"""Notes of `Recording.flipped`."""
UNWRAPPED = "positions that wrap at"
"""Beginning of the note on positions that went on where their counters began again."""


@dataclass(frozen=True, eq=False, repr=False)
class Recording:
    """Hold one recording as the robot logged it.

    Values may be NaN and times may decrease: `check_recording` finds that. A joint whose torque is
    NaN throughout, or constant while it moves, has no torque (`has_torque`).

    Parameters
    ----------
    t
        Times [s], shape (N,).
    q, tau
        Joint positions [rad or m] and torques [N m or N], shape (N, n); a torque is positive in
        the direction in which the drive accelerates the joint.
    qd, qdd
        Velocities and accelerations, if logged, shape (N, n).
    joint_names
        Names of the n joints, in the order of the columns.
    source
        Name of the recording, such as its file.
    torque_source
        What measured the torque: a joint torque "sensor", the "motor", its "current" (times a
        gain), the "command" of a position servo, or "unknown".
    notes
        Sentences about what the reader assumed or changed.
    extra
        Other quantities (N,) or (N, m) by name, such as `tau_ext`.
    gains
        Factors by which the logged torques were multiplied, one per joint, without signs.
    command
        Commanded positions [rad or m], if logged, shape (N, n).
    servo
        The position servo that follows the command, as far as it is known.
    started
        Time from which `t` counts [s since 1970-01-01 UTC]; 0 if the log's clock has no date.
    undriven
        Joints without a drive, such as the joints of a free base: their torque is known to be zero.
    contact
        Contacts of a robot with a free base, (N, n_contacts), 1 where they are closed and 0 where
        they are open; None: it touches nothing.
    stated
        What a person states of the log, and checks believe: "position", "torque" (their units or
        gains), "sign", "zero".

    Raises
    ------
    RecordingError
        If shapes do not agree, names repeat or there is no sample.

    Examples
    --------
    >>> t, q, tau = [0.0, 0.01], [[0.0], [0.1]], [[1.0], [2.0]]
    >>> recording = Recording(t=t, q=q, tau=tau, joint_names=("elbow",), source="log.csv")
    >>> recording
    Recording('log.csv': 2 samples x 1 joints (elbow), 0.01 s at 100 Hz, torque from unknown)
    >>> recording.flipped().tau[1, 0].item()
    -2.0
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
    command: Array | None = None
    servo: PositionServo | None = None
    started: float = 0.0
    undriven: tuple[str, ...] = ()
    contact: Array | None = None
    stated: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        t = _freeze(self.t, "t", self.source)
        # None is refused as a torque, as it is no array of the shape of q.
        channels = {
            name: _freeze(getattr(self, name), name, self.source)
            for name in OF_JOINTS
            if name == "tau" or getattr(self, name) is not None
        }
        extra = {name: _freeze(values, name, self.source) for name, values in self.extra.items()}
        q = channels["q"]
        if t.ndim != 1 or t.size == 0:
            raise RecordingError(
                f"{self.source}: t must be a vector of at least one time, got shape {t.shape}",
                file=self.source,
                value=t.shape,
            )
        if q.ndim != 2 or q.shape[0] != t.size or q.shape[1] == 0:
            raise RecordingError(
                f"{self.source}: q must have shape ({t.size}, n_joints) to go with {t.size} times,"
                f" got {q.shape}",
                file=self.source,
                value=q.shape,
            )
        for name, array in channels.items():
            if array.shape != q.shape:
                raise RecordingError(
                    f"{self.source}: {name} must have the shape of q, {q.shape}, got {array.shape}",
                    file=self.source,
                    value=array.shape,
                    expected=q.shape,
                )
        names = tuple(self.joint_names) or tuple(f"joint_{k}" for k in range(1, q.shape[1] + 1))
        repeated = min((name for name in names if names.count(name) > 1), default=None)
        n_gains = q.shape[1] if self.servo is None else len(self.servo.kp)
        if len(names) != q.shape[1]:
            raise RecordingError(
                f"{self.source}: {q.shape[1]} columns in q but {len(names)} joint names:"
                f" {', '.join(names)}",
                file=self.source,
                value=len(names),
                expected=q.shape[1],
            )
        if repeated is not None:
            raise RecordingError(
                f"{self.source}: joint name {repeated!r} is used {names.count(str(repeated))}"
                " times; each joint needs its own",
                file=self.source,
                value=repeated,
            )
        if self.torque_source not in TORQUE_SOURCES:
            raise RecordingError(
                f"{self.source}: torque_source {self.torque_source!r} is not one of"
                f" {', '.join(TORQUE_SOURCES)}",
                file=self.source,
                value=self.torque_source,
                available=TORQUE_SOURCES,
            )
        if n_gains != q.shape[1]:
            raise RecordingError(
                f"{self.source}: the servo has gains of {n_gains} joints, the log has {q.shape[1]}",
                file=self.source,
                value=n_gains,
                expected=q.shape[1],
            )
        for name, array in extra.items():
            if array.ndim not in (1, 2) or array.shape[0] != t.size:
                raise RecordingError(
                    f"{self.source}: {name} has shape {array.shape} but there are {t.size} times",
                    file=self.source,
                    value=array.shape,
                )
        settled = {
            "t": t,
            **channels,
            "joint_names": names,
            "notes": tuple(self.notes),
            "extra": MappingProxyType(extra),
        }
        for name, value in settled.items():
            object.__setattr__(self, name, value)

    def __repr__(self) -> str:
        return (
            f"Recording({self.source!r}: {self.n_samples} samples x {self.n_joints} joints"
            f" ({join_names(self.joint_names)}), {self.duration:.4g} s at {self.rate:.4g} Hz,"
            " torque"
            f" from {self.torque_source})"
        )

    def _repr_html_(self) -> str:
        """Return a table of the range of every joint for notebooks."""
        limits = [
            pick(values, axis=0) for values in (self.q, self.tau) for pick in (np.nanmin, np.nanmax)
        ]
        rows = "".join(
            f"<tr><td>{html.escape(name)}</td>"
            + "".join(f"<td>{value:.4g}</td>" for value in values)
            + "</tr>"
            for name, *values in zip(self.joint_names, *limits, strict=True)
        )
        heads = ("joint", "position from", "to", "torque from", "to")
        head = "".join(f"<th>{head}</th>" for head in heads)
        return f"<table><caption>{html.escape(repr(self))}</caption><tr>{head}</tr>{rows}</table>"

    @property
    def n_samples(self) -> int:
        """Number of samples."""
        return int(self.t.size)

    @property
    def has_computed_torque(self) -> bool:
        """Whether its torque was not measured, but is what a law makes of commands."""
        return self.torque_source == "command"

    @property
    def driving_command(self) -> Array | None:
        """The commands (N, n) from which its torque follows; None where it was measured."""
        return self.command if self.has_computed_torque else None

    @property
    def drive_law(self) -> PositionServo | None:
        """The law by which commands became torques; None where the torque was measured."""
        return None if self.driving_command is None else self.servo

    @property
    def n_joints(self) -> int:
        """Number of joints."""
        return int(self.q.shape[1])

    @cached_property
    def has_torque(self) -> Mask:
        """Which joints have a usable torque channel, shape (n,).

        None has one whose torque is nowhere finite, or one and the same while the joint moves.
        Torques that follow from commands are no channel, and count as usable.

        >>> q, tau = np.array([[0.0, 0.0], [0.1, 0.0]]), np.zeros((2, 2))
        >>> Recording(t=[0.0, 0.01], q=q, tau=tau).has_torque.tolist()
        [False, True]
        """
        if self.has_computed_torque:
            return np.ones(self.n_joints, dtype=np.bool_)
        measured = [_is_signal(*each) for each in zip(self.tau.T, self.q.T, strict=True)]
        undriven = [name in self.undriven for name in self.joint_names]
        return np.logical_or(measured, undriven)

    @property
    def second_encoder(self) -> tuple[EncoderSide, Array] | None:
        """Side and positions (N, n) of a second encoder of each joint; None without one."""
        for side in get_args(EncoderSide):
            other = self.extra.get(ENCODERS[side])
            if other is not None and other.shape == self.q.shape:
                return side, other
        return None

    def with_torque_of(self, has_torque: Mask) -> Recording:
        """Return the recording with torques of zero at joints that have none."""
        if has_torque.all():
            return self
        return replace(self, tau=np.where(has_torque, self.tau, 0.0))

    @property
    def rate(self) -> float:
        """Inverse of the median positive time step [Hz]; NaN if there is none."""
        steps = np.diff(self.t)
        steps = steps[np.isfinite(steps) & (steps > 0)]
        return 1.0 / float(np.median(steps)) if steps.size else float("nan")

    @property
    def duration(self) -> float:
        """Time from the earliest to the latest sample [s]."""
        known = self.t[np.isfinite(self.t)]
        return float(np.ptp(known)) if known.size else float("nan")

    def flipped(self) -> Recording:
        """Return the recording with the opposite sign of all torques, also of extra ones."""
        extra = {
            name: -value if name.startswith("tau") else value for name, value in self.extra.items()
        }
        kept = tuple(note for note in self.notes if note != FLIPPED)
        note = FLIPPED_TWICE if FLIPPED in self.notes else FLIPPED
        return replace(self, tau=-self.tau, extra=extra, notes=(*kept, note))

    def scaled(self, gain: ArrayLike) -> Recording:
        """Return the recording with torques times `gain`, one number or one per joint."""
        gains = np.atleast_1d(np.asarray(gain, dtype=np.float64))
        if gains.ndim != 1 or gains.size not in (1, self.n_joints):
            raise RecordingError(
                f"{self.source}: {gains.size} gains for {self.n_joints} joints"
                f" ({', '.join(self.joint_names)})",
                cure=Cure("give one gain, or one per joint"),
                file=self.source,
                value=gains.size,
                expected=self.n_joints,
            )
        if not np.all(np.isfinite(gains)) or np.any(gains == 0):
            raise RecordingError(
                f"{self.source}: gains must be finite and not zero, got {gains.tolist()}",
                file=self.source,
                value=gains.tolist(),
            )
        listed = ", ".join(f"{g:g}" for g in gains)
        before = np.ones(self.n_joints) if self.gains is None else np.array(self.gains)
        return replace(
            self,
            tau=self.tau * gains,
            notes=(*self.notes, f"torques were multiplied by {listed}"),
            gains=tuple((gains * before).tolist()),
        )

    def reordered(self, names: Sequence[str]) -> Recording:
        """Return the recording with columns in the order of `names`; other joints are dropped."""
        missing = [name for name in names if name not in self.joint_names]
        if missing:
            raise RecordingError(
                f"{self.source} has no joint {missing[0]!r}; it has {', '.join(self.joint_names)}",
                file=self.source,
                joint=missing[0],
                available=self.joint_names,
            )
        order = [self.joint_names.index(name) for name in names]
        extra = {
            k: v[:, order] if v.ndim == 2 and v.shape[1] == self.n_joints else v
            for k, v in self.extra.items()
        }
        return replace(
            self,
            **self._change_channels(lambda x: x[:, order]),
            joint_names=tuple(names),
            extra=extra,
            gains=None if self.gains is None else tuple(self.gains[k] for k in order),
            servo=None if self.servo is None else self.servo.reordered(order),
        )

    def _change_channels(self, change: Callable[[Array], Array]) -> dict[str, Any]:
        """Return the channels of the joints (N, n) changed, None where they were not logged."""
        channels = {name: getattr(self, name) for name in OF_JOINTS}
        return {name: None if x is None else change(x) for name, x in channels.items()}

    def behind(
        self, names: Sequence[str], q: Array, qd: Array | None, qdd: Array | None
    ) -> Recording:
        """Return the recording with joints (N, k) before its own that nothing drives.

        Rates are left out where they are known of some joints alone.
        """
        still = np.zeros_like(q)
        before = {"q": q, "tau": still, "qd": qd, "qdd": qdd, "command": still}
        joined: dict[str, Any] = {
            name: _join([first, getattr(self, name)], axis=1) for name, first in before.items()
        }
        return replace(
            self,
            **joined,
            joint_names=(*names, *self.joint_names),
            undriven=tuple(names),
            gains=None if self.gains is None else (*[1.0] * len(names), *self.gains),
            servo=None if self.servo is None else self.servo.behind_base(len(names)),
        )

    def between(self, start: float, stop: float) -> Recording:
        """Return the samples with `start <= t < stop` [s]."""
        return self.taken(
            (self.t >= start) & (self.t < stop), f"no sample between {start:g} s and {stop:g} s"
        )

    def taken(self, keep: Mask | Indices | slice, empty: str = "no sample is left") -> Recording:
        """Return the samples that `keep` selects."""
        if not self.t[keep].size:
            raise RecordingError(
                f"{self.source}: {empty}; it lasts from {np.nanmin(self.t):g} s to"
                f" {np.nanmax(self.t):g} s",
                file=self.source,
                lower=float(np.nanmin(self.t)),
                upper=float(np.nanmax(self.t)),
            )
        return replace(
            self,
            **self._change_channels(lambda x: x[keep]),
            t=self.t[keep],
            extra={name: value[keep] for name, value in self.extra.items()},
            contact=None if self.contact is None else self.contact[keep],
        )

    @property
    def has_touch_downs(self) -> bool:
        """Whether forces that nobody measured begin or end while it is recorded."""
        if self.contact is None:
            return False
        closed = self.contact > 0.5
        # Feet that never move make no touch-down.
        return not np.all(closed == closed[0])

    def reactions_at(self, t: Array, margin: float) -> Reactions:
        """Return the reactions at times t, of contacts that are closed then or `margin` [s] of it.

        Filters spread what happens at a change of contact over its neighbours, where a contact that
        is open counts as one that may be closed.
        """
        from asbuilt.dynamics.reactions import Reactions  # noqa: PLC0415 - light start

        if self.contact is None:
            return Reactions()
        # A sample at the very edge counts, however the clock is rounded.
        reach = margin + (0.5 + 1e-6) / self.rate
        first = np.searchsorted(self.t, t - reach)
        last = np.searchsorted(self.t, t + reach)
        counts = np.cumsum(np.nan_to_num(self.contact, nan=1.0) > 0.5, axis=0, dtype=np.float64)
        counts = np.vstack([np.zeros((1, counts.shape[1])), counts])
        return Reactions(read_only(counts[last] - counts[first] > 0.0))


WORDS = {None: np.nan, "auto": np.nan, "none": np.inf}
"""Words that stand for a number which is unknown, or without bound."""


def spread_over_joints(recording: Recording, given: Any, what: str) -> Array:
    """Return numbers that are given once or per joint as (n,); "auto" and None are NaN."""
    listed = given if isinstance(given, list | tuple) else [given]
    numbers = np.array([WORDS[each] if each in WORDS else float(each) for each in listed])
    if numbers.size not in (1, recording.n_joints):
        raise RecordingError(
            f"{recording.source}: {numbers.size} {what} for {recording.n_joints} joints"
            f" ({', '.join(recording.joint_names)})",
            cure=Cure("give one, or one per joint"),
            file=recording.source,
            value=numbers.tolist(),
            expected=recording.n_joints,
        )
    return np.broadcast_to(numbers, recording.n_joints)


def join_recordings(parts: Sequence[Recording]) -> Recording:
    """Return consecutive parts of a recording as one, with the channels that all of them have.

    Accelerations and extra quantities are left out.
    """
    joined: dict[str, Any] = {
        name: _join([getattr(part, name) for part in parts], axis=0)
        for name in ("t", "q", "tau", "qd", "command", "contact")
    }
    return replace(parts[-1], **joined, qdd=None, extra={})


def _join(parts: Sequence[Array | None], axis: int) -> Array | None:
    """Return parts of a channel as one; None where it was not logged in one of them."""
    known = [part for part in parts if part is not None]
    return np.concatenate(known, axis) if len(known) == len(parts) else None


def find_changed_rows(*channels: Array) -> Mask:
    """Return which rows of channels (N, ...) differ from the row before; the first one does.

    >>> find_changed_rows(np.array([[1.0], [1.0], [2.0]])).tolist()
    [True, False, True]
    """
    changed = [find_true_rows(np.atleast_2d((x[1:] != x[:-1]).T).T) for x in channels]
    return np.concatenate([[True], np.logical_or.reduce(changed)])


def find_advancing_rows(t: Array, kept: Mask) -> Mask:
    """Return which of the kept rows (N,) are later than all kept ones before them.

    Examples
    --------
    >>> kept = np.array([True, True, True, False])
    >>> find_advancing_rows(np.array([0.0, 2.0, 1.0, 3.0]), kept).tolist()
    [True, True, False, False]
    """
    latest = np.maximum.accumulate(np.where(kept, t, -np.inf))
    return np.asarray(kept & (t > np.concatenate([[-np.inf], latest[:-1]])))


def _is_signal(tau: Array, q: Array) -> bool:
    """Return whether torques (N,) of a joint at positions (N,) are measured."""
    tau = tau[np.isfinite(tau)]
    moved = q[np.isfinite(q)]
    still = not moved.size or bool(moved.max() == moved.min())
    return tau.size > 0 and (still or bool(np.any(tau != tau[0])))


def _freeze(value: ArrayLike, name: str, source: str) -> Array:
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise RecordingError(
            f"{source}: {name} is not an array of numbers ({error})", file=source
        ) from error
    if array.flags.writeable:
        array = array.copy() if array is value or array.base is not None else array
        array.setflags(write=False)
    return array
