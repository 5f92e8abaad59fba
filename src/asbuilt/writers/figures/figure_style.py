"""Style of figures: colours, empty figures with a headline, curves thinned, files and addresses.

Colours by Okabe and Ito (2008), distinct for the colour-blind and in grey.
"""

from __future__ import annotations

import io
import os
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from asbuilt.arrays import Array, Indices
from asbuilt.errors import UsageError
from asbuilt.tables import shorten_text
from asbuilt.validation.residuals import find_contiguous_segments
from asbuilt.writers.files import data_address
from asbuilt.writing import atomic_write

BLUE = "#0072B2"
VERMILION = "#D55E00"
GREEN = "#009E73"
ORANGE = "#E69F00"
GREY = "#8A8F98"
INK = "#22262B"
QUIET = "#5F656D"
MEASURED = BLUE
AS_BUILT = VERMILION
CAD = GREY

DATED = {"png": "Software", "svg": "Date", "pdf": "CreationDate"}
"""Field of each kind of file that would make equal figures differ."""
POINTS = 4000
"""Points of a long curve."""

_STYLE: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 8.5,
    "axes.titlesize": 9,
    "axes.titlelocation": "left",
    "axes.labelsize": 8.5,
    "axes.edgecolor": "#9AA0A6",
    "axes.labelcolor": INK,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#E4E7EB",
    "grid.linewidth": 0.6,
    "xtick.color": QUIET,
    "ytick.color": QUIET,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "text.color": INK,
    "text.parse_math": False,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "lines.linewidth": 1.0,
    "lines.solid_joinstyle": "round",
    "agg.path.chunksize": 0,
    "path.simplify": False,
    "svg.fonttype": "path",
    "svg.hashsalt": "asbuilt",
    "pdf.fonttype": 42,
}


def break_name(name: str, width: int) -> str:
    r"""Break a name after underscores or spaces into up to three lines of `width` characters.

    >>> break_name("shoulder_lift_joint", 14)
    'shoulder_lift_\njoint'
    """
    lines = [""]
    for part in name.replace("_", "_ ").replace("  ", " ").split(" "):
        joined = lines[-1] + ("" if lines[-1].endswith("_") or not lines[-1] else " ") + part
        if len(joined) <= width or not lines[-1]:
            lines[-1] = joined
        else:
            lines.append(part)
    return "\n".join(shorten_text(line, width) for line in lines[:3])


def save_figure(figure: Figure, path: str | os.PathLike[str], *, dpi: int = 160) -> Path:
    """Write a figure whole, as PNG, SVG or PDF after its suffix; equal figures give equal bytes."""
    suffix = Path(path).suffix.lower().lstrip(".")
    if suffix not in DATED:
        raise UsageError(
            f"figure {str(path)!r} has an unknown suffix; expected .{', .'.join(DATED)}"
        )
    return atomic_write(path, _draw_figure(figure, suffix, dpi=dpi))


def _draw_figure(figure: Figure, kind: str, **how: Any) -> bytes:
    """Return a figure as a file of a kind, without a date."""
    stream = io.BytesIO()
    with apply_style():
        figure.savefig(stream, format=kind, metadata={DATED[kind]: None}, **how)
    return stream.getvalue()


def apply_style() -> AbstractContextManager[None]:
    """Return the context in which figures are drawn in the house style."""
    return mpl.rc_context(_STYLE)


def make_blank_figure(width: float, height: float) -> Figure:
    """Return an empty figure of a size [inch]."""
    figure = Figure(figsize=(width, height), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure


@contextmanager
def open_figure(
    width: float, height: float, title: str = "", *, rows: int = 1, columns: int = 1, **how: Any
) -> Iterator[tuple[Figure, list[Any]]]:
    """Draw within this context on the axes of a new figure [inch], row by row, with a headline.

    `how` goes to `Figure.subplots`.
    """
    with apply_style():
        figure = make_blank_figure(width, height)
        yield figure, [*figure.subplots(rows, columns, squeeze=False, **how).flat]
        add_headline(figure, title)


def label_once(figure: Figure, axes: Iterable[Any], **how: Any) -> None:
    """Put a legend next to the axes that has each of their labels once; `how` as for a legend."""
    handles: dict[str, Any] = {}
    for axis in axes:
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    figure.legend([*handles.values()], [*handles], **how)


def add_headline(figure: Figure, title: str) -> None:
    """Put a title above the whole figure, if there is one."""
    if title:
        figure.suptitle(title, x=0.01, ha="left", fontsize=10.5, fontweight="bold")


def encode_figure(figure: Figure) -> str:
    """Return a figure as a `data:` address of an SVG; equal figures give equal texts."""
    return data_address(_draw_figure(figure, "svg"), "image/svg+xml")


def thin_curves(t: Array, *curves: Array, points: int) -> tuple[Array, ...]:
    """Return `t` (M,) and each curve (M,) thinned to about `points`.

    Every bucket of time keeps the samples where any curve is smallest and largest, and each
    contiguous segment its ends; NaN between segments keeps lines from bridging gaps.
    """
    share = points / max(len(t), 1)
    kept = list[list[Array]]()
    for start, stop in find_contiguous_segments(t):
        index = start + _find_extremes(
            [curve[start:stop] for curve in curves], max(2, int(share * (stop - start)))
        )
        kept.append([np.append(curve[index], np.nan) for curve in (t, *curves)])
    if not kept:
        return t, *curves
    # No gap behind the last segment.
    return tuple(np.concatenate(parts)[:-1] for parts in zip(*kept, strict=True))


def _find_extremes(curves: list[Array], points: int) -> Indices:
    """Return the indices of the bucket-wise extremes of every curve, and of both ends."""
    n = len(curves[0])
    if n <= points:
        return np.arange(n)
    width = max(1, -(-2 * len(curves) * n // points))
    whole = n // width * width
    chosen: list[Indices] = [np.array([0, n - 1])]
    offsets = np.arange(0, whole, width)
    for curve in curves:
        buckets = curve[:whole].reshape(-1, width)
        chosen += [offsets + buckets.argmin(axis=1), offsets + buckets.argmax(axis=1)]
        if whole < n:
            chosen.append(whole + np.array([curve[whole:].argmin(), curve[whole:].argmax()]))
    return np.unique(np.concatenate(chosen))
