"""The mechanisms that come with the package."""

from __future__ import annotations

import re
from pathlib import Path

_GENERATED = re.compile(r"n_four_bar_([1-9][0-9]{0,8})\Z")


def models_folder() -> Path:
    """Folder of the bundled descriptions: inside an installed package, beside it in a checkout."""
    package = Path(__file__).resolve().parent.parent
    installed = package / "models"
    return installed if installed.is_dir() else package.parent / "models"


def bundled_models() -> tuple[str, ...]:
    """Names that :func:`srm_mbs.load` takes without a path.

    ``n_four_bar_<N>`` is generated for any N beside those listed.
    """
    return tuple(sorted(path.stem for path in models_folder().glob("*.toml")))


def generated_size(name: str) -> int | None:
    """N if ``name`` is ``n_four_bar_<N>``, else None."""
    match = _GENERATED.match(name)
    return int(match[1]) if match else None
