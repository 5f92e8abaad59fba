import csv
import io
import json
from dataclasses import replace
from typing import Any

import numpy as np

from asbuilt.codec import format_json
from asbuilt.validation import compare, validate_samples


def test_differences_are_those_of_the_estimates(example: Any) -> None:
    comparison = compare(example.result)
    for ours, theirs in zip(comparison.parameters, example.result.parameters, strict=True):
        if not theirs.determined:
            assert ours.verdict == "not determined"
        elif np.isnan(theirs.cad):
            assert ours.verdict == "no CAD value"
            assert ours.sigmas is None
        else:
            sigmas = (theirs.estimate - theirs.cad) / theirs.std_error
            assert np.isclose(ours.sigmas, sigmas)
            # As a review has it: a number that is right to a tenth is as claimed.
            off = abs(theirs.estimate - theirs.cad) > 0.1 * abs(theirs.cad)
            assert ours.verdict == ("differs" if ours.false_discovery <= 0.05 and off else "agrees")
    assert 0 < comparison.n_differing <= comparison.n_compared < example.result.n_base


def test_truth_as_cad_does_not_differ(example: Any) -> None:
    truth = example.model.with_parameters(example.truth[:40])
    validation = validate_samples(example.result, example.held_out, cad=truth)
    comparison = compare(example.result, truth, validation)
    assert comparison.n_compared > 0
    assert sum(p.verdict == "differs" and p.name[0] in "Im" for p in comparison.parameters) <= 1
    cad, built = comparison.torque[0]
    assert cad is validation.metrics_cad
    assert built is validation.metrics_as_built


def test_text_csv_and_json_hold_the_same_numbers(example: Any) -> None:
    comparison = compare(
        example.result, validation=validate_samples(example.result, example.held_out)
    )
    text = comparison.as_text()
    assert "DIFFERS" in text
    assert "RMS torque error" in text
    assert all(line == line.rstrip() for line in text.splitlines())
    rows = list(csv.DictReader(io.StringIO(comparison.as_csv())))
    document = json.loads(format_json(comparison.as_document()))
    assert len(rows) == len(document["parameters"]) == example.result.n_base
    for row, entry in zip(rows, document["parameters"], strict=True):
        assert float(row["as built"]) == entry["estimate"]
        assert (float(row["CAD"]) if row["CAD"] else None) == entry["cad"]
    assert document["torque"][0]["cad"]["rms"] == comparison.torque[0][0].rms.tolist()


def test_a_parameter_that_cad_is_silent_on_never_differs(example: Any) -> None:
    silent = tuple(replace(p, cad=float("nan")) for p in example.result.parameters)
    comparison = compare(replace(example.result, parameters=silent))
    assert comparison.n_compared == 0
    assert comparison.verdict().startswith("No parameter has a CAD value.")
