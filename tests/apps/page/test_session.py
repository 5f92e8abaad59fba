"""The page runs a step only when it may, and an answer belongs to the question it was given to."""

from __future__ import annotations

import json
import shlex
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import typer

from asbuilt.apps.page import session as page_session
from asbuilt.apps.page.choices import EXPORTS, Choices, set_option
from asbuilt.apps.page.session import STEPS, Job, Session
from asbuilt.cli.app import app
from asbuilt.errors import UsageError

PATIENCE = 600.0
"""Seconds without an answer after which one is waited for in vain, on a busy machine, too."""

FINDING = {"code": "torque_sign", "severity": "error", "message": "the torques are flipped"}


class CannedWorker:
    """Answers every command at once: a check by one finding, the others by what they were asked."""

    severity = "error"
    fails = False

    def __init__(self) -> None:
        self.may_answer = threading.Event()
        self.may_answer.set()

    def run(
        self, arguments: tuple[str, ...], progress: Callable[[str, float], None]
    ) -> dict[str, Any]:
        progress("read", 0.0)
        self.may_answer.wait(PATIENCE)
        if arguments[0] == "check":
            finding = {**FINDING, "severity": self.severity}
            return {"recordings": [{"findings": [finding]}]}
        if self.fails:
            return {"error": {"message": "it does not go"}}
        if arguments[0] == "identify":
            result = Path(arguments[-1]) / "result.json"
            result.parent.mkdir(parents=True, exist_ok=True)
            result.write_text(json.dumps(arguments))
            return {"files": {"result": str(result)}, "effects": []}
        return {"asked": [*arguments]}

    def cancel(self) -> None:
        self.may_answer.set()

    def close(self) -> None:
        pass


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "log.csv"
    path.write_text("t,q_1\n0,1\n")
    return path


@pytest.fixture
def session(tmp_path: Path, log: Path, monkeypatch: pytest.MonkeyPatch) -> Session:
    monkeypatch.setattr(page_session, "Worker", CannedWorker)
    return Session(tmp_path / "a study", Choices("two-link", (str(log),)))


def settle(session: Session) -> None:
    """Wait until every step that follows by itself has its answer."""
    session.follow()
    end = time.monotonic() + PATIENCE
    # The document is of one moment: between two steps there is none without a job.
    while session.as_document()["job"] is not None and time.monotonic() < end:
        time.sleep(0.005)
    assert session.job is None


def finish(session: Session, step: str) -> None:
    session.run(step)
    settle(session)


def test_identify_is_refused_until_the_logs_are_sound(
    session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert session.refusal("identify") == "the logs are not checked yet"
    settle(session)
    assert session.refusal("identify") == "the check found: the torques are flipped"
    with pytest.raises(UsageError, match="the torques are flipped"):
        session.run("identify")
    monkeypatch.setattr(CannedWorker, "severity", "warning")
    session.choose({"reading": "--flip-torque"})
    assert session.refusal("identify") is not None
    settle(session)
    assert session.refusal("identify") is None
    assert session.refusal("export") == "identify the robot first"
    finish(session, "identify")
    assert session.refusal("export") is None
    session.choose({"options": "--method wls"})
    assert session.refusal("export") == "identify the robot first"
    settle(session)
    monkeypatch.setattr(CannedWorker, "fails", True)
    finish(session, "identify")
    assert session.answer("identify") is not None
    assert session.refusal("export") == "identify the robot first"


@pytest.fixture
def identified(session: Session, monkeypatch: pytest.MonkeyPatch) -> Session:
    monkeypatch.setattr(CannedWorker, "severity", "info")
    settle(session)
    finish(session, "identify")
    assert all(session.answer(step) for step in ("show", "columns", "check", "identify"))
    return session


@pytest.mark.parametrize("change", ["content", "sheet", "result", "touch"])
def test_an_answer_belongs_to_what_the_files_hold(
    identified: Session, log: Path, change: str
) -> None:
    if change == "content":
        log.write_text("t,q_1\n0,2\n")
    elif change == "sheet":
        log.with_name("log.csv.toml").write_text("rate = 100\n")
    elif change == "result":
        identified.result.write_text("{}")
    else:
        log.write_bytes(log.read_bytes())
    current = {step for step in STEPS if identified.answer(step) is not None}
    assert (
        current
        == {
            "content": {"show"},
            "sheet": {"show"},
            "result": {"show", "columns", "check"},
            "touch": {"show", "columns", "check", "identify"},
        }[change]
    )
    told = identified.as_document()["steps"]
    assert {step for step in STEPS if told[step]["current"]} == current


def test_an_answer_belongs_to_the_files_that_a_description_names(
    tmp_path: Path, log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(page_session, "Worker", CannedWorker)
    robot = tmp_path / "arm.urdf"
    robot.write_text('<robot><mesh filename="package://arm/meshes/link.stl"/></robot>')
    mesh = tmp_path / "meshes" / "link.stl"
    mesh.parent.mkdir()
    mesh.write_bytes(b"one")
    session = Session(tmp_path / "study", Choices(str(robot), (str(log),)))
    settle(session)
    assert session.answer("check") is not None
    mesh.write_bytes(b"two")
    assert session.answer("show") is None
    assert session.answer("check") is None


def test_an_answer_to_an_older_question_is_none_to_the_present_one(
    session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(CannedWorker, "severity", "info")
    settle(session)
    worker: Any = session._worker
    worker.may_answer.clear()
    session.run("identify")
    session.choose({"options": "--method wls"})
    worker.may_answer.set()
    settle(session)
    assert session.answer("identify") is None
    told = session.as_document()["steps"]["identify"]
    assert not told["current"]
    assert "--method" not in told["answered"]
    assert session.find_answer(told["key"]) is not None
    assert session.find_answer("another key") is None


def test_files_of_a_run_without_an_answer_are_not_those_of_the_last(
    session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(CannedWorker, "severity", "info")
    settle(session)
    session.run("identify")
    settle(session)
    assert session.as_document()["steps"]["identify"]["kept"]
    before = session.result.read_text()
    worker: Any = session._worker
    worker.may_answer.clear()
    session.run("identify", {"options": "--method wls"})
    session.cancel()  # the worker writes its last file all the same
    deadline = time.monotonic() + PATIENCE
    while session.result.read_text() in ("", before) and time.monotonic() < deadline:
        time.sleep(0.01)
    session.choose({"options": ""})
    told = session.as_document()["steps"]["identify"]
    assert not told["kept"]
    assert not told["current"]


def test_a_step_that_reads_ends_when_its_question_is_old(session: Session) -> None:
    worker: Any = session._worker
    worker.may_answer.clear()
    session.follow()
    assert session.job is not None
    session.choose({"robot": "ur10e"})
    settle(session)
    assert session.answer("show") == {"asked": ["show", "ur10e"]}


def test_options_go_with_the_robot(session: Session, tmp_path: Path) -> None:
    session.choose({"reading": "--rate 100 --flip-torque", "options": "--method wls"})
    session.choose({"logs": ["other.csv"]})
    assert session.choices.reading == "--rate 100 --flip-torque"
    session.choose({"robot": str(tmp_path / "1" / "two-link")})
    assert session.choices.reading == "--rate 100 --flip-torque"
    session.choose({"robot": "ur10e"})
    assert (session.choices.reading, session.choices.options) == ("", "")
    assert "--rate 100 --flip-torque --method wls" in session.as_document()["note"]


def test_a_field_is_an_option_of_the_line(session: Session) -> None:
    session.choose({"reading": "--gain '1, 2' --flip-torque --rate=100"})
    session.set_option("reading", "--rate", "200")
    session.set_option("reading", "--flip-torque", False)
    session.set_option("reading", "--gravity", "-z")
    assert session.choices.reading == "--gain '1, 2' --rate 200 --gravity -z"
    assert session.as_document()["fields"]["reading"] == {
        "--gain": "1, 2",
        "--rate": "200",
        "--gravity": "-z",
    }
    with pytest.raises(UsageError, match="none of the options"):
        set_option("reading", "", "--trust-xacro", True)


def test_a_log_under_load_is_weighed_with_the_identified_arm(session: Session) -> None:
    session.choose({"robot": "two-link", "logs": ["bare.csv"], "payload": ["loaded.csv"]})
    session.set_option("reading", "--window", "5:60")
    words = session.arguments("identify")
    assert words[words.index("--payload") + 1] == "loaded.csv"
    assert words[words.index("--window") + 1] == "5:60"
    assert session.arguments("check")[2:4] == ("bare.csv", "loaded.csv")


def test_a_log_changes_its_use_whatever_became_of_the_others(session: Session) -> None:
    session.choose({"robot": "two-link", "logs": ["a.csv", "b.csv"], "validation": []})
    session.use_logs(["a.csv"], "payload")
    session.use_logs(["c.csv", "b.csv"], "validation")
    chosen = session.choices
    assert (chosen.logs, chosen.validation, chosen.payload) == (
        (),
        ("c.csv", "b.csv"),
        ("a.csv",),
    )
    session.use_logs(["b.csv"], "")
    assert session.choices.recordings == ("c.csv", "a.csv")
    for paths, use in (("a.csv", "logs"), (["a.csv"], "robot"), ([1], "logs"), (None, None)):
        with pytest.raises(UsageError):
            session.use_logs(paths, use)
    assert session.choices.recordings == ("c.csv", "a.csv")


@pytest.mark.parametrize(
    ("choices", "step", "why"),
    [
        (Choices(), "show", "choose a robot first"),
        (Choices("two-link"), "columns", "choose a log first"),
        (Choices("two-link", validation=("a.csv",)), "identify", "a log to identify with"),
    ],
)
def test_steps_wait_for_what_they_need(
    session: Session, choices: Choices, step: str, why: str
) -> None:
    session.choices = choices
    assert why in str(session.refusal(step))


@pytest.mark.parametrize("step", [*STEPS, *EXPORTS])
def test_every_step_is_a_command_that_the_program_takes(session: Session, step: str) -> None:
    session.choose(
        {
            "validation": ["other log.csv"],
            "reading": "--rate 100 --sheet 'a sheet.toml'",
            "options": "--method wls --cutoff 10",
            "effects": "tilt,spring:joints=2",
            "export": step if step in EXPORTS else "urdf",
        }
    )
    step = "export" if step in EXPORTS else step
    shown = session.as_document()["steps"][step]["command"]
    program, name, *arguments = shlex.split(shown)
    assert program == "asbuilt"
    assert (name, *arguments) == session.arguments(step)
    group: Any = typer.main.get_command(app)
    context = group.make_context("asbuilt", [name], resilient_parsing=True)
    group.get_command(context, name).make_context(name, arguments)


def test_another_step_waits_until_the_first_is_done(session: Session) -> None:
    session.job = Job("identify", ("identify", "two-link"), [], "")
    with pytest.raises(UsageError, match="another step is running"):
        session.run("columns")


def test_an_answer_of_a_file_that_changed_meanwhile_is_of_no_question(
    session: Session, log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(CannedWorker, "severity", "warning")
    settle(session)
    worker: Any = session._worker
    first = log.read_text()
    worker.may_answer.clear()
    session.run("identify")
    log.write_text(first + "1,1\n")
    worker.may_answer.set()
    settle(session)
    log.write_text(first)
    settle(session)
    assert session.refusal("identify") is None
    assert session.answer("identify") is None
    finish(session, "identify")
    assert session.answer("identify") is not None


def test_effects_that_were_switched_off_can_be_switched_on(session: Session) -> None:
    def effect(name: str) -> dict[str, Any]:
        return {"effect": name, "joint": None, "in_model": True}

    session._offer_effects(("identify",), {"effects": [effect("tilt"), effect("payload")]})
    session.answers["identify"] = page_session.Answer("", (), {}, "")
    session._offer_effects(("identify", "--effects", "tilt"), {"effects": [effect("tilt")]})
    assert session.offered == [effect("tilt"), effect("payload") | {"in_model": False}]
    session._offer_effects(("identify",), {"effects": []})
    assert session.offered == []
