"""Terminals, pipes and encodings of every kind: one line says what is wrong, never a traceback."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from pathlib import Path

import pytest

import srm_mbs as srm
from srm_mbs.cli import app
from srm_mbs.cli.output import FAULT
from tests.cli.conftest import Describe
from tests.support.commands import ROOT, command, error_line, run, run_apart

posix = pytest.mark.skipif(os.name != "posix", reason="pipes and signals of POSIX")
HOSTILE, ESCAPED = r"\u001b[31mcr\u202eank", r"\x1b[31mcr\u202eank"
"""A name as TOML writes it, and as it is shown."""


def test_a_name_with_characters_that_do_not_print_is_refused_escaped(describe: Describe) -> None:
    path = describe(('name = "pin"', f'name = "{HOSTILE}"'))

    for output in (run("info", path, status=2), run("-v", "simulate", path, status=2)):
        assert ESCAPED in output
        assert "\x1b" not in output
        assert "\u202e" not in output


def test_names_in_errors_cannot_command_the_terminal(describe: Describe, tmp_path: Path) -> None:
    path = describe(('name = "pin"', f'"{HOSTILE}" = "pin"'))
    output = run("info", path, status=2)
    assert ESCAPED in output
    assert "\x1b" not in output
    assert "\u202e" not in output

    output = run("info", tmp_path / "no\x1b[2J\nerror: fake.toml", status=2)
    assert "\x1b" not in output
    assert error_line(output)


@pytest.mark.parametrize(
    ("encoding", "arguments"),
    [("ascii", ("info", "delta_robot")), ("latin-1", ("models",)), ("ascii", ("--help",))],
)
def test_what_an_encoding_lacks_is_shown_escaped(encoding: str, arguments: tuple[str, ...]) -> None:
    ran = run_apart(*arguments, PYTHONIOENCODING=encoding, PYTHONUTF8="0")
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout
    assert "Traceback" not in ran.stderr


def test_errors_are_shown_in_every_encoding(tmp_path: Path) -> None:
    ran = run_apart("info", tmp_path / "küçük 曲柄.toml", PYTHONIOENCODING="ascii")
    assert ran.returncode == 2
    assert "there is no such file" in error_line(ran.stderr)
    assert "Traceback" not in ran.stderr


@posix
@pytest.mark.parametrize("arguments", [("models",), ("info", "four_bar"), ("--help",)])
def test_a_reader_that_ends_early_ends_the_command_silently(arguments: tuple[str, ...]) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    try:
        ran = subprocess.run(
            command(*arguments),
            cwd=ROOT,
            stdout=writing,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    finally:
        os.close(writing)
    assert ran.returncode in (1, 2)
    assert "Traceback" not in ran.stderr
    assert "Exception ignored" not in ran.stderr


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="the full device of Linux")
@pytest.mark.parametrize("arguments", [("models",), ("info", "four_bar"), ("--help",)])
def test_an_output_that_is_full_is_an_error_of_one_line(arguments: tuple[str, ...]) -> None:
    with open("/dev/full", "w") as full:
        ran = subprocess.run(
            command(*arguments),
            cwd=ROOT,
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    assert ran.returncode == 2
    assert ran.stderr == "error: No space left on device\n"


@posix
@pytest.mark.parametrize(
    "closed",
    [
        "1>&- 2>&-",
        *(pytest.param(one, marks=pytest.mark.stress) for one in ("1>&-", "2>&-", "0<&-")),
    ],
)
def test_streams_may_be_closed(closed: str) -> None:
    for arguments, status in ((["info", "four_bar"], 0), (["info", "no such"], 2)):
        line = subprocess.list2cmdline(command(*arguments))
        ran = subprocess.run(
            ["/bin/sh", "-c", f"{line} {closed}"],
            cwd=ROOT,
            capture_output=True,
            text=True,
            check=False,
        )
        assert ran.returncode == status, ran.stderr
        assert "Traceback" not in ran.stderr


@pytest.mark.parametrize(
    ("columns", "term"),
    [
        ("0", "dumb"),
        *(
            pytest.param(*case, marks=pytest.mark.stress)
            for case in (("1", "unknown"), ("-5", ""), ("x", "dumb"), ("100000", "xterm-256color"))
        ),
    ],
)
def test_odd_terminals_show_tables(columns: str, term: str) -> None:
    pty = pytest.importorskip("pty")
    master, slave = pty.openpty()
    environment = os.environ | {"COLUMNS": columns, "TERM": term, "LINES": columns}
    with subprocess.Popen(
        command("info", "four_bar"), cwd=ROOT, stdout=slave, stderr=slave, env=environment
    ) as process:
        os.close(slave)
        shown = b""
        while True:
            try:
                part = os.read(master, 65536)
            except OSError:  # the end of a terminal
                break
            if not part:
                break
            shown += part
    os.close(master)
    assert process.returncode == 0, shown
    assert shown
    assert b"Traceback" not in shown


@posix
def test_ctrl_c_ends_a_command_with_status_130() -> None:
    with subprocess.Popen(
        command("-v", "modes", "four_bar", "--starts", 1_000_000),
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    ) as process:
        assert process.stderr is not None
        begun = process.stderr.readline()  # the mechanism is read
        time.sleep(0.5)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=30)
    assert process.returncode == 130, (begun, errors)
    assert errors.endswith("error: interrupted\n")
    assert "Traceback" not in errors


def test_a_fault_of_the_package_is_one_line_and_verbose_shows_where(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def broken(path: str, **_: object) -> srm.Mechanism:
        raise LookupError(f"no \x1b in {path}")

    monkeypatch.setattr(app.srm_mbs, "load", broken)

    output = run("info", "four_bar", status=FAULT)
    assert error_line(output).startswith(r"error: unexpected LookupError: no \x1b in four_bar. Rep")
    assert "test_terminals" in run_verbose("info", "four_bar")


def run_verbose(*arguments: str) -> str:
    from typer.testing import CliRunner

    return CliRunner().invoke(app.app, ["-v", *arguments]).output
