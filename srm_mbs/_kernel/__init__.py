"""The compiled kernel: C++ sources, and the extension module built from them.

``core`` is the extension module, or None; ``missing`` then says why, and ``remedy`` what to do.

An installation has the extension beside this file.  A checkout has none: it uses the extension of
the srm-mbs that is installed for the same Python, if that was built from the same sources.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from importlib.machinery import PathFinder
from importlib.metadata import version
from importlib.util import module_from_spec
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

from srm_mbs._kernel.build_hash import fingerprint, install_command, installation_records

PACKAGE = "srm_mbs._kernel"
INSTALL_AGAIN = (
    "pip install --force-reinstall --no-deps --no-cache-dir <folder or address of srm-mbs>"
)
"""The command that builds the kernel of an installation again."""


class Kernel(NamedTuple):
    """The extension module, or why there is none.

    Attributes
    ----------
    core
        The extension module, or None.
    missing
        The reason why it is None, a clause whose subject "it" is the kernel; else empty.
    remedy
        The command that makes it available, as an imperative; else empty.
    """

    core: ModuleType | None
    missing: str = ""
    remedy: str = ""


def load(folder: Path, search: Sequence[str]) -> Kernel:
    """The first extension module that fits the sources and the installed Pinocchio.

    Parameters
    ----------
    folder
        ``srm_mbs/_kernel`` of a checkout or of an installation.
    search
        Folders of installed packages, as in ``sys.path``: searched for a checkout only.
    """
    sources = fingerprint(folder)
    refused: list[Kernel] = []
    for place in _places(folder, search if sources else ()):
        found = _load_from(place, folder, sources, search)
        if found.core is not None:
            return found
        refused.append(found)
    return refused[0] if refused else _not_built(folder, sources, search)


def _places(folder: Path, search: Sequence[str]) -> Iterator[Path]:
    """The folder itself, then those of installed packages, where they hold a built kernel."""
    for place in dict.fromkeys([folder, *(Path(entry, *PACKAGE.split(".")) for entry in search)]):
        if (place / "built.py").is_file():
            yield place


def _load_from(place: Path, folder: Path, sources: str, search: Sequence[str]) -> Kernel:
    """The extension module in ``place``, for the package in ``folder`` with these ``sources``."""
    built = _module("built", place)
    # Kernels that do not name their sources were built before the sources were compared.
    if sources and sources != getattr(built, "SOURCES", ""):
        reason = f"it was built from other sources than those in {folder.parents[1]}"
        return Kernel(None, reason, _build_again(folder, sources, search))
    built_against: str = built.PINOCCHIO
    installed = version("pin")
    minor = built_against.split(".")[:2]
    # Another Pinocchio would crash the interpreter.
    if minor != installed.split(".")[:2]:
        reason = f"it was built against Pinocchio {built_against}, but pin {installed} is installed"
        same_pin = f'Run: pip install "pin=={".".join(minor)}.*"'
        return Kernel(None, reason, _build_again(folder, sources, search) if sources else same_pin)
    import pinocchio  # noqa: F401 - loads the libraries that the kernel links to

    try:
        core = _module("_core", place)
    except ImportError as error:
        reason = f"it cannot be loaded: {error}"
        return Kernel(None, reason, _build_again(folder, sources, search))
    return Kernel(core)


def _build_again(folder: Path, sources: str, search: Sequence[str], before: str = "Run") -> str:
    """The command that builds the kernel for the package in ``folder``, as an imperative."""
    return f"{before}: {install_command(folder, search) if sources else INSTALL_AGAIN}"


def _module(name: str, place: Path) -> ModuleType:
    """The submodule ``name`` of this package, loaded from the folder ``place``."""
    spec = PathFinder.find_spec(f"{PACKAGE}.{name}", [str(place)])
    if spec is None or spec.loader is None:
        raise ModuleNotFoundError(f"{place} has no {name} for this Python", name=name)
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    if name == "_core":
        sys.modules[spec.name] = module
    return module


def _not_built(folder: Path, sources: str, search: Sequence[str]) -> Kernel:
    """Why no kernel was built for the package in ``folder``."""
    if sources and next(installation_records(search), None) is None:
        reason = "a checkout of the source has none of its own, and no srm-mbs is installed for "
        return Kernel(None, reason + sys.executable, _build_again(folder, sources, search))
    reason = (
        "it was not built when srm-mbs was installed, because there was no C++17 compiler or "
        "because it failed"
    )
    command = _build_again(folder, sources, search, "With a C++17 compiler, run")
    return Kernel(None, reason, f"{command} -v")


core, missing, remedy = load(Path(__file__).parent, sys.path)
