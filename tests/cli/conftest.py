"""Descriptions that commands read."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.support.commands import ROOT

Describe = Callable[..., Path]


@pytest.fixture
def describe(tmp_path: Path) -> Describe:
    """Writes a description of the bundled four-bar linkage with parts of its text replaced."""

    def write(*changes: tuple[str, str]) -> Path:
        text = (ROOT / "models" / "four_bar.toml").read_text(encoding="utf-8")
        urdf = ROOT / "urdf" / "four_bar.urdf"
        for old, new in (("../urdf/four_bar.urdf", urdf.as_posix()), *changes):
            assert old in text
            text = text.replace(old, new)
        path = tmp_path / "mine.toml"
        path.write_text(text, encoding="utf-8")
        return path

    return write
