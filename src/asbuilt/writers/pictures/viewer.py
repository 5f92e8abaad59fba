"""Viewer of a robot in 3-D in the browser: motion, frames, mass properties (viser)."""

from __future__ import annotations

import contextlib
import io
import socket
import time
from collections.abc import Callable, Iterator
from functools import partial
from importlib import import_module
from typing import Any

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description import ROOT, RobotModel, quaternion_from_rotation, rotation_onto
from asbuilt.description.appearance import Solid, inertia_ellipsoid
from asbuilt.dynamics.kinematics import link_poses
from asbuilt.errors import MissingExtraError, UsageError
from asbuilt.excitation import Motion, MotionBounds
from asbuilt.findings import Cure
from asbuilt.writers.pictures.skeleton import MotionView, build_round_mesh

BODY_COLOURS = {"rod": (205, 208, 213), "housing": (226, 122, 32)}
STAND = (96, 101, 108)
PATH = (0, 114, 178)
COM = (20, 20, 24)
INERTIA = (0, 158, 115)


BODY_OPACITY = 0.35
"""Opacity of the bodies while something inside them is shown."""
FRAME_RATE = 30.0
"""Poses sent per second [Hz]."""
HOST = "127.0.0.1"
"""Address of the page, which this computer alone can open."""
PORTS = 20
"""Ports from the wanted one on that are tried."""
DISTANCE = 2.7
BESIDE_PANEL = 0.3
"""Distance of the camera and its sideways offset from the panel, in radii of the scene."""


class Viewer:
    """A page that shows a robot in 3-D and, where there is a motion, plays it.

    Bodies are rods and housings drawn from the geometry. Per link it can show the frame, the centre
    of mass, and the ellipsoid of uniform density that has the link's inertia; links with physically
    inconsistent inertia have a point but no ellipsoid. Without a motion each joint has a slider.

    Raises
    ------
    MissingExtraError
        If viser is not installed.
    UsageError
        If no port from `port` on is free.
    """

    def __init__(
        self,
        model: RobotModel,
        motion: Motion | None = None,
        *,
        port: int = 8080,
    ) -> None:
        try:
            viser = import_module("viser")
        except ImportError:
            raise MissingExtraError("viser", "view", "the 3-D view") from None
        self.model = model
        self.motion = motion
        # 600: most poses in a saved page.
        self.view = MotionView.of_motion(model, motion, most=600, rate=FRAME_RATE)
        self.port = _find_free_port(port)
        with contextlib.redirect_stdout(io.StringIO()), _refuse_foreign_origins(self.port):
            self.server: Any = viser.ViserServer(
                host=HOST, port=self.port, label=f"asbuilt: {model.name}", verbose=False
            )
        self._links: list[Any] = []
        self._layers: dict[str, list[Any]] = {
            "bodies": [],
            "frames": [],
            "centres of mass": [],
            "inertia ellipsoids": [],
            "path of the tip": [],
        }
        self._build_scene()
        self._pose(self.view.q[0])

    def __repr__(self) -> str:
        return f"Viewer({self.model.name!r}, {self.url})"

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://{self.server.get_host()}:{self.port}"

    def page(self) -> str:
        """Return one self-contained HTML page that shows the robot and plays the motion."""
        self._show(dict.fromkeys(self._layers, True), opacity=BODY_OPACITY)
        recorder = self.server.get_scene_serializer()
        pause = float(self.view.t[-1]) / max(1, len(self.view.t) - 1)
        for q in self.view.q if len(self.view.t) > 1 else ():
            self._pose(q)
            recorder.insert_sleep(pause)
        return str(recorder.as_html())

    def serve(self, *, until: Callable[[], bool] | None = None) -> None:
        """Play the motion again and again until interrupted or `until()` is true."""
        controls = _Controls(self)
        last = time.perf_counter()
        while until is None or not until():
            now = time.perf_counter()
            controls.advance(now - last)
            last = now
            time.sleep(1.0 / FRAME_RATE)

    def close(self) -> None:
        """Stop the server."""
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    def _build_scene(self) -> None:
        scene = self.server.scene
        view = self.view
        model = self.model
        scene.set_up_direction(tuple(view.up))
        scene.configure_default_lights(cast_shadow=True)
        scene.add_grid(
            "/floor",
            width=8 * view.radius,
            height=8 * view.radius,
            cell_size=0.1,
            section_size=0.5,
            cell_color=(228, 231, 235),
            section_color=(205, 209, 214),
            plane_color=(250, 250, 251),
            plane_opacity=1.0,
            shadow_opacity=0.2,
            wxyz=_convert_to_wxyz(rotation_onto(view.up)),
            position=tuple((view.floor - 2e-3) * view.up),
        )
        for place, solid in zip(("/stand", "/column"), view.stand, strict=False):
            self._add_mesh(place, solid, STAND)
        for k, link in enumerate(model.links):
            name = f"/links/{k + 1} {link.name.replace('/', '-')}"
            self._links.append(scene.add_frame(name, show_axes=False))
            size = 0.09 * view.radius
            self._layers["frames"].append(
                scene.add_frame(
                    f"{name}/frame",
                    axes_length=size,
                    axes_radius=0.035 * size,
                    origin_radius=0.06 * size,
                    visible=False,
                )
            )
            self._add_inertia(name, k)
        for number, solid in enumerate(view.solids):
            parent = "" if solid.link == ROOT else self._links[solid.link].name
            mesh = self._add_mesh(
                f"{parent}/{solid.kind} {number}", solid, BODY_COLOURS[solid.kind]
            )
            self._layers["bodies"].append(mesh)
        if len(view.path) > 1:
            segments = np.stack([view.path[:-1], view.path[1:]], axis=1).astype(np.float32)
            self._layers["path of the tip"].append(
                scene.add_line_segments("/path", segments, PATH, thickness=0.005 * view.radius)
            )
        camera = self.server.initial_camera
        camera.fov = np.deg2rad(40)
        upright = abs(view.up[2]) > 0.9
        sideways = np.array([0.72, -0.72, 0.0]) if upright else np.cross(view.up, [0.3, 0.5, 0.8])
        towards = sideways + 0.35 * view.up
        across = np.cross(view.up, towards)
        centre = view.centre + BESIDE_PANEL * view.radius * across / np.linalg.norm(across)
        camera.look_at = tuple(centre)
        camera.position = tuple(centre + DISTANCE * view.radius * towards)

    def _add_inertia(self, name: str, k: int) -> None:
        inertia = self.model.links[k].inertia
        size = 0.016 * self.view.radius
        if not inertia.mass > 0.0:
            return
        scene = self.server.scene
        centre = tuple(inertia.com)
        self._layers["centres of mass"].append(
            scene.add_icosphere(
                f"{name}/centre of mass", radius=size, color=COM, position=centre, visible=False
            )
        )
        ellipsoid = inertia_ellipsoid(inertia)
        if ellipsoid is None:
            return
        semi_axes, axes = ellipsoid
        self._layers["inertia ellipsoids"].append(
            scene.add_icosphere(
                f"{name}/inertia ellipsoid",
                radius=1.0,
                color=INERTIA,
                opacity=0.45,
                scale=tuple(np.maximum(semi_axes, 0.1 * size)),
                wxyz=_convert_to_wxyz(axes),
                position=centre,
                cast_shadow=False,
                visible=False,
            )
        )

    def _add_mesh(self, name: str, solid: Solid, colour: tuple[int, int, int]) -> Any:
        vertices, faces = build_round_mesh(solid)
        return self.server.scene.add_mesh_simple(
            name, vertices.astype(np.float32), faces.astype(np.uint32), color=colour
        )

    def _pose(self, q: Array) -> None:
        with self.server.atomic():
            for handle, pose in zip(self._links, link_poses(self.model, q), strict=True):
                handle.wxyz = _convert_to_wxyz(pose[:3, :3])
                handle.position = tuple(pose[:3, 3])

    def _show(self, visible: dict[str, bool], *, opacity: float | None) -> None:
        for layer, shown in visible.items():
            for handle in self._layers[layer]:
                handle.visible = shown
        for handle in self._layers["bodies"]:
            handle.opacity = opacity
            handle.cast_shadow = opacity is None


class _Controls:
    """Panel of the page: what is shown, and a player, or a slider per joint without a motion."""

    def __init__(self, viewer: Viewer) -> None:
        self.viewer = viewer
        # Time in the motion, and time of the pose that is shown [s].
        self.now = 0.0
        self.shown = -1.0
        gui = viewer.server.gui
        model = viewer.model
        motion = viewer.motion
        gui.configure_theme(show_logo=False, show_share_button=False)
        mass = sum(link.inertia.mass for link in model.links)
        gui.add_markdown(f"**{model.name}** - {model.n_joints} joints, {mass:.2f} kg moving")
        with gui.add_folder("Show"):
            self.boxes = {
                layer: gui.add_checkbox(layer, initial_value=layer in ("bodies", "path of the tip"))
                for layer, handles in viewer._layers.items()
                if handles
            }
        for box in self.boxes.values():
            box.on_update(lambda _: self.show())
        if motion is not None:
            with gui.add_folder("Motion"):
                self.playing = gui.add_checkbox("play", initial_value=True)
                self.speed = gui.add_slider("speed", min=0.1, max=3.0, step=0.1, initial_value=1.0)
                self.place = gui.add_slider(
                    "time [s]", min=0.0, max=round(motion.duration, 3), step=0.01, initial_value=0.0
                )
            return
        bounds = MotionBounds.assumed(model)
        with gui.add_folder("Joints"):
            start = np.clip(viewer.view.q[0], bounds.lower + 1e-3, bounds.upper - 1e-3)
            self.sliders = [
                gui.add_slider(
                    f"{joint.name} [{'rad' if joint.is_revolute else 'm'}]",
                    min=round(float(low), 3),
                    max=round(float(high), 3),
                    step=0.001,
                    initial_value=round(float(q), 3),
                )
                for joint, low, high, q in zip(
                    model.joints, bounds.lower, bounds.upper, start, strict=True
                )
            ]
        for slider in self.sliders:
            slider.on_update(
                lambda _: viewer._pose(np.array([entry.value for entry in self.sliders]))
            )

    def show(self) -> None:
        """Show the layers that are ticked; bodies turn to glass where something is inside them."""
        visible = {layer: bool(box.value) for layer, box in self.boxes.items()}
        inside = any(
            visible.get(layer, False)
            for layer in ("frames", "centres of mass", "inertia ellipsoids")
        )
        self.viewer._show(visible, opacity=BODY_OPACITY if inside else None)

    def advance(self, seconds: float) -> None:
        """Move on by so much time, or go where the slider was put."""
        motion = self.viewer.motion
        if motion is None:
            return
        if abs(self.place.value - self.shown) > 0.006 and self.shown >= 0.0:
            self.now = float(self.place.value)
        elif self.playing.value:
            self.now = (self.now + seconds * float(self.speed.value)) % motion.duration
        if round(self.now, 2) != self.shown:
            self.viewer._pose(motion.derivative(self.now))
            self.place.value = self.shown = round(self.now, 2)


def _convert_to_wxyz(rotation: Array) -> tuple[float, ...]:
    return tuple(float(x) for x in quaternion_from_rotation(rotation))


@contextlib.contextmanager
def _refuse_foreign_origins(port: int) -> Iterator[None]:
    """Have the server that is started meanwhile refuse connections from pages of other sites.

    viser has no such setting, so the origins are given to its web socket server. A program without
    an origin is no page of a browser and may connect.
    """
    from websockets.asyncio import server  # noqa: PLC0415 - comes with viser

    origins = [None, f"http://{HOST}:{port}", f"http://localhost:{port}"]
    serve = server.serve
    server.serve = partial(serve, origins=origins)  # type: ignore[misc, assignment, arg-type]
    try:
        yield
    finally:
        server.serve = serve  # type: ignore[misc]


def _find_free_port(port: int) -> int:
    """Return the first free port from `port` on."""
    if not 0 < port < 65536:
        raise UsageError(f"a port is a number from 1 to 65535, got {port}")
    for candidate in range(port, min(port + PORTS, 65536)):
        with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((HOST, candidate))
            except OSError:
                continue
            return candidate
    raise UsageError(
        f"the ports {port} to {port + PORTS - 1} of {HOST} are all taken",
        cure=Cure("use another port", {"port": port + PORTS}),
    )
