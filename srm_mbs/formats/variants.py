"""Data that the variants of a linkage share with the mechanism that was loaded first."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from operator import attrgetter
from typing import Any, NamedTuple

from srm_mbs.errors import InputError
from srm_mbs.formats.toml.description import Description, check_description
from srm_mbs.formats.toml.schema import InitialEntry
from srm_mbs.formats.translation import KnownTree
from srm_mbs.model.anchors import Anchor
from srm_mbs.model.closures import LoopClosure

VARYING = ("loop", "points", "initial")
"""Keys of a translated description whose numbers variants change."""


class Elements(NamedTuple):
    """A description, and its closures and points, whose tables may be those of another variant."""

    description: Description
    closures: tuple[LoopClosure, ...]
    points: dict[str, Anchor]


@dataclass(frozen=True, eq=False)
class KnownLinkage:
    """The mechanism of a linkage, as it was read.

    Attributes
    ----------
    tree
        Its tree.
    description, entries
        Its checked description, translated, and the tables of this.
    closures, points
        Its closures and named points.
    """

    tree: KnownTree
    description: Description
    entries: Mapping[str, Any]
    closures: tuple[LoopClosure, ...]
    points: Mapping[str, Anchor]

    def __reduce__(self) -> tuple[Any, ...]:
        """Without the description, whose tables have classes made at run time."""
        return _checked_again, (self.tree, dict(self.entries), self.closures, dict(self.points))

    def elements(self, entries: Mapping[str, Any]) -> Elements | None:
        """The elements of a variant with the translated tables ``entries``; None where more than
        places and the start differ, and for what the check of a description may refuse."""
        own = self.entries
        if own.keys() != entries.keys() or any(
            own[key] != value for key, value in entries.items() if key not in VARYING
        ):
            return None
        try:
            closures = self._closures(entries.get("loop", []))
            points = dict(self._points(entries.get("points", {})))
        except (InputError, TypeError):
            return None  # the check says what is wrong
        if closures is None:
            return None
        parts: Mapping[str, Any] = entries.get("initial", {})
        q, v, guess = (dict(parts.get(part, {})) for part in ("q", "v", "guess"))
        start = InitialEntry.model_construct(q=q, v=v, guess=guess)
        return Elements(self.description.model_copy(update={"initial": start}), closures, points)

    def _points(self, tables: Mapping[str, Any]) -> Iterator[tuple[str, Anchor]]:
        """Named points; those of the known ones that stay where they are, are the same."""
        known = self.entries.get("points", {})
        for name, at in tables.items():
            same = name in self.points and known.get(name) == at
            yield name, self.points[name] if same else Anchor(**at)

    def _closures(self, tables: list[dict[str, Any]]) -> tuple[LoopClosure, ...] | None:
        """Closures that differ in their places alone, no two of which are the same."""
        known = self.entries.get("loop", [])
        if len(tables) != len(known):
            return None
        found = []
        for table, own, closure in zip(tables, known, self.closures):
            if table != own:
                ends = {side: table[side] for side in ("a", "b") if side in table}
                placed = [own.get(side, {}).get("link") == at["link"] for side, at in ends.items()]
                if (
                    len(ends) != 2
                    or not all(placed)
                    or own != table | {"a": own["a"], "b": own["b"]}
                ):
                    return None
                closure = closure.between(Anchor(**ends["a"]), Anchor(**ends["b"]))
            found.append(closure)
        different = {_all_but_name(one) for one in found}
        return tuple(found) if len(different) == len(found) else None


_all_but_name = attrgetter(*(key.name for key in fields(LoopClosure) if key.name != "name"))


def _checked_again(
    tree: KnownTree,
    entries: dict[str, Any],
    closures: tuple[LoopClosure, ...],
    points: dict[str, Anchor],
) -> KnownLinkage:
    return KnownLinkage(tree, check_description(entries, ""), entries, closures, points)
