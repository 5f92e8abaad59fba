"""The page answers whoever has its address, on this machine, and no page of another site."""

from __future__ import annotations

import http.client
import json
import os
import re
import resource
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

import pytest

from asbuilt.apps.page import server as page_server
from asbuilt.apps.page import session as page_session
from asbuilt.apps.page.choices import Choices
from asbuilt.apps.page.server import PageServer
from asbuilt.apps.page.session import Session

PATIENCE = 600.0
"""Seconds without an answer after which one is waited for in vain, on a busy machine, too."""

TEMPLATES = Path(page_server.__file__).parent / "templates"


class NoWorker:
    """Stands for the process of the commands, which these tests do not need."""

    def close(self) -> None:
        pass


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[PageServer]:
    monkeypatch.setattr(page_session, "Worker", NoWorker)
    served = PageServer(Session(tmp_path / "study", Choices()), 0)
    thread = threading.Thread(target=served.serve_forever, daemon=True)
    thread.start()
    yield served
    served.shutdown()
    served.server_close()
    thread.join()


def ask(
    server: PageServer, method: str, place: str, body: Any = None, **headers: str | None
) -> tuple[int, Any]:
    """Ask as the page does, with some headers in place of its own; None leaves one out."""
    own = {"Host": server.hosts[0], "Origin": f"http://{server.hosts[0]}"}
    own["Cookie"] = f"other=1; asbuilt={server.cookie}"
    sent = {name: value for name, value in {**own, **headers}.items() if value is not None}
    connection = http.client.HTTPConnection(*server.server_address, timeout=PATIENCE)
    try:
        connection.putrequest(method, place, skip_host=True)
        for name, value in sent.items():
            connection.putheader(name, value)
        content = b"" if body is None else body
        connection.putheader("Content-Length", str(len(content)))
        connection.endheaders(content)
        reply = connection.getresponse()
        return reply.status, reply.read()
    finally:
        connection.close()


def test_it_listens_on_this_machine_alone(server: PageServer) -> None:
    assert server.server_address[0] == "127.0.0.1"
    assert len({server.secret, server.place, server.cookie}) == 3
    assert min(map(len, (server.secret, server.place, server.cookie))) >= 32


def test_the_secret_is_exchanged_for_a_cookie_once(server: PageServer) -> None:
    url = server.url
    first = f"/{server.secret}/"
    connection = http.client.HTTPConnection(*server.server_address, timeout=PATIENCE)
    connection.request("GET", first)
    reply = connection.getresponse()
    page = reply.read().decode()
    cookie = str(reply.getheader("Set-Cookie"))
    assert reply.status == 200
    assert f"url=/{server.place}/" in page
    assert {"HttpOnly", "SameSite=Strict", f"Path=/{server.place}/"} <= set(cookie.split("; "))
    assert cookie.startswith(f"asbuilt={server.cookie};")
    assert ask(server, "GET", first)[0] == 403
    assert server.url != url
    place = f"/{server.place}/state"
    assert ask(server, "GET", place, Cookie=cookie.partition(";")[0])[0] == 200
    for wrong in (None, "asbuilt=", "asbuilt=x", f"other={server.cookie}", "\xe9=\xff; asbuilt"):
        assert ask(server, "GET", place, Cookie=wrong)[0] == 403


def test_the_file_that_opens_the_page_is_for_its_owner_alone(server: PageServer) -> None:
    path = server.write_opener()
    assert path.stat().st_mode & 0o777 == 0o600
    assert f'url={server.url}">' in path.read_text()
    assert ask(server, "GET", f"/{server.place}/files/{path.name}")[0] == 404
    assert ask(server, "GET", f"/{server.secret}/", Cookie=None)[0] == 200
    assert not path.exists()


@pytest.mark.parametrize("method", ["GET", "POST", "PUT"])
@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({}, 200),
        ({"Host": "localhost:{port}", "Origin": "http://localhost:{port}"}, 200),
        ({"Host": "evil.example"}, 403),
        ({"Host": "127.0.0.1:1"}, 403),
        ({"Origin": "http://evil.example"}, 403),
        ({"Origin": "null"}, 403),
        ({"Origin": "http://127.0.0.1:1"}, 403),
        ({"Origin": "https://127.0.0.1:{port}"}, 403),
    ],
)
def test_only_its_own_host_and_origin_are_answered(
    server: PageServer, method: str, headers: dict[str, str], status: int
) -> None:
    port = server.server_address[1]
    place = f"/{server.place}/" + {"GET": "state", "POST": "state", "PUT": "files/1/a.csv"}[method]
    given = {name: value.format(port=port) for name, value in headers.items()}
    assert ask(server, method, place, b"{}" if method == "POST" else b"", **given)[0] == status


def test_a_change_needs_an_origin_and_everything_the_secret(server: PageServer) -> None:
    place = f"/{server.place}/state"
    assert ask(server, "GET", place, Origin=None)[0] == 200
    assert ask(server, "POST", place, b"{}", Origin=None)[0] == 403
    for wrong in ("/", "/state", "/x/state", f"/{server.place[:-1]}/state", f"/{server.place}x/"):
        assert ask(server, "GET", wrong)[0] == 403, wrong
    assert not (server.session.folder).exists()


@pytest.mark.parametrize(
    "place",
    [
        "files/../secret",
        "files/%2e%2e/secret",
        "files/..%2fsecret",
        "files//etc/passwd",
        "files/%2fetc%2fpasswd",
        "files/link",
        "files/",
        "page.py",
        "../server.py",
        "answer/../state",
        "answer/nothing",
        "files/%00",
        "files/" + "x" * 5000,
        "files/%ff%fe",
    ],
)
def test_only_files_of_the_folder_are_given(server: PageServer, tmp_path: Path, place: str) -> None:
    folder = server.session.folder
    folder.mkdir()
    (tmp_path / "secret").write_text("secret")
    (folder / "link").symlink_to(tmp_path / "secret")
    status, content = ask(server, "GET", f"/{server.place}/{place}")
    assert status == 404 or json.loads(content)["answer"] is None
    assert b"secret" not in content
    assert b"root:" not in content


@pytest.mark.parametrize(
    ("name", "written"),
    [
        ("1/run%201.csv", "1/run_1.csv"),
        ("..%2f..%2f.bashrc", "file/file/bashrc"),
        ("%2e%2e/%2e%2e/x.csv", "file/file/x.csv"),
        ("1/bag/metadata.yaml", "1/bag/metadata.yaml"),
        ("1/-rf", "1/rf"),
        ("1/a%00b.csv", "1/a_b.csv"),
        ("1/a%0d%0aX-Evil:%201", "1/a__X-Evil__1"),
        ("1/" + "%C3%A9" * 200, "1/" + "é" * 60),
    ],
)
def test_uploads_stay_in_their_folder(server: PageServer, name: str, written: str) -> None:
    status, content = ask(server, "PUT", f"/{server.place}/files/{name}", b"t,q_1\n")
    assert status == 200
    path = Path(json.loads(content)["path"])
    assert path == server.session.folder / "uploads" / written
    assert path.read_bytes() == b"t,q_1\n"


def test_an_upload_that_ends_early_leaves_no_file(server: PageServer) -> None:
    connection = http.client.HTTPConnection(*server.server_address, timeout=PATIENCE)
    connection.putrequest("PUT", f"/{server.place}/files/1/log.csv", skip_host=True)
    for name, value in (
        ("Host", server.hosts[0]),
        ("Origin", f"http://{server.hosts[0]}"),
        ("Cookie", f"asbuilt={server.cookie}"),
        ("Content-Length", "1000"),
    ):
        connection.putheader(name, value)
    connection.endheaders(b"t,q_1\n")
    connection.sock.shutdown(1)
    assert connection.getresponse().status == 409
    connection.close()
    assert [*(server.session.uploads / "1").iterdir()] == []


@pytest.mark.study
def test_an_upload_of_half_a_gigabyte_goes_to_disk_piece_by_piece(server: PageServer) -> None:
    piece, count = b"0.1,0.2,0.3,0.4\n" * 65_536, 500
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    connection = http.client.HTTPConnection(*server.server_address, timeout=PATIENCE)
    connection.putrequest("PUT", f"/{server.place}/files/1/long.csv", skip_host=True)
    connection.putheader("Host", server.hosts[0])
    connection.putheader("Origin", f"http://{server.hosts[0]}")
    connection.putheader("Cookie", f"asbuilt={server.cookie}")
    connection.putheader("Content-Length", str(count * len(piece)))
    connection.endheaders()
    for _ in range(count):
        connection.send(piece)
    assert connection.getresponse().status == 200
    connection.close()
    path = server.session.folder / "uploads" / "1" / "long.csv"
    assert path.stat().st_size == count * len(piece)
    path.unlink()
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50_000  # kB


@pytest.mark.parametrize(
    "body",
    [b"[]", b"{", b'{"robot": 1}', b'{"logs": "a"}', b'{"logs": [1]}', b'{"robot": "--json"}',
     b'{"reading": "\'"}', b"[" * 100_000, b'{"reading": "--trust-xacro"}',
     b'{"options": "--mcap /tmp/x.mcap"}', b'{"options": "--out /tmp"}', b'{"options": "-o/tmp"}',
     b'{"options": "--scheduler tcp://evil.example:1"}', b'{"options": "--rrd=/tmp/x"}',
     b'{"reading": "other.csv"}', b'{"reading": "--rate"}', b'{"export": "--urdf /tmp/x"}',
     b'{"robot": "a\\u0000b"}', b'{"logs": ["\\ud800"]}', b'{"robot": "' + b"x" * 5000 + b'"}'],
)  # fmt: skip
def test_requests_that_make_no_sense_change_nothing(server: PageServer, body: bytes) -> None:
    status, content = ask(server, "POST", f"/{server.place}/state", body)
    assert status == 409
    assert json.loads(content)["error"]
    assert server.session.choices == Choices()


@pytest.mark.parametrize("name", ["a\r\nX-Evil: 1.bin", 'a"b;c.bin', "\u4e2d\u6587.bin", "é.bin"])
def test_a_download_has_one_clean_name(server: PageServer, name: str) -> None:
    server.session.folder.mkdir()
    (server.session.folder / name).write_bytes(b"content")
    connection = http.client.HTTPConnection(*server.server_address, timeout=PATIENCE)
    place = f"/{server.place}/files/{quote(name, safe='')}"
    connection.request("GET", place, headers={"Cookie": f"asbuilt={server.cookie}"})
    reply = connection.getresponse()
    assert reply.read() == b"content"
    assert reply.getheader("X-Evil") is None
    told = str(reply.getheader("Content-Disposition"))
    assert unquote(told.partition("filename*=UTF-8''")[2]) == name
    connection.close()


@pytest.mark.parametrize("size", ["9" * 5000, "-1", "1e3", " ", "٣", "5000001"])
def test_a_size_that_is_none_is_refused(server: PageServer, size: str) -> None:
    lines = (
        f"POST /{server.place}/state HTTP/1.1",
        f"Host: {server.hosts[0]}",
        f"Origin: http://{server.hosts[0]}",
        f"Cookie: asbuilt={server.cookie}",
        f"Content-Length: {size}",
    )
    reply = send(server, "\r\n".join(lines).encode() + b"\r\n\r\n")
    assert reply.startswith((b"HTTP/1.1 413 ", b"HTTP/1.1 411 "))


def send(server: PageServer, request: bytes) -> bytes:
    """All that comes back for some bytes."""
    with socket.create_connection(server.server_address, timeout=PATIENCE) as connection:
        connection.sendall(request)
        connection.shutdown(socket.SHUT_WR)
        reply = b""
        with suppress(ConnectionError):
            while piece := connection.recv(65536):
                reply += piece
    return reply


def test_files_of_one_name_lie_side_by_side(server: PageServer) -> None:
    paths = []
    for content in (b"first", b"second"):
        _, told = ask(server, "POST", f"/{server.place}/batch", b"{}")
        place = f"/{server.place}/files/{json.loads(told)['batch']}/log.csv"
        paths.append(Path(json.loads(ask(server, "PUT", place, content)[1])["path"]))
        assert ask(server, "PUT", place, b"another")[0] == 409
    assert [path.read_bytes() for path in paths] == [b"first", b"second"]


def test_uploads_that_are_cut_off_by_the_end_leave_nothing(server: PageServer) -> None:
    begun = []
    for number in range(20):
        connection = http.client.HTTPConnection(*server.server_address, timeout=PATIENCE)
        connection.putrequest("PUT", f"/{server.place}/files/1/{number}.csv", skip_host=True)
        for name, value in (
            ("Host", server.hosts[0]),
            ("Origin", f"http://{server.hosts[0]}"),
            ("Cookie", f"asbuilt={server.cookie}"),
            ("Content-Length", "1000"),
        ):
            connection.putheader(name, value)
        connection.endheaders(b"t,q_1\n")
        begun.append(connection)
    folder = server.session.uploads / "1"
    end = time.monotonic() + PATIENCE
    while len([*folder.glob(".*.part")]) < 20 and time.monotonic() < end:
        time.sleep(0.01)
    server.shutdown()
    server.server_close()
    assert [*folder.iterdir()] == []
    for connection in begun:
        connection.close()


@pytest.mark.study
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_browser_is_started_without_the_secret_and_nothing_is_left(
    tmp_path: Path, number: int
) -> None:
    browser = tmp_path / "browser"
    browser.write_text(f'#!/bin/sh\nprintf "%s\\n" "$@" > "{tmp_path}/told"\n')
    browser.chmod(0o700)
    folder = tmp_path / "study"
    command = (sys.executable, "-m", "asbuilt", "open", "--port", "0", "--json", "-o", str(folder))
    environment = os.environ | {"BROWSER": f"{browser} %s", "PYTHONPATH": os.pathsep.join(sys.path)}
    program = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    )
    end = time.monotonic() + PATIENCE
    while not (tmp_path / "told").exists() and time.monotonic() < end:
        time.sleep(0.05)
    assert (folder / "open-in-browser.html").stat().st_mode & 0o777 == 0o600
    time.sleep(0.5)
    program.send_signal(number)
    out, err = program.communicate(timeout=PATIENCE)
    secret = json.loads(out)["url"].split("/")[-2]
    told = (tmp_path / "told").read_text()
    assert told.startswith("file://")
    assert secret not in told
    assert (program.returncode, err) == (0, "")
    assert [*folder.iterdir()] == []


def test_the_page_names_no_other_server() -> None:
    for path in TEMPLATES.iterdir():
        found = re.findall(r"(?:https?:)?//[a-z][\w.-]+\.[a-z]{2,}[^\s\"']*", path.read_text())
        assert set(found) <= {"http://www.w3.org/2000/svg"}, path.name
