"""What the command line knows of the command that moves a robot in rounds."""

from __future__ import annotations

from asbuilt.cli import Entries, Entry

COMMANDS: Entries = {
    "Motions": {
        "run": Entry(
            "apps.run.command",
            "Move a robot in rounds until its model is proven.",
            (
                "ur10e --on virtual:lab",
                "ur10e --on files:exchange --program urscript --until 3",
            ),
            "",
        ),
    },
}
