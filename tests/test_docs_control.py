"""What docs/control.md shows runs as it stands."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import srm_mbs as srm

PAGE = (Path(__file__).parent.parent / "docs" / "control.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)


def test_the_blocks_of_the_page_run_in_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    assert len(BLOCKS) == 7
    for block in BLOCKS:
        exec(block, names)
    for name in ("solution", "sampled", "bounced", "fall"):
        run = names[name]
        assert isinstance(run, srm.Solution)
        assert run.success, (name, run.message)
    assert len(names["bounced"].segments) > 1  # type: ignore[attr-defined]


def test_it_says_what_is_out_of_scope() -> None:
    assert "Contact between bodies" in PAGE[PAGE.index("## What this is not for") :]
