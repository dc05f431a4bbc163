"""What the numbers were measured on."""

from __future__ import annotations

import os
import platform
from importlib import metadata
from pathlib import Path

PACKAGES = (
    "srm-mbs",
    "pin",
    "numpy",
    "scipy",
    "matplotlib",
    "mujoco",
    "exudyn",
    "scikit-sundae",
    "scipy-dae",
    "heyoka",
)


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next(
        (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")),
        platform.processor(),
    )


def describe() -> dict[str, str | int | None]:
    """Processor, number of processors, system and Python; no host name."""
    return {
        "processor": _processor(),
        "architecture": platform.machine(),
        "processors": os.cpu_count(),
        "system": platform.system(),
        "python": platform.python_version(),
    }


def versions() -> dict[str, str | None]:
    """Versions of the packages that are measured; None for those that are not installed."""
    import srm_mbs

    found: dict[str, str | None] = {}
    for name in PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = None
    found["srm-mbs"] = srm_mbs.__version__  # the checkout, not what may be installed beside it
    return found
