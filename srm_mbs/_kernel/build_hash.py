"""Builds of the kernel: the hash of its sources, and the command that builds and installs it.

CMake runs this file alone when it builds the kernel, so it imports the standard library only.  A
kernel is loaded where the hash that it was built with equals the hash of the sources beside the
Python modules.
"""

from __future__ import annotations

import hashlib
import shlex
from collections.abc import Iterator, Sequence
from importlib.metadata import distributions
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


def installation_records(search: Sequence[str]) -> Iterator[str]:
    """Records of where each srm-mbs in ``search`` was installed from (PEP 610; may be empty).

    Parameters
    ----------
    search
        Folders of installed packages, as in ``sys.path``.
    """
    for found in distributions(name="srm-mbs", path=list(search)):
        yield found.read_text("direct_url.json") or ""


def install_command(folder: Path, search: Sequence[str]) -> str:
    """The shell command that installs a checkout, in place where it is installed so now.

    Parameters
    ----------
    folder
        ``srm_mbs/_kernel`` of the checkout.
    search
        Folders of installed packages, as in ``sys.path``.
    """
    editable = '"editable": true' in next(installation_records(search), "")
    return f"pip install {'-e ' * editable}{shlex.quote(str(folder.parents[1]))}"
