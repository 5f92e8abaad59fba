"""The 2015 paper is reproduced to the digit where it can be, and repeated where it cannot."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from asbuilt.cli.hayat2015 import published
from asbuilt.cli.reproduce import Reproduction, reproduce
from asbuilt.cli.reproduce_tables import (
    reproduction_document,
    reproduction_text,
    write_reproduction,
)
from command_line import documented_fields


@pytest.fixture(scope="module")
def redone() -> Reproduction:
    return reproduce()


def test_bundled_facts_are_the_papers_tables(shared: Path) -> None:
    rows = list(csv.DictReader((shared / "paper" / "table2.csv").open()))
    paper = published()
    assert [row.id for row in paper.parameters] == [int(row["id"]) for row in rows]
    assert [row.expression for row in paper.parameters] == [
        row["expression_corrected"] for row in rows
    ]
    assert [row.printed or row.expression for row in paper.parameters] == [
        row["expression_as_printed"] for row in rows
    ]
    assert paper.cad.tolist() == [float(row["cad"]) for row in rows]
    assert paper.robot.tolist() == [float(row["robot"]) for row in rows]


def test_table_2_is_reproduced(redone: Reproduction) -> None:
    assert redone.ids_equal == redone.n_same_expressions == redone.n_same_values == 43
    off = {
        k
        for k, row in enumerate(redone.parameters, start=1)
        if abs(row.cad_ours - row.cad_printed) > 5e-7
    }
    assert off == {23, 26, 30, 33}
    assert redone.largest_difference < 3.1e-6


def test_identification_from_simulated_motion_gives_the_cad_values(redone: Reproduction) -> None:
    ours = np.array([row.cad_ours for row in redone.parameters])
    np.testing.assert_allclose(
        [row.simulated for row in redone.parameters], ours, rtol=0, atol=1e-9
    )


def test_consistency_of_both_columns_is_as_found_independently(redone: Reproduction) -> None:
    assert redone.cad_margin == pytest.approx(8.4e-4, rel=0.02)
    assert redone.robot_margin == pytest.approx(-0.099, rel=0.02)


def test_printed_alpha_contradicts_table_2(redone: Reproduction) -> None:
    assert 0 < redone.mismatches_with_printed_alpha < 43


def test_table_3_is_repeated_on_a_robot_that_cad_does_not_know(redone: Reproduction) -> None:
    rigid, full = redone.rigid.validations[0], redone.full.validations[0]
    shown = np.array(redone.paper.table3_joints) - 1
    assert np.all(rigid.metrics_as_built.rms[shown] < rigid.metrics_cad.rms[shown])
    assert np.all(full.metrics_as_built.rms < 0.5 * rigid.metrics_as_built.rms)


def test_text_says_what_cannot_be_reproduced_and_files_are_written(
    redone: Reproduction, tmp_path: Path
) -> None:
    text = reproduction_text(redone)
    assert "43 of 43 ids, 43 of 43 expressions and 43 of 43 CAD values" in text
    assert "not public" in text
    files = write_reproduction(tmp_path, redone)
    assert {"text", "table1", "table2", "table3", "figure3", "figure4"} == set(files)
    assert all(path.stat().st_size > 0 for path in files.values())
    document = reproduction_document(redone, files)
    json.dumps(document, allow_nan=False)
    assert set(document) == documented_fields()["reproduce"][0]
