"""Dataclasses as plain data and back."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from numpy.typing import NDArray

from asbuilt.codec import FieldError, format_json, make_plain, restore_dataclass, store_as
from asbuilt.dynamics import PositionServo
from asbuilt.findings import Cure, Finding


@dataclass(frozen=True)
class Inner:
    name: str
    count: int = 3


@dataclass(frozen=True, eq=False)
class Outer:
    numbers: NDArray[np.float64]
    flags: NDArray[np.bool_]
    places: tuple[NDArray[np.int64], ...]
    kind: Literal["one", "two"]
    ratio: float = field(metadata=store_as(missing=np.inf))
    text: str | None
    inner: Inner | None
    several: tuple[Inner, ...]
    pair: tuple[str, float]
    table: Mapping[str, float]
    doubled: int = field(
        metadata=store_as(key="twice", encode=lambda x: 2 * x, decode=lambda x: x // 2)
    )
    later: float = 1.5


EXAMPLE = Outer(
    numbers=np.array([[0.1, np.nan], [1e-300, -0.0]]),
    flags=np.array([True, False]),
    places=(np.array([1, 2]), np.array([], dtype=np.int64)),
    kind="two",
    ratio=np.inf,
    text=None,
    inner=Inner("a"),
    several=(Inner("b", 1), Inner("c", 2)),
    pair=("x", 0.1 + 0.2),
    table={"k": 1.0 / 3.0},
    doubled=7,
)


def test_plain_data_are_json_and_come_back_to_the_last_bit() -> None:
    text = json.dumps(make_plain(EXAMPLE), allow_nan=False)
    again = restore_dataclass(Outer, json.loads(text))
    assert json.dumps(make_plain(again)) == text
    np.testing.assert_array_equal(again.numbers, EXAMPLE.numbers)
    assert np.signbit(again.numbers[1, 1])
    assert again.flags.dtype == np.bool_
    assert [part.dtype for part in again.places] == [np.int64, np.int64]
    assert again.ratio == np.inf
    assert (again.inner, again.several) == (EXAMPLE.inner, EXAMPLE.several)
    assert (again.pair, again.table) == (EXAMPLE.pair, EXAMPLE.table)
    assert make_plain(EXAMPLE)["twice"] == 14
    assert again.doubled == 7


def test_findings_come_back_with_their_cures() -> None:
    found = Finding(
        "gap", "info", "a gap", Cure("record again", {"checked": False, "rate": 2.0}), "A1", 1.0
    )
    assert restore_dataclass(Finding, json.loads(format_json(found))) == found
    bare = Finding("gap", "error", "a gap")
    assert restore_dataclass(Finding, make_plain(bare)) == bare


def test_paths_and_numbers_of_numpy_are_plain() -> None:
    document = {"path": Path("a") / "b", 1: np.float64(2.0), "n": np.int64(3), "no": np.nan}
    assert make_plain(document) == {"path": str(Path("a") / "b"), "1": 2.0, "n": 3, "no": None}
    assert type(make_plain(np.float64(2.0))) is float


@pytest.mark.parametrize(
    ("change", "error"),
    [
        ({"kind": "three"}, "three"),
        ({"inner": {"count": 1}}, "name"),
        ({"several": [{"name": 1}]}, "expected str"),
        ({"several": {"name": "a"}}, "expected a list"),
        ({"ratio": "fast"}, "fast"),
        ({"numbers": ["a"]}, "array of numbers"),
        ({"text": 3}, "expected str"),
        ({"pair": ["x"]}, "argument 2 is shorter"),
    ],
)
def test_what_does_not_fit_is_refused(change: dict[str, object], error: str) -> None:
    data = make_plain(EXAMPLE)
    assert isinstance(data, dict)
    with pytest.raises((KeyError, TypeError, ValueError), match=error):
        restore_dataclass(Outer, data | change)
    del data["numbers"]
    with pytest.raises(FieldError, match="numbers: it is missing"):
        restore_dataclass(Outer, data)
    with pytest.raises(TypeError, match="object"):
        restore_dataclass(Outer, [1])  # type: ignore[arg-type]


def test_infinite_numbers_of_a_tuple_come_back() -> None:
    servo = PositionServo(kp=(5.0, 5.0), kd=(0.1, 0.1), torque_limit=(np.inf, 2.0))
    assert make_plain(servo)["torque_limit"] == [None, 2.0]
    assert restore_dataclass(PositionServo, json.loads(format_json(servo))) == servo
