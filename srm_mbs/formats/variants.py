"""Data that the variants of a linkage share with the mechanism that was loaded first."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from operator import attrgetter
from typing import Any, NamedTuple

import pinocchio as pin

from srm_mbs.errors import InputError
from srm_mbs.formats.planar.variants import model_with
from srm_mbs.formats.toml.description import Description, check_description
from srm_mbs.formats.toml.schema import AnchorEntry, InitialEntry, PlanarEntry
from srm_mbs.formats.translation import KnownTree, NumbersOfVariants, merged_initial
from srm_mbs.formats.urdf.override import without_overrides
from srm_mbs.formats.urdf.variants import OverridableTree
from srm_mbs.model.anchors import Anchor
from srm_mbs.model.closures import LoopClosure

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
    numbers
        Of variants of a planar linkage, where nothing else of them differs.
    overridable
        What ``[[override]]`` of others may change.
    urdf_path, format
        As of its :class:`~srm_mbs.model.mechanism.Source`.
    """

    tree: KnownTree
    description: Description
    entries: Mapping[str, Any]
    closures: tuple[LoopClosure, ...]
    points: Mapping[str, Anchor]
    numbers: NumbersOfVariants | None = None
    overridable: OverridableTree | None = None
    urdf_path: str = ""
    format: str = ""

    def __reduce__(self) -> tuple[Any, ...]:
        """Without the description, whose tables have classes made at run time."""
        return _checked_again, (
            self.tree,
            dict(self.entries),
            self.closures,
            dict(self.points),
            self.numbers,
            self.overridable,
            self.urdf_path,
            self.format,
        )

    def varied(self, given: Description, own: Mapping[str, Any]) -> VariedLinkage | None:
        """The variant with the description ``given``, whose tables are ``own``; None where it has
        to be read as a whole."""
        if given.planar is not None:
            return self._varied_linkage(given.planar, own)
        if self.overridable is None:
            return None
        model = self.overridable.model(self.tree.model, given.override)
        elements = None if model is None else self.elements(without_overrides(own))
        return None if elements is None else VariedLinkage(model, elements, ())

    def _varied_linkage(self, entry: PlanarEntry, own: Mapping[str, Any]) -> VariedLinkage | None:
        if self.numbers is None:
            return None
        try:
            found = self.numbers(entry)
        except InputError:
            return None  # reading it as a whole says what is wrong
        model = None if found is None else model_with(self.tree, found.joints, found.inertias)
        if found is None or model is None:
            return None
        closures = tuple(
            closure.between(*(Anchor(**at) for at in found.closures[closure.name]))
            if closure.name in found.closures
            else closure
            for closure in self.closures
        )
        if not _all_different(closures):
            return None
        points = dict(self.points)
        named = own.get("points", {})
        points |= {name: Anchor(**at) for name, at in found.points.items() if name not in named}
        initial = merged_initial(own.get("initial", {}), found.initial)
        description = self._starting(initial)
        if found.forces:
            anchors = {
                name: {key: AnchorEntry.model_validate(at) for key, at in ends.items()}
                for name, ends in found.forces.items()
            }
            forces = [
                entry.model_copy(update=anchors.get(entry.name)) for entry in description.force
            ]
            description = description.model_copy(update={"force": forces})
        return VariedLinkage(
            model, Elements(description, closures, points, self.tree.results), found.notes
        )

    def _starting(self, initial: Mapping[str, Any]) -> Description:
        """The description with the table ``initial``, whose numbers are checked."""
        q, v, guess = (dict(initial.get(part, {})) for part in ("q", "v", "guess"))
        start = InitialEntry.model_construct(q=q, v=v, guess=guess)
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


def _all_different(closures: Sequence[LoopClosure]) -> bool:
    """Whether no two closures are the same but for their names."""
    return len(closures) == len({_all_but_name(one) for one in closures})


_all_but_name = attrgetter(*(key.name for key in fields(LoopClosure) if key.name != "name"))


def _checked_again(
    tree: KnownTree,
    entries: dict[str, Any],
    closures: tuple[LoopClosure, ...],
    points: dict[str, Anchor],
    *others: Any,
) -> KnownLinkage:
    return KnownLinkage(tree, check_description(entries, ""), entries, closures, points, *others)
