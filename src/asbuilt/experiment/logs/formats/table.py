"""What every file format is read into: named columns of equal length."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from asbuilt.arrays import Array
from asbuilt.errors import RecordingError


@dataclass(frozen=True, eq=False)
class Table:
    """Hold named columns of equal length (N,); `text_columns` names those that do not hold numbers.

    `headless` says that the file had no names and the columns are called "1", "2", ... A column
    from a source with joint names of its own (a ROS message) has its quantity and joint in `known`.
    """

    source: str
    columns: Mapping[str, Array]
    headless: bool = False
    text_columns: tuple[str, ...] = ()
    known: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    @property
    def n_samples(self) -> int:
        """Number of rows."""
        return next(iter(self.columns.values())).size if self.columns else 0


def table_from_variables(source: str, variables: Mapping[str, Array]) -> Table:
    """Spread vectors (N,) and matrices (N, m) or (m, N) over columns.

    A matrix `positions` gives `positions_1`, ..., `positions_m`.

    N is the length that most variables share; variables without it are left out.

    Raises
    ------
    RecordingError
        If no variable is numeric, or no two agree on a length.
    """
    arrays = {name: np.squeeze(np.asarray(value)) for name, value in variables.items()}
    arrays = {
        name: a
        for name, a in arrays.items()
        if a.ndim in (1, 2)
        and a.size > 1
        and np.issubdtype(a.dtype, np.number)
        and not np.iscomplexobj(a)
    }
    if not arrays:
        found = ", ".join(variables) or "nothing"
        raise RecordingError(
            f"{source} is not a recording: it holds no numeric vector or matrix (found {found})"
        )
    votes: dict[int, int] = {}
    for array in arrays.values():
        for size in set(array.shape):
            votes[size] = votes.get(size, 0) + 1
    length = max(votes, key=lambda size: (votes[size], size))
    columns: dict[str, Array] = {}
    left_out = []
    for name, array in arrays.items():
        if length not in array.shape:
            left_out.append(f"{name} {array.shape}")
            continue
        values = array.astype(np.float64)
        if values.ndim == 1:
            columns[name] = values
            continue
        matrix = values if values.shape[0] == length else values.T
        for k in range(matrix.shape[1]):
            columns[f"{name}_{k + 1}"] = np.ascontiguousarray(matrix[:, k])
    notes = (
        (f"variables without the common length {length} were left out: {', '.join(left_out)}",)
        if left_out
        else ()
    )
    return Table(source=source, columns=columns, notes=notes)
