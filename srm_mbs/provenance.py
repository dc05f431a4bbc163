"""Where a mechanism came from, and what its description says besides the mechanism itself."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Source:
    """Where a mechanism came from: enough to load it again, and to draw it.

    Attributes
    ----------
    description
        Text of the TOML description.
    urdf
        Text of the URDF as it was read.
    urdf_path
        Where that URDF lay, for mesh files relative to it; may be gone when a run is replayed.
    path
        The description's own path, for messages.
    base, gravity
        As used: the description's, unless the caller gave others.
    format
        Format of the file that held the links and joints.
    """

    description: str
    urdf: str
    urdf_path: str
    path: str
    base: str
    gravity: tuple[float, float, float]
    format: str = "URDF"


@dataclass(frozen=True)
class SimulationDefaults:
    """Defaults of the command line from ``[simulation]``; ``None`` where the file is silent."""

    t_end: float | None = None
    rtol: float | None = None
    atol: float | None = None
