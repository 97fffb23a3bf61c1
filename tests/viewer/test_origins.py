"""The live viewer's socket answers its own pages and programs, and no other page that a browser has open."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from bigs.viewer.app import Viewer
from bigs.viewer.origins import is_own_page
from bigs.viewer.stage import Stage

pytest.importorskip("viser", reason="needs the extra 'viewer'")


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    K = np.array([[50.0, 0.0, 32.0], [0.0, 50.0, 24.0], [0.0, 0.0, 1.0]])
    stage = Stage(
        title="nothing",
        frames=1,
        fps=1.0,
        K=K,
        width=64,
        height=48,
        middle=np.array([0.0, 0.0, 1.0]),
        colors={},
        knobs={},
        show=lambda frame, pose: {},
        image=None,
        truth=None,
    )
    with Viewer(stage, port=0) as viewer:
        yield viewer.url.removeprefix("http://")


def opens(address: str, **headers: str) -> bool:
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    try:
        with connect(f"ws://{address}", subprotocols=None, additional_headers=headers):
            return True
    except InvalidStatus as refusal:
        assert refusal.response.status_code == 403
        return False


def test_a_handshake_of_another_page_is_refused(address: str) -> None:
    port = address.rsplit(":", 1)[1]
    assert opens(address)
    assert opens(address, Origin=f"http://{address}")
    for origin in ("http://example.com", f"http://example.com:{port}", "null", "http://127.0.0.1:1", "", "["):
        assert not opens(address, Origin=origin), origin


@pytest.mark.parametrize(
    ("origins", "hosts", "listening", "own"),
    [
        ([], ["anything"], "127.0.0.1", True),
        (["http://localhost:9000"], ["localhost:9000"], "127.0.0.1", True),
        (["http://[::1]:8080"], ["[::1]:8080"], "::1", True),
        # A name of the web that leads here.
        (["http://evil.example:8080"], ["evil.example:8080"], "127.0.0.1", False),
        (["http://evil.example:8080"], ["localhost:8080"], "127.0.0.1", False),
        (["http://localhost:3000"], ["localhost:8080"], "127.0.0.1", False),
        (["http://localhost:8080", "http://localhost:8080"], ["localhost:8080"], "127.0.0.1", False),
        (["http://localhost:x"], ["localhost:x"], "127.0.0.1", False),
        (["file://"], [""], "127.0.0.1", False),
        # Let in by --host.
        (["http://workstation:8080"], ["workstation:8080"], "0.0.0.0", True),
        (["http://evil.example"], ["workstation:8080"], "0.0.0.0", False),
    ],
)
def test_whose_page_it_is(origins: list[str], hosts: list[str], listening: str, own: bool) -> None:
    assert is_own_page(origins, hosts, listening) == own
