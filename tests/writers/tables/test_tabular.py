import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from asbuilt.codec import format_json
from asbuilt.dynamics import parameter_values
from asbuilt.validation import validate_samples
from asbuilt.workflow import Study
from asbuilt.writers import base_document, identify_document, validate_document, write_json
from asbuilt.writers.tables.tabular import tabulate_identified, tabulate_prediction

METRICS = {"source", "rms", "max_abs", "r_squared", "relative_error"}


def test_identify_document_has_the_promised_fields(example: Any, tmp_path: Path) -> None:
    promised = {
        "robot", "method", "n_samples", "n_standard", "n_base", "rank", "condition_number",
        "scaled_condition_number", "joints", "parameters", "train", "validation", "cad",
        "physically_consistent", "warnings", "files",
    }  # fmt: skip
    write_json(
        tmp_path / "x.json",
        identify_document(
            Study(example.result, example.result.findings), files={"result": tmp_path / "r.json"}
        ),
    )
    document = json.loads((tmp_path / "x.json").read_text())
    assert promised <= document.keys()
    assert {"id", "name", "expression", "unit", "cad", "estimate", "std_error"} <= document[
        "parameters"
    ][0].keys()
    assert document["train"].keys() >= METRICS
    assert document["cad"].keys() >= METRICS
    assert document["validation"][0].keys() >= METRICS
    assert document["warnings"][0].keys() == {"code", "message"}
    assert document["files"] == {"result": str(tmp_path / "r.json")}
    assert document["n_base"] == len(document["parameters"]) == example.result.n_base


def test_json_never_has_nan(example: Any) -> None:
    parameters = tuple(replace(p, cad=np.nan, std_error=np.inf) for p in example.result.parameters)
    result = replace(example.result, parameters=parameters, condition_number=np.inf)
    text = format_json(identify_document(Study(result, result.findings)))
    document = json.loads(
        text, parse_constant=lambda constant: (_ for _ in ()).throw(AssertionError(constant))
    )
    assert document["parameters"][0]["cad"] is None
    assert document["condition_number"] is None
    assert json.loads(
        format_json(
            {"a": np.array([1.0, np.nan]), "b": np.int64(3), "c": (np.bool_(True), Path("x"))}
        )
    ) == {
        "a": [1.0, None],
        "b": 3,
        "c": [True, "x"],
    }


def test_base_document_has_the_promised_fields(example: Any) -> None:
    base = example.result.base
    document = json.loads(format_json(base_document(base, example.model)))
    assert {"robot", "n_standard", "n_base", "parameters", "standard"} <= document.keys()
    assert (
        document["n_standard"]
        == len(document["standard"])
        == len(parameter_values(example.model, base.drive))
    )
    first = document["parameters"][0]
    assert first.keys() == {"id", "name", "expression", "symbolic", "value", "unit"}
    assert {entry["status"] for entry in document["standard"]} <= {
        "unidentifiable",
        "grouped",
        "identifiable",
    }
    values = base.values(parameter_values(example.model, base.drive))
    assert [entry["value"] for entry in document["parameters"]] == [
        v if np.isfinite(v) else None for v in values.tolist()
    ]
    ids = {entry["id"] for entry in document["parameters"]}
    assert all(set(entry["in"]) <= ids for entry in document["standard"])


def test_parameters_csv_reads_back_to_the_bit(example: Any) -> None:
    rows = list(csv.DictReader(tabulate_identified(example.result).as_csv().splitlines()))
    for row, parameter in zip(rows, example.result.parameters, strict=True):
        assert float(row["estimate"]) == parameter.estimate
        assert float(row["std_error"]) == parameter.std_error
        assert row["expression"] == parameter.expression
        assert (row["cad"] == "") == bool(np.isnan(parameter.cad))


def test_validation_tables(example: Any) -> None:
    validation = validate_samples(example.result, example.held_out)
    document = json.loads(format_json(validate_document(example.result, [validation])))
    assert document["validation"][0]["rms"] == validation.metrics_as_built.rms.tolist()
    predicted = tabulate_prediction(validation)
    assert len(predicted.rows) == len(validation.t)
    assert len(predicted.columns) == 13
