"""Figure of a sweep of the low-pass cutoff."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator, ScalarFormatter

from asbuilt.tables import significant
from asbuilt.workflow.cutoff_sweep import CutoffSweep
from asbuilt.writers.figures.figure_style import (
    BLUE,
    GREEN,
    GREY,
    VERMILION,
    blank_figure,
    headline,
    styled,
)


def cutoff_figure(sweep: CutoffSweep, *, title: str = "") -> Figure:
    """Draw held-out error and the whiteness of the residual against the cutoff."""
    cutoffs = np.array([trial.cutoff for trial in sweep.trials])
    with styled():
        figure = blank_figure(7.0, 4.6)
        upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
        upper.plot(
            cutoffs,
            [trial.score for trial in sweep.trials],
            color=VERMILION,
            marker="o",
            markersize=4,
            label="against unfiltered torque",
        )
        upper.plot(
            cutoffs,
            [trial.in_band for trial in sweep.trials],
            color=GREY,
            marker="o",
            markersize=3,
            linestyle="--",
            label="against filtered torque",
        )
        upper.set_ylabel("held-out error,\nrelative to the best")
        upper.legend(loc="best")
        # Held-out error, relative to the best, above which the axis is logarithmic.
        if max(trial.score for trial in sweep.trials) > 4.0:
            upper.set_yscale("log")
            upper.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            upper.yaxis.set_major_formatter(ScalarFormatter())
            upper.yaxis.set_minor_locator(NullLocator())
        lower.plot(
            cutoffs,
            [trial.durbin_watson for trial in sweep.trials],
            color=BLUE,
            marker="o",
            markersize=4,
        )
        share = lower.twinx()
        share.plot(
            cutoffs,
            [100 * trial.effective_share for trial in sweep.trials],
            color=GREEN,
            marker="s",
            markersize=3,
        )
        share.set_ylabel("independent samples\n[% of white]", color=GREEN)
        share.set_ylim(bottom=0.0)
        share.grid(visible=False)
        lower.set_ylabel("Durbin-Watson\n(white: 2)", color=BLUE)
        lower.set_ylim(bottom=0.0)
        lower.set_xscale("log")
        lower.set_xticks(cutoffs, [significant(float(cutoff), 2) for cutoff in cutoffs])
        lower.minorticks_off()
        lower.set_xlabel("cutoff [Hz]")
        for axis in (upper, lower):
            axis.axvline(sweep.chosen, color=VERMILION, linewidth=0.8, linestyle=":")
        headline(figure, title)
    return figure
