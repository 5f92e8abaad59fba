"""What a turn about a joint's axis leaves as it is, from masses on that axis."""

from __future__ import annotations

import numpy as np

from asbuilt.description.inertia import LinkInertia
from asbuilt.dynamics.base.regrouping import AXIAL


def test_axial_directions_span_exactly_the_masses_on_the_axis() -> None:
    masses = [
        LinkInertia.from_com(1.0, [0.0, 0.0, height], np.zeros((3, 3))).parameters
        for height in (0.0, 0.3, -1.0)
    ]
    found = np.linalg.lstsq(AXIAL.T, np.transpose(masses), rcond=None)[0]
    np.testing.assert_allclose(AXIAL.T @ found, np.transpose(masses), atol=1e-12)
    assert np.linalg.matrix_rank(found) == np.linalg.matrix_rank(AXIAL) == 3
