"""The registry of estimators; one that another distribution adds is in `test_extending`."""

from __future__ import annotations

import os
import subprocess
import sys


def run(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *map(str, arguments)],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
        check=False,
    )


def test_help_imports_no_estimator():
    code = (
        "import sys\n"
        "from asbuilt.cli.app import main\n"
        "try:\n    main(['--help'])\nexcept SystemExit:\n    pass\n"
        "loaded = [name for name in sys.modules if '.identification.estimators.' in name]\n"
        "sys.exit(str(loaded) if loaded else 0)\n"
    )
    found = run("-c", code)
    assert found.returncode == 0, found.stderr
