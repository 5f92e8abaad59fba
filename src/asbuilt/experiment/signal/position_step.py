"""Step of logged positions: resolution of an encoder, or digits of a file."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from asbuilt.arrays import Array
from asbuilt.compilation import kernel

NEAR = 0.1
"""Distance from a multiple of the step, in steps, that counts as on it."""
LARGEST_MULTIPLE = 60.0
"""Typical difference in steps beyond which a step is too fine to be measured."""


def find_position_steps(segments: Sequence[Array]) -> Array:
    """Return the step of the values of each joint (n,), 0 where none is found.

    A joint that takes values on a grid changes between samples by multiples of its step, whatever
    the noise before the quantisation. The step is the largest number of which 0.6 of the
    changes are multiples: of a continuous signal it is about 0.2, and up to 0.4 of them may be off,
    samples that were interpolated or a digit that was lost. `segments` are positions (L, n).

    Examples
    --------
    >>> q = np.round(np.sin(np.arange(2000) / 300.0) / 1e-3) * 1e-3
    >>> find_position_steps([q[:, None]]).round(9).tolist()
    [0.001]
    """
    return np.array(
        [
            _find_step(np.concatenate([np.diff(q[:, k]) for q in segments]))
            for k in range(segments[0].shape[1])
        ]
    )


def _find_step(differences: Array) -> float:
    # Of longer recordings every second, third, ... difference is used.
    # As many differences as decide; more only cost time.
    size = np.abs(differences[:: max(1, differences.size // 20_000)])
    size = size[np.isfinite(size)]
    n_all = size.size
    # Exact zeros and rounding of a division are no steps.
    size = size[size > 1e-9 * max(size.max(initial=0.0), np.finfo(np.float64).tiny)]
    # A step is measured from thirty differences other than 0.
    if size.size < 30:
        return 0.0
    # The standard error of a share of 1000 differences is 0.015, so that a candidate which few of
    # them support is not looked at more closely.
    few = np.ascontiguousarray(size[:: max(1, size.size // 1_000)])
    for candidate in _list_candidates(size):
        # A thousand differences sort out most candidates.
        if _measure_share(few, _refine_step(few, candidate)) < 0.45:
            continue
        step = _refine_step(size, candidate)
        if step > 0.0 and _measure_share(size, step) >= 0.6:
            # A constant speed changes by one size too, but no multiple of it is exact.
            return 0.0 if _has_constant_speed(size / step, n_all) else step
    return 0.0


def _list_candidates(size: Array) -> Array:
    """Return possible steps, largest first: changes that are frequent, and their fractions."""
    typical = float(np.median(size))
    common = np.quantile(size, np.linspace(0.0, 0.9, 61))
    # Differences between frequent changes are multiples of the step as well.
    gaps = np.diff(np.unique(np.round(size / typical, 3))) * typical
    gaps = np.quantile(gaps, np.linspace(0.0, 0.9, 13)) if gaps.size else gaps
    # Every second or third value of a coarse log may be missing.
    found = np.concatenate([common, common / 2.0, common / 3.0, gaps])
    # Steps far below the typical change cannot be told from noise.
    found = found[(found > typical / LARGEST_MULTIPLE) & (found <= 1.5 * typical)]
    return np.unique(found)[::-1]


@kernel("f1 f", fastmath=True, usual=True)
def _refine_step(size: Array, step: float) -> float:
    """Return the least-squares step of the differences that are near multiples of `step`.

    Without branches the sums run in vector registers.
    """
    # Small multiples first: their error is the step's, large ones then refine it.
    for most in (2.5, 8.5, LARGEST_MULTIPLE):
        product = square = 0.0
        for k in range(size.size):
            ratio = size[k] / step
            multiple = np.rint(ratio)
            # Twice as far as counts: the first estimate is rough.
            near = (abs(ratio - multiple) < 2.0 * NEAR) & (multiple >= 1.0) & (multiple < most)
            weight = multiple if near else 0.0
            product += size[k] * weight
            square += weight * weight
        if square > 0.0:
            step = product / square
    return step


@kernel("f1 f", fastmath=True, usual=True)
def _measure_share(size: Array, step: float) -> float:
    """Return the share of differences that are near multiples of `step`."""
    count = 0.0
    for k in range(size.size):
        ratio = size[k] / step
        multiple = np.rint(ratio)
        near = (abs(ratio - multiple) < NEAR) & (multiple >= 1.0)
        count += 1.0 if near else 0.0
    return count / size.size


def _has_constant_speed(multiples: Array, n_all: int) -> bool:
    """Return whether the changes are of one size, as at a constant speed, and not exactly so."""
    alike = np.abs(multiples - 1.0) < NEAR
    # Rounded values repeat exactly, to a hundredth of the step.
    return bool(alike.sum() > 0.6 * n_all and np.std(multiples[alike]) > 0.01)
