"""A vertical slide of two coupled motors: its offset shares base parameters with masses."""

import numpy as np
import pytest

from asbuilt import StudyOptions, identify, load_robot, simulate_recording
from asbuilt.excitation import random_fourier
from asbuilt.identification import consistency_margin
from asbuilt.identification.bodies.consistency import decide_consistency
from asbuilt.writers import export_result

LINK = """
[[links]]
name = "{name}"
joint = "{joint}"
kind = "{kind}"
parent = "{parent}"
origin = {{ xyz = {xyz}, rpy = {rpy} }}
mass = {mass}
com = {com}
inertia_about_com = {{ Ixx = {inertia}, Iyy = {inertia}, Izz = {inertia} }}
limits = {{ lower = -0.3, upper = 0.3, velocity = 0.5, acceleration = 3.0, torque = 900.0 }}
drive = {{ armature = {armature}, viscous = 2.0, coulomb = 1.5 }}
"""


@pytest.fixture(scope="module")
def torso(tmp_path_factory):
    rows = (
        ("column", "lift", "prismatic", "base", [0, 0, 0], [0, 0, 0], 12.0, [0.02, 0, 0.2], 0.3, 8),
        ("mast", "lift_2", "prismatic", "column", [0, 0, 0.4], [0, 0, 0], 7.0, [0, 0, 0.1], 0.2, 5),
        ("arm", "shoulder", "revolute", "mast", [0.1, 0, 0], [1.5, 0, 0], 4.0, [0.2, 0, 0], 0.1, 1),
        ("hand", "elbow", "revolute", "arm", [0.4, 0, 0], [0, 0, 0], 2.0, [0.1, 0, 0], 0.03, 0.2),
    )  # fmt: skip
    names = "name", "joint", "kind", "parent", "xyz", "rpy", "mass", "com", "inertia", "armature"
    links = "".join(LINK.format(**dict(zip(names, row, strict=True))) for row in rows)
    coupling = '\n[[couplings]]\nmotor = "lift"\nturns = { lift = 1.0, lift_2 = -1.0 }\n'
    file = tmp_path_factory.mktemp("torso") / "torso.toml"
    file.write_text('name = "torso"\nroot_link = "base"\n' + links + coupling)
    return load_robot(file)


@pytest.fixture(scope="module")
def result(torso):
    wrong = torso.with_parameters(torso.parameters * np.repeat([0.4, 2.5, 0.5, 1.6], 10))
    log = simulate_recording(torso, random_fourier(torso, rng=13, duration=8.0), rng=13)
    return identify(wrong, log, options=StudyOptions(method="consistent", checked=False)).result


def test_a_consistent_fit_is_called_consistent(result):
    """The base parameter `Iam1 + Fo2 / g` may be negative, since an offset has any sign."""
    shared = [name for name in result.base.names if name.startswith(("Ia", "m"))]
    offsets = [j for j, name in enumerate(result.base.standard_names) if name.startswith("Fo")]
    places = [result.base.names.index(name) for name in shared]
    assert np.any(result.base.regrouping[np.ix_(places, offsets)] != 0.0)
    assert result.physically_consistent
    assert decide_consistency(result.base, result.estimates)[1]


def test_an_offset_hides_no_inconsistent_link(result):
    beta = result.estimates.copy()
    beta[result.base.names.index("Izz4")] = -0.05
    assert consistency_margin(result.base, beta) < -0.01


def test_mujoco_accepts_the_robot_as_built(result, tmp_path):
    mujoco = pytest.importorskip("mujoco")
    export_result(result, mjcf=tmp_path / "torso.xml")
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "torso.xml"))
    assert model.nv == 4
    assert model.body_mass[1:].min() > 0.0
