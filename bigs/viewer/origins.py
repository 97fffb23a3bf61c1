"""Who may connect to the live viewer: its own page and programs, but no other web page.

A browser lets any page open a WebSocket to this machine and names the page only in `Origin`. viser does not
check it, so bigs adds a check.
"""

from __future__ import annotations

import contextlib
import http
import ipaddress
import threading
from collections.abc import Iterator
from typing import Any
from urllib.parse import urlsplit

# The library's function is replaced for a moment, so viewers start one at a time.
_STARTING = threading.Lock()


def is_own_page(origins: list[str], hosts: list[str], listening: str) -> bool:
    """Whether a request may be answered, by its headers.

    Args:
        origins: its `Origin`; programs send none.
        hosts: its `Host`, which is what the browser takes this server to be.
        listening: the address that the server listens at. At a loopback address only names of this machine
            count: a page of the web may have its own name lead here.
    """
    if not origins:
        return True
    if len(origins) != 1 or len(hosts) != 1:
        return False
    try:
        page, host = urlsplit(origins[0].lower()), urlsplit(f"//{hosts[0].lower()}")
        same = page.scheme in ("http", "https") and (page.hostname, page.port) == (host.hostname, host.port)
    except ValueError:
        return False
    return same and (_is_loopback(host.hostname) or not _is_loopback(listening))


@contextlib.contextmanager
def own_pages_only(listening: str) -> Iterator[None]:
    """Servers that viser starts in the block refuse requests of other pages with status 403."""
    import websockets.asyncio.server as library

    serve = library.serve

    def guarded(*arguments: Any, process_request: Any = None, **options: Any) -> Any:
        def answer(connection: Any, request: Any) -> Any:
            headers = request.headers
            if not is_own_page(headers.get_all("Origin"), headers.get_all("Host"), listening):
                return connection.respond(http.HTTPStatus.FORBIDDEN, "another page's request\n")
            return None if process_request is None else process_request(connection, request)

        return serve(*arguments, process_request=answer, **options)

    with _STARTING:
        library.serve = guarded  # type: ignore[assignment,misc]
        try:
            yield
        finally:
            library.serve = serve  # type: ignore[misc]


def _is_loopback(host: str | None) -> bool:
    if host is None:
        return False
    if host == "localhost" or host.endswith(".localhost"):
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
