"""Bias by effects that a model lacks, from a fit with them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.rotation import axes_across
from asbuilt.dynamics.base.base_parameters import find_base_parameters
from asbuilt.dynamics.drives.selection import available_terms
from asbuilt.errors import AsbuiltError
from asbuilt.identification.errors.omitted_bias import (
    OmittedBias,
    follow_effects,
    moved_estimate,
    shrunken,
)
from asbuilt.identification.errors.uncertainty import block_uncertainty
from asbuilt.identification.estimators.least_squares import fit_least_squares
from asbuilt.identification.identify import Fit
from asbuilt.identification.information.estimate import Estimate
from asbuilt.identification.information.square_root_information import (
    SquareRootInformation,
    accumulate_stream,
)
from asbuilt.identification.result.design_values import design_values
from asbuilt.validation.generalisation.effect_evidence import fitted_tilt, with_term
from asbuilt.validation.generalisation.missing_effects import MissingEffect, effects_text

if TYPE_CHECKING:
    from asbuilt.experiment.signal.samples import Samples


def with_effects(
    fit: Fit,
    training: Sequence[Samples],
    effects: Sequence[MissingEffect],
    *,
    block_seconds: float | None = None,
) -> Fit:
    """Return a fit whose errors include the bias by effects that the model lacks.

    The samples are fitted again with the effects, drive terms as parameters and a base tilt as
    further columns. The difference of both fits is the bias; its covariance is that of the effects
    from time blocks. A drive term that one joint shows is fitted at all, where it usually has a
    like share of the torque. Textbook errors stay, and so do errors where no fit has the effects.
    """
    if not effects or fit.uncertainty.basis.asked == "textbook":
        return fit
    try:
        bias, spread = _bias(fit, training, effects, block_seconds)
        moved = moved_estimate(fit.information, fit.estimate)
    except (AsbuiltError, np.linalg.LinAlgError):
        return fit
    own = moved @ bias
    covariance = np.outer(own, own) + moved @ spread @ moved.T
    omitted = OmittedBias(
        bias=own,
        covariance=0.5 * (covariance + covariance.T),
        free_bias=bias,
        free_covariance=np.outer(bias, bias) + spread,
        effects=effects_text(effects),
    )
    return replace(fit, omitted=omitted)


def _bias(
    fit: Fit,
    training: Sequence[Samples],
    effects: Sequence[MissingEffect],
    block_seconds: float | None,
) -> tuple[Array, Array]:
    """Return the bias (p,) of weighted least squares and its covariance (p, p)."""
    drive = fit.base.drive
    for key in dict.fromkeys(each.effect for each in effects if each.joint is not None):
        drive = with_term(drive, key, range(len(fit.model.joint_names)))
    base = find_base_parameters(fit.model, drive)
    information = accumulate_stream(fit.model, base, training, block_seconds=block_seconds)
    estimate = fit_least_squares(
        information, weights=fit.estimate.weights, prior=design_values(fit.model, base)
    )
    place = {name: j for j, name in enumerate(base.names)}
    own = [place[name] for name in fit.base.names if name in place]
    kept = np.flatnonzero([name in place for name in fit.base.names])
    bias, V = np.zeros(fit.base.n_base), np.zeros((fit.base.n_base,) * 2)
    further = [j for name, j in place.items() if name not in fit.base.names]
    if further:
        order = own + further
        follows = follow_effects(estimate.covariance[np.ix_(order, order)], len(own))
        errors = block_uncertainty(information, estimate).covariance[np.ix_(further, further)]
        size = _usual_sizes(information, estimate, effects, further)
        mean, spread = shrunken(estimate.beta[further], errors, size)
        bias[kept] = follows @ mean
        V[np.ix_(kept, kept)] = follows @ spread @ follows.T
    if any(each.joint is None for each in effects):
        axes = axes_across(fit.model.gravity)
        tilt = fitted_tilt(fit.model, base, estimate, training, axes, block_seconds)
        follows = tilt.follows[own]
        bias[kept] -= follows @ tilt.increments
        V[np.ix_(kept, kept)] += follows @ tilt.covariance @ follows.T
    return bias, V


def _usual_sizes(
    information: SquareRootInformation,
    estimate: Estimate,
    effects: Sequence[MissingEffect],
    further: Sequence[int],
) -> Array:
    """Return the usual size (m,) of the parameters of drive terms, from the joints that show them.

    A term has like shares of the torque at all joints: the mean square of its share at the joints
    that show it, times the torque of each joint, over the length of its column.
    """
    names, joints = information.base.names, information.joint_names
    torque = np.sqrt(information.torque_energy) * estimate.weights
    length = np.linalg.norm(information.stacked(estimate.weights)[:, :-1], axis=0)
    sizes = np.zeros(len(further))
    for key in dict.fromkeys(each.effect for each in effects if each.joint is not None):
        shown = {each.joint for each in effects if each.effect == key}
        places = {
            i: k
            for k in range(len(joints))
            for symbol in available_terms()[key].symbols
            for i, j in enumerate(further)
            if names[j] == f"{symbol}{k + 1}" and length[j] > 0.0
        }
        shares = [
            float(estimate.beta[further[i]] * length[further[i]] / torque[k])
            for i, k in places.items()
            if joints[k] in shown
        ]
        for i, k in places.items():
            sizes[i] = np.sqrt(np.mean(np.square(shares))) * torque[k] / length[further[i]]
    return sizes
