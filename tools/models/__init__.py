"""Where the larger bundled mechanisms come from: geometry computed, URDF and TOML written.

    python -m tools.models

Run from a checkout; writes ``models/NAME.toml`` and ``urdf/NAME.urdf``.  A test checks that the
files are what this writes.
"""

from __future__ import annotations

from collections.abc import Callable


def made() -> dict[str, Callable[[], tuple[str, str]]]:
    """What makes each model: URDF, empty for a linkage, and description, by name."""
    from tools.models.gears import GEARS
    from tools.models.parallel import PARALLEL
    from tools.models.planar import PLANAR
    from tools.models.spatial import SPATIAL

    return PLANAR | SPATIAL | PARALLEL | GEARS
