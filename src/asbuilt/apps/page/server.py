"""Web server of the page: one user of this machine, who has its address.

The address begins with a secret, without which nothing is answered. Only requests to the server's
own name are, and none that another page sends; the page asks nothing of any other server.
"""

from __future__ import annotations

import json
import re
import secrets
import socket
from collections.abc import Iterator
from contextlib import suppress
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Annotated, Any, NoReturn
from urllib.parse import unquote

import typer

from asbuilt.apps.page.session import Choices, Session
from asbuilt.cli import (
    AsJson,
    Browser,
    Out,
    PagePort,
    answer,
    complete_robot,
    describe_cure,
    serve_page,
)
from asbuilt.errors import AsbuiltError, UsageError
from asbuilt.writing import atomic_write

HOST = "127.0.0.1"
NAMES = (HOST, "localhost")
LAST_PORT_OFFSET = 20
"""How many ports after the wanted one are tried."""
LARGEST_UPLOAD = 4e9
"""Bytes of a file, as of logs that are read whole."""
LARGEST_REQUEST = 4_000_000
"""Bytes of a request that is no file: the choices of ten thousand columns take 1 MB."""
CHUNK = 1 << 20
KINDS = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".json": "application/json",
    ".png": "image/png",
}
"""Types of what is answered; other files are downloaded."""
OWN = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src"
    " 'self'; frame-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""What the page may load: files of this server alone."""
FRAMED = (
    "sandbox allow-scripts; default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval' blob:"
    " data:; style-src 'unsafe-inline'; img-src data: blob:; font-src data:; connect-src data:"
    " blob:; worker-src blob: data:; base-uri 'none'; form-action 'none'"
)
"""What a written page, such as a report, may load in its frame: nothing but itself."""


class PageServer(ThreadingHTTPServer):
    """Serve a session on this machine.

    Parameters
    ----------
    session
        What the page shows.
    port
        Port, or the next free one of 20; 0: any.

    Raises
    ------
    UsageError
        If no port is free.
    """

    daemon_threads = True
    allow_reuse_address = False

    def __init__(self, session: Session, port: int) -> None:
        self.session = session
        self.token = secrets.token_urlsafe(24)
        for tried in range(port, port + LAST_PORT_OFFSET + 1):
            with suppress(OSError, OverflowError):
                super().__init__((HOST, tried), Handler)
                return
        raise UsageError(f"no port from {port} to {port + LAST_PORT_OFFSET} is free", value=port)

    @property
    def hosts(self) -> tuple[str, ...]:
        """Names by which this server is asked."""
        return tuple(f"{name}:{self.server_address[1]}" for name in NAMES)

    @property
    def url(self) -> str:
        """Address of the page, with its secret."""
        return f"http://{self.hosts[0]}/{self.token}/"


class Refused(Exception):  # noqa: N818 - what happened, not a fault of the program
    """End a request that was answered by an error."""


class Handler(BaseHTTPRequestHandler):
    """Answer one request."""

    server: PageServer
    server_version, sys_version = "asbuilt", ""
    protocol_version = "HTTP/1.1"
    timeout = 60.0

    def do_GET(self) -> None:
        """Answer with the page, its state, an answer of a step, or a file that was written."""
        place = self._read_place()
        if place == "state":
            self._send_json(self.server.session.as_document())
        elif place.startswith("answer/"):
            self._send_json(
                self.server.session.answers.get(place.removeprefix("answer/"), ((), None))[1]
            )
        elif place.startswith("files/"):
            self._send_file(self._find_written(place.removeprefix("files/")), FRAMED)
        else:
            self._send_file(_find_resource(place or "page.html"), OWN)

    def do_POST(self) -> None:
        """Change what is chosen, write a sheet, start a step, or end it."""
        place = self._read_place()
        try:
            given = self._read_body()
            if place == "state":
                self.server.session.choose(given)
            elif place == "sheet":
                self.server.session.assign(given.get("columns", []))
            elif place == "cancel":
                self.server.session.cancel()
            elif place.startswith("run/"):
                self.server.session.run(place.removeprefix("run/"))
            else:
                self.send_error(HTTPStatus.NOT_FOUND)
                return
        except AsbuiltError as problem:
            hint = describe_cure(problem.cure)
            text = problem.message + (f"; {hint}" if hint else "")
            self._send_json({"error": text}, HTTPStatus.CONFLICT)
            return
        self._send_json(self.server.session.as_document())

    def do_PUT(self) -> None:
        """Write an uploaded file, piece by piece, into the folder of the page."""
        place, size = self._read_place(), self._read_size(LARGEST_UPLOAD)
        names = map(_clean_file_name, place.split("/")[1:])
        path = self.server.session.folder.joinpath("uploads", *names)

        def pieces(left: int) -> Iterator[bytes]:
            while left:
                piece = self.rfile.read(min(CHUNK, left))
                if not piece:
                    raise UsageError("the upload ended early; send the file again")
                left -= len(piece)
                yield piece

        try:
            atomic_write(path, pieces(size))
        except AsbuiltError as problem:
            self.close_connection = True
            self._send_json({"error": problem.message}, HTTPStatus.CONFLICT)
            return
        self._send_json({"path": str(path)})

    def _refuse(self, status: HTTPStatus) -> NoReturn:
        """Send an error to the browser, and end the request and its connection."""
        self.send_error(status)
        raise Refused

    def _read_place(self) -> str:
        """Return what is asked for; refuse the request if that is not allowed."""
        token, _, place = self.path.partition("?")[0].removeprefix("/").partition("/")
        hosts, origin = self.server.hosts, self.headers.get("Origin")
        own = self.headers.get("Host", "") in hosts
        asked_here = origin in {f"http://{host}" for host in hosts}
        allowed = own and (asked_here if origin or self.command != "GET" else True)
        if not allowed or not secrets.compare_digest(token.encode(), self.server.token.encode()):
            self._refuse(HTTPStatus.FORBIDDEN)
        return unquote(place)

    def _read_size(self, most: float) -> int:
        """Return the length of what is sent; refuse the request if it is unknown or too large."""
        text = self.headers.get("Content-Length", "")
        if not text.isdecimal() or int(text) > most:
            self._refuse(
                HTTPStatus.REQUEST_ENTITY_TOO_LARGE if text else HTTPStatus.LENGTH_REQUIRED
            )
        return int(text)

    def _read_body(self) -> dict[str, Any]:
        size = self._read_size(LARGEST_REQUEST)
        try:
            given = json.loads(self.rfile.read(size) or b"{}")
        except (ValueError, RecursionError):
            given = None
        if not isinstance(given, dict):
            raise UsageError("the request is not a JSON object")
        return given

    def _find_written(self, place: str) -> Path | None:
        """Return a file of the folder, None if it is none or lies elsewhere."""
        folder = self.server.session.folder.resolve()
        path = (folder / place).resolve()
        return path if path.is_relative_to(folder) and path.is_file() else None

    def _send_file(self, path: Path | None, policy: str) -> None:
        if path is None:
            self.send_error(HTTPStatus.NOT_FOUND)
            return
        kind = KINDS.get(path.suffix)
        with path.open("rb") as stream:
            self._send_head(path.stat().st_size, kind or "application/octet-stream", policy)
            if kind is None:
                self.send_header("Content-Disposition", f'attachment; filename="{path.name}"')
            self.end_headers()
            while piece := stream.read(CHUNK):
                self.wfile.write(piece)

    def _send_json(self, document: Any, status: HTTPStatus = HTTPStatus.OK) -> None:
        content = json.dumps(document).encode()
        self._send_head(len(content), KINDS[".json"], OWN, status)
        self.end_headers()
        self.wfile.write(content)

    def _send_head(
        self, size: int, kind: str, policy: str, status: HTTPStatus = HTTPStatus.OK
    ) -> None:
        self.send_response(status)
        for name, value in (
            ("Content-Type", kind),
            ("Content-Length", str(size)),
            ("Content-Security-Policy", policy),
            ("X-Content-Type-Options", "nosniff"),
            ("Referrer-Policy", "no-referrer"),
            ("Cross-Origin-Resource-Policy", "same-origin"),
            ("Cache-Control", "no-store"),
        ):
            self.send_header(name, value)

    def log_message(self, format: str, *args: Any) -> None:
        """Keep quiet: the terminal shows the address alone."""

    def handle_one_request(self) -> None:
        """Answer a request; a browser that goes away is no error."""
        with suppress(ConnectionError, socket.timeout, Refused):
            super().handle_one_request()
            return
        self.close_connection = True


def _find_resource(name: str) -> Path | None:
    """Return a file of the page, or the style of reports that it shares; None for others."""
    from asbuilt.writers import REPORT_TEMPLATES

    own = Path(__file__).parent / "templates"
    folders = dict.fromkeys(("page.html", "page.js", "page.css"), own)
    folders |= dict.fromkeys(("report.css", "plot.js"), REPORT_TEMPLATES)
    return folders[name] / name if name in folders else None


def _clean_file_name(name: str) -> str:
    """Return a name that is one of a file in this folder, whatever was sent.

    >>> _clean_file_name("../../.bashrc"), _clean_file_name("run 1.csv")
    ('bashrc', 'run_1.csv')
    """
    last = name.replace("\\", "/").rsplit("/", maxsplit=1)[-1]
    return re.sub(r"[^\w.+-]", "_", last).lstrip(".-")[-100:] or "file"


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
        server = PageServer(session, port)
        answer(
            as_json,
            lambda: {"url": server.url, "folder": str(session.folder)},
            lambda: f"{server.url}\nResults are written to {session.folder}; Ctrl-C ends it.",
        )
        with server:
            serve_page(server.url, server.serve_forever, browser=browser)
    finally:
        session.close()
