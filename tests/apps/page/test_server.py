"""The page answers whoever has its address, on this machine, and no page of another site."""

from __future__ import annotations

import http.client
import json
import re
import resource
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from asbuilt.apps.page import server as page_server
from asbuilt.apps.page import session as page_session
from asbuilt.apps.page.server import PageServer
from asbuilt.apps.page.session import Choices, Session

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
    sent = {name: value for name, value in {**own, **headers}.items() if value is not None}
    connection = http.client.HTTPConnection(*server.server_address, timeout=30)
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
    assert len(server.token) >= 32


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
    place = f"/{server.token}/" + {"GET": "state", "POST": "state", "PUT": "files/a.csv"}[method]
    given = {name: value.format(port=port) for name, value in headers.items()}
    assert ask(server, method, place, b"{}" if method == "POST" else b"", **given)[0] == status


def test_a_change_needs_an_origin_and_everything_the_secret(server: PageServer) -> None:
    place = f"/{server.token}/state"
    assert ask(server, "GET", place, Origin=None)[0] == 200
    assert ask(server, "POST", place, b"{}", Origin=None)[0] == 403
    for wrong in ("/", "/state", "/x/state", f"/{server.token[:-1]}/state", f"/{server.token}x/"):
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
    ],
)
def test_only_files_of_the_folder_are_given(server: PageServer, tmp_path: Path, place: str) -> None:
    folder = server.session.folder
    folder.mkdir()
    (tmp_path / "secret").write_text("secret")
    (folder / "link").symlink_to(tmp_path / "secret")
    status, content = ask(server, "GET", f"/{server.token}/{place}")
    assert status == 404 or content == b"null"
    assert b"secret" not in content
    assert b"root:" not in content


@pytest.mark.parametrize(
    ("name", "written"),
    [
        ("run%201.csv", "run_1.csv"),
        ("..%2f..%2f.bashrc", "file/file/bashrc"),
        ("%2e%2e/%2e%2e/x.csv", "file/file/x.csv"),
        ("bag/metadata.yaml", "bag/metadata.yaml"),
        ("-rf", "rf"),
        ("a%00b.csv", "a_b.csv"),
    ],
)
def test_uploads_stay_in_their_folder(server: PageServer, name: str, written: str) -> None:
    status, content = ask(server, "PUT", f"/{server.token}/files/{name}", b"t,q_1\n")
    assert status == 200
    path = Path(json.loads(content)["path"])
    assert path == server.session.folder / "uploads" / written
    assert path.read_bytes() == b"t,q_1\n"


def test_an_upload_that_ends_early_leaves_no_file(server: PageServer) -> None:
    connection = http.client.HTTPConnection(*server.server_address, timeout=30)
    connection.putrequest("PUT", f"/{server.token}/files/log.csv", skip_host=True)
    for name, value in (
        ("Host", server.hosts[0]),
        ("Origin", f"http://{server.hosts[0]}"),
        ("Content-Length", "1000"),
    ):
        connection.putheader(name, value)
    connection.endheaders(b"t,q_1\n")
    connection.sock.shutdown(1)
    assert connection.getresponse().status == 409
    connection.close()
    assert [*(server.session.folder / "uploads").iterdir()] == []


@pytest.mark.study
def test_an_upload_of_half_a_gigabyte_goes_to_disk_piece_by_piece(server: PageServer) -> None:
    piece, count = b"0.1,0.2,0.3,0.4\n" * 65_536, 500
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    connection = http.client.HTTPConnection(*server.server_address, timeout=300)
    connection.putrequest("PUT", f"/{server.token}/files/long.csv", skip_host=True)
    connection.putheader("Host", server.hosts[0])
    connection.putheader("Origin", f"http://{server.hosts[0]}")
    connection.putheader("Content-Length", str(count * len(piece)))
    connection.endheaders()
    for _ in range(count):
        connection.send(piece)
    assert connection.getresponse().status == 200
    connection.close()
    path = server.session.folder / "uploads" / "long.csv"
    assert path.stat().st_size == count * len(piece)
    path.unlink()
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50_000  # kB


@pytest.mark.parametrize(
    "body",
    [b"[]", b"{", b'{"robot": 1}', b'{"logs": "a"}', b'{"logs": [1]}', b'{"robot": "--json"}',
     b'{"reading": "\'"}', b"[" * 100_000],
)  # fmt: skip
def test_requests_that_make_no_sense_change_nothing(server: PageServer, body: bytes) -> None:
    status, content = ask(server, "POST", f"/{server.token}/state", body)
    assert status == 409
    assert json.loads(content)["error"]
    assert server.session.choices == Choices()


def test_the_page_names_no_other_server() -> None:
    for path in TEMPLATES.iterdir():
        found = re.findall(r"(?:https?:)?//[a-z][\w.-]+\.[a-z]{2,}[^\s\"']*", path.read_text())
        assert set(found) <= {"http://www.w3.org/2000/svg"}, path.name
