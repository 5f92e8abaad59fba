"""Progress, cures and findings as the command line shows them."""

from __future__ import annotations

import pytest

from asbuilt import compilation
from asbuilt.cli import describe_cure
from asbuilt.cli.answers import COMPILING, Screen
from asbuilt.findings import Cure, Finding


class Terminal:
    """A stderr that says that it is a terminal."""

    def isatty(self) -> bool:
        return True

    def write(self, text: str) -> int:
        return len(text)

    def flush(self) -> None:
        pass


def test_cures_name_options_and_commands() -> None:
    cure = Cure("find the gains", {"gain": (1.0, 2.0), "checked": False}, call="find_gains")
    assert describe_cure(cure) == "find the gains (--gain 1.0,2.0, --unchecked, asbuilt gains)"
    assert describe_cure(Cure("record longer")) == "record longer"
    assert describe_cure(None) == ""
    finding = Finding("flipped_torque", "error", "the torque of A2 has the other sign", cure)
    assert finding.as_line(describe_cure).startswith("ERROR flipped_torque: the torque of A2 has")
    assert finding.as_line(describe_cure).endswith("asbuilt gains).")


def test_a_bar_pulses_until_a_fraction_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stderr", Terminal())
    screen = Screen()
    screen.report("identify", 0.0)
    (task,) = screen._bar.tasks
    assert task.total is None
    screen.report("identify: A2", 0.4)
    assert (task.total, task.completed, task.description) == (1.0, 0.4, "identify: A2")
    screen.report("write", 0.0)
    assert screen._bar.tasks[0].finished
    screen.close()


def test_verbose_prints_each_step_once(capsys: pytest.CaptureFixture[str]) -> None:
    screen = Screen(verbose=True)
    for fraction in (0.0, 0.5, 1.0):
        screen.report("filter", fraction)
    assert [line.split()[-1] for line in capsys.readouterr().err.splitlines()] == ["filter"]


class Cold:
    """A kernel that is to be compiled."""

    def __init__(self, *, is_kept: bool) -> None:
        self.is_kept = is_kept


def test_compilation_is_announced_with_how_often_it_happens_and_done_at_once(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = []
    monkeypatch.setattr(compilation, "compile_kernels", lambda kernel, report: calls.append(kernel))
    Screen().announce_compilation(Cold(is_kept=True))
    assert capsys.readouterr().err == f"asbuilt: {COMPILING}\n"
    assert len(calls) == 1
    Screen().announce_compilation(Cold(is_kept=False))
    assert "in every run" in capsys.readouterr().err
    assert len(calls) == 1
    Screen(quiet=True).announce_compilation(Cold(is_kept=True))
    assert capsys.readouterr().err == ""
    assert len(calls) == 2
