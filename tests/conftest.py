"""Shared fixtures: reference data."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

DATA = Path(__file__).parent / "data"


@pytest.fixture(scope="session")
def exact() -> dict[str, Any]:
    """High-accuracy solutions (40-digit Taylor series, elliptic functions), as decimal strings."""
    data: dict[str, Any] = json.loads((DATA / "exact_solutions.json").read_text())
    return data
