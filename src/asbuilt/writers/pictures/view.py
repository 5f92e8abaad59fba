"""One call for every view of a robot: picture, animation, page, or the viewer."""

from __future__ import annotations

import io
import os
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from PIL import Image as Pillow

from asbuilt.arrays import Image
from asbuilt.description import RobotModel, load_robot
from asbuilt.errors import UsageError
from asbuilt.excitation import Motion, read_motion
from asbuilt.writers.files import atomic_write
from asbuilt.writers.pictures.motion_view import MotionView
from asbuilt.writers.pictures.skeleton import draw_skeleton_frames
from asbuilt.writers.pictures.viewer import Viewer

STILLS = (".png",)
ANIMATIONS = (".gif", ".webp")


def view_robot(
    robot: RobotModel | str | os.PathLike[str],
    motion: Motion | str | os.PathLike[str] | None = None,
    *,
    save: str | os.PathLike[str] | None = None,
    port: int = 8080,
    progress: Callable[[float], None] | None = None,
) -> Path | Viewer:
    """Save a view of a robot or its motion, or open the viewer.

    Parameters
    ----------
    robot
        Robot, name of a bundled robot, or path of a description.
    motion
        Motion or path of a motion file; without one the robot stands.
    save
        File to write: `.png` (picture), `.gif` or `.webp` (animation), `.html` (a page that plays
        the motion in 3-D; needs viser).
    port
        Port of the viewer if nothing is saved; the next free one if it is taken.
    progress
        Called with the fraction of the frames drawn.

    Returns
    -------
    Path or Viewer
        The file written, or the viewer: `serve()` plays the motion, `close()` stops it.

    Raises
    ------
    UsageError
        If the suffix is unknown, or an animation has no motion.
    MissingExtraError
        If viser is needed and not installed.

    Examples
    --------
    >>> import tempfile
    >>> folder = Path(tempfile.mkdtemp())
    >>> view_robot("two-link", save=folder / "robot.png").name
    'robot.png'
    """
    model = robot if isinstance(robot, RobotModel) else load_robot(robot)
    moved = motion if motion is None or isinstance(motion, Motion) else read_motion(motion, model)
    if save is not None and Path(save).suffix.lower() != ".html":
        return write_picture(save, model, moved, progress=progress)
    viewer = Viewer(model, moved, port=port)
    if save is None:
        return viewer
    try:
        return atomic_write(save, viewer.page())
    finally:
        viewer.close()


def write_picture(
    path: str | os.PathLike[str],
    model: RobotModel,
    motion: Motion | None = None,
    *,
    size: tuple[int, int] = (640, 480),
    progress: Callable[[float], None] | None = None,
) -> Path:
    """Write a robot as a picture (`.png`), or its motion as an animation (`.gif`, `.webp`).

    A picture shows the start and the path of the tip, an animation runs in real time.

    Raises
    ------
    UsageError
        If the suffix is unknown, or an animation has no motion.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in (*STILLS, *ANIMATIONS):
        raise UsageError(
            f"a picture is written as {', '.join((*STILLS, *ANIMATIONS))}, not as"
            f" {Path(path).name!r}"
        )
    moving = suffix in ANIMATIONS
    if moving and motion is None:
        raise UsageError(
            f"{Path(path).name} would be an animation, but there is no motion; give one, or write a"
            " .png"
        )
    # Frames of an animation per second [Hz].
    # 125: longer motions are shown with fewer frames per second.
    view = MotionView.of_motion(model, motion, most=125 if moving else 2, rate=12.5)
    images: list[Image] = []
    for image in draw_skeleton_frames(view if moving else view.first(), *size):
        images.append(image)
        if progress is not None:
            progress(len(images) / len(view.t))
    return write_frames(path, images, float(view.t[-1]) if moving else 0.0)


def write_frames(path: str | os.PathLike[str], images: Sequence[Image], seconds: float) -> Path:
    """Write images (height, width, 3) as a file that shows them in so many seconds, over and over.

    Raises `UsageError` for several images if no animation has the suffix.
    """
    suffix = Path(path).suffix.lower()
    if len(images) > 1 and suffix not in ANIMATIONS:
        raise UsageError(f"an animation is written as .gif or .webp, not as {Path(path).name!r}")
    frames = [Pillow.fromarray(image) for image in images]
    if suffix == ".gif":
        several = Pillow.fromarray(np.concatenate(images[:: max(1, len(images) // 8)]))
        palette = several.quantize(255, dither=Pillow.Dither.NONE)
        frames = [frame.quantize(palette=palette, dither=Pillow.Dither.NONE) for frame in frames]
    # 655_350: milliseconds between frames; GIF has 16 bits for hundredths of a second.
    pause = min(round(1000 * seconds / max(1, len(frames) - 1)), 655_350)
    film = {"save_all": True, "append_images": frames[1:], "duration": pause, "loop": 0}
    how = {".gif": {**film, "optimize": False}, ".webp": {**film, "quality": 80}}
    stream = io.BytesIO()
    frames[0].save(stream, suffix[1:].upper(), **how.get(suffix, {}))
    return atomic_write(path, stream.getvalue())
