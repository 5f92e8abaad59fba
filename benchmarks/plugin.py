"""Time per call of the ROS 2 plugin beside Pinocchio's recursion in C++, one core.

    python benchmarks/plugin.py --eigen DIR

DIR is the include folder of Eigen 3 (`pip install --target DIR cmeel-eigen`); Pinocchio's headers
come with `pin`. Both are compiled with -O3 and called with the same changing
motion. The plugin has armature, friction and offset of the drives; Pinocchio has armature.
"""

from __future__ import annotations

import argparse
import subprocess
import tempfile
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from xml.etree.ElementTree import parse

import pinocchio as pin

import asbuilt
from asbuilt import StudyOptions, VirtualRobot, export_result
from asbuilt.description import DriveValues

ROBOTS = ("ur10e", "kuka-iiwa7-r800", "franka-panda")
CALLS = 200_000
REPEATS = 7
HEADERS = Path(__file__).parents[1] / "tests/apps/simulators/ros2_headers"
DEFINED = [
    f"-D{each}"
    for each in (
        "BOOST_MPL_LIMIT_LIST_SIZE=30",
        "BOOST_MPL_LIMIT_VECTOR_SIZE=30",
        "BOOST_MPL_CFG_NO_PREPROCESSED_HEADERS",
        "BOOST_FUSION_INVOKE_MAX_ARITY=12",
        # The recursion of its library, which is compiled with all optimisations.
        "PINOCCHIO_ENABLE_TEMPLATE_INSTANTIATION",
    )
]
"""What programs that use Pinocchio define, by its own CMake files."""
CLOCK = """
#include <cstdio>
#include <ctime>
static double now() {{ timespec t; clock_gettime(CLOCK_MONOTONIC, &t);
  return 1e6 * static_cast<double>(t.tv_sec) + 1e-3 * static_cast<double>(t.tv_nsec); }}
template <typename Call> void report(Call call) {{
  double q[{n}], v[{n}], a[{n}], best = 1e9, sum = 0.0;
  for (int j = 0; j < {n}; ++j) {{ q[j] = 0.1 * j; v[j] = 0.2 - 0.1 * j; a[j] = 0.3 * j; }}
  for (int repeat = 0; repeat < {repeats}; ++repeat) {{
    const double start = now();
    for (int k = 0; k < {calls}; ++k) {{
      for (int j = 0; j < {n}; ++j) q[j] += 1e-4 * (j + 1);
      sum += call(q, v, a);
    }}
    const double each = (now() - start) / {calls};
    if (each < best) best = each;
  }}
  std::printf("%.4f %d\\n", best, sum == 0.5);
}}
"""
PLUGIN = """#include "{package}/solver.hpp"
int main() {{
  double tau[{n}];
  report([&](const double * q, const double * v, const double * a) {{
    {package}::AsBuilt::computeTorques(q, v, a, tau);
    return tau[0];
  }});
}}
"""
PINOCCHIO = """#include <pinocchio/algorithm/rnea.hpp>
#include <pinocchio/multibody.hpp>
using namespace pinocchio;
static void add(Model & model, int parent, const JointModel & kind, const double * place,
  const double * body, double armature) {{
  Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>> R(place), I(body + 4);
  const Eigen::Vector3d p(place[9], place[10], place[11]), c(body[1], body[2], body[3]);
  const std::string name = "joint" + std::to_string(model.njoints);
  const auto joint = model.addJoint(parent, kind, SE3(R, p), name);
  model.appendBodyToJoint(joint, Inertia(body[0], c, Symmetric3(Eigen::Matrix3d(I))));
  model.armature[model.nv - 1] = armature;
}}
int main() {{
  Model model;
{joints}
  Data data(model);
  Eigen::VectorXd x(model.nq), u(model.nv), w(model.nv);
  report([&](const double * q, const double * v, const double * a) {{
    for (int j = 0; j < {n}; ++j) {{ x[j] = q[j]; u[j] = v[j]; w[j] = a[j]; }}
    return rnea(model, data, x, u, w)[0];
  }});
}}
"""


def write_joints(urdf: Path) -> str:
    """Return the statements that build Pinocchio's model of a URDF."""
    model = pin.buildModelFromUrdf(str(urdf))
    lines = []
    for k in range(1, model.njoints):
        place = model.jointPlacements[k]
        body = model.inertias[k]
        numbers = [
            ", ".join(repr(float(x)) for x in values)
            for values in (
                [*place.rotation.ravel(), *place.translation],
                [body.mass, *body.lever, *body.inertia.ravel()],
            )
        ]
        kind = model.joints[k].shortname()
        lines.append(
            f"  {{ const double p[] = {{{numbers[0]}}}, b[] = {{{numbers[1]}}};"
            f" add(model, {model.parents[k]}, {kind}(), p, b, 0.1); }}"
        )
    return "\n".join(lines)


def time_robot(name: str, eigen: Path | None) -> tuple[float, float | None]:
    """Return microseconds per call of the plugin, and of Pinocchio if there is an Eigen."""
    model = asbuilt.load_robot(name)
    drive = DriveValues(armature=0.1, viscous=1.0, coulomb=2.0, offset=0.1)
    truth = replace(model, joints=tuple(replace(joint, drive=drive) for joint in model.joints))
    motion = asbuilt.random_fourier(model, 1, duration=10.0)
    recording = VirtualRobot.ideal(truth).record(motion, 0).recording
    options = StudyOptions(drive="armature,viscous,coulomb,offset", holdout=None)
    result = asbuilt.identify(model, [recording], options=options).result
    n = model.n_joints
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        export_result(result, simulators={"ros2-inverse-dynamics": folder}, urdf=folder / "r.urdf")
        package = str(parse(folder / "package.xml").getroot().findtext("name"))
        clock = CLOCK.format(n=n, repeats=REPEATS, calls=CALLS)
        own = ["-I", str(folder / "include"), "-I", str(HEADERS)]
        text = clock + PLUGIN.format(n=n, package=package)
        c = [*own, "-O3", "-c", "src/dynamics.c", "-o", "dynamics.o"]
        subprocess.run(["gcc", "-std=c99", *c], cwd=folder, check=True)
        ours = time_program(folder, text, [*own, "src/solver.cpp", "dynamics.o"])
        if eigen is None:
            return ours, None
        prefix = Path(str(find_spec("pinocchio").origin)).parents[4]  # type: ignore[union-attr]
        libraries = [f"-L{prefix / 'lib'}", f"-Wl,-rpath,{prefix / 'lib'}", "-lpinocchio_default"]
        theirs = ["-I", str(prefix / "include"), "-I", str(eigen), *DEFINED]
        text = clock + PINOCCHIO.format(n=n, joints=write_joints(folder / "r.urdf"))
        return ours, time_program(folder, text, [*theirs, *libraries])


def time_program(folder: Path, text: str, options: list[str]) -> float:
    """Compile a program and return the time that it prints."""
    (folder / "main.cpp").write_text(text)
    command = [
        "g++",
        "-std=c++17",
        "-O3",
        "-DNDEBUG",
        "main.cpp",
        *options,
        "-o",
        "program",
    ]
    subprocess.run([*command, "-lm"], cwd=folder, check=True)
    done = subprocess.run([folder / "program"], check=True, capture_output=True)
    return float(done.stdout.split()[0])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--eigen", type=Path)
    parser.add_argument("--robots", nargs="+", default=ROBOTS)
    given = parser.parse_args()
    for name in given.robots:
        ours, theirs = time_robot(name, given.eigen)
        beside = "" if theirs is None else f", Pinocchio {theirs:.3f}"
        print(f"{name}: microseconds per call: plugin {ours:.3f}{beside}")
    print(f"the best of {REPEATS} runs of {CALLS} calls")


if __name__ == "__main__":
    main()
