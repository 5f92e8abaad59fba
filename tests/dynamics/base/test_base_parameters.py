"""Base parameters of known robots.

The paper's Table 2, published counts, symbols, and files of other people.
"""

from __future__ import annotations

import csv
import re
from pathlib import Path

import numpy as np
import pytest

from asbuilt.description import DHRow, RobotModel, bundled_robot, placement, robot_from_dh
from asbuilt.description.formats.urdf import read_urdf
from asbuilt.description.rotation import rotation_x
from asbuilt.dynamics import BaseParameters, DriveSet, find_base_parameters, observation_matrix
from asbuilt.dynamics.base.symbols import replace_lengths
from asbuilt.errors import IdentifiabilityError, UsageError

RIGHT = np.pi / 2
ALL_TERMS = "armature,viscous,coulomb,offset"


def iiwa() -> RobotModel:
    lengths = (0.34, 0.0, 0.4, 0.0, 0.4, 0.0, 0.126)
    angles = (RIGHT, -RIGHT, -RIGHT, RIGHT, RIGHT, -RIGHT, 0.0)
    return robot_from_dh(
        [DHRow(b=b, alpha=alpha) for b, alpha in zip(lengths, angles, strict=True)], name="iiwa"
    )


ARMS = {
    "iiwa": (iiwa(), (43, 48, 69)),
    "panda": (
        robot_from_dh(
            [
                DHRow(b=0.333),
                DHRow(alpha=-RIGHT),
                DHRow(alpha=RIGHT, b=0.316),
                DHRow(alpha=RIGHT, a=0.0825),
                DHRow(alpha=-RIGHT, a=-0.0825, b=0.384),
                DHRow(alpha=RIGHT),
                DHRow(alpha=RIGHT, a=0.088),
            ],
            convention="modified",
        ),
        (43, 48, 69),
    ),
    "wam": (
        robot_from_dh(
            [
                DHRow(alpha=-RIGHT),
                DHRow(alpha=RIGHT),
                DHRow(a=0.045, alpha=-RIGHT, b=0.55),
                DHRow(a=-0.045, alpha=RIGHT),
                DHRow(alpha=-RIGHT, b=0.3),
                DHRow(alpha=RIGHT),
                DHRow(b=0.06),
            ]
        ),
        (43, 48, 69),
    ),
    "puma": (
        robot_from_dh(
            [
                DHRow(alpha=RIGHT),
                DHRow(a=0.4318),
                DHRow(a=0.0203, alpha=-RIGHT, b=0.15),
                DHRow(alpha=RIGHT, b=0.4318),
                DHRow(alpha=-RIGHT),
                DHRow(),
            ]
        ),
        (36, 40, 58),
    ),
    "ur5e": (
        robot_from_dh(
            [
                DHRow(b=0.1625, alpha=RIGHT),
                DHRow(a=-0.425),
                DHRow(a=-0.3922),
                DHRow(b=0.1333, alpha=RIGHT),
                DHRow(b=0.0997, alpha=-RIGHT),
                DHRow(b=0.0996),
            ]
        ),
        (36, 40, 58),
    ),
    "tx40": (
        robot_from_dh(
            [
                DHRow(),
                DHRow(alpha=-RIGHT),
                DHRow(a=0.225, b=0.035),
                DHRow(alpha=RIGHT, b=0.225),
                DHRow(alpha=-RIGHT),
                DHRow(alpha=RIGHT, b=0.065),
            ],
            convention="modified",
        ),
        (36, 40, 58),
    ),
}


def evaluated(text: str, names: dict[str, float]) -> float:
    return float(eval(text, {"__builtins__": {}}, names))


def random_parameters(base: BaseParameters, rng: np.random.Generator) -> dict[str, float]:
    return {
        name: float(value)
        for name, value in zip(
            base.standard_names, rng.uniform(0.5, 2.0, base.n_standard), strict=True
        )
    }


@pytest.mark.parametrize("arm", ARMS)
def test_counts_are_those_published(arm: str) -> None:
    model, counts = ARMS[arm]
    for drive, count in zip(("none", "armature", ALL_TERMS), counts, strict=True):
        base = find_base_parameters(model, DriveSet.parse(drive))
        assert base.n_base == count == len(base.ids) == len(base.names) == len(base.units)
        assert (
            base.n_standard
            == len(base.standard)
            == {"none": 10, "armature": 11, ALL_TERMS: 14}[drive] * model.n_joints
        )


def test_the_papers_second_table_row_by_row(shared: Path) -> None:
    with (shared / "paper" / "table2.csv").open() as file:
        table = list(csv.DictReader(file))
    model = bundled_robot("kuka-iiwa7-r800")
    base = find_base_parameters(model)
    values = base.values(model.parameters)
    assert base.ids.tolist() == [int(row["id"]) for row in table]
    rng = np.random.default_rng(7)
    chi = random_parameters(base, rng)
    papers = {}
    for i in range(1, 8):
        papers |= {
            f"I{i}{pair}": chi[f"I{pair}{i}"] for pair in ("xx", "xy", "xz", "yy", "yz", "zz")
        }
        papers |= {f"m{i}": chi[f"m{i}"]} | {
            f"d{i}{axis}": chi[f"m{axis}{i}"] / chi[f"m{i}"] for axis in "xyz"
        }
    for row, expression, symbolic, value in zip(
        table, base.expressions, base.symbolic, values, strict=True
    ):
        expected = evaluated(row["expression_corrected"], papers)
        assert evaluated(expression, chi) == pytest.approx(expected, rel=1e-9)
        assert evaluated(symbolic, {**chi, **model.lengths}) == pytest.approx(expected, rel=1e-9)
        digits = (
            5e-6
            if row["row"] in {"23", "26", "30", "33"}
            else 1.01 * 10.0 ** -_decimals(row["cad"])
        )
        assert abs(value - float(row["cad"])) <= digits, row


def _decimals(text: str) -> int:
    mantissa, _, exponent = text.upper().partition("E")
    return len(mantissa.partition(".")[2]) - int(exponent or 0)


def test_symbols_of_the_iiwa_read_as_in_the_paper() -> None:
    base = find_base_parameters(iiwa())
    symbolic = dict(zip(base.names, base.symbolic, strict=True))
    numbers = dict(zip(base.names, base.expressions, strict=True))
    assert symbolic["Iyy1"] == "Iyy1 + Izz2"
    assert symbolic["Ixx2"] == "Ixx2 - Izz2 + Izz3 + b3**2*(m3 + m4 + m5 + m6 + m7) - 2*b3*my3"
    assert symbolic["mz2"] == "mz2 - my3 + b3*(m3 + m4 + m5 + m6 + m7)"
    assert (
        numbers["Ixx2"]
        == "Ixx2 - Izz2 + Izz3 - 0.8*my3 + 0.16*m3 + 0.16*m4 + 0.16*m5 + 0.16*m6 + 0.16*m7"
    )
    assert numbers["mz6"] == "mz6 + mz7 + 0.126*m7"
    assert "0.015876*m7" in numbers["Ixx6"]


@pytest.mark.parametrize("arm", ARMS)
def test_symbols_hold_for_other_lengths(arm: str) -> None:
    model, _ = ARMS[arm]
    drive = DriveSet.parse("armature,offset")
    base = find_base_parameters(model, drive)
    rng = np.random.default_rng(3)
    lengths = {symbol: float(rng.uniform(0.1, 1.0)) for symbol in model.lengths}
    other = find_base_parameters(replace_lengths(model, lengths), drive)
    chi = random_parameters(base, rng)
    beta = other.values(list(chi.values()))
    np.testing.assert_allclose(
        [evaluated(text, {**chi, **lengths}) for text in base.symbolic], beta, rtol=1e-12
    )
    here = base.values(list(chi.values()))
    np.testing.assert_allclose([evaluated(text, chi) for text in base.expressions], here, rtol=1e-9)
    assert not set(model.lengths) & set(re.findall(r"[A-Za-z]\w*", " ".join(base.expressions)))


@pytest.mark.parametrize("robot", ["franka-panda", "puma-560"])
def test_offsets_along_a_joints_own_axis_keep_their_symbols(robot: str) -> None:
    base = find_base_parameters(bundled_robot(robot).with_gravity((0.0, 0.0, 0.0)))
    assert not re.search(r"\d\.\d", " ".join(base.symbolic))
    assert any(
        re.fullmatch(r"Iyz\d - b\d\*my\d.*|Iyz\d - b\d\*\(my\d.*", text) for text in base.symbolic
    )


def test_a_weight_that_never_changes_is_an_offset() -> None:
    slide = robot_from_dh([DHRow(kind="prismatic")], name="lift")
    base = find_base_parameters(slide, DriveSet.parse("armature,offset"))
    assert base.names == ("m1", "Ia1")
    np.testing.assert_allclose(base.values([0.0] * 9 + [2.0, 0.5, 9.81]), [3.0, -0.5], rtol=1e-12)


@pytest.mark.slow
def test_sympy_agrees_on_the_symbols() -> None:
    sympy = pytest.importorskip("sympy")
    base = find_base_parameters(iiwa())
    symbols = {name: sympy.Symbol(name) for name in (*base.standard_names, "b1", "b3", "b5", "b7")}
    lengths = {symbols[symbol]: sympy.nsimplify(value) for symbol, value in iiwa().lengths.items()}
    for text, row in zip(base.symbolic, base.regrouping, strict=True):
        expected = sum(
            sympy.nsimplify(round(value, 12)) * symbols[base.standard_names[j]]
            for j, value in enumerate(row)
            if value
        )
        assert sympy.expand(sympy.sympify(text, locals=symbols).subs(lengths) - expected) == 0


def test_a_missing_value_reaches_only_the_sums_that_contain_it() -> None:
    base = find_base_parameters(iiwa(), DriveSet.parse("viscous,armature"))
    chi = np.ones(base.n_standard)
    chi[base.standard_names.index("Ia1")] = chi[base.standard_names.index("Fv3")] = np.nan
    missing = [
        name for name, value in zip(base.names, base.values(chi), strict=True) if np.isnan(value)
    ]
    assert missing == ["Iyy1", "Fv3"]
    with pytest.raises(UsageError, match="84 standard parameters"):
        base.values(chi[:-7])


def test_the_answer_is_frozen_and_the_same_every_time() -> None:
    first, second = find_base_parameters(iiwa()), find_base_parameters(iiwa())
    assert first.expressions == second.expressions
    assert first.standard == second.standard
    np.testing.assert_array_equal(first.regrouping, second.regrouping)
    with pytest.raises(ValueError, match="read-only"):
        first.regrouping[0, 0] = 2.0


def test_a_robot_on_the_verge_of_being_special_is_refused_with_both_numbers() -> None:
    tilt = placement(rotation_x(1e-11))
    model = robot_from_dh(
        [DHRow(alpha=RIGHT, b=0.3, origin=tilt), DHRow(a=0.4), DHRow(a=0.3, b=0.1)], name="leaning"
    )
    with pytest.raises(
        IdentifiabilityError,
        match=r"leaning .* gives 15 base parameters, .* is 17 .*near right angles",
    ):
        find_base_parameters(model)


def test_other_peoples_descriptions(shared: Path) -> None:
    for path in sorted((shared / "models").glob("*.urdf")):
        model = read_urdf(path)
        rng = np.random.default_rng(1)
        for drive in (DriveSet(), DriveSet.parse(ALL_TERMS)):
            base = find_base_parameters(model, drive)
            q, qd, qdd = rng.uniform(-2.0, 2.0, (3, 5, model.n_joints))
            Y = observation_matrix(model, q, qd, qdd, drive=drive)
            np.testing.assert_allclose(
                Y[:, base.columns] @ base.regrouping, Y, atol=1e-12 * np.abs(Y).max()
            )
            expected = {7: (43, 69), 6: (36, 58)}[model.n_joints]
            assert base.n_base == expected[1 if drive else 0], path.name
            assert base.expressions == base.symbolic
