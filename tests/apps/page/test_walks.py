"""Whatever is chosen in whatever order: the screen is the one that a new page would show."""

from __future__ import annotations

import random
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from chromium import chromium

from asbuilt.apps.page import session as page_session
from asbuilt.apps.page.choices import EXPORTS, Choices
from asbuilt.apps.page.server import PageServer
from asbuilt.apps.page.session import Session
from faked_commands import FakedWorker

pytestmark = pytest.mark.study
SERVERS = 10
WALKS = 20
"""Walks on each server: 200 in all."""
STEPS = 7
PATIENCE = 600.0
"""Seconds after which a page that is busy is waited for in vain, on a busy machine, too."""
FLAGS = (
    "window-size=1300,1600 disable-background-timer-throttling disable-renderer-backgrounding"
    " disable-backgrounding-occluded-windows"
)

SETTLE = """
const done = arguments[arguments.length - 1];
const lookAgain = () => window.dispatchEvent(new Event("focus"));
lookAgain();
let calm = 0;
let looks = 0;
const look = () => {
  calm = document.getElementById("main").getAttribute("aria-busy") === "false" ? calm + 1 : 0;
  if (calm > 2) { done(); return; }
  looks += 1;
  if (looks % 8 === 0 && calm === 0) lookAgain();
  setTimeout(look, 5);
};
look();
"""
"""The page itself looks four times a second at what runs; faked commands are done sooner."""
SCREEN = """
const lines = [];
const walk = (node) => {
  if (node.hidden || ["trouble", "upload"].includes(node.id)) return;
  const text = [...node.childNodes].filter((each) => each.nodeType === 3)
    .map((each) => each.textContent.trim()).join("");
  const held = ["value", "checked", "disabled", "src", "href"]
    .map((name) => (typeof node[name] === "object" || node.type === "file" ? "" : node[name]));
  lines.push([node.tagName, node.id, node.getAttribute("class"), text, ...held].join("|"));
  if (node.tagName === "svg") lines.push(node.outerHTML);
  else for (const child of node.children) walk(child);
};
walk(document.body);
return lines;
"""
ENTER = """
const node = document.getElementById(arguments[0])
  || document.querySelector(`[data-option="${arguments[0]}"]`);
node.value = arguments[1];
node.dispatchEvent(new Event("change"));
"""
CLICK = """
const nodes = [...document.querySelectorAll(arguments[0])].filter((node) => !node.disabled);
if (nodes.length) nodes[arguments[1] % nodes.length].click();
"""
PICK = """
const lists = [...document.querySelectorAll(arguments[0])];
if (!lists.length) return;
const list = lists[arguments[1] % lists.length];
list.selectedIndex = arguments[2] % list.options.length;
list.dispatchEvent(new Event("change"));
"""
UPLOAD = """
const files = new DataTransfer();
files.items.add(new File([arguments[1]], arguments[2]));
const input = document.getElementById(arguments[0]);
input.files = files.files;
input.dispatchEvent(new Event("change"));
"""
DRAG = """
const chips = [...document.querySelectorAll(".chip")];
const places = [...document.querySelectorAll(".place")];
if (!chips.length) return;
const dataTransfer = new DataTransfer();
const fire = (node, type) =>
  node.dispatchEvent(new DragEvent(type, { dataTransfer, bubbles: true, cancelable: true }));
fire(chips[arguments[0] % chips.length], "dragstart");
const place = places[arguments[1] % places.length];
fire(place, "dragover");
fire(place, "drop");
document.getElementById("assign").click();
"""


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    window = chromium(tmp_path_factory.mktemp("profile"), FLAGS)
    window.set_script_timeout(PATIENCE)
    yield window
    window.quit()


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[PageServer]:
    monkeypatch.setattr(page_session, "Worker", FakedWorker)
    for name in ("one", "two", "three"):
        (tmp_path / f"{name}.csv").write_text(name)
    (tmp_path / "arm.urdf").write_text("<robot/>")
    served = PageServer(Session(tmp_path / "study", Choices()), 0)
    thread = threading.Thread(target=served.serve_forever, daemon=True)
    thread.start()
    yield served
    served.shutdown()
    served.server_close()
    served.session.close()
    thread.join()


def open_page(server: PageServer, browser: Any) -> str:
    """Go to the page past the one that takes the secret, and return where it is."""
    wait = pytest.importorskip("selenium.webdriver.support.wait")
    place = f"http://{server.hosts[0]}/{server.place}/"
    browser.get(server.url)
    wait.WebDriverWait(browser, PATIENCE).until(
        lambda page: (
            page.current_url == place
            and page.execute_script('return document.readyState === "complete"')
        )
    )
    return place


def acts(browser: Any, folder: Path, rng: random.Random) -> list[Callable[[], Any]]:
    """Everything that can be done with a mouse, and files that change behind the page."""

    def run(script: str, *arguments: Any) -> Callable[[], Any]:
        return lambda: browser.execute_script(script, *arguments)

    def number() -> int:
        return rng.randrange(1000)

    log = folder / f"{rng.choice(('one', 'two', 'three'))}.csv"
    robot = rng.choice(("ur10e", "two-link", "scara"))
    return [
        run(ENTER, "robot-name", robot),
        run(ENTER, "robot-path", str(folder / "arm.urdf")),
        run(ENTER, "robot-path", rng.choice(("nowhere.urdf", "-o"))),
        *2 * [run(ENTER, "log-path", str(log))],
        run(CLICK, "#log-list button", number()),
        run(PICK, "#log-list select", number(), number()),
        run(ENTER, "--rate", rng.choice(("", "100", "250"))),
        run(ENTER, "--window", rng.choice(("", "5:60", "5:60,80:", "5-60"))),
        run(ENTER, "--flip-torque", rng.choice(("", "true"))),
        run(PICK, '[data-option="--torque-source"]', 0, number()),
        run(PICK, '[data-option="--mounting"]', 0, number()),
        run(ENTER, "reading", rng.choice(("", "--rate 100 --flip-torque", "--rate", "'"))),
        run(ENTER, "options", rng.choice(("", "--method wls", "--trust-xacro", "--out /tmp"))),
        *2 * [run(CLICK, "#check-findings button, #check-answer button", number())],
        run(DRAG, number(), number()),
        *4 * [run(CLICK, "#identify-button", 0)],
        run(CLICK, "#cancel", 0),
        run(CLICK, "#effects input, #effects-button", number()),
        run(CLICK, "#view-button", 0),
        run(CLICK, "#export-button", 0),
        run(ENTER, "export-format", rng.choice([*EXPORTS])),
        run(CLICK, "#sample", 0),
        run(UPLOAD, "log-file", str(number() % 3), "log.csv"),
        run(UPLOAD, "robot-file", str(number() % 3), "arm.urdf"),
        lambda: log.write_text(str(number() % 3)),
    ]


@pytest.mark.parametrize("seed", range(SERVERS))
def test_a_walk_ends_where_a_new_page_begins(
    server: PageServer, browser: Any, tmp_path: Path, seed: int
) -> None:
    rng = random.Random(seed)
    place = open_page(server, browser)
    walked = browser.current_window_handle
    browser.switch_to.new_window("tab")
    fresh = browser.current_window_handle
    seen = set()
    try:
        for walk in range(WALKS):
            browser.switch_to.window(walked)
            for _ in range(STEPS):
                rng.choice(acts(browser, tmp_path, rng))()
                if rng.random() < 0.3:
                    browser.execute_async_script(SETTLE)
            browser.execute_async_script(SETTLE)
            # Boxes that were ticked wait for the click that identifies with them.
            browser.execute_script(CLICK, "#effects-button:not([hidden])", 0)
            browser.execute_async_script(SETTLE)
            # What was refused stays to be mended until it is undone or something is accepted.
            browser.execute_script(CLICK, "#undo", 0)
            browser.execute_script(ENTER, "export-format", rng.choice([*EXPORTS]))
            browser.execute_async_script(SETTLE)
            shown = browser.execute_script(SCREEN)
            browser.switch_to.window(fresh)
            browser.get(place)
            browser.execute_async_script(SETTLE)
            loaded = browser.execute_script(SCREEN)
            differing = [pair for pair in zip(shown, loaded, strict=False) if pair[0] != pair[1]]
            assert shown == loaded, (walk, differing[:5])
            seen.add(str(shown))
    finally:
        browser.close()
        browser.switch_to.window(walked)
    assert len(seen) > WALKS / 2


def test_two_changes_before_an_answer_are_both_kept(
    server: PageServer, browser: Any, tmp_path: Path
) -> None:
    open_page(server, browser)
    for name in ("one", "two"):
        browser.execute_script(ENTER, "log-path", str(tmp_path / f"{name}.csv"))
    browser.execute_async_script(SETTLE)
    browser.execute_script(f"""
        const change = (...arguments) => {{ {PICK} }};
        change("#log-list select", 0, 2);
        change("#log-list select", 1, 1);
    """)
    browser.execute_async_script(SETTLE)
    chosen = server.session.choices
    assert [Path(path).stem for path in chosen.payload + chosen.validation] == ["one", "two"]
    uses = [f"SELECT||||{use}||false||" for use in ("validation", "payload")]
    assert [line for line in browser.execute_script(SCREEN) if line in uses] == uses


def test_a_use_that_is_refused_is_not_shown(
    server: PageServer, browser: Any, tmp_path: Path
) -> None:
    open_page(server, browser)
    browser.execute_script(ENTER, "log-path", str(tmp_path / "one.csv"))
    browser.execute_async_script(SETTLE)
    browser.execute_script(f"""
        const change = (...arguments) => {{ {PICK} }};
        document.querySelector("#log-list select").options[1].value = "elsewhere";
        change("#log-list select", 0, 1);
    """)
    browser.execute_async_script(SETTLE)
    assert not browser.find_element("id", "trouble").get_property("hidden")
    assert "SELECT||||logs||false||" in browser.execute_script(SCREEN)
