"""Build the pictures and tables of the pages in docs/built, with asbuilt itself.

`make docs` runs it; it does nothing while they are newer than the source. `--home` also renews
docs/pictures/home.png, which the repository keeps for the README.
"""

from __future__ import annotations

import importlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import matplotlib as mpl
import numpy as np

mpl.use("Agg")

import matplotlib.pyplot as plt
from matplotlib.colors import ListedColormap
from matplotlib.patches import Patch

import asbuilt
from asbuilt.apps.paper.pages import describe_outcome, write_reproduction
from asbuilt.apps.paper.tables import build_all_tables

DOCS = Path(__file__).resolve().parent
BUILT, KEPT = DOCS / "built", DOCS / "pictures"
STAMP = BUILT / "complete"
ROBOTS = ("kuka-iiwa7-r800", "ur10e", "franka-panda", "scara")
SERVOS = ("so-101", "go2")
LARGEST = 2_000_000
"""Largest animation [bytes]."""
ORANGE, BLUE, GRAY = "#d9731a", "#2166ac", "#444444"

mpl.rcParams.update(
    {"font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "savefig.dpi": 110}
)


def saved(figure: plt.Figure, path: Path) -> None:
    """Write a figure on white, so that both colour schemes show it."""
    figure.savefig(path, facecolor="white")
    plt.close(figure)


def run(folder: Path, line: str) -> None:
    """Run a command as a user types it."""
    command = [sys.executable, "-m", "asbuilt", *line.split()]
    environment = os.environ | {"COLUMNS": "80"}
    subprocess.run(command, cwd=folder, check=True, stdout=subprocess.DEVNULL, env=environment)


def reproduction() -> None:
    """Write the tables and figures of the 2015 paper."""
    redone = asbuilt.reproduce_paper()
    write_reproduction(BUILT / "reproduction", redone)
    listed = "\n".join(f"* {sentence}" for sentence in describe_outcome(redone))
    (BUILT / "reproduction" / "sentences.md").write_text(listed + "\n")
    for name, table in build_all_tables(redone).items():
        (BUILT / "reproduction" / f"{name}.html").write_text(table.as_html() + "\n")


def tutorial(folder: Path) -> None:
    """Run the tutorial up to the second motion and keep its pictures."""
    for line in (
        "simulate ur10e --preset lab -o log.csv",
        "identify ur10e log.csv -o study",
        "compare study/result.json -o comparison",
        "excite ur10e --given study/result.json --starts 2 -o motion.csv",
        "view ur10e motion.csv --save motion.webp",
    ):
        run(folder, line)
    for source, name in (
        ("study/torque.png", "tutorial_torque.png"),
        ("study/report.html", "tutorial_report.html"),
        ("motion.html", "tutorial_motion.html"),
        ("motion.webp", "motion.webp"),
        ("comparison/differences.png", "differences.png"),
        ("comparison/attribution.png", "attribution.png"),
    ):
        shutil.copy(folder / source, BUILT / name)
    model = asbuilt.load_robot("ur10e")
    motion_figure(model, asbuilt.read_motion(folder / "motion.csv", model))
    filter_figure(asbuilt.read_recording(folder / "log.csv", model=model))
    truth = json.loads((folder / "log_truth.json").read_text())
    error_figure(asbuilt.read_result(folder / "study" / "result.json"), truth)


def rollouts(folder: Path) -> None:
    """Identify robots from commands, and animate what was held out beside its simulation."""
    for name in SERVOS:
        for line in (
            f"simulate {name} --preset servo --duration 30 --seed 1 -o {name}.csv",
            f"identify {name} {name}.csv --holdout last:0.3 -o {name}",
            f"validate {name}/result.json {name}.csv --rollout 0.5,2 --animation {name}.webp"
            f" -o {name}",
        ):
            run(folder, line)
        shutil.copy(folder / f"{name}.webp", BUILT / f"rollout_{name}.webp")
        shutil.copy(folder / name / "rollout.html", BUILT / f"rollout_{name}.html")
        size = (BUILT / f"rollout_{name}.webp").stat().st_size
        if size > LARGEST:
            raise RuntimeError(f"rollout_{name}.webp has {size} bytes, more than {LARGEST}")


def motion_figure(model: asbuilt.RobotModel, motion: object) -> None:
    """Draw positions, velocities and torques of a motion as shares of their limits."""
    states = motion.sample(100.0)
    tau = asbuilt.inverse_dynamics(model, states.q, states.qd, states.qdd)
    limits = [joint.limits for joint in model.joints]
    rows = (
        ("position", states.q, [each.upper for each in limits]),
        ("velocity", states.qd, [each.velocity for each in limits]),
        ("torque", tau, [each.torque for each in limits]),
    )
    figure, axes = plt.subplots(3, 1, figsize=(8, 5), sharex=True, layout="constrained")
    for axis, (what, values, most) in zip(axes, rows, strict=True):
        axis.plot(states.t, 100.0 * values / np.array(most, dtype=float), lw=0.9)
        axis.axhline(100, color=GRAY, lw=0.8, ls="--")
        axis.axhline(-100, color=GRAY, lw=0.8, ls="--")
        axis.set_ylabel(f"{what}\n[% of limit]")
    axes[0].legend(
        model.joint_names, ncols=6, fontsize=7, loc="lower center", bbox_to_anchor=(0.5, 1)
    )
    axes[-1].set_xlabel("time [s]")
    saved(figure, BUILT / "tutorial_motion.png")


def filter_figure(recording: asbuilt.Recording) -> None:
    """Draw a torque as recorded and as the signal chain passes it on."""
    samples = asbuilt.prepare_samples(recording)
    joint, window = 4, (5.0, 8.0)
    figure, axis = plt.subplots(figsize=(8, 2.6), layout="constrained")
    raw = (recording.t >= window[0]) & (recording.t <= window[1])
    kept = (samples.t >= window[0]) & (samples.t <= window[1])
    axis.plot(
        recording.t[raw],
        recording.tau[raw, joint],
        color="#bbbbbb",
        lw=0.5,
        label="as recorded, 1000 Hz",
    )
    axis.plot(
        samples.t[kept],
        samples.tau[kept, joint],
        "o-",
        ms=3,
        color=BLUE,
        label="filtered and decimated",
    )
    axis.set(xlabel="time [s]", ylabel=f"{recording.joint_names[joint]} [N m]")
    axis.legend(fontsize=8)
    saved(figure, BUILT / "signal_chain.png")


def error_figure(result: asbuilt.IdentificationResult, truth: dict) -> None:
    """Draw the error of each estimate in standard errors, known for a virtual robot."""
    true = np.array([truth["parameters"][name] for name in result.base.standard_names])
    off = (result.estimates - result.base.regrouping @ true) / result.std_errors
    figure, axis = plt.subplots(figsize=(8, 2.6), layout="constrained")
    axis.axhspan(-2, 2, color="#e8eef5", label="2 standard errors")
    axis.plot(np.arange(1, len(off) + 1), off, "o", ms=4, color=BLUE, label="estimate minus truth")
    axis.set(xlabel="base parameter", ylabel="error / standard error", ylim=(-5, 5))
    axis.legend(fontsize=8, ncols=2)
    saved(figure, BUILT / "standard_errors.png")


def identifiability_figure() -> None:
    """Draw which standard parameters of an arm are identifiable."""
    done = subprocess.run(
        [sys.executable, "-m", "asbuilt", "base", "ur10e", "--json"],
        check=True,
        capture_output=True,
        text=True,
    )
    standard = json.loads(done.stdout)["standard"]
    kinds = ("unidentifiable", "grouped", "identifiable")
    grid = np.array([kinds.index(each["status"]) for each in standard]).reshape(-1, 10)
    colours = ("#dddddd", "#9ecae1", "#2166ac")
    figure, axis = plt.subplots(figsize=(7, 2.9), layout="constrained")
    axis.imshow(grid, cmap=ListedColormap(colours), vmin=0, vmax=2, aspect="auto")
    axis.set_xticks(range(10), ["Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz", "mx", "my", "mz", "m"])
    axis.set_yticks(range(len(grid)), [f"link {k + 1}" for k in range(len(grid))])
    axis.set_xticks(np.arange(0.5, 9), minor=True)
    axis.set_yticks(np.arange(0.5, len(grid) - 1), minor=True)
    axis.grid(which="minor", color="white", lw=2)
    axis.tick_params(which="both", length=0)
    axis.spines[:].set_visible(False)
    names = ("unidentifiable", "identifiable in sums only", "identifiable alone")
    patches = [Patch(color=colour, label=name) for colour, name in zip(colours, names, strict=True)]
    axis.legend(handles=patches, ncols=3, fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 1))
    saved(figure, BUILT / "identifiability.png")


def friction_figure() -> None:
    """Draw the friction laws over velocity."""
    qd = np.linspace(-1.0, 1.0, 801)
    laws = (
        ("viscous", 2.0 * qd),
        ("coulomb", 1.0 * np.sign(qd)),
        ("viscous + coulomb + offset", 1.2 * qd + 0.8 * np.sign(qd) + 0.2),
        ("stribeck", 0.8 * qd + np.sign(qd) * (0.7 + 0.7 * np.exp(-((qd / 0.1) ** 2)))),
    )
    figure, axes = plt.subplots(1, 4, figsize=(8, 2.1), sharey=True, layout="constrained")
    for axis, (name, torque) in zip(axes, laws, strict=True):
        axis.plot(qd, torque, color=BLUE)
        axis.axhline(0, color=GRAY, lw=0.5)
        axis.set_title(name, fontsize=8)
        axis.set_xlabel("velocity [rad/s]", fontsize=8)
    axes[0].set_ylabel("torque [N m]")
    saved(figure, BUILT / "friction.png")


def home() -> None:
    """Renew the picture of the README and the home page."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        held = asbuilt.run_demo(folder).study.validations[0]
        asbuilt.view_robot("kuka-iiwa7-r800", save=folder / "robot.png")
        metrics = (held.metrics_cad, held.metrics_as_built)
        draw_home(folder, [100.0 * each.relative_error for each in metrics])


def draw_home(folder: Path, errors: list[float]) -> None:
    """Draw the torque of the demonstration at A5, which bears the gripper that CAD lacks.

    `errors` of CAD and as built [%] are those that the demonstration prints.
    """
    model = asbuilt.load_robot("kuka-iiwa7-r800")
    result = asbuilt.read_result(folder / "result.json")
    test = asbuilt.prepare_samples(asbuilt.read_recording(folder / "validation.csv", model=model))
    cad = result.predict_cad(test)
    built = result.predict(test)
    joint = model.joint_names.index("A5")
    figure = plt.figure(figsize=(7.5, 3.0), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1, 2.6))
    picture = plt.imread(folder / "robot.png")
    left.imshow(picture[:, picture.shape[1] // 5 : -(picture.shape[1] // 5)])
    left.axis("off")
    t, shown = cad.t, cad.t <= 10.0
    for values, style in (
        (cad.measured, {"color": GRAY, "lw": 3.5, "alpha": 0.4, "label": "measured"}),
        (cad.predicted, {"color": ORANGE, "lw": 1.2, "label": "predicted from CAD"}),
        (built.predicted, {"color": BLUE, "lw": 1.2, "label": "predicted as built"}),
    ):
        right.plot(t[shown], values[shown, joint], **style)
    right.set(xlabel="time [s]", ylabel=f"torque of joint {model.joint_names[joint]} [N m]")
    right.set_title(
        f"another motion: torque error {errors[0]:.1f} % from CAD, {errors[1]:.1f} % as built",
        fontsize=10,
    )
    right.legend(fontsize=8, ncols=3, loc="upper center", bbox_to_anchor=(0.5, -0.2), frameon=False)
    KEPT.mkdir(exist_ok=True)
    saved(figure, KEPT / "home.png")


def outdated() -> bool:
    """Return whether the source is newer than what was built."""
    if not STAMP.exists():
        return True
    results = DOCS.parent / "benchmarks" / "open" / "results.jsonl"
    source = [Path(__file__), results, *Path(asbuilt.__file__).parent.rglob("*.py")]
    return max(path.stat().st_mtime for path in source) > STAMP.stat().st_mtime


def benchmark() -> None:
    """Draw the results of the open benchmark."""
    sys.path.append(str(DOCS.parent / "benchmarks" / "open"))
    importlib.import_module("page").draw_pictures(BUILT / "benchmark")


def main() -> None:
    """Build what is outdated."""
    if "--home" in sys.argv:
        home()
    if not outdated():
        return
    BUILT.mkdir(exist_ok=True)
    for name in ROBOTS:
        asbuilt.view_robot(name, save=BUILT / f"{name}.png")
    identifiability_figure()
    friction_figure()
    with tempfile.TemporaryDirectory() as folder:
        tutorial(Path(folder))
        rollouts(Path(folder))
    reproduction()
    benchmark()
    STAMP.write_text("")


if __name__ == "__main__":
    main()
