"""The owner's end of a live page: starts its server and sends it drawing commands.

:class:`Window` takes the place of ``meshcat.visualizer.ViewerWindow``, whose server listens for
commands of anybody on a second port.
"""

from __future__ import annotations

import os
import secrets
import socket
import subprocess
import sys
import tempfile
import time
import webbrowser
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NoReturn

from srm_mbs.errors import InputError
from srm_mbs.visualization.animation import server

SERVERLESS = "Use solution.export_html(path), which needs no server"
"""Remedy if the server does not work."""
START_TIME = 60.0
"""Time (s) for the server to start."""
KINDS = {
    "set_object": server.OBJECT,
    "set_transform": server.TRANSFORM,
    "set_property": server.PROPERTY,
    "set_animation": server.ANIMATION,
    "delete": server.DELETE,
}
"""Kinds of meshcat's commands by their types."""
# Isolated, without the path of this process: the server imports the standard library and tornado,
# and nothing of the working folder.
START = (
    "import runpy, sys; sys.path.append(sys.argv[1]); runpy.run_path(sys.argv[2], None, '__main__')"
)
LONGEST_TOKEN = 32
# A killed server must not kill its owner as well, whatever it does with SIGPIPE.
_SENDING = getattr(socket, "MSG_NOSIGNAL", 0)


class Window:
    """A served page, to which a ``meshcat.Visualizer`` sends its commands.

    Parameters
    ----------
    page
        The HTML page.

    Attributes
    ----------
    web_url
        Address of the page, with the token that it takes to open it.
    server_proc
        The process of the server, which ends when :meth:`close` is called and when this process
        ends in any way.

    Raises
    ------
    InputError
        If the server does not start.
    """

    def __init__(self, page: str) -> None:
        import tornado

        folder = Path(tornado.__file__).resolve().parents[1]
        program = Path(server.__file__).resolve()
        self._patience: float | None = None
        self._remedy = SERVERLESS
        self._unsent = memoryview(b"")
        self._unanswered = 0
        self._socket, other = socket.socketpair()
        # A file holds whatever the server writes until it starts; a pipe that is full blocks it.
        with tempfile.TemporaryFile() as said:
            try:
                self.server_proc = subprocess.Popen(
                    [sys.executable, "-I", "-S", "-c", START, str(folder), str(program)],
                    stdin=other.fileno(),
                    stdout=subprocess.DEVNULL,
                    stderr=said,
                    cwd=os.path.sep,
                    start_new_session=True,  # Ctrl-C ends the player only
                )
            except OSError as error:
                self._socket.close()
                raise InputError(
                    f"the server of the page cannot start: {error.strerror}", remedy=SERVERLESS
                ) from error
            finally:
                other.close()
            try:
                self.web_url = self._start(page)
            except BaseException as error:
                self.close()
                if not isinstance(error, OSError):
                    raise
                said.seek(0)
                words = said.read().decode(errors="replace").strip().splitlines()
                raise InputError(
                    f"the server of the page cannot start (exit code {self.server_proc.returncode})"
                    + (f": {words[-1]}" if words else ""),
                    remedy=SERVERLESS,
                ) from error

    def _start(self, page: str) -> str:
        """Hand over the page and the token; returns the address.

        Raises
        ------
        OSError
            If the server ends, or is not ready in time.
        """
        deadline = time.monotonic() + START_TIME
        token = secrets.token_urlsafe()[:LONGEST_TOKEN]
        self._unsent = _frame(server.PAGE, token, "", page.encode("utf-8"))
        self._write(deadline)
        address = b""
        while not address.endswith(b"\n"):
            address += self._read(4096, deadline)
        return address.decode().strip()

    # -- commands ---------------------------------------------------------------------------------

    def send(self, command: Any) -> None:
        """Send a command of meshcat, and wait until the server has accepted it.

        Raises
        ------
        InputError
            If the server does not accept it in the time of :meth:`answering`, or has stopped; if
            the command asks for an answer of the page.
        """
        import umsgpack  # type: ignore[import-untyped]

        content = command.lower()
        kind = KINDS.get(content["type"])
        if kind is None:
            self._refuse(content["type"])
        name = content["property"] if kind == server.PROPERTY else ""
        self._exchange(_frame(kind, content["path"], name, umsgpack.packb(content)))

    def wait(self) -> None:
        """Wait until a page is open; raises as :meth:`send`."""
        self._exchange(_frame(server.WAIT, "", "", b""))

    def open(self) -> Window:
        """Open the page in a browser."""
        webbrowser.open(self.web_url, new=2)
        return self

    def get_scene(self) -> NoReturn:
        """Refused, with another way."""
        self._refuse("get_scene")

    def get_image(self) -> NoReturn:
        """Refused, with another way."""
        self._refuse("capture_image")

    def _refuse(self, kind: str) -> NoReturn:
        raise InputError(
            f"the page does not answer to {kind!r}",
            remedy="Use solution.export_html(path) or solution.export_image(path)",
        )

    @contextmanager
    def answering(self, seconds: float, remedy: str = SERVERLESS) -> Iterator[None]:
        """Context in which the server has ``seconds`` to accept each command; without it, any
        time.  Errors have the ``remedy``.

        Raises
        ------
        InputError
            If the server does not accept a command in time, or has stopped.
        """
        before = self._patience, self._remedy
        self._patience, self._remedy = seconds, remedy
        try:
            if self.server_proc.poll() is not None:
                raise self._stopped()
            yield
        finally:
            self._patience, self._remedy = before

    def _stopped(self) -> InputError:
        return InputError("the server of the page has stopped", remedy=self._remedy)

    def _exchange(self, frame: memoryview) -> None:
        """Send a command and receive its answer."""
        deadline = None if self._patience is None else time.monotonic() + self._patience
        try:
            self._settle(deadline)  # a command that was not accepted in time
            self._unsent, self._unanswered = frame, 1
            self._settle(deadline)
        except TimeoutError as error:
            raise InputError(
                f"the server of the page does not answer within {self._patience:g} s",
                remedy=self._remedy,
            ) from error
        except OSError as error:
            raise self._stopped() from error

    def _settle(self, deadline: float | None) -> None:
        self._write(deadline)
        while self._unanswered:
            self._unanswered -= len(self._read(self._unanswered, deadline))

    def _write(self, deadline: float | None) -> None:
        while self._unsent:
            self._socket.settimeout(_until(deadline))
            self._unsent = self._unsent[self._socket.send(self._unsent, _SENDING) :]

    def _read(self, size: int, deadline: float | None) -> bytes:
        self._socket.settimeout(_until(deadline))
        received = self._socket.recv(size)
        if not received:
            raise ConnectionResetError
        return received

    # -- end --------------------------------------------------------------------------------------

    @property
    def closed(self) -> bool:
        """Whether :meth:`close` has been called."""
        return self._socket.fileno() < 0

    def close(self) -> None:
        """Stop serving; harmless a second time."""
        with suppress(OSError):
            self._socket.close()
        self.server_proc.kill()
        self.server_proc.wait()


def _frame(kind: bytes, path: str, name: str, data: bytes) -> memoryview:
    """A command as :data:`srm_mbs.visualization.animation.server.HEADER` has it."""
    parts = path.encode(), name.encode(), data
    return memoryview(b"".join([server.HEADER.pack(kind, *map(len, parts)), *parts]))


def _until(deadline: float | None) -> float | None:
    """Seconds to ``deadline``.

    Raises
    ------
    TimeoutError
        If it has passed.
    """
    if deadline is None:
        return None
    left = deadline - time.monotonic()
    if left <= 0.0:
        raise TimeoutError
    return left
