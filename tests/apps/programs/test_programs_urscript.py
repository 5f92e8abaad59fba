"""URScript programs: their form, and their course when run line by line with a stand-in for the
controller.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field

import numpy as np
import pytest

from asbuilt import make_program
from asbuilt.description import bundled_robot
from asbuilt.excitation import Motion, random_fourier

ROBOTS = ("ur10e", "puma-560")
NUMBER = r"-?\d+\.\d{7}"


class HaltError(Exception):
    """The program ended itself."""


@dataclass
class Controller:
    """An ideal UR: it is where servoj or movej put it, `tick` seconds later.

    It is `off` away from where movej should bring it.
    """

    tick: float
    off: float = 0.0
    pose: list[float] = field(default_factory=lambda: [0.0] * 6)
    commanded: list[list[float]] = field(default_factory=list)
    said: list[str] = field(default_factory=list)

    def servoj(self, q: list[float], *, t: float, lookahead_time: float, gain: float) -> None:
        assert t == self.tick
        assert 0.03 <= lookahead_time <= 0.2
        assert 100 <= gain <= 2000
        assert len(q) == 6
        self.commanded.append(list(q))
        self.pose = list(q)

    def movej(self, q: list[float], *, a: float, v: float) -> None:
        assert v <= 0.2
        assert a <= 0.5
        self.said.append(f"movej {v}")
        self.pose = [x + self.off for x in q]

    def popup(self, text: str, *, title: str, warning: bool, error: bool, blocking: bool) -> None:
        assert blocking
        assert warning != error
        assert title
        self.said.append(text)

    def names(self) -> dict[str, object]:
        return {
            "servoj": self.servoj,
            "movej": self.movej,
            "popup": self.popup,
            "get_steptime": lambda: self.tick,
            "get_actual_joint_positions": lambda: self.pose,
            "norm": abs,
            "sleep": lambda seconds: None,
            "stopj": lambda deceleration: self.said.append("stopj"),
            "textmsg": self.said.append,
            "HaltError": HaltError,
        }


def balanced(script: str) -> None:
    """Assert that blocks open and close at their indentation, and that brackets close on their
    line.
    """
    open_blocks: list[int] = []
    for line in script.splitlines():
        code = line.split("#")[0].rstrip() if line.lstrip().startswith("#") else line.rstrip()
        if not code.strip():
            continue
        indent = len(code) - len(code.lstrip())
        assert "\t" not in code
        assert code.count("(") == code.count(")")
        assert code.count("[") == code.count("]")
        if code.strip() == "end":
            assert indent == open_blocks.pop()
        else:
            assert indent == 2 * len(open_blocks)
            if re.match(r"\s*(def|while|if)\b", code):
                assert code.endswith(":")
                open_blocks.append(indent)
    assert open_blocks == []


def python_of(script: str) -> str:
    """Translate to Python: blocks by indentation are there already.

    URScript's rules of scope are made explicit.
    """
    lines, nested, local = [], False, set[str]()
    code_lines = script.splitlines()
    for k, line in enumerate(code_lines):
        indent, code = line[: len(line) - len(line.lstrip())], line.strip()
        if code == "end":
            nested = nested and indent != "  "
            continue
        if code.startswith("global "):
            name = code.split()[1]
            code = f"global {name}; {code.removeprefix('global ')}"
        elif code.startswith("local "):
            local.add(code.split()[1])
            code = code.removeprefix("local ")
        elif code == "halt":
            code = "raise HaltError"
        lines.append(indent + code)
        if code.startswith("def ") and indent:
            nested, local = True, set(re.findall(r"\w+", code[code.index("(") :]))
            body = "\n".join(code_lines[k:]).split("\n  end")[0]
            declared = local | set(re.findall(r"local (\w+)", body))
            assigned = set(re.findall(r"^\s*(\w+) = ", body, flags=re.MULTILINE)) - declared
            lines.append(f"{indent}  global {', '.join(sorted(assigned))}")
    return "\n".join(lines)


def run(script: str, controller: Controller) -> None:
    name = re.search(r"^def (\w+)\(\):", script, flags=re.MULTILINE)
    assert name is not None
    exec(python_of(script) + f"\n{name.group(1)}()\n", controller.names())


def scripts(robot: str) -> tuple[Motion, dict[str, str]]:
    model = bundled_robot(robot)
    motion = random_fourier(model, rng=8, duration=6.0, n_harmonics=4)
    return motion, {
        file.role: file.text for file in make_program(model, motion, "urscript", name="run 1")
    }


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("role", ["program", "dry_run"])
def test_form(robot: str, role: str) -> None:
    text = scripts(robot)[1][role]
    balanced(text)
    assert max(len(line) for line in text.splitlines()) < 500
    assert len(re.findall(r"^def asbuilt_", text, flags=re.MULTILINE)) == 1


@pytest.mark.parametrize("robot", ROBOTS)
def test_numbers_are_those_of_the_motion(robot: str) -> None:
    motion, files = scripts(robot)
    for role in ("program", "dry_run"):
        rows = re.findall(r"^  move_on\(\[(.*?)\],\[(.*?)\]\)$", files[role], flags=re.MULTILINE)
        q, v = (np.array([[float(x) for x in row[k].split(",")] for row in rows]) for k in (0, 1))
        assert all(re.fullmatch(NUMBER, x) for row in rows for part in row for x in part.split(","))
        spacing = float(re.search(r"spacing = ([\d.]+)", files[role]).group(1))  # type: ignore[union-attr]
        t = np.linspace(0.0, motion.duration, len(rows) + 1)
        assert spacing == pytest.approx(t[1], abs=1e-9)
        np.testing.assert_allclose(q, motion.derivative(t[1:]), atol=0.51e-7)
        np.testing.assert_allclose(v, motion.derivative(t[1:], 1), atol=0.51e-7)


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("tick", [0.002, 0.008])
@pytest.mark.parametrize("role", ["program", "dry_run"])
def test_the_robot_follows_the_motion_at_every_cycle(robot: str, tick: float, role: str) -> None:
    motion, files = scripts(robot)
    slowdown = 10.0 if role == "dry_run" else 1.0
    controller = Controller(tick)
    run(files[role], controller)
    q = np.array(controller.commanded)
    t = np.arange(len(q)) * tick / slowdown
    moving = t < motion.duration - 1e-9
    np.testing.assert_allclose(q[moving], motion.derivative(t[moving]), atol=1.1e-4)
    np.testing.assert_allclose(q[~moving], np.tile(motion.end, ((~moving).sum(), 1)), atol=1e-7)
    assert (~moving).sum() * tick >= 0.45
    steps = np.abs(np.diff(q, axis=0)) / tick
    assert np.all(steps <= (1.02 * motion.peaks(1) + 0.005) / slowdown)
    assert controller.said[1].startswith("movej")
    assert "start pose" in controller.said[0]
    assert ("Did the dry run reach its end?" in controller.said[2]) == (role == "program")
    assert controller.said[-1] == "run 1: done"


def test_a_robot_that_does_not_reach_the_start_is_not_moved_on() -> None:
    _, files = scripts("ur10e")
    controller = Controller(0.002, off=0.02)
    with pytest.raises(HaltError):
        run(files["program"], controller)
    assert controller.commanded == []
    assert "not at the start pose" in controller.said[-1]
