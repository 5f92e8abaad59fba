"""Virtual robots with known causes: the attribution must name them, their sizes and no others."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from itertools import pairwise, permutations
from pathlib import Path

import numpy as np
import pytest
from virtual_causes import identified

from asbuilt.description.load import load_robot
from asbuilt.errors import ResultError
from asbuilt.identification.result.result import IdentificationResult
from asbuilt.validation.attribution.attribution import attribute
from asbuilt.validation.attribution.causes import BEFORE, CAUSES, shapley_values
from asbuilt.writers.figures.comparison_figures import attribution_figure
from asbuilt.writers.tables.tabular import json_text

ARM = "kuka-iiwa7-r800"


@pytest.mark.parametrize(
    ("causes", "named"),
    [
        ("p", {"payload"}),
        ("f", {"friction"}),
        ("t", {"mounting"}),
        ("g", {"gain"}),
        ("l", {"links"}),
        ("pf", {"payload", "friction"}),
        ("ft", {"friction", "mounting"}),
        ("fg", {"friction", "gain"}),
        ("pt", {"payload", "mounting"}),
    ],
)
def test_the_true_causes_are_named_and_no_others(causes: str, named: set[str]) -> None:
    found = attribute(identified(ARM, causes))
    assert set(found.chosen) == named
    np.testing.assert_allclose(
        sum(each.share for each in found.shares) + found.unexplained, 1.0, atol=1e-9
    )
    told = found.rms_cad > 0.3
    assert np.all(found.unexplained[told] < 0.05)
    missing = {
        CAUSES[cause]
        for cause in set(CAUSES) - named - ({"payload"} if "links" in named else set())
    }
    assert all(
        any(cause in line for line in found.findings if line.startswith("Not needed"))
        for cause in missing
    )


def test_a_robot_as_designed_needs_no_cause() -> None:
    found = attribute(identified(ARM, ""))
    assert found.chosen == ()
    assert found.shares == ()
    assert all(line.endswith("no cause explains it.") for line in found.sentences)


def test_too_few_independent_samples_are_said_to_be_too_few() -> None:
    """The same errors, worth as many samples as nothing can be told from.

    Neither is a cause named nor is any said to be needless.
    """
    result = identified(ARM, "pf")
    found = attribute(replace(result, effective_samples=0.5))
    assert found.chosen == ()
    assert all(
        line.endswith("too few validation samples to attribute it.") for line in found.sentences
    )
    (said,) = found.findings
    assert "validate on a recording of its own" in said
    assert CAUSES["friction"] in said


@pytest.mark.study
def test_sizes_are_those_of_the_causes() -> None:
    said = " ".join(attribute(identified(ARM, "p")).findings)
    assert "carries 1.9" in said
    assert "(20, 0, 80) mm" in said.replace("-0", "0")
    tilt = attribute(identified(ARM, "t")).values
    np.testing.assert_allclose(np.rad2deg([tilt["tilt 1"], tilt["tilt 2"]]), [1.0, -0.5], atol=0.05)
    gains = attribute(identified(ARM, "g")).values
    np.testing.assert_allclose([gains["gain 2"], gains["gain 4"]], [0.1, -0.1], atol=0.01)
    friction = attribute(identified(ARM, "f"))
    np.testing.assert_allclose([friction.values[f"Fc{k}"] for k in range(1, 8)], 2.0, atol=0.05)
    assert "Coulomb 2.0 N m" in friction.sentences[0]


def test_friction_is_told_in_plain_numbers_whatever_terms_the_result_has() -> None:
    """A power of velocity in place of viscous friction at joint 1.

    The sentence still says Coulomb and viscous, not one large Coulomb.
    """
    found = attribute(
        identified(
            ARM, "f", drive="viscous:joints=2/3/4/5/6/7,coulomb,offset,power:joints=1:exponent=0.7"
        )
    )
    for k in (0, 1):
        numbers = re.search(
            r"friction \(Coulomb ([\d.]+) N m, viscous ([\d.]+) N m s/rad\)", found.sentences[k]
        )
        assert numbers is not None, found.sentences[k]
        np.testing.assert_allclose(
            [float(number) for number in numbers.groups()], [2.0, 1.0], atol=0.1
        )


def test_shares_are_those_of_the_torques_of_the_causes_and_half_of_what_they_have_in_common() -> (
    None
):
    both, one, other = (attribute(identified(ARM, causes)) for causes in ("pf", "p", "f"))
    share = {each.cause: each.share for each in both.shares}
    energy = both.rms_cad**2
    crossed = (energy - one.rms_cad**2 - other.rms_cad**2) / 2.0
    for cause, alone in (("payload", one), ("friction", other)):
        np.testing.assert_allclose(share[cause], (alone.rms_cad**2 + crossed) / energy, atol=0.02)


def test_a_payload_hidden_in_wrong_links_is_offered_as_part_of_them() -> None:
    found = attribute(identified(ARM, "pfl"))
    assert set(found.chosen) == {"friction", "links"}
    assert "payload" in found.weighed
    assert any("cannot separate the two" in line for line in found.findings)
    assert any(
        "A payload is ruled out" in line for line in attribute(identified(ARM, "l")).findings
    )


@pytest.mark.parametrize("robot", ["puma-560", "scara"])
def test_other_robots(robot: str) -> None:
    found = attribute(identified(robot, "f"))
    assert found.chosen == ("friction",)


def test_a_single_hinge_says_nothing_of_masses_at_its_flange(tmp_path: Path) -> None:
    """Their mass makes no torque there, so that neither a payload nor its absence is claimed."""
    urdf = tmp_path / "door.urdf"
    urdf.write_text(
        '<robot name="door"><link name="wall"/><link name="wing"><inertial><origin xyz="0.3 0'
        ' 0.5"/><mass value="4"/><inertia ixx="0.4" ixy="0" ixz="0" iyy="0.5" iyz="0"'
        ' izz="0.2"/></inertial></link><joint name="hinge" type="revolute"><parent'
        ' link="wall"/><child link="wing"/><axis xyz="0 1 0"/><limit lower="-2" upper="2"'
        ' velocity="2" effort="50"/></joint></robot>'
    )
    found = attribute(identified(str(urdf), "fl"))
    assert {"friction", "links"} <= set(found.chosen)
    assert not any("payload" in line or "flange" in line for line in found.findings)


def test_shapley_values_are_means_over_the_orders() -> None:
    rng = np.random.default_rng(0)
    causes = ("friction", "richer friction", "payload", "links", "gain")
    table: dict[frozenset[str], np.ndarray] = {}

    def worth(some: frozenset[str]) -> np.ndarray:
        return table.setdefault(some, rng.normal(size=2))

    values = shapley_values(causes, worth)
    orders = [
        order
        for order in permutations(causes)
        if all(
            order.index(BEFORE[cause]) < order.index(cause) for cause in causes if cause in BEFORE
        )
    ]
    for cause in causes:
        gains = [
            worth(frozenset(order[: order.index(cause) + 1]))
            - worth(frozenset(order[: order.index(cause)]))
            for order in orders
        ]
        np.testing.assert_allclose(values[cause], np.mean(gains, axis=0))


def test_nested_models_never_fit_worse_and_judge_on_held_out_data() -> None:
    found = attribute(identified(ARM, "pf"))
    fitted = np.array([np.sum(step.rms_fitted**2) for step in found.steps])
    assert found.steps[0].cause == "CAD"
    assert [step.cause for step in found.steps[1:]] == list(CAUSES)
    assert fitted[-1] < 0.01 * fitted[0]
    by_cause = {step.cause: step for step in found.steps}
    assert by_cause["payload"].probability < 1e-6
    assert by_cause["gain"].probability > 1e-3
    np.testing.assert_allclose(found.rms_cad, found.steps[0].rms)


def test_what_comes_later_does_not_hide_a_step() -> None:
    """Little friction beside a payload that makes far more torque and is taken up after it.

    Each step is tested against what the whole leaves.
    """
    found = attribute(identified(ARM, "pf", friction=(0.1, 0.15)))
    steps = {step.cause: step for step in found.steps}
    drop = {
        cause: np.sum(before.rms_fitted**2 - now.rms_fitted**2)
        for before, now in pairwise(found.steps)
        for cause in [now.cause]
    }
    assert drop["friction"] < 0.2 * drop["payload"]
    assert steps["friction"].probability < 1e-6
    assert steps["mounting"].probability > 1e-3


def test_every_step_has_more_parameters() -> None:
    """Gains of joints whose torque CAD hardly knows, and friction that would be negative, are
    counted all the same.
    """
    still = identified(ARM, "p")
    model = still.model
    feather = model.with_parameters(
        np.where(np.arange(model.parameters.size) >= 20, 1e-4, 1.0).reshape(model.parameters.shape)
        * model.parameters
    )
    for cad in (None, feather):
        counts = [step.parameters for step in attribute(still, cad).steps]
        assert np.all(np.diff(counts) > 0), counts


def test_another_description_is_attributed_too() -> None:
    model = load_robot(ARM)
    heavier = model.with_parameters(1.1 * model.parameters)
    found = attribute(identified(ARM, "f"), heavier)
    assert {"friction"} < set(found.chosen)
    assert found.rms_cad[1] > 3.0 * attribute(identified(ARM, "f")).rms_cad[1]


def test_evidence_survives_json_and_its_absence_is_said() -> None:
    result = identified(ARM, "pf")
    again = IdentificationResult.from_json(result.to_json())
    assert json.loads(json_text(attribute(again).as_document())) == json.loads(
        json_text(attribute(result).as_document())
    )
    with pytest.raises(ResultError, match="identify again"):
        attribute(replace(result, cause_data=None))
    damaged = json.loads(result.to_json())
    damaged["cause_data"]["fitted"][0] = "AAAA"
    with pytest.raises(ResultError, match="identify again"):
        IdentificationResult.from_json(json.dumps(damaged))


def test_text_tables_and_figure() -> None:
    found = attribute(identified(ARM, "pf"))
    text = found.as_text(full=True)
    assert "% of the squared error is payload (1.9 kg)" in text
    assert "unexplained" in text
    assert all(line == line.rstrip() for line in text.splitlines())
    huge = np.zeros(7)
    huge[:2] = 9.0, -8.0
    beyond = replace(
        found,
        shares=(*found.shares[1:], replace(found.shares[0], share=huge)),
        unexplained=0 * huge,
    )
    axis = attribution_figure(beyond).axes[0]
    assert axis.get_ylim() == (-300.0, 300.0)
    assert {"\u25b2", "\u25bc"} <= {label.get_text()[:1] for label in axis.texts}
    figure = attribution_figure(found)
    heights = {}
    for bars in figure.axes[0].containers:
        heights.setdefault(bars.get_label(), [bar.get_height() for bar in bars])
    np.testing.assert_allclose(
        heights[CAUSES["payload"]], 100 * np.maximum(found.shares[1].share, 0.0)
    )
