"""Whatever is asked of the server, it gives one clean answer."""

from __future__ import annotations

import json
import random
import socket
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pytest

from asbuilt.apps.page import session as page_session
from asbuilt.apps.page.choices import LINES, Choices, list_options
from asbuilt.apps.page.server import PageServer
from asbuilt.apps.page.session import STEPS, Session
from faked_commands import FakedWorker

pytestmark = pytest.mark.study
REQUESTS = 500
STATUSES = {200, 400, 403, 404, 409, 411, 413, 414, 431, 501, 505}
"""What a request may be answered by; 500 is a fault of ours."""
NAMES = (
    "log.csv", "résumé.csv", "中文.csv", "a\r\nX-Evil: 1.csv", "a\0b", "x" * 300, "../../x", ".",
    "", "..", "a/b/c.csv", "/etc/passwd", "-o", "'\"", "\ud800", "a" * 5000, "%2e%2e",
    "\x7f\x1b[31m", "open-in-browser.html", "result.json", "con", "a?b#c", "a\\b", "\udcff.csv",
)  # fmt: skip
VALUES: tuple[Any, ...] = (
    *NAMES, None, True, 0, -1, 1e308, 10**400, [], {}, [[]], [None], ["a", 1], {"a": {}}, "NaN",
    "--trust-xacro", "--rate", "--rate 100", "--mcap /tmp/x", "-o /tmp", "urdf", "reading", "100",
)  # fmt: skip
FIELDS = (
    "robot", "logs", "validation", "reading", "options", "effects", "export", "line", "option",
    "value", "columns", "name", "quantity", "joint", "unknown", "paths", "use",
)  # fmt: skip


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[PageServer]:
    monkeypatch.setattr(page_session, "Worker", FakedWorker)
    log = tmp_path / "log.csv"
    log.write_text("t\n")
    served = PageServer(Session(tmp_path / "study", Choices("ur10e", (str(log),))), 0)
    thread = threading.Thread(target=served.serve_forever, daemon=True)
    thread.start()
    yield served
    served.shutdown()
    served.server_close()
    served.session.close()
    thread.join()


def draw_place(rng: random.Random, server: PageServer) -> str:
    """A place of the page or near one, as it stands in a request."""
    name = quote(rng.choice(NAMES), safe=rng.choice(("", "/", "/%")), errors="surrogatepass")
    step = rng.choice((*STEPS, "sample", name))
    own = (
        "", "state", "logs", "option", "sheet", "batch", "sample", "cancel", f"run/{step}",
        f"answer/{name}", f"files/{name}", f"files/1/{name}", f"files/uploads/{name}", "page.js",
        "sample.svg", "plot.js", "page.py", name,
    )  # fmt: skip
    place = f"/{server.place}/{rng.choice(own)}"
    return rng.choice((*9 * (place,), "/", f"/{name}", "*", "//", f"http://x/{name}", f"{place}?a"))


def draw_value(rng: random.Random, depth: int = 0) -> Any:
    """A JSON value that the page may send, or almost."""
    kind = rng.randrange(6 if depth < 3 else 4)
    if kind < 4:
        return rng.choice((*VALUES, *list_options(rng.choice([*LINES]))))
    if kind == 4:
        return [draw_value(rng, depth + 1) for _ in range(rng.randrange(4))]
    return {rng.choice(FIELDS): draw_value(rng, depth + 1) for _ in range(rng.randrange(5))}


def draw_column(rng: random.Random) -> Any:
    """An entry of a sheet's columns that is sound, or lacks something."""
    entry: dict[str, Any] = {
        "name": rng.choice(("t", "position_elbow", "torque_elbow", "torque_wrist", *NAMES)),
        "quantity": rng.choice(("", "time", "position", "torque", "mass", None)),
        "joint": rng.choice(("", "elbow", "wrist", "of the log", 3)),
    }
    if rng.random() < 0.3:
        del entry[rng.choice([*entry])]
    return entry if rng.random() < 0.9 else draw_value(rng)


def draw_body(rng: random.Random) -> bytes:
    """A body: JSON of the page's kind, mostly."""
    given = draw_value(rng)
    if rng.random() < 0.5:
        given = {name: draw_value(rng) for name in rng.sample(FIELDS, rng.randrange(5))}
    if rng.random() < 0.3:
        given = {"columns": [draw_column(rng) for _ in range(rng.randrange(6))]}
    text = json.dumps(given).encode()
    return rng.choice((*9 * (text,), b"", text[:-1], b"[" * 9999, b"9" * 9999, b"\xff\x00", b"NaN"))


SOUND: tuple[tuple[str, str, Any], ...] = (
    ("GET", "", None),
    ("GET", "state", None),
    ("GET", "page.js", None),
    ("POST", "batch", {}),
    ("POST", "cancel", {}),
    ("POST", "run/identify", {"effects": ""}),
    ("POST", "run/export", {"export": "mjcf"}),
    ("POST", "state", {"reading": "--rate 100"}),
    ("POST", "option", {"line": "options", "option": "--mounting", "value": "estimate"}),
    ("POST", "state", {"robot": "ur10e", "validation": []}),
)
"""What the page asks, by which the session gets to where the strange requests find it."""


def draw_request(rng: random.Random, server: PageServer) -> bytes:
    """A whole request, with headers that are right, wrong, twice there or missing."""
    method = rng.choice((*4 * ("GET",), *6 * ("POST",), *3 * ("PUT",), "HEAD", "DELETE", "\u00e9"))
    body = b"" if method == "GET" and rng.random() < 0.95 else draw_body(rng)
    place = draw_place(rng, server)
    if rng.random() < 0.35:
        method, own, given = rng.choice(SOUND)
        place = f"/{server.place}/{own}"
        body = b"" if given is None else json.dumps(given).encode()
    host = server.hosts[0]
    size = str(len(body))
    headers = {"Host": host, "Origin": f"http://{host}", "Cookie": f"asbuilt={server.cookie}"}
    lengths = (*60 * (size,), "9" * 5000, "-1", "1_0", "+1", "\u00b2", "1e9", "99999999999", "")
    headers["Content-Length"] = rng.choice(lengths)
    if rng.random() < 0.1:
        del headers[rng.choice([*headers])]
    strange = ("", "null", "x" * 70_000, "\u00e9\u00ff", "a=b;;=", f"asbuilt={server.cookie};" * 2)
    if rng.random() < 0.1:
        headers[rng.choice([*headers])] = rng.choice(strange)
    if rng.random() < 0.05:
        headers["Transfer-Encoding"] = "chunked"
    version = rng.choice((*60 * ("HTTP/1.1",), "HTTP/1.0", "HTTP/2.0", "HTTP/9", "x"))
    lines = [f"{method} {place} {version}"]
    lines += [f"{name}: {value}" for name, value in headers.items()]
    return "\r\n".join(lines).encode("latin-1", "replace") + b"\r\n\r\n" + body


def send(server: PageServer, request: bytes) -> bytes:
    """All that comes back for a request, after which nothing is sent."""
    with socket.create_connection(server.server_address, timeout=600) as connection:
        reply = b""
        with suppress(OSError):
            connection.sendall(request)
            connection.shutdown(socket.SHUT_WR)
            while piece := connection.recv(1 << 16):
                reply += piece
    return reply


def check_reply(reply: bytes) -> int:
    """Return the status of a reply whose every header is one that the server sends."""
    head, _, content = reply.partition(b"\r\n\r\n")
    first, *lines = head.decode("ascii").split("\r\n")
    protocol, status, _ = first.split(" ", 2)
    assert protocol == "HTTP/1.1"
    headers = dict(line.split(": ", 1) for line in lines)
    assert len(headers) == len(lines)
    assert set(headers) <= {
        "Server", "Date", "Content-Type", "Content-Length", "Content-Security-Policy",
        "X-Content-Type-Options", "Referrer-Policy", "Cross-Origin-Resource-Policy",
        "Cache-Control", "Connection", "Content-Disposition", "Set-Cookie",
    }  # fmt: skip
    assert all(value.isprintable() for value in headers.values())
    assert headers["X-Content-Type-Options"] == "nosniff"
    assert len(content) == int(headers["Content-Length"]) or status in (
        # The body of an early answer to HEAD is left out, as HTTP asks.
        *("501", "403", "431"),
    )
    assert b"Traceback" not in content
    if headers["Content-Type"] == "application/json":
        json.loads(content)
    return int(status)


def test_500_requests_have_500_clean_answers(
    server: PageServer, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    rng = random.Random(39)
    outside = {path.name for path in tmp_path.iterdir()}
    seen: dict[int, int] = {}
    for number in range(REQUESTS):
        request = draw_request(rng, server)
        reply = send(server, request)
        if not reply:  # a connection that was ended before the whole request had come
            assert len(request) > 60_000, (number, request[:300])
            continue
        try:
            status = check_reply(reply)
        except (AssertionError, ValueError) as problem:
            raise AssertionError((number, request[:300], reply[:800])) from problem
        assert status in STATUSES, (number, request[:300], reply[:300])
        seen[status] = seen.get(status, 0) + 1
    assert {200, 403, 404, 409} <= set(seen)
    assert seen[200] > REQUESTS / 10, seen
    assert {path.name for path in tmp_path.iterdir()} <= outside | {"study"}
    folder = server.session.folder
    written = {path for path in folder.rglob("*") if path.is_file()}
    assert all(path.resolve().is_relative_to(folder.resolve()) for path in written)
    assert not [path for path in written if path.name.endswith(".part")]
    out, err = capfd.readouterr()
    assert "Traceback" not in out + err
    assert "a request failed" not in err
