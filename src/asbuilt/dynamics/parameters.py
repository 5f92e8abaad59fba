"""Names, units and values of the standard parameters.

Ten per link, link by link, then the drive parameters, joint by joint.
"""

from __future__ import annotations

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.inertia import PARAMETER_NAMES, PARAMETER_UNITS
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.drives.drive_set import NO_DRIVE, DriveSet


def parameter_count(model: RobotModel, drive: DriveSet = NO_DRIVE) -> int:
    """Return the number of standard parameters, `10 n_links + columns_per_joint n_joints`."""
    drive.check_joints(model.n_joints)
    return len(PARAMETER_NAMES) * model.n_links + drive.columns_per_joint * model.n_joints


def parameter_names(model: RobotModel, drive: DriveSet = NO_DRIVE) -> tuple[str, ...]:
    """Return the names of the standard parameters.

    `Ixx1 ... m1 Ixx2 ... mn`, then `Ia1 Fv1 Fc1 Fo1 Ia2 ...` as chosen.
    """
    links = tuple(
        f"{name}{number}" for number in range(1, model.n_links + 1) for name in PARAMETER_NAMES
    )
    return links + tuple(
        name for number in range(1, model.n_joints + 1) for name in drive.names(number)
    )


def parameter_units(model: RobotModel, drive: DriveSet = NO_DRIVE) -> tuple[str, ...]:
    """Return the unit of each standard parameter.

    A drive parameter's depends on whether its joint turns or slides.
    """
    drives = tuple(unit for joint in model.joints for unit in drive.units(joint.kind))
    return PARAMETER_UNITS * model.n_links + drives


def parameter_values(model: RobotModel, drive: DriveSet = NO_DRIVE) -> Array:
    """Return the values the description gives, shape (n_standard,).

    NaN for a drive value on which it is silent, or gives with other parameters.
    """
    drives = [
        value for k, joint in enumerate(model.joints) for value in drive.at(k).values(joint.drive)
    ]
    return np.concatenate(
        [
            model.parameters,
            np.array(drives, dtype=np.float64),  # None becomes NaN
        ]
    )
