"""Masses from a scale: read from text, kept by the fit and by the robot as built."""

import numpy as np
import pytest

from asbuilt import StudyOptions, identify, load_robot, simulate_recording
from asbuilt.errors import UsageError
from asbuilt.excitation import random_fourier
from asbuilt.identification import IdentificationResult, as_built_parameters, build_cad_prior
from asbuilt.identification.bodies.body_bounds import bound_known_masses, bound_widely
from asbuilt.identification.bodies.known_masses import (
    limits_from_text,
    link_masses_from_text,
    total_mass_from_text,
    with_known_masses,
)


def masses(result):
    return as_built_parameters(result).parameters[9 : 10 * result.model.n_joints : 10]


@pytest.fixture(scope="module")
def arm():
    return load_robot("kuka-iiwa7-r800")


@pytest.fixture(scope="module")
def log(arm):
    motion = random_fourier(arm, rng=1, duration=10.0)
    return simulate_recording(arm, motion, rate=200.0, rng=1)


@pytest.mark.parametrize(
    ("text", "limits"),
    [
        ("18.5+-0.5", (18.0, 19.0)),
        ("18.5 +/- 0.5", (18.0, 19.0)),
        ("18.5±0.5", (18.0, 19.0)),
        ("<= 3", (0.0, 3.0)),
        (">=1e-2", (0.01, np.inf)),
        ("0.1+-0.2", (0.0, pytest.approx(0.3))),
    ],
)
def test_limits_are_read(text, limits):
    assert limits_from_text(text) == limits


@pytest.mark.parametrize(
    "text", ["", "18", "18+-0", "-3+-1", "<=0", "18+-nan", "1e999+-1", "18+-1kg", "=3", "3+-1+-1"]
)
def test_other_texts_are_refused_with_an_example(text):
    with pytest.raises(UsageError, match=r"known mass.*18\.6"):
        limits_from_text(text)


@pytest.mark.parametrize("text", ["18+-1,5", "18+-1,root=", "18+-1,base=3", "18+-1,root=30"])
def test_a_wrong_root_mass_is_refused(text):
    with pytest.raises(UsageError, match="root"):
        total_mass_from_text(text)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "NAME=KG"),
        ("hand", "NAME=KG"),
        ("hand=3", "KG\\+-KG"),
        ("hand<=2,hand>=3", "contradict"),
        ("hand=1+-0.1,", "NAME=KG"),
    ],
)
def test_wrong_link_masses_are_refused(text, said):
    with pytest.raises(UsageError, match=said):
        link_masses_from_text(text)


def test_masses_of_links_must_exist_and_agree_with_the_total(arm):
    with pytest.raises(UsageError, match="no moving link 'hand'"):
        with_known_masses(arm, None, {"hand": (1.0, 2.0)})
    with pytest.raises(UsageError, match="contradict"):
        with_known_masses(arm, (1.0, 2.0), {arm.link_names[0]: (3.0, 4.0)})


@pytest.mark.parametrize("method", ["auto", "entropic", "wls"])
@pytest.mark.study
def test_the_robot_as_built_has_the_weighed_mass(arm, log, method):
    """What torques leave open follows the scale, also where CAD is outside the limits."""
    cad = sum(link.inertia.mass for link in arm.links)
    options = StudyOptions(
        method=method,
        total_mass=f"{1.1 * cad}+-0.01",
        link_mass=f"{arm.link_names[0]}<={0.9 * arm.links[0].inertia.mass}",
    )
    result = identify(arm, log, options=options).result
    found = masses(result)
    assert found.sum() == pytest.approx(1.1 * cad, abs=0.0101)
    assert found[0] <= 0.9 * arm.links[0].inertia.mass * (1.0 + 1e-5)
    assert any("7 links together" in note for note in result.notes)
    again = IdentificationResult.from_json(result.to_json())
    np.testing.assert_allclose(masses(again), found, rtol=1e-9)


@pytest.mark.study
def test_limits_far_from_cad_hold(arm, log):
    """Known masses replace the wide bounds of their links, which begin at 0.05 of CAD."""
    limits = dict.fromkeys(arm.link_names[:2], (0.0, 0.02))
    result = identify(arm, log, options=StudyOptions(method="entropic", link_mass=limits)).result
    assert np.all(masses(result)[:2] <= 0.0201)
    prior = build_cad_prior(result.model, result.base.drive)
    assert bound_known_masses(prior).labels == ("m1 <= 0.02 kg (given)", "m2 <= 0.02 kg (given)")
    assert not any(label.startswith(("m1", "m2")) for label in bound_widely(prior).labels)


@pytest.mark.study
def test_a_bound_that_the_fit_reaches_is_kept_by_the_robot_as_built(arm):
    """A tilt that nothing describes drives the consistent fit to the edge of wide bounds."""
    motion = random_fourier(arm, rng=2, duration=10.0)
    tilted = arm.with_gravity([2.5, -1.5, -9.4])
    log = simulate_recording(tilted, motion, rng=2)
    result = identify(arm, log, options=StudyOptions(method="consistent", checked=False)).result
    assert any("active of" in note and "active of 0" not in note for note in result.notes)
    prior = build_cad_prior(arm, result.base.drive)
    chi = as_built_parameters(result).parameters
    assert bound_widely(prior).slack(chi).min() >= -1e-5
