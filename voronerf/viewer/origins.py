"""Keeps pages of other sites out: a browser lets each of its pages open a websocket to 127.0.0.1.

viser does not check where a request comes from. Its server is that of the package websockets, which passes each request
to a function of viser before it answers; the function here is called first. Its rules are those of Jupyter: a page must
come from where it connects to, and what listens at a loopback address must be asked for by a loopback name, since
the owner of any other name can have it lead here after the page is loaded (DNS rebinding).
"""

from __future__ import annotations

import contextlib
import ipaddress
import warnings
from collections.abc import Callable, Iterator, Mapping
from typing import Any
from urllib.parse import urlsplit

import viser
from websockets.asyncio import server
from websockets.http11 import Request, Response


@contextlib.contextmanager
def only_own_pages(host: str) -> Iterator[None]:
    """A viser server that is made in this context, to listen at `host`, refuses requests of pages of other sites."""
    serve, made = server.serve, []

    def serve_own_pages(*arguments: Any, process_request: Callable[..., Any], **options: Any) -> server.serve:
        def check(connection: server.ServerConnection, request: Request) -> Response | Any:
            reason = why_refused(request.headers, host)
            return process_request(connection, request) if reason is None else connection.respond(403, f"{reason}\n")

        made.append(host)
        return serve(*arguments, process_request=check, **options)

    server.serve = serve_own_pages  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        server.serve = serve  # type: ignore[misc]
    if not made:
        warnings.warn(f"pages of other sites can reach the viewer with viser {viser.__version__}", stacklevel=2)


def why_refused(headers: Mapping[str, str], host: str) -> str | None:
    """Why a request to what listens at `host` is refused; None if it is not.

    Programs that are no browser send no `Origin`, and are let in.

    Examples:
        >>> from voronerf.viewer.origins import why_refused
        >>> why_refused({"Host": "localhost:8080", "Origin": "http://localhost:8080"}, "127.0.0.1")
        >>> why_refused({"Host": "localhost:8080", "Origin": "https://example.org"}, "127.0.0.1")
        'a page of https://example.org must not use the viewer at localhost:8080'
    """
    asked, origin = headers.get("Host", ""), headers.get("Origin")
    if _is_loopback(host) and not _is_loopback(urlsplit(f"//{asked}").hostname or ""):
        return f"the viewer listens at {host} and must be opened there or as localhost, not as {asked}"
    if origin is not None and urlsplit(origin).netloc != asked:
        return f"a page of {origin} must not use the viewer at {asked}"
    return None


def _is_loopback(name: str) -> bool:
    try:
        return ipaddress.ip_address(name).is_loopback
    except ValueError:
        return name == "localhost"
