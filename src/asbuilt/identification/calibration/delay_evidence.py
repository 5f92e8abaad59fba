"""Whether delays of the torque predict other motions better, groups of blocks held out in turn."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import BaseParameters
from asbuilt.dynamics.kernels.blas import one_blas_thread
from asbuilt.errors import AsbuiltError
from asbuilt.identification.bodies.cad_prior import cad_prior
from asbuilt.identification.estimators.consistent_fit import fit_toward_cad
from asbuilt.identification.estimators.least_squares import fit_least_squares
from asbuilt.identification.information.held_out import different_motions, held_out_errors
from asbuilt.identification.information.square_root_information import (
    SquareRootInformation,
    accumulate_stream,
)
from asbuilt.identification.result.design_values import design_values

if TYPE_CHECKING:
    from asbuilt.experiment.signal.samples import Samples


def predicts_better(
    model: RobotModel,
    base: BaseParameters,
    weights: Array,
    before: Sequence[Samples],
    after: Sequence[Samples],
    *,
    block_seconds: float | None = None,
) -> bool:
    """Return whether shifted torques are predicted better on groups of different motion.

    Links near CAD (or plain least squares, where CAD has no masses) are fitted to the other groups
    and predict each group, with torques as logged and shifted back. False if there are fewer than
    three groups, which say nothing.

    Parameters
    ----------
    model, base
        The robot and base parameters of the fits.
    weights
        Weights of the joints (n,).
    before, after
        Samples with torques as logged, and shifted back.
    block_seconds
        Length of the time blocks [s].
    """
    relief = relief_of_delays(model, base, weights, before, after, block_seconds=block_seconds)
    # Standard errors by which the error on other motions must fall. Own choice, from recordings of
    # four real robots, whole and two thirds of each: in ten sets delays of 18 to 62 ms exceeded 2
    # of their own standard errors. Eight sets fail here; applied, those delays change the error on
    # other recordings by -18 to +51 %, by +16 % on average. The other two, of the fast log of the
    # Med 7, lower it by 1 and 2 %.
    return relief is not None and relief[0] > 2.0 * relief[1]


def relief_of_delays(
    model: RobotModel,
    base: BaseParameters,
    weights: Array,
    before: Sequence[Samples],
    after: Sequence[Samples],
    *,
    block_seconds: float | None = None,
) -> tuple[float, float] | None:
    """Return the log of the fall of the squared error on other motions, and its standard error.

    None if there are fewer than three groups of motion, or no fit to one of them.
    """
    as_logged, shifted = (
        accumulate_stream(model, base, samples, block_seconds=block_seconds)
        for samples in (before, after)
    )
    with one_blas_thread():
        groups = different_motions(shifted, weights)
        # Groups below which held-out errors have no usable standard error.
        if len(groups) < 3 or as_logged.n_blocks != shifted.n_blocks:
            return None
        try:
            errors = [
                held_out_errors(each, lambda part: _fitted(model, part, weights), groups)[0]
                @ weights**2
                for each in (as_logged, shifted)
            ]
        except (AsbuiltError, np.linalg.LinAlgError):
            return None
    tiny = np.finfo(np.float64).tiny
    relief = np.log(np.maximum(errors[0], tiny) / np.maximum(errors[1], tiny))
    return float(relief.mean()), float(relief.std(ddof=1) / np.sqrt(len(relief)))


def _fitted(model: RobotModel, part: SquareRootInformation, weights: Array) -> Array:
    if model.has_every_mass:
        prior = cad_prior(model, part.base.drive)
        # Weight of CAD in the fits, as for a base tilt: ten times the usual design effect.
        return fit_toward_cad(part, prior, weight=100.0, weights=weights).beta
    design = design_values(model, part.base)
    return fit_least_squares(part, weights=weights, prior=design).beta
