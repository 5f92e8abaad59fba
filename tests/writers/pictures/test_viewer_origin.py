"""The viewer answers its own page and no page of another site."""

from __future__ import annotations

import pytest

from asbuilt.description import bundled_robot


@pytest.mark.parametrize(
    ("origin", "accepted"),
    [
        ("http://evil.example", False),
        ("http://127.0.0.1:{wrong}", False),
        ("null", False),
        ("http://127.0.0.1:{port}", True),
        ("http://localhost:{port}", True),
        (None, True),
    ],
)
def test_only_the_own_origin_may_connect(origin: str | None, accepted: bool) -> None:
    pytest.importorskip("viser")
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    from asbuilt.writers import Viewer

    viewer = Viewer(bundled_robot("two-link"))
    try:
        shown = origin and origin.format(port=viewer.port, wrong=viewer.port + 1)
        url = f"ws://127.0.0.1:{viewer.port}"
        if accepted:
            connect(url, origin=shown, subprotocols=["viser-v0"]).close()
        else:
            with pytest.raises(InvalidStatus, match="403"):
                connect(url, origin=shown, subprotocols=["viser-v0"])
    finally:
        viewer.close()
