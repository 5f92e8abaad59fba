"""Web server of the page: one user of this machine, who was shown its address.

The address holds a secret that opens the page in one browser, once; a cookie then stands for it.
Only requests to the server's own name are answered, and none that another page sends; the page asks
nothing of any other server.
"""

from __future__ import annotations

import json
import os
import re
import secrets
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import MappingProxyType
from typing import Any, NoReturn
from urllib.parse import quote, unquote

from asbuilt.apps.page.session import Session
from asbuilt.cli import describe_cure
from asbuilt.errors import AsbuiltError, UsageError
from asbuilt.untrusted import describe_problem
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
DEEPEST_UPLOAD = 16
"""Folders of an uploaded file, one in the other; a bag has two."""
LONGEST_NAME = 120
"""Bytes of the name of an uploaded file; file systems take 255."""
LONGEST_END = 5.0
"""Seconds in which an upload that is ended has removed what it wrote."""
LONGEST_REST = 1.0
"""Seconds in which the rest of a refused request is read."""
COOKIE = "asbuilt"
KINDS = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".json": "application/json",
    ".png": "image/png",
    ".svg": "image/svg+xml",
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

    A browser shows the secret of an address once and gets a cookie for it, which no script can
    read and no page of another site can use. The page then lies at a place that only this browser
    knows, so that other servers of this machine do not get the cookie.

    Parameters
    ----------
    session
        What the page shows.
    port
        Port, or the next free one of 20; 0: any.
    announce
        Called with the address for a further browser, when one has used its own.

    Raises
    ------
    UsageError
        If no port is free.
    """

    daemon_threads = True
    allow_reuse_address = False

    def __init__(
        self, session: Session, port: int, announce: Callable[[str], None] = lambda url: None
    ) -> None:
        self.session = session
        self.secret = secrets.token_urlsafe(24)
        self.place = secrets.token_urlsafe(24)
        self.cookie = secrets.token_urlsafe(24)
        self.announce = announce
        self._exchange = threading.Lock()
        self._open: dict[threading.Thread, socket.socket] = {}
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
        """Address that opens the page in one browser, with its secret."""
        return f"http://{self.hosts[0]}/{self.secret}/"

    @property
    def opener(self) -> Path:
        """File that leads a browser to the page, which only its owner can read."""
        return self.session.folder / "open-in-browser.html"

    def write_opener(self) -> Path:
        """Write the file that leads to the page: an argument of a program is seen by everyone."""
        lines = (
            '<!DOCTYPE html><meta charset="utf-8"><title>asbuilt</title>',
            '<meta name="referrer" content="no-referrer">',
            f'<meta http-equiv="refresh" content="0; url={self.url}">',
            f'<p><a href="{self.url}">Open the page of asbuilt</a></p>',
        )
        return atomic_write(self.opener, "\n".join(lines) + "\n", mode=0o600)

    def take_secret(self, given: str) -> bool:
        """Return whether a secret is the present one, which then is none any more."""
        with self._exchange:
            if not secrets.compare_digest(given.encode("utf-8", "replace"), self.secret.encode()):
                return False
            self.secret = secrets.token_urlsafe(24)
        self.opener.unlink(missing_ok=True)
        self.announce(self.url)
        return True

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Answer the requests of a connection, which is known until it ends."""
        self._open[threading.current_thread()] = request
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._open.pop(threading.current_thread(), None)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say that a request failed, in a line."""
        print(f"asbuilt: a request failed: {sys.exc_info()[1]}", file=sys.stderr)

    def server_close(self) -> None:
        """End every connection, so that uploads remove what they have written, and wait for it."""
        super().server_close()
        for thread, connection in tuple(self._open.items()):
            with suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
            thread.join(LONGEST_END)
        self.opener.unlink(missing_ok=True)


class Refused(Exception):  # noqa: N818 - what happened, not a fault of the program
    """End a request that was answered by an error."""


class Handler(BaseHTTPRequestHandler):
    """Answer one request."""

    server: PageServer
    server_version = "asbuilt"
    sys_version = ""
    protocol_version = "HTTP/1.1"
    timeout = 60.0

    def do_GET(self) -> None:
        """Answer with the page, its state, an answer of a step, or a file that was written."""
        if self.headers.get("Content-Length", "0") != "0" or "Transfer-Encoding" in self.headers:
            self._refuse(HTTPStatus.BAD_REQUEST)
        self._check_sender()
        if self._exchange_secret():
            return
        place = self._read_place()
        session = self.server.session
        if place == "state":
            session.follow()
            self._send_json(session.as_document())
        elif place.startswith("answer/"):
            key = place.removeprefix("answer/")
            self._send_json({"key": key, "answer": session.find_answer(key)})
        elif place.startswith("files/"):
            self._send_file(self._find_written(place.removeprefix("files/")), FRAMED)
        else:
            self._send_file(_find_resource(place or "page.html"), OWN)

    def do_POST(self) -> None:
        """Change what is chosen, write a sheet, start a step, or end it."""
        self._check_sender()
        place = self._read_place()
        session = self.server.session
        try:
            given = self._read_body()
            if place == "state":
                session.choose(given)
            elif place == "logs":
                session.use_logs(given.get("paths"), given.get("use"))
            elif place == "option":
                session.set_option(given.get("line"), given.get("option"), given.get("value"))
            elif place == "sheet":
                session.assign(given.get("columns"))
            elif place == "batch":
                self._send_json({"batch": session.make_batch()})
                return
            elif place == "sample":
                session.run_sample()
            elif place == "cancel":
                session.cancel()
            elif place.startswith("run/"):
                session.run(place.removeprefix("run/"), given)
            else:
                self.send_error(HTTPStatus.NOT_FOUND)
                return
        except (AsbuiltError, OSError) as problem:
            self._send_problem(problem)
            return
        self._send_json(session.as_document())

    def do_PUT(self) -> None:
        """Write an uploaded file, piece by piece, into the folder of its batch."""
        self._check_sender()
        place = self._read_place()
        size = self._read_size(LARGEST_UPLOAD)
        first, *names = place.split("/")
        if first != "files" or not 2 <= len(names) <= DEEPEST_UPLOAD:
            self._refuse(HTTPStatus.NOT_FOUND)
        path = self.server.session.uploads.joinpath(*map(_clean_file_name, names))

        def pieces(left: int) -> Iterator[bytes]:
            while left:
                piece = self.rfile.read(min(CHUNK, left))
                if not piece:
                    raise UsageError("the upload ended early; send the file again")
                left -= len(piece)
                yield piece

        try:
            atomic_write(path, pieces(size), create=True)
        except FileExistsError:
            self.close_connection = True
            self._send_problem(UsageError(f"{path.name} was sent before"))
        except (AsbuiltError, ConnectionError, TimeoutError) as problem:
            self.close_connection = True
            self._send_problem(problem)
        else:
            self._send_json({"path": str(path)})

    def _refuse(self, status: HTTPStatus) -> NoReturn:
        """Send an error to the browser, and end the request and its connection."""
        self.send_error(status)
        raise Refused

    def _check_sender(self) -> None:
        """Refuse a request by another name than ours, or from a page that is not ours."""
        hosts = self.server.hosts
        origin = self.headers.get("Origin")
        asked_here = origin in {f"http://{host}" for host in hosts}
        if self.headers.get("Host", "") not in hosts or not (
            asked_here or (origin is None and self.command == "GET")
        ):
            self._refuse(HTTPStatus.FORBIDDEN)

    def _exchange_secret(self) -> bool:
        """Answer the address with the secret by a cookie and a way to the page, once."""
        secret, _, rest = self.path.removeprefix("/").partition("/")
        if rest or not self.server.take_secret(secret):
            return False
        place = f"/{self.server.place}/"
        # A redirection would go without the cookie: its request comes from where the link was.
        text = (
            '<!DOCTYPE html><title>asbuilt</title><link rel="icon" href="data:,">'
            f'<meta http-equiv="refresh" content="0; url={place}">'
        )
        cookie = f"{COOKIE}={self.server.cookie}; Path={place}; HttpOnly; SameSite=Strict"
        self._send_text(text, KINDS[".html"], more={"Set-Cookie": cookie})
        return True

    def _read_place(self) -> str:
        """Return what is asked for; refuse a request without the cookie, or of another place."""
        place, _, rest = self.path.partition("?")[0].removeprefix("/").partition("/")
        pairs = (pair.strip().partition("=") for pair in self.headers.get("Cookie", "").split(";"))
        cookies = {name: value for name, _, value in pairs}
        for given, own in (
            (place, self.server.place),
            (cookies.get(COOKIE, ""), self.server.cookie),
        ):
            if not secrets.compare_digest(given.encode("utf-8", "replace"), own.encode()):
                self._refuse(HTTPStatus.FORBIDDEN)
        return unquote(rest)

    def _read_size(self, most: float) -> int:
        """Return the length of what is sent; refuse the request if it is unknown or too large."""
        text = self.headers.get("Content-Length", "")
        if "Transfer-Encoding" in self.headers or not text:
            self._refuse(HTTPStatus.LENGTH_REQUIRED)
        if not re.fullmatch(r"[0-9]{1,20}", text) or int(text) > most:
            self._refuse(HTTPStatus.REQUEST_ENTITY_TOO_LARGE)
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
        try:
            folder = self.server.session.folder.resolve()
            path = (folder / place).resolve()
            is_written = path.is_relative_to(folder) and path.is_file()
        except (OSError, ValueError, RuntimeError):
            return None
        return path if is_written and path != self.server.opener.resolve() else None

    def _send_file(self, path: Path | None, policy: str) -> None:
        try:
            stream = None if path is None else path.open("rb")
        except OSError:
            stream = None
        if stream is None or path is None:
            self.send_error(HTTPStatus.NOT_FOUND)
            return
        kind = KINDS.get(path.suffix)
        with stream:
            left = os.fstat(stream.fileno()).st_size
            more = {} if kind else {"Content-Disposition": _name_download(path.name)}
            self._send_head(left, kind or "application/octet-stream", policy, more=more)
            while piece := stream.read(min(CHUNK, left)):
                self.wfile.write(piece)
                left -= len(piece)
        if left:  # the file has become shorter since
            self.close_connection = True

    def _send_problem(self, problem: Exception) -> None:
        """Send an error of the program as a sentence."""
        if isinstance(problem, AsbuiltError):
            hint = describe_cure(problem.cure)
            text = problem.message + (f"; {hint}" if hint else "")
        else:
            text = describe_problem(problem)
        self._send_json({"error": text}, HTTPStatus.CONFLICT)

    def _send_json(self, document: Any, status: HTTPStatus = HTTPStatus.OK) -> None:
        self._send_text(json.dumps(document), KINDS[".json"], status)

    def _send_text(
        self,
        text: str,
        kind: str,
        status: HTTPStatus = HTTPStatus.OK,
        more: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        content = text.encode()
        self._send_head(len(content), kind, OWN, status, more)
        if self.command != "HEAD":
            self.wfile.write(content)

    def _send_head(
        self,
        size: int,
        kind: str,
        policy: str,
        status: HTTPStatus = HTTPStatus.OK,
        more: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        self.send_response(status)
        for name, value in {
            "Content-Type": kind,
            "Content-Length": str(size),
            "Content-Security-Policy": policy,
            "X-Content-Type-Options": "nosniff",
            "Referrer-Policy": "no-referrer",
            "Cross-Origin-Resource-Policy": "same-origin",
            "Cache-Control": "no-store",
            **({"Connection": "close"} if self.close_connection else {}),
            **more,
        }.items():
            self.send_header(name, value)
        self.end_headers()

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Send a status in one line, and end the connection: what follows was not read."""
        self.close_connection = True
        self.request_version = self.protocol_version  # else one that was not read has no headers
        status = HTTPStatus(code)
        text = f"{status.value} {status.phrase}\n"
        if status is HTTPStatus.FORBIDDEN:
            text += (
                "The address that asbuilt shows opens the page in one browser, once. For another"
                " browser, or after a restart, use the last address in the terminal.\n"
            )
        self._send_text(text, "text/plain; charset=utf-8", status)

    def finish(self) -> None:
        """End the connection; what is still sent is read for a moment.

        Else the system takes the answer back from a browser that is still sending.
        """
        super().finish()
        with suppress(OSError):
            self.connection.shutdown(socket.SHUT_WR)
            self.connection.settimeout(LONGEST_REST)
            end = time.monotonic() + LONGEST_REST
            while time.monotonic() < end and self.connection.recv(CHUNK):
                pass

    def log_message(self, format: str, *args: Any) -> None:
        """Keep quiet: the terminal shows the address alone."""

    def handle_one_request(self) -> None:
        """Answer a request; a browser that goes away is no error."""
        with suppress(ConnectionError, socket.timeout, Refused):
            super().handle_one_request()
            return
        self.close_connection = True


def _name_download(name: str) -> str:
    r"""Return the header that names a download: ASCII for old browsers, UTF-8 for the others.

    >>> _name_download("é\r\nX-Evil: 1.bin")
    'attachment; filename="___X-Evil: 1.bin"; filename*=UTF-8\'\'%C3%A9%0D%0AX-Evil%3A%201.bin'
    """
    plain = re.sub(r'[^ -~]|["\\%]', "_", name)
    return f"attachment; filename=\"{plain}\"; filename*=UTF-8''{quote(os.fsencode(name), safe='')}"


def _find_resource(name: str) -> Path | None:
    """Return a file of the page, or the style of reports that it shares; None for others."""
    from asbuilt.writers import REPORT_TEMPLATES

    own = Path(__file__).parent / "templates"
    folders = {path.name: own for path in own.iterdir()}
    folders |= dict.fromkeys(("report.css", "plot.js"), REPORT_TEMPLATES)
    return folders[name] / name if name in folders else None


def _clean_file_name(name: str) -> str:
    """Return a name that is one of a file in this folder, whatever was sent.

    >>> _clean_file_name("../../.bashrc"), _clean_file_name("run 1.csv")
    ('bashrc', 'run_1.csv')
    """
    last = name.replace("\\", "/").rsplit("/", maxsplit=1)[-1]
    clean = re.sub(r"[^\w.+-]", "_", last).lstrip(".-").encode("utf-8", "replace")
    return clean[-LONGEST_NAME:].decode("utf-8", "ignore").lstrip(".-") or "file"
