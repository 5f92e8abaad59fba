"""Errors keep message, cure and fields through pickling, and name what to install."""

from __future__ import annotations

import pickle
import re
import tomllib
from pathlib import Path

import pytest

from asbuilt.errors import AsbuiltError, MissingExtraError, MotionError, RecordingError
from asbuilt.findings import Cure

PROJECT = tomllib.loads(
    (Path(__file__).resolve().parents[1] / "pyproject.toml").read_text(encoding="utf-8")
)["project"]


def test_fields_are_attributes_and_survive_pickling() -> None:
    error = MotionError("joint A3 leaves its limit", cure=Cure("slow down"), joint="A3", value=7.1)
    for each in (error, pickle.loads(pickle.dumps(error))):
        assert isinstance(each, AsbuiltError)
        assert isinstance(each, ValueError)
        assert (each.joint, each.value) == ("A3", 7.1)
        assert str(each) == "joint A3 leaves its limit; slow down"
    with pytest.raises(AttributeError, match="joint"):
        error.upper  # noqa: B018 - the access itself is tested


@pytest.mark.parametrize("extra", ["sim", "bags", "hdf5", "cad", "view", "rerun"])
def test_a_missing_extra_names_every_package_to_install(extra: str) -> None:
    names = {re.split(r"[<>=\[]", each)[0] for each in PROJECT["optional-dependencies"][extra]}
    text = str(MissingExtraError(min(names), extra, "this"))
    found = re.search(r"run pip install ([^,]+), or pip install 'asbuilt\[(\w+)\]'", text)
    assert found is not None, text
    # Metadata may write a distribution with either separator (PEP 503).
    named = {each.replace("-", ".") for each in found[1].split()}
    assert (named, found[2]) == ({each.replace("-", ".") for each in names}, extra)


def test_the_text_of_an_error_names_the_arguments_that_cure_it() -> None:
    error = RecordingError("the sign is flipped", cure=Cure("flip it", {"flip_torque": True}))
    assert str(error) == "the sign is flipped; flip it (flip_torque=True)"
    assert error.message == "the sign is flipped"
    gains = RecordingError("no gains", cure=Cure("find them", call="find_gains"))
    assert str(gains).endswith("find them (asbuilt.find_gains)")
