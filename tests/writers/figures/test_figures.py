import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from asbuilt.errors import UsageError
from asbuilt.validation import validate_samples
from asbuilt.writers import save_figure, torque_figure


@pytest.fixture(scope="module")
def figures(example: Any) -> dict[str, Figure]:
    return drawn(example)


def drawn(example: Any) -> dict[str, Figure]:
    result = example.result
    v = validate_samples(result, example.held_out)
    return {
        "torque": torque_figure(
            v.t,
            v.measured,
            v.predicted,
            cad=v.predicted_cad,
            joint_names=v.joint_names,
            units=v.units,
            title=v.source,
        ),
    }


@pytest.mark.parametrize(
    "suffix", ["svg", *(pytest.param(x, marks=pytest.mark.study) for x in ("png", "pdf"))]
)
def test_every_figure_saves_in_every_format(example: Any, tmp_path: Path, suffix: str) -> None:
    magic = {"png": b"\x89PNG", "svg": b"<?xml", "pdf": b"%PDF"}[suffix]
    one, two = drawn(example), drawn(example)
    for name in one:
        content = save_figure(one[name], tmp_path / f"{name}.{suffix}", dpi=50).read_bytes()
        assert content.startswith(magic)
        assert content == save_figure(two[name], tmp_path / f"again.{suffix}", dpi=50).read_bytes()


def test_drawn_curves_hold_the_peaks_and_the_gaps(example: Any, figures: dict[str, Figure]) -> None:
    v = validate_samples(example.result, example.held_out)
    for k in range(4):
        measured = figures["torque"].axes[2 * k].lines[0].get_ydata()
        assert np.nanmax(measured) == v.measured[:, k].max()
        assert np.nanmin(measured) == v.measured[:, k].min()
        assert np.count_nonzero(np.isnan(measured)) == len(example.held_out.segments) - 1


def test_torque_axes_are_labelled_with_units_and_share_time(figures: dict[str, Figure]) -> None:
    axes = figures["torque"].axes
    assert "[N m]" in axes[0].get_ylabel()
    assert "[N]" in axes[4].get_ylabel()
    assert axes[-1].get_xlabel() == "time [s]"
    assert len({axis.get_xlim() for axis in axes}) == 1


def test_unknown_suffix_is_refused(figures: dict[str, Figure], tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"expected \.png, \.svg, \.pdf"):
        save_figure(figures["torque"], tmp_path / "x.bmp")


@pytest.mark.study
def test_no_global_figure_is_made() -> None:
    code = (
        "import sys, asbuilt.writers.figures.study_figures;"
        " assert 'matplotlib.pyplot' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
