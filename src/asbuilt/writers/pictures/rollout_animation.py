"""Animation of a rollout: measured robot next to its simulations by CAD and as built."""

from __future__ import annotations

import io
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image as Pillow
from PIL import ImageDraw, ImageFont

from asbuilt.arrays import Array, Image
from asbuilt.description import ROOT, RobotModel, link_solids, load_robot
from asbuilt.dynamics.kinematics import link_poses
from asbuilt.errors import UsageError
from asbuilt.excitation import Motion, read_motion
from asbuilt.validation import Rollout, SimulatedMotion, position_unit
from asbuilt.writers.pictures.skeleton import Camera, MotionView, draw_skeleton_frames, place_ends
from asbuilt.writers.pictures.viewer import Viewer
from asbuilt.writing import atomic_write

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
    model = load_robot(robot)
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


FACTORS = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1000.0)
"""Factors by which errors are enlarged."""
COLOURS = {"CAD": (217, 115, 26), "as built": (33, 102, 172)}
TITLES = {"CAD": "before, by CAD", "as built": "after, as built"}
DARK = (40, 44, 52)
QUIET = (120, 126, 136)
PALE = (226, 229, 234)
WIDTH = 780
STRIP = 118
TITLE = 46
MARGIN = 12
"""Width of the picture, heights of the curves and the titles, and free border [pixels]."""


@dataclass(frozen=True, slots=True, eq=False)
class _Shown:
    """Times of the film (N,) [s], positions and errors (N, n) by robot, and what enlarges them."""

    t: Array
    q: Array
    errors: dict[str, Array]
    factor: float


def write_rollout_animation(
    path: str | os.PathLike[str],
    model: RobotModel,
    rollout: Rollout,
) -> Path:
    """Write a rollout's first recording as an animation (`.gif` or `.webp`) in real time.

    One panel for each robot that was simulated: the measured motion as a solid robot, the simulated
    one as lines whose distance to it is enlarged by the factor that is stated. Below, the error
    over time. Every window starts in the measured state; time between windows is left out.

    Parameters
    ----------
    path
        File to write.
    model
        The robot.
    rollout
        Its rollout.

    Raises
    ------
    UsageError
        If the suffix is unknown, or no robot was simulated.
    """
    shown = _select_frames(rollout.motions[0])
    return write_frames(path, [*_draw_frames(model, shown, rollout)], float(shown.t[-1]))


def _select_frames(motion: SimulatedMotion) -> _Shown:
    """Return the frames of the first windows, one after another."""
    cut = motion.windows
    paths = (("CAD", motion.cad), ("as built", motion.as_built))
    given = {name: path for name, path in paths if path is not None}
    if not given:
        raise UsageError(f"no robot of {cut.source} could be simulated, so there is no animation")
    # Longest part of a recording that is shown [s].
    count = max(1, min(cut.n_windows, int(6.0 / cut.horizon)))
    # Frames per second [Hz].
    every = max(1, round(cut.rate / 12.5))
    t = (cut.starts[:count, None] + cut.times).ravel()[::every]
    measured = cut.q[:count].reshape(-1, cut.q.shape[2])[::every]
    errors = {
        name: path[:count].reshape(-1, path.shape[2])[::every] - measured
        for name, path in given.items()
    }
    # A simulation that diverges, or a gap of the log, has no pose to draw.
    drawn = np.isfinite(np.column_stack([measured, *errors.values()])).all(axis=1)
    if not drawn.any():
        raise UsageError(f"no simulated pose of {cut.source} is finite, so there is no animation")
    t = t[drawn]
    measured = measured[drawn]
    errors = {name: error[drawn] for name, error in errors.items()}
    worst = max(float(np.sqrt(np.mean(error**2))) for error in errors.values())
    # Error of the worse simulation as it is drawn [rad or m], root mean square over joints.
    factor = max((factor for factor in FACTORS if factor * worst <= 0.12), default=1.0)
    return _Shown(_close_gaps(t), measured, errors, factor)


def _close_gaps(t: Array) -> Array:
    """Return times from zero that pass over gaps between windows in one usual step."""
    steps = np.diff(t)
    usual = float(np.median(steps)) if len(steps) else 0.0
    return np.concatenate([[0.0], np.cumsum(np.where(steps > 1.5 * usual, usual, steps))])


def _draw_frames(model: RobotModel, shown: _Shown, rollout: Rollout) -> Iterator[Image]:
    panel = (WIDTH - (len(shown.errors) + 1) * MARGIN) // len(shown.errors)
    size = (panel, round(0.66 * panel))
    view = MotionView.of(model, shown.t, shown.q)
    view = replace(view, path=view.path[:1].repeat(2, axis=0))
    camera = Camera.around(view, *size)
    lines = {name: _project_lines(model, camera, shown, name) for name in shown.errors}
    canvas = Pillow.new("RGB", (WIDTH, TITLE + size[1] + STRIP + 2 * MARGIN), "white")
    boxes = _write_titles(canvas, shown, rollout, size)
    curves = _draw_axes(canvas, shown, TITLE + size[1] + MARGIN, position_unit(model))
    for k, robot in enumerate(draw_skeleton_frames(view, *size)):
        frame = canvas.copy()
        for name, left in boxes.items():
            picture = Pillow.fromarray(robot).convert("L").convert("RGB")
            _draw_simulated(ImageDraw.Draw(picture), lines[name][k], COLOURS[name], panel)
            frame.paste(picture, (left, TITLE))
        draw = ImageDraw.Draw(frame)
        for name, points in curves.items():
            known = [point for point in points[: k + 1] if np.isfinite(point[1])]
            if len(known) > 1:
                draw.line(known, fill=COLOURS[name], width=2)
            x, y = points[k]
            if np.isfinite(y):
                draw.ellipse((x - 3, y - 3, x + 3, y + 3), fill=COLOURS[name])
        yield np.asarray(frame)


def _project_lines(model: RobotModel, camera: Camera, shown: _Shown, name: str) -> Array:
    """Return the ends of the simulated robot's rods in the picture, shape (N, rods, 2, 2)."""
    poses = link_poses(model, shown.q + shown.factor * shown.errors[name])
    rods = [solid for solid in link_solids(model) if solid.kind == "rod" and solid.link != ROOT]
    ends = [[camera.project(end)[0] for end in place_ends(rod, poses)] for rod in rods]
    return np.asarray(ends).transpose(2, 0, 1, 3)


def _draw_simulated(
    draw: ImageDraw.ImageDraw, rods: Array, colour: tuple[int, int, int], panel: int
) -> None:
    thick = max(2, round(panel / 110))
    for start, stop in rods.tolist() if np.all(np.isfinite(rods)) else ():
        draw.line((*start, *stop), fill=colour, width=thick)
        for x, y in (start, stop):
            draw.ellipse((x - thick, y - thick, x + thick, y + thick), fill=colour)


def _write_titles(
    canvas: Pillow.Image, shown: _Shown, rollout: Rollout, size: tuple[int, int]
) -> dict[str, int]:
    """Write the titles of the panels; return the left edge of each."""
    draw = ImageDraw.Draw(canvas)
    large = ImageFont.load_default(15)
    small = ImageFont.load_default(11)
    legend = "measured: grey, simulated: lines"
    if shown.factor != 1.0:
        legend += f", errors drawn {shown.factor:g} times"
    lefts = {name: MARGIN + k * (size[0] + MARGIN) for k, name in enumerate(shown.errors)}
    for name, left in lefts.items():
        total = {"CAD": rollout.cad, "as built": rollout.as_built}[name]
        title = TITLES[name] + ("" if total is None else f": {total.text}")
        draw.text((left, 6), title, fill=COLOURS[name], font=large)
        draw.text((left, 26), legend, fill=QUIET, font=small)
    return lefts


def _draw_axes(
    canvas: Pillow.Image, shown: _Shown, top: int, unit: str
) -> dict[str, list[tuple[float, float]]]:
    """Draw the axes of the errors; return their points in the picture."""
    draw = ImageDraw.Draw(canvas)
    font = ImageFont.load_default(11)
    left = MARGIN + 34
    right = WIDTH - MARGIN
    bottom = top + STRIP - 22
    # Root mean square over the joints at each time.
    sizes = {name: 1e3 * np.sqrt(np.mean(x**2, axis=1)) for name, x in shown.errors.items()}
    most = _round_up(max(float(np.nanmax(size)) for size in sizes.values()))
    for share in (0.0, 0.5, 1.0):
        y = bottom - share * (bottom - top - 14)
        draw.line((left, y, right, y), fill=PALE)
        draw.text((left - 6, y), f"{share * most:g}", fill=QUIET, font=font, anchor="rm")
    draw.text((left, top - 4), f"error of all joints [{unit}]", fill=DARK, font=font)
    along = left + shown.t / shown.t[-1] * (right - left)
    for second in range(int(shown.t[-1]) + 1):
        x = left + second / shown.t[-1] * (right - left)
        draw.text((x, bottom + 5), f"{second} s", fill=QUIET, font=font, anchor="ma")
    heights = {name: bottom - size / most * (bottom - top - 14) for name, size in sizes.items()}
    return {
        name: [*zip(along.tolist(), height.tolist(), strict=True)]
        for name, height in heights.items()
    }


def _round_up(value: float) -> float:
    """Return the next of 1, 2, 5, 10, ... times a power of ten."""
    power = 10.0 ** np.floor(np.log10(max(value, 1e-9)))
    return float(power * next(x for x in (1.0, 2.0, 5.0, 10.0) if x * power >= value))
