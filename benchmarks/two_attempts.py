"""Logs of others, read without their sheets: which of them `check` makes usable in two attempts.

The first attempt is `asbuilt check ROBOT LOG --write-sheet` in a folder that holds the log alone;
the second is the same again, with the sheet that the first one wrote. A log passes if the second
is ready, or asks only for what no file holds: gains of currents, the mounting, a load, which topic
or robot was meant. Nothing else is edited in between.

    python benchmarks/two_attempts.py ../shared [--only kinova,indy]
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

CASES = """
data/airbot/vali_opt.csv                            models/airbot/airbot_play.urdf
data/baxter/Training_Random.csv                     models/baxter/baxter_left.urdf   --rate 100
data/dvrk/psm/one.csv                               dvrk-psm                         --rate 200
data/go2_hung/traj_0.pt                             models/go2/go2.xml --fixed-base --kp 20 --kd 1.5
data/indy/random_free_MonitoringDataLog7.txt        models/indy/indy7.urdf
data/indy/joint_free_with_load.txt                  models/indy/indy7.urdf
data/kinova/opti_traj_testing1.csv                  models/kinova/gen3.urdf
data/kinova/opti_traj_testing2.csv                  models/kinova/gen3.urdf
data/kr300/A.csv                                    models/kuka_kr300.toml
data/krang/train.csv                                models/krang/krang_arm.urdf
data/kuka_lwr4/measurements_1.npz                   models/kuka_lwr4.urdf
data/lbr_med7/measurements_with_ext_tau_1_dgr.csv   models/lbrstack_med7.urdf        --rate 100
data/panda/panda_gaz.csv                            franka-panda
data/panda/panda_unisa.db3                          franka-panda
data/rokae_two_channels/rokae_a.csv                 models/rokae_xmate.toml          --rate 1000
data/schunk/m1.csv                                  models/schunk/schunk_lwa4p.urdf
data/so101_sage/multisine                           models/so101/so101_new_calib.urdf
data/tx40/tx40.csv                                  models/staubli_tx40.toml
data/ur10_rosbag2/ur10_exciting_trajectory.db3      models/ur10.urdf
data/ur10e/ur-20_02_10-30sec_12harm.csv             models/ur10e.urdf
data/z1/zn_a.csv                                    models/z1/z1.xml
data/z1/zn_b.csv                                    models/z1/z1.xml
field/00_base/log.csv                               field/00_base/tri.urdf
field/20_plotjuggler/pj.csv                         field/20_plotjuggler/tri.urdf
field/22_gravity_compensated/js.csv                 field/22_gravity_compensated/tri.urdf
field/23_dynamixel/novel.csv                        field/23_dynamixel/tri.urdf
field/23_dynamixel/raw.csv                          field/23_dynamixel/tri.urdf
field/23_dynamixel/u16.csv                          field/23_dynamixel/tri.urdf
field/23_dynamixel/vel.csv                          field/23_dynamixel/tri.urdf
field/24_kinova/gen3.csv                            field/24_kinova/cont.urdf
field/24_kinova/gen3_sense.csv                      field/24_kinova/cont.urdf
field/27_wrap/wrap.csv                              field/27_wrap/tri.urdf
field/28_bag_two_publishers/split_groups            field/28_bag_two_publishers/tri.urdf
field/31_timestamps/ns.csv                          field/31_timestamps/tri.urdf
field/31_timestamps/ns_e.csv                        field/31_timestamps/tri.urdf
field/40_one_joint/one.csv                          field/40_one_joint/tri.urdf
"""
"""Log, robot, and what a person knows of them beyond the files."""
ONLY_A_PERSON = {
    *("current_gains", "gravity_direction", "joint_torque_scale", "torque_scale"),
    *("torque_not_explained", "unit_unknown"),
}
"""Codes of findings about gains, the mounting and loads, which no file holds."""


def list_cases(shared: Path) -> Iterator[tuple[Path, str, list[str]]]:
    """Yield log, robot and options of each case."""
    for line in CASES.strip().splitlines():
        log, robot, *options = line.split()
        path = shared / robot
        yield shared / log, str(path.resolve()) if path.exists() else robot, options


def copy_alone(log: Path, folder: Path) -> Path:
    """Copy a log, a file or a folder, without what lies beside it."""
    target = folder / log.name
    if log.is_dir():
        shutil.copytree(log, target)
    else:
        shutil.copyfile(log, target)
    return target


def check_log(robot: str, log: Path, options: list[str]) -> tuple[str, str]:
    """Return the state that `check` prints, and the codes of its errors or its message."""
    command = [sys.executable, "-m", "asbuilt", "check", robot, str(log), *options, "--json"]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    try:
        document = json.loads(run.stdout)
    except ValueError:
        return "CRASH", (run.stderr or run.stdout).strip()[-200:]
    if "error" in document:
        return "UNREADABLE", " ".join(document["error"]["message"].split())[:160]
    found = [each for part in document["recordings"] for each in part["findings"]]
    errors = sorted({each["code"] for each in found if each["severity"] == "error"})
    warnings = sorted({each["code"] for each in found if each["severity"] == "warning"})
    if errors:
        return "NOT READY", ", ".join(errors)
    return ("READY WITH CARE", ", ".join(warnings)) if warnings else ("READY", "")


def main() -> None:
    """Print a table of both attempts at every log, and how many pass."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("shared", type=Path)
    parser.add_argument("--only", default="")
    parser.add_argument("--attempts", type=int, default=2)
    given = parser.parse_args()
    wanted = [part for part in given.only.split(",") if part]
    passed = tried = 0
    for log, robot, options in list_cases(given.shared):
        if wanted and not any(part in str(log) for part in wanted):
            continue
        tried += 1
        with tempfile.TemporaryDirectory(prefix="two-attempts-") as folder:
            copied = copy_alone(log, Path(folder))
            more = ["--write-sheet"] if given.attempts > 1 else []
            results = [check_log(robot, copied, [*options, *more])]
            if given.attempts > 1:
                results.append(check_log(robot, copied, options))
        state, what = results[-1]
        codes = set(what.split(", "))
        good = state.startswith("READY") or (state == "NOT READY" and codes <= ONLY_A_PERSON)
        passed += good
        name = str(log.relative_to(given.shared))
        print(f"{'yes' if good else 'NO ':3}  {name}")
        for state, what in results:
            print(f"     {state:15} {what}", flush=True)
    print(f"\n{passed} of {tried} logs in {given.attempts} attempts")


if __name__ == "__main__":
    main()
