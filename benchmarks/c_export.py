"""Time per call of the exported C code, one core, gcc -O2, inputs that change from call to call."""

from __future__ import annotations

import subprocess
import tempfile
from dataclasses import replace
from pathlib import Path

from asbuilt.description.load import load_robot
from asbuilt.description.model import DriveValues
from asbuilt.writers.models.c.c_code import generate_c_code, write_c

ROBOTS = ("kuka-iiwa7-r800", "franka-panda", "ur10e")
CALLS = 200_000
REPEATS = 7

PROGRAM = """
#define _POSIX_C_SOURCE 199309L
#include "robot.h"
#include <stdio.h>
#include <time.h>

static double now(void) {{ struct timespec t;
  clock_gettime(CLOCK_MONOTONIC, &t);
  return 1e6*(double)t.tv_sec + 1e-3*(double)t.tv_nsec; }}

#define TIME(what, call) do {{ \\
    double best = 1e9; \\
    for (int repeat = 0; repeat < {repeats}; repeat++) {{ \\
        double start = now(); \\
        for (int k = 0; k < {calls}; k++) {{ \\
            for (int j = 0; j < {n}; j++) q[j] += 1e-4*(j + 1); \\
            call; sum += out[k % {n}]; }} \\
        double each = (now() - start)/{calls}; \\
        if (each < best) best = each; \\
    }} \\
    printf("%s %.4f\\n", what, best); \\
}} while (0)

int main(void)
{{
    static double q[{n}], qd[{n}], qdd[{n}], out[{n}*{p}];
    double sum = 0.0;
    for (int j = 0; j < {n}; j++) {{ q[j] = 0.1*j; qd[j] = 0.2 - 0.1*j; qdd[j] = 0.3*j; }}
    TIME("inverse_dynamics", {prefix}_inverse_dynamics(q, qd, qdd, out));
    TIME("gravity_torque", {prefix}_gravity_torque(q, out));
    TIME("regressor", {prefix}_regressor(q, qd, qdd, out));
    return sum == 0.5;
}}
"""


def measure() -> dict[str, float | str]:
    """Return microseconds per call, all four drive terms included."""
    found: dict[str, float | str] = {}
    for name in ROBOTS:
        model = load_robot(name)
        drive = DriveValues(armature=0.1, viscous=1.0, coulomb=2.0, offset=0.1)
        model = replace(model, joints=tuple(replace(joint, drive=drive) for joint in model.joints))
        code = generate_c_code(model)
        with tempfile.TemporaryDirectory() as place:
            source, header = write_c(Path(place) / "robot.c", model)
            p = int(header.read_text().split("_BASE_PARAMETERS ")[1].split()[0])
            main = Path(place) / "main.c"
            main.write_text(
                PROGRAM.format(
                    prefix=code.prefix, n=model.n_joints, p=p, calls=CALLS, repeats=REPEATS
                )
            )
            program = Path(place) / "program"
            subprocess.run(
                ["gcc", "-std=c99", "-O2", str(main), str(source), "-o", str(program), "-lm"],
                check=True,
            )
            lines = subprocess.run(
                [str(program)], check=True, capture_output=True, text=True
            ).stdout.split()
        found |= {
            f"{name}_{what}_us_per_sample": float(value)
            for what, value in zip(lines[::2], lines[1::2], strict=True)
        }
    return found
