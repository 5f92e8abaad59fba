"""What an ensemble says of single parameters: its table, ranges and correlations."""

from __future__ import annotations

import io
import json
from typing import Any

import numpy as np

from asbuilt.description.inertia import PARAMETER_NAMES
from asbuilt.identification.ensembles.ensemble import QUANTILES, Ensemble


def parquet_table(ensemble: Ensemble) -> bytes:
    """Return the table as Parquet: a row for every robot, units in the metadata of the file.

    The column `draw` is the number of the model file, the others are named as in a result.
    """
    import polars  # noqa: PLC0415 - slow

    columns = dict(zip(ensemble.names, ensemble.table.T, strict=True))
    frame = polars.DataFrame({"draw": np.arange(len(ensemble), dtype=np.int64), **columns})
    content = io.BytesIO()
    units = {"draw": "", **dict(zip(ensemble.names, ensemble.units, strict=True))}
    frame.write_parquet(
        content, metadata={"units": json.dumps(units), "robot": ensemble.result.robot}
    )
    return content.getvalue()


def ranges(ensemble: Ensemble) -> list[dict[str, Any]]:
    """Return name, unit, owner, value, spread and quantiles of every column."""
    spread, keys = ensemble.table.std(axis=0), [f"q{round(100 * each):02d}" for each in QUANTILES]
    return [
        {
            "name": name,
            "unit": unit,
            **owner,
            "value": value,
            "std": std,
            **dict(zip(keys, column, strict=True)),
        }
        for name, unit, owner, value, std, column in zip(
            ensemble.names,
            ensemble.units,
            _owners(ensemble),
            ensemble.middle.tolist(),
            spread.tolist(),
            ensemble.quantiles.T.tolist(),
            strict=True,
        )
    ]


def correlation(ensemble: Ensemble) -> dict[str, Any]:
    """Return the correlation matrix of the columns that vary, with their names."""
    table = ensemble.table
    spread, size = table.std(axis=0), np.abs(table).mean(axis=0)
    # Spread relative to the value below which a column is constant (rounding of the fits).
    varies = np.flatnonzero((spread > 1e-9 * size) & (spread > np.finfo(np.float64).tiny))
    names = [ensemble.names[k] for k in varies]
    if len(ensemble) < 2 or not names:
        return {"names": [], "matrix": []}
    matrix = np.atleast_2d(np.corrcoef(table[:, varies].T))
    return {"names": names, "matrix": np.round(matrix, 6).tolist()}


def _owners(ensemble: Ensemble) -> list[dict[str, str]]:
    """Return the link or joint that each column belongs to."""
    model, drive = ensemble.result.model, ensemble.result.base.drive
    links = [{"link": name} for name in model.link_names for _ in PARAMETER_NAMES]
    joints = [{"joint": name} for name in model.joint_names for _ in range(drive.columns_per_joint)]
    servo = [{"joint": name} for name in model.joint_names] * 2 + [{"joint": "all"}]
    return [*links, *joints, *(servo if ensemble.kp is not None else [])]
