"""What the command line knows of the commands of link masses."""

from __future__ import annotations

from asbuilt.cli import Entries, Entry

COMMANDS: Entries = {
    "Robots": {
        "masses": Entry(
            "apps.masses.command",
            "Compute link masses from meshes and materials, or from a table.",
            (
                "my_robot.urdf --meshes meshes --material aluminium",
                "my_robot.urdf --table cad.csv --about com -o new.urdf",
            ),
            "link_masses",
            compiles=False,
        ),
    },
}
