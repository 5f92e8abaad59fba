"""A picture or a short animation of a motion as a file."""

from __future__ import annotations

import io
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Literal

import numpy as np
from PIL import Image as Pillow

from asbuilt.arrays import Image
from asbuilt.description.model import RobotModel
from asbuilt.errors import UsageError
from asbuilt.excitation.motions.motion import Motion
from asbuilt.writers.files import atomic_write
from asbuilt.writers.pictures.gl_render import offscreen_context, rendered_frames
from asbuilt.writers.pictures.motion_view import MotionView
from asbuilt.writers.pictures.skeleton import skeleton_frames

Style = Literal["auto", "rendered", "skeleton"]

STILLS, ANIMATIONS = (".png",), (".gif", ".webp")


def write_picture(
    path: str | os.PathLike[str],
    model: RobotModel,
    motion: Motion | None = None,
    *,
    size: tuple[int, int] = (640, 480),
    style: Style = "auto",
    progress: Callable[[float], None] | None = None,
) -> Path:
    """Write a robot as a picture (`.png`), or its motion as an animation (`.gif`, `.webp`).

    A picture shows the start and the path of the tip, an animation runs in real time.

    MuJoCo renders it if it is installed and OpenGL works without a screen (EGL or OSMesa), else it
    is drawn as shaded solids, unless `style` says otherwise.

    Raises
    ------
    UsageError
        If the suffix is unknown, an animation has no motion, or rendering is impossible.
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
    images = []
    for k, image in enumerate(picture_frames(view if moving else view.first(), *size, style=style)):
        images.append(image)
        if progress is not None:
            progress((k + 1) / len(view.t))
    stream = io.BytesIO()
    if not moving:
        Pillow.fromarray(images[0]).save(stream, "PNG")
        return atomic_write(path, stream.getvalue())
    # 655_350: milliseconds between frames; GIF has 16 bits for hundredths of a second.
    pause = min(round(1000 * float(view.t[-1]) / (len(view.t) - 1)), 655_350)
    if suffix == ".gif":
        palette = Pillow.fromarray(np.concatenate(images[:: max(1, len(images) // 8)])).quantize(
            255, dither=Pillow.Dither.NONE
        )
        frames = [
            Pillow.fromarray(image).quantize(palette=palette, dither=Pillow.Dither.NONE)
            for image in images
        ]
        frames[0].save(
            stream,
            "GIF",
            save_all=True,
            append_images=frames[1:],
            duration=pause,
            loop=0,
            optimize=False,
        )
    else:
        first, *rest = (Pillow.fromarray(image) for image in images)
        first.save(
            stream, "WEBP", save_all=True, append_images=rest, duration=pause, loop=0, quality=80
        )
    return atomic_write(path, stream.getvalue())


def picture_frames(
    view: MotionView, width: int, height: int, *, style: Style = "auto"
) -> Iterator[Image]:
    """Yield the frames of a view as images (height, width, 3), in one of the styles."""
    if style not in ("auto", "rendered", "skeleton"):
        raise UsageError(f"style {style!r} is not one of auto, rendered, skeleton")
    context = None if style == "skeleton" else offscreen_context(2 * width, 2 * height)
    if context is not None:
        return rendered_frames(view, context, width, height)
    if style == "rendered":
        raise UsageError(
            "rendering without a screen needs MuJoCo and EGL or OSMesa, which do not work here;"
            " use the style skeleton"
        )
    return skeleton_frames(view, width, height)
