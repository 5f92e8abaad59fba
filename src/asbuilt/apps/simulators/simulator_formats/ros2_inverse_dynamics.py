"""A ROS 2 package with a plugin of `inverse_dynamics_solver` on the exported C.

The interface is `inverse_dynamics_solver::InverseDynamicsSolver` of the package
inverse_dynamics_solver (unisa-acg, github.com/unisa-acg/inverse-dynamics-solver,
include/inverse_dynamics_solver/inverse_dynamics_solver.hpp): `initialize`, `getInertiaMatrix`,
`getCoriolisVector`, `getGravityVector`, `getFrictionVector` and `getTorques`, vectors by value.
There `getTorques` has no friction. Here one class has it, as the result's torque; a second leaves
it to `getFrictionVector`.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from asbuilt.writers import (
    SIMULATOR_FORMATS,
    ExportedDrives,
    SimulatorFormat,
    note_left_out_control,
)
from asbuilt.writing import atomic_write

TESTED = 5
"""States in the test of the package."""
ENVIRONMENT = Environment(
    loader=PackageLoader("asbuilt.apps.simulators"),
    undefined=StrictUndefined,
    autoescape=False,
    keep_trailing_newline=True,
    trim_blocks=True,
    lstrip_blocks=True,
)
FILES = {
    "package.xml": "package.xml",
    "CMakeLists.txt": "CMakeLists.txt",
    "plugin.xml": "plugin.xml",
    "include/{package}/solver.hpp": "solver.hpp",
    "src/solver.cpp": "solver.cpp",
    "test/test_solver.cpp": "test_solver.cpp",
}
"""Templates by the place of their file in the package."""


class Ros2InverseDynamics(SimulatorFormat):
    """A folder to put into a workspace."""

    key = "ros2-inverse-dynamics"
    title = "ROS 2 package with a plugin of inverse_dynamics_solver (a folder)"
    exact = True

    def document(self, drives: ExportedDrives, path: Path) -> tuple[str, tuple[str, ...]]:
        """Return the source of the plugin, and notes."""
        notes = note_left_out_control(drives.result, "inverse dynamics")
        order = "the joints are in the order of the log: " + ", ".join(drives.result.joint_names)
        return _render("solver.cpp", drives), (*notes, order)

    def write(self, drives: ExportedDrives, path: Path) -> tuple[Path, tuple[str, ...]]:
        """Write the package; return its folder."""
        package = name_package(drives.model.name)
        code = drives.generate_exact_c(f"{package}/dynamics", package)
        for place, template in FILES.items():
            atomic_write(path / place.format(package=package), _render(template, drives))
        atomic_write(path / "src" / "dynamics.c", code.source)
        atomic_write(path / "include" / package / "dynamics.h", code.header)
        return path, self.document(drives, path)[1]


def name_package(robot: str) -> str:
    r"""Return the name of the package, by the rules of ROS (REP 144).

    >>> name_package("UR 10e--x"), name_package("\u540d")
    ('ur_10e_x_as_built', 'robot_as_built')
    """
    words = re.findall(r"[a-z0-9]+", robot.lower().encode("ascii", "ignore").decode())
    stem = "_".join(words)[:60].strip("_") or "robot"
    return f"{stem if stem[0].isalpha() else f'robot_{stem}'}_as_built"


def _render(template: str, drives: ExportedDrives) -> str:
    result = drives.result
    draw = np.random.default_rng(0)
    motion = draw.uniform(-1.0, 1.0, (3, TESTED, result.model.n_joints))
    states = np.stack([*motion, result.torque(*motion)], axis=1)
    return ENVIRONMENT.get_template(template).render(
        package=name_package(drives.model.name),
        robot=_plain(drives.model.name),
        origin=_plain(drives.origin),
        joints=_plain(", ".join(result.joint_names)),
        n=result.model.n_joints,
        states=[[[repr(float(x)) for x in row] for row in state] for state in states],
    )


def _plain(text: str) -> str:
    """Return a text that is safe in comments of C++ and in XML."""
    return " ".join(re.sub(r"[^A-Za-z0-9 .,:;()_/+-]", "?", text).split())


SIMULATOR_FORMATS.register("ros2-inverse-dynamics", Ros2InverseDynamics())
