"""Any app can be taken away: the rest is imported, and the command line says what is absent."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from without_apps import copy_source, list_apps

IMPORT_ALL = """
import contextlib, importlib, pkgutil, asbuilt
for found in pkgutil.walk_packages(asbuilt.__path__, "asbuilt."):
    if not found.name.endswith("__main__"):
        importlib.import_module(found.name)
for name in asbuilt.__all__:
    getattr(asbuilt, name)
from asbuilt.cli.app import main
with contextlib.suppress(SystemExit):
    main(["--help"])
from asbuilt.cli.commands import ABSENT
for name in ABSENT:
    try:
        main([name])
    except SystemExit as end:
        print("ABSENT", name, ABSENT[name], end.code)
"""


@pytest.mark.study
@pytest.mark.parametrize("app", list_apps())
def test_what_is_left_without_an_app_runs(app: str, tmp_path: Path) -> None:
    environment = copy_source(tmp_path, [app])
    done = subprocess.run(
        [sys.executable, "-c", IMPORT_ALL],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "Usage: asbuilt" in done.stdout
    assert "identify" in done.stdout
    absent = [line.split()[1:] for line in done.stdout.splitlines() if line.startswith("ABSENT")]
    assert all(of == app and status == "2" for _, of, status in absent)
    complaints = done.stderr.splitlines()
    assert len([line for line in complaints if f"the app {app}" in line]) == len(absent)
