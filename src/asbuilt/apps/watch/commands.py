"""What the command line knows of the commands of watching a robot at work."""

from __future__ import annotations

from asbuilt.cli import Entries, Entry

COMMANDS: Entries = {
    "Identification": {
        "watch": Entry(
            "apps.watch.command",
            "Watch a log for external torque, contact and fault.",
            (
                "study/result.json log.csv --calibrate quiet.csv",
                "study/result.json log.csv --thresholds thresholds.json -o events",
            ),
            "watch",
        ),
    },
}
