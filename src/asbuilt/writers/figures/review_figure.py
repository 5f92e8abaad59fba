"""Figure of claimed numbers of drives beside what a recording says of them."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from asbuilt.validation import Claim, Review
from asbuilt.writers.figures.figure_style import (
    BLUE,
    GREY,
    INK,
    VERMILION,
    broken,
    drawn,
    label_once,
)

SHOWN = ("armature", "damping", "damping + kv", "friction loss", "kp", "forcerange")
"""Kinds of numbers in the figure."""
COLOURS = {"contradicted": VERMILION, "supported": BLUE, "undetermined": GREY}
SIGMAS = 2.0
"""Half the length of an error bar in standard errors."""


def review_figure(review: Review) -> Figure:
    """Draw each number of the drives with its error bar, beside its claim, joint by joint."""
    kinds = [kind for kind in SHOWN if any(_shown(claim, kind) for claim in review.claims)]
    joints = list(review.result.joint_names)
    columns = max(1, min(3, len(kinds)))
    rows = max(1, -(-len(kinds) // columns))
    width, height = 2.9 * columns + 0.6, rows * (0.24 * len(joints) + 0.9) + 0.5
    title = f"{review.robot}: numbers of its drives beside the log"
    with drawn(width, height, title, rows=rows, columns=columns, sharey=True) as (figure, axes):
        for axis in axes[len(kinds) :]:
            axis.set_visible(False)
        for axis, kind in zip(axes, kinds, strict=False):
            claims = [claim for claim in review.claims if _shown(claim, kind)]
            _draw(axis, claims, joints)
            axis.set_yticks(range(len(joints)), [broken(name, 16) for name in joints])
            axis.set(title=f"{kind} [{claims[0].unit}]", ylim=(len(joints) - 0.5, -0.5))
        label_once(figure, axes, loc="outside lower left", ncols=4)
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
