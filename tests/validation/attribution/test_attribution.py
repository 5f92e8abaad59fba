"""Virtual robots with known causes: the attribution must name them, their sizes and no others."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from virtual_causes import TOOL, divided, identified, recorded

from asbuilt.codec import format_json
from asbuilt.description import load_robot
from asbuilt.dynamics import inverse_dynamics
from asbuilt.errors import ResultError
from asbuilt.identification import IdentificationResult
from asbuilt.validation import attribute
from asbuilt.writers.figures.comparison_figures import draw_attribution

ARM = "kuka-iiwa7-r800"


@pytest.mark.parametrize(
    ("causes", "named", "found"),
    [
        ("ft", {"friction", "tilt"}, {"tilt"}),
        *(
            pytest.param(causes, named, found, marks=pytest.mark.study)
            for causes, named, found in (
                ("l", {"links"}, set()),
                ("pf", {"payload", "friction"}, set()),
                ("p", {"payload"}, set()),
                ("f", {"friction"}, set()),
                ("t", {"tilt"}, {"tilt"}),
                ("g", set(), {"gain"}),
                ("fg", {"friction"}, {"gain"}),
                ("pt", {"payload", "tilt"}, {"tilt"}),
            )
        ),
    ],
)
def test_the_true_causes_are_named_and_no_others(
    causes: str, named: set[str], found: set[str]
) -> None:
    """Tilts and gains are found by `find_effects`; the model has a tilt, and no gain.

    CAD is the description without the tilt, whose share of its error is that of the tilt.
    """
    given = attribute(identified(ARM, causes))
    assert set(given.chosen) == named
    assert {each.effect for each in given.effects} == found
    assert {each.in_model for each in given.effects} == {each == "tilt" for each in found}
    if named:
        shares = sum(each.share for each in given.shares)
        np.testing.assert_allclose(shares + given.unexplained, 1.0, atol=1e-9)
        seen = given.rms_cad > 0.3
        assert np.all(given.unexplained[seen] < (0.5 if "g" in causes else 0.05))


def test_a_robot_as_designed_needs_no_cause() -> None:
    found = attribute(identified(ARM, ""))
    assert found.chosen == ()
    assert found.payload is None
    assert all("nothing explains" in line for line in found.sentences)


@pytest.mark.study
def test_an_effect_has_one_number_in_findings_and_sections() -> None:
    result = identified(ARM, "pt")
    found = attribute(result)
    (tilt,) = result.effects
    assert tilt.text in " ".join(found.findings)
    assert found.payload is not None
    assert found.payload.text in found.findings[0]
    (share,) = [each for each in found.shares if each.effect == "payload"]
    # Torques do not determine a payload apart from its link: it has an interval, no error.
    assert found.payload.std_error is None
    assert found.payload.feasible is not None
    least, greatest = found.payload.feasible
    assert least <= found.payload.estimate <= greatest
    interval, _, chosen = share.sizes[1].partition(" kg, chosen ")
    assert [float(end) for end in interval.split(" to ")] == pytest.approx(
        found.payload.feasible, rel=5e-3
    )
    assert float(chosen) == pytest.approx(found.payload.estimate, rel=5e-3)


def test_the_sign_of_a_tilt_is_that_of_the_world() -> None:
    """Base turned by +1 and -0.5 degrees: gravity in the base turns the other way."""
    result = identified(ARM, "t")
    gravity = np.array(result.model.gravity)
    np.testing.assert_allclose(np.rad2deg(gravity[:2] / 9.81), [-0.5, -1.0], atol=0.02)
    assert "(+1.01 about x, -0.50 about y)" in result.effects[0].text


def test_the_error_of_cad_is_that_of_the_description_as_given() -> None:
    """Without the tilt, by inverse dynamics; what the tilt explains is its share."""
    found = attribute(identified(ARM, "t"))
    _, held = divided(recorded(ARM, "t"))
    by_cad = inverse_dynamics(load_robot(ARM), held.q, held.qd, held.qdd)
    error = held.filtered(held.tau - by_cad)
    rms = np.sqrt(np.mean(error**2, axis=0))
    np.testing.assert_allclose(found.rms_cad, rms, rtol=1e-6)
    (tilt,) = [each for each in found.shares if each.effect == "tilt"]
    loaded = rms > 10.0 * found.rms_chosen
    assert loaded.any()
    np.testing.assert_allclose(tilt.share[loaded], 1.0, atol=0.05)


@pytest.mark.study
def test_a_payload_hidden_in_wrong_links_is_not_claimed() -> None:
    """Links off by some 10 % weigh as much as the tool: only where CAD is right it is named."""
    exact = attribute(identified(ARM, "pf")).payload
    assert exact is not None
    assert exact.estimate == pytest.approx(TOOL.mass, abs=0.1)
    assert exact.feasible is not None
    assert exact.feasible[0] <= TOOL.mass <= exact.feasible[1]
    hidden = attribute(identified(ARM, "pfl"))
    assert hidden.payload is None
    assert set(hidden.chosen) == {"links", "friction"}


@pytest.mark.study
def test_sizes_are_those_of_the_causes() -> None:
    payload = attribute(identified(ARM, "p")).payload
    assert payload is not None
    centre = [float(each) for each in re.findall(r"\((.*)\)", payload.text)[0].split(",")]
    np.testing.assert_allclose(centre, [20, 0, 80], atol=2.0)
    gains = identified(ARM, "g").effects
    np.testing.assert_allclose([each.estimate for each in gains], [0.1, -0.1], atol=0.01)
    sentences = attribute(identified(ARM, "f")).sentences
    sizes = [float(str(re.findall(r"Coulomb ([\d.]+)", each)[0])) for each in sentences]
    np.testing.assert_allclose(sizes, 2.0, atol=0.05)


@pytest.mark.study
def test_sizes_are_the_parameters_of_the_result_whatever_terms_it_has() -> None:
    """A power of velocity in place of viscous friction at joint 1."""
    result = identified(
        ARM, "f", drive="viscous:joints=2/3/4/5/6/7,coulomb,offset,power:joints=1:exponent=0.7"
    )
    friction = next(each for each in attribute(result).shares if each.effect == "friction")
    for k, word in enumerate(("power-law", "viscous")):
        value = {each.name: each.estimate for each in result.parameters}
        own = next(v for n, v in value.items() if n.endswith(str(k + 1)) and n[:2] in ("Fv", "Fp"))
        found = re.search(rf"{word} ([\d.]+) ", friction.sizes[k])
        assert found is not None, friction.sizes[k]
        assert float(found.group(1)) == pytest.approx(own, abs=0.02)
        assert "Coulomb" in friction.sizes[k]


@pytest.mark.study
def test_shares_are_those_of_the_torques_of_the_causes_and_half_of_what_they_have_in_common() -> (
    None
):
    both, one, other = (attribute(identified(ARM, causes)) for causes in ("pf", "p", "f"))
    share = {each.effect: each.share for each in both.shares}
    energy = both.rms_cad**2
    crossed = (energy - one.rms_cad**2 - other.rms_cad**2) / 2.0
    for cause, alone in (("payload", one), ("friction", other)):
        np.testing.assert_allclose(share[cause], (alone.rms_cad**2 + crossed) / energy, atol=0.02)


@pytest.mark.parametrize("robot", [pytest.param("puma-560", marks=pytest.mark.study), "scara"])
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
    assert found.payload is None
    assert not any("carries" in line for line in found.findings)


def test_another_description_is_attributed_too() -> None:
    model = load_robot(ARM)
    heavier = model.with_parameters(1.1 * model.parameters)
    found = attribute(identified(ARM, "f"), heavier)
    assert {"friction"} < set(found.chosen)
    assert found.rms_cad[1] > 3.0 * attribute(identified(ARM, "f")).rms_cad[1]


def test_evidence_survives_json_and_its_absence_is_said() -> None:
    result = identified(ARM, "pf")
    again = IdentificationResult.from_json(result.to_json())
    assert json.loads(format_json(attribute(again).as_document())) == json.loads(
        format_json(attribute(result).as_document())
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
    assert re.search(r"% of the squared error is payload \(0 to [\d.]+\s+kg,\s+chosen\s+1\.9", text)
    assert "unexplained" in text
    assert all(line == line.rstrip() for line in text.splitlines())
    huge = np.zeros(7)
    huge[:2] = 9.0, -8.0
    beyond = replace(
        found,
        shares=(*found.shares[1:], replace(found.shares[0], share=huge)),
        unexplained=0 * huge,
    )
    axis = draw_attribution(beyond).axes[0]
    assert axis.get_ylim() == (-300.0, 300.0)
    assert {"\u25b2", "\u25bc"} <= {label.get_text()[:1] for label in axis.texts}
    figure = draw_attribution(found)
    heights = {}
    for bars in figure.axes[0].containers:
        heights.setdefault(bars.get_label(), [bar.get_height() for bar in bars])
    np.testing.assert_allclose(
        heights[found.shares[0].effect], 100 * np.maximum(found.shares[0].share, 0.0)
    )
