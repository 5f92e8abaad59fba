"""Show that a change of the code keeps every number: record what commands say, compare two records.

    python benchmarks/same_numbers.py record --asbuilt "CMD..." --data ../shared --out DIR
    python benchmarks/same_numbers.py compare BEFORE AFTER [--expected FILE]

`record` runs `CASES`, commands on recorded and on virtual robots, through the command line with
`--json`, and stores each document with its exit status as DIR/NAME.json; a command that fails is
stored too. CMD is how to run the program, such as `env PYTHONPATH=OLD/src python -m asbuilt.cli`
for an earlier state of the code; by default it is the `asbuilt` beside this Python.

`compare` goes through two such folders. Numbers agree where `|a - b| <= 1e-12 max(|a|, |b|)`;
truths, exit statuses and the texts under `WORDS_THAT_COUNT` (names, methods, statuses, ...) agree
where they are equal. All other texts are passed over, and so are the fields of `NEVER_THE_SAME`
(paths, wall-clock seconds). An item of a list goes by its name, code or id where all have one.
Fields that only AFTER has are listed and do no harm: the contract allows them. The exit status is
1 where anything differs that FILE does not expect:

    [[expected]]
    path = "lwr4/*:parameters.*.std_error"      # DOCUMENT:PATH, with * ? [] as in file names
    reason = "block length is now rounded to whole samples"

Nothing here depends on the speed of the machine or on the number of its cores: motions are designed
by one or two starts with a time limit that is never met, in one process, and `excite --duration
auto`, whose trials end after some seconds, is left out, and so is `demo`.
A record takes 13 minutes of one core: 7 to 9 minutes with two jobs on two cores.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import resource
import shlex
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path
from string import Template
from typing import Any

TOLERANCE = 1e-12
"""Largest relative difference of two numbers that are the same."""
MOST_COMPUTING = 600
"""CPU seconds that a command may take, many times what the slowest takes; a busy machine does not
use them up sooner."""
SHOWN = 5
"""Differences that are shown of a group, largest first, where not all are asked for."""

NEVER_THE_SAME = frozenset({"command", "stderr", "files", "seconds", "solve_seconds"})
"""Fields that are passed over, with all that is in them."""
WORDS_THAT_COUNT = frozenset(
    (
        "assumed_limits",
        "beyond_tolerance",
        "cause",
        "chosen",
        "code",
        "criterion",
        "determined",
        "drive",
        "dropped",
        "expression",
        "fairly",
        "hardly",
        "id",
        "joint",
        "joints",
        "key",
        "kind",
        "method",
        "moved_too_little",
        "name",
        "names",
        "negligible",
        "not_at_all",
        "not_determined",
        "parametrisation",
        "severity",
        "shared_with",
        "side",
        "status",
        "symbolic",
        "torque_source",
        "unit",
        "well",
    )
)
"""Fields whose texts, alone or in a list, are compared; not `verdict`, at times a sentence."""
LABELS = ("name", "code", "id", "key")
"""What an item of a list goes by, the first of these that all items have."""

UR10E_SHEET = """header = false
torque_source = "current"
[columns]
time = 1
position = "2-7"
velocity = "8-13"
torque = "14-19"
"""

MOTION = "--time-limit 100000 --duration 8 --rate 100 --seed 3"
WORDS = {
    "LWR4": "$MODELS/kuka_lwr4.urdf",
    "LWR4_1": "$DATA/kuka_lwr4/measurements_1.npz",
    "LWR4_2": "$DATA/kuka_lwr4/measurements_2.npz",
    "LWR4_3": "$DATA/kuka_lwr4/measurements_3.npz",
    "MED7": "$MODELS/lbrstack_med7.urdf",
    "MED7_SLOW": "$DATA/lbr_med7/measurements_with_ext_tau_1_dgr.csv",
    "MED7_FAST": "$DATA/lbr_med7/measurements.csv",
    "MED7_ALIKE": " ".join(
        f"$DATA/lbr_med7/joint_states_{part}.csv" for part in ("positions", "velocities", "efforts")
    ),
    "MED7_READ": "--rate 100 --flip-torque",
    "UR10E": "$MODELS/ur10e.urdf",
    "UR10E_30": "$DATA/ur10e/ur-20_02_10-30sec_12harm.csv",
    "UR10E_40": "$DATA/ur10e/ur-20_02_12-40sec_12harm.csv",
    "UR10E_PTP": "$DATA/ur10e/ur-20_01_17-ptp_10_points.csv",
    "UR10E_BARE": "$DATA/ur10e/ur-20_02_19_14harm50sec.csv",
    "UR10E_LOAD": "$DATA/ur10e/ur-20_02_19_14harm50secLoad.csv",
    "UR10E_BARE2": "$DATA/ur10e/ur-20_01_31-unload.csv",
    "UR10E_LOAD2": "$DATA/ur10e/ur-20_01_31-load.csv",
    "UR10E_GAIN": "--gain 14.87,13.26,11.13,10.62,11.03,11.47",
    "UR10E_READ": "--sheet $SCRATCH/ur10e.toml $UR10E_GAIN",
    "UR10": "$MODELS/ur10.urdf",
    "UR10_BAG": "$DATA/ur10_rosbag2/ur10_exciting_trajectory.db3",
    "AIRBOT": "$MODELS/airbot/airbot_play.urdf",
    "AIRBOT_GA": "$DATA/airbot/vali_ga_N12T25.csv",
    "AIRBOT_OPT": "$DATA/airbot/vali_opt.csv",
    "AIRBOT_N7": "$DATA/airbot/vali_ptrnSrch_N7T25QR-5.csv",
    "AIRBOT_N8": "$DATA/airbot/vali_ptrnSrch_N8T25QR-8.csv",
    "AIRBOT_READ": "--sheet $DATA/airbot/sheet.toml",
    "ROKAE": "$MODELS/rokae_xmate.toml",
    "ROKAE_SENSOR": "$DATA/rokae_two_channels/rokae_a.csv",
    "ROKAE_MOTOR": "$DATA/rokae_two_channels/rokae_a_motor.csv",
    "ROKAE_GAIN": "120,120,100,100,80,80,80",
    "TX40": "$MODELS/staubli_tx40.toml",
    "TX40_LOG": "$DATA/tx40/tx40.csv",
    "FOURIER": f"--starts 1 --harmonics 2 {MOTION}",
    "FEW": f"--starts 2 --harmonics 8 {MOTION}",
}
"""What stands for robots, recordings and how these are read; `$OUT` is the folder of a case."""


@dataclass(frozen=True)
class Case:
    """A command, in words of `WORDS`; `@NAME/FILE` is a file that the case NAME wrote before."""

    name: str
    command: str

    @property
    def needs(self) -> frozenset[str]:
        """Names of the cases whose files this one reads."""
        words = shlex.split(self.command)
        return frozenset(str(Path(word[1:]).parent) for word in words if word.startswith("@"))

    def words(self, data: Path, scratch: Path) -> list[str]:
        """Return the words of the command line, after the program's own."""
        places = {
            "DATA": str(data / "data"),
            "MODELS": str(data / "models"),
            "PAPER": str(data / "paper"),
            "SCRATCH": str(scratch),
            "OUT": str(scratch / self.name),
        }
        text = self.command
        while "$" in text:
            text = Template(text).substitute(WORDS | places)
        words = shlex.split(text)
        found = [f"{scratch / word[1:]}" if word.startswith("@") else word for word in words]
        return [*found, "--json"]


BUNDLED = ("franka-panda", "kuka-iiwa7-r800", "puma-560", "scara", "two-link", "ur10e")
DESCRIBED = {
    "models/lwr4": "$LWR4",
    "models/lwr4-cogimon": "$MODELS/kuka_lwr4_cogimon.urdf",
    "models/med7": "$MED7",
    "models/iiwa7": "$MODELS/lbrstack_iiwa7.urdf",
    "models/iiwa14": "$MODELS/iiwa14.urdf",
    "models/iiwa14-mjcf": "$MODELS/mjcf_iiwa14.xml",
    "models/ur10": "$UR10",
    "models/ur10e": "$UR10E",
    "models/xarm7": "$MODELS/xarm7.urdf",
    "models/airbot": "$AIRBOT",
    "models/airbot-gripper": "$MODELS/airbot/airbot_play_gripper.urdf",
    "models/so101": "$MODELS/so101/so101_new_calib.urdf",
    "models/so101-mjcf": "$MODELS/so101/so101_new_calib.xml",
    "models/rokae": "$ROKAE",
    "models/tx40": "$TX40",
    "models/table1": "$PAPER/table1.csv",
}

OF_THE_PROGRAM = (
    Case("program/robots", "robots"),
    Case("program/drives", "drives"),
    Case("program/reproduce", "reproduce --out $OUT"),
)
OF_DESCRIPTIONS = tuple(
    case
    for name, robot in DESCRIBED.items()
    for case in (
        Case(f"{name}/show", f"show {robot}"),
        Case(f"{name}/base", f"base {robot} --drive armature,viscous,coulomb,offset"),
    )
)
OF_BUNDLED_ROBOTS = tuple(
    case
    for robot in BUNDLED
    for case in (
        Case(f"{robot}/motion", f"excite {robot} $FOURIER --out $OUT/motion.csv"),
        Case(f"{robot}/show", f"show {robot}"),
        Case(f"{robot}/base", f"base {robot}"),
        Case(
            f"{robot}/lab",
            f"simulate {robot} @{robot}/motion/motion.csv --preset lab --seed 5 --out $OUT/log.csv",
        ),
        Case(
            f"{robot}/factory",
            f"simulate {robot} --preset factory --duration 12 --seed 6 --out $OUT/log.csv",
        ),
        Case(f"{robot}/check", f"check {robot} @{robot}/lab/log.csv @{robot}/factory/log.csv"),
        Case(
            f"{robot}/auto",
            f"identify {robot} @{robot}/lab/log.csv --holdout last:0.3 --out $OUT",
        ),
        Case(f"{robot}/as-built", f"show @{robot}/auto/robot.toml"),
        Case(
            f"{robot}/wls",
            f"identify {robot} @{robot}/factory/log.csv --method wls --holdout last:0.3",
        ),
        Case(
            f"{robot}/validate",
            f"validate @{robot}/auto/result.json @{robot}/factory/log.csv --unchecked",
        ),
        Case(f"{robot}/compare", f"compare @{robot}/auto/result.json"),
    )
)
OF_MOTIONS = (
    Case("motions/bspline", "excite two-link --parametrisation bspline $FEW --out $OUT/m.csv"),
    Case("motions/quintic", "excite two-link --parametrisation quintic $FEW --out $OUT/m.csv"),
    Case("motions/poses", "excite scara --parametrisation point-to-point $FEW --out $OUT/m.csv"),
    Case("motions/static", "excite ur10e --static 10 --seed 1 --rate 100 --out $OUT/m.csv"),
    Case("motions/a", "excite scara --criterion a $FOURIER --out $OUT/m.csv"),
    Case("motions/e", "excite scara --criterion e $FOURIER --out $OUT/m.csv"),
    Case("motions/condition", "excite scara --criterion condition $FOURIER --out $OUT/m.csv"),
    Case("motions/focus", "excite scara --focus Izz1 $FOURIER --out $OUT/m.csv"),
    Case("motions/power", "excite two-link --perturbed 2 --power 500 $FOURIER --out $OUT/m.csv"),
    Case("motions/box", "excite two-link --tool-box=-3,3,-3,3,-3,3 $FOURIER --out $OUT/m.csv"),
    Case("motions/apart", "excite ur10e --collision skeleton $FOURIER --out $OUT/m.csv"),
    Case("motions/given", "excite $LWR4 --given @lwr4/wls/result.json $FOURIER --out $OUT/m.csv"),
    Case("motions/program", "program scara @scara/motion/motion.csv --format csv --out $OUT"),
    Case("motions/free", "simulate scara --free drop --duration 2 --out $OUT/free.csv"),
    Case(
        "motions/exact",
        "simulate scara @scara/motion/motion.csv --engine inverse-dynamics --preset lab --seed 2"
        " --out $OUT/log.csv",
    ),
    Case("motions/exact-wls", "identify scara @motions/exact/log.csv --method wls"),
    Case(
        "motions/parquet",
        "simulate scara --preset factory --duration 20 --seed 1 --out $OUT/log.parquet",
    ),
    Case(
        "motions/parquet-auto",
        "identify scara @motions/parquet/log.parquet --holdout blocks:2s:3",
    ),
)
OF_TWO_CHANNELS = (
    Case(
        "channels/sensor",
        "simulate scara @scara/motion/motion.csv --preset lab --set torque=sensor --seed 5"
        " --out $OUT/log.csv",
    ),
    Case(
        "channels/motor",
        "simulate scara @scara/motion/motion.csv --preset lab --set torque=motor --seed 5"
        " --out $OUT/log.csv",
    ),
    Case(
        "channels/both", "channels scara @channels/sensor/log.csv --motor @channels/motor/log.csv"
    ),
    Case(
        "channels/rokae",
        "channels $ROKAE $ROKAE_SENSOR --motor $ROKAE_MOTOR --motor-gain $ROKAE_GAIN",
    ),
)
OF_TOOLS = tuple(
    case
    for robot in ("ur10e", "kuka-iiwa7-r800")
    for case in (
        Case(
            f"tools/{robot}-loaded",
            f"simulate {robot} @{robot}/motion/motion.csv --preset lab --tool 2.5@0.01,0.02,0.08"
            " --seed 5 --out $OUT/log.csv",
        ),
        Case(
            f"tools/{robot}-payload",
            f"payload @{robot}/auto/result.json @tools/{robot}-loaded/log.csv"
            f" --unloaded @{robot}/lab/log.csv",
        ),
    )
)
OF_LWR4 = (
    Case("lwr4/check", "check $LWR4 $LWR4_1 $LWR4_2 $LWR4_3"),
    Case(
        "lwr4/auto",
        "identify $LWR4 $LWR4_1 --validate $LWR4_2 --validate $LWR4_3 --out $OUT",
    ),
    Case("lwr4/as-built", "show @lwr4/auto/robot.toml"),
    Case(
        "lwr4/export",
        "export @lwr4/auto/result.json --urdf $OUT/a.urdf --mjcf $OUT/a.xml --c $OUT/a.c",
    ),
    Case("lwr4/as-built-urdf", "show @lwr4/export/a.urdf"),
    Case("lwr4/as-built-mjcf", "show @lwr4/export/a.xml"),
    Case("lwr4/wls", "identify $LWR4 $LWR4_3 --validate $LWR4_1 --method wls --out $OUT"),
    *(
        Case(f"lwr4/{name}", f"identify $LWR4 $LWR4_1 --validate $LWR4_3 --method {options}")
        for name, options in {
            "ols": "ols",
            "ridge": "ridge",
            "huber": "huber",
            "bisquare": "bisquare",
            "ml": "ml",
            "total": "total",
            "iv": "iv",
            "essential": "essential",
            "consistent": "consistent",
            "entropic": "entropic",
            "euclidean": "euclidean",
            "bootstrap": "wls --errors bootstrap",
            "textbook": "wls --errors textbook",
            "refuse": "wls --undetermined refuse",
            "mounting-wls": "wls --mounting estimate",
            "mounting-consistent": "consistent --mounting estimate",
            "drive-auto": "wls --drive auto",
            "drive-spring": "wls --drive auto,spring",
            "drive-stribeck": "wls --drive viscous,coulomb,stribeck:velocity=0.1,offset",
            "cutoff": "wls --cutoff 5 --decimate 4",
            "cutoff-auto": "wls --cutoff auto",
            "paper": "wls --preset paper2015",
        }.items()
    ),
    Case("lwr4/two", "identify $LWR4 $LWR4_1 $LWR4_2 --validate $LWR4_3 --mounting estimate"),
    Case("lwr4/holdout", "identify $LWR4 $LWR4_3 --holdout blocks:5s:3"),
    Case("lwr4/validate", "validate @lwr4/auto/result.json $LWR4_2 $LWR4_3"),
    Case("lwr4/validate-cad", "validate $LWR4 $LWR4_3"),
    Case("lwr4/compare", "compare @lwr4/auto/result.json"),
    Case("lwr4/compare-tolerance", "compare @lwr4/wls/result.json --cad-tolerance 5%"),
    Case("lwr4/compare-later", "compare @lwr4/auto/result.json --with @lwr4/wls/result.json"),
)
OF_MED7 = (
    Case("med7/check-slow", "check $MED7 $MED7_SLOW $MED7_READ"),
    Case("med7/check-fast", "check $MED7 $MED7_FAST $MED7_READ"),
    Case("med7/check-alike", "check $MED7 $MED7_ALIKE --flip-torque"),
    Case("med7/check-unflipped", "check $MED7 $MED7_FAST --rate 100"),
    Case(
        "med7/slow",
        "identify $MED7 $MED7_SLOW $MED7_READ --holdout blocks:5s:3 --out $OUT",
    ),
    Case("med7/as-built", "show @med7/slow/robot.toml"),
    *(
        Case(
            f"med7/slow-{name}",
            f"identify $MED7 $MED7_SLOW $MED7_READ --holdout blocks:5s:3 --method {options}",
        )
        for name, options in {
            "wls": "wls",
            "entropic": "entropic",
            "mounting-wls": "wls --mounting estimate",
            "mounting-auto": "auto --mounting estimate",
            "drive-auto": "wls --drive auto",
        }.items()
    ),
    Case("med7/fast", "identify $MED7 $MED7_FAST $MED7_READ --holdout last:0.3"),
    Case(
        "med7/fast-consistent",
        "identify $MED7 $MED7_FAST $MED7_READ --holdout last:0.3 --method consistent",
    ),
    Case("med7/alike", "identify $MED7 $MED7_ALIKE --flip-torque --holdout blocks:5s:3"),
    Case("med7/validate", "validate @med7/slow/result.json $MED7_FAST $MED7_READ"),
    Case("med7/compare", "compare @med7/slow/result.json"),
    Case(
        "med7/compare-iiwa7",
        "compare @med7/slow/result.json --cad $MODELS/lbrstack_iiwa7.urdf",
    ),
    Case(
        "med7/controller",
        "compare @med7/slow/result.json --controller $MED7_SLOW $MED7_READ",
    ),
)
OF_UR10E = (
    Case("ur10e-logs/check-12harm", "check $UR10E $UR10E_30 $UR10E_40 $UR10E_READ"),
    Case("ur10e-logs/check-ptp", "check $UR10E $UR10E_PTP $UR10E_READ"),
    Case("ur10e-logs/check-14harm", "check $UR10E $UR10E_BARE $UR10E_LOAD $UR10E_READ"),
    Case("ur10e-logs/check-january", "check $UR10E $UR10E_BARE2 $UR10E_LOAD2 $UR10E_READ"),
    Case(
        "ur10e-logs/auto",
        "identify $UR10E $UR10E_30 --validate $UR10E_40 --validate $UR10E_PTP $UR10E_READ"
        " --out $OUT",
    ),
    Case("ur10e-logs/as-built", "show @ur10e-logs/auto/robot.toml"),
    *(
        Case(
            f"ur10e-logs/{name}",
            f"identify $UR10E $UR10E_30 --validate $UR10E_40 $UR10E_READ --method {options}",
        )
        for name, options in {
            "wls": "wls",
            "consistent": "consistent",
            "entropic": "entropic",
            "huber": "huber",
            "drive-auto": "wls --drive auto",
            "drive-load": "wls --drive armature,viscous,coulomb,load_friction,offset",
        }.items()
    ),
    Case("ur10e-logs/bare", "identify $UR10E $UR10E_BARE $UR10E_READ --method wls --out $OUT"),
    Case(
        "ur10e-logs/loaded",
        "identify $UR10E $UR10E_LOAD $UR10E_READ --method wls --holdout blocks:5s:3",
    ),
    Case(
        "ur10e-logs/with-payload",
        "identify $UR10E $UR10E_BARE --payload $UR10E_LOAD $UR10E_READ",
    ),
    Case(
        "ur10e-logs/payload",
        "payload @ur10e-logs/bare/result.json $UR10E_LOAD $UR10E_READ --holdout blocks:5s:3",
    ),
    Case(
        "ur10e-logs/payload-unloaded",
        "payload @ur10e-logs/auto/result.json $UR10E_LOAD --unloaded $UR10E_BARE $UR10E_READ",
    ),
    Case(
        "ur10e-logs/payload-frozen",
        "payload @ur10e-logs/bare/result.json $UR10E_LOAD $UR10E_READ --arm frozen"
        " --gain-uncertainty 3%",
    ),
    Case(
        "ur10e-logs/payload-january",
        "payload @ur10e-logs/auto/result.json $UR10E_LOAD2 --unloaded $UR10E_BARE2 $UR10E_READ",
    ),
    Case(
        "ur10e-logs/gains",
        "gains $UR10E $UR10E_BARE --loaded $UR10E_LOAD --mass 2.805 --sheet $SCRATCH/ur10e.toml",
    ),
    Case(
        "ur10e-logs/validate",
        "validate @ur10e-logs/auto/result.json $UR10E_BARE $UR10E_PTP $UR10E_READ",
    ),
    Case("ur10e-logs/compare", "compare @ur10e-logs/auto/result.json"),
    Case(
        "ur10e-logs/compare-later",
        "compare @ur10e-logs/auto/result.json --with @ur10e-logs/bare/result.json",
    ),
)
OF_UR10 = (
    Case("ur10/check", "check $UR10 $UR10_BAG --torque-source motor"),
    *(
        Case(
            f"ur10/{name}",
            f"identify $UR10 $UR10_BAG --torque-source motor --holdout blocks:2s:3"
            f" --method {options} --out $OUT",
        )
        for name, options in {
            "auto": "auto",
            "wls": "wls",
            "consistent": "consistent",
            "mounting": "wls --mounting estimate",
        }.items()
    ),
    Case("ur10/compare", "compare @ur10/wls/result.json"),
    Case("ur10/nearest", "export @ur10/wls/result.json --nearest --mjcf $OUT/a.xml"),
    Case("ur10/as-built", "show @ur10/nearest/a.xml"),
)
OF_AIRBOT = (
    Case("airbot/check-1", "check $AIRBOT $AIRBOT_GA $AIRBOT_OPT $AIRBOT_READ"),
    Case("airbot/check-2", "check $AIRBOT $AIRBOT_N7 $AIRBOT_N8 $AIRBOT_READ"),
    Case(
        "airbot/auto",
        "identify $AIRBOT $AIRBOT_OPT --validate $AIRBOT_GA $AIRBOT_READ --cutoff 5 --out $OUT",
    ),
    Case("airbot/own-cutoff", "identify $AIRBOT $AIRBOT_OPT --validate $AIRBOT_GA $AIRBOT_READ"),
    Case(
        "airbot/own-cutoff-wls",
        "identify $AIRBOT $AIRBOT_N7 --validate $AIRBOT_N8 $AIRBOT_READ --method wls",
    ),
    Case(
        "airbot/wls",
        "identify $AIRBOT $AIRBOT_N7 --validate $AIRBOT_N8 $AIRBOT_READ --cutoff 5 --method wls",
    ),
    Case(
        "airbot/three",
        "identify $AIRBOT $AIRBOT_OPT $AIRBOT_N7 $AIRBOT_N8 --validate $AIRBOT_GA $AIRBOT_READ"
        " --cutoff 5 --method consistent",
    ),
    Case("airbot/validate", "validate @airbot/auto/result.json $AIRBOT_N7 $AIRBOT_N8 $AIRBOT_READ"),
    Case("airbot/compare", "compare @airbot/auto/result.json"),
)
OF_ROKAE = (
    Case("rokae/check", "check $ROKAE $ROKAE_SENSOR"),
    Case("rokae/check-motor", "check $ROKAE $ROKAE_MOTOR --gain $ROKAE_GAIN"),
    Case("rokae/auto", "identify $ROKAE $ROKAE_SENSOR --holdout blocks:2s:3 --out $OUT"),
    Case("rokae/wls", "identify $ROKAE $ROKAE_SENSOR --holdout blocks:2s:3 --method wls"),
    Case(
        "rokae/motor",
        "identify $ROKAE $ROKAE_MOTOR --gain $ROKAE_GAIN --holdout blocks:2s:3 --method wls",
    ),
    Case("rokae/validate", "validate @rokae/auto/result.json $ROKAE_SENSOR"),
    Case("rokae/compare", "compare @rokae/auto/result.json"),
)
OF_TX40 = (
    Case("tx40/check", "check $TX40 $TX40_LOG"),
    Case("tx40/auto", "identify $TX40 $TX40_LOG --holdout last:0.3 --out $OUT"),
    Case("tx40/wls", "identify $TX40 $TX40_LOG --holdout last:0.3 --method wls"),
    Case("tx40/entropic", "identify $TX40 $TX40_LOG --holdout last:0.3 --method entropic"),
    Case("tx40/consistent", "identify $TX40 $TX40_LOG --holdout last:0.3 --method consistent"),
    Case("tx40/validate", "validate @tx40/auto/result.json $TX40_LOG --cutoff 20 --decimate 50"),
    Case("tx40/compare", "compare @tx40/auto/result.json"),
)
CASES = (
    *OF_THE_PROGRAM,
    *OF_BUNDLED_ROBOTS,
    *OF_LWR4,
    *OF_MED7,
    *OF_UR10E,
    *OF_UR10,
    *OF_AIRBOT,
    *OF_ROKAE,
    *OF_TX40,
    *OF_MOTIONS,
    *OF_TWO_CHANNELS,
    *OF_TOOLS,
    *OF_DESCRIPTIONS,
)


def record(program: Sequence[str], data: Path, out: Path, *, jobs: int, only: str) -> None:
    """Run the cases whose name fits `only`, and those they need; write a document of each."""
    cases = with_needs([case for case in CASES if fnmatchcase(case.name, only)])
    begun = time.perf_counter()
    failed: list[str] = []
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder)
        (scratch / "ur10e.toml").write_text(UR10E_SHEET)
        for number, (case, answer) in enumerate(
            answers(cases, program, data, scratch, jobs=jobs), start=1
        ):
            path = out / f"{case.name}.json"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(json.dumps(answer, indent=1) + "\n")
            status = answer["exit_status"]
            print(
                f"{number:4d}/{len(cases)} {answer['seconds']:6.1f} s  exit {status}  {case.name}",
                flush=True,
            )
            if status != 0:
                failed.append(f"  {case.name}: {status}  {answer['stderr'][-200:].strip()}")
    print(f"{len(cases)} documents in {time.perf_counter() - begun:.0f} s: {out}")
    if failed:
        print(f"{len(failed)} commands did not end with 0; that is recorded, too:")
        print("\n".join(failed))


def with_needs(cases: Sequence[Case]) -> list[Case]:
    """Return the cases and, before them, all whose files they read."""
    wanted = {case.name for case in cases}
    for case in reversed(CASES):
        if case.name in wanted:
            wanted |= case.needs
    return [case for case in CASES if case.name in wanted]


def answers(
    cases: Sequence[Case],
    program: Sequence[str],
    data: Path,
    scratch: Path,
    *,
    jobs: int,
) -> Iterator[tuple[Case, dict[str, Any]]]:
    """Yield what each case answers, as soon as it has; a case begins after those it needs."""
    waiting, running, done = list(cases), dict[Future[dict[str, Any]], Case](), set[str]()
    with ThreadPoolExecutor(jobs) as pool:
        while waiting or running:
            ready = [case for case in waiting if case.needs <= done]
            for case in ready[: jobs - len(running)]:
                waiting.remove(case)
                running[pool.submit(answer_of, case, program, data, scratch)] = case
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                case = running.pop(future)
                done.add(case.name)
                yield case, future.result()


def answer_of(case: Case, program: Sequence[str], data: Path, scratch: Path) -> dict[str, Any]:
    """Return the command, its exit status and document; of an error the exit status alone."""
    (scratch / case.name).mkdir(parents=True, exist_ok=True)
    threads = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    begun = time.perf_counter()
    run = subprocess.run(
        [*program, *case.words(data, scratch)],
        capture_output=True,
        text=True,
        env=threads | os.environ,
        check=False,
    )
    status = run.returncode
    return {
        "command": case.command,
        "exit_status": status,
        "document": document_of(run.stdout),
        "stderr": run.stderr[-2000:] if status else "",
        "seconds": time.perf_counter() - begun,
    }


def document_of(stdout: str) -> Any:
    """Return the JSON document in it; None where there is none, or one that tells an error."""
    try:
        document = json.loads(stdout)
    except json.JSONDecodeError:
        return None
    return None if isinstance(document, dict) and "error" in document else document


@dataclass(frozen=True)
class Difference:
    """What is not the same: `path` in document `name`, with `relative` the size of it."""

    name: str
    path: str
    before: Any
    after: Any
    relative: float

    @property
    def where(self) -> str:
        """Document and path, which an expectation's pattern is held against."""
        return f"{self.name}:{self.path}"

    @property
    def group(self) -> str:
        """Document and the first part of the path."""
        return f"{self.name}:{self.path.split('.')[0]}"


@dataclass
class Comparison:
    """Go through pairs of documents, and gather what differs."""

    tolerance: float = TOLERANCE
    n_documents: int = 0
    n_numbers: int = 0
    differences: list[Difference] = field(default_factory=list)
    new_fields: list[str] = field(default_factory=list)

    def add(self, name: str, before: Mapping[str, Any], after: Mapping[str, Any]) -> None:
        """Compare two answers of the case `name`."""
        self.n_documents += 1
        if before["exit_status"] != after["exit_status"]:
            statuses = before["exit_status"], after["exit_status"]
            self.differences.append(Difference(name, "exit_status", *statuses, math.inf))
            return
        self._compare(name, (), before["document"], after["document"])

    def _compare(self, name: str, path: tuple[str, ...], before: Any, after: Any) -> None:
        if is_prose(before) and is_prose(after) and not counts(path):
            return
        if isinstance(before, dict) and isinstance(after, dict):
            kept = {key: value for key, value in before.items() if key not in NEVER_THE_SAME}
            for key, value in kept.items():
                self._compare(name, (*path, key), value, after.get(key, GONE))
            added = [key for key in after if key not in before and key not in NEVER_THE_SAME]
            self.new_fields += [f"{name}:{'.'.join((*path, key))}" for key in added]
        elif isinstance(before, list) and isinstance(after, list):
            old, new = labelled(before), labelled(after)
            for label in old | new:
                pair = old.get(label, GONE), new.get(label, GONE)
                self._compare(name, (*path, label), *pair)
        else:
            self._compare_values(name, path, before, after)

    def _compare_values(self, name: str, path: tuple[str, ...], before: Any, after: Any) -> None:
        relative = math.inf
        if is_number(before) and is_number(after):
            self.n_numbers += 1
            relative = relative_difference(before, after)
            if relative <= self.tolerance:
                return
        elif type(before) is type(after) and before == after:
            return
        self.differences.append(Difference(name, ".".join(path), before, after, relative))


class Gone:
    """Stand for what a document does not have."""

    def __repr__(self) -> str:
        return "absent"


GONE = Gone()


def is_prose(value: Any) -> bool:
    """Return whether it is a text, texts, or none where one could be."""
    return (
        value is None
        or isinstance(value, str)
        or (isinstance(value, list) and all(isinstance(item, str) for item in value))
    )


def is_number(value: Any) -> bool:
    """Return whether it is a number, which truths are not."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def relative_difference(before: float, after: float) -> float:
    """Return `|a - b| / max(|a|, |b|)`: zero for the same, infinite where only one is finite."""
    if before == after or (math.isnan(before) and math.isnan(after)):
        return 0.0
    if not (math.isfinite(before) and math.isfinite(after)):
        return math.inf
    return abs(before - after) / max(abs(before), abs(after))


def counts(path: tuple[str, ...]) -> bool:
    """Return whether a text is compared: it, or the list that it is in, is under such a field."""
    fields = [part for part in path if not part.isdigit()]
    return bool(fields) and fields[-1] in WORDS_THAT_COUNT


def labelled(items: list[Any]) -> dict[str, Any]:
    """Return the items of a list by their name, code or id, or by their number from 0."""
    keys = [key for key in LABELS if all(isinstance(item, dict) and key in item for item in items)]
    found: dict[str, Any] = {}
    for number, item in enumerate(items):
        label = str(item[keys[0]] if keys else number)
        same = sum(known.split("#")[0] == label for known in found)
        found[f"{label}#{same + 1}" if same else label] = item
    return found


def compare(before: Path, after: Path, *, only: str, tolerance: float) -> Comparison:
    """Return what differs between two folders of documents."""
    found = Comparison(tolerance)
    folders = [documents_in(folder, only) for folder in (before, after)]
    for name in sorted(folders[0] | folders[1]):
        paths = [folder.get(name) for folder in folders]
        if paths[0] is None or paths[1] is None:
            had, has = ("recorded" if path else GONE for path in paths)
            found.differences.append(Difference(name, "document", had, has, math.inf))
        else:
            found.add(name, *(json.loads(path.read_text()) for path in paths if path))
    return found


def documents_in(folder: Path, only: str) -> dict[str, Path]:
    """Return the paths of the documents whose name fits, by name."""
    paths = {
        path.relative_to(folder).with_suffix("").as_posix(): path for path in folder.rglob("*.json")
    }
    return {name: path for name, path in paths.items() if fnmatchcase(name, only)}


def expectations(file: Path | None) -> dict[str, str]:
    """Return the reasons of what is expected to differ, by pattern."""
    if file is None:
        return {}
    tables = tomllib.loads(file.read_text()).get("expected", [])
    if not all({"path", "reason"} <= table.keys() for table in tables):
        raise SystemExit(f"{file}: every [[expected]] has a path and a reason")
    return {table["path"]: table["reason"] for table in tables}


def told(found: Comparison, expected: Mapping[str, str], *, full: bool) -> tuple[str, bool]:
    """Return the verdict in words, and whether nothing differs that is not expected."""
    surprises, lines = list[Difference](), list[str]()
    reasons = dict.fromkeys(expected, 0)
    for difference in found.differences:
        pattern = next((each for each in expected if fnmatchcase(difference.where, each)), None)
        if pattern is None:
            surprises.append(difference)
        else:
            reasons[pattern] += 1
    for pattern, count in reasons.items():
        lines.append(f"expected, {count} times: {pattern} ({expected[pattern]})")
    if found.new_fields:
        lines.append(f"{len(found.new_fields)} new fields, which are allowed")
        lines += [f"  {each}" for each in found.new_fields[: None if full else SHOWN]]
    lines += grouped(surprises, full=full)
    verdict = f"{len(surprises)} DIFFERENCES" if surprises else "all equal"
    but = f" but for {sum(reasons.values())} expected differences" if sum(reasons.values()) else ""
    lines.append(
        f"{found.n_documents} documents, {found.n_numbers} numbers: {verdict}{but}"
        f" (to {found.tolerance:g} relative)"
    )
    return "\n".join(lines), not surprises


def grouped(differences: Iterable[Difference], *, full: bool) -> Iterator[str]:
    """Yield lines on differences by document and field, the largest first."""
    groups: dict[str, list[Difference]] = {}
    for difference in sorted(differences, key=lambda each: -each.relative):
        groups.setdefault(difference.group, []).append(difference)
    for group, members in groups.items():
        yield f"{group}: {len(members)} differ"
        for each in members if full else members[:SHOWN]:
            pair = f"{brief(each.before)} -> {brief(each.after)}"
            yield f"  {each.path or '(all)'}  {pair}  {each.relative:.1e}"
        if len(members) > SHOWN and not full:
            yield f"  ... and {len(members) - SHOWN} smaller ones (--full shows them)"


def brief(value: Any) -> str:
    """Return a value in few letters."""
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:37]}..."


def main() -> int:
    """Record or compare, and return the exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    verbs = parser.add_subparsers(dest="verb", required=True)
    recording = verbs.add_parser("record", help="run all commands and store what they say")
    own = str(Path(sys.executable).with_name("asbuilt"))
    recording.add_argument("--asbuilt", default=own, metavar="CMD", help="how to run the program")
    recording.add_argument(
        "--data", type=Path, required=True, help="folder with data/, models/ and paper/ in it"
    )
    recording.add_argument("--out", type=Path, required=True, help="folder of the documents")
    recording.add_argument("--jobs", type=int, default=2, help="commands at a time (default: 2)")
    most = f"CPU seconds of one command (default: {MOST_COMPUTING})"
    recording.add_argument("--seconds", type=int, default=MOST_COMPUTING, help=most)
    comparing = verbs.add_parser("compare", help="say which numbers of two records differ")
    comparing.add_argument("before", type=Path)
    comparing.add_argument("after", type=Path)
    comparing.add_argument("--expected", type=Path, help="TOML file of what may differ, and why")
    comparing.add_argument(
        "--tolerance", type=float, default=TOLERANCE, help="relative (default: 1e-12)"
    )
    comparing.add_argument("--full", action="store_true", help="show all differences")
    for verb in (recording, comparing):
        verb.add_argument("--only", default="*", metavar="PATTERN", help="cases such as 'lwr4/*'")
    arguments = parser.parse_args()
    if arguments.verb == "record":
        if not (arguments.data / "data").is_dir():
            parser.error(f"there is no folder {arguments.data / 'data'} with recordings")
        if not any(fnmatchcase(case.name, arguments.only) for case in CASES):
            groups = dict.fromkeys(f"'{Path(case.name).parent}/*'" for case in CASES)
            parser.error(f"no case fits {arguments.only!r}; there are {', '.join(groups)}")
        # Commands inherit the limit; this process computes little.
        resource.setrlimit(resource.RLIMIT_CPU, (arguments.seconds, resource.RLIM_INFINITY))
        record(
            shlex.split(arguments.asbuilt),
            arguments.data.resolve(),
            arguments.out,
            jobs=arguments.jobs,
            only=arguments.only,
        )
        return 0
    found = compare(
        arguments.before, arguments.after, only=arguments.only, tolerance=arguments.tolerance
    )
    if not found.n_documents:
        parser.error(f"no documents to compare in {arguments.before} and {arguments.after}")
    text, same = told(found, expectations(arguments.expected), full=arguments.full)
    print(text)
    return 0 if same else 1


if __name__ == "__main__":
    sys.exit(main())
