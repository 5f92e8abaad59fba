"""The recipes of docs/design/extending.md run as another distribution, from the command line."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from asbuilt.description import bundled_robot
from asbuilt.excitation import random_fourier
from asbuilt.experiment import simulate_recording
from asbuilt.writers import write_recording
from command_line import call_elsewhere

PAGE = Path(__file__).resolve().parents[1] / "docs" / "design" / "extending.md"
RECIPES = dict(
    re.findall(
        r'^```python title="(\w+)\.py"\n(.*?)^```', PAGE.read_text(), re.DOTALL | re.MULTILINE
    )
)
GROUPS = {
    "drive_terms": "saturated_term",
    "effects": "cogging_effect",
    "estimators": "halved_estimator",
    "log_formats": "json_lines_format",
    "motions": "mirrored_motions",
    "program_formats": "json_program",
    "payload_formats": "plain_payload",
    "report_sections": "outside_section",
    "description_formats": "chain_format",
    "simulator_formats": "gains_format",
    "figures": "error_figure",
    "drivers": "mujoco_driver",
}

SEAMS = ("c_observers", "link_shapes", "program_writers")
"""Registries by which the core reaches one app."""


NAMES = ("halved", "ols")
"""Estimators, the first from outside."""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a distribution that has every recipe."""
    folder = tmp_path_factory.mktemp("site")
    about = folder / "recipes-1.0.dist-info"
    about.mkdir()
    for name, text in RECIPES.items():
        (folder / f"{name}.py").write_text(text)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: recipes\nVersion: 1.0\n")
    lines = [f"[asbuilt.{group}]\n{module} = {module}\n" for group, module in GROUPS.items()]
    (about / "entry_points.txt").write_text("".join(lines))
    return folder


@pytest.mark.apps("programs")
def test_there_is_a_recipe_for_every_registry() -> None:
    assert set(RECIPES) == set(GROUPS.values())
    text = PAGE.read_text()
    source = Path(__file__).resolve().parents[1] / "src"
    registry = re.compile(r'Registry\(\s*"[\w ]+",\s*(?:None|"[\w.]+"),\s*"asbuilt\.(\w+)"')
    groups = {name for path in source.rglob("*.py") for name in registry.findall(path.read_text())}
    assert groups == {*GROUPS, *SEAMS}
    assert all(f"`asbuilt.{group}`" in text for group in GROUPS)


def test_term_and_description_format(site: Path, tmp_path: Path) -> None:
    (tmp_path / "arm.chain").write_text('{"name": "heavy", "scale": 2.0}')
    drives, shown = call_elsewhere(tmp_path, site, "drives --json", "show arm.chain --json")
    assert "saturated" in {each["key"] for each in json.loads(drives)["drives"]}
    assert json.loads(shown)["robot"] == "heavy"


def test_figure(site: Path) -> None:
    """The function is found by its entry point, beside those of asbuilt."""
    asked = "from asbuilt.identification.result.result import FIGURES; print(*FIGURES)"
    done = subprocess.run(
        [sys.executable, "-c", asked],
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(site), *sys.path])},
        capture_output=True,
        text=True,
        check=True,
    )
    assert {"errors", "torque", "residuals", "parameters"} <= set(done.stdout.split())


@pytest.mark.study
def test_log_format_estimator_and_section(site: Path, tmp_path: Path) -> None:
    motion = random_fourier(bundled_robot("two-link"), 1, duration=6.0)
    log = simulate_recording(bundled_robot("two-link"), motion, rate=100.0)
    write_recording(tmp_path / "log.csv", log)
    rows = pl.read_csv(tmp_path / "log.csv").to_dicts()
    (tmp_path / "log.jsonl").write_text("\n".join(json.dumps(row) for row in rows))
    *studies, _ = call_elsewhere(
        tmp_path,
        site,
        *(f"identify two-link log.jsonl --method {name} --json --out {name}" for name in NAMES),
        "export ols/result.json --nearest --to gains=gains.txt",
    )
    found = dict(zip(NAMES, map(json.loads, studies), strict=True))
    half, whole = ([p["estimate"] for p in found[name]["parameters"]] for name in found)
    assert [2 * value for value in half] == pytest.approx(whole)
    assert "<h2>From outside</h2>" in (tmp_path / "ols" / "report.html").read_text()
    assert (tmp_path / "gains.txt").read_text().startswith("two-link: 2 joints")


@pytest.mark.study
@pytest.mark.apps("programs")
def test_motions_and_program(site: Path, tmp_path: Path) -> None:
    line = "excite two-link --parametrisation mirrored --harmonics 5 --duration 6 --starts 1"
    (printed,) = call_elsewhere(tmp_path, site, f"{line} --program json --no-report --json")
    found = json.loads(printed)
    assert found["parametrisation"] == "mirrored"
    points = json.loads((tmp_path / found["files"]["json_program"]).read_text())
    assert points[0] == pytest.approx(points[-1])


@pytest.mark.study
def test_effect_from_outside_is_named(site: Path, tmp_path: Path) -> None:
    model = bundled_robot("two-link")
    motion = random_fourier(model, 1, duration=20.0)
    log = simulate_recording(model, motion, rate=200.0, rng=1)
    ripple = np.zeros_like(log.tau)
    ripple[:, 0] = 2.0 * np.sin(12.0 * log.q[:, 0])
    write_recording(tmp_path / "log.csv", replace(log, tau=log.tau + ripple))
    (printed,) = call_elsewhere(
        tmp_path, site, "identify two-link log.csv --cutoff 20 --unchecked --json"
    )
    found = {each["effect"]: each for each in json.loads(printed)["effects"]}
    assert found["cogging"]["joint"] == model.joint_names[0]
    assert found["cogging"]["estimate"] == pytest.approx(2.0, rel=0.1)
    assert not found["cogging"]["in_model"]


@pytest.mark.study
def test_driver_moves_a_simulator_of_its_own(site: Path, tmp_path: Path) -> None:
    """The loop finds what MuJoCo's model has and the description lacks: 1 kg at the second link."""
    call_elsewhere(tmp_path, site, "convert two-link described.xml")
    described = (tmp_path / "described.xml").read_text()
    assert 'mass="5.184"' in described
    (tmp_path / "heavier.xml").write_text(described.replace('mass="5.184"', 'mass="6.184"'))
    (printed,) = call_elsewhere(
        tmp_path, site, "run two-link --on mujoco:heavier.xml --seconds 6 --until 1 --json"
    )
    first, *_, last, summary = map(json.loads, printed.splitlines())
    assert summary["ending"] == "proven"
    assert last["found"] < 0.01 < first["found"]
