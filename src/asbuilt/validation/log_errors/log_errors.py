"""Errors of a log that its residual shows: clock, zero positions, gains, and what drifts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from asbuilt.dynamics.base.base_parameters import find_base_parameters
from asbuilt.errors import AsbuiltError, IdentifiabilityError, UsageError
from asbuilt.identification.calibration.mounting import Mounting, find_mounting
from asbuilt.validation.generalisation.effect_evidence import plain_fit
from asbuilt.validation.log_errors.log_error_bounds import NAMED
from asbuilt.validation.log_errors.log_error_search import LogError, LogErrorSearch

if TYPE_CHECKING:
    from asbuilt.experiment.signal.samples import Samples
    from asbuilt.identification.result.result import IdentificationResult

SEARCHED = 20_000
"""Samples that are searched."""
SPAN = 10.0
"""Length [s] of the parts that are searched of longer recordings."""


@dataclass(frozen=True, slots=True)
class Sought:
    """Hold what a search found: `errors`, the largest share first, and what it cannot find.

    Errors of the clock below `clock_unseen` (a share of its rate) would explain less of the
    residual than what is named; infinite where other parameters take the place of any clock.
    `zero_unseen` (n,) [rad or m] and `gain_unseen` (n,), a share, are the same of each joint's zero
    position and gain, to first order; empty if nothing was searched.
    """

    errors: tuple[LogError, ...] = ()
    clock_unseen: float = 0.0
    zero_unseen: tuple[float, ...] = ()
    gain_unseen: tuple[float, ...] = ()


def log_errors(
    result: IdentificationResult,
    training: Sequence[Samples],
    *,
    mounting: Mounting | None = None,
    block_seconds: float | None = None,
) -> tuple[LogError, ...]:
    """Return the errors that `sought_errors` finds."""
    return sought_errors(result, training, mounting=mounting, block_seconds=block_seconds).errors


def sought_errors(
    result: IdentificationResult,
    training: Sequence[Samples],
    *,
    mounting: Mounting | None = None,
    block_seconds: float | None = None,
) -> Sought:
    """Search the residual of a result for errors of the log.

    Columns of all candidates are added to the weighted least squares fit one at a time
    (`BlockEquations.selected`). Their values are then found by Gauss-Newton steps, each about the
    log with the errors so far taken out. A clock that explains most is named alone, for then the
    other columns were those of wrong velocities; one that is off by a factor is looked for at
    some factors, and has to explain more than any other candidate. A base tilt that is chosen
    first is estimated, and errors of the log are sought on the tilted robot: its column is that
    of CAD's masses to first order, and what it leaves resembles wrong gains.

    Parameters
    ----------
    result
        The result; candidates are linearised about its values.
    training
        The samples it was identified from.
    mounting
        The mounting, if it has been estimated; otherwise it is where a tilt is chosen first.
    block_seconds
        Length of the time blocks of standard errors [s].

    Samples that cannot be fitted again show none, nor do fewer time blocks than standard errors
    need.
    """
    if not training:
        return Sought()
    searched = _thinned(training)
    try:
        search = LogErrorSearch(
            result.model, result.base, result.estimates, searched, block_seconds
        )
        if search.tilt_is_first:
            search = _tilted(search, mounting) or search
        return Sought(
            _found(search),
            search.clock_unseen,
            tuple(search.unseen("zero").tolist()),
            tuple(search.unseen("scale").tolist()),
        )
    except (AsbuiltError, np.linalg.LinAlgError):
        return Sought()


def _tilted(search: LogErrorSearch, mounting: Mounting | None) -> LogErrorSearch | None:
    """Return the search on the robot with its base tilt; None if no tilt is significant."""
    model, drive, seconds = search.model, search.base.drive, search.seconds
    if mounting is None:
        try:
            mounting = find_mounting(model, search.training, drive=drive, block_seconds=seconds)
        except (IdentifiabilityError, UsageError):
            return None
    if not mounting.is_tilted:
        return None
    base = find_base_parameters(mounting.model, drive)
    values = plain_fit(mounting.model, base, search.training, seconds).beta
    return LogErrorSearch(mounting.model, base, values, search.training, seconds, tilted=True)


def _found(search: LogErrorSearch) -> tuple[LogError, ...]:
    """Return the errors that a search finds and that matter."""
    pace = search.pace()
    if pace is not None and pace.share > search.largest_share:
        return (pace,)
    found = search.chosen()
    if found and found[0].kind == "clock":
        return (found[0],) if search.matters(found[0]) else ()
    curved = {each.joint for each in found if each.kind == "nonlinear"}
    return tuple(
        each
        for each in found
        if each.kind not in ("clock", "tilt", "drive")
        and each.share >= NAMED
        and not (each.kind == "scale" and each.joint in curved)
        and search.matters(each)
    )


def _thinned(training: Sequence[Samples]) -> list[Samples]:
    """Return parts of all recordings with at most about `SEARCHED` samples together."""
    n_samples = sum(samples.n_samples for samples in training)
    every = -(-n_samples // SEARCHED)
    if every <= 1:
        return list(training)
    return [
        samples.select((samples.t - samples.t[0]) // SPAN % every == 0.0) for samples in training
    ]
