"""Memory of this process, as Linux counts it.

``ru_maxrss`` does not serve: it never falls, and in a child it begins at the largest memory of the
process that started it.  Nothing heavy is imported here: children measure themselves with it.
"""

from __future__ import annotations

import gc
import re
import sys
from collections.abc import Callable
from pathlib import Path

ON_LINUX = sys.platform.startswith("linux")


def largest() -> float:
    """Largest resident memory (MB) since the program began or :func:`growth` was called last."""
    return _status("VmHWM")


def growth(work: Callable[[], object]) -> float:
    """How far (MB) resident memory rises above its start while ``work`` runs."""
    gc.collect()
    Path("/proc/self/clear_refs").write_text("5")  # the largest memory is the present one
    start = _status("VmRSS")
    work()
    return largest() - start


def _status(entry: str) -> float:
    found = re.search(rf"{entry}:\s*(\d+) kB", Path("/proc/self/status").read_text())
    assert found is not None
    return int(found[1]) * 1024 / 1e6
