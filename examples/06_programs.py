"""Write the programs that run a motion on real controllers, for each format and every bundled robot
that it can move.
"""

from __future__ import annotations

import tempfile

from asbuilt import load_robot
from asbuilt.errors import MotionError
from asbuilt.excitation.motions.random_motion import random_fourier
from asbuilt.writers.programs.format import PROGRAM_FORMATS
from asbuilt.writers.programs.program import make_program
from asbuilt.writers.programs.program_files import write_program

ROBOTS = ("kuka-iiwa7-r800", "franka-panda", "ur10e", "scara")

for robot in ROBOTS:
    model = load_robot(robot)
    motion = random_fourier(model, rng=1, duration=10.0)
    for form in PROGRAM_FORMATS:
        try:
            program = make_program(model, motion, form, name=f"{robot} run 1")
        except MotionError as refusal:
            print(f"{robot:<16} {form:<9} {str(refusal).split(';')[0]}")
            continue
        with tempfile.TemporaryDirectory() as folder:
            files = write_program(folder, program)
            sizes = ", ".join(
                f"{path.name} ({path.stat().st_size / 1024:.0f} kB)" for path in files.values()
            )
        print(f"{robot:<16} {form:<9} {sizes}")

notes = {file.role: file for file in program}["notes"]
print(f"\nwhat {notes.name} says:\n\n{notes.text}")
