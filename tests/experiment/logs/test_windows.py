"""Segments of a log that are kept, by an option and by a sheet."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from asbuilt.errors import RecordingError, UsageError
from asbuilt.experiment import ReadingOptions, check_recording, read_recording

T = np.arange(0.0, 10.0, 0.01)
COLUMNS = {"t": T + 3.0, "q_1": np.sin(T), "tau_1": np.cos(T)}


def kept(**settings: object) -> np.ndarray:
    return np.asarray(read_recording(COLUMNS, **settings).t - 3.0)


def test_windows_count_from_the_first_sample_and_may_be_open() -> None:
    inside = kept(window="1:2,8:")
    assert np.all(((inside >= 1.0) & (inside < 2.0)) | (inside >= 8.0))
    assert inside.size == 300
    assert np.array_equal(kept(window=[(0.0, 5.0)]), kept(window=":5"))


def test_an_option_replaces_the_windows_of_a_sheet() -> None:
    sheet = {"windows": [{"start": 1.0, "stop": 2.0}]}
    assert kept(sheet=sheet).size == 100
    assert kept(sheet=sheet, window="2:5").size == 300


@pytest.mark.parametrize("text", ["5", "5:2", "a:b", "-1:3", ""])
def test_what_is_no_window_is_one_error(text: str) -> None:
    with pytest.raises(UsageError, match="segments of the log from START to STOP"):
        ReadingOptions(window=text)


def test_windows_without_a_sample_are_refused() -> None:
    with pytest.raises(RecordingError, match="no sample lies in the time windows"):
        kept(window="100:")


def test_a_check_reads_what_holds_a_recording(tmp_path: Path) -> None:
    names = ["t", "q_1", "q_2", "tau_1", "tau_2"]
    table = np.column_stack([T, np.sin(T), np.cos(2 * T), np.cos(T), np.sin(T)])
    np.savetxt(tmp_path / "log.csv", table, delimiter=",", header=",".join(names), comments="")
    found = check_recording("two-link", str(tmp_path / "log.csv"), window=":8")
    assert found.duration == pytest.approx(8.0, abs=0.02)
    np.savetxt(
        tmp_path / "two.csv", 0.9 * table, delimiter=",", header=",".join(names), comments=""
    )
    with pytest.raises(UsageError, match="takes one recording"):
        check_recording("two-link", [tmp_path / "log.csv", tmp_path / "two.csv"])
