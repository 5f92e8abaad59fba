"""Errors of simulated positions, what they compare with, and windows that no model explains."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from asbuilt.arrays import Array, Indices
from asbuilt.codec import make_plain
from asbuilt.description.model import RobotModel
from asbuilt.description.structure.parts import Joint
from asbuilt.dynamics.kinematics import link_poses
from asbuilt.errors import UsageError
from asbuilt.experiment.root import root_of
from asbuilt.identification.calibration.delay import FARTHEST
from asbuilt.identification.calibration.payload import choose_payload_frame

if TYPE_CHECKING:
    from asbuilt.identification.trajectories.windows import Windows

TURN = 2.0 * np.pi
"""Distance [rad] from the measured position at which a revolute joint counts as diverged."""
OUTLYING = 2.5
"""Error of a window, in medians of all windows, beyond which it is outlying: own choice."""
FEWEST = 8
"""Fewest windows that have a usual error."""


def position_unit(model: RobotModel) -> str:
    """Return the unit of a thousandth of the positions of the joints that have a drive."""
    return joint_unit([model.joints[k] for k in model.driven_joints])


def joint_unit(joints: Iterable[Joint]) -> str:
    """Return the unit of a thousandth of the positions of joints."""
    kinds = {joint.is_revolute for joint in joints}
    return "mrad or mm" if len(kinds) > 1 else "mrad" if kinds == {True} else "mm"


@dataclass(frozen=True, slots=True, eq=False)
class RolloutErrors:
    """Hold position errors of simulated windows, in rad or m; NaN if a window diverged.

    Attributes
    ----------
    rms
        Of each joint, over all samples after the start of all windows, shape (n,).
    rms_all
        Of all joints with a drive together.
    final
        Of each joint at the end of the windows, shape (n,).
    tool
        Root mean square distance [m] between measured and simulated tool at the end of the
        windows; None if the robot has several ends or none.
    diverged
        Number of windows in which the simulation diverged.
    until
        Time since the start of a window [s] before which no simulation diverged, of this robot or
        one that it is compared with; the whole window if none did.
    rms_until, rms_all_until
        As `rms` and `rms_all`, over the samples before that time; NaN if there are none.
    unit
        Of a thousandth of the positions, as `joint_unit` has it.
    base
        Of a free base: root mean square distance [m] between its measured and simulated places, and
        angle [rad] between its verticals; None of a root that is fixed, or moves in a plane.
    """

    rms: Array
    rms_all: float
    final: Array
    tool: float | None
    diverged: int
    until: float
    rms_until: Array
    rms_all_until: float
    unit: str
    base: tuple[float, float] | None = None

    @property
    def text(self) -> str:
        """The error of all joints with its unit, or that the simulation diverges."""
        return "diverges" if self.diverged else f"{1e3 * self.rms_all:.3g} {self.unit}"

    @property
    def text_until(self) -> str:
        """The error of all joints before any simulation diverges, with its unit."""
        return f"{1e3 * self.rms_all_until:.3g} {self.unit}"

    def as_dict(self) -> dict[str, Any]:
        """Return plain numbers, None for what is not finite."""
        base = self.base and dict(zip(("position", "tilt"), self.base, strict=True))
        plain = {key: value for key, value in make_plain(self).items() if key != "unit"}
        return plain | {"base": make_plain(base)}


@dataclass(frozen=True, slots=True, eq=False)
class RecordingErrors:
    """Hold the errors over the windows of one recording, None where there are none.

    `no_physics` are errors of the delayed command, `regular` errors as built over windows that are
    not outlying.
    """

    source: str
    n_windows: int
    cad: RolloutErrors | None
    as_built: RolloutErrors | None
    no_physics: RolloutErrors | None = None
    regular: RolloutErrors | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return what `--json` prints."""
        return {
            "source": self.source,
            "n_windows": self.n_windows,
            **{
                name: errors and errors.as_dict()
                for name in BY_RECORDING
                for errors in (getattr(self, name),)
            },
        }


BY_RECORDING = ("cad", "as_built", "no_physics", "regular")
"""Names of the errors of a recording."""


def average_errors(recordings: Sequence[RecordingErrors]) -> dict[str, float | None]:
    """Return the mean of `rms_all` over recordings, however many windows each has.

    None where a recording has no such errors; recordings without regular windows do not count
    there.
    """
    found: dict[str, float | None] = {}
    for name in BY_RECORDING:
        every = [getattr(one, name) for one in recordings]
        known = [one.rms_all for one in every if one is not None]
        whole = known and (name == "regular" or len(known) == len(every))
        found[name] = float(np.mean(known)) if whole else None
    return found


def drop_lost(model: RobotModel, measured: Array, simulated: Array) -> Array:
    """Return simulated positions (W, L, n), NaN from where a window diverges.

    It does where a position is not finite, or a revolute joint a whole turn from the measured one.
    """
    revolute = np.array([joint.is_revolute for joint in model.joints])
    with np.errstate(invalid="ignore"):
        near = np.isfinite(simulated) & ~(revolute & (np.abs(simulated - measured) >= TURN))
    # Once lost, a window stays lost: later positions mean nothing.
    lost = np.maximum.accumulate(~np.all(near, axis=2), axis=1)
    return np.where(lost[..., None], np.nan, simulated)


def find_divergence(times: Array, simulated: Array) -> float:
    """Return when the first of some windows (W, L, n) diverges [s]; infinite if none does.

    `times` (L,) count from the start of a window to each sample.
    """
    lost = ~np.all(np.isfinite(simulated), axis=(0, 2))
    return float(np.min(times[lost], initial=np.inf))


def measure_rollout_errors(
    model: RobotModel,
    times: Sequence[Array],
    measured: Sequence[Array],
    simulated: Sequence[Array],
    until: float | None = None,
) -> RolloutErrors:
    """Compare simulated with measured positions of windows.

    Parameters
    ----------
    model
        The robot.
    times
        Times of the samples of the windows of each recording since their start [s], shapes (L,).
    measured, simulated
        Positions of the windows of each recording, shapes (W, L, n).
    until
        When the first simulation diverges [s], of this robot or one that it is compared with;
        None: of this robot.
    """
    # Until the first one diverges, so that robots compare over the same time.
    if until is None:
        until = min(map(find_divergence, times, simulated))
    # The start is given, and has no error.
    error = [(b - a)[:, 1:] for a, b in zip(measured, simulated, strict=True)]
    early = [x[:, t[1:] < until] for x, t in zip(error, times, strict=True)]
    free = model.driven_joints.start
    ends = [np.concatenate([x[:, -1] for x in paths]) for paths in (measured, simulated)]
    return RolloutErrors(
        *_evaluate_rms(error, free),
        np.sqrt(np.mean((ends[1] - ends[0]) ** 2, axis=0)),
        _measure_tool_distance(model, *ends),
        int(sum(np.sum(~np.all(np.isfinite(q), axis=(1, 2))) for q in simulated)),
        min(until, max(float(t[-1]) for t in times)),
        *_evaluate_rms(early, free),
        position_unit(model),
        root_of(model).measure_errors(measured, simulated),
    )


def _evaluate_rms(errors: Sequence[Array], free: int) -> tuple[Array, float]:
    """Return the root mean square of errors (W, L, n) by joint, and of all from `free` on.

    NaN of none.
    """
    every = np.concatenate([error.reshape(-1, error.shape[2]) for error in errors])
    if not len(every):
        return np.full(every.shape[1], np.nan), float("nan")
    return np.sqrt(np.mean(every**2, axis=0)), float(np.sqrt(np.mean(every[:, free:] ** 2)))


def _measure_tool_distance(model: RobotModel, measured: Array, simulated: Array) -> float | None:
    """Return the root mean square distance [m] between the tools of two poses (W, n)."""
    ends = set(range(model.n_links)) - set(model.parents)
    # Several ends, or none on the way to the tool: no single tool moves.
    if model.mixes_joints or any(model.tool_link not in model.ancestors(end) for end in ends):
        return None
    try:
        _, link, placement = choose_payload_frame(model)
    except UsageError:
        return None
    there = np.all(np.isfinite(simulated), axis=1)
    # A window that diverged has no end.
    if not there.all():
        return np.nan
    places = [(link_poses(model, q)[:, link] @ placement)[:, :3, 3] for q in (measured, simulated)]
    return float(np.sqrt(np.mean(np.sum((places[1] - places[0]) ** 2, axis=1))))


@dataclass(frozen=True, slots=True)
class OutlyingWindow:
    """Name a window: recording, time of its start [s], error [rad or m] and its largest joint."""

    source: str
    start: float
    rms: float
    joint: str


def find_outlying_windows(
    windows: Sequence[Windows], simulated: Sequence[Array | None], joint_names: Sequence[str]
) -> tuple[tuple[OutlyingWindow, ...], list[Indices]]:
    """Return the outlying windows, and for each recording the indices of the others.

    Nothing of both where a recording was not simulated.
    """
    errors = [
        np.sqrt(np.mean((path - cut.q)[:, 1:] ** 2, axis=1))
        for cut, path in zip(windows, simulated, strict=True)
        if path is not None
    ]
    if len(errors) < len(windows):
        return (), []
    size = [np.sqrt(np.mean(error**2, axis=1)) for error in errors]
    every = np.concatenate(size)
    known = every[np.isfinite(every)]
    # Few windows have no usual error, nor have windows that all diverged.
    limit = OUTLYING * float(np.median(known)) if len(every) >= FEWEST and len(known) else np.inf
    found = list[OutlyingWindow]()
    regular = list[Indices]()
    for cut, error, window_errors in zip(windows, errors, size, strict=True):
        # NaN of a window that diverged is not usual, unless nothing says what is.
        usual = (window_errors <= limit) | np.isinf(limit)
        regular.append(np.flatnonzero(usual))
        found += [
            OutlyingWindow(
                cut.source,
                float(cut.starts[w]),
                float(window_errors[w]),
                joint_names[int(np.argmax(np.nan_to_num(error[w], nan=np.inf)))],
            )
            for w in np.flatnonzero(~usual)
        ]
    return tuple(found), regular


# Say when two windows have the same command: own choices.
#
# At every one of `REPETITION_POINTS` times of the window each joint's command must agree within
# `REPETITION_TOLERANCE` of its range in all windows, and the command must move by
# `REPETITION_MOVING` of it.

REPETITION_POINTS = 8
REPETITION_TOLERANCE = 2e-3
REPETITION_MOVING = 0.02


ROUNDING = 1e-3
"""Share of a period by which times of samples and commands differ by rounding."""


def pair_repeated_windows(windows: Sequence[Windows]) -> tuple[list[Array], list[Array]] | None:
    """Return the positions of pairs of windows with the same command; None if there are none.

    Recordings whose windows have another number of samples than most are left out. Two lists of
    one array (pairs, L, n).
    """
    if any(window.signal.kind != "command" for window in windows):
        return None
    lengths = [window.n_samples for window in windows]
    usual = max(lengths, key=lengths.count)
    windows = [window for window in windows if window.n_samples == usual]
    commands = _stack_commands(windows)
    q = np.concatenate([window.q for window in windows])
    size = np.ptp(commands, axis=(0, 1))
    if len(q) < 2 or not np.any(size > 0.0):
        return None
    # Joints without commands that move never differ.
    scaled = commands / np.where(size > 0.0, size, np.inf)
    # Rests repeat by themselves, and say nothing.
    moves = np.ptp(scaled, axis=1).max(axis=1) > REPETITION_MOVING
    places = np.flatnonzero(moves)
    # A few times are enough to tell commands apart.
    at = np.linspace(0, scaled.shape[1] - 1, REPETITION_POINTS).astype(int)
    if len(places) < 2:
        return None
    from scipy.spatial import KDTree  # noqa: PLC0415 - light start

    tree = KDTree(scaled[places][:, at].reshape(len(places), -1))
    pairs = tree.query_pairs(REPETITION_TOLERANCE, p=np.inf, output_type="ndarray")
    if not len(pairs):
        return None
    first = places[pairs[:, 0]]
    second = places[pairs[:, 1]]
    return [q[first]], [q[second]]


def _stack_commands(windows: Sequence[Windows]) -> Array:
    """Return the command at the samples of all windows, shape (W, L, n)."""
    parts = []
    for window in windows:
        # Times that agree up to rounding take the command of the same sample.
        times = window.starts[:, None] + window.times + ROUNDING / window.rate
        at = np.searchsorted(window.signal.t, times, side="right") - 1
        parts.append(window.signal.values[np.clip(at, 0, len(window.signal.t) - 1)])
    return np.concatenate(parts)


def delay_command(windows: Windows) -> Array | None:
    """Return the motion of the command from the measured position, shape (W, L, n).

    It is delayed by the time that fits the windows best. None if torques drive.
    """
    if windows.signal.kind != "command":
        return None
    times = windows.starts[:, None] + windows.times

    def delayed(delay: float) -> Array:
        command = np.stack(
            [np.interp(times - delay, windows.signal.t, u) for u in windows.signal.values.T],
            axis=-1,
        )
        # From the measured start on: only the motion of the command counts.
        return np.asarray(command - command[:, :1] + windows.start_q[:, None])

    from scipy.optimize import minimize_scalar  # noqa: PLC0415 - light start

    found = minimize_scalar(
        lambda delay: float(np.mean((delayed(delay) - windows.q)[:, 1:] ** 2)),
        bounds=(0.0, FARTHEST),
        method="bounded",
    )
    return delayed(float(found.x))
