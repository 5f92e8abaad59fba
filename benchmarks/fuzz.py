"""Fuzz the readers: random mutations of good files until the time is up.

    python benchmarks/fuzz.py --seconds 3600 --out out/fuzz
    python benchmarks/fuzz.py --bounds

Every input must end in a command's exit status 0, 1 or 2 without an unexpected error. An input that
does not is saved with its command as a reproducer, and the exit status is 1. `--bounds` prints time
and peak memory of inputs that are huge, endless or too deep, slowest first, each in a process of
its own; the exit status is 1 if one takes more than 2 s or 500 MB.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import random
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from asbuilt.cli.app import main
from robustness import bounds, corpus

HANG = 60
"""Seconds after which an input counts as hung; a damaged bag may take 10."""


def seeds() -> dict[str, tuple[tuple[str, ...], dict[str, bytes], str]]:
    """Good inputs by name: command, files, and the file that is mutated."""
    log = corpus.csv_log().encode()
    found: dict[str, tuple[tuple[str, ...], dict[str, bytes], str]] = {}
    for suffix, text in corpus.ROBOTS.items():
        found[f"robot{suffix}"] = (("show", f"@a{suffix}"), {f"a{suffix}": text.encode()}, suffix)
    for suffix, data in {".csv": log, **corpus.binary_logs()}.items():
        found[f"log{suffix}"] = (
            ("check", "two-link", f"@a{suffix}"), {f"a{suffix}": data}, suffix,
        )  # fmt: skip
    found["sheet.toml"] = (
        ("check", "two-link", "@a.csv", "--sheet", "@s.toml"),
        {"a.csv": log, "s.toml": corpus.SHEET.encode()},
        ".toml",
    )
    return found


def mutated(data: bytes, rng: random.Random) -> bytes:
    """Damage bytes, or numbers of a text, one to four times."""
    for _ in range(rng.randrange(1, 5)):
        if len(data) < 2:
            return data
        if rng.random() < 0.3 and data.isascii():
            found = [*corpus.numbers_replaced(data.decode())]
            if found:
                data = rng.choice(found)[1].encode()
                continue
        data = rng.choice([*corpus.damaged(data, rng, 5)])[1]
    return data


def run(case: corpus.Case, folder: Path) -> str:
    """Run one case; return what is wrong, an empty text if nothing is."""
    err = io.StringIO()
    signal.alarm(HANG)
    try:
        with contextlib.redirect_stderr(err), contextlib.redirect_stdout(io.StringIO()):
            main(case.written(folder))
    except SystemExit as end:
        if end.code not in (None, 0, 1, 2) or "unexpected" in err.getvalue():
            return f"status {end.code}: {err.getvalue()[-500:]}"
    except BaseException:
        return traceback.format_exc()[-1500:]
    finally:
        signal.alarm(0)
    return ""


def hung(*_: object) -> None:
    raise TimeoutError("the input hangs")


def fuzz(seconds: float, seed: int, out: Path) -> int:
    """Return the number of failures."""
    rng, begun = random.Random(seed), time.monotonic()
    good, tried, failures = seeds(), Counter[str](), 0
    signal.signal(signal.SIGALRM, hung)
    with tempfile.TemporaryDirectory() as place:
        while time.monotonic() < begun + seconds:
            name = rng.choice([*good])
            arguments, files, suffix = good[name]
            target = next(key for key in files if key.endswith(suffix))
            spoilt = files | {target: mutated(files[target], rng)}
            case = corpus.Case(name, arguments, spoilt)
            tried[name] += 1
            wrong = run(case, Path(place))
            if wrong:
                failures += 1
                saved = out / f"{failures:03d}"
                saved.mkdir(parents=True, exist_ok=True)
                case.written(saved)
                (saved / "command.txt").write_text(f"{' '.join(arguments)}\n\n{wrong}\n")
                print(f"FAILED {name}, saved in {saved}: {wrong.splitlines()[-1][:200]}")
    for name, count in sorted(tried.items()):
        print(f"{name:16} {count:6}")
    print(f"{tried.total()} inputs, {failures} failures, seed {seed}")
    return failures


def report_bounds(shown: int = 15) -> int:
    """Print the slowest and largest cases; return how many are beyond the bounds."""
    found = sorted(bounds.costs(), key=lambda cost: -cost.seconds)
    print(f"{'seconds':>8} {'MB':>6}  status  case")
    largest = sorted(found, key=lambda cost: -cost.megabytes)[:5]
    for cost in [*found[:shown], *(each for each in largest if each not in found[:shown])]:
        name = f"{cost.group}: {cost.name}"
        print(f"{cost.seconds:8.2f} {cost.megabytes:6.0f}  {cost.status:6}  {name[:80]}")
    slow = sum(cost.seconds > bounds.SLOWEST for cost in found)
    large = sum(cost.megabytes > bounds.LARGEST for cost in found)
    print(
        f"{len(found)} inputs: {slow} beyond {bounds.SLOWEST:g} s, {large} beyond"
        f" {bounds.LARGEST:g} MB; median {found[len(found) // 2].seconds:.2f} s"
    )
    return slow + large


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=3600.0)
    parser.add_argument("--seed", type=int, default=int(time.time()))
    parser.add_argument("--out", type=Path, default=Path("out/fuzz"))
    parser.add_argument("--bounds", action="store_true")
    given = parser.parse_args()
    if given.bounds:
        sys.exit(1 if report_bounds() else 0)
    sys.exit(1 if fuzz(given.seconds, given.seed, given.out) else 0)
