"""The server of the live page: a program of its own, which imports tornado and nothing else.

:class:`srm_mbs.visualization.animation.window.Window` starts it.  Its standard input is one end of
a pair of connected sockets, on which only its owner writes: first the page and a token, then
drawing commands of meshcat.  Each is answered by one byte.  It passes the commands to every page
that is open, and to pages that are opened later those that are still valid.

It listens on 127.0.0.1 only and answers requests for ``/<token>/`` (the page) and
``/<token>/socket`` (the commands, a websocket).  Pages have nothing to say: whoever sends a message
is disconnected.  The server ends when its standard input does, and so when its owner is killed.
"""

from __future__ import annotations

import asyncio
import hmac
import logging
import os
import re
import socket
import struct
import sys
from contextlib import suppress
from typing import Any

from tornado.httpserver import HTTPServer
from tornado.ioloop import PeriodicCallback
from tornado.iostream import IOStream, StreamClosedError
from tornado.netutil import bind_sockets
from tornado.web import Application, HTTPError, RequestHandler
from tornado.websocket import WebSocketClosedError, WebSocketHandler

HEADER = struct.Struct("!cIIQ")
"""Before each command: its kind, and the bytes of the path, of the name of a property, of the
data, which follow in this order."""
PAGE, OBJECT, TRANSFORM, PROPERTY, ANIMATION, DELETE, WAIT = (
    *(b"g", b"o", b"t", b"p", b"a", b"d", b"w"),
)
"""Kinds of commands: the page itself, with the token as its path; those of meshcat; and one that
is answered when a page is open."""
DRAWING = (OBJECT, TRANSFORM, PROPERTY, ANIMATION)
DONE = b"+"
"""Answer to a command."""
LARGEST_COMMAND = 2**32
"""Bytes of a command."""

HOST = "127.0.0.1"
PORTS = (*range(7000, 7100), 0)
"""Ports that are tried in this order; 0 is any free one."""
OWN_HOSTS = re.compile(r"(127\.0\.0\.1|localhost)(:[0-9]{1,5})?")
"""Names under which a browser of this machine asks for the page, through a forwarded port too.
Any other one belongs to a page of somebody else, whose name now leads here."""
HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "default-src 'none'; script-src 'unsafe-inline'; "
    "style-src 'unsafe-inline'; img-src data: blob:; font-src data:; "
    "connect-src 'self' data: blob:",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}
MOST_CONNECTIONS, MOST_PAGES = 100, 20
"""Open connections, and open pages."""
REQUEST_TIME = 10.0
"""Time (s) for a request to arrive, and for an idle connection to make the next one."""
LARGEST_REQUEST = 16_384
"""Bytes of a request."""
LARGEST_MESSAGE = 1024
"""Bytes of a message of a page."""
LARGEST_BACKLOG = 64 * 10**6
"""Bytes, besides those of the scene, that a page may be behind before it is disconnected."""
OWNER_INTERVAL = 1000
"""Time (ms) between two looks whether the owner lives."""


class Scene:
    """The commands that make the picture, and the pages that show it."""

    def __init__(self, page: bytes, token: str) -> None:
        self.page = page
        self.token = token.encode()
        self.commands: dict[tuple[str, bytes, str], bytes] = {}
        self.pages: set[Socket] = set()
        self.opened = asyncio.Event()

    def draw(self, kind: bytes, path: str, name: str, data: bytes) -> bool:
        """Keep a command and pass it on; whether its kind is known."""
        path = "/".join(part for part in path.split("/") if part)
        if kind == DELETE:
            self._forget(lambda key: not path or f"{key[0]}/".startswith(f"{path}/"))
        elif kind in DRAWING:
            if kind == OBJECT:  # a new object has no properties yet
                self._forget(lambda key: key[0] == path and key[1] == PROPERTY)
            key = (path, kind, name)
            self.commands.pop(key, None)  # the last one of its kind, in the order of arrival
            self.commands[key] = data
        else:
            return False
        for page in list(self.pages):
            page.show(data)
        return True

    def _forget(self, obsolete: Any) -> None:
        self.commands = {key: data for key, data in self.commands.items() if not obsolete(key)}

    def size(self) -> int:
        """Bytes of all commands that are kept."""
        return sum(map(len, self.commands.values()))


class Private(RequestHandler):
    """Answers those who know the token, and ask for it under a name of this machine."""

    def initialize(self, scene: Scene, door: Door) -> None:
        self.scene, self.door = scene, door

    def prepare(self) -> None:
        hosts = self.request.headers.get_list("Host")
        if len(hosts) != 1 or not OWN_HOSTS.fullmatch(hosts[0]):
            raise HTTPError(403)
        if not hmac.compare_digest(str(self.path_args[0]).encode(), self.scene.token):
            raise HTTPError(404)


class Page(Private):
    """The page."""

    def get(self, _: str) -> None:
        for name, value in HEADERS.items():
            self.set_header(name, value)
        self.finish(self.scene.page)


class Socket(Private, WebSocketHandler):
    """The commands for one page, which come from the same origin only (tornado's check)."""

    def open(self, *_: str) -> None:
        self.behind = 0
        if len(self.scene.pages) >= MOST_PAGES:
            self._stream().close()
            return
        self.set_nodelay(True)
        self.door.keep(self._stream())
        self.scene.pages.add(self)
        self.scene.opened.set()
        for data in self.scene.commands.values():
            self.show(data)

    def _stream(self) -> Any:
        connection: Any = self.ws_connection
        return connection.stream

    def show(self, data: bytes) -> None:
        """Send a command; a page that does not read them is disconnected."""
        if self.behind > LARGEST_BACKLOG + self.scene.size():
            self._stream().close()
            return
        with suppress(WebSocketClosedError):
            sent = self.write_message(data, binary=True)
            self.behind += len(data)
            sent.add_done_callback(lambda done: self._count(done, len(data)))

    def _count(self, done: asyncio.Future[None], size: int) -> None:
        self.behind -= size
        if not done.cancelled():
            done.exception()  # the page has gone: on_close follows

    def on_message(self, _: str | bytes) -> None:
        self._stream().close()

    def on_close(self) -> None:
        self.scene.pages.discard(self)
        if not self.scene.pages:
            self.scene.opened.clear()


class Door(HTTPServer):
    """Accepts a bounded number of connections: a new one takes the place of the oldest one that
    is not a page."""

    def initialize(self, *args: Any, **kwargs: Any) -> None:
        super().initialize(*args, **kwargs)
        self._streams: list[IOStream] = []
        self._kept: set[IOStream] = set()

    def handle_stream(self, stream: IOStream, address: Any) -> None:
        self._streams = [known for known in self._streams if not known.closed()]
        self._kept = {known for known in self._kept if not known.closed()}
        if len(self._streams) >= MOST_CONNECTIONS:
            oldest = next(known for known in self._streams if known not in self._kept)
            oldest.close()
        self._streams.append(stream)
        super().handle_stream(stream, address)

    def keep(self, stream: IOStream) -> None:
        """Never close ``stream``, the connection of a page, for a new one."""
        self._kept.add(stream)


def listen(scene: Scene) -> int:
    """Serve ``scene``; returns the port.

    Raises
    ------
    OSError
        If no port can be bound.
    """
    application = Application(websocket_max_message_size=LARGEST_MESSAGE)
    door = Door(
        application,
        idle_connection_timeout=REQUEST_TIME,
        body_timeout=REQUEST_TIME,
        max_header_size=LARGEST_REQUEST,
        max_body_size=LARGEST_REQUEST,
    )
    own = {"scene": scene, "door": door}
    application.add_handlers(".*", [(r"/([^/]*)/", Page, own), (r"/([^/]*)/socket", Socket, own)])
    for port in PORTS:
        try:
            sockets = bind_sockets(port, HOST)
        except OSError:
            if port == PORTS[-1]:
                raise
            continue
        break
    door.add_sockets(sockets)
    bound: int = sockets[0].getsockname()[1]
    return bound


async def read_command(owner: IOStream) -> tuple[bytes, str, str, bytes]:
    """Kind, path, name and data of the next command.

    Raises
    ------
    StreamClosedError
        If the owner has ended, or writes no commands.
    """
    kind, *sizes = HEADER.unpack(await owner.read_bytes(HEADER.size))
    if sum(sizes) > LARGEST_COMMAND:
        owner.close()
    path, name, data = [await owner.read_bytes(size) if size else b"" for size in sizes]
    return kind, path.decode(), name.decode(), data


async def serve(owner: IOStream) -> None:
    """Serve until the owner ends, or sends a command of an unknown kind."""
    kind, token, _, page = await read_command(owner)
    if kind != PAGE or not token:
        return
    scene = Scene(page, token)
    port = listen(scene)
    _be_silent()
    await owner.write(f"http://{HOST}:{port}/{token}/\n".encode())
    while True:
        kind, path, name, data = await read_command(owner)
        if kind == WAIT:
            await scene.opened.wait()
        elif not scene.draw(kind, path, name, data):
            return
        await owner.write(DONE)


def _be_silent() -> None:
    """Write nothing any more: nobody reads it, and strangers cause it."""
    logging.disable()
    nowhere = os.open(os.devnull, os.O_RDWR)
    for stream in (1, 2):
        os.dup2(nowhere, stream)
    os.close(nowhere)


async def main() -> None:
    """Serve the owner at the other end of standard input."""
    parent = os.getppid()

    def look() -> None:
        # Where others have inherited the owner's end of the pair, it outlives the owner.
        if os.getppid() != parent:
            os._exit(0)

    PeriodicCallback(look, OWNER_INTERVAL).start()
    owner = IOStream(socket.socket(fileno=sys.stdin.fileno()), max_buffer_size=LARGEST_COMMAND)
    with suppress(StreamClosedError):
        await serve(owner)


if __name__ == "__main__":
    asyncio.run(main())
    os._exit(0)  # at once: nobody waits for what pages have not read
