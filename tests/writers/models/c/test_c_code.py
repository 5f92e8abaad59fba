import ctypes
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from pinocchio_oracle import pinocchio_model, random_robot
from reload_oracle import as_if_identified, drive_torques, two_armed

from asbuilt.description import RobotModel, bundled_robot, load_robot
from asbuilt.dynamics import (
    DriveSet,
    available_terms,
    drive_torque,
    find_base_parameters,
    gravity_torque,
    inverse_dynamics,
    regressor,
)
from asbuilt.errors import UsageError
from asbuilt.writers.models.as_built import draw_sample_states
from asbuilt.writers.models.c.c_code import generate_c_code, write_c
from asbuilt.writers.models.c.c_expressions import StraightLine, Term
from studied_cases import first_of

FLAGS = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O1")


class Compiled:
    """The functions of a C file as Python calls."""

    def __init__(self, folder: Path, model: RobotModel, **options: Any) -> None:
        self.source, self.header = write_c(folder / "robot.c", model, **options)
        self.prefix = generate_c_code(model, **options).prefix
        library = folder / "robot.so"
        subprocess.run(
            ["gcc", *FLAGS, "-shared", "-fPIC", str(self.source), "-o", str(library), "-lm"],
            check=True,
        )
        self.library = ctypes.CDLL(str(library))
        self.folder = folder

    def call(self, function: str, size: int) -> Callable[..., np.ndarray]:
        def run(*inputs: np.ndarray) -> np.ndarray:
            out = np.full(size, np.nan)
            pointers = [
                np.ascontiguousarray(x).ctypes.data_as(ctypes.POINTER(ctypes.c_double))
                for x in (*inputs, out)
            ]
            getattr(self.library, f"{self.prefix}_{function}")(*pointers)
            return out

        return run

    def base_values(self, count: int) -> np.ndarray:
        return np.array(
            (ctypes.c_double * count).in_dll(self.library, f"{self.prefix}_base_values")
        )

    def self_test(self) -> subprocess.CompletedProcess[str]:
        program = self.folder / "self_test"
        define = f"-D{self.prefix.upper()}_SELF_TEST"
        subprocess.run(
            ["gcc", *FLAGS, define, str(self.source), "-o", str(program), "-lm"], check=True
        )
        return subprocess.run([str(program)], capture_output=True, text=True, check=False)


def check_compiles(folder: Path, model: RobotModel) -> Compiled:
    """Compare with Pinocchio and with the batched kernels, and the regressor with its own parameter
    table.
    """
    compiled, n = Compiled(folder, model), model.n_joints
    drive = DriveSet.parse("armature,viscous,coulomb,offset")
    base = find_base_parameters(model, drive)
    beta = compiled.base_values(base.n_base)
    q, qd, qdd = draw_sample_states(model, 10)
    qd[0, 0] = 0.0
    tau, gravity, row = (
        compiled.call(f, k)
        for f, k in (("inverse_dynamics", n), ("gravity_torque", n), ("regressor", n * base.n_base))
    )
    oracle = pinocchio_model(model)
    data = oracle.createData()
    drives = drive_torques(model, qd, qdd, offset=True)
    for k in range(len(q)):
        found = tau(q[k], qd[k], qdd[k])
        np.testing.assert_allclose(
            found, pin.rnea(oracle, data, q[k], qd[k], qdd[k]) + drives[k], rtol=0, atol=1e-9
        )
        np.testing.assert_allclose(gravity(q[k]), gravity_torque(model, q[k]), rtol=0, atol=1e-9)
        Y = row(q[k], qd[k], qdd[k]).reshape(n, -1)
        np.testing.assert_allclose(
            Y, regressor(model, q[k], qd[k], qdd[k], drive)[:, base.columns], rtol=0, atol=1e-9
        )
        np.testing.assert_allclose(Y @ beta, found, rtol=0, atol=1e-9)
    return compiled


@pytest.mark.parametrize("name", [pytest.param("franka-panda", marks=pytest.mark.study), "scara"])
def test_bundled_robots(name: str, tmp_path: Path) -> None:
    check_compiles(tmp_path, as_if_identified(bundled_robot(name), 3))


@pytest.mark.study
@pytest.mark.parametrize("name", ["lbrstack_med7.urdf", "mjcf_iiwa14.xml"])
def test_descriptions_of_strangers(shared: Path, name: str, tmp_path: Path) -> None:
    check_compiles(tmp_path, as_if_identified(load_robot(shared / "models" / name), 4))


@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(seed, marks=pytest.mark.study) for seed in (1, 2))]
)
def test_random_trees_under_tilted_gravity(seed: int, tmp_path: Path) -> None:
    check_compiles(tmp_path, as_if_identified(random_robot(np.random.default_rng(seed), 5), seed))


@pytest.mark.study
def test_two_arms(tmp_path: Path) -> None:
    check_compiles(tmp_path, as_if_identified(two_armed(), 4))


def test_lengths_that_are_almost_zero_keep_their_torque(tmp_path: Path) -> None:
    model = as_if_identified(bundled_robot("ur10e"), 3)
    wrist = np.array(model.joints[4].before)
    wrist[0, 3] += 5e-11
    model = replace(
        model,
        joints=(
            *model.joints[:4],
            replace(model.joints[4], before=wrist, before_symbols=None),
            *model.joints[5:],
        ),
    )
    tau = Compiled(tmp_path, model).call("inverse_dynamics", 6)
    q, qd, qdd = draw_sample_states(model, 20)
    expected = inverse_dynamics(model, q, qd, qdd) + drive_torques(model, qd, qdd, offset=True)
    np.testing.assert_allclose(
        [tau(*state) for state in zip(q, qd, qdd, strict=True)], expected, rtol=0, atol=1e-11
    )


def test_self_test_passes_and_notices_a_changed_number(tmp_path: Path) -> None:
    compiled = check_compiles(tmp_path, as_if_identified(bundled_robot("two-link"), 3))
    done = compiled.self_test()
    assert done.returncode == 0
    assert float(done.stdout.split()[-1]) < 1e-9
    compiled.source.write_text(compiled.source.read_text().replace("cos(q[1])", "sin(q[1])", 1))
    assert compiled.self_test().returncode == 1


def test_only_sine_and_cosine_are_called(tmp_path: Path) -> None:
    compiled = check_compiles(tmp_path, as_if_identified(bundled_robot("ur10e"), 3))
    symbols = subprocess.run(
        ["nm", "-D", "--undefined-only", str(tmp_path / "robot.so")],
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    called = {line.split()[-1].split("@")[0] for line in symbols.splitlines() if " U " in line}
    assert called <= {"sin", "cos", "sincos"}
    assert "malloc" not in compiled.source.read_text()


def test_hostile_names_stay_text(example: Any, tmp_path: Path) -> None:
    model = as_if_identified(example.model, 1)
    names = ('*/ int x; /* "', "??/\\", "é\n#error", "%s\\")
    joints = tuple(
        replace(joint, name=name) for joint, name in zip(model.joints, names, strict=True)
    )
    check_compiles(
        tmp_path, replace(model, name='7 "arms" */ ??/\\', joints=joints, notes=("a */ b", "c \\"))
    )


@pytest.mark.study
def test_richer_drive_terms_and_coupled_motors(tmp_path: Path) -> None:
    model = bundled_robot("ur10e")
    coupling = np.eye(6)
    coupling[5, 4], coupling[4, 3] = 1.0, -0.5
    model = replace(model, motor_coupling=coupling)
    keys = "motor_armature,motor_viscous,motor_coulomb,viscous,quadratic,cubic,coulomb"
    keys += ",asymmetric_coulomb,asymmetric_viscous,spring,balancer,offset"
    drive = DriveSet.parse(keys)
    values = np.random.default_rng(0).uniform(0.1, 1.0, 6 * drive.columns_per_joint)
    compiled = Compiled(tmp_path, model, drive=drive, drive_values=values)
    tau = compiled.call("inverse_dynamics", 6)
    q, qd, qdd = draw_sample_states(model, 10)
    expected = inverse_dynamics(model, q, qd, qdd) + drive_torque(
        drive, values, q, qd, qdd, shares=model.motor_shares
    )
    np.testing.assert_allclose(
        [tau(*state) for state in zip(q, qd, qdd, strict=True)], expected, rtol=0, atol=1e-9
    )
    assert compiled.self_test().returncode == 0


@pytest.mark.parametrize("first", first_of(2, range(6)))
def test_every_term_of_the_catalogue_is_written(first: int, tmp_path: Path) -> None:
    """Every sixth at once, since compiling takes longest; a wrong one is wrong in the sum."""
    model = replace(bundled_robot("two-link"), motor_coupling=np.eye(2) + np.eye(2, k=-1))
    drive = DriveSet(tuple(available_terms().values())[first::6])
    values = np.random.default_rng(0).uniform(0.1, 1.0, 2 * drive.columns_per_joint)
    compiled = Compiled(tmp_path, model, drive=drive, drive_values=values)
    q, qd, qdd = draw_sample_states(model, 5)
    load = inverse_dynamics(model, q, qd, qdd)
    expected = load + drive_torque(drive, values, q, qd, qdd, load=load, shares=model.motor_shares)
    tau = compiled.call("inverse_dynamics", 2)
    np.testing.assert_allclose(
        [tau(*state) for state in zip(q, qd, qdd, strict=True)], expected, rtol=0, atol=1e-9
    )
    assert compiled.self_test().returncode == 0


@pytest.mark.parametrize("name", ["robot.cpp", "robot", "a b.c"])
def test_file_names_that_cannot_be_included(name: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"C (code|file)"):
        write_c(tmp_path / name, bundled_robot("two-link"))
    assert not list(tmp_path.iterdir())


def test_sums_fold_numbers_and_share_terms() -> None:
    code = StraightLine()
    a, b = Term(1.0, "a"), Term(-2.0, "b")
    assert code.total((a, Term(0.0)), (Term(2.0), Term(3.0))) == Term(6.0)
    one = code.total((a, b), (Term(0.5), a))
    two = code.total((b, -a), (Term(-0.5), a))
    assert two == -one
    assert code.used([one]) == [f"const double {one.name} = 0.5*a - 2.0*a*b;"]
    assert code.used([Term(1.0)]) == []
