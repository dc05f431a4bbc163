"""The compiled kernel: C++ sources, and the extension module built from them.

``core`` is the extension module, or None; ``missing`` then says why.
"""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from types import ModuleType

from srm_mbs._kernel.build_hash import fingerprint

INSTALL_AGAIN = (
    "install srm-mbs again from its source: "
    "pip install --force-reinstall --no-deps --no-cache-dir <folder or address of srm-mbs>"
)
OUTDATED = "it was built from other sources (install again: pip install -e .)"
"""``missing`` of a checkout whose sources have changed since the kernel was built."""


def _load() -> tuple[ModuleType | None, str]:
    """The extension module, or why there is none."""
    try:
        built = import_module("srm_mbs._kernel.built")
    except ModuleNotFoundError:
        return None, (
            "it was not built when srm-mbs was installed, because there was no C++17 compiler "
            f"or because it failed; {INSTALL_AGAIN} (with -v, it says why)"
        )
    built_against: str = built.PINOCCHIO
    installed = version("pin")
    if built_against.split(".")[:2] != installed.split(".")[:2]:
        return None, (
            f"it was built against Pinocchio {built_against}, but pin {installed} is installed; "
            f"{INSTALL_AGAIN}"
        )
    sources = fingerprint(Path(__file__).parent)
    # A kernel that does not say from what it was built is older than this question.
    if sources and sources != getattr(built, "SOURCES", ""):
        return None, OUTDATED
    import pinocchio  # noqa: F401 - loads the libraries that the kernel links to

    try:
        return import_module("srm_mbs._kernel._core"), ""
    except ImportError as error:
        return None, f"it cannot be loaded: {error}; {INSTALL_AGAIN}"


core, missing = _load()
