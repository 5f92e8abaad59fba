"""Inputs that are huge, endless or too deep are refused within 500 MB.

Their times are in `benchmarks/fuzz.py --bounds`.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
from pathlib import Path

import pytest

from robustness import bounds

PROGRAM = Path(bounds.__file__)
MOST_COMPUTING = 600
"""CPU seconds of the cases of some groups together; a busy machine does not use them up sooner."""


def limit_computing() -> None:
    resource.setrlimit(resource.RLIMIT_CPU, (MOST_COMPUTING, MOST_COMPUTING))


@pytest.mark.skipif(sys.platform != "linux", reason="needs /proc")
@pytest.mark.parametrize("groups", bounds.TOGETHER, ids="-".join)
@pytest.mark.study
def test_refused_within_500_megabytes(groups: tuple[str, ...]) -> None:
    """All cases of some groups run in one process, whose peak bounds that of each."""
    done = subprocess.run(
        [sys.executable, str(PROGRAM), "--together", *groups],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True, text=True, check=False, preexec_fn=limit_computing,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    costs = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(costs) == sum(len(bounds.cases()[group]) for group in groups)
    beyond = [each for each in costs if each["megabytes"] > bounds.LARGEST]
    assert not beyond, beyond[0]
    assert all(each["status"] for each in costs if each["group"] != "sheets")


def test_every_group_is_run() -> None:
    assert {group for groups in bounds.TOGETHER for group in groups} == set(bounds.cases())
