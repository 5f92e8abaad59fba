"""What the command line knows of the commands of the page."""

from __future__ import annotations

from asbuilt.cli import Entries, Entry

COMMANDS: Entries = {
    "Recordings": {
        "columns": Entry(
            "apps.page.columns",
            "Show which column of a log is which quantity of which joint.",
            ("ur10e log.csv", "ur10e log.csv --sheet log.toml --json"),
            "",
            compiles=False,
        ),
    },
    "Complete runs": {
        "open": Entry(
            "apps.page.command",
            "Open a page in the browser: from files to a trusted model.",
            ("", "my_robot.urdf log.csv --no-browser"),
            "",
            compiles=False,
        ),
    },
}
