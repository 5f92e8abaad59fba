"""Figure of claimed numbers of drives beside what a recording says of them."""

from __future__ import annotations

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from asbuilt.validation.review.claim import Claim
from asbuilt.validation.review.review import Review
from asbuilt.writers.figures.figure_style import (
    BLUE,
    GREY,
    INK,
    VERMILION,
    blank_figure,
    broken,
    headline,
    styled,
)

SHOWN = ("armature", "damping", "damping + kv", "friction loss", "kp", "forcerange")
"""Kinds of numbers in the figure."""
COLOURS = {"contradicted": VERMILION, "supported": BLUE, "undetermined": GREY}
SIGMAS = 2.0
"""Half the length of an error bar in standard errors."""


def review_figure(review: Review, *, title: str = "") -> Figure:
    """Draw each number of the drives with its error bar, beside its claim, joint by joint."""
    kinds = [kind for kind in SHOWN if any(_shown(claim, kind) for claim in review.claims)]
    joints = list(review.result.joint_names)
    columns = max(1, min(3, len(kinds)))
    rows = max(1, -(-len(kinds) // columns))
    with styled():
        figure = blank_figure(2.9 * columns + 0.6, rows * (0.24 * len(joints) + 0.9) + 0.5)
        axes = np.atleast_1d(figure.subplots(rows, columns, sharey=True)).ravel()
        for axis in axes[len(kinds) :]:
            axis.set_visible(False)
        for axis, kind in zip(axes, kinds, strict=False):
            _draw(axis, [claim for claim in review.claims if _shown(claim, kind)], joints)
            unit = next(claim.unit for claim in review.claims if claim.what == kind)
            axis.set_title(f"{kind} [{unit}]")
            axis.set_yticks(range(len(joints)), [broken(name, 16) for name in joints])
            axis.set_ylim(len(joints) - 0.5, -0.5)
        handles: dict[str, Artist] = {}
        for axis in axes:
            for handle, label in zip(*axis.get_legend_handles_labels(), strict=True):
                handles.setdefault(label, handle)
        figure.legend([*handles.values()], [*handles], loc="outside lower left", ncols=4)
        headline(figure, title or f"{review.robot}: numbers of its drives beside the log")
    return figure


def _shown(claim: Claim, kind: str) -> bool:
    return claim.what == kind and claim.estimate is not None and claim.std_error is not None


def _draw(axis: Axes, claims: list[Claim], joints: list[str]) -> None:
    """Draw the claims of one kind."""
    size = max(max(abs(claim.claimed), abs(claim.estimate or 0.0)) for claim in claims)
    for claim in claims:
        place = joints.index(claim.joint)
        # An error bar longer than so many times the largest number of its kind is cut.
        bar = min(SIGMAS * (claim.std_error or 0.0), 4.0 * size)
        axis.errorbar(
            claim.estimate or 0.0,
            place,
            xerr=bar,
            fmt="o",
            markersize=3.5,
            color=COLOURS[claim.verdict],
            elinewidth=1.2,
            label=claim.verdict,
        )
        axis.plot(
            [claim.claimed] * 2,
            [place - 0.35, place + 0.35],
            color=INK,
            linewidth=1.4,
            label="claim",
        )
    axis.axvline(0.0, color=GREY, linewidth=0.5)
