"""Run the command line as `python -m asbuilt`."""

from asbuilt.cli import run

run()
