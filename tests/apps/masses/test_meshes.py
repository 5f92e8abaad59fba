from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from asbuilt.apps.masses import link_from_meshes, read_cad_table
from asbuilt.apps.masses.computed_masses import parse_unit_factor
from asbuilt.apps.masses.solids import MATERIALS, MeshPart, with_cad_links
from asbuilt.description import LinkInertia, load_robot, placement
from asbuilt.errors import DescriptionError, MissingExtraError, UsageError
from log_cholesky import from_log_cholesky

trimesh = pytest.importorskip("trimesh")


def box(
    mass: float, sides: tuple[float, float, float], centre: tuple[float, float, float]
) -> LinkInertia:
    x, y, z = (side**2 for side in sides)
    return LinkInertia.from_com(mass, centre, mass / 12 * np.diag([y + z, x + z, x + y]))


@pytest.fixture
def brick(tmp_path):
    """A brick of 100 x 60 x 40 mm with a corner at the origin, in an STL in millimetres."""
    mesh = trimesh.creation.box((100, 60, 40))
    mesh.apply_translation((50, 30, 20))
    mesh.export(tmp_path / "brick.stl")
    return tmp_path / "brick.stl"


def test_a_brick_has_the_moments_of_a_brick(brick):
    cad = link_from_meshes("a", [MeshPart(path=brick, material="aluminium", unit="mm")])
    expected = box(2700 * 0.1 * 0.06 * 0.04, (0.1, 0.06, 0.04), (0.05, 0.03, 0.02))
    assert np.allclose(cad.link.inertia.parameters, expected.parameters, rtol=1e-6, atol=1e-12)
    assert cad.warnings == ()


def test_parts_add_up_where_they_sit(brick):
    T = placement(Rotation.from_euler("xyz", [0.3, -0.2, 0.9]).as_matrix(), (0.4, 0.1, -0.2))
    parts = [
        MeshPart(path=brick, material="aluminium", unit="mm", name="shell"),
        MeshPart(path=brick, material=1000.0, unit="mm", placement=T, name="motor"),
    ]
    cad = link_from_meshes("a", parts)
    light = box(1000 * 0.1 * 0.06 * 0.04, (0.1, 0.06, 0.04), (0.05, 0.03, 0.02))
    heavy = box(2700 * 0.1 * 0.06 * 0.04, (0.1, 0.06, 0.04), (0.05, 0.03, 0.02))
    assert np.allclose(
        cad.link.inertia.parameters, (heavy + light.moved(T)).parameters, rtol=1e-6, atol=1e-12
    )
    assert [name for name, _ in cad.link.parts] == ["shell", "motor"]
    assert cad.link.inertia.is_consistent


def test_a_fine_sphere_approaches_the_formula(tmp_path):
    trimesh.creation.icosphere(subdivisions=4, radius=0.1).export(tmp_path / "ball.ply")
    inertia = link_from_meshes(
        "a", [MeshPart(path=tmp_path / "ball.ply", material="steel", unit="m")]
    ).link.inertia
    mass = MATERIALS["steel"] * 4 / 3 * np.pi * 0.1**3
    assert np.isclose(inertia.mass, mass, rtol=5e-3)
    assert np.allclose(inertia.principal_moments, 0.4 * mass * 0.01, rtol=1e-2)


def test_doubtful_surfaces_are_named(brick, tmp_path):
    mesh = trimesh.load(brick, force="mesh")
    mesh.update_faces(np.arange(len(mesh.faces)) > 0)
    mesh.export(tmp_path / "open.stl")
    (warning,) = link_from_meshes(
        "a", [MeshPart(path=tmp_path / "open.stl", material=1000.0, unit="mm")]
    ).warnings
    assert "link 'a', open.stl: the surface is not closed" in warning
    inside_out = trimesh.load(brick, force="mesh")
    inside_out.invert()
    inside_out.export(tmp_path / "inverted.stl")
    cad = link_from_meshes(
        "a", [MeshPart(path=tmp_path / "inverted.stl", material=1000.0, unit="mm")]
    )
    assert "inside out" in cad.warnings[0]
    assert np.isclose(cad.link.inertia.mass, 0.24)
    assert (
        "check the unit"
        in link_from_meshes("a", [MeshPart(path=brick, material=1000.0, unit="m")]).warnings[0]
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"material": "adamantium"},
            r"material 'adamantium' is unknown; give a density in kg/m\^3 or one of abs, aluminium",
        ),
        ({"material": -3.0}, r"density is -3.0"),
        ({"unit": "furlong"}, r"length unit 'furlong' is unknown"),
        ({"path": "none.stl"}, r"mesh none\.stl cannot be read: it does not exist"),
        ({"path": "part.step"}, r"meshes are read from .stl"),
    ],
)
def test_parts_that_make_no_sense(brick, change, message):
    part = MeshPart(**({"path": brick, "material": 1000.0, "unit": "mm"} | change))
    with pytest.raises(DescriptionError, match=message):
        link_from_meshes("a", [part])


def test_flat_and_broken_meshes(tmp_path):
    trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]).export(tmp_path / "flat.stl")
    with pytest.raises(DescriptionError, match="no volume"):
        link_from_meshes("a", [MeshPart(path=tmp_path / "flat.stl", material=1.0, unit="m")])
    (tmp_path / "junk.obj").write_text("this is no mesh")
    with pytest.raises(DescriptionError, match=r"cannot be read|no finite triangles"):
        link_from_meshes("a", [MeshPart(path=tmp_path / "junk.obj", material=1.0, unit="m")])
    with pytest.raises(DescriptionError, match="no parts are given"):
        link_from_meshes("a", [])


def test_without_trimesh_the_extra_is_named(monkeypatch, brick):
    import sys

    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(MissingExtraError, match=r"asbuilt\[cad\]"):
        link_from_meshes("a", [MeshPart(path=brick, material=1.0, unit="mm")])


def exported(
    path,
    inertia: LinkInertia,
    *,
    about: str,
    sign: float,
    header: str,
    separator: str = ",",
    rows: int = 1,
):
    tensor = inertia.inertia_about_com if about == "com" else inertia.inertia
    g, mm = 1e3, 1e3
    values = [inertia.mass * g, *(inertia.com * mm), *(np.diag(tensor) * g * mm**2)]
    values += [sign * tensor[i, j] * g * mm**2 for i, j in ((0, 1), (0, 2), (1, 2))]
    cells = [repr(float(value)) for value in values]
    if separator == ";":
        cells = [cell.replace(".", ",") for cell in cells]
    path.write_text(header + "\n" + (separator.join(["link_2", "housing", *cells]) + "\n") * rows)


PLAIN = "link,part,mass,cx,cy,cz,Ixx,Iyy,Izz,Ixy,Ixz,Iyz"
UNITS = (
    "Link,Component,Mass [g],Rx [mm],Ry [mm],Rz [mm],Lxx (g*mm^2),Lyy (g mm2),Lzz (g mm²),Lxy (g"
    " mm^2),Lxz (g mm^2),Lyz (g mm^2)"
)


@pytest.mark.parametrize("about", ["com", "origin"])
@pytest.mark.parametrize(("products", "sign"), [("tensor", 1.0), ("integral", -1.0)])
@pytest.mark.parametrize("separator", [",", ";"])
def test_every_convention_of_cad_tables(tmp_path, about, products, sign, separator):
    inertia = from_log_cholesky(np.random.default_rng(2).uniform(-1, 1, 10))
    exported(
        tmp_path / "t.csv",
        inertia,
        about=about,
        sign=sign,
        header=UNITS.replace(",", separator),
        separator=separator,
    )
    links = read_cad_table(tmp_path / "t.csv", about=about, products=products)
    assert np.allclose(
        links["link_2"].link.inertia.parameters, inertia.parameters, rtol=1e-12, atol=1e-12
    )
    assert [name for name, _ in links["link_2"].link.parts] == ["housing"]


def test_rows_of_one_link_add_up(tmp_path):
    inertia = from_log_cholesky(np.zeros(10))
    exported(tmp_path / "t.csv", inertia, about="com", sign=1.0, header=UNITS, rows=3)
    links = read_cad_table(tmp_path / "t.csv", about="com", products="tensor")
    assert np.allclose(links["link_2"].link.inertia.parameters, 3 * inertia.parameters)
    model = with_cad_links(load_robot("two-link"), links)
    assert np.allclose(model.links[1].inertia.parameters, links["link_2"].link.inertia.parameters)
    assert model.links[0].inertia.mass == 5.4
    with pytest.raises(DescriptionError, match=r"no link 'link_9' \(did you mean"):
        with_cad_links(model, {"link_9": links["link_2"]})


def test_the_wrong_convention_is_noticed(tmp_path):
    inertia = LinkInertia.from_com(2.0, [0.5, 0.4, 0.3], np.diag([0.01, 0.01, 0.01]))
    exported(tmp_path / "t.csv", inertia, about="com", sign=1.0, header=UNITS)
    (warning,) = read_cad_table(tmp_path / "t.csv", about="origin", products="tensor")[
        "link_2"
    ].warnings
    assert "link 'link_2', part 'housing'" in warning
    assert "check units, about='origin'" in warning


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (PLAIN + "\na,b,1,0,0,0,1,1,1,0,0,0\n", r"column 'mass' states no unit"),
        (
            UNITS.replace("[g]", "[stone]") + "\na,b,1,0,0,0,1,1,1,0,0,0\n",
            r"column 'Mass \[stone\]': .*'stone', which is unknown",
        ),
        (
            UNITS.replace("[g]", "[mm]") + "\na,b,1,0,0,0,1,1,1,0,0,0\n",
            r"mass\^0 length\^1; expected mass\^1 length\^0",
        ),
        (UNITS.replace("Lyz", "Qyz") + "\na,b,1,0,0,0,1,1,1,0,0,0\n", r"column Iyz is missing"),
        (UNITS.replace("Lyz", "Lxy") + "\na,b,1,0,0,0,1,1,1,0,0,0\n", r"gives Ixy a second time"),
        (UNITS + "\na,b,1,0,0\n", r"line 2: 5 cells"),
        (
            UNITS + "\na,b,1,5,0,0,0,1,1,1,0,0,0\n",
            r"line 2: 13 cells, but the header has 12 columns; where numbers have decimal commas",
        ),
        (UNITS + "\na,b," + "1" * 200_000 + ",0,0,0,1,1,1,0,0,0\n", r"cannot be read as CSV text"),
        (UNITS + "\na,b,one,0,0,0,1,1,1,0,0,0\n", r"line 2: mass is 'one'"),
        (UNITS + "\na,b,inf,0,0,0,1,1,1,0,0,0\n", r"line 2: mass is inf"),
        (UNITS, r"no rows"),
    ],
)
def test_broken_cad_tables(tmp_path, text, message):
    (tmp_path / "t.csv").write_text(text)
    with pytest.raises(DescriptionError, match=message):
        read_cad_table(tmp_path / "t.csv", about="com", products="tensor")


def test_empty_cells_behind_the_last_column_say_nothing(tmp_path):
    (tmp_path / "t.csv").write_text(UNITS + "\na,b,1000,0,0,0,1,1,1,0,0,0,, \n")
    assert (
        read_cad_table(tmp_path / "t.csv", about="com", products="tensor")["a"].link.inertia.mass
        == 1.0
    )


def test_conventions_must_be_said(tmp_path):
    with pytest.raises(UsageError, match="does not state its conventions"):
        read_cad_table(tmp_path / "t.csv", about="middle", products="tensor")


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("kg m^2", 1.0),
        ("g*cm²", 1e-7),
        ("lb in2", 0.45359237 * 0.0254**2),
        ("g µm²", 1e-15),
        ("kg·m^2", 1.0),
    ],
)
def test_units(text, value):
    assert np.isclose(parse_unit_factor(text, mass=1, length=2), value, rtol=1e-14)


def test_a_table_of_gigabytes_is_one_error(tmp_path):
    path = tmp_path / "masses.csv"
    with path.open("wb") as stream:
        stream.truncate(8_000_000_000)
    with pytest.raises(DescriptionError, match=r"has 8000 MB; at most 2 MB are read"):
        read_cad_table(path, about="com", products="tensor")
