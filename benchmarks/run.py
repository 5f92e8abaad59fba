"""Run every benchmark beside this file in one go, print the numbers with ratios to the peers, and
write them as JSON.

Each benchmark is a module with `measure() -> dict[str, float | str]`; a key that ends in
`_us_per_sample`, `_s`, `_ms` or `_mb` carries its unit, and a key that starts with `ratio_` says
how many times faster than the peer it names.
"""

from __future__ import annotations

import argparse
import importlib.util
import inspect
import json
import os
import platform
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent


def main() -> None:
    """Run, print, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--out", type=Path, default=Path("out/bench.json"), help="JSON file to write"
    )
    parser.add_argument(
        "--data",
        type=Path,
        help="folder with recordings in data/ and robots in models/ (default: ../shared)",
    )
    parser.add_argument(
        "--search-s",
        type=float,
        help="what the long search for the best motion may take [s] (default: 240)",
    )
    parser.add_argument(
        "--time-limit",
        type=float,
        help="what each design in the table of designs may take [s] (default: no limit)",
    )
    parser.add_argument("names", nargs="*", help="benchmarks to run (default: all)")
    arguments = parser.parse_args()
    available = sorted(path.stem for path in HERE.glob("*.py") if path.stem != "run")
    unknown = sorted(set(arguments.names) - set(available))
    if unknown:
        parser.error(f"no benchmark {unknown[0]!r}; there are: {', '.join(available)}")
    sys.path.insert(0, str(HERE))
    report: dict[str, object] = {
        "machine": {
            "processor": platform.processor() or platform.machine(),
            "cores": os.cpu_count(),
        }
    }
    for name in arguments.names or available:
        spec = importlib.util.spec_from_file_location(name, HERE / f"{name}.py")
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        if not hasattr(module, "measure"):
            continue
        print(f"{name}: {(module.__doc__ or '').strip().splitlines()[0]}", flush=True)
        wanted = {
            key: getattr(arguments, key, None)
            for key in inspect.signature(module.measure).parameters
        }
        numbers = module.measure(
            **{key: value for key, value in wanted.items() if value is not None}
        )
        report[name] = numbers
        for key, value in numbers.items():
            print(
                (
                    f"  {key:<52} {value:>12.4g}"
                    if isinstance(value, int | float)
                    else f"  {key:<52} {value}"
                ),
                flush=True,
            )
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(json.dumps(report, indent=2) + "\n")
    print(f"written: {arguments.out}")


if __name__ == "__main__":
    main()
