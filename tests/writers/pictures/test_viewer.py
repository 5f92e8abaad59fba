"""The 3-D page must load in a real browser, draw, move and say nothing is wrong."""

from __future__ import annotations

import io
import socket
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chromium import chromium
from PIL import Image

from asbuilt.description import Solid, bundled_robot
from asbuilt.dynamics import link_poses
from asbuilt.errors import MissingExtraError, UsageError
from asbuilt.excitation import QuinticMotion
from asbuilt.writers import Viewer
from asbuilt.writers.pictures.skeleton import build_round_mesh


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    window = chromium(
        tmp_path_factory.mktemp("profile"),
        "use-angle=swiftshader enable-unsafe-swiftshader window-size=700,500",
        browser="ALL",
    )
    yield window
    window.quit()


def picture(browser: Any) -> np.ndarray:
    with Image.open(io.BytesIO(browser.get_screenshot_as_png())) as image:
        return np.asarray(image.convert("RGB")).astype(int)


def orange(image: np.ndarray) -> int:
    """How many pixels have the colour of housings."""
    return int(
        np.sum(
            (image[..., 0] > 150)
            & (image[..., 2] < 0.6 * image[..., 0])
            & (image[..., 1] < 0.85 * image[..., 0])
        )
    )


def until_drawn(browser: Any, seconds: float = 600.0) -> np.ndarray:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        image = picture(browser)
        if orange(image[:, :450]) > 400:
            return image
        time.sleep(0.5)
    pytest.fail("the robot did not appear in the page")


def complaints(browser: Any) -> list[str]:
    return [
        entry["message"]
        for entry in browser.get_log("browser")
        if entry["level"] == "SEVERE" and "ERR_CONNECTION_REFUSED" not in entry["message"]
    ]


def test_page_draws_the_robot_plays_and_shows_what_is_inside(browser: Any) -> None:
    model = bundled_robot("ur10e")
    motion = QuinticMotion.between(
        [0.0, -1.0, 1.0, 0.0, 0.0, 0.0], [1.5, -0.5, 0.5, 1.0, 1.0, 1.0], 3.0
    )
    viewer = Viewer(model, motion, port=8300)
    done = threading.Event()
    player = threading.Thread(target=viewer.serve, kwargs={"until": done.is_set})
    player.start()
    try:
        browser.get(viewer.url)
        first = until_drawn(browser)
        time.sleep(1.0)
        assert np.abs(picture(browser)[:, :450] - first[:, :450]).max() > 50, "nothing moves"
        green = np.sum(
            (first[:, :450, 1] > first[:, :450, 0] + 20)
            & (first[:, :450, 1] > first[:, :450, 2] + 10)
        )
        label = browser.find_element("xpath", "//label[normalize-space()='inertia ellipsoids']")
        browser.execute_script(
            "document.getElementById(arguments[0]).click()", label.get_attribute("for")
        )
        end = time.monotonic() + 600
        while time.monotonic() < end:
            image = picture(browser)[:, :450]
            if (
                np.sum((image[..., 1] > image[..., 0] + 20) & (image[..., 1] > image[..., 2] + 10))
                > green + 300
            ):
                break
            time.sleep(0.5)
        else:
            pytest.fail("no ellipsoids appeared")
        assert complaints(browser) == []
    finally:
        done.set()
        player.join()
        viewer.close()


def test_saved_page_needs_no_server(browser: Any, tmp_path: Path) -> None:
    viewer = Viewer(
        bundled_robot("scara"),
        QuinticMotion.between([0.0, 0.0, 0.0, 0.0], [1.0, -1.0, 0.1, 1.0], 2.0),
        port=8330,
    )
    text = viewer.page()
    viewer.close()
    assert "http://127.0.0.1" not in text
    path = tmp_path / "scara.html"
    path.write_text(text, encoding="utf-8")
    browser.get("about:blank")
    browser.get_log("browser")
    browser.get(path.as_uri())
    end = time.monotonic() + 600
    while time.monotonic() < end and np.std(picture(browser)) < 12:
        time.sleep(0.5)
    assert np.std(picture(browser)) > 12
    assert complaints(browser) == []


def test_links_stand_where_kinematics_puts_them() -> None:
    model = bundled_robot("franka-panda")
    viewer = Viewer(model, port=8360)
    try:
        q = np.linspace(-0.5, 0.5, 7)
        viewer._pose(q)
        for handle, pose in zip(viewer._links, link_poses(model, q), strict=True):
            np.testing.assert_allclose(handle.position, pose[:3, 3], atol=1e-6)
        assert len(viewer._layers["inertia ellipsoids"]) == 7
    finally:
        viewer.close()


@pytest.mark.parametrize("kind", ["rod", "housing"])
def test_meshes_are_closed_and_seen_from_outside(kind: str) -> None:
    solid = Solid(0, kind, np.array([0.1, 0.2, 0.3]), np.array([0.4, 0.0, 0.9]), 0.05)  # type: ignore[arg-type]
    vertices, faces = build_round_mesh(solid, slices=96, rings=33)
    corners = vertices[faces]
    volume = (
        np.sum(np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))) / 6
    )
    cylinder = np.pi * 0.05**2 * solid.length
    assert volume == pytest.approx(
        cylinder + (4 / 3 * np.pi * 0.05**3 if kind == "rod" else 0.0), rel=0.01
    )


def test_a_taken_port_is_passed_over_and_a_wrong_one_refused() -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        taken = other.getsockname()[1]
        viewer = Viewer(bundled_robot("two-link"), port=taken)
        viewer.close()
        assert taken < viewer.port < taken + 20
    with pytest.raises(UsageError, match="a port is a number from 1 to 65535, got 0"):
        Viewer(bundled_robot("two-link"), port=0)


def test_without_viser_the_error_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(
        MissingExtraError,
        match=(
            r"the 3-D view needs the package viser, which is not installed; run pip install [\w ]+,"
            r" or pip install 'asbuilt\[view\]'"
        ),
    ):
        Viewer(bundled_robot("two-link"))
