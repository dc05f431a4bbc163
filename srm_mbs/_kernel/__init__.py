"""The compiled kernel: C++ sources, and the extension module built from them.

``core`` is the extension module, or None; ``missing`` then says why.
"""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import version
from types import ModuleType

INSTALL_AGAIN = (
    "install srm-mbs again from its source: "
    "pip install --force-reinstall --no-deps --no-cache-dir <folder or address of srm-mbs>"
)


def _load() -> tuple[ModuleType | None, str]:
    """The extension module, or why there is none."""
    try:
        built_against: str = import_module("srm_mbs._kernel.built").PINOCCHIO
    except ModuleNotFoundError:
        return None, (
            "it was not built when srm-mbs was installed, because there was no C++17 compiler "
            f"or because it failed; {INSTALL_AGAIN} (with -v, it says why)"
        )
    installed = version("pin")
    if built_against.split(".")[:2] != installed.split(".")[:2]:
        return None, (
            f"it was built against Pinocchio {built_against}, but pin {installed} is installed; "
            f"{INSTALL_AGAIN}"
        )
    import pinocchio  # noqa: F401 - loads the libraries that the kernel links to

    try:
        return import_module("srm_mbs._kernel._core"), ""
    except ImportError as error:
        return None, f"it cannot be loaded: {error}; {INSTALL_AGAIN}"


core, missing = _load()
