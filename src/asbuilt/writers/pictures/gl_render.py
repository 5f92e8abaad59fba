"""Pictures rendered by MuJoCo without a screen (EGL or OSMesa)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from importlib import import_module
from itertools import pairwise
from types import ModuleType
from typing import Any
from xml.etree.ElementTree import Element, SubElement, fromstring, tostring

import numpy as np

from asbuilt.arrays import Array, Image
from asbuilt.description.formats.mjcf_text import mjcf_text
from asbuilt.description.inertia import LinkInertia
from asbuilt.description.model import DriveValues
from asbuilt.writers.pictures.motion_view import MotionView

PATH_COLOUR = (0.0, 0.447, 0.698, 1.0)
ANY_BODY = LinkInertia.from_com(1.0, np.zeros(3), np.eye(3))
"""Inertia of every link; pictures do not depend on it."""


def offscreen_context(width: int, height: int) -> Any | None:
    """Return a current OpenGL context that needs no screen, or None."""
    for backend in ("egl", "osmesa"):
        try:
            context = import_module(f"mujoco.{backend}").GLContext(width, height)
            context.make_current()
        except (
            Exception
        ):  # an OpenGL that is missing, broken or without a device fails in many ways
            continue
        return context
    return None


def rendered_frames(view: MotionView, context: Any, width: int, height: int) -> Iterator[Image]:
    """Yield every frame of a motion as an image (height, width, 3), antialiased."""
    mujoco = import_module("mujoco")
    w, h = 2 * width, 2 * height
    compiled = mujoco.MjModel.from_xml_string(_scene_text(view, w, h))
    data, scene, options = (
        mujoco.MjData(compiled),
        mujoco.MjvScene(compiled, maxgeom=len(view.path) + 200),
        mujoco.MjvOption(),
    )
    options.geomgroup[:] = 1
    options.sitegroup[:] = 0
    camera = mujoco.MjvCamera()
    camera.lookat[:] = view.centre
    camera.azimuth, camera.elevation = 135.0, -18.0
    camera.distance = view.radius / np.sin(np.deg2rad(compiled.vis.global_.fovy) / 2) * 0.92
    resources = mujoco.MjrContext(compiled, mujoco.mjtFontScale.mjFONTSCALE_100.value)
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, resources)
    window = mujoco.MjrRect(0, 0, w, h)
    order = [
        mujoco.mj_name2id(compiled, mujoco.mjtObj.mjOBJ_JOINT, joint.name)
        for joint in view.model.moving_joints
    ]
    image = np.empty((h, w, 3), dtype=np.uint8)
    try:
        for q in view.q:
            data.qpos[order] = view.model.link_positions(q)
            mujoco.mj_kinematics(compiled, data)
            mujoco.mj_camlight(compiled, data)
            mujoco.mjv_updateScene(
                compiled, data, options, None, camera, mujoco.mjtCatBit.mjCAT_ALL.value, scene
            )
            _draw_path(mujoco, scene, view.path, 0.003 * view.radius)
            mujoco.mjr_render(window, scene, resources)
            mujoco.mjr_readPixels(image, None, window, resources)
            yield (
                np.flipud(image).reshape(height, 2, width, 2, 3).mean(axis=(1, 3)).astype(np.uint8)
            )
    finally:
        resources.free()
        context.free()


def _scene_text(view: MotionView, width: int, height: int) -> str:
    model = view.model
    plain = replace(
        model,
        joints=tuple(replace(joint, drive=DriveValues()) for joint in model.joints),
        links=tuple(replace(link, inertia=ANY_BODY, parts=()) for link in model.links),
    )
    root = fromstring(mjcf_text(plain, actuators=False))
    for old in (*root.findall("visual"), *root.findall("statistic")):
        root.remove(old)
    visual = SubElement(root, "visual")
    SubElement(visual, "global", offwidth=str(width), offheight=str(height), fovy="32")
    SubElement(
        visual,
        "headlight",
        ambient="0.35 0.35 0.36",
        diffuse="0.35 0.35 0.35",
        specular="0.1 0.1 0.1",
    )
    SubElement(visual, "quality", shadowsize="2048", offsamples="0", numslices="36", numstacks="10")
    SubElement(visual, "map", znear="0.01", zfar="12", shadowclip="1.5", haze="0.55")
    SubElement(visual, "rgba", haze="1 1 1 1")
    SubElement(root, "statistic", extent=repr(view.radius), center=_triple(view.centre))
    assets = SubElement(root, "asset")
    SubElement(
        assets,
        "texture",
        type="skybox",
        builtin="flat",
        rgb1="1 1 1",
        rgb2="1 1 1",
        width="64",
        height="64",
    )
    SubElement(
        assets,
        "texture",
        name="tiles",
        type="2d",
        builtin="checker",
        rgb1="0.93 0.94 0.95",
        rgb2="0.89 0.90 0.92",
        width="512",
        height="512",
    )
    SubElement(
        assets,
        "material",
        name="floor",
        texture="tiles",
        texrepeat="4 4",
        texuniform="true",
        reflectance="0",
    )
    world = root.find("worldbody")
    if world is not None:
        _floor(world, view)
        SubElement(
            world,
            "light",
            directional="false",
            cutoff="75",
            exponent="0",
            attenuation="1 0 0",
            pos=_triple(view.centre + 4.0 * view.radius * (view.up + 0.3 * _sideways(view.up))),
            dir=_triple(-(view.up + 0.3 * _sideways(view.up))),
            diffuse="0.55 0.55 0.55",
            specular="0.2 0.2 0.2",
            castshadow="true",
        )
    return tostring(root, encoding="unicode")


def _floor(world: Element, view: MotionView) -> None:
    SubElement(
        world,
        "geom",
        type="plane",
        material="floor",
        size="0 0 0.1",
        pos=_triple(view.floor * view.up),
        zaxis=_triple(view.up),
        contype="0",
        conaffinity="0",
    )
    stand = {"type": "cylinder", "rgba": "0.45 0.47 0.50 1", "contype": "0", "conaffinity": "0"}
    for solid in view.stand:
        place = f"{_triple(solid.start)} {_triple(solid.stop)}"
        SubElement(world, "geom", {**stand, "fromto": place, "size": repr(solid.radius)})


def _draw_path(mujoco: ModuleType, scene: Any, path: Array, radius: float) -> None:
    for start, stop in pairwise(path):
        if scene.ngeom >= scene.maxgeom:
            return
        geom = scene.geoms[scene.ngeom]
        colour = np.array(PATH_COLOUR, dtype=np.float32)
        mujoco.mjv_initGeom(
            geom, mujoco.mjtGeom.mjGEOM_CAPSULE.value, np.zeros(3), np.zeros(3), np.zeros(9), colour
        )
        mujoco.mjv_connector(geom, mujoco.mjtGeom.mjGEOM_CAPSULE.value, radius, start, stop)
        geom.category = mujoco.mjtCatBit.mjCAT_DECOR.value
        scene.ngeom += 1


def _sideways(up: Array) -> Array:
    """Return a unit vector square to `up`, towards the camera where up is z."""
    other = np.cross(up, [0.6, 0.8, 0.0] if abs(up[2]) > 0.5 else [0.0, 0.0, 1.0])
    return np.asarray(other / np.linalg.norm(other))


def _triple(values: Array) -> str:
    return " ".join(repr(float(value)) for value in values)
