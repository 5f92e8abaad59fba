"""Rollouts of a study: which windows, which robots, driven by what.

Study-level: the numerics are in `identification/trajectories` and `validation/rollout`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from asbuilt.description import RobotModel, load_robot
from asbuilt.executor import Workers
from asbuilt.experiment import Recording, Samples, SignalChain, head_of, hold_out, resolve_chain
from asbuilt.experiment.logs.recordings import (
    Recorded,
    RecordingLike,
    as_recordings,
    read_fitted_recordings,
)
from asbuilt.experiment.signal.preparation import MotionFilters
from asbuilt.identification.result.result import IdentificationResult
from asbuilt.identification.trajectories.simulated_robot import (
    DriveSignal,
    build_robot_as_built,
    build_robot_as_described,
    choose_driving_signal,
    choose_law,
)
from asbuilt.identification.trajectories.windows import cut_windows
from asbuilt.validation.rollout.rollout import Rollout, roll_out
from asbuilt.workflow.prepare import find_unseeing
from asbuilt.workflow.study_options import ValidationOptions
from asbuilt.workflow.torque_source import drive_as_built, drive_as_described

Simulated = tuple[Recording, Samples, DriveSignal]
"""A recording, the part of its motion that is simulated, and what drives it."""


def roll_out_result(
    result: IdentificationResult,
    recordings: RecordingLike | Sequence[RecordingLike],
    horizons: Sequence[float],
    *,
    options: ValidationOptions | None = None,
    workers: Workers | None = None,
) -> tuple[Rollout, ...]:
    """Simulate recordings from the measured state with an identified model, and with CAD.

    Of a recording that the result was identified from, only what was held out is simulated, if
    anything was. MuJoCo simulates windows one after another, under the logged command if the
    recording states how drives follow it, or else under the logged torque.

    Parameters
    ----------
    result
        The identified robot.
    recordings
        One recording or several, as for `identify`.
    horizons
        Lengths of the windows [s].
    options
        How to prepare the recordings; None: the defaults.
    workers
        Workers of `open_workers` that simulate, to the same bits; None: this process.

    Returns
    -------
    tuple of Rollout
        The errors for each horizon.

    Raises
    ------
    RecordingError
        If no window fits into a recording, or nothing drives its simulation.
    MissingExtraError
        If MuJoCo is not installed.
    """
    options = options or ValidationOptions()
    cad = options.cad
    chain = options.chain or result.chain
    cad = None if cad is None else load_robot(cad)
    results = []
    parts = []
    for item in as_recordings(result.model, recordings):
        # What was held out of this recording is simulated by values that have not seen it.
        # With a chain of its own the division of the study does not apply.
        fitted, holdout = (result, None) if options.chain else find_unseeing(result, item)
        parts.append(_prepare_part(drive_as_built(result, item), chain, holdout, MotionFilters()))
        results.append(fitted)
    return simulate_rollouts(results, parts, horizons, cad=cad, workers=workers)


def roll_out_robot(
    robot: RobotModel | str | Path,
    recordings: RecordingLike | Sequence[RecordingLike],
    horizons: Sequence[float],
    *,
    options: ValidationOptions | None = None,
    workers: Workers | None = None,
) -> tuple[Rollout, ...]:
    """Simulate recordings with a robot as described, drives included.

    Parameters and errors as for `roll_out_result`; there is no robot as built.
    """
    options = options or ValidationOptions()
    model, (logged,) = read_fitted_recordings(load_robot(robot), (recordings,))
    parts = [
        _prepare_part(drive_as_described(model, item), options.chain, None, MotionFilters())
        for item in logged
    ]
    described = [
        build_robot_as_described(model, choose_law(recording, None)).driven_by(signal)
        for recording, _, signal in parts
    ]
    return tuple(
        roll_out(
            model,
            [cut_windows(one, samples, horizon, signal, model) for one, samples, signal in parts],
            described,
            [None] * len(parts),
            workers=workers,
        )
        for horizon in horizons
    )


def simulate_rollouts(
    results: Sequence[IdentificationResult],
    parts: Sequence[Simulated],
    horizons: Sequence[float],
    *,
    cad: RobotModel | None = None,
    workers: Workers | None = None,
) -> tuple[Rollout, ...]:
    """Return the rollouts of parts of recordings, each by its own result and by CAD."""
    if not parts:
        return ()
    by_cad = []
    built = []
    for result, (recording, _, signal) in zip(results, parts, strict=True):
        law = choose_law(recording, result)
        described = build_robot_as_described(cad or result.model, law)
        by_cad.append(described.driven_by(signal))
        built.append(build_robot_as_built(result, law).driven_by(signal))
    return tuple(
        roll_out(
            results[0].model,
            [
                cut_windows(one, samples, horizon, signal, results[0].model)
                for one, samples, signal in parts
            ],
            by_cad,
            built,
            workers=workers,
        )
        for horizon in horizons
    )


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedParts:
    """Hold what a study may be fitted to by simulations, and what may validate them."""

    trained: tuple[Simulated, ...] = ()
    held_out: tuple[Simulated, ...] = ()


def select_simulated_parts(
    recordings: Sequence[Recorded],
    validation: Sequence[Recorded],
    chain: SignalChain | None,
    holdout: str | None,
    filters: MotionFilters,
) -> SimulatedParts:
    """Return what a study may simulate: all but what is held out, and that and other recordings."""
    # What is held out is simulated by parts, other recordings whole.
    held = () if holdout is None else recordings
    return SimulatedParts(
        tuple(_prepare_part(item, chain, holdout, filters, train=True) for item in recordings),
        (
            *(_prepare_part(item, chain, holdout, filters) for item in held),
            *(_prepare_part(item, chain, None, filters) for item in validation),
        ),
    )


def _prepare_part(
    item: Recorded,
    chain: SignalChain | None,
    holdout: str | None,
    filters: MotionFilters,
    *,
    train: bool = False,
) -> Simulated:
    """Return a recording, a part of its motion with rests by the rule, and its signal."""
    if isinstance(item, Samples):
        samples = item
        recording = Recording(
            t=item.t,
            # Without the filter's torque: simulations are driven by what was logged.
            q=item.q,
            tau=item.tau_raw,
            joint_names=item.joint_names,
            source=item.source,
            torque_source=item.torque_source,
        )
    else:
        recording = head_of(item)
        settled = resolve_chain(chain or SignalChain(), recording, filters=filters)
        # Rests are part of a motion, and windows need every sample.
        whole = replace(settled, rests=True, parallel=False, decimate=None)
        samples = filters.prepare(recording, whole).samples(whole.delay)
    signal = choose_driving_signal(recording)
    if holdout is not None:
        samples = hold_out(samples, holdout)[0 if train else 1]
    return recording, samples, signal
