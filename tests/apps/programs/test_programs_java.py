"""The Java applications for KUKA Sunrise, compiled against small stand-ins for KUKA's classes and
run without a robot.
"""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from asbuilt import make_program
from asbuilt.apps.programs import write_program
from asbuilt.description import bundled_robot
from asbuilt.excitation import MotionBounds, PointToPointMotion, random_fourier

pytestmark = pytest.mark.skipif(shutil.which("javac") is None, reason="javac is not here")

MODEL = bundled_robot("kuka-iiwa7-r800")
PANDA = bundled_robot("franka-panda")
SPLINE = random_fourier(MODEL, rng=4, duration=8.0, n_harmonics=3)
POSES = np.array([SPLINE.start, SPLINE.start + 0.3, SPLINE.start - 0.2, SPLINE.start])
POINT_TO_POINT = PointToPointMotion.within(POSES, velocity=0.8, acceleration=2.0, dwell=[0.5, 0.0])

CLASSES = {
    "com.kuka.common.ThreadUtil": (
        "public class ThreadUtil { public static void milliSleep(long ms) {"
        ' System.out.println("SLEEP " + ms); } }'
    ),
    "com.kuka.roboticsAPI.applicationModel.IApplicationControl": (
        """public class IApplicationControl {
        private double o = 1.0;
        public void setApplicationOverride(double value) { o = value;
          System.out.println("OVERRIDE " + value); }
        public double getApplicationOverride() { return o; } }"""
    ),
    "com.kuka.roboticsAPI.applicationModel.RoboticsAPIContext": (
        """public class RoboticsAPIContext {
        public <T> T getDeviceFromType(Class<T> kind) {
            try { return kind.getDeclaredConstructor().newInstance(); }
              catch (Exception e) { throw new RuntimeException(e); } } }"""
    ),
    "com.kuka.task.ITaskLogger": (
        """public class ITaskLogger {
        public void info(String text) { System.out.println("INFO " + text); }
        public void error(String text) { System.out.println("ERROR " + text); } }"""
    ),
    "com.kuka.roboticsAPI.uiModel.ApplicationDialogType": (
        "public enum ApplicationDialogType { INFORMATION, QUESTION, WARNING, ERROR }"
    ),
    "com.kuka.roboticsAPI.uiModel.IApplicationUI": (
        """public class IApplicationUI {
        private static int next = 0;
        public int displayModalDialog(ApplicationDialogType kind, String text, String... buttons) {
            int answer = Integer.parseInt(System.getProperty("answers").split(",")[next++]);
            System.out.println("DIALOG " + text + " -> " + buttons[answer]);
            return answer; } }"""
    ),
    "com.kuka.roboticsAPI.applicationModel.RoboticsAPIApplication": (
        """
        import com.kuka.task.ITaskLogger;
        import com.kuka.roboticsAPI.uiModel.IApplicationUI;
        public abstract class RoboticsAPIApplication {
        private final IApplicationControl control = new IApplicationControl();
        public abstract void initialize();
        public abstract void run() throws Exception;
        protected RoboticsAPIContext getContext() { return new RoboticsAPIContext(); }
        protected ITaskLogger getLogger() { return new ITaskLogger(); }
        protected IApplicationUI getApplicationUI() { return new IApplicationUI(); }
        protected IApplicationControl getApplicationControl() { return control; } }"""
    ),
    "com.kuka.roboticsAPI.deviceModel.JointPosition": (
        """public class JointPosition {
        private final double[] q;
        public JointPosition(double... values) { q = values.clone(); }
        public double get(int i) { return q[i]; }
        public String toString() {
          return java.util.Arrays.toString(q).replaceAll("[\\\\[\\\\],]", ""); } }"""
    ),
    "com.kuka.roboticsAPI.motionModel.IMotion": "public interface IMotion { }",
    "com.kuka.roboticsAPI.motionModel.IMotionContainer": (
        """public class IMotionContainer {
        public boolean cancel() { System.out.println("CANCEL"); return true; } }"""
    ),
    "com.kuka.roboticsAPI.motionModel.SplineMotionJP": (
        """public abstract class SplineMotionJP<T extends SplineMotionJP<T>> implements IMotion {
        protected String rel = "";
        public com.kuka.roboticsAPI.deviceModel.JointPosition goal;
        @SuppressWarnings("unchecked") private T with(String more) { rel += more; return (T) this; }
        public T setJointVelocityRel(double v) { return with(" v=" + v); }
        public T setJointAccelerationRel(double a) { return with(" a=" + a); }
        public T setJointJerkRel(double j) { return with(" j=" + j); } }"""
    ),
    "com.kuka.roboticsAPI.motionModel.PTP": (
        """public class PTP extends SplineMotionJP<PTP> {
        public PTP(com.kuka.roboticsAPI.deviceModel.JointPosition q) { goal = q; }
        public String toString() { return "PTP " + goal + " |" + rel; } }"""
    ),
    "com.kuka.roboticsAPI.motionModel.SplineJP": (
        """public class SplineJP implements IMotion {
        private final StringBuilder text = new StringBuilder("SPLINE");
        private String rel = "";
        private SplineMotionJP<?> last;
        public SplineJP(SplineMotionJP<?>... segments) {
          for (SplineMotionJP<?> s : segments) { text.append("\\n  " + s); last = s; } }
        public com.kuka.roboticsAPI.deviceModel.JointPosition end() { return last.goal; }
        public SplineJP setJointVelocityRel(double v) { rel += " v=" + v; return this; }
        public SplineJP setJointAccelerationRel(double a) { rel += " a=" + a; return this; }
        public SplineJP setJointJerkRel(double j) { rel += " j=" + j; return this; }
        public String toString() { return text + "\\nEND SPLINE" + rel; } }"""
    ),
    "com.kuka.roboticsAPI.motionModel.BasicMotions": (
        """public class BasicMotions {
        public static PTP ptp(com.kuka.roboticsAPI.deviceModel.JointPosition q) {
          return new PTP(q); } }"""
    ),
    "com.kuka.roboticsAPI.motionModel.controlModeModel.IMotionControlMode": (
        "public interface IMotionControlMode { }"
    ),
    "com.kuka.roboticsAPI.motionModel.controlModeModel.PositionControlMode": (
        "public class PositionControlMode implements IMotionControlMode { }"
    ),
    "com.kuka.roboticsAPI.motionModel.PositionHold": (
        """public class PositionHold implements IMotion {
        public PositionHold(
          com.kuka.roboticsAPI.motionModel.controlModeModel.IMotionControlMode mode,
          long time, java.util.concurrent.TimeUnit unit) { }
        public PositionHold addMotionOverlay(
          com.kuka.connectivity.fastRobotInterface.FRIJointOverlay overlay) { return this; }
        public String toString() { return "HOLD"; } }"""
    ),
    "com.kuka.roboticsAPI.deviceModel.LBR": (
        """
        import com.kuka.roboticsAPI.motionModel.*;
        public class LBR {
        private JointPosition q = new JointPosition(0, 0, 0, 0, 0, 0, 0);
        private void follow(IMotion m) {
            if (m instanceof PTP) q = ((PTP) m).goal;
            if (m instanceof SplineJP) q = ((SplineJP) m).end();
            if (Boolean.getBoolean("stuck")) q = new JointPosition(0.5, 0, 0, 0, 0, 0, 0);
            System.out.println(m); }
        public IMotionContainer move(IMotion m) { follow(m); return new IMotionContainer(); }
        public IMotionContainer moveAsync(IMotion m) { follow(m); return new IMotionContainer(); }
        public JointPosition getCurrentJointPosition() { return q; } }"""
    ),
    "com.kuka.roboticsAPI.sensorModel.DataRecorder": (
        """public class DataRecorder {
        public enum AngleUnit { Radian, Degree }
        private String text;
        public DataRecorder(String file,
          long timeout, java.util.concurrent.TimeUnit unit, int interval) {
          text = file + " " + timeout + " " + interval; }
        public DataRecorder addCurrentJointPosition(com.kuka.roboticsAPI.deviceModel.LBR lbr,
          AngleUnit unit) { text += " q:" + unit; return this; }
        public DataRecorder addInternalJointTorque(com.kuka.roboticsAPI.deviceModel.LBR lbr) {
          text += " tau"; return this; }
        public DataRecorder addExternalJointTorque(com.kuka.roboticsAPI.deviceModel.LBR lbr) {
          text += " ext"; return this; }
        public boolean enable() { System.out.println("ENABLE " + text); return true; }
        public boolean startRecording() { System.out.println("RECORD"); return true; }
        public boolean stopRecording() { System.out.println("STOP"); return true; }
        public java.net.URL getURL() { return null; } }"""
    ),
    "com.kuka.connectivity.fastRobotInterface.FRIConfiguration": (
        """public class FRIConfiguration {
        public static FRIConfiguration createRemoteConfiguration(
          com.kuka.roboticsAPI.deviceModel.LBR lbr,
          String host) { return new FRIConfiguration(); }
        public void setSendPeriodMilliSec(int ms) { System.out.println("PERIOD " + ms); } }"""
    ),
    "com.kuka.connectivity.fastRobotInterface.FRISession": (
        """public class FRISession {
        public FRISession(FRIConfiguration c) { }
        public void await(long time, java.util.concurrent.TimeUnit unit)
          throws java.util.concurrent.TimeoutException {
            if (Boolean.getBoolean("lonely"))
              throw new java.util.concurrent.TimeoutException("no client"); }
        public void close() { System.out.println("CLOSE"); } }"""
    ),
    "com.kuka.connectivity.fastRobotInterface.FRIJointOverlay": (
        "public class FRIJointOverlay { public FRIJointOverlay(FRISession s) { } }"
    ),
    "Main": (
        """public class Main { public static void main(String[] a) throws Exception {
        com.kuka.roboticsAPI.applicationModel.RoboticsAPIApplication app =
            (com.kuka.roboticsAPI.applicationModel.RoboticsAPIApplication)
              Class.forName(a[0]).getDeclaredConstructor().newInstance();
        app.initialize(); app.run(); } }"""
    ),
}


@pytest.fixture(scope="module")
def classes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the compiled stand-ins and every application, for two robots."""
    folder = tmp_path_factory.mktemp("java")
    sources = []
    for name, body in CLASSES.items():
        package, _, short = name.rpartition(".")
        path = folder / "src" / package.replace(".", "/") / f"{short}.java"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text((f"package {package};\n" if package else "") + body)
        sources.append(path)
    panda = random_fourier(PANDA, rng=2, duration=6.0)
    for form, model, motion, name in (
        ("sunrise", MODEL, SPLINE, "spline"),
        ("sunrise", MODEL, POINT_TO_POINT, "poses"),
        ("sunrise", PANDA, panda, "panda"),
        ("sunrise", PANDA, panda, "*/ \\u000a evil"),
        ("fri", MODEL, SPLINE, "spline"),
        ("fri", PANDA, panda, "panda"),
    ):
        written = write_program(
            folder / "src" / "application", make_program(model, motion, form, name=name)
        )
        sources.append(written["application" if form == "fri" else "program"])
    done = subprocess.run(
        [
            "javac",
            "-Xlint:all",
            "-Werror",
            "-encoding",
            "ascii",
            "-d",
            str(folder / "out"),
            *map(str, sources),
        ],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return folder / "out"


def ran(classes: Path, name: str, answers: str, *properties: str) -> list[str]:
    done = subprocess.run(
        [
            "java",
            "-Xshare:auto",
            "-XX:TieredStopAtLevel=1",
            "-cp",
            str(classes),
            f"-Danswers={answers}",
            *properties,
            "Main",
            f"application.{name}",
        ],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def poses_of(lines: Sequence[str]) -> np.ndarray:
    found = [re.search(r"PTP (.*?) \|", line) for line in lines]
    return np.array([[float(x) for x in match.group(1).split()] for match in found if match])


def relative(line: str, letter: str) -> float:
    match = re.search(rf"\b{letter}=([0-9.eE-]+)", line)
    assert match is not None
    return float(match.group(1))


@pytest.mark.parametrize(
    ("answer", "override", "log"),
    [("1", 0.1, "spline_dry_run_log.txt"), ("2", 1.0, "spline_log.txt")],
)
@pytest.mark.study
def test_spline_passes_the_points_of_the_motion_at_its_speeds(
    classes: Path, answer: str, override: float, log: str
) -> None:
    lines = ran(classes, "SplineExcitation", f"{answer},1")
    begin, end = (
        lines.index("SPLINE"),
        next(k for k, line in enumerate(lines) if line.startswith("END SPLINE")),
    )
    points = poses_of(lines[begin:end])
    t = np.linspace(0.0, SPLINE.duration, len(points) + 1)
    np.testing.assert_allclose(points, SPLINE.derivative(t[1:]), atol=5.1e-7)
    curve = CubicSpline(t, np.vstack([SPLINE.start, points]), bc_type="clamped")
    dense = np.linspace(0.0, SPLINE.duration, 4001)
    assert np.abs(curve(dense) - SPLINE.derivative(dense)).max() < 0.011
    parts = np.abs(SPLINE.derivative(dense, 1)) / MotionBounds.of(MODEL).velocity
    for k, line in enumerate(lines[begin + 1 : end]):
        within = (dense >= t[k]) & (dense <= t[k + 1])
        assert relative(line, "v") == pytest.approx(max(parts[within].max(), 0.01), abs=0.01)
    assert f"OVERRIDE {override}" in lines
    assert lines[-1] == "INFO Recorded to null"
    enabled = next(line for line in lines if line.startswith("ENABLE"))
    assert enabled == f"ENABLE {log} -1 2 q:Radian tau ext"
    assert lines.index("RECORD") < begin < end < lines.index("STOP")
    assert [line for line in lines if line.startswith("OVERRIDE")][-1] == "OVERRIDE 1.0"


@pytest.mark.study
def test_approach_comes_first_and_is_slow(classes: Path) -> None:
    lines = ran(classes, "SplineExcitation", "1,1")
    moves = [line for line in lines if line.startswith("PTP")]
    np.testing.assert_allclose(poses_of(moves)[0], SPLINE.start, atol=5.1e-7)
    assert relative(moves[0], "v") * MotionBounds.of(MODEL).velocity.max() <= 0.2
    assert lines[0].startswith("DIALOG")
    assert lines.index(moves[0]) < lines.index("RECORD")


def test_point_to_point_motion_is_made_of_its_own_moves(classes: Path) -> None:
    lines = ran(classes, "PosesExcitation", "2,1")
    moves = [line for line in lines if line.startswith("PTP")][1:]
    np.testing.assert_allclose(poses_of(moves), POSES[1:], atol=2e-5)
    speeds = [relative(move, "v") for move in moves]
    limit = MotionBounds.of(MODEL).velocity
    peaks = np.minimum(0.8, np.sqrt(2.0 * np.array([0.3, 0.5, 0.2])))
    np.testing.assert_allclose(speeds, peaks * (1 / limit).max(), rtol=5e-3)
    pauses = [
        line
        for line in lines[lines.index(moves[0]) : lines.index("STOP")]
        if line.startswith("SLEEP")
    ]
    assert pauses == ["SLEEP 500", "SLEEP 1000"]
    assert not any("SPLINE" in line for line in lines)


@pytest.mark.parametrize("answers", ["0", "1,0"])
def test_cancelling_starts_nothing(classes: Path, answers: str) -> None:
    lines = ran(classes, "SplineExcitation", answers)
    assert "RECORD" not in lines
    assert "SPLINE" not in lines


def test_robot_that_is_not_at_the_start_is_left_alone(classes: Path) -> None:
    lines = ran(classes, "SplineExcitation", "2,1", "-Dstuck=true")
    assert any(line.startswith("ERROR A1 is at 0.5 rad") for line in lines)
    assert "RECORD" not in lines


def test_fri_application_hands_over_and_always_closes(classes: Path) -> None:
    lines = ran(classes, "SplineFriHold", "1,1,0")
    assert "PERIOD 5" in lines
    assert lines.index("HOLD") < lines.index("CANCEL") < lines.index("CLOSE")
    lonely = ran(classes, "SplineFriHold", "1,1,0", "-Dlonely=true")
    assert "HOLD" not in lonely
    assert lonely[-1] == "CLOSE"
    assert "PERIOD 5" not in ran(classes, "SplineFriHold", "1,0")
