"""The order of the rows along the graph of the loops, in which many of them are factorised.

Two rows meet where they have coordinates or ancestors of these in common.  Rows that meet the
fewest others come first (greedy minimum degree), those that hang together next to each other (in
postorder of the elimination tree): along a chain of loops from one end to the other, in a tree of
loops from the leaves to the root.

Source: J. A. George, J. W. H. Liu, The evolution of the minimum degree ordering algorithm, SIAM
Review 31 (1989) 1.
"""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from srm_mbs.arrays import BoolArray

LARGE = 64
"""Coordinates above which pivots are taken along the graph, by the kernel where there is one."""

FULL = 0.5
"""Part of the entries of W from which there is no graph to follow."""

COMMON = 16
"""Loops that a coordinate is common to before it says nothing about their order."""


def graph_order(pattern: BoolArray, parents: Sequence[int]) -> tuple[int, ...]:
    """All rows along the graph of the loops; () for up to 64 coordinates, or if W is full.

    Parameters
    ----------
    pattern : (rows, nv)
        Which entries of G may differ from zero.
    parents : (nv,)
        The next coordinate to the root, or -1.
    """
    if pattern.shape[1] <= LARGE or not len(pattern):
        return ()
    return _ordered(pattern.shape, np.packbits(pattern).tobytes(), tuple(parents))


@lru_cache(maxsize=32)
def _ordered(shape: tuple[int, int], bits: bytes, parents: tuple[int, ...]) -> tuple[int, ...]:
    size = shape[0] * shape[1]
    pattern = np.unpackbits(np.frombuffer(bits, np.uint8), count=size).reshape(shape).astype(bool)
    supports = [_with_ancestors(np.flatnonzero(row).tolist(), parents) for row in pattern]
    if sum(map(len, supports)) > FULL * size:
        return ()
    alike: dict[frozenset[int], list[int]] = {}
    for row, support in enumerate(supports):
        alike.setdefault(support, []).append(row)
    groups = list(alike.values())
    order = _postordered(*_eliminated(_neighbours(list(alike))))
    return tuple(row for group in order for row in groups[group])


def _with_ancestors(support: Sequence[int], parents: Sequence[int]) -> frozenset[int]:
    found: set[int] = set()
    for k in support:
        while k >= 0 and k not in found:
            found.add(k)
            k = parents[k]
    return frozenset(found)


def _neighbours(supports: Sequence[frozenset[int]]) -> list[set[int]]:
    """The supports that each one meets; coordinates that very many have in common do not count."""
    of: dict[int, list[int]] = {}
    for k, support in enumerate(supports):
        for coordinate in support:
            of.setdefault(coordinate, []).append(k)
    most = max(COMMON, 10 * int(np.sqrt(len(supports))))
    found: list[set[int]] = [set() for _ in supports]
    for together in of.values():
        if len(together) <= most:
            for k in together:
                found[k].update(together)
    for k, others in enumerate(found):
        others.discard(k)
    return found


def _eliminated(neighbours: list[set[int]]) -> tuple[list[int], list[int]]:
    """Nodes in the order of their degree when they are eliminated, which makes their neighbours
    meet, and the next neighbour to be eliminated, or -1."""
    heap = [(len(others), k) for k, others in enumerate(neighbours)]
    heapq.heapify(heap)
    place: dict[int, int] = {}
    met: list[set[int]] = [set() for _ in neighbours]
    while heap:
        degree, k = heapq.heappop(heap)
        if k in place or degree != len(neighbours[k]):
            continue
        place[k] = len(place)
        met[k] = others = neighbours[k]
        for other in others:
            own = neighbours[other]
            own |= others
            own -= {k, other}
            heapq.heappush(heap, (len(own), other))
    parents = [min(others, key=place.__getitem__, default=-1) for others in met]
    return list(place), parents


def _postordered(order: Sequence[int], parents: Sequence[int]) -> list[int]:
    """``order`` with each node after those that it is the parent of, and next to them."""
    children: dict[int, list[int]] = {}
    for k in order:
        children.setdefault(parents[k], []).append(k)
    out: list[int] = []
    waiting = children.get(-1, [])[:]
    # From the root: each node before its children, the last ones first; then turned round.
    while waiting:
        k = waiting.pop()
        out.append(k)
        waiting += children.get(k, [])
    return out[::-1]
