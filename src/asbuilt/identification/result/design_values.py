"""Base parameters by design."""

from __future__ import annotations

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import BaseParameters
from asbuilt.dynamics.parameters import parameter_values


def design_values(model: RobotModel, base: BaseParameters) -> Array:
    """Return the base parameters by design, shape (p,), NaN where the description has no value.

    A drive value that the description lacks, or states for a simulator's sake, adds nothing to
    sums with links and is NaN by itself.
    """
    chi, links = parameter_values(model, base.drive), 10 * model.n_links
    for i, link in enumerate(model.links):
        if not link.inertia_known:
            chi[10 * i : 10 * i + 10] = np.nan
    silent = np.zeros(len(chi), dtype=bool)
    silent[links:] = np.isnan(chi[links:]) if model.drives_by_design else True
    values = base.values(np.where(silent, 0.0, chi))
    values[silent[base.columns]] = np.nan
    return values
