"""The command that opens the page in the browser."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

from asbuilt.apps.page.choices import Choices
from asbuilt.apps.page.server import PageServer
from asbuilt.apps.page.session import Session
from asbuilt.cli import AsJson, Browser, Out, PagePort, answer, complete_robot, serve_page
from asbuilt.errors import UsageError


def open(
    robot: Annotated[
        str | None,
        typer.Argument(
            metavar="[ROBOT]",
            autocompletion=complete_robot,
            help="a bundled robot or its file; can be chosen on the page",
        ),
    ] = None,
    log: Annotated[
        list[Path] | None,
        typer.Argument(metavar="[LOG...]", help="recordings; can be chosen on the page"),
    ] = None,
    *,
    port: PagePort = 8090,
    browser: Browser = True,
    out: Out = Path("study"),
    as_json: AsJson = False,
) -> None:
    """Open a page that leads from files to a trusted model.

    Drop a description and logs on it, correct what their columns were matched to, check, identify,
    switch effects, export. Every step is a command of this program, which the page shows. It runs
    on this machine, for whoever has its address; Ctrl-C ends it.
    """
    logs = tuple(str(path) for path in log or ())
    missing = next((path for path in logs if not Path(path).exists()), None)
    if missing is not None:
        raise UsageError(f"recording {missing} does not exist", file=missing)
    session = Session(out or Path("study"), Choices(robot or "", logs))
    try:
        server = PageServer(session, port, announce=_announce_next)
        start = server.write_opener().absolute().as_uri() if browser else ""
        answer(
            as_json,
            lambda: {"url": server.url, "folder": str(session.folder)},
            lambda: f"{server.url}\nResults are written to {session.folder}; Ctrl-C ends it.",
        )
        with server, _end_on_request():
            serve_page(start, server.serve_forever, browser=browser)
    finally:
        session.close()


def _announce_next(url: str) -> None:
    """Show the address for a further browser on stderr, for each one holds once."""
    print(f"opened; for another browser: {url}", file=sys.stderr, flush=True)


@contextmanager
def _end_on_request() -> Iterator[None]:
    """End as Ctrl-C does when the system asks to, so that no file is left half-written."""

    def end(number: int, frame: Any) -> NoReturn:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
