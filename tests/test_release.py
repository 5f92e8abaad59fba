"""The files of a release say the same: version, dependencies, files that they copy."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import yaml

import asbuilt

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
RENAMED = {"matplotlib": "matplotlib-base"}
"""Names on conda-forge; that one brings no windows."""


def test_all_versions_are_the_same() -> None:
    recipe = yaml.safe_load((ROOT / "packaging/conda/recipe.yaml").read_text("utf-8"))
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
    versions = {recipe["context"]["version"], citation["version"], asbuilt.__version__}
    assert versions == {PROJECT["version"]}


def test_the_recipe_has_the_dependencies_of_the_package() -> None:
    recipe = yaml.safe_load((ROOT / "packaging/conda/recipe.yaml").read_text("utf-8"))
    listed = {each.replace(" ", "") for each in recipe["requirements"]["run"]}
    needed = {re.split("[<>=]", each)[0]: each for each in PROJECT["dependencies"]}
    renamed = {each.replace(name, RENAMED.get(name, name)) for name, each in needed.items()}
    assert listed == renamed | {f"python{PROJECT['requires-python']}"}


def test_the_image_copies_what_is_there_and_runs_as_no_root() -> None:
    text = (ROOT / "Dockerfile").read_text("utf-8")
    copied = [word for line in re.findall(r"^COPY (.*) \S+$", text, re.M) for word in line.split()]
    kept = re.findall(r"^!(.*)$", (ROOT / ".dockerignore").read_text("utf-8"), re.M)
    assert sorted(copied) == sorted(kept)
    assert all((ROOT / each).exists() for each in copied)
    assert text.rindex("USER asbuilt") > text.rindex("FROM")


def test_a_release_is_tried_before_it_is_published() -> None:
    jobs = yaml.safe_load((ROOT / ".github/workflows/release.yml").read_text("utf-8"))["jobs"]
    assert (jobs["try"]["needs"], jobs["publish"]["needs"]) == ("build", "try")
    assert jobs["publish"]["permissions"] == {"id-token": "write"}
