"""What the README shows runs as it stands."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

import srm_mbs as srm

README = (Path(__file__).parent.parent / "README.md").read_text(encoding="utf-8")
PYTHON = re.findall(r"```python\n(.*?)```", README, re.DOTALL)


def test_the_python_blocks_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    assert len(PYTHON) == 3
    for block in PYTHON:
        exec(block, names)
    assert (tmp_path / "drift.png").stat().st_size > 10_000
    assert (tmp_path / "slider_crank.html").stat().st_size > 500_000
    solution = names["solution"]
    assert isinstance(solution, srm.Solution)
    assert solution.success


def test_the_description_shown_is_the_bundled_slider_crank() -> None:
    (shown,) = re.findall(r"```toml\n(.*?)```", README, re.DOTALL)
    folder = Path(__file__).parent.parent / "models"
    bundled = tomllib.loads((folder / "slider_crank.toml").read_text(encoding="utf-8"))
    assert tomllib.loads(shown)["loop"] == bundled["loop"]


def test_it_starts_with_exactly_two_commands() -> None:
    (first, *_) = re.findall(r"```sh\n(.*?)```", README, re.DOTALL)
    commands = [line for line in first.splitlines() if line and not line.startswith("#")]
    assert len(commands) == 2
    assert "pip install ." in commands[0]
    assert "srm-mbs simulate slider_crank" in commands[0]
    assert commands[1] == "tests/run"
