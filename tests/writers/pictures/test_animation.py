"""Pictures must show the robot where kinematics puts it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from asbuilt.description import bundled_robot
from asbuilt.errors import UsageError
from asbuilt.excitation import QuinticMotion, random_fourier
from asbuilt.writers import write_picture
from asbuilt.writers.pictures.skeleton import MotionView, draw_skeleton_frames


@pytest.mark.study
def test_every_robot_is_drawn_within_the_picture() -> None:
    for name in ("scara", "ur10e", "g1-arms"):
        model = bundled_robot(name)
        view = MotionView.of_motion(model, random_fourier(model, 1, duration=4.0), most=3)
        frames = list(draw_skeleton_frames(view, 160, 120))
        assert len(frames) == 3
        for frame in frames:
            assert frame.shape == (120, 160, 3)
            orange = (frame[..., 0] > 100) & (frame[..., 2] < 0.55 * frame[..., 0])
            assert 20 < orange.sum() < 0.3 * orange.size, name
            rows, columns = np.nonzero(orange)
            assert 0 < rows.min() < rows.max() < 119
            assert 0 < columns.min() < columns.max() < 159
        assert np.any(frames[0] != frames[1])


@pytest.mark.parametrize("suffix", ["webp", "gif"])
@pytest.mark.study
def test_animation_has_the_length_of_the_motion(suffix: str, tmp_path: Path) -> None:
    model = bundled_robot("two-link")
    motion = QuinticMotion.between([0.0, 0.0], [1.0, -1.0], 1.6)
    seen: list[float] = []
    file = tmp_path / f"a.{suffix}"
    path = write_picture(file, model, motion, size=(120, 90), progress=seen.append)
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
    assert next(draw_skeleton_frames(MotionView.of_motion(model, None), 80, 60)).std() > 5


def test_wrong_pictures_are_refused(tmp_path: Path) -> None:
    model = bundled_robot("two-link")
    with pytest.raises(
        UsageError, match=r"a picture is written as \.png, \.gif, \.webp, not as 'a\.jpg'"
    ):
        write_picture(tmp_path / "a.jpg", model)
    with pytest.raises(UsageError, match="there is no motion"):
        write_picture(tmp_path / "a.gif", model)
    with pytest.raises(UsageError, match="needs finite positions of shape"):
        MotionView.of(model, [0.0], [[0.0]])
    assert write_picture(tmp_path / "a.png", model).read_bytes()[:4] == b"\x89PNG"
