"""Memory that is left for the steps of a run."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

MEMINFO = Path("/proc/meminfo")
GROUPS = Path("/proc/self/cgroup")
GROUP_ROOT = Path("/sys/fs/cgroup")
FILES = (
    ("memory.max", "memory.current", "inactive_file"),
    ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
)
"""Limit and use of a control group, and the name of the part of its use that the system can take
back, of both versions of control groups."""


def free_memory() -> float:
    """Memory (bytes) that this program may still take: of the machine or, if that is less, of its
    container.  Where the system does not say, half of the memory of the machine, or infinity."""
    try:
        lines = MEMINFO.read_text().splitlines()
        available = next(line for line in lines if line.startswith("MemAvailable:"))
        free = 1024.0 * float(available.split()[1])
    except (OSError, StopIteration):
        return 0.5 * _physical_memory()
    return min([free, *(_left_in(group) for group in _control_groups())])


def _physical_memory() -> float:
    """Memory of this machine (bytes); infinite where the system does not say."""
    try:
        return float(os.sysconf("SC_PHYS_PAGES")) * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):  # Windows has no sysconf
        return np.inf


def _control_groups() -> list[Path]:
    """Folders of the control groups of this program that may limit its memory: within a container
    the root is its own."""
    found = []
    try:
        for line in GROUPS.read_text().splitlines():
            _, controllers, path = line.split(":", 2)
            if controllers in ("", "memory"):
                root = GROUP_ROOT / controllers
                found += [root, root / path.lstrip("/")]
    except (OSError, ValueError):
        pass
    return found


def _left_in(group: Path) -> float:
    """Memory that the limit of a control group leaves (bytes); infinite without a limit."""
    for limit, use, part in FILES:
        try:
            most = float((group / limit).read_text())  # "max" is no number
            used = float((group / use).read_text())
            lines = (group / "memory.stat").read_text().splitlines()
            files = next(float(line.split()[1]) for line in lines if line.split()[0] == part)
            return most - used + files
        except (OSError, ValueError, StopIteration):
            continue
    return np.inf
