"""Identification as a whole: prepare, identify, validate, compare with CAD."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from asbuilt.description import RobotModel
from asbuilt.dynamics.drives.drive_set import DriveSet
from asbuilt.dynamics.drives.torque import choose_usual_drive
from asbuilt.errors import UsageError
from asbuilt.executor import Workers
from asbuilt.experiment import ReadingOptions, Recording, Samples, SignalChain, head_of
from asbuilt.experiment.logs.recordings import Recorded, RecordingLike, read_fitted_recordings
from asbuilt.experiment.signal.preparation import MotionFilters
from asbuilt.experiment.virtual.physics import import_mujoco
from asbuilt.findings import Cure, rank_findings
from asbuilt.registry import divide_settings
from asbuilt.validation import rollout_findings
from asbuilt.validation.verdicts.model_errors import choose_decisive_rollout
from asbuilt.validation.verdicts.reasons import OF_TORQUE
from asbuilt.workflow.cutoff_sweep import CutoffSweep, sweep_cutoffs
from asbuilt.workflow.fits import fit_study
from asbuilt.workflow.prepare import (
    Prepared,
    Progress,
    prepare,
    report_holdout,
    settle_rule,
    with_settled_holdout,
)
from asbuilt.workflow.study_options import BLOCKS, StudyOptions
from asbuilt.workflow.study_result import Study, conclude_study
from asbuilt.workflow.torque_source import TorqueOrigin

if TYPE_CHECKING:
    from asbuilt.workflow.rollout import Simulated


def identify(
    robot: RobotModel | str | Path,
    recordings: RecordingLike | Sequence[RecordingLike],
    *further: Any,
    validation: RecordingLike | Sequence[RecordingLike] = (),
    options: StudyOptions | None = None,
    workers: Workers | None = None,
    progress: Progress | None = None,
    **settings: Any,
) -> Study:
    """Identify a robot from recordings and validate the result.

    Parameters
    ----------
    robot
        A robot, the name of a bundled one, or the path of a description.
    recordings
        One recording or several: paths, data frames, dictionaries of arrays, `Recording`,
        `RecordingStream`, or `Samples` already prepared.
    validation
        Recordings to validate on, in addition to what `options.holdout` holds out.
    options
        How to identify; None: the defaults.
    workers
        Workers of `open_workers` that simulate rollouts, to the same bits; None: this process.
    progress
        Called with the name of a step and the fraction done.
    **settings
        Single fields of `StudyOptions` and `ReadingOptions` that replace fields of `options`, such
        as `method="wls", rate=1000`; texts as on the command line.

    Returns
    -------
    Study
        The result, its predictions and findings.

    Raises
    ------
    RecordingError
        If a check finds an error in a recording, or filters leave nothing of it.
    IdentifiabilityError
        If the recordings are too short.
    UsageError
        If no recording is given, or something after the recordings by its place; if there is no
        such option, or its value is wrong.

    Examples
    --------
    >>> from asbuilt import load_robot, simulate_recording, identify
    >>> from asbuilt.excitation.motions.fourier import random_fourier
    >>> model = load_robot("two-link")
    >>> motion = random_fourier(model, rng=1, duration=10.0)
    >>> log = simulate_recording(model, motion, rng=1)
    >>> study = identify(model, log, holdout="last:0.3", method="wls")
    >>> study.result.rank == study.result.n_base
    True
    """
    if further:
        raise UsageError(
            "identify takes a robot and its recordings; everything else goes by name, and a"
            f" {type(further[0]).__name__} came third",
            cure=Cure(
                "several recordings are one list, identify(robot, [first, second]); one to"
                " validate on is validation=..., arrays are {'t': t, 'q': q, 'tau': tau}"
            ),
        )
    # Settings by name go to the options that have them.
    of_study, of_reading = divide_settings(settings, StudyOptions, ReadingOptions)
    wanted = replace(options or StudyOptions(), **of_study)
    reading = ReadingOptions(**of_reading)
    report = progress or (lambda what, fraction: None)
    robot = reading.base.load_robot(robot)
    if wanted.refine:
        robot.require_no_reactions()
    if wanted.rollout:
        # A missing simulator is said before hours of work.
        import_mujoco("a rollout")
    model, (trained, others) = read_fitted_recordings(robot, (recordings, validation), reading)
    model = wanted.with_prior(model)
    # Samples of no recording have nothing to be held out of.
    options = with_settled_holdout(wanted, trained, others) if trained else wanted
    filters = MotionFilters()
    trained, others, source, options = settle_torque(model, trained, others, options, filters)
    # Nothing is left to simulate that the model has not seen.
    if options.rollout and options.holdout is None and not others:
        raise _make_all_fitted_error()
    prepared, cutoffs = _prepare_recordings(
        model, trained, others, options, source, filters, report
    )
    report("identify", 0.0)
    parts = None
    horizons = options.rollout
    # Simulated motion can decide a verdict only where the simulator is installed.
    if not horizons and find_spec("mujoco") is not None:
        horizons = source.decisive_horizons
    if options.refine or horizons:
        from asbuilt.workflow.rollout import select_simulated_parts  # noqa: PLC0415 - light start

        parts = select_simulated_parts(trained, others, prepared.chain, prepared.holdout, filters)
    # Motions are kept for the preparation alone: they are the largest part of the memory.
    del filters
    fits = fit_study(model, prepared, options, source, parts, report)
    prepared = fits.prepared
    report("predict", 0.0)
    held_out_findings = report_holdout(
        wanted, prepared, trained, bool(others) or bool(prepared.held_out)
    )
    study = conclude_study(fits, options, cutoffs, held_out_findings)
    report("compare", 1.0)
    if parts is None or not horizons or not (options.rollout or parts.held_out):
        return study
    report("roll out", 0.0)
    return _roll_out(study, parts.held_out, horizons, workers)


def settle_torque(
    model: RobotModel,
    recordings: Sequence[Recorded],
    validation: Sequence[Recorded],
    options: StudyOptions,
    filters: MotionFilters | None = None,
) -> tuple[list[Recorded], list[Recorded], TorqueOrigin, StudyOptions]:
    """Return recordings with their torque, where it comes from, and the options.

    Nothing changes unless some torque is to follow from a command. `filters` filter motions, if
    some serve others too. Raises `UsageError` where recordings have torques of different kinds.
    """
    if not any(map(_has_drive_law, (*recordings, *validation))):
        return [*recordings], [*validation], TorqueOrigin(), options
    from asbuilt.workflow.servo import settle_servo  # noqa: PLC0415 - light start

    return settle_servo(model, recordings, validation, options, filters)


def _has_drive_law(item: Recorded) -> bool:
    return not isinstance(item, Samples) and head_of(item).drive_law is not None


def _prepare_recordings(
    model: RobotModel,
    trained: Sequence[Recorded],
    others: Sequence[Recorded],
    options: StudyOptions,
    source: TorqueOrigin,
    filters: MotionFilters,
    report: Progress,
) -> tuple[Prepared, CutoffSweep | None]:
    """Prepare recordings, and sweep cutoffs if that is asked for."""
    sweeps: list[CutoffSweep] = []

    def settle(chain: SignalChain, heads: Sequence[Recording]) -> SignalChain:
        sweeps.append(_sweep_cutoff(model, heads, chain, options, report))
        # The parallel cutoff was that of another one.
        return replace(chain, cutoff=sweeps[0].chosen, parallel_cutoff=None)

    prepared = prepare(
        model,
        trained,
        validation=others,
        chain=options.chain,
        holdout=options.holdout,
        checked=options.checked,
        tolerated=(),
        settle=settle if options.sweep_cutoff else None,
        # What a law made of commands has a delay of its own.
        estimate_delay=source.is_measured,
        filters=filters,
        # Simulated windows are cut from a part of each recording.
        in_turn=source.is_measured and not options.rollout,
        progress=report,
    )
    return source.settle_samples(prepared, trained), sweeps[0] if sweeps else None


def _make_all_fitted_error() -> UsageError:
    return UsageError(
        "a rollout needs a recording, or a part of one, that the model is not fitted to",
        cure=Cure("hold out a part, or give another recording", settings={"holdout": BLOCKS}),
    )


def _roll_out(
    study: Study,
    held: Sequence[Simulated],
    horizons: Sequence[float],
    workers: Workers | None,
) -> Study:
    """Simulate what was held out by the fit that has not seen it."""
    from asbuilt.workflow.rollout import simulate_rollouts  # noqa: PLC0415 - light start

    if not held:
        raise _make_all_fitted_error()
    # Values that have not seen what is simulated.
    result = study.result.of_training
    rollouts = simulate_rollouts([result] * len(held), held, horizons, workers=workers)
    known = study.findings
    if result.decided_by_motion and choose_decisive_rollout(rollouts) is not None:
        # Simulated motion decides: what torques say of its use is information.
        known = tuple(
            replace(finding, severity="info") if finding.code in OF_TORQUE else finding
            for finding in known
        )
    findings = rank_findings((*known, *rollout_findings(rollouts)))
    return replace(study, rollouts=rollouts, findings=findings)


def _sweep_cutoff(
    model: RobotModel,
    recordings: Sequence[Recording],
    chain: SignalChain,
    options: StudyOptions,
    report: Progress,
) -> CutoffSweep:
    if not recordings:
        raise UsageError(
            "a cutoff can be chosen for recordings only; these samples are filtered already"
        )
    return sweep_cutoffs(
        model,
        recordings,
        drive=(
            options.drive
            if isinstance(options.drive, DriveSet)
            else choose_usual_drive(model, recordings[0].torque_source)
        ),
        method=options.method,
        chain=chain,
        holdout=settle_rule(recordings, options.holdout),
        progress=report,
    )
