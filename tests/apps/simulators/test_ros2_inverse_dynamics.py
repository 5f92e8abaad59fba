"""The ROS 2 package: compiled without ROS against headers of ours, its torque is the result's."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from pathlib import Path
from xml.etree.ElementTree import parse

import numpy as np
import pytest

from asbuilt.description import load_robot
from asbuilt.dynamics import DriveSet
from asbuilt.excitation import random_fourier
from asbuilt.experiment import VirtualRobot, prepare_samples
from asbuilt.identification import IdentificationResult, identify_samples
from asbuilt.writers import export_result

HEADERS = Path(__file__).parent / "ros2_headers"
CONFIGS = Path(__file__).parent / "ros2_cmake"
COMPILER = shutil.which("g++")
needs_compiler = pytest.mark.skipif(COMPILER is None, reason="there is no C++ compiler")
FUNCTIONS = """
#include <cstdlib>
#include <memory>
#include "{package}/solver.hpp"

static long allocations = 0;
void * operator new(std::size_t size) {{ ++allocations; return std::malloc(size); }}
void operator delete(void * place) noexcept {{ std::free(place); }}
void operator delete(void * place, std::size_t) noexcept {{ std::free(place); }}

static Eigen::VectorXd fill(const double * values)
{{
  Eigen::VectorXd made({package}::kJoints);
  for (std::size_t j = 0; j < {package}::kJoints; ++j) made(j) = values[j];
  return made;
}}

extern "C" long torques(
  int form, const double * q, const double * qd, const double * qdd, double * tau)
{{
  std::unique_ptr<inverse_dynamics_solver::InverseDynamicsSolver> solver;
  if (form == 1) solver = std::make_unique<{package}::AsBuiltWithoutFriction>();
  else solver = std::make_unique<{package}::AsBuilt>();
  solver->initialize();
  const Eigen::VectorXd a = fill(q), b = fill(qd), c = fill(qdd);
  const std::size_t n = {package}::kJoints;
  const long before = allocations;
  Eigen::VectorXd found;
  if (form == 2) {{
    for (int k = 0; k < 1000; ++k) {package}::AsBuilt::computeTorques(q, qd, qdd, tau);
    return allocations - before;
  }}
  if (form == 3) {{
    auto [M, C, g] = solver->getDynamicParameters(a, b);
    const Eigen::VectorXd f = solver->getFrictionVector(b);
    for (std::size_t j = 0; j < n; ++j) {{
      tau[j] = C(j) + g(j) + f(j);
      for (std::size_t k = 0; k < n; ++k) tau[j] += M(j, k) * qdd[k];
    }}
    return 0;
  }}
  found = solver->getTorques(a, b, c);
  const long used = allocations - before;
  for (std::size_t j = 0; j < n; ++j) tau[j] = found(j);
  return used;
}}
"""


def identified(terms: str) -> IdentificationResult:
    """A tilted arm with these drives, identified from exact torques."""
    model = load_robot("ur10e").with_gravity([0.6, -0.4, -9.7])
    drive = DriveSet.parse(terms)
    rng = np.random.default_rng(2)
    values = rng.uniform(0.1, 1.0, model.n_joints * drive.columns_per_joint)
    robot = VirtualRobot.ideal(model).with_drive(drive, values)
    motion = random_fourier(model, rng=1, duration=10.0, n_harmonics=8)
    samples = prepare_samples(robot.record(motion, rate=100.0, rng=1).recording)
    return identify_samples(model, [samples], drive=drive)


def compiled(folder: Path) -> tuple[str, ctypes.CDLL]:
    """The package's name, and its library with the functions above."""
    package = str(parse(folder / "package.xml").getroot().findtext("name"))
    (folder / "functions.cpp").write_text(FUNCTIONS.format(package=package))
    where = ["-I", str(folder / "include"), "-I", str(HEADERS)]
    strict = ["-Wall", "-Wextra", "-Wpedantic", "-Werror", "-O1", "-fPIC"]
    commands = (
        ["gcc", "-std=c99", *strict, *where, "-c", "src/dynamics.c", "-o", "dynamics.o"],
        ["g++", "-std=c++17", *strict, *where, "-shared", "src/solver.cpp", "functions.cpp",
         "dynamics.o", "-o", "plugin.so", "-lm"],
        ["g++", "-std=c++17", *strict, *where, "src/solver.cpp", "test/test_solver.cpp",
         "dynamics.o", "-o", "test_solver", "-lm"],
    )  # fmt: skip
    for command in commands:
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
    return package, ctypes.CDLL(str(folder / "plugin.so"))


@needs_compiler
@pytest.mark.study
def test_the_plugin_has_the_torque_of_the_result(tmp_path: Path) -> None:
    result = identified("armature,viscous,coulomb,offset,spring")
    export = export_result(result, simulators={"ros2-inverse-dynamics": tmp_path / "package"})
    folder = export.files["ros2-inverse-dynamics"]
    package, library = compiled(folder)
    names = [each.get("type") for each in parse(folder / "plugin.xml").getroot()]
    assert names == [f"{package}::AsBuilt", f"{package}::AsBuiltWithoutFriction"]
    n = result.model.n_joints
    pointer = np.ctypeslib.ndpointer(dtype=np.float64, shape=(n,))
    library.torques.argtypes = [ctypes.c_int, *[pointer] * 4]
    library.torques.restype = ctypes.c_long
    rng = np.random.default_rng(5)
    for _ in range(50):
        q, qd, qdd = rng.uniform(-2.0, 2.0, (3, n))
        tau = result.torque(q, qd, qdd)
        found = np.empty((4, n))
        used = [library.torques(form, q, qd, qdd, found[form]) for form in range(4)]
        # One allocation is the vector that the interface returns by value; the loop has none.
        assert used[:3] == [1, 1, 0]
        for form in (0, 2, 3):
            np.testing.assert_allclose(found[form], tau, atol=1e-9)
        signs = np.sign(qd)
        rubbing = rub(result, qd, signs)
        np.testing.assert_allclose(found[1], tau - rubbing, atol=1e-9)
    assert subprocess.run([folder / "test_solver"], check=False).returncode == 0


def rub(result: IdentificationResult, qd: np.ndarray, signs: np.ndarray) -> np.ndarray:
    """Viscous and Coulomb friction from the values alone."""
    value = dict(zip(result.base.names, result.estimates.tolist(), strict=True))
    n = result.model.n_joints
    return np.array(
        [value[f"Fv{j}"] * qd[j - 1] + value[f"Fc{j}"] * signs[j - 1] for j in range(1, n + 1)]
    )


def test_an_impossible_robot_is_exported_as_it_was_identified(tmp_path: Path) -> None:
    """The plugin holds torques, which need no possible bodies."""
    result = identified("armature,viscous,coulomb,offset")
    export = export_result(result, simulators={"ros2-inverse-dynamics": tmp_path})
    assert export.verdict == "the identified parameters"
    assert any("order of the log" in note for note in export.notes["ros2-inverse-dynamics"])
    assert {path.name for path in tmp_path.rglob("*") if path.is_file()} == {
        "package.xml", "CMakeLists.txt", "plugin.xml", "solver.hpp", "solver.cpp", "dynamics.c",
        "dynamics.h", "test_solver.cpp",
    }  # fmt: skip


@pytest.mark.skipif(shutil.which("cmake") is None, reason="there is no CMake")
@needs_compiler
@pytest.mark.study
def test_the_package_is_built_tested_and_installed_by_cmake(tmp_path: Path) -> None:
    """As `colcon build` and `colcon test` do, with configurations of our own for what ROS has."""
    result = identified("armature,viscous,coulomb,offset")
    export_result(result, simulators={"ros2-inverse-dynamics": tmp_path / "package"})
    build = tmp_path / "build"
    installed = tmp_path / "install"
    places = [f"-D{path.stem.removesuffix('Config')}_DIR={CONFIGS}" for path in CONFIGS.iterdir()]
    commands = (
        ["cmake", "-S", tmp_path / "package", "-B", build, f"-DCMAKE_INSTALL_PREFIX={installed}",
         *places],
        ["cmake", "--build", build, "--target", "install"],
        ["ctest", "--test-dir", build, "--output-on-failure", "--no-tests=error"],
    )  # fmt: skip
    for command in commands:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
        assert "Warning" not in done.stdout + done.stderr
    assert {path.name for path in installed.rglob("*") if path.is_file()} >= {
        "libur10e_as_built.so", "plugin.xml", "solver.hpp", "export_ur10e_as_built.cmake",
    }  # fmt: skip
