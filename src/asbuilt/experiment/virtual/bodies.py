"""Bodies of a virtual robot: tools, other mass distributions, a tilted base."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.inertia import LinkInertia
from asbuilt.description.model import ROOT, RobotModel
from asbuilt.description.rotation import rotation_from_rpy
from asbuilt.dynamics.newton_euler import inverse_dynamics, mass_matrix
from asbuilt.errors import UsageError
from asbuilt.excitation.limits import MotionBounds


def with_body(model: RobotModel, body: LinkInertia, at: str | None = None) -> RobotModel:
    """Return the robot with a body welded to a link or frame `at`, by default the last link.

    The body's inertia is given in the axes of that link or frame.

    Raises
    ------
    UsageError
        If the robot has no moving link or frame of that name.
    """
    index, placement = _flange(model, at)
    link, carried = model.links[index], body.moved(placement)
    links = list(model.links)
    links[index] = replace(
        link,
        inertia=link.inertia + carried,
        parts=(*(link.parts or ((link.name, link.inertia),)), ("tool", carried)),
    )
    return replace(model, links=tuple(links))


def perturbed_links(model: RobotModel, fraction: float, rng: np.random.Generator) -> RobotModel:
    """Return the robot with every link stretched, sheared, shifted and scaled by about `fraction`.

    The pseudo-inertia becomes `s A J A^T` with `s = exp(fraction N)`, `A = [[1 + fraction N / 2,
    fraction r N / 2], [0, 1]]`, N standard normal, r the radius of gyration. A consistent link
    stays consistent, since congruence keeps J positive definite (Wensing et al. 2018).
    """
    links = []
    for link in model.links:
        J = link.inertia.pseudo_inertia
        radius = np.sqrt(max(np.trace(J[:3, :3]), 0.0) / J[3, 3]) if J[3, 3] > 0 else 0.0
        A = np.eye(4)
        A[:3, :3] += fraction / 2 * rng.normal(size=(3, 3))
        A[:3, 3] = fraction / 2 * radius * rng.normal(size=3)
        scale = np.exp(fraction * rng.normal())
        inertia = LinkInertia.from_pseudo_inertia(scale * A @ J @ A.T)
        links.append(replace(link, inertia=inertia, parts=()))
    return replace(model, links=tuple(links))


def tilted_base(model: RobotModel, roll: float, pitch: float) -> RobotModel:
    """Return the robot with its root turned by small angles [rad] about x, then y."""
    return model.with_gravity(rotation_from_rpy([roll, pitch, 0.0]).T @ model.gravity)


def torque_and_inertia(model: RobotModel, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return torque range and mean inertia of each joint, two (n,).

    The torque range is the limit, or without one the largest torque at random states.
    """
    bounds = MotionBounds.assumed(model)
    low = np.stack([bounds.lower, -bounds.velocity, -bounds.acceleration])
    high = np.stack([bounds.upper, bounds.velocity, bounds.acceleration])
    q, qd, qdd = (rng.uniform(low[k], high[k], size=(64, model.n_joints)) for k in range(3))
    largest = np.max(np.abs(inverse_dynamics(model, q, qd, qdd)), axis=0)
    inertia = np.mean(np.diagonal(mass_matrix(model, q), axis1=1, axis2=2), axis=0)
    return np.where(np.isfinite(bounds.torque), bounds.torque, np.maximum(largest, 1.0)), inertia


def _flange(model: RobotModel, at: str | None) -> tuple[int, Array]:
    if at is None:
        return model.tool_link, np.eye(4)
    if at in model.link_names:
        return model.link_names.index(at), np.eye(4)
    for frame in model.frames:
        if frame.name == at and frame.link != ROOT:
            return frame.link, frame.placement
    names = [*model.link_names, *(frame.name for frame in model.frames if frame.link != ROOT)]
    raise UsageError(
        f"{model.name} has no moving link or frame {at!r} to carry a tool; it has"
        f" {', '.join(names)}",
        value=at,
        available=names,
    )
