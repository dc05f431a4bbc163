"""A whole mechanism description, and the closures, forces and drives that its entries ask for."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from srm_mbs.anchors import Anchor
from srm_mbs.drives import Drive
from srm_mbs.errors import InputError
from srm_mbs.force_element import ForceElement
from srm_mbs.forces import FORCE_TYPES
from srm_mbs.loading.entries import (
    AnchorEntry,
    ForceEntry,
    LoopEntry,
    TopEntry,
    TorqueEntry,
    WrenchEntry,
)
from srm_mbs.loading.laws import LAW_KEYS, law_from, with_law
from srm_mbs.loading.translation import MODEL_KEYS
from srm_mbs.loop_closure import LoopClosure


class Description(TopEntry):
    """A whole description: the keys of :class:`~srm_mbs.loading.entries.TopEntry`."""

    @property
    def model_file(self) -> tuple[str, str]:
        """Key and path of the file that holds the links and joints."""
        return next((key, name) for key in MODEL_KEYS if (name := getattr(self, key)) is not None)

    def closures(self) -> tuple[LoopClosure, ...]:
        """The loop closures.

        Raises
        ------
        InputError
            For an unknown type, a wrong axis, or an anchor without link or frame.
        """
        out = []
        for i, entry in enumerate(self.loop):
            with _labelled("loop", i, entry.name) as label:
                out.append(LoopClosure(**_with_anchors(label, entry)))
        return tuple(out)

    def coupled_joints(self) -> frozenset[str]:
        """Names of the joints that take part in a coupling."""
        return frozenset(name for entry in self.loop for name in entry.joints or ())

    def anchors(self) -> Iterator[tuple[str, AnchorEntry]]:
        """Every anchor with its key, ``loop[0].a`` for example."""
        entries: list[tuple[str, Iterable[tuple[str, Any]]]] = [
            *((f"loop[{i}]", entry) for i, entry in enumerate(self.loop)),
            *((f"force[{i}]", entry) for i, entry in enumerate(self.force)),
            *((f"drive[{i}]", entry) for i, entry in enumerate(self.drive)),
        ]
        for where, entry in entries:
            for key, value in entry:
                if isinstance(value, AnchorEntry):
                    yield f"{where}.{key}", value

    def force_elements(self, folder: Path | None) -> tuple[ForceElement, ...]:
        """The force elements; tables are read from ``folder``, None leaves out those that have one.

        Raises
        ------
        InputError
            For a value that an element cannot take, an anchor without link or frame, or a table
            that cannot be read.
        """
        out = []
        for i, entry in enumerate(self.force):
            with _labelled("force", i, entry.name) as label:
                values = _with_anchors(label, entry)
                law = values.get("law")
                if law is not None:
                    values["law"] = {key: getattr(law, key) for key in LAW_KEYS}
                if folder is None and (values.get("law") or values.get("table")):
                    continue
                if isinstance(entry, TorqueEntry | WrenchEntry):
                    values = with_law(values, folder or Path())
                out.append(FORCE_TYPES[values.pop("type")](**values))
        return tuple(out)

    def drives(self, folder: Path) -> tuple[Drive, ...]:
        """The drives; tables are read from ``folder``, unless their paths are absolute.

        Raises
        ------
        InputError
            For a law or value that a drive cannot take, or a table that cannot be read.
        """
        out = []
        for i, entry in enumerate(self.drive):
            with _labelled("drive", i, entry.name or entry.joint or "") as label:
                anchors = {
                    side: None if given is None else _anchor(label, side, given)
                    for side, given in (("a", entry.a), ("b", entry.b))
                }
                out.append(
                    Drive(
                        law_from({key: getattr(entry, key) for key in LAW_KEYS}, folder),
                        joint=entry.joint,
                        axis=entry.axis,
                        distance=entry.distance,
                        absolute=entry.absolute,
                        name=entry.name,
                        **anchors,
                    )
                )
        return tuple(out)


@contextmanager
def _labelled(kind: str, index: int, name: str) -> Iterator[str]:
    """Call an element by its name or number in errors that do not name it yet."""
    label = f"{kind} {name!r}" if name else f"{kind}[{index}]"
    try:
        yield label
    except InputError as error:
        if not (error.element or "").startswith(kind):
            error.element = f"{label}: {error.element}" if error.element else label
        raise


def _anchor(label: str, side: str, given: AnchorEntry) -> Anchor:
    try:
        return Anchor(given.link, given.frame, _triple(given.xyz), _triple(given.rpy))
    except InputError as error:
        what = "" if error.element == "anchor" else f": {error.element}"
        error.element = f"{label}, anchor {side}{what}"
        raise


def _with_anchors(label: str, entry: LoopEntry | ForceEntry) -> dict[str, Any]:
    """The keys of an element, its anchors made."""
    return {
        key: _anchor(label, key, value) if isinstance(value, AnchorEntry) else value
        for key, value in entry
    }


def _triple(values: list[float]) -> tuple[float, float, float]:
    x, y, z = values
    return (x, y, z)
