"""Which sources the kernel is built from: asked by CMake on building, and on loading it."""

from __future__ import annotations

import hashlib
from pathlib import Path


def fingerprint(folder: Path) -> str:
    """SHA-256 of the kernel's sources and of what builds them; empty where they do not lie beside.

    Parameters
    ----------
    folder
        ``srm_mbs/_kernel`` of a checkout, or of an installation, which has no sources.
    """
    build = folder.parents[1] / "CMakeLists.txt"
    files = sorted((folder / "src").glob("[!.]*.[ch]pp"))
    if not files or not build.is_file():
        return ""
    found = hashlib.sha256()
    for path in (build, *files):
        content = path.read_bytes()
        found.update(f"{path.name} {len(content)}\n".encode())
        found.update(content)
    return found.hexdigest()
