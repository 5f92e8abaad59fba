"""`asbuilt excite` as a script meets it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from asbuilt.cli import main
from asbuilt.description import load_robot
from asbuilt.dynamics import DriveSet, find_base_parameters, inverse_dynamics, observation_matrix
from asbuilt.excitation import check_motion, read_motion
from asbuilt.excitation.collision.constraint import build_constraints
from command_line import call
from studied_cases import first_of

FIELDS = {
    "robot",
    "parametrisation",
    "duration",
    "n_harmonics",
    "log_det",
    "d_efficiency",
    "condition_number",
    "scaled_condition_number",
    "worst_margin",
    "collision_distance",
    "solve_seconds",
    "files",
}


@pytest.mark.parametrize(
    ("robot", "options"),
    first_of(
        2,
        [
            ("two-link", ()),
            ("scara", ("--parametrisation", "point-to-point", "--rate", 1000)),
            ("ur10e", ("--static", 8)),
            (
                "franka-panda",
                ("--collision", "skeleton:0.05", "--drive", "viscous", "--harmonics", 3),
            ),
        ],
    ),
)
def test_json_has_the_promised_fields_and_the_file_holds_the_motion(
    capsys, tmp_path: Path, robot: str, options
) -> None:
    file = tmp_path / "motion.csv"
    status, out, err = call(
        capsys,
        "excite",
        robot,
        "--duration",
        8,
        "--starts",
        1,
        "--rate",
        200,
        "--out",
        file,
        "--json",
        "--no-report",
        *options,
    )
    assert status == 0, err
    document = json.loads(out)
    assert document.keys() >= FIELDS
    assert document["worst_margin"].keys() >= {"position", "velocity", "acceleration", "torque"}
    assert all(margin is None or margin > 0 for margin in document["worst_margin"].values())
    assert (document["collision_distance"] is not None) == ("--collision" in options)
    assert 0 < document["scaled_condition_number"] <= document["condition_number"] * (1 + 1e-9)
    model = load_robot(robot)
    motion = read_motion(document["files"]["motion"], model)
    assert motion.duration == pytest.approx(document["duration"], abs=0.01)
    assert check_motion(model, motion).is_respected
    if "--static" not in options:
        assert 0 < document["d_efficiency"] < 1


@pytest.mark.study
def test_text_names_limits_efficiency_and_file(capsys, tmp_path: Path) -> None:
    status, out, _ = call(
        capsys,
        "excite",
        "two-link",
        "--duration",
        6,
        "--harmonics",
        3,
        "--starts",
        1,
        "--out",
        tmp_path / "m.csv",
    )
    assert status == 0
    for said in (
        "D-efficiency",
        "limits kept",
        "condition number",
        "nearest joint",
        "std err",
        "m.csv",
    ):
        assert said in out


@pytest.mark.parametrize(
    ("options", "status", "said"),
    [
        (("--criterion", "x"), 2, "available: d, a, e, condition"),
        (("--duration", "-3"), 2, "from 0.01 to 3600 s"),
        (("--duration", "soon"), 2, "positive number"),
        (("--focus", "Izz7"), 2, "no base parameter"),
        (("--noise", "a,b"), 2, "numbers separated by commas"),
        (("--noise", "1,2,3"), 2, "one per joint"),
        (("--parametrisation", "chebyshev"), 2, "available:"),
        (("--collision", "nothing.toml"), 1, "cannot be read"),
        (("--tool-box", "1,2"), 2, "six numbers"),
        (("--fraction", "0"), 2, "fraction"),
        (("--static", "0"), 2, "greater than or equal to 1"),
    ],
)
def test_wrong_usage_is_one_message(
    capsys, tmp_path: Path, options, status: int, said: str
) -> None:
    found, out, err = call(
        capsys, "excite", "two-link", "--starts", 1, "--out", tmp_path / "m.csv", *options
    )
    assert (found, out) == (status, "")
    assert said in err
    assert err.count("\n") == 1
    assert not (tmp_path / "m.csv").exists()


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The result of a recording."""
    folder = tmp_path_factory.mktemp("first")
    log = folder / "log.csv"
    virtual = ("--engine", "inverse-dynamics", "--preset", "lab", "--duration", "10")
    simulate = ("simulate", "two-link", *virtual, "--rate", "250", "--out", str(log))
    told = ("--unchecked", "--drive", "viscous,coulomb,offset", "--out", str(folder))
    for arguments in (simulate, ("identify", "two-link", str(log), *told)):
        with pytest.raises(SystemExit) as end:
            main([*arguments])
        assert not end.value.code
    return folder / "result.json"


@pytest.mark.study
@pytest.mark.parametrize("time_limit", [1e-6, 1e6])
def test_an_earlier_result_leaves_less_to_find(
    capsys, tmp_path: Path, first: Path, time_limit: float
) -> None:
    """Also on a machine so slow that the time is up before the search begins."""
    result = json.loads(first.read_text())
    status, out, err = call(
        capsys,
        "excite",
        "two-link",
        "--given",
        first,
        "--duration",
        6,
        "--starts",
        1,
        "--time-limit",
        time_limit,
        "--out",
        tmp_path / "m.csv",
        "--json",
    )
    assert status == 0, err
    document = json.loads(out)
    assert document["noise"] == pytest.approx(result["sigma"])
    before = {parameter["name"]: parameter["std_error"] for parameter in result["parameters"]}
    after = {parameter["name"]: parameter["std_error"] for parameter in document["parameters"]}
    assert all(after[name] <= before[name] * (1 + 1e-6) for name in before)
    assert np.mean([after[name] / before[name] for name in before]) < 0.9


def test_options_of_motions_are_refused_for_standing_poses(capsys, tmp_path: Path) -> None:
    for option in (
        ("--focus", "m3"),
        ("--power", 50),
        ("--perturbed", 2),
        ("--criterion", "a"),
        ("--parametrisation", "bspline"),
    ):
        status, _, err = call(
            capsys, "excite", "ur10e", "--static", 8, *option, "--out", tmp_path / "motion.csv"
        )
        assert status == 2
        assert f"these options are for motions; leave out {option[0]}" in err


def test_options_that_would_do_nothing_are_refused(capsys, tmp_path: Path) -> None:
    for options, idle in (
        (("--precision", 0.01), "--precision"),
        (("--tool-frame", "flange"), "--tool-frame"),
        (("--given", tmp_path / "result.json", "--drive", "viscous"), "--drive"),
        (("--static", 8, "--drive", "viscous"), "--drive"),
    ):
        status, out, err = call(
            capsys, "excite", "ur10e", *options, "--out", tmp_path / "motion.csv"
        )
        assert (status, out) == (2, "")
        assert f"leave out {idle}" in err
    assert not list(tmp_path.iterdir())


@pytest.mark.study
def test_parameters_are_judged_by_what_their_errors_change_of_the_torque(
    capsys, tmp_path: Path
) -> None:
    """Of the recorded torque, a column times its standard error, both RMS along the motion that was
    written.
    """
    file = tmp_path / "motion.csv"
    status, out, err = call(
        capsys,
        "excite",
        "ur10e",
        "--duration",
        8,
        "--starts",
        1,
        "--rate",
        500,
        "--out",
        file,
        "--no-report",
        "--json",
    )
    assert status == 0, err
    model, document = load_robot("ur10e"), json.loads(out)
    drive = DriveSet.parse(document["drive"])
    state = read_motion(file, model).at(np.arange(0.0, 8.0, 0.002))
    matrix = observation_matrix(
        model, *state, drive=drive, columns=find_base_parameters(model, drive).columns
    )
    size = np.sqrt((inverse_dynamics(model, *state) ** 2).sum(axis=1).mean())
    found = [
        parameter["std_error"] * np.linalg.norm(column)
        for parameter, column in zip(document["parameters"], matrix.T, strict=True)
    ]
    stated = [parameter["torque_effect"] for parameter in document["parameters"]]
    assert stated == pytest.approx(np.array(found) / np.sqrt(len(state[0])) / size, rel=0.01)
    assert (
        "of torque"
        in call(
            capsys,
            "excite",
            "ur10e",
            "--duration",
            4,
            "--harmonics",
            3,
            "--starts",
            1,
            "--no-report",
            "--out",
            file,
        )[1]
    )


@pytest.mark.study
def test_a_motion_that_nobody_kept_from_hitting_itself_says_so(capsys, tmp_path: Path) -> None:
    file, base = (
        tmp_path / "motion.csv",
        (*("excite", "ur10e", "--duration", 4, "--harmonics", 3, "--starts", 1, "--no-report"),),
    )
    status, out, err = call(capsys, *base, "--out", file, "--json")
    assert status == 0, err
    (note,) = [
        note for note in json.loads(out)["notes"] if note.startswith("NOT CHECKED FOR COLLISIONS")
    ]
    model = load_robot("ur10e")
    motion = read_motion(file, model)
    (guard,) = build_constraints(model, collision="skeleton")
    distance = guard.smallest_distance(motion.at(motion.sample_times(100.0))[0])
    stated = int(note.split()[-2])
    assert ("overlaps itself" in note) == (distance < 0)
    assert stated == pytest.approx(1000 * abs(distance), abs=3)
    assert (
        "NOT CHECKED FOR COLLISIONS"
        in call(capsys, "excite", "ur10e", "--static", 6, "--out", file)[1]
    )
    assert "NOT CHECKED" not in call(capsys, *base, "--collision", "skeleton", "--out", file)[1]
