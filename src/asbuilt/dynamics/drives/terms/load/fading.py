"""How load-dependent friction near standstill fades with speed."""

from __future__ import annotations

from asbuilt.dynamics.drives.term import NonlinearParameter

FADING = (
    NonlinearParameter(
        "velocity", 0.1, 1e-3, 5.0, "rad/s", typical=2.0, speed=True, credible=(0.0, 0.1)
    ),
    NonlinearParameter("power", 2.0, 0.5, 10.0, "", fitted=False, typical=2.0),
)
"""Velocity and power of `exp(-|qd / velocity|^power)`, the same for every term of the kind."""
