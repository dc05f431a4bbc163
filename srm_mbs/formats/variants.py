"""Data that the variants of a linkage share with the mechanism that was loaded first."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from operator import attrgetter
from typing import Any, NamedTuple

import pinocchio as pin

from srm_mbs.errors import InputError
from srm_mbs.formats.toml.description import Description, check_description
from srm_mbs.formats.toml.parameters import Nested, with_numbers
from srm_mbs.formats.translation import KnownTree, NumbersOfVariants, Vector
from srm_mbs.formats.urdf.variants import OverridableTree, model_with
from srm_mbs.model.anchors import Anchor
from srm_mbs.model.closures import LoopClosure
from srm_mbs.model.mechanism import Source

VARYING = ("loop", "points", "initial")
"""Keys of a translated description whose numbers variants change."""


class Elements(NamedTuple):
    """A description, and its closures and points, whose tables may be those of another variant;
    and what follows from the tree of both."""

    description: Description
    closures: tuple[LoopClosure, ...]
    points: dict[str, Anchor]
    tree_results: dict[Any, Any]


class VariedLinkage(NamedTuple):
    """A variant of a linkage with its model, elements and notes."""

    model: pin.Model
    elements: Elements
    notes: tuple[str, ...]


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
    source
        Where it came from, without its texts.
    numbers
        Of variants of a planar linkage, where nothing else of them differs.
    overridable
        What ``[[override]]`` of others may change.
    varying
        The numbers of the description of these that variants change otherwise.
    """

    tree: KnownTree
    description: Description
    entries: Mapping[str, Any]
    closures: tuple[LoopClosure, ...]
    points: Mapping[str, Anchor]
    source: Source
    numbers: NumbersOfVariants | None = None
    overridable: OverridableTree | None = None
    varying: Nested = field(default_factory=dict)

    def __reduce__(self) -> tuple[Any, ...]:
        """Without the description, whose tables have classes made at run time."""
        return _checked_again, (
            self.tree,
            dict(self.entries),
            self.closures,
            dict(self.points),
            self.source,
            self.numbers,
            self.overridable,
            self.varying,
        )

    def varied(self, numbers: Sequence[float]) -> VariedLinkage | None:
        """The variant with these numbers at the places of its expressions; None where it has to be
        read as a whole, because of a fault perhaps."""
        if self.overridable is not None:
            return self._overridden(self.overridable, numbers)
        try:
            found = None if self.numbers is None else self.numbers(numbers)
        except InputError:
            return None  # reading it as a whole says what is wrong
        if found is None:
            return None
        closures = [
            _moved(closure, found.closures.get(closure.name, {})) for closure in self.closures
        ]
        points = {**self.points, **{k: self.points[k].at(xyz) for k, xyz in found.points.items()}}
        description = self._starting(found.initial)
        if found.forces:
            forces = list(description.force)
            for i, places in found.forces.items():
                ends = {
                    key: getattr(forces[i], key).model_copy(update={"xyz": list(xyz)})
                    for key, xyz in places.items()
                }
                forces[i] = forces[i].model_copy(update=ends)
            description = description.model_copy(update={"force": forces})
        number = self.tree.numbers
        model = model_with(
            self.tree.model,
            {number[link]: place for link, place in found.joints.items()},
            {number[link]: inertia for link, inertia in found.inertias.items()},
        )
        return self._made(model, description, closures, points, found.notes)

    def _overridden(
        self, overridable: OverridableTree, numbers: Sequence[float]
    ) -> VariedLinkage | None:
        """:meth:`varied` of a URDF."""
        model = overridable.model(self.tree.model, numbers)
        if model is None:
            return None
        description = with_numbers(self.description, self.varying, numbers)
        closures, points = list(self.closures), dict(self.points)
        for i in self.varying.get("loop", ()):
            a, b = (Anchor(**dict(end)) for end in (description.loop[i].a, description.loop[i].b))
            closures[i] = closures[i].between(a, b)
        for name in self.varying.get("points", ()):
            points[name] = Anchor(**dict(description.points[name]))
        return self._made(model, description, closures, points)

    def _made(
        self,
        model: pin.Model,
        description: Description,
        closures: Sequence[LoopClosure],
        points: dict[str, Anchor],
        notes: tuple[str, ...] = (),
    ) -> VariedLinkage | None:
        """A variant; None if two of its closures are the same."""
        if not _all_different(closures):
            return None
        elements = Elements(description, tuple(closures), points, self.tree.results)
        return VariedLinkage(model, elements, notes)

    def _starting(self, initial: Mapping[str, Any]) -> Description:
        """The description with the table ``initial``, whose numbers are checked."""
        q, v, guess = (dict(initial.get(part, {})) for part in ("q", "v", "guess"))
        start = self.description.initial.model_copy(update={"q": q, "v": v, "guess": guess})
        return self.description.model_copy(update={"initial": start})

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
        start = self._starting(entries.get("initial", {}))
        return Elements(start, closures, points, self.tree.results)

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
        return tuple(found) if _all_different(found) else None


def _moved(closure: LoopClosure, places: Mapping[str, Vector]) -> LoopClosure:
    """A closure with its ends at other ``places`` in their links, by side."""
    if not places:
        return closure
    a, b = closure.anchors
    return closure.between(
        a.at(places["a"]) if "a" in places else a, b.at(places["b"]) if "b" in places else b
    )


def _all_different(closures: Sequence[LoopClosure]) -> bool:
    """Whether no two closures are the same but for their names."""
    count, places = len(closures), {tuple([end.xyz for end in one.anchors]) for one in closures}
    return len(places) == count or len({_all_but_name(one) for one in closures}) == count


_all_but_name = attrgetter(*(key.name for key in fields(LoopClosure) if key.name != "name"))


def _checked_again(
    tree: KnownTree,
    entries: dict[str, Any],
    closures: tuple[LoopClosure, ...],
    points: dict[str, Anchor],
    *others: Any,
) -> KnownLinkage:
    return KnownLinkage(tree, check_description(entries, ""), entries, closures, points, *others)
