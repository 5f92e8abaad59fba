"""A family of motions and a program format of another distribution run from the command line."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from asbuilt.description import bundled_robot
from asbuilt.excitation import read_motion

MIRRORED = """
from dataclasses import dataclass

import numpy as np

from asbuilt.excitation.motions.bspline import BSplineMotion
from asbuilt.excitation.motions.parametrisation import PARAMETRISATIONS, Parametrisation


@dataclass(frozen=True)
class Mirrored(Parametrisation):
    '''A B-spline whose control points are the same forward and backward.'''

    key = "mirrored"
    size_name = "free control points"
    density = 1.0

    def _spline(self, coefficients):
        return BSplineMotion(np.vstack([coefficients, coefficients[::-1]]), self.duration)

    def basis(self, t, order):
        return self._spline(np.eye(self.size)).derivative(t, order)

    def motion(self, coefficients):
        return self._spline(coefficients)

    @property
    def shortest_wave(self):
        return self.duration / self.size

    @property
    def constant(self):
        return np.ones(self.size)


PARAMETRISATIONS.register(Mirrored.key, Mirrored)
"""

JSON_FORMAT = """
import json

from asbuilt.apps.programs.format import PROGRAM_FORMATS, ProgramFile, ProgramFormat


class JsonFormat(ProgramFormat):
    key = "json"
    title = "JSON points"
    default_rate = 10.0

    def files(self, request):
        points = request.motion.sample(request.rate).q.tolist()
        return (ProgramFile("program", f"{request.stem}.json", json.dumps(points)),)


PROGRAM_FORMATS.register(JsonFormat.key, JsonFormat())
"""


@pytest.fixture
def site(tmp_path: Path) -> Path:
    folder = tmp_path / "site"
    about = folder / "more_motions-1.0.dist-info"
    about.mkdir(parents=True)
    (folder / "mirrored_motions.py").write_text(MIRRORED)
    (folder / "json_programs.py").write_text(JSON_FORMAT)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: more-motions\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(
        "[asbuilt.motions]\nmirrored = mirrored_motions\n"
        "[asbuilt.program_formats]\njson = json_programs\n"
    )
    return folder


@pytest.mark.apps("programs")
@pytest.mark.study
def test_a_family_and_a_format_from_outside_run_from_the_command_line(
    site: Path, tmp_path: Path
) -> None:
    path = os.pathsep.join([str(site), *sys.path])
    arguments = ["excite", "two-link", "--parametrisation", "mirrored", "--harmonics", "5"]
    arguments += ["--duration", "6", "--starts", "1", "--program", "json"]
    run = subprocess.run(
        [sys.executable, "-m", "asbuilt", *arguments, "--no-report", "--json"],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": path},
        check=False,
    )
    assert run.returncode == 0, run.stdout + run.stderr
    document = json.loads(run.stdout)
    assert (document["parametrisation"], document["size"]) == ("mirrored", 5)
    motion = read_motion(tmp_path / "motion.csv", bundled_robot("two-link"))
    t = np.linspace(0.0, 3.0, 50)
    np.testing.assert_allclose(motion.derivative(t), motion.derivative(6.0 - t), atol=1e-6)
    points = json.loads((tmp_path / document["files"]["json_program"]).read_text())
    np.testing.assert_allclose(points, motion.sample(10.0).q, atol=1e-9)
