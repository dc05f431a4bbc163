"""Loops of onshape-to-robot: pairs of frames ``closing_<name>_1`` and ``closing_<name>_2``.

The exporter writes a mate whose name begins with ``closing_`` as two frames, which in its URDFs are
links on fixed joints.  A revolute mate gets two more frames, 0.1 m along its axis:
``closing_<name>_1_z`` and ``closing_<name>_2_z``.  Of the other mates (ball, fastened, slider) the
URDF does not say the type: the origins are joined, with a note.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any

CLOSING = re.compile(r"(closing_.+)_1\Z")


def _named_by(own: Mapping[str, Any]) -> set[str]:
    """Links and frames at which the description itself has closures."""
    found = set()
    for loop in own.get("loop", ()):
        for side in "ab":
            end = loop.get(side, {})
            if isinstance(end, Mapping):
                found |= {str(end.get("link")), str(end.get("frame"))}
    return found


def closing_frames(
    links: Iterable[str], own: Mapping[str, Any]
) -> tuple[list[dict[str, Any]], list[str]]:
    """Closures of the pairs among ``links``, and notes.

    Pairs at which the description ``own`` has a closure are left to it.
    """
    names = list(links)
    known, described = set(names), _named_by(own)
    loops: list[dict[str, Any]] = []
    notes: list[str] = []
    for link in names:
        match = CLOSING.match(link)
        if match is None:
            continue
        name, other = match[1], f"{match[1]}_2"
        if other not in known:
            notes.append(f"the link {link!r} has no partner {other!r}: no loop is closed there")
            continue
        if {link, other} & described:
            notes.append(f"{name!r} is closed as the description says")
            continue
        loop = {"name": name, "type": "point", "a": {"link": other}, "b": {"link": link}}
        if {f"{link}_z", f"{other}_z"} <= known:
            loop |= {"type": "revolute", "axis": [0.0, 0.0, 1.0]}
        else:
            notes.append(
                f"{name!r} joins the origins of {link!r} and {other!r} (closure point): the file "
                "does not say the type of this mate; a [[loop]] between the two replaces it"
            )
        loops.append(loop)
    return loops, notes
