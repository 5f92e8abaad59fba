"""BAM's own law, solved for the motion, gives the torque of the drive terms."""

from dataclasses import replace

import numpy as np
import pytest

from asbuilt.apps.simulators.simulator_formats.bam import choose_bam_parameters
from asbuilt.description import DriveValues, Joint, bundled_robot
from asbuilt.dynamics import DriveSet
from asbuilt.errors import UsageError

VALUES = {
    "stribeck": {"Fs": 0.3, "velocity": 0.4, "power": 1.4},
    "load_friction": {"Fl": 0.2},
    "load_stribeck": {"Fls": 0.1, "velocity": 0.4, "power": 1.4},
    "directional_load_friction": {"Flm": 0.25, "Fle": 0.21},
    "directional_load_stribeck": {"Flsm": 0.05, "Flse": 0.03, "velocity": 0.4, "power": 1.4},
    "quadratic_load_stribeck": {"Flqm": 0.002, "Flqe": 0.001, "velocity": 0.4, "power": 1.4},
}


def joint_with(name: str) -> Joint:
    terms = {key: VALUES[key] for key in DriveSet.parse(name).keys if key in VALUES}
    drive = DriveValues(armature=0.02, viscous=0.0, coulomb=0.0, terms=terms)
    return replace(bundled_robot("two-link").joints[0], drive=drive)


def friction_of_bam(p: dict[str, float], motor: float, external: float, qd: float) -> float:
    """Return the friction budget that BAM documents for its models."""
    fades = np.exp(-(abs(qd / p["dtheta_stribeck"]) ** p["alpha"])) if "alpha" in p else 0.0
    budget = p["friction_base"] + p["friction_viscous"] * abs(qd)
    budget += fades * p.get("friction_stribeck", 0.0)
    between = abs(motor - external)
    budget += between * (
        p.get("load_friction_base", 0.0) + fades * p.get("load_friction_stribeck", 0.0)
    )
    for ending, size in (("", 1.0), ("_stribeck", fades)):
        budget += size * abs(
            external * p.get(f"load_friction_external{ending}", 0.0)
            - motor * p.get(f"load_friction_motor{ending}", 0.0)
        )
    if motor * external < 0.0:
        ahead = abs(motor) > abs(external)
        square = p.get("load_friction_external_quad", 0.0) * external**2 if ahead else (
            p.get("load_friction_motor_quad", 0.0) * motor**2
        )  # fmt: skip
        budget += fades * square
    return float(budget)


def friction_in_motion(p: dict[str, float], load: float, qd: float) -> float:
    """Return the friction at which motor, load and friction are in balance, by iteration."""
    friction = 0.0
    for _ in range(200):
        friction = friction_of_bam(p, load + friction * np.sign(qd), -load, qd)
    return friction


def torque_of_terms(name: str, load: float, qd: float) -> float:
    joint = joint_with(name)
    stated = DriveSet.parse(name + ("" if name[-1] in "13" else ":velocity=0.4:power=1.4"))
    values = [value or 0.0 for value in stated.values(joint.drive)]
    state = (np.zeros(1), np.array([qd]), np.zeros(1))
    return float(values @ stated.evaluate(*state, load=np.array([load]))[:, 0])


@pytest.mark.parametrize("name", ["bam-m1", "bam-m2", "bam-m5"])
@pytest.mark.parametrize("load", [-8.0, 3.0])
@pytest.mark.parametrize("qd", [-0.9, 0.05, 3.0])
def test_torque_in_motion(name: str, load: float, qd: float) -> None:
    p = choose_bam_parameters(joint_with(name))
    assert p["model"] == name[-2:]
    expected = friction_in_motion(p, load, qd) * np.sign(qd)
    # beside Stribeck friction and while load friction fades, the two laws differ to second order
    tolerance = 1e-6 if "alpha" not in p or abs(qd) > 1 else 0.06
    assert torque_of_terms(name, load, qd) == pytest.approx(expected, rel=tolerance, abs=1e-9)


@pytest.mark.parametrize("name", ["bam-m3", "bam-m4"])
def test_one_coefficient_is_the_mean_of_both_directions(name: str) -> None:
    p = choose_bam_parameters(joint_with(name))
    ahead, back = (friction_in_motion(p, load, 5.0) for load in (6.0, -6.0))
    assert ahead > back
    assert 0.5 * (ahead + back) == pytest.approx(torque_of_terms(name, 6.0, 5.0), rel=1e-9)


def test_quadratic_friction_counts_by_direction() -> None:
    p = choose_bam_parameters(joint_with("bam-m6"))
    for load, size in ((9.0, 0.002), (-9.0, 0.001)):
        difference = torque_of_terms("bam-m6", load, 0.2) - torque_of_terms("bam-m5", load, 0.2)
        fades = np.exp(-((0.2 / 0.4) ** 1.4))
        assert difference == pytest.approx(size * 81.0 * fades, rel=1e-12)
    assert (p["load_friction_external_quad"], p["load_friction_motor_quad"]) == (0.002, 0.001)


@pytest.mark.parametrize("text", ["bam", "bam-m7", "m4", "bam-m1:velocity=1", "bam-m4:joints=2"])
def test_names_that_are_no_set(text: str) -> None:
    with pytest.raises(UsageError, match=r"set of drive terms|fades with speed"):
        DriveSet.parse(text)


def test_a_set_states_one_velocity_for_all_terms_that_fade() -> None:
    drive = DriveSet.parse("bam:m4:velocity=0.2,offset")
    assert [str(term) for term in drive.terms if "velocity" in str(term)] == [
        "stribeck:velocity=0.2",
        "load_stribeck:velocity=0.2",
    ]
    assert "offset" in drive.keys
    assert DriveSet.parse(str(drive)) == drive
