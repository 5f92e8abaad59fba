"""Examples and notebooks import asbuilt only, run from an empty folder, and hold what they say."""

from __future__ import annotations

import ast
import json
import re
import runpy
import sys
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pytest

import asbuilt

pytestmark = pytest.mark.apps(
    *("estimators", "fleet", "masses", "page", "paper", "programs", "simulators", "watch")
)
"""The documentation and the examples are of the whole distribution."""

HOUSE = Path(__file__).resolve().parents[1]
EXAMPLES = sorted((HOUSE / "examples").glob("[0-9]*.py"))
NOTEBOOKS = sorted((HOUSE / "docs" / "notebooks").glob("*.ipynb"))


def imports_of(nodes: list[ast.AST]) -> set[str]:
    imported = {
        alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names
    }
    return imported | {str(node.module) for node in nodes if isinstance(node, ast.ImportFrom)}


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_example_uses_public_names_and_asserts(example: Path) -> None:
    nodes = [*ast.walk(ast.parse(example.read_text(encoding="utf-8")))]
    imported = imports_of(nodes)
    assert {name for name in imported if name.startswith("asbuilt")} == {"asbuilt"}
    assert imported <= {"asbuilt", "numpy"} | sys.stdlib_module_names
    assert any(isinstance(node, ast.Assert) for node in nodes)


@pytest.mark.slow
@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
@pytest.mark.study
def test_example_runs(
    example: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(example), run_name="__main__")
    assert capsys.readouterr().out.strip()


@pytest.mark.study
def test_the_lines_that_run_an_exported_servo_arm_follow_its_episode(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The page's own lines, in MuJoCo alone: within a milliradian on commands."""
    pytest.importorskip("mujoco")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["10_record_an_episode.py", "--out", "episode.csv"])
    runpy.run_path(str(HOUSE / "examples" / "10_record_an_episode.py"), run_name="__main__")
    options = {"kp": 17.8, "torque_limit": 3.35}
    study = asbuilt.identify("so-101", "episode.csv", **options)
    asbuilt.write_study("study", study)
    asbuilt.export_result(study.result, mjcf="so101.xml")
    page = (HOUSE / "docs" / "how-to" / "so-101.md").read_text(encoding="utf-8")
    lines = re.findall(r"^```py\n(.*?)^```", page, re.DOTALL | re.MULTILINE)[0]
    capsys.readouterr()
    exec(compile(lines, "so-101.md", "exec"), {})
    assert float(capsys.readouterr().out.split()[0]) < 1.0


def cells_of(notebook: Path) -> list[str]:
    """Return the code cells of a notebook, which is kept without outputs."""
    cells = [
        cell for cell in json.loads(notebook.read_text())["cells"] if cell["cell_type"] == "code"
    ]
    assert not any(cell["outputs"] for cell in cells), "clear the outputs; make docs runs it"
    return ["".join(cell["source"]) for cell in cells]


def run_cells(notebook: Path) -> dict[str, Any]:
    names: dict[str, Any] = {"__name__": notebook.stem}
    for source in cells_of(notebook):
        exec(compile(source, notebook.name, "exec"), names)
    return names


@pytest.fixture
def drawn_nowhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    plt.switch_backend("agg")


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_uses_public_names(notebook: Path) -> None:
    imported = imports_of([*ast.walk(ast.parse("\n".join(cells_of(notebook))))])
    others = {"numpy", "polars", "mujoco", "matplotlib.pyplot"}
    assert imported <= {"asbuilt"} | others | sys.stdlib_module_names


@pytest.mark.study
@pytest.mark.usefixtures("drawn_nowhere")
def test_first_notebook_predicts_another_motion() -> None:
    study = run_cells(HOUSE / "docs" / "notebooks" / "first-model.ipynb")["study"]
    assert study.verdict.use == "yes"
    assert study.result.validation[0].relative_error < 0.1 * study.result.cad.relative_error
    assert {path.name for path in Path().iterdir()} >= {"report.html", "ur10e_as_built.xml"}


@pytest.mark.study
@pytest.mark.usefixtures("drawn_nowhere")
def test_notebook_from_lerobot_finds_the_delay_and_simulates() -> None:
    """The servos of the preset are 10 ms late; MuJoCo follows the commands as the robot did."""
    names = run_cells(HOUSE / "docs" / "notebooks" / "lerobot-to-mujoco.ipynb")
    assert names["delay"].estimate == pytest.approx(0.010, abs=0.002)
    assert np.sqrt(np.mean(names["error"] ** 2)) < 0.005
    longest = names["study"].rollouts[-1]
    assert longest.as_built.rms_all < 0.3 * longest.cad.rms_all


@pytest.mark.study
@pytest.mark.usefixtures("drawn_nowhere")
def test_notebook_of_the_payload_weighs_the_camera() -> None:
    names = run_cells(HOUSE / "docs" / "notebooks" / "payload.ipynb")
    payload, camera = names["payload"], names["camera"]
    assert payload.values[:4] == pytest.approx([camera.mass, *camera.com], abs=0.02)
    assert "mass 0.80" in repr(payload)
    assert "<td>com_z</td>" in payload._repr_html_()
