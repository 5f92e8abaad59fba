"""The identification of the validation tests, shared; makes the oracle beside this file importable."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

NAME = "asbuilt_example_identification"
if NAME not in sys.modules:
    specification = importlib.util.spec_from_file_location(NAME, Path(__file__).parents[1] / "validation" / "conftest.py")
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    sys.modules[NAME] = module
    specification.loader.exec_module(module)

example = sys.modules[NAME].example
filtered_example = sys.modules[NAME].filtered_example
armature_example = sys.modules[NAME].armature_example
