"""The command that opens the page: open."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer

from asbuilt.cli.answers import answer
from asbuilt.cli.arguments.options import AsJson, Browser, Out, PagePort, complete_robot
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
    from asbuilt.cli.page.server import PageServer
    from asbuilt.cli.page.session import Choices, Session

    logs = tuple(str(path) for path in log or ())
    missing = next((path for path in logs if not Path(path).exists()), None)
    if missing is not None:
        raise UsageError(f"recording {missing} does not exist", file=missing)
    session = Session(out or Path("study"), Choices(robot or "", logs))
    try:
        server = PageServer(session, port)
        answer(
            as_json,
            lambda: {"url": server.url, "folder": str(session.folder)},
            lambda: f"{server.url}\nResults are written to {session.folder}; Ctrl-C ends it.",
        )
        if browser:
            import webbrowser

            webbrowser.open(server.url)
        with suppress(KeyboardInterrupt), server:
            server.serve_forever()
    finally:
        session.close()
