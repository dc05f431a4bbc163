"""Who may open the live page, what strangers can do to it, and when its server ends."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import struct
import subprocess
import sys
import textwrap
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
import umsgpack

import srm_mbs as srm
from srm_mbs.visualization.animation import server
from srm_mbs.visualization.animation.playback import close, play
from srm_mbs.visualization.animation.window import Window
from tests.support.bundled import load

ROOT = Path(__file__).parents[3]
LINUX = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")


@contextlib.contextmanager
def served() -> Iterator[Any]:
    """A played run."""
    visualizer = play(srm.simulate(load("four_bar"), 0.2), open_browser=False, block=False)
    try:
        yield visualizer
    finally:
        close(visualizer)


@pytest.fixture(scope="module")
def visualizer() -> Iterator[Any]:
    """A played run, whose server bears all that the tests of this file do to it."""
    with served() as one:
        yield one


def port_of(visualizer: Any) -> int:
    port = urlsplit(visualizer.url()).port
    assert port is not None
    return port


def path_of(visualizer: Any) -> str:
    return urlsplit(visualizer.url()).path


def asked(port: int, request: bytes, host: str = "127.0.0.1") -> bytes:
    """The first line of the answer to ``request``."""
    with socket.create_connection((host, port), timeout=20.0) as connection:
        connection.sendall(request)
        with connection.makefile("rb") as answer:
            return answer.readline().strip()


def get(port: int, path: str, *headers: str) -> bytes:
    return asked(port, "\r\n".join([f"GET {path} HTTP/1.1", *headers, "", ""]).encode())


def opening(port: int, path: str, origin: str) -> bytes:
    """The first line of the answer to a browser that opens a websocket from ``origin``."""
    return get(port, path, f"Host: 127.0.0.1:{port}", f"Origin: {origin}", *UPGRADE)


UPGRADE = (
    *("Connection: Upgrade", "Upgrade: websocket"),
    *("Sec-WebSocket-Version: 13", "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ=="),
)


@contextlib.contextmanager
def upgraded(visualizer: Any) -> Iterator[socket.socket]:
    """A connection of a page of the same origin, on which nothing is read but the first answer."""
    port, path = port_of(visualizer), path_of(visualizer)
    headers = (f"Host: 127.0.0.1:{port}", f"Origin: http://127.0.0.1:{port}", *UPGRADE)
    with socket.create_connection(("127.0.0.1", port), timeout=20.0) as connection:
        lines = [f"GET {path}socket HTTP/1.1", *headers, "", ""]
        connection.sendall("\r\n".join(lines).encode())
        assert connection.recv(12) == b"HTTP/1.1 101"
        yield connection


def hung_up(page: socket.socket) -> bool:
    """Whether the server has closed a connection, after all that it sent."""
    page.settimeout(0.5)
    try:
        while page.recv(2**20):
            pass
    except TimeoutError:
        return False
    except ConnectionError:
        return True
    return True


def still_draws(visualizer: Any) -> bool:
    """Whether the server accepts a command at once."""
    with visualizer.window.answering(10.0):
        visualizer["/probe"].set_transform(np.eye(4))
    return True


def commands_at(visualizer: Any) -> list[dict[str, Any]]:
    """The commands that a page receives which is opened now."""
    data = b""
    with upgraded(visualizer) as page:
        page.settimeout(0.5)
        with contextlib.suppress(TimeoutError):
            while received := page.recv(2**20):
                data += received
    data, found = data.partition(b"\r\n\r\n")[2], []
    while data:  # frames of a websocket: their head tells their length
        assert data[0] == 0x82
        wide = {126: 2, 127: 8}.get(data[1], 0)
        size = int.from_bytes(data[2 : 2 + wide], "big") if wide else data[1]
        found.append(umsgpack.unpackb(data[2 + wide : 2 + wide + size]))
        data = data[2 + wide + size :]
    return found


def test_the_page_has_a_random_address_and_is_given_to_nobody_who_does_not_know_it(
    visualizer: Any,
) -> None:
    port, path = port_of(visualizer), path_of(visualizer)
    own = f"Host: 127.0.0.1:{port}"
    assert len(path) > 30
    assert get(port, path, own) == b"HTTP/1.1 200 OK"
    for other in ("/", "/static/", "//", "/socket", f"{path[:-2]}/", "/" + "a" * 32 + "/"):
        assert get(port, other, own) == b"HTTP/1.1 404 Not Found", other
    for other in ("/", "//socket", "/" + "a" * 32 + "/socket"):
        answer = opening(port, other, f"http://127.0.0.1:{port}")
        assert answer == b"HTTP/1.1 404 Not Found", other
    window = Window("another page")
    try:
        assert urlsplit(window.web_url).path != path
    finally:
        window.close()


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:7000", "127.0.0.1.evil.example", "0.0.0.0", "[::]", ""]
)
def test_a_foreign_name_that_leads_here_gets_nothing(visualizer: Any, host: str) -> None:
    port, path = port_of(visualizer), path_of(visualizer)
    assert get(port, path, f"Host: {host}").startswith(b"HTTP/1.1 4")
    answer = get(port, f"{path}socket", f"Host: {host}", f"Origin: http://{host}", *UPGRADE)
    assert answer.startswith(b"HTTP/1.1 4")


def test_the_page_opens_through_a_forwarded_port_of_this_machine(visualizer: Any) -> None:
    for host in ("localhost:8080", "127.0.0.1:1234", "localhost"):
        answer = get(port_of(visualizer), path_of(visualizer), f"Host: {host}")
        assert answer == b"HTTP/1.1 200 OK"


def test_only_the_page_itself_gets_the_commands(visualizer: Any) -> None:
    port, path = port_of(visualizer), f"{path_of(visualizer)}socket"
    assert opening(port, path, f"http://127.0.0.1:{port}").startswith(b"HTTP/1.1 101")
    for origin in ("http://evil.example", f"http://127.0.0.1:{port + 1}", "null", "file://"):
        assert opening(port, path, origin) == b"HTTP/1.1 403 Forbidden", origin


@LINUX
def test_the_server_listens_on_one_port_of_the_loopback_only(visualizer: Any) -> None:
    with pytest.raises(ConnectionRefusedError):
        asked(port_of(visualizer), b"GET / HTTP/1.1\r\n\r\n", host="127.0.0.2")
    pid = visualizer.window.server_proc.pid
    sockets = {os.readlink(entry) for entry in Path(f"/proc/{pid}/fd").iterdir()}
    tables = [Path(f"/proc/{pid}/net/{name}").read_text().splitlines() for name in ("tcp", "tcp6")]
    rows = [line.split() for table in tables for line in table[1:]]
    listening = [row[1] for row in rows if row[3] == "0A" and f"socket:[{row[9]}]" in sockets]
    assert listening == [f"0100007F:{port_of(visualizer):04X}"]


def test_a_page_that_is_opened_late_gets_the_last_command_of_each_kind(visualizer: Any) -> None:
    node = visualizer["/late"]
    node.set_property("visible", False)
    node.set_property("visible", True)
    for x in (1.0, 2.0):
        place = np.eye(4)
        place[0, 3] = x
        node.set_transform(place)
    visualizer["/gone"].set_transform(np.eye(4))
    visualizer["/gone/within"].set_transform(np.eye(4))
    visualizer["/gone"].delete()
    found = commands_at(visualizer)
    of_node = [command for command in found if command["path"] == "/late"]
    assert [command["type"] for command in of_node] == ["set_property", "set_transform"]
    assert of_node[0]["value"] is True
    assert of_node[1]["matrix"][12] == 2.0
    assert not any(command["path"].startswith("/gone") for command in found)
    assert sum(command["type"] == "set_animation" for command in found) == 1


def test_a_new_object_of_a_node_has_none_of_the_properties_of_the_old_one() -> None:
    scene = server.Scene(b"", "token")
    assert scene.draw(server.PROPERTY, "/a/b", "colour", b"1")
    assert scene.draw(server.TRANSFORM, "a/b/", "", b"2")
    assert scene.draw(server.OBJECT, "/a/b", "", b"3")
    assert list(scene.commands.values()) == [b"2", b"3"]
    assert not scene.draw(b"?", "/a", "", b"4")
    assert scene.draw(server.DELETE, "/a/bc", "", b"5")
    assert list(scene.commands.values()) == [b"2", b"3"]
    assert scene.draw(server.DELETE, "/a", "", b"6")
    assert not scene.commands


def test_a_page_has_nothing_to_say(visualizer: Any) -> None:
    image = json.dumps({"data": "data:image/png;base64,aGVsbG8="})

    for kind, message in (
        *((0x81, image), (0x81, "x" * 10**6), (0x82, "\x00\xff" * 100), (0x81, "{")),
        *((0x81, "[" * 1000), (0x81, "\udcff"), (0x8F, "an unknown kind"), (0x01, "a part")),
    ):
        content = message.encode("utf-8", "surrogateescape")
        # A page masks what it sends, here with zeros.
        head = struct.pack("!BBQ4x", kind, 0x80 | 127, len(content))
        with upgraded(visualizer) as page, contextlib.suppress(ConnectionError):
            page.sendall(head + content)
            if kind == 0x01:
                page.sendall(head + content)
            while page.recv(2**20):
                pass
        # Nothing of it is the answer to the next command.
        assert still_draws(visualizer)
    visualizer.window._socket.settimeout(0.2)
    with pytest.raises(TimeoutError):
        visualizer.window._socket.recv(1)


@pytest.mark.parametrize(
    "request_",
    [
        b"\x00" * 100_000,
        b"GET / HTTP/1.1\r\n" + b"A: " + b"b" * 200_000,
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 99999999999\r\n\r\n",
        b"POST / HTTP/1.1\r\nHost: 127.0.0.1\r\nTransfer-Encoding: chunked\r\n\r\nffffffffff\r\n",
        b"GET / HTTP/1.1\r\nHost: a\r\nHost: 127.0.0.1\r\n\r\n",
        b"\xff\x00\x00\x00\x00\x00\x00\x00\x01\x7f",  # the greeting of zmq
    ],
)
def test_garbage_does_not_disturb_the_server(visualizer: Any, request_: bytes) -> None:
    with (
        contextlib.suppress(ConnectionError),
        socket.create_connection(("127.0.0.1", port_of(visualizer)), timeout=20.0) as connection,
    ):
        connection.sendall(request_)
        with contextlib.suppress(OSError):  # the server may have hung up
            connection.shutdown(socket.SHUT_WR)
        answer = connection.recv(4096)
        assert not answer.startswith((b"HTTP/1.1 2", b"HTTP/1.1 1"))
    assert still_draws(visualizer)


def test_connections_that_ask_nothing_do_not_keep_the_page_from_its_reader(visualizer: Any) -> None:
    port, path = port_of(visualizer), path_of(visualizer)
    with contextlib.ExitStack() as stack, upgraded(visualizer) as page:
        for _ in range(3 * server.MOST_CONNECTIONS):
            idle = stack.enter_context(socket.create_connection(("127.0.0.1", port)))
            with contextlib.suppress(ConnectionError):
                idle.sendall(b"GET / HT")
        assert get(port, path, f"Host: 127.0.0.1:{port}") == b"HTTP/1.1 200 OK"
        assert still_draws(visualizer)
        page.settimeout(0.5)
        assert not hung_up(page)


def test_a_bounded_number_of_pages_is_open(visualizer: Any) -> None:
    with contextlib.ExitStack() as stack:
        for _ in range(server.MOST_PAGES):
            stack.enter_context(upgraded(visualizer))
        with upgraded(visualizer) as page:
            assert hung_up(page)
    assert still_draws(visualizer)
    time.sleep(0.2)
    with upgraded(visualizer) as page:
        assert not hung_up(page)


def test_a_thousand_visits_do_not_block_a_server_whose_pipes_nobody_reads(visualizer: Any) -> None:
    for _ in range(1000):
        with upgraded(visualizer):
            pass
    assert still_draws(visualizer)


@LINUX
def test_a_page_that_reads_nothing_is_disconnected_before_it_fills_the_memory(
    visualizer: Any,
) -> None:
    status = Path(f"/proc/{visualizer.window.server_proc.pid}/status")
    heavy = "x" * 4 * 10**6
    with upgraded(visualizer) as page, visualizer.window.answering(60.0):
        for _ in range(60):
            visualizer["/heavy"].set_property("text", heavy)
        largest = next(line for line in status.read_text().splitlines() if "VmHWM" in line)
        assert int(largest.split()[1]) < 250_000
        with contextlib.suppress(ConnectionResetError):
            while page.recv(2**20):
                pass
    visualizer["/heavy"].delete()
    assert still_draws(visualizer)


@LINUX
@pytest.mark.parametrize("heir", ["", "os.fork() or time.sleep(60)"])
def test_the_server_ends_with_its_owner_also_if_that_is_killed(heir: str) -> None:
    """Also if another process has inherited what the owner had open."""
    program = f"""
        import os, time
        import srm_mbs as srm
        view = srm.LiveView(srm.load("four_bar"), open_browser=False)
        print(view.visualizer.window.server_proc.pid, view.visualizer.url(), flush=True)
        {heir}
        time.sleep(60)
    """
    with subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(program)],
        stdout=subprocess.PIPE,
        cwd=ROOT,
        start_new_session=True,
    ) as owner:
        try:
            assert owner.stdout is not None
            pid, address = owner.stdout.readline().decode().split()
            time.sleep(0.2)
            owner.kill()
            assert ended(int(pid), 10.0)
            with pytest.raises(ConnectionRefusedError):
                asked(urlsplit(address).port or 0, b"\r\n\r\n")
        finally:
            os.killpg(owner.pid, signal.SIGKILL)


def ended(pid: int, seconds: float) -> bool:
    """Whether a process ends in time, waited for by its parent or not."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        try:
            state = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
        except (FileNotFoundError, ProcessLookupError):
            return True
        if state == "Z":
            return True
        time.sleep(0.05)
    return False


def test_watching_a_run_executes_nothing_of_the_working_folder(tmp_path: Path) -> None:
    trap = "import pathlib; pathlib.Path(r'{}').write_text('')\n"
    names = ("tornado", "zmq", "meshcat", "srm_mbs", "asyncio", "runpy", "logging", "re", "hmac")
    for name in (*names, "sitecustomize", "usercustomize"):
        (tmp_path / f"{name}.py").write_text(trap.format(tmp_path / f"{name}.ran"))
    program = """
        import srm_mbs as srm
        mechanism = srm.load("four_bar")
        with srm.LiveView(mechanism, open_browser=False) as view:
            run = srm.simulate(mechanism, 0.2, progress=view)
            view.play(run)
            print(view.shown)
    """
    # -P: the owner itself is a program of another folder, as srm-mbs is.
    done = subprocess.run(
        [sys.executable, "-P", "-c", textwrap.dedent(program)],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip().isdecimal()
    assert list(tmp_path.glob("*.ran")) == []


def test_a_question_to_the_page_is_an_input_error_with_another_way(visualizer: Any) -> None:
    for question in (visualizer.get_image, visualizer.static_html):
        with pytest.raises(srm.InputError, match=r"Use solution\.export_html\(path\)"):
            question()
    assert still_draws(visualizer)


def test_waiting_for_a_page_ends_when_one_is_open() -> None:
    with served() as visualizer:
        with (
            pytest.raises(srm.InputError, match="does not answer within"),
            visualizer.window.answering(0.2),
        ):
            visualizer.wait()
        with upgraded(visualizer), visualizer.window.answering(20.0):
            visualizer.wait()


@pytest.mark.browser
def test_the_policy_of_the_page_lets_it_play_and_load_nothing_from_elsewhere(
    browser: Any, visualizer: Any
) -> None:
    context = browser.new_context(viewport={"width": 300, "height": 200})
    page, complaints = context.new_page(), []
    page.on("console", lambda message: complaints.append(message.text))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.goto(visualizer.url())
    for _ in range(600):
        if page.evaluate("viewer.animator.playing && viewer.animator.time > 0"):
            break
        page.wait_for_timeout(100.0)
    else:
        pytest.fail("the page does not play")
    assert [text for text in complaints if "Content Security Policy" in text] == []
    port = port_of(visualizer)
    address = f"http://localhost:{port}{path_of(visualizer)}"
    blocked = page.evaluate(
        "a => fetch(a, {mode: 'no-cors'}).then(() => false, () => true)", address
    )
    assert blocked
    context.close()
