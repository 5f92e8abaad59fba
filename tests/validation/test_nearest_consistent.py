"""A model in place of the identified one, judged from what the result carries, against predictions
from the samples themselves.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from virtual_causes import identified, recorded

from asbuilt.experiment import SignalChain, hold_out, prepare_samples
from asbuilt.identification import predict_torque
from asbuilt.validation.verdicts.model_errors import compare_with_nearest


def test_errors_are_those_of_predicting_the_samples() -> None:
    result = identified("ur10e", "f")
    train, held = hold_out(prepare_samples(recorded("ur10e", "f"), SignalChain()), "blocks:2s:3")
    other = result.estimates * (1.0 + 0.2 * np.random.default_rng(0).normal(size=result.n_base))
    found = compare_with_nearest(result, other)
    for samples, errors in ((train, found.nearest_fitted), (held, found.nearest)):
        predicted = predict_torque(result.model, result.base, other, samples)
        np.testing.assert_allclose(errors, np.sqrt(np.mean(predicted.error**2, axis=0)), rtol=1e-7)
    predicted = predict_torque(result.model, result.base, result.estimates, held)
    np.testing.assert_allclose(
        found.identified, np.sqrt(np.mean(predicted.error**2, axis=0)), rtol=1e-6
    )
    np.testing.assert_allclose(
        found.torque, np.sqrt(np.mean(predicted.measured**2, axis=0)), rtol=1e-9
    )


def test_the_joint_that_suffers_is_named() -> None:
    result = identified("ur10e", "f")
    place = result.base.names.index("Fc4")
    spoilt = result.estimates.copy()
    spoilt[place] = 0.0
    found = compare_with_nearest(result, spoilt)
    assert found.bad == (3,)
    assert found.objection().startswith(f"{result.joint_names[3]}: ")
    assert not found.worse_than_cad
    assert compare_with_nearest(result, result.estimates).objection() == ""


def test_worse_than_cad_is_said() -> None:
    result = identified("ur10e", "")
    worse = compare_with_nearest(result, 1.02 * np.nan_to_num(result.cad_values))
    assert worse.worse_than_cad
    assert worse.objection()


def test_nothing_is_said_without_evidence() -> None:
    assert (
        compare_with_nearest(
            replace(identified("ur10e", "f"), cause_data=None),
            np.zeros(identified("ur10e", "f").n_base),
        )
        is None
    )


def test_document_and_table() -> None:
    found = compare_with_nearest(identified("ur10e", "f"), identified("ur10e", "f").estimates)
    assert found.as_document()["stand_in"] == pytest.approx(found.identified)
    assert "as written" in found.table().as_text()
