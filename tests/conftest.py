"""Fixtures for every room."""

from __future__ import annotations

import gc
import os
import sys
from pathlib import Path

import pytest

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False
"""Processes that tests start read bytecode: to compile it takes each a second or more."""

SHARED = Path(__file__).resolve().parents[2] / "shared"


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder with recordings and descriptions of real robots, outside this repository."""
    if not (SHARED / "data").is_dir():
        pytest.skip("the folder ../shared with recordings of real robots is not here")
    return SHARED


INSTALLED = Path(__file__).resolve().parents[1] / "src" / "asbuilt" / "apps"


def pytest_collection_finish() -> None:
    """Spare the collector the thousands of tests and all modules, which stay to the end."""
    gc.freeze()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip tests that need apps which are not there (`tests/without_apps.py`)."""
    for item in items:
        needed = {app for marker in item.iter_markers("apps") for app in marker.args}
        absent = sorted(app for app in needed if not (INSTALLED / app).is_dir())
        if absent:
            item.add_marker(pytest.mark.skip(reason=f"without the app {', '.join(absent)}"))
