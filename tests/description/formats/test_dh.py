from __future__ import annotations

import numpy as np
import pytest

from asbuilt.description import ROOT, DHRow, placement, robot_from_dh
from asbuilt.description.formats.dh import read_dh_table
from asbuilt.description.lengths import evaluate_lengths
from asbuilt.description.rotation import rotation_x, rotation_z
from asbuilt.errors import DescriptionError

HEADER = "link,b,a,alpha_deg,m,rx,ry,rz,Ixx,Iyy,Izz,Ixy,Iyz,Izx\n"
ROW = "1,0.3,0.2,90,2,0.1,0,0,0.1,0.1,0.1,0,0,0\n"


def test_standard_and_modified_are_the_textbook_products():
    q, a, b, alpha, theta = 0.7, 0.3, -0.2, 0.4, 0.1
    standard = robot_from_dh([DHRow(a=a, b=b, alpha=alpha, theta=theta)]).joints[0]
    T = standard.before @ placement(rotation_z(q)) @ standard.after
    turn, slide = placement(rotation_z(q + theta)), placement(translation=(0, 0, b))
    length, twist = placement(translation=(a, 0, 0)), placement(rotation_x(alpha))
    assert np.allclose(T, turn @ slide @ length @ twist, atol=1e-15)
    modified = robot_from_dh(
        [DHRow(a=a, b=b, alpha=alpha, theta=theta)], convention="modified"
    ).joints[0]
    T = modified.before @ placement(rotation_z(q)) @ modified.after
    assert np.allclose(T, twist @ length @ turn @ slide, atol=1e-15)


@pytest.mark.parametrize("convention", ["standard", "modified"])
def test_symbols_stand_for_the_translations(convention):
    origin = placement(rotation_x(0.3))
    rows = [
        DHRow(a=0.1, b=0.4, alpha=np.pi / 2, origin=origin),
        DHRow(b=0.4, alpha=-0.5, theta=0.2),
        DHRow(a=-0.3, kind="prismatic", alpha=np.pi),
        DHRow(),
    ]
    model = robot_from_dh(rows, convention=convention)
    assert dict(model.lengths) == {"a1": 0.1, "b1": 0.4, "b2": 0.4, "a3": -0.3}
    for joint in model.joints:
        for symbols, T in (
            (joint.before_symbols, joint.before),
            (joint.after_symbols, joint.after),
        ):
            if symbols is None:
                assert not T[:3, 3].any()
            else:
                assert np.allclose(evaluate_lengths(symbols, model.lengths), T[:3, 3], atol=1e-16)


def test_an_origin_with_plain_numbers_leaves_numbers():
    model = robot_from_dh(
        [DHRow(a=0.1, origin=placement(translation=(1, 2, 3)))], convention="modified"
    )
    assert model.joints[0].before_symbols is None
    assert np.array_equal(model.joints[0].before[:3, 3], [1.1, 2, 3])


def test_trees_and_orphans():
    model = robot_from_dh([DHRow(), DHRow(parent=ROOT), DHRow(parent=0)])
    assert model.parents == (ROOT, ROOT, 0)
    with pytest.raises(DescriptionError, match="row 1 hangs on row 3"):
        robot_from_dh([DHRow(parent=2), DHRow(), DHRow()])


def test_angles_are_straightened_and_nonsense_is_refused():
    model = robot_from_dh([DHRow(alpha=1.5708)])
    assert np.array_equal(model.joints[0].after[:3, :3], rotation_x(np.pi / 2))
    assert "alpha of row 1 is given as 1.5708" in model.notes[0]
    with pytest.raises(DescriptionError, match="alpha of row 1 is nan"):
        robot_from_dh([DHRow(alpha=np.nan)])
    with pytest.raises(DescriptionError, match="'khalil' is unknown"):
        robot_from_dh([DHRow()], convention="khalil")
    with pytest.raises(DescriptionError, match="no moving joint"):
        robot_from_dh([])


def test_a_table_may_have_offsets_and_sliding_joints(tmp_path):
    path = tmp_path / "arm.csv"
    extra = (
        HEADER.strip()
        + ",theta_deg,kind\n"
        + ROW.strip()
        + ",90,revolute\n\n"
        + ROW.strip()
        + ",0,P\n"
    )
    path.write_text(extra)
    model = read_dh_table(path)
    assert model.name == "arm"
    assert [joint.kind for joint in model.joints] == ["revolute", "prismatic"]
    assert np.array_equal(model.joints[0].before[:3, :3], rotation_z(np.pi / 2))
    assert model.links[0].inertia.mass == 2.0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no rows"),
        (HEADER, "no rows"),
        (
            HEADER + ROW.replace(",90,", ",ninety,"),
            r"line 2: alpha_deg is 'ninety'; it must be a number",
        ),
        (HEADER + ROW.replace(",90,", ",inf,"), r"alpha_deg is inf; it must be finite"),
        (HEADER + "1,2,3\n", r"line 2: 3 cells, but the header has 14 columns"),
        (HEADER.replace("Izz", "Iqq") + ROW, r"column Izz is missing"),
        (HEADER.replace("link", "m") + ROW, r"column 'm' appears twice"),
        (HEADER.strip() + ",colour\n" + ROW.strip() + ",red\n", r"column 'colour' is unknown"),
        (HEADER.strip() + ",kind\n" + ROW.strip() + ",helical\n", r"kind is 'helical'"),
    ],
)
def test_broken_tables_name_line_and_column(tmp_path, text, message):
    path = tmp_path / "table.csv"
    path.write_text(text)
    with pytest.raises(DescriptionError, match=message):
        read_dh_table(path)
