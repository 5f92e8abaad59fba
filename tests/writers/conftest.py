"""The small identification that the tests of this room judge and tell of."""

from __future__ import annotations

from example_identification import armature_example, example, filtered_example

__all__ = ["armature_example", "example", "filtered_example"]
