"""Rollouts: recordings simulated from the measured state, by CAD and as built."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from asbuilt.arrays import Array, Indices
from asbuilt.codec import make_plain
from asbuilt.description.model import RobotModel
from asbuilt.errors import InertiaError
from asbuilt.executor import Workers, run_in_order
from asbuilt.findings import Cure, Finding, join_names
from asbuilt.tables import Cell, Column, Shown, Table, round_significant
from asbuilt.validation.rollout.position_errors import (
    OUTLYING,
    OutlyingWindow,
    RecordingErrors,
    RolloutErrors,
    average_errors,
    delay_command,
    drop_lost,
    find_divergence,
    find_outlying_windows,
    joint_unit,
    measure_rollout_errors,
    pair_repeated_windows,
)

if TYPE_CHECKING:
    from asbuilt.identification.trajectories.simulated_robot import DrivenBy, SimulatedRobot
    from asbuilt.identification.trajectories.windows import Windows


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedMotion:
    """Hold the windows of one recording and their simulations.

    `cad` and `as_built` have shape (W, L, n), or are None where there is no such robot.
    """

    windows: Windows
    cad: Array | None
    as_built: Array | None


@dataclass(frozen=True, slots=True, eq=False)
class Rollout:
    """Hold the errors of simulated windows of one length.

    Attributes
    ----------
    horizon
        Length of the windows [s].
    driven_by
        What drives the simulation.
    motions
        Windows and simulations, recording by recording.
    cad, as_built
        Errors over all windows; None where there is no such robot.
    floor
        Differences between repetitions of the same command, what no model can be below; None if
        no command was repeated.
    no_physics
        Errors of the delayed command taken for the position; None if torques drive.
    by_recording
        Errors recording by recording.
    why
        Why a robot was not simulated, by `"cad"` or `"as_built"`.
    outlying
        Windows in which something acts that the model lacks.
    regular
        Errors as built over all other windows; None if none is outlying.
    """

    horizon: float
    driven_by: DrivenBy
    motions: tuple[SimulatedMotion, ...]
    cad: RolloutErrors | None
    as_built: RolloutErrors | None
    floor: RolloutErrors | None
    no_physics: RolloutErrors | None
    by_recording: tuple[RecordingErrors, ...]
    why: tuple[tuple[str, str], ...] = ()
    outlying: tuple[OutlyingWindow, ...] = ()
    regular: RolloutErrors | None = None

    @property
    def n_windows(self) -> int:
        """Number of windows."""
        return sum(motion.windows.n_windows for motion in self.motions)

    def as_dict(self) -> dict[str, Any]:
        """Return what `--json` prints."""
        return {
            "horizon": self.horizon,
            "driven_by": self.driven_by,
            "n_windows": self.n_windows,
            **{
                name: errors and errors.as_dict()
                for name, errors in (
                    ("cad", self.cad),
                    ("as_built", self.as_built),
                    ("noise_floor", self.floor),
                    ("no_physics", self.no_physics),
                    ("regular", self.regular),
                )
            },
            "outlying": make_plain(self.outlying),
            "mean": average_errors(self.by_recording),
            "motions": [motion.as_dict() for motion in self.by_recording],
        }


def roll_out(
    model: RobotModel,
    windows: Sequence[Windows],
    cad: Sequence[SimulatedRobot | None],
    as_built: Sequence[SimulatedRobot | None],
    *,
    workers: Workers | None = None,
) -> Rollout:
    """Simulate windows of the same length and measure their errors.

    Parameters
    ----------
    model
        The robot.
    windows
        Windows of each recording.
    cad, as_built
        The robots to simulate in each recording, or None.
    workers
        Share the simulations, to the same bits; None: this process.
    """
    why: dict[str, str] = {}
    tasks = [(*zip(robots, windows, strict=True),) for robots in (cad, as_built)]
    paths = run_in_order(_simulate_task, [*tasks[0], *tasks[1]], workers)

    def simulated(name: str, found: Sequence[Array | str | None]) -> list[Array | None]:
        """Return paths, none from the first on that cannot be simulated, and note why."""
        # One robot that cannot be simulated ends its series: errors over some recordings would not
        # compare.
        kept: list[Array | None] = []
        for path, cut in zip(found, windows, strict=True):
            if isinstance(path, str):
                why.setdefault(name, path)
            if path is None or isinstance(path, str) or name in why:
                kept.append(None)
            else:
                kept.append(drop_lost(model, cut.q, path))
        return kept

    by_cad = simulated("cad", paths[: len(windows)])
    built = simulated("as_built", paths[len(windows) :])
    motions = tuple(map(SimulatedMotion, windows, by_cad, built))
    commands = [delay_command(cut) for cut in windows]
    found, usual = find_outlying_windows(windows, built, model.joint_names)
    cad_errors, built_errors, no_physics, regular = _measure_errors(
        model, motions, commands, usual if found else []
    )
    return Rollout(
        windows[0].horizon,
        windows[0].signal.kind,
        motions,
        cad_errors,
        built_errors,
        _measure_floor(model, windows),
        no_physics,
        tuple(
            RecordingErrors(
                cut.source,
                cut.n_windows,
                *_measure_errors(model, motions[k : k + 1], commands[k : k + 1], usual[k : k + 1]),
            )
            for k, cut in enumerate(windows)
        ),
        tuple(why.items()),
        found,
        regular,
    )


def _measure_errors(
    model: RobotModel,
    motions: Sequence[SimulatedMotion],
    commands: Sequence[Array | None],
    usual: Sequence[Indices],
) -> tuple[RolloutErrors | None, ...]:
    """Return errors by CAD, as built, of the delayed command, and as built over usual windows.

    None where a motion is not there, or no window of these recordings is usual.
    """
    times = [motion.windows.times for motion in motions]
    measured = [motion.windows.q for motion in motions]
    both = [motion.cad for motion in motions], [motion.as_built for motion in motions]
    ends = [
        find_divergence(t, path)
        for paths in both
        for t, path in zip(times, paths, strict=True)
        if path is not None
    ]

    def errors(
        paths: Sequence[Array | None], until: float | None = None, at: Sequence[Any] = ()
    ) -> RolloutErrors | None:
        rows = at or [slice(None)] * len(motions)
        there = [path[row] for path, row in zip(paths, rows, strict=True) if path is not None]
        if len(there) < len(motions):
            return None
        logged = [q[row] for q, row in zip(measured, rows, strict=True)]
        return measure_rollout_errors(model, times, logged, there, until)

    return (
        # Both robots up to the first divergence of either.
        *(errors(paths, min(ends, default=None)) for paths in both),
        errors(commands),
        errors(both[1], at=usual) if any(len(at) for at in usual) else None,
    )


def _measure_floor(model: RobotModel, windows: Sequence[Windows]) -> RolloutErrors | None:
    """Return the differences between repetitions of the same command; None without any."""
    pairs = pair_repeated_windows(windows)
    if pairs is None:
        return None
    length = pairs[0][0].shape[1]
    times = next(cut.times for cut in windows if cut.n_samples == length)
    # Repetitions of a base differ by where it stands.
    return replace(measure_rollout_errors(model, [times], *pairs), base=None)


def _simulate_task(task: tuple[SimulatedRobot | None, Windows]) -> Array | str | None:
    """Return the motion of a robot, None without one, or why it cannot be simulated."""
    from asbuilt.identification.trajectories.mujoco_engine import (  # noqa: PLC0415 - light start
        simulate_windows,
    )

    robot, windows = task
    try:
        # Errors of the steps are undone to first order.
        return None if robot is None else simulate_windows(robot.centred(windows.step), windows)
    except InertiaError as problem:
        return problem.message


def rollout_findings(rollouts: Sequence[Rollout]) -> tuple[Finding, ...]:
    """Return what is wrong, or worth knowing, about rollouts."""
    found = (finding for rollout in rollouts for finding in _report_rollout(rollout))
    return tuple({(finding.code, finding.message): finding for finding in found}.values())


def _report_rollout(rollout: Rollout) -> Iterator[Finding]:
    length = f"{rollout.horizon:g} s"
    for name, reason in rollout.why:
        yield Finding(
            "rollout_impossible",
            "warning",
            f"The robot {_name_model(name)} cannot be simulated: {reason}",
            Cure("identify physically consistent links", settings={"method": "entropic"}),
        )
    for name, errors in (("cad", rollout.cad), ("as_built", rollout.as_built)):
        if errors is not None and errors.diverged:
            yield Finding(
                "rollout_diverged",
                "warning",
                f"The simulation {_name_model(name)} diverges in {errors.diverged} of"
                f" {rollout.n_windows} windows of {length}, {_word_divergence(rollout)}",
                Cure("roll out shorter windows, and check gains and signs"),
            )
    yield from _report_worse_than_command(rollout, length)
    yield from _report_outlying(rollout, length)


def _word_divergence(rollout: Rollout) -> str:
    """Return when the first simulation diverges, and the errors up to there."""
    both = ((_name_model("cad"), rollout.cad), (_name_model("as_built"), rollout.as_built))
    there = [(name, errors) for name, errors in both if errors is not None]
    until = there[0][1].until
    earlier = [
        f"{errors.text_until} {name}" for name, errors in there if np.isfinite(errors.rms_all_until)
    ]
    began = f"the first after {until:.2g} s"
    return f"{began}. The error before is {join_names(earlier)}" if earlier else began


def _report_worse_than_command(rollout: Rollout, length: str) -> Iterator[Finding]:
    """Yield whether the delayed command alone is closer to the motion than the model.

    If that is so in some recordings only, they are named.
    """
    built = rollout.as_built
    plain = rollout.no_physics
    if built is None or plain is None:
        return
    message = (
        f"Over {length} the delayed command alone is closer to the measured motion than the"
        " simulation as built"
    )
    if built.rms_all > plain.rms_all or built.diverged:
        yield Finding(
            "rollout_worse_than_command",
            "warning",
            f"{message} ({1e3 * plain.rms_all:.3g} against {_format_size(built)})",
            Cure("check gains, delay and torque limits of the servo, or refine by trajectories"),
        )
        # Worse on the whole is said once, and not recording by recording.
        return
    worse = [
        f"{Path(motion.source).name} ({1e3 * motion.no_physics.rms_all:.3g} against"
        f" {_format_size(motion.as_built)})"
        for motion in rollout.by_recording
        if motion.as_built is not None
        and motion.no_physics is not None
        and motion.as_built.rms_all > motion.no_physics.rms_all
    ]
    if worse:
        yield Finding(
            "rollout_worse_than_command",
            "warning",
            f"{message} in {join_names(worse, 6)}",
            Cure("look there for rests, contact and loads that the model lacks"),
        )


def _report_outlying(rollout: Rollout, length: str) -> Iterator[Finding]:
    """Yield a finding that names the outlying windows."""
    if not rollout.outlying or rollout.regular is None or rollout.as_built is None:
        return
    # Windows that diverged come first.
    worst = sorted(rollout.outlying, key=lambda window: -np.nan_to_num(window.rms, nan=np.inf))
    places = [
        f"{Path(window.source).name} {window.start:.4g} s ({window.joint})" for window in worst
    ]
    yield Finding(
        "rollout_outlying",
        "warning",
        f"In {len(worst)} of {rollout.n_windows} windows of {length} the error is beyond"
        f" {OUTLYING:g} times the median, as under contact, a servo limit or another load:"
        f" {join_names(places, 4)}. Without them it is {rollout.regular.text}"
        f" instead of {_format_size(rollout.as_built)}",
        Cure("look at these times; exclude contact from the recording"),
    )


def _format_size(errors: RolloutErrors) -> str:
    return "one that diverges" if errors.diverged else errors.text


def _name_model(name: str) -> str:
    return "by CAD" if name == "cad" else "as built"


def tabulate_joint_errors(model: RobotModel, rollout: Rollout) -> Table:
    """Return the errors of every joint for one horizon."""
    unit = joint_unit(model.joints)
    simulated = {"as built": rollout.as_built, "CAD": rollout.cad}
    compared = simulated | {"command": rollout.no_physics, "repeat": rollout.floor}
    values = {name: errors.rms for name, errors in compared.items() if errors is not None}
    ends = {f"end, {name}": errors.final for name, errors in simulated.items() if errors}
    columns = (
        Column("joint", width=20, of=model.joint_names.__getitem__),
        *(
            Column(name, unit, "decimal", detail=name in ends, of=partial(_show_joint, joints))
            for name, joints in (values | ends).items()
        ),
    )
    title = f"Position error of rollouts of {rollout.horizon:g} s, held out"
    return Table.of(range(model.n_joints), columns, title)


def _show_joint(errors: Array, k: int) -> Cell:
    return format_in_milli(float(errors[k]))


def format_in_milli(value: float | None) -> Cell:
    """Return a length or angle in thousandths of its unit, as a cell."""
    if value is None:
        return None
    if not np.isfinite(value):
        return Shown(None, "diverged")
    return Shown(1e3 * value, round_significant(1e3 * value))
