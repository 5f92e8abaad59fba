"""The page runs a step only when it may, and every step is a command that the program takes."""

from __future__ import annotations

import shlex
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import typer

from asbuilt.apps.page import session as page_session
from asbuilt.apps.page.session import STEPS, Choices, Session
from asbuilt.cli.app import app
from asbuilt.errors import UsageError

FINDING = {"code": "torque_sign", "severity": "error", "message": "the torques are flipped"}


class CannedWorker:
    """Answers every command at once, a check by one finding."""

    severity = "error"

    def run(self, arguments: Any, progress: Callable[[str, float], None]) -> dict[str, Any]:
        progress("read", 0.0)
        finding = {**FINDING, "severity": self.severity}
        return {"recordings": [{"findings": [finding]}]} if arguments[0] == "check" else {}

    def close(self) -> None:
        pass


@pytest.fixture
def session(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Session:
    monkeypatch.setattr(page_session, "Worker", CannedWorker)
    return Session(tmp_path / "a study", Choices("two-link", ("log.csv",)))


def finish(session: Session, step: str) -> None:
    session.run(step)
    end = time.monotonic() + 10.0
    while session.job is not None and time.monotonic() < end:
        time.sleep(0.01)
    assert session.job is None


def test_identify_is_refused_until_the_logs_are_sound(
    session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert session.refusal("identify") == "the logs are not checked yet"
    finish(session, "check")
    assert session.refusal("identify") == "the check found: the torques are flipped"
    with pytest.raises(UsageError, match="the torques are flipped"):
        session.run("identify")
    monkeypatch.setattr(CannedWorker, "severity", "warning")
    session.choose({"reading": "--flip-torque"})
    assert session.refusal("identify") == "the logs are not checked yet"
    finish(session, "check")
    assert session.refusal("identify") is None
    assert session.refusal("export") == "identify the robot first"
    finish(session, "identify")
    assert session.refusal("export") is None
    session.choose({"options": "--method wls"})
    assert session.refusal("export") == "identify the robot first"


@pytest.mark.parametrize(
    ("choices", "step", "why"),
    [
        (Choices(), "show", "choose a robot first"),
        (Choices("two-link"), "columns", "choose a log first"),
        (Choices("two-link", validation=("a.csv",)), "identify", "all are for validation"),
    ],
)
def test_steps_wait_for_what_they_need(
    session: Session, choices: Choices, step: str, why: str
) -> None:
    session.choices = choices
    assert why in str(session.refusal(step))


@pytest.mark.parametrize("step", STEPS)
def test_every_step_is_a_command_that_the_program_takes(session: Session, step: str) -> None:
    session.choose(
        {
            "validation": ["other log.csv"],
            "reading": "--rate 100 --sheet 'a sheet.toml'",
            "options": "--method wls",
            "effects": "tilt,spring:joints=2",
            "export": "--urdf 'as built.urdf'",
        }
    )
    shown = session.as_document()["steps"][step]["command"]
    program, name, *arguments = shlex.split(shown)
    assert program == "asbuilt"
    assert (name, *arguments) == session.arguments(step)
    group: Any = typer.main.get_command(app)
    context = group.make_context("asbuilt", [name], resilient_parsing=True)
    group.get_command(context, name).make_context(name, arguments)


def test_another_step_waits_until_the_first_is_done(session: Session) -> None:
    session.job = page_session.Job("show", ("show", "two-link"))
    with pytest.raises(UsageError, match="another step is running"):
        session.run("columns")
