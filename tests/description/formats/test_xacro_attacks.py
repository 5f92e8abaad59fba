"""xacro files of strangers: no expression runs code, reads a foreign file, or leads elsewhere."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from asbuilt.description import load_robot
from asbuilt.description.formats.expansion import BUILTINS, MATH, evaluate
from asbuilt.errors import DescriptionError
from asbuilt.isolation import build_isolated_command

ARM = """<robot name="arm" xmlns:xacro="http://www.ros.org/wiki/xacro">{}
<link name="floor"/><link name="arm"><inertial><mass value="2"/>
<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="j" type="continuous"><axis xyz="0 0 1"/>
<parent link="floor"/><child link="arm"/></joint></robot>"""
FRAMES = (
    "list((g.gi_frame.f_back.f_back.f_builtins['open'](PLACE, 'w').write('x') for g in"
    " [(g.gi_frame for g in [1])]))"
)
WRITING = [
    "[g.gi_frame.f_back.f_globals for g in [(x for x in [1])]]",
    FRAMES,
    "(lambda: 0).__globals__",
    "(lambda f: f)(1)",
    "[].__class__.__base__.__subclasses__()",
    "''.__class__",
    "'{0.__class__}'.format(1)",
    "'%c'.__mod__(1)",
    "f'{1}'",
    "[x for x in [1]]",
    "{x for x in [1]}",
    "(x := 1)",
    "__import__('os').system('touch PLACE')",
    "open(PLACE, 'w')",
    "getattr(1, 'real')",
    "type(1)",
    "vars()",
    "python.type('A', (), {})",
    "python.vars(xacro)",
    "math.__loader__",
    "math.__dict__",
    "xacro.load_yaml.__globals__",
    "load_yaml.func_globals",
    "xacro.process_file('x')",
    "max.__self__",
    "print_location()",
    "max(*[1, 2])",
    "max(**{})",
    "b'1'",
    "1j",
    "x.y",
    "1 << 9",
    "...",
    "yield 1",
    "map.__call__",
    "str.join('a', 'b')",
]
"""Roads that lead out of restrictions of Python, and what else is not on the list."""


def spoilt(folder: Path, text: str, name: str = "arm.xacro") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / name
    path.write_text(ARM.format(text))
    return path


@pytest.mark.parametrize("text", WRITING)
def test_the_evaluator_refuses_what_is_not_listed(text: str) -> None:
    known = {**BUILTINS, **MATH, "math": dict(MATH), "python": dict(BUILTINS), "xacro": {}, "x": 1}
    with pytest.raises((ValueError, SyntaxError, NameError, KeyError, TypeError)):
        evaluate(text, known, [*BUILTINS.values(), *filter(callable, MATH.values())])


@pytest.mark.parametrize("text", ["2 ** 3 + 7 // 2 - 1.5", "3 > 2 >= 2 != 1", "not 1 or 'a' < 'b'",
    "[1, 2, 3][-1] + (4, 5)[0]", "{'a': {'b': 2}}['a']['b']", "'abc'[::-1]", "1 if 2 in [1] else 3",
    "max(1, 2, key=abs)", "round(pi / 2, 3)", "'%05.2f' % sqrt(2)", "sum(map(abs, [-1, 2]))",
    "' a b '.strip().split(' ')", "sorted({'b': 1, 'a': 2}.items())", "(-2) ** 2 % 3", "1 and 0",
    "'x' * 3", "None is None", "1_000 * 1e-3", "atan2(1, -1)", "0 < 1 < 1"])  # fmt: skip
def test_what_is_listed_has_the_value_of_python(text: str) -> None:
    """The oracle is Python itself."""
    names = {**BUILTINS, **MATH}
    found = evaluate(text, names, [*filter(callable, names.values())])
    assert found == eval(text, dict(names))


@pytest.mark.parametrize("text", [*WRITING[:3], "9 ** 9 ** 9 ** 9", "'a' * 10 ** 10", "(" * 3000, *(
    pytest.param(text, marks=pytest.mark.study) for text in WRITING[3:])])  # fmt: skip
def test_no_expression_of_a_file_does_anything(text: str, tmp_path: Path) -> None:
    pytest.importorskip("xacro")
    target = tmp_path / "touched"
    said = text.replace("PLACE", repr(str(target))).replace("<", "&lt;").replace('"', "&quot;")
    path = spoilt(tmp_path / "in", f'<a v="${{{said}}}"/>')
    with pytest.raises(DescriptionError, match="xacro") as caught:
        load_robot(path)
    assert "trust_xacro" in str(caught.value.cure.settings if caught.value.cure else "")
    assert not target.exists()


@pytest.mark.parametrize("text", [
    '<a v="$(eval 1+1)"/>', '<a v="$(env HOME)"/>', '<a v="$(optenv HOME)"/>',
    '<a v="$(find nowhere)"/>', '<a v="$(cwd)"/>', '<a v="$(dirname)"/>',
])  # fmt: skip
def test_no_extension_asks_the_machine(text: str, tmp_path: Path) -> None:
    pytest.importorskip("xacro")
    with pytest.raises(DescriptionError, match="is not allowed"):
        load_robot(spoilt(tmp_path, text))


@pytest.mark.parametrize("how", ["up", "absolute", "link", "folder link", "glob", "suffix", "fifo"])
@pytest.mark.parametrize("what", ["include", "yaml"])
def test_files_beyond_the_folder_are_neither_read_nor_printed(
    how: str, what: str, tmp_path: Path
) -> None:
    pytest.importorskip("xacro")
    suffix = "xacro" if what == "include" else "yaml"
    secret = tmp_path / f"secret.{suffix}"
    secret.write_text("PASSWORD-1234")
    folder = tmp_path / "in"
    folder.mkdir()
    place = {
        "up": f"../secret.{suffix}",
        "absolute": str(secret),
        "link": f"inside.{suffix}",
        "folder link": f"inside/secret.{suffix}",
        "glob": f"../*.{suffix}",
        "suffix": "notes.txt",
        "fifo": f"pipe.{suffix}",
    }[how]
    if how == "link":
        (folder / place).symlink_to(secret)
    elif how == "folder link":
        (folder / "inside").symlink_to(tmp_path)
    elif how == "suffix":
        (folder / place).write_text("PASSWORD-1234")
    elif how == "fifo":
        os.mkfifo(folder / place)
    text = (
        f'<xacro:include filename="{place}"/>'
        if what == "include"
        else f"<a v=\"${{xacro.load_yaml('{place}')}}\"/>"
    )
    with pytest.raises(DescriptionError) as caught:
        load_robot(spoilt(folder, text))
    assert "PASSWORD" not in str(caught.value)


def test_what_the_evaluator_would_overlook_meets_the_audit_hook(tmp_path: Path) -> None:
    """Here it is replaced by one that evaluates any Python."""
    pytest.importorskip("xacro")
    target = tmp_path / "touched"
    path = spoilt(tmp_path / "in", f"<a v=\"${{open({str(target)!r}, 'w')}}\"/>")
    program = (
        "import asbuilt.description.formats.expansion as e;"
        " e.evaluate = lambda text, names, functions: {0};"
        f" e.expand({str(path)!r}, 10**7, trusted=False)"
    )
    for instead, said in (
        ("eval(text)", b"exec is not allowed"),
        (f"open({str(target)!r}, 'w')", b"is not a description in the folder"),
        ("e.os.system('touch ' + text)", b"os.system is not allowed"),
        ("e.import_module('socket').socket()", b"socket.py is not a description"),
        ("e.os.remove(text)", b"os.remove is not allowed"),
    ):
        done = subprocess.run(
            build_isolated_command(program.format(instead)),
            env={},
            capture_output=True,
            check=False,
        )
        assert done.returncode == 2
        assert said in done.stderr, done.stderr
    assert not target.exists()


def test_trusted_files_are_expanded_by_xacro_alone(tmp_path: Path) -> None:
    pytest.importorskip("xacro")
    path = spoilt(tmp_path, '<a v="${[x for x in range(3)]}"/>')
    with pytest.raises(DescriptionError, match="is not allowed"):
        load_robot(path)
    assert load_robot(path, trust_xacro=True).joint_names == ("j",)
    with pytest.raises(DescriptionError, match="is not allowed"):
        load_robot(path)


@pytest.mark.parametrize(
    "start",
    [
        ["-m", "asbuilt"],
        pytest.param(["-P", "-c", "from asbuilt.cli import run; run()"], marks=pytest.mark.study),
    ],
)
def test_modules_beside_a_robot_are_not_run(start: list[str], tmp_path: Path) -> None:
    pytest.importorskip("xacro")
    spoilt(tmp_path, "")
    path = os.pathsep.join(each for each in sys.path if each)
    told = {}
    for where in (tmp_path, tmp_path / "elsewhere"):
        where.mkdir(exist_ok=True)
        for name in ("resource", "xacro", "yaml", "numpy", "polars", "json"):
            (tmp_path / f"{name}.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')\n")
        told[where] = subprocess.run(
            [sys.executable, *start, "show", str(tmp_path / "arm.xacro"), "--json"], cwd=where,
            env={"PYTHONPATH": path, "HOME": str(tmp_path)}, capture_output=True, check=False,
        )  # fmt: skip
        assert told[where].returncode == 0, told[where].stderr
    assert not (tmp_path / "ran").exists()
    assert told[tmp_path].stdout == told[tmp_path / "elsewhere"].stdout
