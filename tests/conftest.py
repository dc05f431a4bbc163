"""Shared fixtures: reference data, a browser."""

from __future__ import annotations

import atexit
import json
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import srm_mbs as srm
from srm_mbs.integration.kernel import backend
from srm_mbs.visualization.animation.video import browser as headless_browser

DATA = Path(__file__).parent / "data"

# Tests leave the user's compiled code alone; all processes of a session share theirs.
_CACHE = tempfile.TemporaryDirectory(prefix="srm-mbs-tests-")
os.environ.setdefault("SRM_MBS_CACHE", _CACHE.name)
atexit.register(_CACHE.cleanup)

# What "auto" takes depends on what was compiled before: tests run on the kernel, unless they or the
# environment ask for another backend.  Without a kernel they ask for the Python reference, which
# runs would warn of.
if srm.backend() == "python":
    os.environ["SRM_MBS_BACKEND"] = "python"
os.environ.setdefault("SRM_MBS_BACKEND", "kernel")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--default-backend-only",
        action="store_true",
        help="Leave out the cases of tests that name their backend: with another default backend "
        "they are the same.",
    )


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if not config.option.default_backend_only:
        return

    def named(item: pytest.Item) -> bool:
        case = getattr(item, "callspec", None)
        return case is not None and case.params.get("backend", "auto") != "auto"

    config.hook.pytest_deselected(items=[item for item in items if named(item)])
    items[:] = [item for item in items if not named(item)]


def pytest_report_header() -> str:
    """The backend of the tests, and why it is not the kernel."""
    reason = (
        f" (the compiled kernel is not available: {backend.missing})" if backend.missing else ""
    )
    return f"srm_mbs: backend {srm.backend()}{reason}"


@pytest.fixture(scope="session")
def exact() -> dict[str, Any]:
    """High-accuracy solutions (40-digit Taylor series, elliptic functions), as decimal strings."""
    data: dict[str, Any] = json.loads((DATA / "exact_solutions.json").read_text())
    return data


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    try:
        with headless_browser() as launched:
            yield launched
    except srm.InputError as error:
        pytest.skip(str(error))


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Modules of stress tests alone take seconds to import, and by default none of them is run."""
    if collection_path.name == "stress" and config.option.markexpr == "not stress":
        return True
    return None
