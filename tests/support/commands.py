"""Commands of ``srm-mbs``, run in this process or in one of their own."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

from typer.testing import CliRunner

import srm_mbs as srm
from srm_mbs.cli.app import app

ROOT = Path(srm.__file__).parents[1]


def run(*args: object, status: int = 0) -> str:
    """Output, both streams, of a command run in this process."""
    result = CliRunner().invoke(app, [str(arg) for arg in args])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == status, result.output
    assert "Traceback" not in result.output
    return result.output


def command(*args: object) -> list[str]:
    """The command as a shell would start it."""
    return [sys.executable, "-m", "srm_mbs", *map(str, args)]


def run_apart(*args: object, **environment: str) -> subprocess.CompletedProcess[str]:
    """A command run in a process of its own, as from a shell with pipes."""
    return subprocess.run(
        command(*args),
        cwd=ROOT,
        env=os.environ | environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=240,
    )


def row(output: str, name: str) -> str:
    """The text after ``name`` in a table."""
    found = re.search(rf"^{re.escape(name)}  +(.*)$", output, re.MULTILINE)
    assert found, f"no row {name!r} in: {output}"
    return found[1]


def error_line(output: str) -> str:
    """The one line that reports an error."""
    (line,) = [line for line in output.splitlines() if line.startswith("error: ")]
    return line
