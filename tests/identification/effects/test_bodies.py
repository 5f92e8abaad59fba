"""What bodies have beyond CAD: coverage of the payload's error, and false payloads."""

from __future__ import annotations

import numpy as np
import pytest

from asbuilt.arrays import Array
from asbuilt.description.inertia import LinkInertia
from asbuilt.description.load import load_robot
from asbuilt.dynamics.base.base_parameters import find_base_parameters
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.identification.bodies.cad_prior import cad_prior
from asbuilt.identification.effects.bodies import explain_bodies

MODEL = load_robot("kuka-iiwa7-r800")
BASE = find_base_parameters(MODEL, DriveSet())
PRIOR = cad_prior(MODEL, DriveSet())
TOOL = LinkInertia.from_com(1.2, [0.01, -0.01, 0.07], np.diag([0.004, 0.0035, 0.0015]))
NOISE = 0.002


def differences(scatter: float, payload: bool, count: int) -> list[Array]:
    """Return base parameters less those of CAD: scatter of links, noise, and a tool if wanted."""
    rng = np.random.default_rng(3)
    root = np.linalg.cholesky(np.linalg.inv(PRIOR.metric))
    found = []
    for _ in range(count):
        links = np.einsum("iab,ib->ia", root, rng.normal(size=(MODEL.n_links, 10))) * scatter
        links[MODEL.tool_link] += TOOL.parameters if payload else 0.0
        found.append(BASE.values(links.ravel()) + NOISE * rng.normal(size=BASE.n_base))
    return found


@pytest.mark.parametrize(
    "scatter", [0.1, *(pytest.param(each, marks=pytest.mark.study) for each in (0.0, 0.02))]
)
def test_the_error_of_a_payload_covers_the_scatter_of_cad(scatter: float) -> None:
    """Intervals of 95 % cover the mass in 85 % of draws at least: 0.1 is links off by 4 %."""
    C = NOISE**2 * np.eye(BASE.n_base)
    found = [
        explain_bodies(BASE, PRIOR, MODEL.tool_link, each, C)
        for each in differences(scatter, True, 120)
    ]
    there = [each for each in found if each.has_payload]
    assert len(there) > 0.6 * len(found)
    errors = [float(np.sqrt(each.covariance[9, 9])) for each in there]
    away = [abs(each.payload[9] - TOOL.mass) for each in there]
    assert np.mean(np.array(away) < 1.96 * np.array(errors)) > 0.85


@pytest.mark.parametrize("scatter", [0.1, pytest.param(0.0, marks=pytest.mark.study)])
def test_links_that_scatter_seldom_look_like_a_payload(scatter: float) -> None:
    C = NOISE**2 * np.eye(BASE.n_base)
    found = [
        explain_bodies(BASE, PRIOR, MODEL.tool_link, each, C)
        for each in differences(scatter, False, 120)
    ]
    assert sum(each.has_payload for each in found) <= 0.06 * len(found)
    differ = np.mean([each.links_differ for each in found])
    assert differ < 0.1 if scatter == 0.0 else differ == 1.0
