"""Names from strangers in every controller program: its code is that of plain names."""

from __future__ import annotations

import ast
import re
import tomllib
from dataclasses import replace
from xml.etree import ElementTree

import pytest
import yaml

from asbuilt import make_program
from asbuilt.apps.programs.format import PROGRAM_FORMATS, ProgramFile
from asbuilt.description import RobotModel, bundled_robot
from asbuilt.excitation import QuinticMotion
from studied_cases import first_of

ROBOTS = {"franka": "franka-panda", "sunrise": "kuka-iiwa7-r800", "fri": "kuka-iiwa7-r800",
          "urscript": "ur10e", "ros2": "ur10e", "csv": "ur10e"}  # fmt: skip
HOSTILE = [
    '";system("reboot");//', "'; import os; os.abort() #", '"""\nimport os\n"""', "*/ int x; /*",
    "\n#include </etc/passwd>", "\\", "a\\\n", "??/", "??/\nint x;", "\\u000a evil(); //",
    "\r\nend\n",
    "%s%n%x", "{{ 7 * 7 }}", "{% raise %}", "${x}", "$(reboot)`id`", "\x00\x1b[2J\x07",
    "\u2028x\u2029",
    "\u202eevil", "*\uff0f int y; \uff0f*", "＂; halt", "名前", "\U0001f916", "x" * 10_000,
    "--> <x/>",
    "]]> &lt;", "- a: !!python/object/apply:os.abort []", "a: b #", "=cmd|' /C calc'!A0", "\ud800",
    "true", "1e5", "~", "", " ", "\t", "' or 1=1", "-", "run---1", "/*/", "*//*", "\v\f\x85",
]  # fmt: skip
COMMENTS = {
    ".cpp": r"/\*.*?\*/|//[^\n]*",
    ".java": r"/\*.*?\*/|//[^\n]*",
    ".script": r"#[^\n]*",
    ".xml": r"<!--.*?-->",
}
TEXT = r'"(?:[^"\\\n]|\\.)*"'


def made(form: str, name: str) -> tuple[RobotModel, tuple[ProgramFile, ...]]:
    """The program of a robot whose every name is this one, numbered."""
    plain = bundled_robot(ROBOTS[form])
    joints = tuple(replace(each, name=f"{name}{k}") for k, each in enumerate(plain.joints))
    links = tuple(replace(each, name=f"{name}{k}") for k, each in enumerate(plain.links))
    model = replace(plain, name=name, joints=joints, links=links, notes=(name,), source=name)
    start = [0.2, -0.2, 0.2, -1.7, 0.2, 0.5, -0.2][: model.n_joints]
    end = [each + 0.1 for each in start]
    motion = QuinticMotion.through([start, end, start], [0.0, 3.0, 6.0])
    return model, make_program(
        model, motion, form, name=name, rate=50.0 if form in ("csv", "ros2") else None
    )


def code_of(file: ProgramFile) -> str:
    """What of a file runs: without comments, and texts replaced by their place."""
    suffix = "." + file.name.rpartition(".")[2]
    if suffix == ".py":
        tree = ast.parse(file.text)
        for node in ast.walk(tree):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                node.value = ""
        return ast.dump(tree)
    found = re.compile(f"({COMMENTS.get(suffix, '(?!)')})|({TEXT})", re.DOTALL)
    code = found.sub(lambda match: "" if match[1] else '""', file.text)
    code = re.sub(r"[A-Za-z0-9_]*(?:Excitation|Hold)\b|asbuilt_\w+|namespace \w+", "NAME", code)
    return " ".join(code.split())


@pytest.mark.parametrize("form", sorted(PROGRAM_FORMATS))
def test_every_format_is_tried(form: str) -> None:
    assert form in ROBOTS


@pytest.mark.parametrize(
    "form",
    first_of(
        1,
        [
            pytest.param(
                each, marks=[pytest.mark.study] if each in ("csv", "franka", "fri", "ros2") else []
            )
            for each in sorted(ROBOTS)
        ],
    ),
)
def test_the_code_is_that_of_plain_names(form: str) -> None:
    _, plain = made(form, "arm")
    for name in HOSTILE:
        model, files = made(form, name)
        assert [each.role for each in files] == [each.role for each in plain]
        for file, other in zip(files, plain, strict=True):
            assert re.fullmatch(r"[A-Za-z0-9_.-]{1,90}", file.name), file.name
            suffix = file.name.rpartition(".")[2]
            if suffix == "xml":
                ElementTree.fromstring(file.text)
            if suffix == "toml":
                assert tomllib.loads(file.text)["joints"] == list(model.joint_names)
            elif suffix in ("yaml", "yml"):
                head, points = file.text.split("\npoints:")
                assert yaml.safe_load(head) == {"joint_names": list(model.joint_names)}
                assert points == other.text.split("\npoints:")[1]
            elif suffix not in ("csv", "txt"):
                assert "\0" not in file.text
                assert code_of(file) == code_of(other), (file.name, repr(name[:40]))
