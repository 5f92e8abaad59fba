"""Programs for controllers.

What every format promises, the sheets beside them, and names from strangers.
"""

from __future__ import annotations

import ast
import csv
import io
import re
import tomllib
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import yaml

from asbuilt import make_program
from asbuilt.apps.programs import program_format, write_program
from asbuilt.apps.programs.format import PROGRAM_FORMATS, ProgramFile
from asbuilt.apps.programs.naming import (
    make_class_name,
    make_file_stem,
    make_lowercase_identifier,
    make_plain_text,
)
from asbuilt.apps.programs.via_points import choose_hermite_knots, divide_point_to_point
from asbuilt.description import JointLimits, RobotModel, bundled_robot
from asbuilt.dynamics import inverse_dynamics
from asbuilt.errors import MotionError, UsageError
from asbuilt.excitation import (
    BSplineMotion,
    Motion,
    PointToPointMotion,
    QuinticMotion,
    check_motion,
    random_fourier,
    random_point_to_point,
    read_motion,
)
from asbuilt.excitation.collision.capsules import build_surroundings
from asbuilt.excitation.collision.constraint import CollisionGuard
from asbuilt.experiment import read_recording, read_sheet
from studied_cases import first_of

ALLOWED = {
    "sunrise": ("kuka-iiwa7-r800", "franka-panda"),
    "fri": ("kuka-iiwa7-r800", "franka-panda"),
    "franka": ("kuka-iiwa7-r800", "franka-panda"),
    "urscript": ("ur10e", "puma-560"),
    "ros2": ("ur10e", "scara"),
    "csv": ("kuka-iiwa7-r800", "scara"),
}
CASES = [(form, robot) for form, robots in ALLOWED.items() for robot in robots]


def excitation(model: RobotModel, duration: float = 5.0) -> Motion:
    return random_fourier(model, rng=3, duration=duration, n_harmonics=3)


def limited(name: str) -> RobotModel:
    """The robot with a finite limit wherever its description gives none, so that every format has
    what it needs.
    """
    model = bundled_robot(name)
    joints = [replace(j.limits, velocity=min(j.limits.velocity, 2.0)) for j in model.joints]
    return model.with_limits(joints)


@pytest.mark.parametrize(("form", "robot"), CASES)
def test_every_format_states_robot_motion_limits_and_safety(form: str, robot: str) -> None:
    model = limited(robot)
    motion = excitation(model)
    files = {file.role: file for file in make_program(model, motion, form, name="Run 1")}
    assert {"program", "sheet"} <= set(files)
    head = files["notes" if form == "csv" else "program"].text[:6000]
    worst = check_motion(model, motion).worst
    for said in (
        robot,
        "Run 1",
        "5.000 s",
        "dry run takes 50.0 s",
        "SAFETY",
        "NOT checked: collisions",
        "emergency",
        "HOW TO RUN",
    ):
        assert said in re.sub(r"\n(?://| \*|#)? *", " ", head), said
    for quantity, margin in worst.items():
        line = next(line for line in head.splitlines() if f"{quantity}:" in line)
        assert (
            ("NOT CHECKED" in line)
            if margin is None
            else (f"{100 * margin.margin:.1f} %" in line and margin.joint in line)
        )
    for file in files.values():
        assert file.text.isascii()
        assert file.text.endswith("\n")
        assert all(line == line.rstrip() for line in file.text.splitlines()[:60])
        assert re.fullmatch(r"[A-Za-z0-9_-]+\.[a-z]+", file.name)


@pytest.mark.parametrize(("form", "robot"), CASES)
def test_sheet_is_read_and_names_the_joints(form: str, robot: str, tmp_path: Path) -> None:
    model = limited(robot)
    written = write_program(tmp_path, make_program(model, excitation(model), form, name="run"))
    sheet = read_sheet(written["sheet"])
    assert tuple(sheet.joints or ()) == model.joint_names
    assert sheet.sign == (-1 if form in {"sunrise", "fri"} else 1)
    assert sheet.torque_source == {
        "sunrise": "sensor",
        "fri": "sensor",
        "franka": "sensor",
        "urscript": "current",
    }.get(form, "unknown")


@pytest.mark.parametrize("form", ["ros2", "csv"])
def test_speeds_of_the_approach_name_their_joints_where_units_differ(form: str) -> None:
    model = bundled_robot("scara")
    header = " ".join(
        line.lstrip("# ")
        for line in program_text(make_program(model, excitation(model), form)).splitlines()
    )
    assert (
        "to the start pose at no more than 0.2 rad/s (joint_1, joint_2, joint_4); 0.05 m/s"
        " (joint_3)" in header
    )


def test_formats_refuse_robots_that_they_cannot_move() -> None:
    for form, kind in PROGRAM_FORMATS.items():
        for robot in ("kuka-iiwa7-r800", "ur10e", "scara", "two-link"):
            model = bundled_robot(robot)
            if kind.n_joints in (None, model.n_joints):
                continue
            with pytest.raises(
                MotionError,
                match=rf"{form} is for robots with {kind.n_joints} revolute joints.*{robot} has",
            ):
                make_program(model, excitation(model), form)
    with pytest.raises(UsageError, match="franka, sunrise, fri, csv, ros2, urscript"):
        make_program(bundled_robot("scara"), excitation(bundled_robot("scara")), "krl")


def test_sliding_joints_are_refused_where_axes_turn() -> None:
    model = bundled_robot("ur10e")
    sliding = replace(model, joints=(replace(model.joints[0], kind="prismatic"), *model.joints[1:]))
    with pytest.raises(MotionError, match="of which shoulder_pan_joint are prismatic"):
        make_program(
            sliding, BSplineMotion(np.outer([0.0, 0.1, 0.1, 0.0], np.ones(6)), 5.0), "urscript"
        )


@pytest.mark.parametrize("form", sorted(ALLOWED))
def test_motions_beyond_limits_are_refused(form: str) -> None:
    model = limited(ALLOWED[form][0])
    motion = excitation(model)
    with pytest.raises(MotionError, match="beyond its limit"):
        make_program(model, motion.slowed(0.1), form)


def test_a_dry_run_too_heavy_to_hold_is_refused() -> None:
    model = bundled_robot("two-link")
    motion = BSplineMotion([[0.0, 0.0], [0.0, -0.6], [0.0, -0.6], [0.0, 0.0]], 0.7)
    torque = [
        np.abs(inverse_dynamics(model, *m.at(np.linspace(0, m.duration, 500)))).max(axis=0)
        for m in (motion, motion.slowed(10))
    ]
    below = 0.5 * (torque[0][1] + torque[1][1])
    assert torque[0][1] != pytest.approx(torque[1][1], rel=1e-3)
    limits = [
        replace(j.limits, torque=np.inf if k == 0 else below, velocity=np.inf, acceleration=np.inf)
        for k, j in enumerate(model.joints)
    ]
    with pytest.raises(
        MotionError, match=r"dry run at 10 % of the speed violates|beyond its limit"
    ):
        make_program(model.with_limits(limits), motion, "csv")


def test_motions_that_do_not_rest_at_their_ends_are_refused(tmp_path: Path) -> None:
    model = bundled_robot("two-link")
    table = tmp_path / "moving.csv"
    t = np.linspace(0.0, 3.0, 61)
    rows = "\n".join(f"{x:.3f},{0.3 * np.sin(x):.9f},{0.2 * np.cos(x):.9f}" for x in t)
    table.write_text(f"t,q_{model.joint_names[0]},q_{model.joint_names[1]}\n{rows}\n")
    with pytest.raises(
        MotionError, match="at the start of the motion, where a controller needs it at rest"
    ):
        make_program(model, read_motion(table, model), "csv")


@pytest.mark.parametrize("rate", [0.0, -5.0, np.nan, np.inf])
def test_rates_that_are_none(rate: float) -> None:
    model = bundled_robot("two-link")
    with pytest.raises(MotionError, match="rate"):
        make_program(model, excitation(model), "csv", rate=rate)


@pytest.mark.parametrize(
    ("form", "rate"),
    [("sunrise", 300.0), ("fri", 1500.0), ("urscript", 400.0), ("urscript", 1000.0)],
)
def test_rates_that_the_controller_does_not_have(form: str, rate: float) -> None:
    model = limited(ALLOWED[form][0])
    with pytest.raises(MotionError, match=f"{rate:g} Hz is no"):
        make_program(model, excitation(model), form, rate=rate)


def test_franka_refuses_jumps_of_acceleration() -> None:
    model = bundled_robot("franka-panda")
    motion = random_point_to_point(model, rng=2, n_poses=4, fraction=0.5)
    with pytest.raises(MotionError, match=r"jumps by .* rad/s.2 within one millisecond"):
        make_program(model, motion, "franka")
    make_program(model, motion, "ros2")


def test_sunrise_needs_velocity_limits() -> None:
    model = bundled_robot("kuka-iiwa7-r800")
    bare = model.with_limits([JointLimits()] * 7)
    with pytest.raises(MotionError, match="no velocity limit for A1, A2"):
        make_program(bare, excitation(model), "sunrise")
    text = make_program(bare, excitation(model), "fri")[0].text
    assert len(re.findall("NOT CHECKED, the description gives no limit", text)) == 5


NASTY = [
    'a"; halt\nend\n',
    "*/ class X {} /*",
    "\\u000a\\u002a\\u002f evil(); \\",
    '""" + __import__("os").abort() + """',
    "{{ 7 * 7 }}{% raise %}",
    "../../etc/passwd",
    "--> <x/>",
    "Müller’s Roboter №5",
    "名前",
    "%s$(reboot)`id`",
    "'; DROP",
    "",
    "x" * 500,
]


@pytest.mark.parametrize("name", NASTY)
def test_names_cannot_leave_their_place(name: str) -> None:
    plain = make_plain_text(name)
    assert plain.isascii()
    assert not set('\\"`\n\r') & set(plain)
    assert "*/" not in plain
    assert re.fullmatch(r"[A-Za-z0-9_-]{1,60}", make_file_stem(name))
    assert make_lowercase_identifier(name, prefix="asbuilt_").isidentifier()
    assert re.fullmatch(r"[A-Z][A-Za-z0-9]*Excitation", make_class_name(name, suffix="Excitation"))


@pytest.mark.parametrize("name", first_of(5, NASTY))
def test_programs_of_robots_with_such_names_keep_their_form(name: str) -> None:
    model = bundled_robot("scara")
    other = "bad: [" + name + "]"
    joints = (replace(model.joints[0], name=other), *model.joints[1:])
    odd = replace(model, name=name, joints=joints)
    motion = excitation(odd, 4.0)
    files = {
        file.role: file.text for file in make_program(odd, motion, "ros2", name=name, rate=20.0)
    }
    ast.parse(files["program"])
    document = yaml.safe_load(files["motion"])
    assert document["joint_names"] == list(odd.joint_names)
    assert set(document) == {"joint_names", "points"}
    assert tomllib.loads(files["sheet"])["joints"] == list(odd.joint_names)
    table = make_program(odd, motion, "csv", name=name, rate=20.0)[0].text
    assert next(csv.reader(io.StringIO(table)))[1] == f"q_{other}"
    arm = bundled_robot("ur10e")
    script = make_program(replace(arm, name=name), excitation(arm), "urscript", name=name)
    for file in script:
        if file.name.endswith(".xml"):
            ElementTree.fromstring(file.text)
        if file.name.endswith(".script"):
            code = [
                line
                for line in file.text.splitlines()
                if line.strip() and not line.lstrip().startswith("#")
            ]
            assert code[0].startswith("def asbuilt_")
            assert code[-1] == "end"
            assert sum(line.strip() == "halt" for line in code) == 1
            assert all(line.count('"') % 2 == 0 for line in code)


def test_csv_reads_back_as_the_motion(tmp_path: Path) -> None:
    model = bundled_robot("scara")
    motion = excitation(model, 4.003)
    written = write_program(tmp_path, make_program(model, motion, "csv", name="run", rate=100.0))
    for role, meant in (("program", motion), ("dry_run", motion.slowed(10))):
        back = read_motion(written[role], model)
        assert back.duration == pytest.approx(meant.duration, abs=1e-6)
        t = np.unique(np.append(meant.sample_times(100.0), meant.duration).round(9))
        for order in (0, 1, 2):
            np.testing.assert_allclose(
                back.derivative(np.minimum(t, back.duration), order),
                meant.derivative(t, order),
                atol=2e-6,
            )
        table = np.loadtxt(written[role], delimiter=",", skiprows=1)
        np.testing.assert_allclose(table[:, 1:], np.hstack(meant.at(t)), atol=0.5000001e-9)


@pytest.mark.parametrize(("form", "header"), [
    ("sunrise", "% ZeitInSec ZeitInNanoSec {q} {tau} {ext}"),
    ("fri", "t,{q},{tau},{ext}"),
    ("franka", "t,{q},{qd},{tau},{ext}"),
])  # fmt: skip
def test_logs_of_kuka_and_franka_come_back_as_torques_of_the_drive(
    form: str, header: str, tmp_path: Path
) -> None:
    """A log written the way the controller writes it, sign included, is read with the sheet as what
    the drives exert.
    """
    model = bundled_robot("kuka-iiwa7-r800")
    motion = excitation(model)
    written = write_program(tmp_path, make_program(model, motion, form, name="run"))
    s = motion.sample(PROGRAM_FORMATS[form].default_rate)
    tau = inverse_dynamics(model, s.q, s.qd, s.qdd)
    blank = " " if form == "sunrise" else ","
    names = {"q": "q_{}", "qd": "qd_{}", "tau": "tau_{}", "ext": "tau_ext_{}"}
    if form == "sunrise":
        names = {
            "q": "axisQMsr_LBR_iiwa_7_R800_1[{}]",
            "qd": "",
            "tau": "tauMsr_LBR_iiwa_7_R800_1[{}]",
            "ext": "tauExt_LBR_iiwa_7_R800_1[{}]",
        }
    first = header.format(
        **{key: blank.join(name.format(k) for k in range(1, 8)) for key, name in names.items()}
    )
    sign = 1 if form == "franka" else -1
    time = (
        np.column_stack([np.floor(s.t) + 1e6, (1e9 * (s.t % 1)).round()])
        if form == "sunrise"
        else s.t[:, None]
    )
    parts = [time, s.q, *([s.qd] if form == "franka" else []), sign * tau, sign * 0.1 * tau]
    log = written["sheet"].with_suffix(".txt" if form == "sunrise" else ".csv")
    np.savetxt(log, np.hstack(parts), fmt="%.9g", delimiter=blank, header=first, comments="")
    recording = read_recording(log, model=model)
    np.testing.assert_allclose(recording.q, s.q, atol=1e-7)
    np.testing.assert_allclose(recording.tau, tau, atol=1e-5)
    np.testing.assert_allclose(recording.extra["tau_ext"], 0.1 * tau, atol=1e-5)
    assert recording.rate == pytest.approx(PROGRAM_FORMATS[form].default_rate, rel=1e-6)
    assert recording.torque_source == "sensor"


def test_log_of_the_rtde_comes_back_with_currents(tmp_path: Path) -> None:
    model = bundled_robot("ur10e")
    motion = excitation(model)
    written = write_program(
        tmp_path, make_program(model, motion, "urscript", name="run", rate=125.0)
    )
    fields = ElementTree.parse(written["recipe"]).getroot().findall("./recipe[@key='out']/field")
    names = [field.attrib["name"] for field in fields]
    assert [field.attrib["type"] for field in fields] == ["DOUBLE"] + ["VECTOR6D"] * (
        len(fields) - 1
    )
    s = motion.sample(125.0)
    values = {
        "timestamp": s.t[:, None] + 1000.0,
        "actual_q": s.q,
        "actual_qd": s.qd,
        "actual_current": 0.1 * s.qdd,
    }
    header = ["timestamp"] + [f"{name}_{k}" for name in names[1:] for k in range(6)]
    rows = np.hstack([values.get(name, 30.0 + 0.0 * s.q) for name in names])
    log = written["sheet"].with_suffix(".csv")
    np.savetxt(log, rows, fmt="%.9g", delimiter=" ", header=" ".join(header), comments="")
    recording = read_recording(log, model=model, gain=[10.0] * 6)
    np.testing.assert_allclose(recording.q, s.q, atol=1e-7)
    np.testing.assert_allclose(recording.tau, s.qdd, atol=1e-6)
    assert recording.torque_source == "current"


def test_table_logged_as_the_proposal_says_comes_back(tmp_path: Path) -> None:
    model = bundled_robot("scara")
    motion = excitation(model)
    written = write_program(tmp_path, make_program(model, motion, "csv", name="run"))
    s = motion.sample(250.0)
    tau = inverse_dynamics(model, s.q, s.qd, s.qdd)
    names = model.joint_names
    header = ",".join(["t", *(f"q_{name}" for name in names), *(f"tau_{name}" for name in names)])
    np.savetxt(
        written["sheet"].with_suffix(".csv"),
        np.column_stack([s.t, s.q, tau]),
        delimiter=",",
        header=header,
        comments="",
    )
    recording = read_recording(written["sheet"].with_suffix(".csv"), model=model)
    np.testing.assert_allclose(recording.q, s.q, atol=1e-9)
    np.testing.assert_allclose(recording.tau, tau, atol=1e-9)


def test_bag_comes_back_by_joint_name(tmp_path: Path) -> None:
    """The joint state broadcaster orders joints as it likes."""
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    typesys = pytest.importorskip("rosbags.typesys")
    model = bundled_robot("ur10e")
    motion = excitation(model)
    written = write_program(tmp_path, make_program(model, motion, "ros2", name="run"))
    s, order = motion.sample(100.0), [3, 0, 5, 1, 4, 2]
    tau = inverse_dynamics(model, s.q, s.qd, s.qdd)
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    types = store.types
    state = types["sensor_msgs/msg/JointState"]
    with rosbag2.Writer(written["sheet"].with_suffix(""), version=8) as bag:
        topic = bag.add_connection("/joint_states", state.__msgtype__, typestore=store)
        for t, q, qd, torque in zip(s.t, s.q, s.qd, tau, strict=True):
            stamp = types["builtin_interfaces/msg/Time"](sec=int(t), nanosec=round(1e9 * (t % 1)))
            message = state(
                header=types["std_msgs/msg/Header"](stamp=stamp, frame_id=""),
                name=[model.joint_names[k] for k in order],
                position=q[order],
                velocity=qd[order],
                effort=torque[order],
            )
            bag.write(topic, round(1e9 * t), store.serialize_cdr(message, state.__msgtype__))
    recording = read_recording(written["sheet"].with_suffix(""), model=model)
    np.testing.assert_allclose(recording.q, s.q, atol=1e-12)
    np.testing.assert_allclose(recording.tau, tau, atol=1e-12)
    assert recording.rate == pytest.approx(100.0, rel=1e-6)


@pytest.mark.parametrize(
    ("form", "robot"), [("urscript", "ur10e"), ("ros2", "ur10e"), ("csv", "kuka-iiwa7-r800")]
)
def test_sheets_of_currents_have_a_place_for_gains(form: str, robot: str, tmp_path: Path) -> None:
    """Filled in as the sheet says, the line is read as gains; left as it is, there are none."""
    model = limited(robot)
    sheet = write_program(tmp_path, make_program(model, excitation(model), form, name="run"))[
        "sheet"
    ]
    assert read_sheet(sheet).gains is None
    line = f"# gains = [{', '.join(f'g{k + 1}' for k in range(model.n_joints))}]"
    text = sheet.read_text()
    assert text.count(line) == 1
    assert "N m per ampere" in text
    assert "asbuilt gains" in text
    gains = [10.0 + k for k in range(model.n_joints)]
    sheet.write_text(text.replace(line, f"gains = {gains}"))
    assert read_sheet(sheet).gains == gains


@pytest.mark.parametrize("form", first_of(2, sorted(ALLOWED)))
def test_programs_say_which_collisions_were_checked(form: str) -> None:
    model = limited(ALLOWED[form][0])
    motion = excitation(model)
    head = {
        collision: program_text(make_program(model, motion, form, collision=collision))
        for collision in (None, "skeleton:0.01")
    }
    assert "neither on the motion nor on the approach" in head[None]
    said = re.search(r"keep at least (\d+) mm from each other", head["skeleton:0.01"])
    assert said is not None
    guard = CollisionGuard(model, build_surroundings(model, "skeleton:0.01"))
    nearest = min(
        guard.smallest_distance(motion.derivative(np.array([t])))
        for t in np.arange(0.0, 5.0005, 0.01)
    )
    assert int(said[1]) == pytest.approx(1000 * nearest, abs=2.0)
    assert "NOT checked: collisions on the approach to the start pose" in head["skeleton:0.01"]


def test_motions_on_which_bodies_touch_are_refused() -> None:
    model = bundled_robot("ur10e")
    with pytest.raises(MotionError, match="overlap by"):
        make_program(model, excitation(model), "urscript", collision="skeleton:0.2")


@pytest.mark.parametrize("form", sorted(PROGRAM_FORMATS))
@pytest.mark.parametrize("parametrisation", ["fourier", "bspline", "quintic", "point-to-point"])
@pytest.mark.study
def test_kinds_of_motion_are_refused_by_name_as_they_would_be_by_motion(
    form: str, parametrisation: str
) -> None:
    """What `excite` is told before its search is what the program says of a motion of that kind."""
    model = limited(ALLOWED[form][0])
    poses = excitation(model).derivative(np.linspace(0.0, 5.0, 6))
    motion: Motion = {
        "fourier": excitation(model),
        "bspline": BSplineMotion(poses[[0, 0, 0, 1, 2, 3, 3, 3]], 20.0),
        "quintic": QuinticMotion.through(poses, np.linspace(0.0, 25.0, 6)),
        "point-to-point": PointToPointMotion.within(poses, velocity=0.5, acceleration=6.0),
    }[parametrisation]
    refused = []
    for call in (
        lambda: program_format(form, model, parametrisation),
        lambda: make_program(model, motion, form),
    ):
        try:
            call()
            refused.append(False)
        except MotionError:
            refused.append(True)
    assert refused[0] == refused[1]


def program_text(files: tuple[ProgramFile, ...]) -> str:
    """The header of a program as running text."""
    texts = {file.role: file.text for file in files}
    head = texts.get("notes", texts["program"])[:6000]
    return re.sub(r"\s+", " ", re.sub(r"\n[ \t]*(#|//|\*)", "\n", head))


def test_point_to_point_motions_are_told_from_others() -> None:
    poses = np.array([[0.0, 0.0], [1.0, -0.5], [0.2, 0.4], [0.0, 0.0]])
    motion = PointToPointMotion.within(poses, velocity=1.0, acceleration=2.0, dwell=[0.5, 0.0])
    found = divide_point_to_point(motion)
    assert found is not None
    np.testing.assert_allclose([segment.pose for segment in found], poses[1:], atol=1e-5)
    np.testing.assert_allclose([segment.dwell for segment in found], [0.5, 0.0, 0.0], atol=0.005)
    np.testing.assert_allclose([segment.speed.max() for segment in found][:1], [1.0], atol=0.01)
    assert divide_point_to_point(excitation(bundled_robot("two-link"))) is None


def test_knots_are_as_few_as_the_tolerance_allows() -> None:
    motion = excitation(bundled_robot("ur10e"))
    coarse, fine = choose_hermite_knots(motion, 1e-3), choose_hermite_knots(motion, 1e-6)
    assert coarse.size < fine.size
    with pytest.raises(MotionError, match="without jumps of velocity"):
        choose_hermite_knots(motion, 1e-16)
