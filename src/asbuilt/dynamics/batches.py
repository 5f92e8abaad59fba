"""Joint arrays, checked once, and their samples distributed among threads."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.kernels.recursion import BLOCK
from asbuilt.errors import UsageError
from asbuilt.executor import count_cores

_WORTH_A_THREAD = 8192
"""Samples that take longer than a thread takes to start."""


def choose_threads(asked: int | None, usual: int) -> int:
    """Return the number of threads asked for, else `usual`; raises UsageError below 1."""
    if asked is not None and asked < 1:
        raise UsageError(
            f"threads must be at least 1, got {asked}; leave it out to use all cores for long"
            " recordings"
        )
    return usual if asked is None else asked


def shape_joint_samples(model: RobotModel, **given: ArrayLike) -> tuple[Array, ...]:
    """Return the arrays as contiguous (n_samples, n_joints), (n_joints,) being one sample.

    Raises `UsageError` where they are not alike, not finite, or of other joints.
    """
    n = model.n_joints
    arrays = []
    shapes = {}
    for name, value in given.items():
        array = np.asarray(value, dtype=np.float64)
        shapes[name] = array.shape
        if array.ndim not in (1, 2) or array.shape[-1] != n:
            raise UsageError(
                f"{name} must have shape ({n},) or (n_samples, {n}) for the {n} joints of"
                f" {model.name}, got {array.shape}"
            )
        if not np.isfinite(array).all():
            sample, joint = np.argwhere(~np.isfinite(np.atleast_2d(array)))[0]
            raise UsageError(
                f"{name} of joint {model.joint_names[joint]!r} is"
                f" {np.atleast_2d(array)[sample, joint]} at sample {sample}; remove or fill such"
                " samples first"
            )
        arrays.append(np.ascontiguousarray(np.atleast_2d(array)))
    if len(set(shapes.values())) > 1:
        raise UsageError(
            "shapes differ: "
            + ", ".join(f"{name} {shape}" for name, shape in shapes.items())
            + "; give one value per sample and joint"
        )
    return tuple(arrays)


def inertial_parameters(model: RobotModel, parameters: ArrayLike | None) -> Array:
    """Return the standard inertial parameters as (n_links, 10).

    The model's own where none are given; raises `UsageError` for another number.
    """
    chi = model.parameters if parameters is None else np.array(parameters, dtype=np.float64)
    if chi.shape != (10 * model.n_links,):
        raise UsageError(
            f"{model.name} has {10 * model.n_links} inertial parameters, got shape {chi.shape};"
            " leave drive parameters out"
        )
    return chi.reshape(-1, 10)


def flatten_array(array: Array) -> Array:
    """Return a one-dimensional read-only view.

    Read-only throughout, so that the kernels are compiled once.
    """
    view = array.reshape(-1)
    view.flags.writeable = False
    return view


def run_over_samples(
    work: Callable[[int, int], object], n_samples: int, threads: int | None = 1
) -> None:
    """Call `work(start, stop)` on ranges of whole blocks that together cover all samples.

    In parallel threads; None chooses their number.
    """
    wanted = choose_threads(threads, min(count_cores(), n_samples // _WORTH_A_THREAD))
    blocks = -(-n_samples // BLOCK)
    parts = max(1, min(wanted, blocks))
    edges = [min(n_samples, BLOCK * (blocks * part // parts)) for part in range(parts + 1)]
    if parts == 1:
        work(0, n_samples)
        return
    with ThreadPoolExecutor(parts) as pool:
        list(pool.map(work, edges[:-1], edges[1:]))
