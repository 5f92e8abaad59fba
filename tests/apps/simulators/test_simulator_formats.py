"""Files for simulators, read by other means: Python run with stand-ins, USD text, XML, YAML."""

import json
import re
import sys
import types
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import polars
import pytest
import yaml
from tests.identification.ensembles.example_results import servo_result

from asbuilt.errors import UsageError
from asbuilt.identification import IdentificationResult, as_built_parameters, draw_ensemble
from asbuilt.writers import SIMULATOR_FORMATS, Export, export_result, write_ensemble

FRICTION = ("Fv", "Fc")


@pytest.fixture(scope="module")
def result() -> IdentificationResult:
    return servo_result(shared=False, relative=0.02)


@pytest.fixture(scope="module")
def written(result: IdentificationResult, tmp_path_factory: pytest.TempPathFactory) -> Export:
    folder = tmp_path_factory.mktemp("simulators")
    endings = {"isaac-lab": ".py", "usd": ".usda", "mjlab": ".py", "bam": ".json"}
    places = {key: folder / f"{key}{endings.get(key, '.xml')}" for key in SIMULATOR_FORMATS}
    return export_result(result, mjcf=folder / "robot.xml", simulators=places)


def friction(result: IdentificationResult) -> dict[str, list[float]]:
    """Return viscous and Coulomb friction of both joints."""
    values = as_built_parameters(result).parameters[20:].reshape(2, 2)
    return dict(zip(FRICTION, values.T.tolist(), strict=True))


def run_with(text: str, modules: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Run Python text that imports modules which are not installed."""
    before = {name: sys.modules.get(name) for name in modules}
    for name, content in modules.items():
        sys.modules[name] = types.ModuleType(name)
        vars(sys.modules[name]).update(content)
    try:
        space: dict[str, Any] = {"__file__": "x/load_ensemble.py", "__name__": "loaded"}
        exec(compile(text, "written", "exec"), space)
        return space
    finally:
        for name, module in before.items():
            if module is None:
                del sys.modules[name]
            else:
                sys.modules[name] = module


def test_isaac_lab_gets_a_delayed_actuator(result: IdentificationResult, written: Export) -> None:
    text = written.files["isaac-lab"].read_text()
    space = run_with(text, {"isaaclab.actuators": {"DelayedPDActuatorCfg": dict}})
    (group,) = space["actuators"](0.002).values()
    assert (group["min_delay"], group["max_delay"]) == (6, 6)
    joints = list(result.joint_names)
    assert [re.fullmatch(each, name) is not None for each, name in
            zip(group["joint_names_expr"], joints, strict=True)] == [True, True]  # fmt: skip
    assert list(group["stiffness"].values()) == [40.0, 20.0]
    assert list(group["effort_limit"].values()) == [20.0, 20.0]
    assert list(group["viscous_friction"].values()) == friction(result)["Fv"]
    assert list(group["dynamic_friction"].values()) == friction(result)["Fc"]


def test_what_a_servo_has_beyond_proportional_control_is_held_or_said(
    result: IdentificationResult, tmp_path: Path
) -> None:
    assert result.servo is not None
    servo = replace(
        result.servo,
        torque_limit=(20.0,) * 2,
        deadband=(0.01,) * 2,
        lead=(0.02,) * 2,
        no_load_speed=(5.0, 6.0),
    )
    richer = replace(result, servo=servo)
    places = {key: tmp_path / f"{key}.xml" for key in SIMULATOR_FORMATS}
    export = export_result(richer, mjcf=tmp_path / "robot.xml", simulators=places)
    space = run_with(
        export.files["isaac-lab"].read_text(), {"isaaclab.actuators": {"DCMotorCfg": dict}}
    )
    (group,) = space["actuators"](0.002).values()
    assert group["saturation_effort"] == servo.torque_limit[0]
    assert list(group["velocity_limit"].values()) == [5.0, 6.0]
    for key in ("mjcf", *SIMULATOR_FORMATS):
        said = " ".join(export.notes[key])
        assert "deadband" in said
        assert "lead" in said
        assert ("fall to zero" in said) == (key != "isaac-lab")
    assert "delay" in " ".join(export.notes["isaac-lab"])


@pytest.mark.parametrize("limits", [(np.inf, np.inf), (np.inf, 7.0)])
def test_isaac_lab_leaves_joints_without_a_limit_unlimited(
    result: IdentificationResult, tmp_path: Path, limits: tuple[float, float]
) -> None:
    assert result.servo is not None
    free = replace(result, servo=replace(result.servo, torque_limit=limits))
    joints = tuple(
        replace(joint, limits=replace(joint.limits, torque=limit))
        for joint, limit in zip(result.model.joints, limits, strict=True)
    )
    free = replace(free, model=replace(result.model, joints=joints))
    export = export_result(free, simulators={"isaac-lab": tmp_path / "a.py"})
    space = run_with(
        export.files["isaac-lab"].read_text(),
        {"isaaclab.actuators": {"DelayedPDActuatorCfg": dict}},
    )
    (group,) = space["actuators"](0.002).values()
    # a joint that a table of Isaac Lab lacks has the limit 0; without a table, that of the USD file
    expected = [1e9, 7.0] if np.isfinite(limits[1]) else None
    found = group.get("effort_limit")
    assert (None if found is None else list(found.values())) == expected


def test_a_delay_below_zero_is_written_as_zero_and_said(
    result: IdentificationResult, tmp_path: Path
) -> None:
    assert result.servo is not None
    early = replace(result, servo=replace(result.servo, delay=-0.004))
    places = {key: tmp_path / f"{key}.xml" for key in SIMULATOR_FORMATS}
    export = export_result(early, mjcf=tmp_path / "robot.xml", simulators=places)
    for key in ("mjcf", *SIMULATOR_FORMATS):
        assert "a delay below zero, -4 ms" in " ".join(export.notes[key])
        written = export.files[key]
        assert written.is_dir() or "-0.004" not in written.read_text()


def test_usd_has_angular_coefficients_per_degree(
    result: IdentificationResult, written: Export
) -> None:
    text = written.files["usd"].read_text()
    assert text.startswith("#usda 1.0\n")
    assert text.count("{") == text.count("}")
    assert text.count("(") == text.count(")")

    def numbers(name: str) -> list[float]:
        return [float(each) for each in re.findall(rf"float {re.escape(name)} = (\S+)", text)]

    degrees = [40.0, 20.0]
    found = np.array(numbers("drive:angular:physics:stiffness")) * np.degrees(1.0)
    np.testing.assert_allclose(found, degrees, rtol=1e-12)
    viscous = np.array(numbers("physxJointAxis:angular:viscousFrictionCoefficient"))
    np.testing.assert_allclose(viscous * np.degrees(1.0), friction(result)["Fv"], rtol=1e-12)
    assert numbers("physxJointAxis:angular:staticFrictionEffort") == friction(result)["Fc"]
    masses = as_built_parameters(result).parameters[9:20:10]
    np.testing.assert_allclose(numbers("physics:mass"), masses, rtol=1e-12)


def test_mjlab_ranges_are_those_of_draws(result: IdentificationResult, written: Export) -> None:
    text = written.files["mjlab"].read_text()
    parts = {
        "mjlab.actuator": {"BuiltinPositionActuatorCfg": dict},
        "mjlab.envs.mdp": {"dr": types.SimpleNamespace(dof_damping=1, dof_frictionloss=2)},
        "mjlab.managers.event_manager": {"EventTermCfg": dict},
        "mjlab.managers.scene_entity_config": {"SceneEntityCfg": lambda *a, **k: (a, k)},
    }
    space = run_with(text, parts)
    first, _ = space["actuators"](0.004)
    assert first["delay_min_lag"] == first["delay_max_lag"] == 3
    assert first["stiffness"] == 40.0
    assert first["viscous_damping"] == friction(result)["Fv"][0]
    events = space["events"]()
    assert len(events) == 4
    quantiles = draw_ensemble(result, 200, rng=0).quantiles
    place = draw_ensemble(result, 2, rng=0).names.index("Fc2")
    assert events["dof_frictionloss of joint_2"]["params"]["ranges"] == (
        quantiles[0, place],
        quantiles[2, place],
    )


def test_mjlab_takes_efforts_where_no_servo_was_identified(
    result: IdentificationResult, tmp_path: Path
) -> None:
    joints = tuple(
        replace(joint, drive=replace(joint.drive, kp=None, kd=None))
        for joint in result.model.joints
    )
    bare = replace(
        result, servo=None, servo_errors=None, model=replace(result.model, joints=joints)
    )
    export = export_result(bare, simulators={"mjlab": tmp_path / "a.py"})
    text = export.files["mjlab"].read_text()
    assert "IdealPdActuatorCfg(" in text
    assert "Builtin" not in text
    assert any("commands are torques" in note for note in export.notes["mjlab"])


def test_pid_controller_parameters(result: IdentificationResult, tmp_path: Path) -> None:
    export = export_result(result, simulators={"ros2-control": tmp_path / "gains.yaml"})
    gains = yaml.safe_load(export.files["ros2-control"].read_text())
    own = gains["pid_controller"]["ros__parameters"]["gains"]["joint_1"]
    assert own == {"p": 40.0, "i": 0.0, "d": 1.0, "u_clamp_max": 20.0, "u_clamp_min": -20.0}
    assert any("delay of the servo" in note for note in export.notes["ros2-control"])


def test_every_file_says_what_it_cannot_hold(written: Export) -> None:
    assert set(SIMULATOR_FORMATS) <= set(written.notes)
    assert any("delay" in note for note in written.notes["mjcf"])
    assert any("delay" in note for note in written.notes["usd"])
    assert json.loads(written.files["bam"].read_text())["joint_1"]["command_delay"] == 0.012
    assert any("command_delay [s] is no parameter of BAM" in note for note in written.notes["bam"])


def test_an_unknown_format_is_refused(result: IdentificationResult, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="isaac-lab"):
        export_result(result, simulators={"isaac_lab": tmp_path / "x.py"})


def test_an_ensemble_is_a_set_that_mujoco_loads(
    result: IdentificationResult, tmp_path: Path
) -> None:
    ensemble = draw_ensemble(result, 5, rng=1)
    write_ensemble(tmp_path, draw_ensemble(result, 9, rng=0), models="urdf")
    written = write_ensemble(tmp_path, ensemble, seed=1)
    assert sorted(path.name for path in tmp_path.glob("model_*")) == [
        f"model_00{k}.xml" for k in range(5)
    ]
    frame = polars.read_parquet(tmp_path / "parameters.parquet")
    np.testing.assert_array_equal(frame.drop("draw").to_numpy(), ensemble.table)
    units = json.loads(polars.read_parquet_metadata(tmp_path / "parameters.parquet")["units"])
    assert (units["Fv1"], units["kp2"], units["delay"]) == ("N m s/rad", "N m/rad", "s")
    for k, path in enumerate(written.models):
        robot = mujoco.MjModel.from_xml_path(str(path))
        row = frame.row(k, named=True)
        np.testing.assert_allclose(robot.actuator_gainprm[:, 0], [row["kp1"], row["kp2"]])
        np.testing.assert_allclose(robot.dof_frictionloss, [row["Fc1"], row["Fc2"]], rtol=1e-12)
        np.testing.assert_allclose(robot.body_mass[1:], [row["m1"], row["m2"]], rtol=1e-12)
    document = json.loads((tmp_path / "ensemble.json").read_text())
    fc2 = next(each for each in document["parameters"] if each["name"] == "Fc2")
    assert (fc2["joint"], fc2["unit"]) == ("joint_2", "N m")
    assert [fc2["q05"], fc2["q95"]] == np.quantile(frame["Fc2"], [0.05, 0.95]).tolist()
    size = len(document["correlation"]["names"])
    assert np.shape(document["correlation"]["matrix"]) == (size, size)


def test_the_loader_reads_the_folder(result: IdentificationResult, tmp_path: Path) -> None:
    write_ensemble(tmp_path, draw_ensemble(result, 2, rng=1))
    text = (tmp_path / "load_ensemble.py").read_text()
    space: dict[str, Any] = {"__file__": str(tmp_path / "load_ensemble.py"), "__name__": "loaded"}
    exec(compile(text, "load_ensemble.py", "exec"), space)
    assert [robot.nu for robot in space["models"]()] == [2, 2]
    assert space["table"]().height == 2
    low, high = space["ranges"]()["Fc1"]
    assert 0.0 < low < high
