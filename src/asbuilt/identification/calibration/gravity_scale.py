"""Scale of a result's gravity torques in those of CAD: what it says about torque gains."""

from __future__ import annotations

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.regressor import observation_matrix
from asbuilt.identification.information.random_motion import random_positions
from asbuilt.identification.result.result import IdentificationResult


def gravity_scales(result: IdentificationResult) -> Array:
    """Return the scale of each joint's gravity torque in that of CAD, (n,), NaN if it has none.

    The least-squares factor from CAD's torque to that of the result in random static poses within
    the limits. Offsets that share base parameters with masses count to neither.
    """
    n = result.model.n_joints
    scales = np.full(n, np.nan)
    links = np.asarray(result.base.columns) < 10 * result.model.n_links
    design = np.array([parameter.cad for parameter in result.parameters], dtype=np.float64)
    if not has_masses(result.model) or not np.all(np.isfinite(design[links])):
        return scales
    q = random_positions(result.model, np.random.default_rng(0))
    still = np.zeros_like(q)
    rows = observation_matrix(
        result.model, q, still, still, drive=result.base.drive, columns=result.base.columns
    )[:, links]
    cad, built = (
        (rows @ values[links]).reshape(len(q), n) for values in (design, result.estimates)
    )
    size = np.sqrt(np.mean(cad**2, axis=0))
    own = np.sqrt(np.mean(built**2, axis=0))
    product = np.mean(cad * built, axis=0)
    # Gravity torque, relative to the largest, below which a joint says nothing of its scale.
    # 0.8: correlation with CAD's gravity torque below which something other than the scale differs.
    clear = (size > 0.05 * size.max(initial=0.0)) & (product > 0.8 * size * own)
    scales[clear] = product[clear] / size[clear] ** 2
    return scales


def has_masses(model: RobotModel) -> bool:
    """Return whether every link has a mass by design."""
    return all(link.inertia_known and link.inertia.mass > 0.0 for link in model.links)


def doubted_gains(scales: Array) -> Array:
    """Return the part of a gain's error (n,) that CAD does not explain; 0 where scales are unknown.

    `|s - 1|` of the gravity torque beyond the tolerance of CAD.
    """
    away = np.abs(np.nan_to_num(scales, nan=1.0) - 1.0)
    # Error of CAD's gravity torques that is usual: its masses are accurate to a fifth at best.
    return np.maximum(away - 0.2, 0.0)
