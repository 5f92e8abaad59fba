"""Pictures must show the robot where kinematics puts it, whichever way they are drawn."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from asbuilt.description.catalogue import bundled_robot
from asbuilt.errors import UsageError
from asbuilt.excitation.motions.quintic import QuinticMotion
from asbuilt.excitation.motions.random_motion import random_fourier
from asbuilt.writers.pictures.animation import picture_frames, write_picture
from asbuilt.writers.pictures.gl_render import offscreen_context
from asbuilt.writers.pictures.motion_view import MotionView

STYLES = ("rendered", "skeleton")


def usable(style: str) -> str:
    if style == "rendered":
        context = offscreen_context(64, 64)
        if context is None:
            pytest.skip("no OpenGL without a screen on this machine")
        context.free()
    return style


@pytest.mark.parametrize("style", STYLES)
@pytest.mark.study
def test_every_robot_is_drawn_within_the_picture(style: str) -> None:
    usable(style)
    for name in ("scara", "ur10e", "g1-arms"):
        model = bundled_robot(name)
        view = MotionView.of_motion(model, random_fourier(model, 1, duration=4.0), most=3)
        frames = list(picture_frames(view, 160, 120, style=style))  # type: ignore[arg-type]
        assert len(frames) == 3
        for frame in frames:
            assert frame.shape == (120, 160, 3)
            orange = (frame[..., 0] > 100) & (frame[..., 2] < 0.55 * frame[..., 0])
            assert 20 < orange.sum() < 0.3 * orange.size, name
            rows, columns = np.nonzero(orange)
            assert 0 < rows.min() < rows.max() < 119
            assert 0 < columns.min() < columns.max() < 159
        assert np.any(frames[0] != frames[1])


@pytest.mark.parametrize(("style", "suffix"), [("rendered", "webp"), ("skeleton", "gif")])
@pytest.mark.study
def test_animation_has_the_length_of_the_motion(style: str, suffix: str, tmp_path: Path) -> None:
    usable(style)
    model = bundled_robot("two-link")
    motion = QuinticMotion.between([0.0, 0.0], [1.0, -1.0], 1.6)
    seen: list[float] = []
    path = write_picture(
        tmp_path / f"a.{suffix}", model, motion, size=(120, 90), style=style, progress=seen.append
    )  # type: ignore[arg-type]
    with Image.open(path) as animation:
        assert animation.n_frames == 20
        assert animation.size == (120, 90)
        duration = 0.0
        for k in range(animation.n_frames):
            animation.seek(k)
            animation.load()
            duration += animation.info["duration"] / 1000
    assert duration == pytest.approx(1.6, rel=0.07)
    assert seen[-1] == 1.0


def test_space_of_a_motion_holds_every_body() -> None:
    model = bundled_robot("ur10e")
    view = MotionView.of_motion(model, random_fourier(model, 3, duration=5.0), most=30)
    for solid in view.solids:
        for end in (solid.start, solid.stop):
            points = view.poses[:, solid.link, :3, :3] @ end + view.poses[:, solid.link, :3, 3]
            assert np.all(np.linalg.norm(points - view.centre, axis=1) < view.radius)
            assert np.all(points @ view.up > view.floor)
    flange = model.frames[-1]
    expected = view.poses[-1, 5] @ flange.placement
    np.testing.assert_allclose(view.path[-1], expected[:3, 3], atol=1e-12)


def test_up_is_against_gravity() -> None:
    model = bundled_robot("ur10e").with_gravity([0.0, 9.81, 0.0])
    np.testing.assert_allclose(MotionView.of_motion(model, None).up, [0.0, -1.0, 0.0])
    for style in STYLES:
        usable(style)
        assert (
            next(iter(picture_frames(MotionView.of_motion(model, None), 80, 60, style=style))).std()
            > 5
        )  # type: ignore[arg-type]


def test_wrong_pictures_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = bundled_robot("two-link")
    with pytest.raises(
        UsageError, match=r"a picture is written as \.png, \.gif, \.webp, not as 'a\.jpg'"
    ):
        write_picture(tmp_path / "a.jpg", model)
    with pytest.raises(UsageError, match="there is no motion"):
        write_picture(tmp_path / "a.gif", model)
    with pytest.raises(UsageError, match="needs finite positions of shape"):
        MotionView.of(model, [0.0], [[0.0]])
    monkeypatch.setattr("asbuilt.writers.pictures.animation.offscreen_context", lambda *_: None)
    with pytest.raises(UsageError, match="use the style skeleton"):
        write_picture(tmp_path / "a.png", model, style="rendered")
    assert write_picture(tmp_path / "a.png", model).read_bytes()[:4] == b"\x89PNG"
