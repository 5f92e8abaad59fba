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
