"""Fixtures for every room."""

from __future__ import annotations

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
