"""What is absurd about masses and inertias, made by misreading sound robots in known ways."""

from dataclasses import replace

import numpy as np
import pytest

from asbuilt import LinkInertia, load_robot, robot_names
from asbuilt.description import Link, check_plausibility, find_wrong_units
from asbuilt.writers import robot_document, robot_text


def misread(model, mass, inertia, names=None):
    """Return a robot with masses and inertias about the centres of mass times factors."""
    links = []
    for link in model.links:
        body = link.inertia
        if names is None or link.name in names:
            body = LinkInertia.from_com(
                mass * body.mass, body.com, inertia * body.inertia_about_com
            )
        links.append(Link(link.name, body))
    return replace(model, links=tuple(links))


@pytest.mark.parametrize("arm", ["ur10e", "kuka-iiwa7-r800", "two-link"])
@pytest.mark.parametrize(
    ("mass", "inertia", "unit"),
    [(1.0, 1e6, "kg mm^2"), (1e3, 1.0, "g"), (1e3, 1e9, "g and g mm^2"), (1.0, 1e9, "g mm^2")],
)
def test_a_wrong_unit_is_named_with_its_factor(arm, mass, inertia, unit):
    model = load_robot(arm)
    assert find_wrong_units(model) is None
    found = find_wrong_units(misread(model, mass, inertia))
    assert f"as in {unit}:" in found.message
    for factor in {mass, inertia} - {1.0}:
        assert f"{factor:.4g} times too large" in found.message


@pytest.mark.parametrize("link", ["upper_arm_link", "shoulder_link"])
def test_a_mass_with_a_digit_too_many_is_named(link):
    model = load_robot("ur10e")
    name = model.link_names[1 if link == "upper_arm_link" else 0]
    (found,) = check_plausibility(misread(model, 10.0, 1.0, [name]))
    assert (found.code, found.link, found.severity) == ("implausible_density", name, "error")
    assert "its mass 10 times too large" in found.message


def test_the_density_is_a_bound():
    # A solid ball of steel has the density that it has; any other body of steel seems lighter.
    m, r = 7850.0 * 4.0 / 3.0 * np.pi * 0.05**3, 0.05
    ball = LinkInertia.from_com(100 * m, [0.1, 0, 0], 40 * m * r**2 * np.eye(3))
    model = load_robot("two-link")
    heavy = replace(model, links=(Link(model.link_names[0], ball), model.links[1]))
    (found,) = [each for each in check_plausibility(heavy) if each.code == "implausible_density"]
    assert "7.85e+05 kg/m^3" in found.message


def test_what_stands_in_two_slots_is_named():
    model = load_robot("two-link")
    tensor = np.array([[0.03, 0.012, 0], [0.012, 0.012, 0], [0, 0, 0.035]])
    slipped = LinkInertia.from_com(3.0, [0.1, 0, 0], tensor)
    found = check_plausibility(replace(model, links=(Link("a", slipped), model.links[1])))
    assert "Iyy and Ixy about its centre of mass are both 0.012 kg m^2" in found[0].message


def test_lengths_and_centres_in_millimetres_are_named():
    model = load_robot("two-link")
    link = model.links[0]
    far = LinkInertia.from_com(
        link.inertia.mass, 1e3 * link.inertia.com, link.inertia.inertia_about_com
    )
    found = check_plausibility(replace(model, links=(Link(link.name, far), model.links[1])))
    assert found[0].code == "com_outside"
    assert "as in mm" in found[0].message


@pytest.mark.parametrize("name", robot_names())
def test_bundled_robots_are_plausible(name):
    assert not [each for each in check_plausibility(load_robot(name)) if each.severity == "error"]


def test_show_says_so_first_and_in_its_table():
    model = misread(load_robot("ur10e"), 1.0, 1e6)
    said = robot_text(model)
    assert "IMPLAUSIBLE MASS PROPERTIES" in said.splitlines()[0]
    assert " OK" not in said
    document = robot_document(model)
    assert set(document["implausible"]) == set(model.link_names)
    assert document["findings"][0]["code"] == "description_units"
