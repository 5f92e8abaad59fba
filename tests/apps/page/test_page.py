"""The page in a real browser, from files to an exported model, on three robots."""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from chromium import chromium
from PIL import Image

from asbuilt.workflow import read_result
from command_line import call, document

SHARED = Path(__file__).resolve().parents[4] / "shared"

ActionChains = pytest.importorskip("selenium.webdriver").ActionChains
pytestmark = pytest.mark.study
SVG = "{http://www.w3.org/2000/svg}"
LONGEST = 600.0
"""Seconds after which a page that has not changed hangs; a busy machine may take minutes."""
GAINS = "--gain 14.87,13.26,11.13,10.62,11.03,11.47"
JOINTS = {
    "Rotation": "shoulder_pan",
    "Pitch": "shoulder_lift",
    "Elbow": "elbow_flex",
    "Wrist_Pitch": "wrist_flex",
    "Wrist_Roll": "wrist_roll",
    "Jaw": "gripper",
}


@dataclass(frozen=True)
class Case:
    """A robot and its log; joints of the log to rename by mouse, and options of reading."""

    robot: str
    log: Path
    joints: dict[str, str] = field(default_factory=dict)
    reading: str = ""
    is_draft: bool = False


@pytest.fixture(params=["lwr4", "ur10e", "so101"])
def case(
    request: pytest.FixtureRequest, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> Case:
    """Real robots, or virtual ones where their recordings are not here."""
    data, models = SHARED / "data", SHARED / "models"
    if not data.is_dir():
        robot = {"lwr4": "two-link", "ur10e": "ur10e", "so101": "scara"}[request.param]
        log = tmp_path / "log.csv"
        document(capsys, "simulate", robot, "--engine", "inverse-dynamics", "-o", log)
        return Case(robot, log)
    if request.param == "lwr4":
        return Case(str(models / "kuka_lwr4.urdf"), data / "kuka_lwr4" / "measurements_3.npz")
    if request.param == "ur10e":
        log = data / "ur10e" / "ur-20_02_10-30sec_12harm.csv"
        return Case("ur10e", log, reading=GAINS, is_draft=True)
    robot = str(models / "so101" / "so101_new_calib.xml")
    reading = "--torque-source command --lock gripper=0"
    return Case(robot, data / "so101_sage" / "multisine", JOINTS, reading, is_draft=True)


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    window = chromium(
        tmp_path_factory.mktemp("profile"),
        "use-angle=swiftshader enable-unsafe-swiftshader window-size=1300,1600",
        browser="ALL",
        performance="ALL",
    )
    yield window
    window.quit()


@dataclass
class Page:
    """A page in the browser."""

    browser: Any
    url: str
    folder: Path

    def state(self) -> dict[str, Any]:
        script = """const done = arguments[0];
            fetch("state").then((reply) => reply.json()).then(done);"""
        return dict(self.browser.execute_async_script(script))

    def settle(self, *steps: str) -> dict[str, Any]:
        """Wait until nothing runs, and the first steps and those named are answered and shown."""
        end = time.monotonic() + LONGEST
        told: dict[str, Any] = {}
        while time.monotonic() < end:
            state = self.state()
            told = state["steps"]
            first = all(told[each]["refusal"] or told[each]["current"] for each in
                        ("show", "columns", "check"))  # fmt: skip
            if state["job"] is None and first and all(told[each]["current"] for each in steps):
                self.run("window.dispatchEvent(new Event('focus'))")
                self.wait_until_drawn()
                return state
            time.sleep(0.3)
        pytest.fail(f"{steps} were not answered: {told}")

    def wait_until_drawn(self) -> None:
        """Wait until the page shows all that the server knows."""
        end, calm = time.monotonic() + LONGEST, 0
        script = "return document.getElementById('main').getAttribute('aria-busy')"
        while calm < 3 and time.monotonic() < end:
            calm = calm + 1 if self.run(script) == "false" else 0
            time.sleep(0.1)
        assert calm == 3

    def text(self, name: str) -> str:
        return str(self.run("return document.getElementById(arguments[0]).textContent", name))

    def run(self, script: str, *arguments: Any) -> Any:
        return self.browser.execute_script(script, *arguments)

    def click(self, name: str) -> None:
        self.run("document.getElementById(arguments[0]).click()", name)

    def enter(self, name: str, text: str) -> None:
        script = """const node = document.getElementById(arguments[0]);
            node.value = (node.value + " " + arguments[1]).trim();
            node.dispatchEvent(new Event("change"));"""
        self.run(script, name, text)

    def pick_joint(self, column: str, joint: str) -> None:
        script = """const row = [...document.querySelectorAll("#column-table tbody tr")]
                .find((each) => each.cells[0].textContent === arguments[0]);
            const list = row.cells[3].firstChild;
            list.value = arguments[1];
            list.dispatchEvent(new Event("change"));"""
        self.run(script, column, joint)


@pytest.fixture
def open_page(browser: Any, tmp_path: Path) -> Iterator[Callable[..., Page]]:
    """Start `asbuilt open` with arguments, and open its page."""
    started = []

    def begin(*arguments: str) -> Page:
        folder = tmp_path / "study"
        command = (*arguments, "--no-browser", "--port", "0", "--json", "-o", str(folder))
        process = subprocess.Popen(
            [sys.executable, "-m", "asbuilt", "open", *command],
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        )
        started.append(process)
        assert process.stdout is not None
        lines = [process.stdout.readline()]
        while lines[-1] not in ("}\n", ""):
            lines.append(process.stdout.readline())
        url = json.loads("".join(lines))["url"]
        for log in ("performance", "browser"):
            browser.get_log(log)  # those of the page before
        browser.get(url)
        end = time.monotonic() + LONGEST
        while not browser.find_elements("id", "main") and time.monotonic() < end:
            time.sleep(0.05)
        return Page(browser, browser.current_url, folder)

    yield begin
    browser.get("about:blank")
    for process in started:
        process.terminate()
        process.wait(30)


def requests(browser: Any) -> set[str]:
    """Addresses that pages have asked for, those of the browser itself left out."""
    messages = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
    asked = [
        each["params"]["request"]["url"]
        for each in messages
        if each["method"] == "Network.requestWillBeSent"
    ]
    return {url for url in asked if not url.startswith(("chrome:", "data:", "blob:", "about:"))}


def test_from_files_to_an_exported_model(
    case: Case,
    open_page: Callable[..., Page],
    browser: Any,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    page = open_page(case.robot, str(case.log))
    page.settle()
    if case.is_draft:
        assert "Not yet" in page.text("identify-refusal")
        assert page.run("return document.getElementById('identify-button').disabled")
        for old, new in case.joints.items():
            page.pick_joint(f"{old}/position", new)
        page.click("assign")
        page.settle()
        assert list(page.folder.glob("*.sheet.toml"))
        if case.reading == GAINS:
            assert "Give --gain" in page.text("check-findings")
            assert page.text("identify-refusal") == "Not yet: mend the errors of step 4 first."
        page.enter("reading", case.reading)
        page.settle()
    assert page.text("identify-refusal") == ""
    page.click("identify-button")
    state = page.settle("identify")
    assert page.text("verdict")
    result = read_result(page.folder / "result.json")
    assert page.run("return document.querySelectorAll('#joint-errors tbody tr').length") == len(
        result.joint_names
    )
    assert page.run("return document.querySelectorAll('#torque-plot path.trace').length") >= 5
    # The command that the page shows gives the same numbers.
    _, *arguments = shlex.split(state["steps"]["identify"]["command"])
    arguments[arguments.index("-o") + 1] = str(tmp_path / "again")
    status, _, said = call(capsys, *arguments, "--json")
    assert status == 0, said
    again = read_result(tmp_path / "again" / "result.json")
    assert [each.estimate for each in result.parameters] == [
        each.estimate for each in again.parameters
    ]
    page.click("export-button")
    page.settle("export")
    assert (page.folder / "robot_as_built.urdf").is_file() or "URDF" in page.text("export-answer")
    origin = page.url.rsplit("/", 2)[0]
    assert {url for url in requests(browser) if not url.startswith(f"{origin}/")} == set()
    assert [each for each in browser.get_log("browser") if each["level"] == "SEVERE"] == []


@pytest.fixture
def virtual(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> tuple[Path, Path]:
    """A robot file and a recording of it."""
    robot, log = tmp_path / "my robot.toml", tmp_path / "my log.csv"
    assert call(capsys, "convert", "two-link", robot)[0] == 0
    document(capsys, "simulate", robot, "--engine", "inverse-dynamics", "-o", log)
    return robot, log


def test_files_are_uploaded_identification_is_cancelled_and_an_effect_is_switched(
    virtual: tuple[Path, Path], open_page: Callable[..., Page], browser: Any
) -> None:
    robot, log = virtual
    page = open_page()
    page.settle()
    for name, path in (("robot-file", robot), ("log-file", log)):
        browser.find_element("id", name).send_keys(str(path))
        time.sleep(1.0)
        page.settle()
    uploaded = page.folder / "uploads"
    assert (uploaded / "2" / "my_log.csv").read_bytes() == log.read_bytes()
    assert page.state()["choices"]["robot"] == str(uploaded / "1" / "my_robot.toml")
    page.click("identify-button")
    time.sleep(0.2)
    page.click("cancel")
    time.sleep(1.0)
    assert not (page.folder / "result.json").exists()
    assert page.state()["job"] is None
    page.click("identify-button")
    page.settle("identify")
    page.run("""const list = document.getElementById("effects");
        const box = list.querySelector("input:not(:disabled)");
        if (box) { box.click(); document.getElementById("effects-button").click(); }""")
    time.sleep(1.0)
    state = page.settle("identify")
    switched = page.run("return Boolean(document.querySelector('#effects input:not(:disabled)'))")
    assert ("--effects" in state["steps"]["identify"]["command"]) is switched


def test_the_robot_moves_in_3d_inside_its_frame(
    virtual: tuple[Path, Path], open_page: Callable[..., Page], browser: Any
) -> None:
    pytest.importorskip("viser")
    page = open_page(*map(str, virtual))
    page.settle()
    page.click("identify-button")
    page.settle("identify")
    page.click("view-button")
    page.settle("view")
    frame = browser.find_element("id", "view-frame")
    assert frame.is_displayed()
    browser.switch_to.frame(frame)
    end = time.monotonic() + LONGEST
    while not browser.find_elements("css selector", "canvas") and time.monotonic() < end:
        time.sleep(0.5)
    assert browser.find_elements("css selector", "canvas")
    browser.switch_to.default_content()
    origin = page.url.rsplit("/", 2)[0]
    assert {url for url in requests(browser) if not url.startswith(f"{origin}/")} == set()


@pytest.mark.parametrize("width", [400, 1300])
def test_it_fits_a_telephone_and_the_dark(
    virtual: tuple[Path, Path], open_page: Callable[..., Page], browser: Any, width: int
) -> None:
    page = open_page(*map(str, virtual))
    page.settle()
    page.run("document.getElementById('columns-all').open = true")
    shape = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", shape)
    dark = {"features": [{"name": "prefers-color-scheme", "value": "dark"}]}
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", dark)
    try:
        assert page.run("return document.documentElement.scrollWidth") <= width
        colour = page.run("return getComputedStyle(document.body).backgroundColor")
        assert max(map(int, colour.removeprefix("rgb(").rstrip(")").split(","))) < 60
    finally:
        browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})


def test_a_hostile_file_is_one_error(open_page: Callable[..., Page], tmp_path: Path) -> None:
    log = tmp_path / "bomb.npz"
    log.write_bytes(b"PK\x03\x04" + b"\x00" * 1000)
    name = tmp_path / "<img src=x onerror=alert(1)>.csv"
    name.write_text("t,q_1\n0,x\n")
    page = open_page("two-link", str(log), str(name))
    page.settle()
    assert "is not a recording" in page.text("check-answer") or "bomb.npz" in page.text(
        "check-answer"
    )
    assert page.run("return document.querySelectorAll('main section:not(#start) img').length") == 0
    assert "<img" in page.text("log-list")


def test_curves_are_zoomed_and_saved_and_a_job_survives_a_reload(
    open_page: Callable[..., Page], browser: Any, tmp_path: Path
) -> None:
    page = open_page()
    page.settle()
    assert page.run("return document.getElementById('start').hidden") is False
    page.click("sample")
    page.wait_until_drawn()
    page.settle()
    page.click("identify-button")
    time.sleep(0.3)
    browser.refresh()
    page.wait_until_drawn()
    assert page.run("return document.getElementById('start').hidden") is True
    page.settle("identify")
    assert page.text("verdict").startswith("USE")
    saved = tmp_path / "saved"
    where = {"behavior": "allow", "downloadPath": str(saved)}
    browser.execute_cdp_cmd("Browser.setDownloadBehavior", where)
    whole = page.run("return document.querySelector('#torque-plot svg').textContent")
    page.click("zoom-in")
    assert page.run("return document.querySelector('#torque-plot svg').textContent") != whole
    page.click("zoom-all")
    assert page.run("return document.querySelector('#torque-plot svg').textContent") == whole
    colours = page.run(
        """return [...document.querySelectorAll("#torque-plot path.trace")]
            .map((path) => getComputedStyle(path).stroke);"""
    )
    assert len(set(colours)) == 5
    for kind in ("svg", "png"):
        page.click(f"save-{kind}")
    end = time.monotonic() + LONGEST
    paths = [saved / f"torque_shoulder_pan_joint.{kind}" for kind in ("svg", "png")]
    while not all(path.is_file() for path in paths) and time.monotonic() < end:
        time.sleep(0.1)
    drawing = ElementTree.parse(paths[0]).getroot()
    assert all(path.get("stroke", "").startswith("rgb") for path in drawing.iter(f"{SVG}path"))
    with Image.open(paths[1]) as picture:
        shown = page.run("return document.getElementById('torque-plot').clientWidth")
        assert picture.width == 2 * shown


def test_columns_are_matched_by_the_mouse(
    virtual: tuple[Path, Path], open_page: Callable[..., Page], browser: Any
) -> None:
    robot, log = virtual
    lines = log.read_text().splitlines()
    head = lines[0].split(",")
    places = [head.index(name) for name in head if name.startswith("tau")]
    head[places[0]], head[places[1]] = head[places[1]], head[places[0]]
    log.write_text("\n".join([",".join(head), *lines[1:]]) + "\n")
    page = open_page(str(robot), str(log))
    page.settle()
    page.run("document.getElementById('columns-all').open = true")
    chips = browser.find_elements("css selector", "#places tbody tr td:last-child .chip")[-2:]
    names = [chip.text for chip in chips]
    place = browser.find_elements("css selector", "#places tbody tr td:last-child")[-1]
    ActionChains(browser).drag_and_drop(chips[0], place).perform()
    time.sleep(0.5)
    moved = browser.find_elements("css selector", "#places tbody tr td:last-child .chip")[-2:]
    assert [chip.text for chip in moved] == names[::-1]
    page.click("assign")
    page.wait_until_drawn()
    page.settle()
    (sheet,) = page.folder.glob("*.sheet.toml")
    assert tomllib.loads(sheet.read_text())["columns"]["torque"] == names[::-1]
