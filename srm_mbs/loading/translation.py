"""What every reader of another format makes: a URDF tree and the entries of our description.

The readers translate; from there on one path leads to the mechanism, whatever the file was, and
``srm-mbs convert`` writes just this.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Translation:
    """A file of another format in ours.

    Attributes
    ----------
    urdf
        Text of a URDF without loops, in the dialect of ``docs/formats.md``.
    entries
        Keys and values of a description (:mod:`srm_mbs.loading.description`) as ``tomllib`` would
        give them: ``loop``, ``force``, ``initial``, ``base``, ``gravity``, ...; without ``format``
        and ``urdf``.
    notes
        Sentences about what was approximated or ignored, and why.
    """

    urdf: str
    entries: dict[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
