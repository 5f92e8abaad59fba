"""A drive term and a description format of another distribution, from the command line."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from asbuilt.description import bundled_robot
from asbuilt.dynamics import DriveTerm, NonlinearParameter, drive_term
from asbuilt.dynamics.drives.term import Formula
from asbuilt.errors import UsageError

SATURATED = '''
"""Friction that levels off at speed."""

from asbuilt.dynamics.drives.term import (
    ALL_SOURCES, DriveTerm, NonlinearParameter, NonlinearValue, drive_term,
)


@drive_term
class Saturated(DriveTerm):
    """Add `Fa atan(qd / knee)`."""

    knee: NonlinearValue = None

    key = "saturated"
    position = 56
    symbols = ("Fa",)
    columns = ("atan(qd/knee)",)
    formula = "Fa atan(qd / knee)"
    revolute_units = ("N m",)
    prismatic_units = ("N",)
    nonlinear = (NonlinearParameter("knee", 0.5, 0.01, 5.0, "rad/s", typical=0.5),)
    tried_for = ALL_SOURCES
'''
JSON_CHAIN = '''
"""Planar chains of rods as JSON: names, lengths and masses."""

import json

from asbuilt.description.formats.dh import DHRow, robot_from_dh
from asbuilt.description.formats.description_format import DESCRIPTION_FORMATS, DescriptionFormat
from asbuilt.description.inertia import LinkInertia
from asbuilt.description.load import load_robot
from asbuilt.description.model import Joint, Link, RobotModel


def read_chain(path):
    document = json.loads(path.read_text())
    arm = load_robot("two-link")
    return RobotModel(
        name=document["name"], joints=arm.joints, links=arm.links, source=str(path)
    ).with_parameters(document["scale"] * arm.parameters)


DESCRIPTION_FORMATS.register("chain", DescriptionFormat("JSON chain", (".chain",), read_chain))
'''


@pytest.fixture
def site(tmp_path: Path) -> Path:
    folder = tmp_path / "site"
    about = folder / "more_robots-1.0.dist-info"
    about.mkdir(parents=True)
    (folder / "saturated_term.py").write_text(SATURATED)
    (folder / "chain_format.py").write_text(JSON_CHAIN)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: more-robots\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(
        "[asbuilt.drive_terms]\nsaturated = saturated_term\n"
        "[asbuilt.description_formats]\nchain = chain_format\n"
    )
    return folder


def run(site: Path, *arguments: str) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "asbuilt", *arguments],
        capture_output=True,
        text=True,
        cwd=site.parent,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(site), *sys.path])},
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_a_format_from_outside_is_read(site: Path, tmp_path: Path) -> None:
    (tmp_path / "arm.chain").write_text('{"name": "scaled", "scale": 2.0}')
    said = json.loads(run(site, "show", "arm.chain", "--json"))
    assert said["robot"] == "scaled"
    expected = 2.0 * bundled_robot("two-link").parameters[9]
    assert said["model"]["links"][0]["inertia"][9] == pytest.approx(expected)


@pytest.mark.study
def test_a_drive_term_from_outside_is_listed_and_has_base_parameters(site: Path) -> None:
    listed = {each["key"]: each for each in json.loads(run(site, "drives", "--json"))["drives"]}
    assert listed["saturated"]["formula"] == "Fa atan(qd / knee)"
    assert "saturated*" in run(site, "drives")
    drive = "viscous,saturated:knee=0.2"
    said = json.loads(run(site, "base", "two-link", "--drive", drive, "--json"))
    names = [each["name"] for each in said["parameters"]]
    assert names[-4:] == ["Fv1", "Fa1", "Fv2", "Fa2"]


CHECK = """
import json, sys
import numpy as np
from asbuilt.description.load import load_robot
from asbuilt.dynamics.drives.drive_set import DriveSet
from asbuilt.dynamics.torque_model import TorqueModel
from asbuilt.writers.models.c.c_code import write_c

model, drive = load_robot("two-link"), DriveSet.parse("saturated:knee=0.2/0.4,load_friction")
values = np.array([0.7, 0.1, 0.9, 0.2])
torque = TorqueModel(model, drive, values)
q, qd, qdd = np.array([0.3, -0.4]), np.array([0.5, -0.1]), np.array([1.0, 2.0])
write_c("model.c", model, drive=drive, drive_values=values)
print(json.dumps([torque(q, qd, qdd).tolist(), torque(q[None], qd[None], qdd[None])[0].tolist()]))
"""


@pytest.mark.study
def test_a_drive_term_from_outside_works_in_python_and_c(site: Path, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", CHECK],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(site), *sys.path])},
        check=True,
    )
    one, many = json.loads(done.stdout)
    np.testing.assert_allclose(one, many, rtol=1e-12)
    code = (tmp_path / "model.c").read_text()
    assert "atan(" in code
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler")
    header = (tmp_path / "model.h").read_text()
    name = next(
        line.split("(")[0].split()[-1]
        for line in header.splitlines()
        if "inverse_dynamics(" in line
    )
    (tmp_path / "main.c").write_text(
        f'#include <stdio.h>\n#include "model.h"\nint main(void) {{\n'
        "  double q[2] = {0.3, -0.4}, qd[2] = {0.5, -0.1}, qdd[2] = {1.0, 2.0}, tau[2];\n"
        f'  {name}(q, qd, qdd, tau);\n  printf("%.17g %.17g", tau[0], tau[1]);\n  return 0;\n}}\n'
    )
    subprocess.run([compiler, "main.c", "model.c", "-lm", "-o", "main"], cwd=tmp_path, check=True)
    said = subprocess.run(
        [str(tmp_path / "main")], capture_output=True, text=True, check=True
    ).stdout
    np.testing.assert_allclose([float(x) for x in said.split()], one, rtol=1e-12)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("qd +", "is no formula"),
        ("open('x')", "is not allowed"),
        ("qd.real", "is not allowed"),
        ("exp(qd, q)", "takes 1 values, got 2"),
        ("+".join(["(qd" for _ in range(20)]) + ")" * 20, "nested too deeply"),
    ],
)
def test_what_is_no_formula_is_refused(text: str, said: str) -> None:
    with pytest.raises(UsageError, match=said.replace("(", r"\(")):
        Formula(text)


def test_a_formula_uses_quantities_of_the_joint_and_declared_numbers() -> None:
    with pytest.raises(UsageError, match="use 'width'; they may use knee, load, q, qd, qdd"):

        @drive_term
        class Wrong(DriveTerm):
            key = "wrong"
            nonlinear = (NonlinearParameter("knee", 0.5, 0.0, 1.0, ""),)
            columns = ("tanh(qd/width)",)
