"""The C++ programs, compiled against small stand-ins for KUKA's and Franka's libraries and run on
an ideal robot.
"""

from __future__ import annotations

import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from asbuilt import make_program
from asbuilt.apps.programs import write_program
from asbuilt.description import bundled_robot
from asbuilt.excitation import Motion, random_fourier
from asbuilt.experiment import read_recording

pytestmark = pytest.mark.skipif(shutil.which("g++") is None, reason="g++ is not here")

FRI = """
#pragma once
#include <array>
#include <cstdio>
#include <cstdlib>
#include <fstream>
namespace KUKA { namespace FRI {
enum ESessionState { IDLE, MONITORING_WAIT, MONITORING_READY, COMMANDING_WAIT, COMMANDING_ACTIVE };
class LBRState {
 public:
  double q[7], tau[7], ext[7];
  double period;
  long step = 0;
  double getSampleTime() const { return period; }
  unsigned int getTimestampSec() const { return 1000u + static_cast<unsigned int>(step * period); }
  unsigned int getTimestampNanoSec() const { const double t = step * period;
    return static_cast<unsigned int>((t - static_cast<long>(t)) * 1e9 + 0.5); }
  const double* getMeasuredJointPosition() const { return q; }
  const double* getMeasuredTorque() const { return tau; }
  const double* getExternalTorque() const { return ext; }
  const double* getIpoJointPosition() const { return ipo; }
  double ipo[7];
};
class LBRCommand {
 public:
  double q[7];
  void setJointPosition(const double* values) { for (int j = 0; j < 7; ++j) q[j] = values[j]; }
};
class LBRClient {
 public:
  LBRClient() {
    std::ifstream file("robot.txt");
    file >> state.period;
    for (double& x : state.q) file >> x;
    for (int j = 0; j < 7; ++j) { state.ipo[j] = state.q[j]; state.tau[j] = -state.q[j];
      state.ext[j] = 0.5; command_.q[j] = state.q[j]; }
  }
  virtual ~LBRClient() {}
  virtual void onStateChange(ESessionState, ESessionState) {}
  virtual void monitor() {}
  virtual void waitForCommand() { command_.setJointPosition(state.ipo); }
  virtual void command() { command_.setJointPosition(state.ipo); }
  const LBRState& robotState() const { return state; }
  LBRCommand& robotCommand() { return command_; }
  LBRState state;
  LBRCommand command_;
};
class UdpConnection {};
class ClientApplication {
 public:
  ClientApplication(UdpConnection&, LBRClient& client)
    : client_(client), out_("commanded.txt") { out_.precision(12); }
  bool connect(int port, const char*) { return port == 30200; }
  void disconnect() {}
  bool step() {
    LBRState& s = client_.state;
    ++s.step;
    if (s.step == 1) client_.onStateChange(IDLE, MONITORING_READY);
    if (s.step < 5) { client_.monitor(); return true; }
    if (s.step == 5) client_.onStateChange(MONITORING_READY, COMMANDING_WAIT);
    if (s.step < 10) { client_.waitForCommand(); return true; }
    if (s.step == 10) client_.onStateChange(COMMANDING_WAIT, COMMANDING_ACTIVE);
    client_.command();
    bool moved = false;
    for (int j = 0; j < 7; ++j) {
      out_ << client_.command_.q[j] << (j < 6 ? " " : "\\n");
      moved = moved || client_.command_.q[j] != s.q[j];
      s.q[j] = client_.command_.q[j];
      s.tau[j] = -s.q[j];
    }
    still_ = moved ? 0 : still_ + 1;
    if (still_ * s.period > 6.0) client_.onStateChange(COMMANDING_ACTIVE, MONITORING_READY);
    return true;
  }
 private:
  LBRClient& client_;
  std::ofstream out_;
  long still_ = 0;
};
}}
"""

FRANKA = """
#pragma once
#include <array>
#include <cstdint>
#include <fstream>
#include <functional>
#include <stdexcept>
#include <string>
namespace franka {
struct Exception : std::runtime_error { using std::runtime_error::runtime_error; };
class Duration {
 public:
  explicit Duration(uint64_t ms = 0) : ms_(ms) {}
  double toSec() const { return ms_ / 1000.0; }
 private:
  uint64_t ms_;
};
struct Finishable { bool motion_finished = false; };
struct JointPositions : Finishable {
  JointPositions(const std::array<double, 7>& values) noexcept : q(values) {}
  std::array<double, 7> q;
};
inline JointPositions MotionFinished(JointPositions command) noexcept {
  command.motion_finished = true; return command; }
struct RobotState {
  std::array<double, 7> q{}, q_d{}, dq{}, tau_J{}, tau_ext_hat_filtered{};
  Duration time;
};
class Robot {
 public:
  explicit Robot(const std::string& address) : out_("commanded.txt") {
    if (address != "robot") throw Exception("no robot at " + address);
    out_.precision(14);
    std::ifstream file("robot.txt");
    double period;
    file >> period;
    for (double& x : state_.q) file >> x;
    state_.q_d = state_.q;
  }
  void setCollisionBehavior(const std::array<double, 7>&, const std::array<double, 7>&,
    const std::array<double, 6>&, const std::array<double, 6>&) {}
  RobotState readOnce() { return state_; }
  void control(std::function<JointPositions(const RobotState&, Duration)> callback) {
    out_ << "motion\\n";
    for (uint64_t k = 0;; ++k) {
      state_.time = Duration(++clock_);
      JointPositions command = callback(state_, Duration(k == 0 ? 0 : 1));
      for (int j = 0; j < 7; ++j) {
        out_ << command.q[j] << (j < 6 ? " " : "\\n");
        state_.dq[j] = (command.q[j] - state_.q[j]) * 1000.0;
        state_.q[j] = state_.q_d[j] = command.q[j];
        state_.tau_J[j] = command.q[j];
      }
      if (command.motion_finished) return;
    }
  }
 private:
  RobotState state_;
  uint64_t clock_ = 5000;
  std::ofstream out_;
};
}
"""

HEADERS = {
    "fri": (FRI, ("friClientApplication.h", "friLBRClient.h", "friUdpConnection.h")),
    "franka": (
        FRANKA,
        tuple(
            f"franka/{name}.h"
            for name in ("control_types", "duration", "exception", "robot", "robot_state")
        ),
    ),
}


@dataclass(frozen=True)
class Built:
    """A program and its files in a folder of their own."""

    form: str
    folder: Path
    program: Path
    motion: Motion

    def run(
        self, *arguments: str, start: np.ndarray, answers: str = "yes\nyes\n"
    ) -> subprocess.CompletedProcess[str]:
        (self.folder / "robot.txt").write_text("0.005 " + " ".join(f"{x:.12f}" for x in start))
        address = ["robot"] if self.form == "franka" else []
        return subprocess.run(
            [self.program, *address, *arguments],
            cwd=self.folder,
            input=answers,
            capture_output=True,
            text=True,
            check=False,
        )

    def commanded(self) -> list[np.ndarray]:
        parts = (self.folder / "commanded.txt").read_text().split("motion\n")
        return [
            np.array(part.split(), dtype=float).reshape(-1, 7) for part in parts if part.strip()
        ]


def compiled(form: str, robot: str, folder: Path, *, syntax_only: bool = False) -> Built:
    model = bundled_robot(robot)
    motion = random_fourier(model, rng=5, duration=3.0, n_harmonics=2)
    written = write_program(folder, make_program(model, motion, form, name="run"))
    text, names = HEADERS[form]
    for name in names:
        header = folder / "include" / name
        header.parent.mkdir(parents=True, exist_ok=True)
        header.write_text('#include "all.h"\n')
        (header.parent / "all.h").write_text(text)
    standard = "-std=c++11" if form == "fri" else "-std=c++17"
    warnings = ["-Wall", "-Wextra", "-Wshadow", "-Werror", "-pedantic"]
    program = folder / "program"
    goal = ["-fsyntax-only"] if syntax_only else ["-o", str(program)]
    done = subprocess.run(
        ["g++", standard, *warnings, "-I", str(folder / "include"), str(written["program"]), *goal],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return Built(form, folder, program, motion)


@pytest.fixture(scope="module", params=["fri", "franka"])
def built(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Built:
    robot = {"fri": "kuka-iiwa7-r800", "franka": "franka-panda"}[request.param]
    return compiled(request.param, robot, tmp_path_factory.mktemp(request.param))


@pytest.mark.parametrize(
    ("form", "robot"),
    [("fri", "franka-panda"), pytest.param("franka", "kuka-iiwa7-r800", marks=pytest.mark.study)],
)
def test_compiles_for_another_robot(form: str, robot: str, tmp_path: Path) -> None:
    compiled(form, robot, tmp_path, syntax_only=True)


@pytest.mark.parametrize("full", [False, pytest.param(True, marks=pytest.mark.study)])
def test_ideal_robot_follows_the_motion_and_the_log_is_read(built: Built, full: bool) -> None:
    offset = np.full(7, 0.004)
    done = built.run(*(["--full"] if full else []), start=built.motion.start + offset)
    assert done.returncode == 0, done.stdout + done.stderr
    assert ("FULL SPEED" in done.stdout) == full
    meant = built.motion if full else built.motion.slowed(10)
    q = built.commanded()[-1]
    rate, lead = (200.0, 3.0) if built.form == "fri" else (1000.0, 1.0)
    first = 1 if built.form == "fri" else 0
    t = (np.arange(len(q)) + first) / rate - lead
    moving = (t >= 0) & (t <= meant.duration)
    assert moving.sum() == int(meant.duration * rate) + 1
    np.testing.assert_allclose(
        q[moving], meant.derivative(t[moving].clip(0, meant.duration)), atol=2e-7
    )
    np.testing.assert_allclose(built.commanded()[0][0], built.motion.start + offset, atol=1e-5)
    np.testing.assert_allclose(q[-1], built.motion.end, atol=1e-9)
    speed = np.abs(np.diff(q, axis=0)) * rate
    assert np.all(speed <= 1.02 * meant.peaks(1) + 0.01)
    log = built.folder / ("run_log.csv" if full else "run_dry_run_log.csv")
    model = bundled_robot("kuka-iiwa7-r800" if built.form == "fri" else "franka-panda")
    recording = read_recording(log, model=model, sheet=built.folder / "run_log.toml")
    np.testing.assert_allclose(recording.tau, recording.q, atol=1e-8)
    assert recording.rate == pytest.approx(rate)
    assert recording.duration >= meant.duration + 2.0


def test_approach_is_slow_and_only_franka_does_it_itself(built: Built) -> None:
    away = built.motion.start + np.array([0.3, -0.2, 0.1, 0.05, 0.0, 0.2, -0.3])
    done = built.run("--full", start=away)
    if built.form == "fri":
        assert done.returncode == 1
        assert "not at the start pose: joint 1" in done.stdout
        np.testing.assert_allclose(
            built.commanded()[-1], np.tile(away, (len(built.commanded()[-1]), 1)), atol=1e-11
        )
    else:
        assert done.returncode == 0, done.stderr
        approach = built.commanded()[0]
        speed = np.abs(np.diff(approach, axis=0)) * 1000
        assert speed.max() == pytest.approx(0.2, rel=1e-3)
        np.testing.assert_allclose(approach[-1], built.motion.start, atol=1e-9)


def test_nothing_moves_without_a_yes(built: Built) -> None:
    (built.folder / "commanded.txt").unlink(missing_ok=True)
    done = built.run("--full", start=built.motion.start, answers="no\n")
    assert done.returncode == 1
    assert not (built.folder / "commanded.txt").exists() or not built.commanded()


def test_wrong_usage_and_foreign_tables_are_refused(built: Built) -> None:
    assert built.run("--fast", start=built.motion.start).returncode == 2
    table = built.folder / f"run_{built.form}.csv"
    text = table.read_text()
    lines = text.splitlines(keepends=True)
    try:
        for damaged, said in (
            ("".join(lines[:-50]), "does not last as long"),
            (
                "".join([lines[0], lines[1].replace(lines[1].split(",")[1], "0.123"), *lines[2:]]),
                "does not start where",
            ),
            ("".join([*lines[:5], "0.1,abc\n", *lines[6:]]), "line 6 is damaged"),
            ("x,y\n", "is not the motion"),
        ):
            table.write_text(damaged)
            done = built.run("--full", start=built.motion.start)
            assert done.returncode == 1
            assert said in done.stderr
    finally:
        table.write_text(text)


@pytest.mark.parametrize("full", [False, True])
def test_commands_have_no_jumps_of_acceleration(built: Built, full: bool) -> None:
    """Third differences of the commands stay at the jerk of the motion.

    Nothing is rounded, repeated or left out anywhere.
    """
    built.run(*(["--full"] if full else []), start=built.motion.start)
    rate = 200.0 if built.form == "fri" else 1000.0
    meant = built.motion if full else built.motion.slowed(10)
    for q in built.commanded():
        jerk = np.abs(np.diff(q, 3, axis=0)) * rate**3
        assert np.all(jerk <= 1.02 * meant.peaks(3) + 0.05)
