"""Who may connect to the viewer, and what a page may send: a browser lets each of its pages open a websocket to it.

viser does not check where a request comes from, and trusts what it is sent. Its server is that of the package
websockets, to which it passes its functions; the functions here are called first.
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

#: Bytes of a message; the page sends some hundred.
LARGEST = 2**16

#: Of websockets: says only what ends the server, and not that somebody connected without a request.
QUIET = log.getChild("websockets")
QUIET.setLevel(logging.CRITICAL)

#: Kinds of messages that the viewer takes; the wish for a public address is none of them.
KINDS = (
    *("ViewerCameraMessage", "GuiUpdateMessage", "ScenePointerMessage", "SceneNodeClickMessage"),
    *(f"TransformControls{what}Message" for what in ("DragStart", "Update", "DragEnd")),
)


def chosen(part: Any) -> Any:
    """The value of a slider or a list, where it is one that can be chosen.

    Raises:
        ValueError: a page of the viewer cannot have sent it.
    """
    value = part.value
    if not (value in part.options if hasattr(part, "options") else part.min <= value <= part.max):
        raise ValueError(f"{part.label} cannot be {value!r}")
    return value


@contextlib.contextmanager
def guarded(host: str, pages: Mapping[str, Callable[[], Awaitable[bytes]]]) -> Iterator[None]:
    """A viser server that is made in this context, to listen at `host`, refuses requests of pages of other sites.

    It passes over messages that the viewer has no use for, and disconnects whoever sends what is none. It also serves
    ``pages``, HTML by their paths.
    """
    serve, made = server.serve, []

    def guarded_serve(
        handler: Callable[..., Any], *arguments: Any, process_request: Callable[..., Any], **options: Any
    ) -> server.serve:
        async def handle(connection: server.ServerConnection) -> None:
            asyncio.get_running_loop().set_exception_handler(_say)
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

        made.append(host)
        return serve(handle, *arguments, process_request=check, **options | {"max_size": LARGEST, "logger": QUIET})

    server.serve = guarded_serve  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        server.serve = serve  # type: ignore[misc]
    if not made:
        warnings.warn(f"pages of other sites can reach the viewer with viser {viser.__version__}", stacklevel=2)


def _answer(page: bytes) -> Response:
    headers = {"Content-Type": "text/html; charset=utf-8", "Content-Length": str(len(page)), "Connection": "close"}
    return Response(200, "OK", Headers({**headers, "Cache-Control": "no-store"}), page)


def _say(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Logs a message that viser could not use, such as text in place of a number."""
    log.warning("a message of a browser is passed over: %.200s", context.get("exception", context["message"]))


def why_refused(headers: Mapping[str, str], host: str) -> str | None:
    """The reason why a request to a server at `host` is refused; None if it is not.

    A page must come from where it connects to, as for Jupyter. And it must ask by an address, or by a name that is
    known to be this machine's: the owner of any other name can have it lead here after the page is loaded (DNS
    rebinding). Programs that are no browser send no `Origin`, and are let in.

    Args:
        headers: of the request.
        host: address or name of this machine that the viewer listens at.

    Examples:
        >>> from voronerf.app.viewer.door import why_refused
        >>> why_refused({"Host": "localhost:8080", "Origin": "http://localhost:8080"}, "127.0.0.1")
        >>> why_refused({"Host": "localhost:8080", "Origin": "https://example.org"}, "127.0.0.1")
        'a page of https://example.org must not use the viewer at localhost:8080'
        >>> why_refused({"Host": "example.org:8080", "Origin": "http://example.org:8080"}, "0.0.0.0")
        'the viewer must be opened by an address or as localhost, not as example.org; --host example.org allows it'
    """
    try:
        asked, origin = headers.get("Host", ""), headers.get("Origin")
        name = urlsplit(f"//{asked}").hostname or ""
        site = None if origin is None else urlsplit(origin).netloc
    except (ValueError, LookupError):  # an address that is none, or a header twice
        return "its headers cannot be read"
    machine = socket.gethostname().lower()
    if not (name in ("localhost", machine, f"{machine}.local", host.lower()) or _is_address(name)):
        return f"the viewer must be opened by an address or as localhost, not as {name}; --host {name} allows it"
    if site is not None and site != asked:
        return f"a page of {origin} must not use the viewer at {asked}"
    return None


def _is_address(name: str) -> bool:
    try:
        ip_address(name)
    except ValueError:
        return False
    return True
