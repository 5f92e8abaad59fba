"""What the command line knows of the commands of the demonstrations and the paper."""

from __future__ import annotations

from asbuilt.cli import Entries, Entry

COMMANDS: Entries = {
    "Complete runs": {
        "demo": Entry(
            "apps.paper.command",
            "Design, record, identify, validate and export on a bundled robot.",
            ("", "fleet -o demo"),
            "run_demo",
        ),
        "reproduce": Entry(
            "apps.paper.command",
            "Reproduce the 2015 paper, table by table and figure by figure.",
            ("", "-o paper"),
            "reproduce_paper",
        ),
    },
}
