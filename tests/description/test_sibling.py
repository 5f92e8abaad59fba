"""A robot of the same type as built in place of the numbers of a description."""

import json
from dataclasses import replace

import numpy as np
import pytest

from asbuilt import load_robot
from asbuilt.description.sibling import Sibling, read_sibling
from asbuilt.errors import DescriptionError


def built():
    """A robot that differs from its description in every number."""
    model = load_robot("two-link")
    joints = tuple(
        replace(joint, drive=replace(joint.drive, viscous=0.3 + k, coulomb=0.1))
        for k, joint in enumerate(model.joints)
    )
    return replace(model.with_parameters(1.07 * np.array(model.parameters)), joints=joints)


def test_the_numbers_survive_a_file(tmp_path) -> None:
    path = tmp_path / "page.json"
    path.write_text(json.dumps({"letter": "A", "sibling": Sibling.of(built()).as_dict()}))
    found = read_sibling(path).applied(load_robot("two-link"))
    np.testing.assert_array_equal(found.parameters, built().parameters)
    assert [joint.drive.viscous for joint in found.joints] == [0.3, 1.3]
    assert "sibling" in found.notes[-1]


def test_geometry_and_limits_stay_those_of_the_description() -> None:
    model = load_robot("two-link")
    turned = replace(model, gravity=np.array([0.0, 0.0, 9.81]))
    found = Sibling.of(built()).applied(turned)
    np.testing.assert_array_equal(found.gravity, turned.gravity)
    assert [joint.limits for joint in found.joints] == [joint.limits for joint in model.joints]


def test_another_type_is_refused() -> None:
    with pytest.raises(DescriptionError, match="links"):
        Sibling.of(built()).applied(load_robot("scara"))


@pytest.mark.parametrize(
    "damage",
    [
        lambda page: page["links"].clear() or page.pop("links"),
        lambda page: page["links"]["link_1"].pop() if "link_1" in page["links"] else None,
        lambda page: page.update(links={"a": [np.nan] * 10}),
        lambda page: page.update(drives=[1]),
    ],
)
def test_a_damaged_page_is_refused(damage, tmp_path) -> None:
    page = Sibling.of(built()).as_dict()
    first = next(iter(page["links"]))
    page["links"]["link_1"] = page["links"].pop(first)
    damage(page)
    path = tmp_path / "page.json"
    path.write_text(json.dumps(page))
    with pytest.raises(DescriptionError, match=r"page\.json has no robot as built"):
        read_sibling(path)


def test_a_page_without_end_is_refused() -> None:
    with pytest.raises(DescriptionError, match=r"/dev/zero"):
        read_sibling("/dev/zero")


def damaged(tmp_path, change):
    page = Sibling.of(built()).as_dict()
    change(page)
    path = tmp_path / "page.json"
    path.write_text(json.dumps(page))
    return path


def first_link(page):
    return page["links"][next(iter(page["links"]))]


@pytest.mark.parametrize(
    ("place", "value", "said"),
    [
        (9, -1.0, "m of link .* is -1.0"),
        (9, True, "m of link .* is True"),
        (0, 1e70, "Ixx of link .* is 1e"),
        (0, 1e308, "it holds the number 1e"),
        (0, "3", "Ixx of link .* is 3; it must be a number"),
        (0, None, "Ixx of link .* is None"),
        (0, 50.0, "no body has the numbers of link"),
    ],
)
def test_numbers_of_no_body_are_refused(place, value, said, tmp_path) -> None:
    path = damaged(tmp_path, lambda page: first_link(page).__setitem__(place, value))
    with pytest.raises(DescriptionError, match=said):
        read_sibling(path)


@pytest.mark.parametrize("value", [-0.1, True, 1e70, "nan"])
def test_drives_that_are_not_passive_are_refused(value, tmp_path) -> None:
    def change(page):
        page["drives"][next(iter(page["drives"]))]["viscous"] = value

    with pytest.raises(DescriptionError, match="viscous of drive"):
        read_sibling(damaged(tmp_path, change))


def test_zeros_in_place_of_a_mass_are_refused(tmp_path) -> None:
    def change(page):
        page["links"] = {name: [0.0] * 10 for name in page["links"]}

    found = read_sibling(damaged(tmp_path, change))
    with pytest.raises(DescriptionError, match="has zeros for"):
        found.applied(load_robot("two-link"))
