from __future__ import annotations

import numpy as np

from asbuilt.description import (
    Joint,
    Link,
    LinkInertia,
    RobotModel,
    load_robot,
    placement,
    rotation_from_rpy,
)
from asbuilt.writers.tables.robot_tables import tabulate_robot_joints, tabulate_robot_links


def test_rounding_is_not_shown_as_products_of_inertia() -> None:
    """A ball far from the origin.

    Its inertia about the centre is the difference of large numbers, and has no products.
    """
    ball = LinkInertia.from_com(2.0, [0.3, -0.7, 0.11], 1e-3 * np.eye(3)).moved(
        placement(rotation_from_rpy([0.3, 0.2, 0.1]), [0.0, 0.1, 0.9])
    )
    I = ball.inertia_about_com
    assert 0.0 < np.abs(I - np.diag(np.diag(I))).max() < 1e-12
    askew = LinkInertia.from_com(
        1.0, [0.0, 0.0, 0.0], [[2.0, 1e-3, 0.0], [1e-3, 3.0, 0.0], [0.0, 0.0, 4.0]]
    )
    joints = tuple(Joint(f"j{k}", "revolute", k - 1, np.eye(4), np.eye(4)) for k in range(2))
    model = RobotModel("two", joints, (Link("ball", ball), Link("askew", askew)))
    products = [row[4] for row in tabulate_robot_links(model).rows]
    assert products == ["0 0 0", "0.001 0 0"]


def test_links_without_mass_properties_are_not_called_ok() -> None:
    model = load_robot("two-link")
    point = LinkInertia.from_com(1.0, [0.1, 0.0, 0.0], np.zeros((3, 3)))
    model = model.with_parameters(np.concatenate([np.zeros(10), point.parameters]))
    verdicts = [row[-1] for row in tabulate_robot_links(model).rows]
    assert verdicts == ["ALL ZERO: no mass properties", "ZERO INERTIA: a point mass"]
    assert tabulate_robot_links(load_robot("two-link")).rows[0][-1] == "OK"


def test_limits_of_robots_that_slide_are_forces_too() -> None:
    units = {
        name: {
            column.header: column.unit for column in tabulate_robot_joints(load_robot(name)).columns
        }["torque"]
        for name in ("two-link", "scara")
    }
    assert units == {"two-link": "N m", "scara": "N m, N"}
