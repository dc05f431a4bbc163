"""What docs/forces_and_drives.md shows runs as it stands."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import srm_mbs as srm
from srm_mbs.laws import LAW_TYPES
from srm_mbs.loading.description import parse_description

PAGE = (Path(__file__).parent.parent / "docs" / "forces_and_drives.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)


def test_the_python_blocks_run_in_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    assert len(blocks("python")) == 4
    for block in blocks("python"):
        exec(block, names)
    solution, stopped = names["solution"], names["stopped"]
    assert isinstance(solution, srm.Solution)
    assert isinstance(stopped, srm.Solution)
    assert solution.success
    assert solution.energy_balance.relative < 1e-6
    assert stopped.success
    assert 1.5 < stopped.joint("crank")[0].max() < 1.7  # it met the stop


@pytest.mark.parametrize("block", blocks("toml"))
def test_the_descriptions_are_valid(block: str) -> None:
    description = parse_description('format = 1\nurdf = "x.urdf"\n' + block, "x.toml")
    assert len(description.drive) + len(description.force) == block.count("[[")


def test_every_type_is_there() -> None:
    for name in (*srm.FORCE_TYPES, *LAW_TYPES):
        assert f"`{name}`" in PAGE or f'"{name}"' in PAGE
