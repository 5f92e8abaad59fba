"""The URDFs of real robots in ../shared/models."""

from __future__ import annotations

SHARED_URDFS = (
    "iiwa14.urdf",
    "kuka_lwr4.urdf",
    "kuka_lwr4_cogimon.urdf",
    "lbrstack_iiwa7.urdf",
    "lbrstack_med7.urdf",
    "ur10.urdf",
    "ur10e.urdf",
    "xarm7.urdf",
)
