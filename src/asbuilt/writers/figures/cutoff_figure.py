"""Figure of a sweep of the low-pass cutoff."""

from __future__ import annotations

from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator, ScalarFormatter

from asbuilt.tables import significant
from asbuilt.workflow.cutoff_sweep import CutoffSweep
from asbuilt.writers.figures.figure_style import (
    BLUE,
    GREEN,
    GREY,
    VERMILION,
    drawn,
)


def cutoff_figure(sweep: CutoffSweep, *, title: str = "") -> Figure:
    """Draw held-out error and the whiteness of the residual against the cutoff."""
    cutoffs = [trial.cutoff for trial in sweep.trials]
    with drawn(7.0, 4.6, title, rows=2, sharex=True, height_ratios=(3, 2)) as (figure, axes):
        upper, lower = axes
        right = lower.twinx()
        for axis, name, factor, colour, mark, size, style, label in (
            (upper, "score", 1, VERMILION, "o", 4, "-", "against unfiltered torque"),
            (upper, "in_band", 1, GREY, "o", 3, "--", "against filtered torque"),
            (lower, "durbin_watson", 1, BLUE, "o", 4, "-", ""),
            (right, "effective_share", 100, GREEN, "s", 3, "-", ""),
        ):
            values = [factor * getattr(trial, name) for trial in sweep.trials]
            look = {"color": colour, "marker": mark, "markersize": size, "linestyle": style}
            axis.plot(cutoffs, values, label=label, **look)
        upper.set_ylabel("held-out error,\nrelative to the best")
        upper.legend(loc="best")
        # Held-out error, relative to the best, above which the axis is logarithmic.
        if max(trial.score for trial in sweep.trials) > 4.0:
            upper.set_yscale("log")
            upper.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            upper.yaxis.set_major_formatter(ScalarFormatter())
            upper.yaxis.set_minor_locator(NullLocator())
        right.set_ylabel("independent samples\n[% of white]", color=GREEN)
        right.set_ylim(bottom=0.0)
        right.grid(visible=False)
        lower.set_ylabel("Durbin-Watson\n(white: 2)", color=BLUE)
        lower.set_ylim(bottom=0.0)
        lower.set(xscale="log", xlabel="cutoff [Hz]")
        lower.set_xticks(cutoffs, [significant(cutoff, 2) for cutoff in cutoffs])
        lower.minorticks_off()
        for axis in (upper, lower):
            axis.axvline(sweep.chosen, color=VERMILION, linewidth=0.8, linestyle=":")
    return figure
