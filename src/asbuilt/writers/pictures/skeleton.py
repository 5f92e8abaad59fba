"""A robot drawn as a skeleton with matplotlib.

Rods, joints and the path of the tip, where no OpenGL is at hand.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D

from asbuilt.arrays import Image
from asbuilt.description.model import ROOT
from asbuilt.writers.pictures.motion_view import MotionView

ROD, HOUSING, SHADOW, PATH, STAND = "#8A8F98", "#E07B20", "#D5D9DE", "#0072B2", "#5F656D"
AZIMUTH, ELEVATION = -45.0, 18.0


def skeleton_frames(view: MotionView, width: int, height: int) -> Iterator[Image]:
    """Yield every frame of a motion as an image (height, width, 3)."""
    for k in range(len(view.t)):
        figure = skeleton_figure(view, k, width, height)
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()


def skeleton_figure(view: MotionView, k: int, width: int = 640, height: int = 480) -> Figure:
    """Draw frame k of a motion, `width` x `height` pixels."""
    figure = Figure(figsize=(width / 100, height / 100), dpi=100, facecolor="white")
    axes = figure.add_axes((-0.16, -0.2, 1.32, 1.4), projection="3d", computed_zorder=False)
    assert isinstance(axes, Axes3D)
    axes.set_axis_off()
    axes.view_init(elev=ELEVATION, azim=AZIMUTH)
    half = 0.72 * view.radius
    for set_limits, middle in zip(
        (axes.set_xlim, axes.set_ylim, axes.set_zlim), view.centre, strict=True
    ):
        set_limits(middle - half, middle + half)
    axes.set_box_aspect((1, 1, 1))
    _grid(axes, view)
    scale = 72 * width / 100 * 0.5 / half
    thin = max(1.0, 0.006 * scale * view.radius)
    for solid in sorted(view.solids, key=lambda solid: solid.kind, reverse=True):
        ends = np.stack([solid.start, solid.stop])
        if solid.link != ROOT:
            pose = view.poses[k, solid.link]
            ends = ends @ pose[:3, :3].T + pose[:3, 3]
        flat = ends - np.outer(ends @ view.up - view.floor, view.up)
        axes.plot(
            *flat.T,
            color=SHADOW,
            linewidth=1.1 * solid.radius * scale,
            solid_capstyle="round",
            zorder=1,
        )
        rod = solid.kind == "rod"
        axes.plot(
            *ends.T,
            color=ROD if rod else HOUSING,
            linewidth=(1.2 if rod else 1.6) * solid.radius * scale,
            solid_capstyle="round" if rod else "butt",
            zorder=3 if rod else 4,
        )
    if view.floor < 0.0:
        foot = np.stack([view.floor * view.up, np.zeros(3)])
        axes.plot(
            *foot.T,
            color=STAND,
            linewidth=1.6 * max(solid.radius for solid in view.solids) * scale,
            zorder=2,
        )
    if len(view.path) > 1:
        axes.plot(*view.path.T, color=PATH, linewidth=thin, zorder=2.5)
    return figure


def _grid(axes: Axes3D, view: MotionView) -> None:
    """Draw the floor as a grid around the robot."""
    seed = np.array([1.0, 0.0, 0.0]) if abs(view.up[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    along = np.cross(np.cross(view.up, seed), view.up)
    along /= np.linalg.norm(along)
    other = np.cross(view.up, along)
    reach = 1.1 * view.radius
    for offset in np.linspace(-reach, reach, 9):
        for one, two in ((along, other), (other, along)):
            line = (
                np.stack([offset * one - reach * two, offset * one + reach * two])
                + view.floor * view.up
            )
            axes.plot(*line.T, color="#E4E7EB", linewidth=0.8, zorder=0)
