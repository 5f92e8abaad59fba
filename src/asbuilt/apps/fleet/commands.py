"""What the command line knows of the commands of fleets."""

from __future__ import annotations

from asbuilt.cli import Entries, Entry

COMMANDS: Entries = {
    "Fleets": {
        "fleet": Entry(
            "apps.fleet.command",
            "Keep the information of many robots over time in a ledger.",
            (
                "add ledger ur10e logs/*.parquet --id-from {id}/*.parquet",
                "identify ledger --id arm-7 --since 2026-03-01",
            ),
            "",
            compiles=False,
        ),
    },
}

SUBCOMMANDS: Entries = {
    "fleet": {
        "add": Entry(
            "apps.fleet.command",
            "Reduce logs to their information and append it to a ledger.",
            (
                "ledger ur10e logs/arm-7/*.parquet --id arm-7",
                "s3://lab/fleet ur10e logs/*/*.csv --id-from {id}/*.csv",
            ),
            "add_logs",
        ),
        "rebuild": Entry(
            "apps.fleet.command",
            "Reduce logs of a ledger again, with settings chosen from all.",
            ("ledger logs/*/*.parquet", "ledger logs/*/*.csv --drive auto"),
            "rebuild_ledger",
        ),
        "show": Entry(
            "apps.fleet.command",
            "Show the robots of a ledger, their logs and settings.",
            ("ledger", "s3://lab/ledger --thorough --json"),
            "fleet_overview",
        ),
        "identify": Entry(
            "apps.fleet.command",
            "Identify a robot from the ledger alone, in any window of dates.",
            ("ledger --id arm-7", "ledger --id arm-7 --since 2026-03-01 -o study"),
            "fleet_identify",
        ),
        "drift": Entry(
            "apps.fleet.command",
            "Find the robots that changed: when, what and how large.",
            ("ledger", "ledger --since 2026-03-01 --json"),
            "fleet_drift",
        ),
        "report": Entry(
            "apps.fleet.command",
            "Write a page of each robot's history, those that changed first.",
            ("ledger --out page", "ledger --since 2026-03-01 -o page"),
            "write_fleet_report",
        ),
    },
}
