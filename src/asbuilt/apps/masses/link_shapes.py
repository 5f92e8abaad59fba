"""Boxes around the shapes of links, within which feasible bodies may be asked to lie."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from asbuilt import RobotModel
from asbuilt.apps.masses.solids import read_solids
from asbuilt.arrays import Array
from asbuilt.identification import LINK_SHAPES


def find_link_boxes(model: RobotModel) -> Mapping[int, tuple[Array, Array]]:
    """Return the corners (3,) of the box around the shapes of each link that has them all [m].

    Raises `DescriptionError` if the robot does not come from a URDF.
    """
    solids = read_solids(model)
    boxes = {}
    for k in range(model.n_links):
        own = [solid for solid in solids if solid.link == k and len(solid.corners)]
        if own and not any(solid.missing for solid in own):
            corners = np.concatenate([solid.corners for solid in own])
            boxes[k] = corners.min(axis=0), corners.max(axis=0)
    return boxes


LINK_SHAPES.register("urdf", find_link_boxes)
