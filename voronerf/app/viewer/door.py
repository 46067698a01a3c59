"""Access control of the viewer: checks of connections and messages.

A browser lets the pages of any site open a websocket to the viewer. viser does not check the origin of a request, and
trusts all messages. It passes its handlers to the server of the package websockets; the functions here wrap them.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
import warnings
from collections.abc import Awaitable, Callable, Iterator, Mapping
from ipaddress import ip_address
from typing import Any
from urllib.parse import urlsplit

import msgspec
import viser
from websockets.asyncio import server
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

log = logging.getLogger(__name__)

#: Greatest number of bytes of a message; a message of viser's page has a few hundred.
LARGEST = 2**16

#: The logger for websockets: only critical errors, so that connections without a request are not logged.
QUIET = log.getChild("websockets")
QUIET.setLevel(logging.CRITICAL)

#: Kinds of messages that the viewer accepts; a request for a public share link is not among them.
KINDS = (
    *("ViewerCameraMessage", "GuiUpdateMessage", "ScenePointerMessage", "SceneNodeClickMessage"),
    *(f"TransformControls{what}Message" for what in ("DragStart", "Update", "DragEnd")),
)


def chosen(part: Any) -> Any:
    """Returns the value of a slider or a list after a check that it is a possible choice.

    Raises:
        ValueError: the value is no possible choice; a page of the viewer never sends such a value.
    """
    value = part.value
    if not (value in part.options if hasattr(part, "options") else part.min <= value <= part.max):
        raise ValueError(f"{part.label} cannot be {value!r}")
    return value


@contextlib.contextmanager
def guarded(host: str, pages: Mapping[str, Callable[[], Awaitable[bytes]]]) -> Iterator[None]:
    """A context in which to make a viser server, which then refuses requests from pages of other sites.

    The server, which listens on `host`, ignores messages that the viewer does not use, and disconnects a browser whose
    message cannot be decoded. It also serves ``pages``, HTML by path.
    """
    serve, guarded_hosts = server.serve, []

    def guarded_serve(
        handler: Callable[..., Any], *arguments: Any, process_request: Callable[..., Any], **options: Any
    ) -> server.serve:
        async def handle(connection: server.ServerConnection) -> None:
            asyncio.get_running_loop().set_exception_handler(_log_error)
            receive = connection.recv

            async def recv() -> Any:
                while True:
                    data: Any = await receive()
                    message = msgspec.msgpack.decode(data)
                    if message["type"] in KINDS and set(message.get("updates", ("value",))) == {"value"}:
                        return data

            connection.recv = recv  # type: ignore[method-assign, assignment]
            try:
                await handler(connection)
            except Exception as error:
                log.warning("a browser is disconnected, its message cannot be read: %.200s", error)
            if connection.protocol.close_sent is not None and connection.protocol.close_sent.code == 1009:
                log.warning("a browser is disconnected, it sent more than %d bytes at once", LARGEST)

        async def check(connection: server.ServerConnection, request: Request) -> Response | Any:
            reason = why_refused(request.headers, host)
            if reason is not None:
                return connection.respond(403, f"{reason}\n")
            page = pages.get(request.path)
            return process_request(connection, request) if page is None else _answer(await page())

        guarded_hosts.append(host)
        return serve(handle, *arguments, process_request=check, **options | {"max_size": LARGEST, "logger": QUIET})

    server.serve = guarded_serve  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        server.serve = serve  # type: ignore[misc]
    if not guarded_hosts:
        warnings.warn(f"pages of other sites can reach the viewer with viser {viser.__version__}", stacklevel=2)


def _answer(page: bytes) -> Response:
    headers = {"Content-Type": "text/html; charset=utf-8", "Content-Length": str(len(page)), "Connection": "close"}
    return Response(200, "OK", Headers({**headers, "Cache-Control": "no-store"}), page)


def _log_error(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Logs a message that viser could not handle, such as text in place of a number."""
    log.warning("a browser's message is ignored: %.200s", context.get("exception", context["message"]))


def why_refused(headers: Mapping[str, str], host: str) -> str | None:
    """Returns the reason why a request to a server at `host` is refused, or None if it is accepted.

    As in Jupyter, a page must come from the host to which it connects. This host must be an IP address or a name of
    this machine: the owner of any other name could redirect it to this machine after the page is loaded (DNS
    rebinding). Programs other than browsers send no `Origin`, and are accepted.

    Args:
        headers: the headers of the request.
        host: the address or name of this machine on which the viewer listens.

    Examples:
        >>> from voronerf.app.viewer.door import why_refused
        >>> why_refused({"Host": "localhost:8080", "Origin": "http://localhost:8080"}, "127.0.0.1")
        >>> why_refused({"Host": "localhost:8080", "Origin": "https://example.org"}, "127.0.0.1")
        'a page of https://example.org must not use the viewer at localhost:8080'
        >>> why_refused({"Host": "example.org:8080", "Origin": "http://example.org:8080"}, "0.0.0.0")
        'the viewer must be opened by an address or as localhost, not as example.org; --host example.org allows it'
    """
    try:
        requested, origin = headers.get("Host", ""), headers.get("Origin")
        name = urlsplit(f"//{requested}").hostname or ""
        site = None if origin is None else urlsplit(origin).netloc
    except (ValueError, LookupError):  # an invalid address, or a duplicate header
        return "its headers cannot be read"
    machine = socket.gethostname().lower()
    if not (name in ("localhost", machine, f"{machine}.local", host.lower()) or _is_address(name)):
        return f"the viewer must be opened by an address or as localhost, not as {name}; --host {name} allows it"
    if site is not None and site != requested:
        return f"a page of {origin} must not use the viewer at {requested}"
    return None


def _is_address(name: str) -> bool:
    try:
        ip_address(name)
    except ValueError:
        return False
    return True
