"""Shapes and materials that no link has are one error with place, value and range."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from asbuilt import link_masses
from asbuilt.apps.masses.solids import look_up_density
from asbuilt.description import bundled_robot, load_robot
from asbuilt.errors import DescriptionError
from asbuilt.excitation.collision.capsules import build_surroundings
from asbuilt.writers.models.urdf import format_urdf

SHAPES = [
    '<cylinder radius="-0.1" length="1"/>', '<cylinder radius="0.1" length="-1"/>',
    '<sphere radius="-1"/>', '<box size="1 -1 1"/>', '<sphere radius="1e308"/>',
    '<box size="1e200 1e200 1"/>', '<sphere radius="nan"/>',
]  # fmt: skip


SAID = "(radius|length|size) of <.*(it must be|finite)"


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("kind", ["visual", "collision"])
def test_shapes_without_sense(shape: str, kind: str, tmp_path: Path) -> None:
    path = tmp_path / "r.urdf"
    body = f"</inertial><{kind}><geometry>{shape}</geometry></{kind}>"
    path.write_text(format_urdf(bundled_robot("two-link")).replace("</inertial>", body))
    model = load_robot(path)
    measure = {
        "visual": lambda: link_masses(model, density=2700.0),
        "collision": lambda: build_surroundings(model, str(path)),
    }
    with pytest.raises(DescriptionError, match=rf"r\.urdf.*{SAID}"):
        measure[kind]()


@pytest.mark.parametrize("density", [-1.0, 0.0, math.nan, math.inf, 1e308])
def test_densities_of_no_matter(density: float) -> None:
    with pytest.raises(DescriptionError, match="it must be a number above 0 to 100000 kg"):
        look_up_density(density, "link_1")
