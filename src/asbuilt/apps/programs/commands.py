"""What the command line knows of the commands of controller programs."""

from __future__ import annotations

from asbuilt.cli import Entries, Entry

COMMANDS: Entries = {
    "Motions": {
        "program": Entry(
            "apps.programs.command",
            "Write a controller program that runs and records a motion.",
            (
                "kuka-iiwa7-r800 motion.csv --format sunrise -o program",
                "ur10e motion.csv --format urscript --rate 500",
            ),
            "make_program",
        ),
    },
}
