"""Whether a base tilt predicts other motions better, by groups of time blocks held out in turn."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from asbuilt.dynamics.base.base_parameters import find_base_parameters
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.dynamics.kernels.blas import one_blas_thread
from asbuilt.errors import IdentifiabilityError
from asbuilt.identification.bodies.cad_prior import cad_prior
from asbuilt.identification.calibration.mounting import Mounting
from asbuilt.identification.estimators.consistent_fit import fit_consistent, fit_toward_cad
from asbuilt.identification.information.held_out import different_motions, held_out_errors
from asbuilt.identification.information.square_root_information import accumulate_stream

if TYPE_CHECKING:
    from asbuilt.experiment.signal.samples import Samples

WEIGHT = 100.0
"""Weight of CAD in the fits, ten times the usual design effect: without CAD, links that the other
groups do not determine decide how well a group is predicted."""
FEWEST_GROUPS = 3
"""Groups below which held-out errors have no usable standard error."""


def relief_on_other_motions(
    mounting: Mounting,
    samples: Sequence[Samples],
    *,
    drive: DriveSet,
    block_seconds: float | None = None,
) -> tuple[float, float] | None:
    """Return the log of the fall of the squared torque error by the tilt, and its standard error.

    On groups of different motion that are held out in turn: links near CAD are fitted to the other
    groups with gravity as described and as estimated, and predict the group. None if there
    are fewer than three groups, or a fit does not converge, as to torques without any noise.
    """
    drive = DriveSet(tuple(term for term in drive.terms if not term.needs_load))
    tilted = mounting.as_given.with_gravity(mounting.gravity)
    base = find_base_parameters(tilted, drive)
    prior = cad_prior(mounting.as_given, drive)
    straight, turned = (
        accumulate_stream(model, base, samples, block_seconds=block_seconds)
        for model in (mounting.as_given, tilted)
    )
    with one_blas_thread():
        weights = fit_consistent(turned, prior).weights
        groups = different_motions(turned, weights)
        if len(groups) < FEWEST_GROUPS:
            return None
        try:
            before, after = (
                held_out_errors(
                    information,
                    lambda part: fit_toward_cad(part, prior, weight=WEIGHT, weights=weights).beta,
                    groups,
                )[0]
                @ weights**2
                for information in (straight, turned)
            )
        except IdentifiabilityError:
            return None
    tiny = np.finfo(np.float64).tiny
    relief = np.log(np.maximum(before, tiny) / np.maximum(after, tiny))
    return float(relief.mean()), float(relief.std(ddof=1) / np.sqrt(len(relief)))
