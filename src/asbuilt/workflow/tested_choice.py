"""The choice of an estimate, tested by motion that was left out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from asbuilt.arrays import Array
from asbuilt.experiment.signal.samples import Samples
from asbuilt.identification import accumulate_stream
from asbuilt.identification.estimators.held_out_choice import surely_better
from asbuilt.identification.identify import Fit
from asbuilt.identification.result.torque_prediction import set_link_parameters
from asbuilt.identification.statistics import exceeds
from asbuilt.validation.generalisation.coverage import NEAR, measure_repeated_share

FEWEST_BLOCKS = 3
"""Time blocks left out below which differences have no usable standard error."""
WORTH = 0.03
"""Share of the torque error that physically inconsistent values must take away: less is not worth a
robot that no simulator takes."""


def find_better_kind(fit: Fit, training: Sequence[Samples], left_out: Sequence[Samples]) -> str:
    """Return the kind of fit that predicts the motion left out surely better; empty if none does.

    An estimator that chooses among fits of several kinds expects errors on other motion from the
    training motion alone. Of other motion that was left out, the squared torque error of each time
    block, as a share of its recording's squared torque, tests the choice: better is a mean paired
    difference beyond one standard error; of physically inconsistent values, beyond what
    `surely_better` asks, and by `WORTH`. Recordings that repeat the training motion test nothing:
    on the LWR4+ least squares predicts a repetition better than a fit toward CAD, and another
    motion three times worse.

    Parameters
    ----------
    fit
        The fit, which has not seen what was left out.
    training, left_out
        Samples of the fit, and those left out.
    """
    if not fit.estimate.rivals:
        return ""
    other = [each for each in left_out if measure_repeated_share(training, each) <= NEAR.repeated]
    betas = np.array([fit.estimate.beta, *(rival.beta for rival in fit.estimate.rivals)])
    blocks = [_measure_block_errors(fit, samples, betas) for samples in other]
    if sum(map(len, blocks)) < FEWEST_BLOCKS:
        return ""
    own, *others = np.concatenate(blocks).T
    pairs = sorted(zip(others, fit.estimate.rivals, strict=True), key=lambda pair: pair[0].sum())
    for errors, rival in pairs:
        needed = 1.0 if rival.consistent else surely_better(len(own))
        worth = rival.consistent or np.sqrt(errors.sum()) < (1.0 - WORTH) * np.sqrt(own.sum())
        if worth and exceeds(own - errors, needed):
            return rival.kind
    return ""


def _measure_block_errors(fit: Fit, samples: Samples, betas: Array) -> Array:
    """Return the squared error of each time block by each beta, (B, m), in the squared torque."""
    base = fit.base
    model = fit.model
    if base.drive.needs_load:
        model = set_link_parameters(model, base, fit.estimate.beta)
    seen = accumulate_stream(model, base, [samples])
    # A recording without torque has no error to share.
    torque = max(float(seen.torque_energy.sum()), np.finfo(np.float64).tiny)
    parts = (seen.select([block]) for block in range(seen.n_blocks))
    errors = [[part.residual_energy(beta).sum() for beta in betas] for part in parts]
    return np.array(errors) / torque
