"""Choice of the low-pass cutoff by held-out torque, unfiltered, at several cutoffs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from asbuilt.arrays import Array
from asbuilt.codec import make_plain
from asbuilt.description.model import RobotModel
from asbuilt.dynamics import DriveSet, find_base_parameters
from asbuilt.errors import AsbuiltError, RecordingError
from asbuilt.experiment import Recording, SignalChain, resolve_chain
from asbuilt.experiment.signal.samples import parse_rule
from asbuilt.identification.identify import identify_samples
from asbuilt.tables import MISSING, Column, Table, round_significant
from asbuilt.validation.prediction import validate_samples
from asbuilt.validation.residuals import measure_whiteness
from asbuilt.workflow.prepare import divide_recordings

MULTIPLES = (0.2, 0.3, 0.45, 0.65, 1.0, 1.5, 2.2, 3.2, 4.8, 7.0)
"""Cutoffs that are tried, in multiples of the one that the chain would choose."""


# Hold which cutoffs are tried, and which of them is taken.

SWEEP_HIGHEST_SHARE = 0.2  # No cutoff above this share of the sampling rate,
SWEEP_APART = 1.2  # Nor one between that and a fraction of it so small that the two would be one
SWEEP_SHORT = 15.0  # Length [s] below which a recording is short: it has no third block of 5 s
SWEEP_FEWEST = 10  # Held-out samples below which a cutoff is not tried
# Held-out error, in multiples of the smallest, that counts as equally good. Of these the lowest
# cutoff is taken.
SWEEP_AS_GOOD = 1.02


HOLDOUT = "blocks:5s:3"
SHORT_HOLDOUT = "blocks:2s:3"
"""What is held out to choose by where the user holds nothing out, and of short recordings.

A low-pass at 3 Hz takes a second of every block: the error of a 2 s block counts only the rest.
"""


@dataclass(frozen=True, slots=True, eq=False)
class CutoffTrial:
    """Hold one cutoff [Hz] and its held-out errors.

    `rms_recorded` and `rms` (n,) are against the torque as recorded and in the band of the filter;
    `score` and `in_band` are the same, joints together, relative to the best trial.
    `durbin_watson`, the mean over joints, is 2 for a residual white up to the cutoff, NaN if all
    segments are shorter than half its period; `effective_share` is the number of independent
    samples, as a fraction of the 2 cutoff a second of a white residual.
    """

    cutoff: float
    rms_recorded: Array
    rms: Array
    durbin_watson: float
    effective_share: float
    score: float = 1.0
    in_band: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class CutoffSweep:
    """Hold the trials in rising order, the cutoff chosen [Hz], why, and the hold-out rule."""

    joint_names: tuple[str, ...]
    trials: tuple[CutoffTrial, ...]
    chosen: float
    why: str
    holdout: str = HOLDOUT

    def table(self) -> Table:
        """Return the trials as a table."""
        rows = tuple(
            (
                round_significant(trial.cutoff),
                "<- chosen" if trial.cutoff == self.chosen else "",
                f"{trial.score:.3f}",
                f"{trial.in_band:.3f}",
                *(round_significant(float(x)) for x in trial.rms_recorded),
                f"{trial.durbin_watson:.2f}" if np.isfinite(trial.durbin_watson) else MISSING,
                f"{100 * trial.effective_share:.0f}",
            )
            for trial in self.trials
        )
        columns = (
            Column("cutoff", "Hz", "decimal"),
            Column(""),
            Column("held out", "relative", "decimal"),
            Column("in band", "relative", "decimal"),
            *(Column(name, align="decimal", width=14) for name in self.joint_names),
            Column("Durbin-Watson", align="decimal"),
            Column("white", "%", "decimal"),
        )
        notes = (
            (
                "Errors are RMS of torque as recorded, which filtering cannot make smaller, on"
                f" {self.holdout} of the recordings identified from, held out; 'held out' is their"
                " joint mean relative to the best."
            ),
            (
                "'in band' is the same against the filtered torque, of which a lower cutoff leaves"
                " less whatever the model is worth; it chooses nothing."
            ),
            (
                "Durbin-Watson, at half periods of the cutoff, is 2 for a residual white up to the"
                " cutoff, near 0 for a slow one; white: how many independent samples it is worth,"
                " of those that a white one would be."
            ),
            self.why,
        )
        return Table(columns, rows, title="Cutoff of the low-pass", notes=notes)

    def as_document(self) -> dict[str, Any]:
        """Return the sweep as numbers."""
        return {
            "chosen": self.chosen,
            "why": self.why,
            "holdout": self.holdout,
            "trials": make_plain(self.trials),
        }


def sweep_cutoffs(
    model: RobotModel,
    recordings: Sequence[Recording],
    *,
    drive: DriveSet,
    method: str = "auto",
    chain: SignalChain | None = None,
    holdout: str | None = None,
    cutoffs: Sequence[float] | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> CutoffSweep:
    """Choose the lowest cutoff whose held-out error is within 2 % of the smallest.

    Each cutoff is tried with the estimator that will be used: what a plain fit makes of directions
    that the motion hardly excites changes at random from cutoff to cutoff. The error is against the
    torque as recorded, since the error in the band of the filter falls with the cutoff whatever the
    model.

    Parameters
    ----------
    model
        The robot.
    recordings
        Recordings to identify from.
    drive
        Drive terms.
    method
        The estimator, a key of `methods`.
    chain
        The signal chain; its cutoff is replaced.
    holdout
        Rule of what is held out; None: "blocks:5s:3", of recordings below 15 s "blocks:2s:3".
    cutoffs
        Cutoffs to try [Hz]; None: ten around the one that the chain would choose.
    progress
        Called with the name of a step and the fraction done.

    Raises
    ------
    RecordingError
        If no cutoff leaves enough samples.
    UsageError
        If the rule cannot be read.
    """
    start = resolve_chain(chain or SignalChain(), *recordings)
    assert start.cutoff is not None
    rates = [recording.rate for recording in recordings]
    tried = sorted(
        map(float, cutoffs or _list_cutoffs(start.cutoff, SWEEP_HIGHEST_SHARE * min(rates)))
    )
    short = min(recording.duration for recording in recordings) < SWEEP_SHORT
    rule = holdout or (SHORT_HOLDOUT if short else HOLDOUT)
    parse_rule(rule)
    base = find_base_parameters(model, drive)
    found: list[CutoffTrial] = []
    last: AsbuiltError | None = None
    for k, cutoff in enumerate(tried):
        if progress is not None:
            progress("cutoff", k / len(tried))
        # A default parallel cutoff is half of this one.
        at = replace(start, cutoff=cutoff, parallel_cutoff=None)
        try:
            training, held_out = divide_recordings(recordings, at, rule)
            result = identify_samples(model, training, base=base, method=method)
            validations = [validate_samples(result, held) for held in held_out]
            if min(item.t.size for item in validations) < SWEEP_FEWEST:
                # Too low a cutoff leaves nothing of short blocks: it is passed over.
                raise RecordingError("the low-pass leaves too few samples to validate")
        except AsbuiltError as problem:
            last = problem
            continue
        recorded, band = (
            np.sqrt(
                np.mean([getattr(item.metrics_as_built, name) ** 2 for item in validations], axis=0)
            )
            for name in ("rms_recorded", "rms")
        )
        whiteness, share = np.mean(
            [measure_whiteness(errors.t, errors.error, cutoff) for errors in validations],
            axis=(0, 2),
        )
        found.append(CutoffTrial(cutoff, recorded, band, float(whiteness), float(share)))
    if not found:
        raise RecordingError(
            "no cutoff leaves enough samples to train and to validate; record longer (at"
            f" {tried[-1]:.3g} Hz: {last})"
        )
    # The best of each joint, at whatever cutoff.
    best = np.min([trial.rms_recorded for trial in found], axis=0)
    # Each joint relative to its best cutoff: joints of large torques do not decide alone.
    scores, bands = (
        np.array([np.sqrt(np.mean((rms / best) ** 2)) for rms in errors])
        for errors in ([trial.rms_recorded for trial in found], [trial.rms for trial in found])
    )
    trials = tuple(
        replace(trial, score=float(score / scores.min()), in_band=float(band / scores.min()))
        for trial, score, band in zip(found, scores, bands, strict=True)
    )
    # The lowest: it leaves the least noise in the regressor.
    chosen = next(trial for trial in trials if trial.score <= SWEEP_AS_GOOD)
    worst = max(trials, key=lambda trial: trial.score)
    why = (
        f"{round_significant(chosen.cutoff)} Hz is the lowest cutoff whose held-out error is within"
        f" {100 * (SWEEP_AS_GOOD - 1):.0f} % of the smallest; {round_significant(worst.cutoff)}"
        " Hz would"
        f" cost {100 * (worst.score - 1):.0f} % more."
    )
    # At the edge of what was tried the choice may lie beyond.
    if chosen in (trials[0], trials[-1]) and len(trials) > 1:
        why += f" None {'lower' if chosen is trials[0] else 'higher'} was tried."
    return CutoffSweep(model.joint_names, trials, chosen.cutoff, why, rule)


def _list_cutoffs(usual: float, highest: float) -> list[float]:
    below = [
        multiple * usual for multiple in MULTIPLES if multiple * usual * SWEEP_APART <= highest
    ]
    # The last at the highest cutoff that the rate allows.
    return [*below, min(MULTIPLES[-1] * usual, highest)] if len(below) < len(MULTIPLES) else below
