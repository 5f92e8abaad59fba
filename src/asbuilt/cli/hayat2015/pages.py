"""The reproduction as text, as files, as a page and as a document."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from asbuilt.cli.hayat2015.figures import all_figures
from asbuilt.cli.hayat2015.reproduction import Reproduction
from asbuilt.cli.hayat2015.tables import (
    agreement_sentence,
    all_tables,
    consistency_sentence,
    highlighted_sentence,
    table_3,
)
from asbuilt.tables import stacked, wrapped
from asbuilt.writers.figures.figure_style import save_figure
from asbuilt.writers.files import atomic_write, data_address, path_texts
from asbuilt.writers.reports.page import Block, image_markup, list_markup, page, table_markup

SOURCE = (
    "A. A. Hayat, V. Abhishek and S. K. Saha, Dynamic Identification of Manipulator: Comparison"
    " between CAD and Actual Parameters, iNaCoMM 2015-94"
)

ORDER = (
    ("figure1", "figure2", "table1", "table2", "gray_rows"),
    ("simulated_torque", "figure3_simulated", "table3", "figure3", "figure4"),
)
"""Order of tables and figures on the page, by section."""


def sentences(redone: Reproduction) -> list[str]:
    """Return what agrees with the paper and what does not, in one sentence each."""
    simulated = redone.simulated_torque
    identified = float(simulated.rms(simulated.from_identified).max())
    cad = float(simulated.rms(simulated.from_cad).max())
    return [
        f"Table 2: {agreement_sentence(redone)}",
        f"Table 1: alpha_7 is a misprint ({redone.paper.alpha_7_printed:g} deg), which would change"
        f" {redone.mismatches_with_printed_alpha} rows of Table 2.",
        f"Simulated torque: predicted from CAD to {cad:.0e} N m RMS, from the parameters identified"
        f" in simulation to {identified:.0e} N m.",
        f"Consistency: {consistency_sentence(redone)}",
        f"Gray rows: {highlighted_sentence(redone)}",
    ]


def reproduction_text(redone: Reproduction, full: bool = False) -> str:
    """Return what `asbuilt reproduce` prints; every table if `full`."""
    lines = [wrapped(SOURCE), "", *(wrapped(sentence) for sentence in sentences(redone)), ""]
    tables = [*all_tables(redone).values()] if full else [table_3(redone)]
    return "\n".join(lines) + "\n" + stacked(tables, full)


def write_reproduction(folder: Path, redone: Reproduction) -> dict[str, Path]:
    """Write every table as CSV, every figure as PNG, the text and a page with all of them."""
    tables, figures = all_tables(redone), all_figures(redone)
    files = {
        "page": atomic_write(folder / "reproduction.html", reproduction_html(redone)),
        "text": atomic_write(folder / "reproduction.txt", reproduction_text(redone, full=True)),
    }
    for name, table in tables.items():
        files[name] = atomic_write(folder / f"{name}.csv", table.as_csv())
    for name, figure in figures.items():
        files[name] = save_figure(figure, folder / f"{name}.png")
    return files


def reproduction_html(redone: Reproduction) -> str:
    """Return the page with every table and figure, complete in one file."""
    tables, figures = all_tables(redone), all_figures(redone)
    shown = {name: table_markup(table, name) for name, table in tables.items()} | {
        name: image_markup(_png_address(figure), name) for name, figure in figures.items()
    }
    blocks = (
        Block(heading.lower(), heading, [shown[name] for name in names])
        for heading, names in zip(("CAD", "Robot"), ORDER, strict=True)
    )
    verdict = Block("verdict", "Verdict", (list_markup(sentences(redone)),))
    title = "The 2015 paper, reproduced"
    return page("The 2015 paper", "reproduced", [verdict, *blocks], title=title, subtitle=SOURCE)


def _png_address(figure: Figure) -> str:
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=110)
    return data_address(stream.getvalue(), "image/png")


def reproduction_document(redone: Reproduction, files: Mapping[str, Path]) -> dict[str, Any]:
    """Return what `asbuilt reproduce --json` prints."""
    simulated = redone.simulated_torque
    return {
        "source": SOURCE,
        "robot": redone.model.name,
        "table1": {
            "alpha_7_printed": redone.paper.alpha_7_printed,
            "rows_missed_as_printed": redone.mismatches_with_printed_alpha,
        },
        "table2": {
            "ids_equal": redone.ids_equal,
            "expressions_equal": redone.n_same_expressions,
            "cad_values_within_rounding": redone.n_same_values,
            "largest_difference": redone.largest_difference,
            "cad_margin": redone.cad_margin,
            "robot_margin": redone.robot_margin,
            "highlighted": [k + 1 for k in redone.paper.highlighted],
            "parameters": [
                {
                    "id": row.id,
                    "printed": row.printed,
                    "corrected": row.corrected,
                    "ours": row.ours,
                    "cad_printed": row.cad_printed,
                    "cad_ours": row.cad_ours,
                    "tolerance": row.tolerance,
                    "simulated": row.simulated,
                    "robot": row.robot,
                    "virtual_robot": row.virtual_robot,
                }
                for row in redone.parameters
            ],
        },
        "table3": {
            "joints": list(redone.paper.table3_joints),
            "paper": {
                "cad": list(redone.paper.table3_cad),
                "robot": list(redone.paper.table3_robot),
            },
            "virtual": {
                "installed": list(redone.differences),
                "n_samples": redone.n_logged,
                "cad": redone.rigid_validation.metrics_cad.as_dict(),
                "identified": redone.rigid_validation.metrics_as_built.as_dict(),
                "identified_with_friction": redone.full_validation.metrics_as_built.as_dict(),
            },
            "simulated_torque": {
                "cad": simulated.rms(simulated.from_cad).tolist(),
                "identified": simulated.rms(simulated.from_identified).tolist(),
            },
        },
        "files": path_texts(files),
    }
