"""Mass properties from geometry against closed formulas, and what is implausible in a file."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from asbuilt import link_masses
from asbuilt.cli import app
from asbuilt.description import LinkInertia, load_robot
from asbuilt.description.formats.urdf import read_urdf
from asbuilt.errors import AsbuiltError, DescriptionError, UsageError

trimesh = pytest.importorskip("trimesh")

JOINT = (
    '<joint name="j{0}" type="revolute"><parent link="{1}"/><child link="{2}"/>'
    '<origin xyz="0 0 0.3"/><axis xyz="0 0 1"/>'
    '<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
)


def main(arguments):
    with pytest.raises(SystemExit) as ended:
        app.main(arguments)
    return ended.value.code or 0


def inertial(mass, moments, com=(0, 0, 0)):
    xx, yy, zz = moments
    return (
        f'<inertial><origin xyz="{com[0]} {com[1]} {com[2]}"/><mass value="{mass}"/>'
        f'<inertia ixx="{xx}" iyy="{yy}" izz="{zz}" ixy="0" ixz="0" iyz="0"/></inertial>'
    )


def body(kind, shape, xyz="0 0 0", rpy="0 0 0"):
    return f'<{kind}><origin xyz="{xyz}" rpy="{rpy}"/><geometry>{shape}</geometry></{kind}>'


def robot(folder: Path, *links: str, extra: str = "") -> Path:
    text = '<robot name="test"><link name="base"/>'
    for k, inside in enumerate(links):
        text += f'<link name="l{k}">{inside}</link>'
        text += JOINT.format(k, "base" if k == 0 else f"l{k - 1}", f"l{k}")
    path = folder / "robot.urdf"
    path.write_text(text + extra + "</robot>")
    return path


def close(found, mass, com, about_com):
    expected = LinkInertia.from_com(mass, com, np.array(about_com))
    np.testing.assert_allclose(found.parameters, expected.parameters, rtol=1e-9, atol=1e-12)


def by_name(masses):
    return {each.name: each for each in masses.links}


def codes(masses, link):
    return {f.code for f in masses.findings if f.message.startswith(f"link {link}:")}


PLAUSIBLE = inertial(1.0, (0.002, 0.002, 0.002))


def test_primitives_with_origins_have_the_inertia_of_the_textbook(tmp_path):
    box = body("visual", '<box size="0.2 0.1 0.06"/>', "0.1 0 0", "0 0 1.5707963267948966")
    cylinder = body("visual", '<cylinder radius="0.05" length="0.3"/>', "0 0 0.15")
    ball = body("visual", '<sphere radius="0.04"/>', "0 0.2 0")
    path = robot(tmp_path, PLAUSIBLE + box, PLAUSIBLE + cylinder, PLAUSIBLE + ball)
    found = by_name(link_masses(load_robot(path), density={"l0": 2700, "l1": 1000, "l2": 7850}))
    m = 2700 * 0.2 * 0.1 * 0.06
    turned = m / 12 * np.diag([0.2**2 + 0.06**2, 0.1**2 + 0.06**2, 0.1**2 + 0.2**2])
    close(found["l0"].computed, m, [0.1, 0, 0], turned)
    m = 1000 * np.pi * 0.05**2 * 0.3
    across = m * (3 * 0.05**2 + 0.3**2) / 12
    close(found["l1"].computed, m, [0, 0, 0.15], np.diag([across, across, m * 0.05**2 / 2]))
    m = 7850 * 4 / 3 * np.pi * 0.04**3
    close(found["l2"].computed, m, [0, 0.2, 0], 0.4 * m * 0.04**2 * np.eye(3))


def test_a_hollow_mesh_in_millimetres_is_a_box_less_a_box(tmp_path):
    outer, inner = (200.0, 100.0, 60.0), (180.0, 80.0, 40.0)
    hole = trimesh.creation.box(inner)
    hole.invert()
    mesh = trimesh.util.concatenate([trimesh.creation.box(outer), hole])
    (tmp_path / "parts").mkdir()
    mesh.export(tmp_path / "parts" / "arm.stl")
    shape = '<mesh filename="package://robot/meshes/arm.stl" scale="0.001 0.001 0.001"/>'
    path = robot(tmp_path, PLAUSIBLE + body("visual", shape, "0.1 0 0"))
    found = link_masses(load_robot(path), meshes=tmp_path / "parts", material="aluminium")
    mass, tensor = 0.0, np.zeros((3, 3))
    for sign, (a, b, c) in ((1, outer), (-1, inner)):
        m = sign * 2700 * a * b * c * 1e-9
        mass += m
        tensor += m / 12 * 1e-6 * np.diag([b * b + c * c, a * a + c * c, a * a + b * b])
    close(by_name(found)["l0"].computed, mass, [0.1, 0, 0], tensor)


def test_a_mesh_without_its_scale_is_named_and_not_used(tmp_path):
    trimesh.creation.box((200, 100, 60)).export(tmp_path / "arm.stl")
    path = robot(tmp_path, PLAUSIBLE + body("visual", '<mesh filename="arm.stl"/>'))
    found = link_masses(load_robot(path), density=2700)
    assert found.links[0].computed is None
    assert codes(found, "l0") == {"mesh_scale"}
    assert "0.001 0.001 0.001" in str(found.findings[0].cure)


def test_an_open_mesh_gives_way_to_the_collision_geometry_and_is_named(tmp_path):
    mesh = trimesh.creation.box((0.2, 0.1, 0.06))
    mesh.update_faces(np.arange(len(mesh.faces)) > 1)
    mesh.export(tmp_path / "open.stl")
    visual = body("visual", '<mesh filename="open.stl"/>')
    collision = body("collision", '<box size="0.2 0.1 0.06"/>')
    path = robot(tmp_path, PLAUSIBLE + visual + collision, PLAUSIBLE + visual)
    found = link_masses(load_robot(path), density=1000)
    links = by_name(found)
    assert (links["l0"].origin, links["l1"].origin) == ("collision", "visual")
    assert links["l0"].computed.mass == pytest.approx(1.2)
    said = {each.message for each in found.findings if each.code == "doubtful_mesh"}
    assert len(said) == 2
    assert all("open.stl" in each and "not closed" in each for each in said)


def test_without_densities_a_link_keeps_its_mass(tmp_path):
    path = robot(tmp_path, inertial(3.0, (1, 1, 1)) + body("visual", '<box size="0.2 0.1 0.06"/>'))
    found = link_masses(load_robot(path))
    tensor = 3.0 / 12 * np.diag([0.1**2 + 0.06**2, 0.2**2 + 0.06**2, 0.2**2 + 0.1**2])
    close(found.links[0].computed, 3.0, np.zeros(3), tensor)


def test_links_behind_fixed_joints_add_to_their_carrier(tmp_path):
    fixed = (
        '<link name="tool">' + body("visual", '<sphere radius="0.05"/>') + "</link>"
        '<joint name="f" type="fixed"><parent link="l0"/><child link="tool"/>'
        '<origin xyz="0 0 0.4"/></joint>'
    )
    path = robot(tmp_path, PLAUSIBLE + body("visual", '<box size="0.1 0.1 0.1"/>'), extra=fixed)
    found = link_masses(load_robot(path), density={"l0": 1000.0, "tool": 2000.0}).links[0].computed
    ball = 2000 * 4 / 3 * np.pi * 0.05**3
    assert found.mass == pytest.approx(1.0 + ball)
    np.testing.assert_allclose(found.com, [0, 0, 0.4 * ball / (1.0 + ball)], atol=1e-12)


def test_what_is_implausible_in_the_description_comes_first(tmp_path):
    box = body("visual", '<box size="0.2 0.1 0.06"/>')
    good = inertial(3.24, (0.00367, 0.01177, 0.0135))
    path = robot(
        tmp_path,
        good + box,
        inertial(3.24, (1, 1, 1)) + box,
        inertial(0.01, (1e-5, 4e-5, 4e-5)) + box,
        inertial(1.0, (0.01, 0.001, 0.001)) + box,
        box,
        inertial(2.0, (0.001, 0.002, 0.002), (0.3, 0, 0)) + box,
    )
    found = link_masses(load_robot(path), density=2700)
    assert codes(found, "l0") == set()
    assert codes(found, "l1") == {"unit_inertia", "inertia_too_large"}
    assert codes(found, "l2") >= {"implausible_density"}
    assert codes(found, "l3") >= {"inconsistent_inertia", "inertia_too_large"}
    assert codes(found, "l4") == {"no_inertia"}
    assert codes(found, "l5") >= {"com_outside"}
    assert [each.name for each in found.links][-1] == "l0"
    assert found.findings[0].severity == "error"
    said = f"LinkMasses('test', 6 of 6 links computed, {len(found.findings)} findings)"
    assert repr(found) == said


def test_copied_inertias_are_named(tmp_path):
    path = robot(tmp_path, PLAUSIBLE, PLAUSIBLE, inertial(2.0, (0.003, 0.003, 0.003)))
    found = link_masses(load_robot(path), density=1000)
    assert "copied_inertia" in codes(found, "l0")
    assert "copied_inertia" in codes(found, "l1")
    assert "copied_inertia" not in codes(found, "l2")


def table(folder):
    path = folder / "cad.csv"
    path.write_text(
        "link,mass [g],cx [mm],cy [mm],cz [mm],Ixx [g mm^2],Iyy [g mm^2],Izz [g mm^2],"
        "Ixy [g mm^2],Ixz [g mm^2],Iyz [g mm^2]\n"
        "l0,1500,10,20,30,2e6,3e6,4e6,1e5,0,0\n"
    )
    return path


def test_a_cad_table_stands_beside_the_description(tmp_path):
    path = robot(tmp_path, PLAUSIBLE, PLAUSIBLE)
    found = by_name(
        link_masses(load_robot(path), table=table(tmp_path), about="com", products="integral")
    )
    tensor = np.array([[2e-3, -1e-4, 0], [-1e-4, 3e-3, 0], [0, 0, 4e-3]])
    close(found["l0"].computed, 1.5, [0.01, 0.02, 0.03], tensor)
    assert found["l0"].mass_change == pytest.approx(0.5)
    assert found["l1"].computed is None


@pytest.mark.parametrize(
    ("options", "kind", "said"),
    [
        ({"material": "wood"}, DescriptionError, "material 'wood' is unknown.*aluminium"),
        ({"density": -1.0}, DescriptionError, "density is -1.0"),
        ({"density": {"l7": 1.0}}, DescriptionError, "no link 'l7'"),
        ({"density": 1.0, "material": "steel"}, UsageError, "exclude each other"),
        ({"meshes": "nowhere"}, DescriptionError, "no folder nowhere"),
        ({"table": "cad.csv"}, UsageError, "does not state its conventions"),
        ({"table": "cad.csv", "density": 1.0}, UsageError, "has masses already"),
    ],
)
def test_what_does_not_fit_is_refused(tmp_path, options, kind, said):
    path = robot(tmp_path, PLAUSIBLE)
    with pytest.raises(kind, match=said):
        link_masses(load_robot(path), **options)


@pytest.mark.parametrize("arm", ["two-link", "ur10e", "kuka-iiwa7-r800"])
def test_robots_without_geometry_take_a_table(arm, tmp_path, capsys):
    model = load_robot(arm)
    with pytest.raises(AsbuiltError, match="has no geometry"):
        link_masses(model, density=2700)
    rows = [
        "link,mass [kg],cx [m],cy [m],cz [m],Ixx [kg m^2],Iyy [kg m^2],Izz [kg m^2],"
        "Ixy [kg m^2],Ixz [kg m^2],Iyz [kg m^2]"
    ]
    for link in model.links:
        t = link.inertia.inertia_about_com
        numbers = [
            2 * link.inertia.mass,
            *link.inertia.com,
            *(2 * np.diag(t)),
            *(2 * t[[0, 0, 1], [1, 2, 2]]),
        ]
        rows.append(",".join([link.name, *map(repr, map(float, numbers))]))
    (tmp_path / "cad.csv").write_text("\n".join(rows) + "\n")
    out = tmp_path / "twice.toml"
    arguments = ["--table", str(tmp_path / "cad.csv"), "--about", "com", "--products", "tensor"]
    assert main(["masses", arm, *arguments, "--out", str(out), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["files"] == {"robot": str(out)}
    np.testing.assert_allclose(
        load_robot(out).parameters, 2 * model.parameters, rtol=1e-9, atol=1e-15
    )


def test_the_urdf_is_edited_in_place(tmp_path, capsys):
    box = body("visual", '<box size="0.2 0.1 0.06"/>')
    path = robot(tmp_path, "<!-- mine -->" + inertial(3.24, (1, 1, 1)) + box)
    out = tmp_path / "new.urdf"
    assert main(["masses", str(path), "--density", "2700", "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert max(map(len, said.replace(str(out), "").splitlines())) <= 80
    assert said.index("ERROR unit_inertia") < said.index("ERROR inertia_too_large")
    assert "<!-- mine -->" in out.read_text()
    m = 2700 * 0.2 * 0.1 * 0.06
    tensor = m / 12 * np.diag([0.1**2 + 0.06**2, 0.2**2 + 0.06**2, 0.2**2 + 0.1**2])
    close(read_urdf(out).links[0].inertia, m, np.zeros(3), tensor)
    assert re.sub(r"<inertial>.*</inertial>", "", out.read_text()) == re.sub(
        r"<inertial>.*</inertial>", "", path.read_text()
    )


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--density", "heavy"], "takes numbers in kg/m"),
        (["--density", "l0="], "LINK=VALUE"),
        (["--about", "corner"], "com, origin"),
        (["--density", "1000", "--out", "new.step"], "must end in .urdf or .toml"),
    ],
)
def test_wrong_usage_ends_with_2(tmp_path, capsys, monkeypatch, arguments, said):
    monkeypatch.chdir(tmp_path)
    path = robot(tmp_path, PLAUSIBLE + body("visual", '<box size="0.2 0.1 0.06"/>'))
    assert main(["masses", str(path), *arguments]) == 2
    assert said in capsys.readouterr().err


def test_a_mesh_that_cannot_be_read_is_the_reason_why_nothing_is_written(tmp_path, capsys):
    (tmp_path / "part.stl").write_bytes(b"not a mesh")
    path = robot(tmp_path, PLAUSIBLE + body("visual", '<mesh filename="part.stl"/>'))
    out = tmp_path / "new.urdf"
    assert main(["masses", str(path), "--density", "2700", "--out", str(out)]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "no mass properties were computed: link l0:" in said
    assert "part.stl" in said


def test_conventions_of_a_table_need_a_table():
    with pytest.raises(UsageError, match="conventions of a table"):
        link_masses(load_robot("two-link"), density=2700.0, about="com", products="tensor")
