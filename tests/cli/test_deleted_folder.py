"""A current folder that was deleted is one error."""

import os
import subprocess
import sys

import pytest


@pytest.mark.study
def test_a_current_folder_that_was_deleted_is_one_error(tmp_path):
    gone = tmp_path / "gone"
    gone.mkdir()
    program = f"import os; os.rmdir({str(gone)!r}); from asbuilt.cli import run; run()"
    done = subprocess.run(
        [sys.executable, "-c", program, "robots"],
        cwd=gone,
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ},
    )
    assert done.returncode == 1
    assert done.stderr.startswith("asbuilt: the current folder does not exist any more")
    assert "Traceback" not in done.stderr
