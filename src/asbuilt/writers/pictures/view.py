"""One call for every view of a robot: picture, animation, page, or the viewer."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from asbuilt.description.load import load_robot
from asbuilt.description.model import RobotModel
from asbuilt.excitation.motions.motion import Motion
from asbuilt.excitation.motions.motion_csv import read_motion
from asbuilt.writers.files import atomic_write
from asbuilt.writers.pictures.animation import Style, write_picture
from asbuilt.writers.pictures.viewer import Viewer


def view_robot(
    robot: RobotModel | str | os.PathLike[str],
    motion: Motion | str | os.PathLike[str] | None = None,
    *,
    save: str | os.PathLike[str] | None = None,
    style: Style = "auto",
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
    style
        Drawing of pictures: `"rendered"` (MuJoCo and OpenGL), `"skeleton"`, or `"auto"`.
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
    >>> view_robot("two-link", save=folder / "robot.png", style="skeleton").name
    'robot.png'
    """
    model = robot if isinstance(robot, RobotModel) else load_robot(robot)
    moved = motion if motion is None or isinstance(motion, Motion) else read_motion(motion, model)
    if save is not None and Path(save).suffix.lower() != ".html":
        return write_picture(save, model, moved, style=style, progress=progress)
    viewer = Viewer(model, moved, port=port)
    if save is None:
        return viewer
    try:
        return atomic_write(save, viewer.page())
    finally:
        viewer.close()
