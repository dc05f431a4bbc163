"""meshcat's server for the page of :mod:`srm_mbs.visualization.animation.page`.

``python -m srm_mbs.visualization.animation.server`` reads the page from standard input, prints the
addresses as meshcat does, and passes commands to every page that is open, or is opened later.
"""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import suppress
from typing import IO, TYPE_CHECKING, Any, cast

from srm_mbs.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

SERVERLESS = "Use solution.export_html(path), which needs no server"
"""Remedy if the server does not work."""


def start_server(page: str) -> tuple[subprocess.Popen[bytes], str, str]:
    """Serve ``page`` from a new process.

    Returns
    -------
    (process, zmq, web)
        The process, the address for commands, and that for browsers.

    Raises
    ------
    InputError
        If the process ends before it serves.
    """
    # The new process finds the package and meshcat on the path of this one.
    paths = os.pathsep.join(path for path in sys.path if path)
    process = subprocess.Popen(
        [sys.executable, "-u", "-m", __name__],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env=os.environ | {"PYTHONPATH": paths},
        start_new_session=True,  # Ctrl-C ends the player only
    )
    to_server, from_server = cast(IO[bytes], process.stdin), cast(IO[bytes], process.stdout)
    with suppress(OSError):  # it may have ended
        to_server.write(page.encode("utf-8"))
    with suppress(OSError):
        to_server.close()
    lines = [from_server.readline().decode().strip() for _ in range(2)]
    found = dict(line.split("=", 1) for line in lines if "=" in line)
    if not {"zmq_url", "web_url"} <= found.keys():
        process.kill()
        process.stdin = None
        words = process.communicate()[1].decode(errors="replace").strip().splitlines()
        raise InputError(
            f"meshcat cannot start its server (exit code {process.returncode})"
            + (f": {words[-1]}" if words else ""),
            remedy=SERVERLESS,
        )
    return process, found["zmq_url"], found["web_url"]


def _serve(page: bytes) -> None:
    """Serve until the process is killed."""
    import warnings

    with warnings.catch_warnings():
        # meshcat imports a deprecated module of pyzmq.
        warnings.simplefilter("ignore", DeprecationWarning)
        import tornado.web
        from meshcat.servers import zmqserver

    class Page(tornado.web.RequestHandler):
        def get(self, *_: Any) -> None:
            self.set_header("Cache-Control", "no-store")
            self.finish(page)

    class Bridge(zmqserver.ZMQWebSocketBridge):  # type: ignore[misc]
        def make_app(self) -> Any:
            routes: Sequence[Any] = [
                (r"/static/(.*)", Page),
                (r"/", zmqserver.WebSocketHandler, {"bridge": self}),
            ]
            return tornado.web.Application(routes)

    bridge = Bridge()
    sys.stdout.write(f"zmq_url={bridge.zmq_url}\nweb_url={bridge.web_url}\n")
    sys.stdout.flush()
    bridge.run()


if __name__ == "__main__":
    _serve(sys.stdin.buffer.read())
