"""Prior of drive parameters: a drive has at most the torque of its joint at the robot's speed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from asbuilt.arrays import Array
from asbuilt.dynamics.base.base_parameters import BaseParameters
from asbuilt.identification.bodies.cad_prior import CadPrior
from asbuilt.identification.information.square_root_information import SquareRootInformation
from asbuilt.identification.information.triangular import triangular_factor

USUAL_DESIGN_EFFECT = 10.0
"""Samples per independent sample: the median of 14 recordings of four robots."""


def with_drive_scale(prior: CadPrior, information: SquareRootInformation) -> CadPrior:
    """Return a prior whose drive parameters are normal about CAD or zero, at a scale of their own.

    The standard deviation of a parameter of joint k is `tau_k / c`: tau_k the RMS torque of the
    joint, c the RMS of the parameter's column at all joints that have one. With it the drive takes
    the whole torque of its joint in motion as fast as the robot's. Friction and armature are less,
    so a parameter that the data determine keeps its value; one of a joint that hardly moves, whose
    own column is small, stays next to zero. A larger CAD value is the scale itself; joints without
    torque take the scale of the largest torque. Like CAD's, the weight is for independent samples.
    """
    links, n = 10 * prior.n_links, information.n_joints
    torque = np.sqrt(information.torque_energy / information.n_samples)
    torque = np.where(torque > 0.0, torque, torque.max())
    energy = _sum_column_energy(information, links).reshape(n, -1)
    present = np.maximum(np.count_nonzero(energy, axis=0), 1)
    typical = np.sqrt(energy.sum(axis=0) / present / information.n_samples)
    whole = np.divide(torque[:, None], typical, out=np.zeros_like(energy), where=typical > 0.0)
    scale = np.maximum(whole.reshape(-1), np.abs(prior.parameters[links:]))
    return replace(
        prior,
        drive_scale=np.where(scale > 0.0, scale, prior.drive_scale),
        drive_weight=USUAL_DESIGN_EFFECT,
    )


def with_drive_rows(factor: Array, base: BaseParameters, prior: CadPrior) -> Array:
    """Return the factor (p + 1, p + 1) of weighted rows and of the prior of drive parameters.

    The prior covers the base parameters that belong to one drive alone.
    """
    first, p = 10 * prior.n_links, base.n_base
    own = np.flatnonzero(base.columns >= first)
    drives = base.columns[own] - first
    weight = np.sqrt(prior.drive_weight) / prior.drive_scale[drives]
    rows = np.zeros((len(own), p + 1))
    rows[range(len(own)), own] = weight
    rows[:, p] = weight * prior.parameters[base.columns[own]]
    return triangular_factor(np.vstack([factor, rows]))


def _sum_column_energy(information: SquareRootInformation, first: int) -> Array:
    """Return the energy of the column of each standard parameter from `first` on, all joints."""
    K = information.base.regrouping[:, first:]
    energy = np.zeros(K.shape[1])
    for support, factor in zip(information.support, information.joint_factors, strict=True):
        energy += np.sum((factor[:, :-1] @ K[support]) ** 2, axis=0)
    return energy
