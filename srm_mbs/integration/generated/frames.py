"""The body in whose frame the terms of a structure take the fewest statements.

Mass matrix, forces and rows are the same in every frame.  In that of a body in the middle of the
tree, rotations are products of fewer, and in that of a free body nothing but gravity and the ground
depends on its place.
"""

from __future__ import annotations

from typing import NamedTuple

from srm_mbs.integration.generated.structure import Structure
from srm_mbs.integration.generated.terms import GROUND, RecordedTerms, record_terms
from srm_mbs.integration.generated.writing import Written, write_c

WORTHWHILE = 0.97
"""Statements against those in the frame of the ground: at most, because below some percent times do
not follow the number of statements."""


class FramedTerms(NamedTuple):
    """The terms of a structure in one frame: its number among motions, or GROUND."""

    frame: int
    recorded: RecordedTerms
    written: Written


def shortest_terms(structure: Structure) -> FramedTerms:
    """The terms of ``structure`` in the frame in which they have the fewest statements.

    Raises
    ------
    UnsupportedElementError
        If two points of an element coincide in every configuration.
    """
    best = _terms(structure, GROUND)
    most = WORTHWHILE * best.written.operations
    for frame in frames_of(structure):
        found = _terms(structure, frame)
        if found.written.operations < min(most, best.written.operations):
            best = found
    return best


def _terms(structure: Structure, frame: int) -> FramedTerms:
    recorded = record_terms(structure, frame)
    return FramedTerms(frame, recorded, write_c(recorded.outputs, recorded.guards))


def frames_of(structure: Structure) -> list[int]:
    """The bodies that come into question beside the ground: a free one, and, on the way from the
    ground along which at least half of all bodies follow, the last two.

    The kernel takes the bodies of bushings in world axes.
    """
    if structure.bushing_joints:
        return []
    motions = structure.motions
    following = [1] * len(motions)
    for number in reversed(range(len(motions))):
        if motions[number].parent >= 0:
            following[motions[number].parent] += following[number]
    way = [number for number, count in enumerate(following) if 2 * count >= len(motions)]
    free = [i for i, own in enumerate(motions) if own.kind == "free" and own.parent < 0]
    return list(dict.fromkeys([*free[:1], *way[-2:]]))
