"""Figure of a free simulation: joint positions and the energy balance."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from asbuilt.experiment.virtual.free_motion import FreeMotion
from asbuilt.tables import shortened
from asbuilt.writers.figures.figure_style import (
    BLUE,
    GREEN,
    INK,
    ORANGE,
    POINTS,
    VERMILION,
    blank_figure,
    headline,
    styled,
)
from asbuilt.writers.figures.thinning import thinned


def energy_figure(motion: FreeMotion, *, title: str = "") -> Figure:
    """Draw positions and energies of a free simulation.

    Kinetic, potential and total energy, with the work of the drives and the loss to friction.
    """
    model, t = motion.model, motion.t
    turning = [joint.is_revolute for joint in model.joints]
    with styled():
        figure = blank_figure(8.5, 5.2)
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=(2, 3))
        colours = mpl.colormaps["viridis"](np.linspace(0.0, 0.9, model.n_joints))
        for name, positions, colour in zip(
            model.joint_names, (motion.q - motion.q[0]).T, colours, strict=True
        ):
            above.plot(
                *thinned(t, positions, points=POINTS), color=colour, label=shortened(name, 20)
            )
        above.set_ylabel(
            f"moved [{'rad' if all(turning) else 'm' if not any(turning) else 'rad, m'}]"
        )
        above.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), handlelength=1.2)
        curves = [
            (motion.kinetic, BLUE, "-", "kinetic"),
            (motion.potential, GREEN, "-", "potential, 0 at the start"),
            (motion.total, INK, "-", "kinetic + potential"),
            (
                motion.total[0] + motion.work - motion.dissipated,
                ORANGE,
                (0, (3, 2)),
                "start + work - friction",
            ),
            (motion.dissipated, VERMILION, "-", "dissipated by friction"),
        ]
        for values, colour, style, label in curves:
            wide = 1.8 if label == "kinetic + potential" else 1.2
            below.plot(
                *thinned(t, values, points=POINTS),
                color=colour,
                linestyle=style,
                linewidth=wide,
                label=label,
            )
        below.set_ylabel("energy [J]")
        below.set_xlabel("time [s]")
        below.margins(x=0.01)
        legend = below.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), handlelength=1.6)
        legend.set_title(f"energy balance to {motion.imbalance:.0e}", prop={"size": 8})
        legend.set_alignment("left")
        headline(figure, title or f"{model.name}: {motion.release}")
    return figure
