"""Whether what asbuilt prints is what the log determines: a table for each kind of statement.

    python benchmarks/determined.py [TABLE...] [--robots N] [--workers N]

false_errors
    `check` on sound logs of virtual robots whose descriptions are wrong (`sound_logs`).
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor

from sound_logs import false_errors

ROBOTS = 200

TABLES = {"false_errors": false_errors}


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("tables", nargs="*", help=f"{', '.join(TABLES)} (default: all)")
    parser.add_argument("--robots", type=int, default=ROBOTS)
    parser.add_argument("--workers", type=int, default=1)
    given = parser.parse_args()
    with ProcessPoolExecutor(given.workers) as pool:
        for name in given.tables or TABLES:
            TABLES[name](given.robots, pool.map)


if __name__ == "__main__":
    main()
