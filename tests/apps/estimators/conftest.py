"""The robot of these tests."""

from __future__ import annotations

import pytest
from three_links import DRIVE, arm, truth

from asbuilt.dynamics import find_base_parameters


@pytest.fixture(scope="session")
def robot():
    """The robot of three links, its base parameters and their true values."""
    model = arm()
    base = find_base_parameters(model, DRIVE)
    return model, base, truth(base, model)
