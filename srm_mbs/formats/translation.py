"""The common form of all formats: a description and a tree of links and joints.

Every reader makes a :class:`Translation`; from there one path leads to the mechanism
(:mod:`srm_mbs.formats.build`), and ``srm-mbs convert`` writes both as text.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple, Protocol
from xml.etree.ElementTree import Element, indent, tostring

import pinocchio as pin

from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.errors import AssemblyError
from srm_mbs.formats.graph.joint_graph import Body, Joint
from srm_mbs.formats.toml.parameters import Place
from srm_mbs.formats.toml.schema import PlanarEntry
from srm_mbs.model.lazy import cached_property
from srm_mbs.model.reach import Reach


@dataclass(frozen=True)
class Options:
    """Wishes of the user about a translation.

    Attributes
    ----------
    cut
        Names of the joints at which loops of a graph of joints are to be cut.
    own
        The tables of the description that names the file; empty if none does.
    reach
        Where files that the file names may lie.
    keyframe
        Name of the state of the file in which the mechanism starts; None: the pose of the file.
    base
        How the root link is held; None: as the description or the file says.
    planar
        The checked section ``[planar]`` of the description, if it has one.
    known
        The tree of another variant of the description.
    """

    cut: tuple[str, ...] = ()
    own: Mapping[str, Any] = field(default_factory=dict)
    reach: Reach = field(default_factory=Reach)
    keyframe: str | None = None
    base: str | None = None
    planar: PlanarEntry | None = None
    known: KnownTree | None = None


class TreeParts(NamedTuple):
    """Bodies and joints of a tree, in order; every joint is where the frame of its child is, with
    the axes of its parent."""

    bodies: Sequence[Body]
    joints: Sequence[Joint]


Vector = tuple[float, float, float]


class Numbers(NamedTuple):
    """The numbers of a variant that may differ from those of the mechanism that was read first.

    Attributes
    ----------
    joints, inertias
        Places (m) of joints in their parents, and inertias as Pinocchio's reader has them, by link.
    closures, points, forces
        Places (m) of anchors in their links: of closures by name and side, of points by name, of
        forces by their number in the description and key.
    initial
        The table ``initial``.
    notes
        As of a :class:`Translation`.
    """

    joints: Mapping[str, Vector]
    inertias: Mapping[str, pin.Inertia]
    closures: Mapping[str, Mapping[str, Vector]]
    points: Mapping[str, Vector]
    forces: Mapping[int, Mapping[str, Vector]]
    initial: dict[str, Any]
    notes: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class KnownTree:
    """The tree of a mechanism, whose variants may have the same links and joints.

    Attributes
    ----------
    parts
        Its bodies and joints (:attr:`Translation.parts`).
    model
        Pinocchio's model.
    results
        What follows from the tree alone
        (:attr:`~srm_mbs.model.mechanism.MechanismData.tree_results`).
    """

    parts: TreeParts
    model: pin.Model
    results: dict[Any, Any]

    def __reduce__(self) -> tuple[Any, ...]:
        """Without results, whose functions may not be pickled."""
        return KnownTree, (self.parts, self.model, {})

    @cached_property
    def numbers(self) -> dict[str, int]:
        """Pinocchio's number of the joint that carries each link, by the name of the link."""
        return {joint.child: self.model.getJointId(joint.name) for joint in self.parts.joints}


def urdf_text(tree: Element) -> str:
    """The text of a URDF, indented."""
    indent(tree)
    return tostring(tree, encoding="unicode") + "\n"


class Written(NamedTuple):
    """Where the start of a joint is written in a file, and the unit there with its factor to rad or
    m."""

    key: str
    unit: str
    factor: float


class FileTerms(Protocol):
    """Speaks of a mechanism in the terms of its file, where these differ from the entries of a
    description."""

    def check(self, mechanism: Mechanism) -> None:
        """Raise InputError if the assembled mechanism cannot be what the file is meant to
        describe."""

    def explain(self, error: AssemblyError) -> None:
        """Change the error about loops that do not close, or rates that contradict each other, to
        one about what the file has."""

    def written(self, joint: str) -> Written | None:
        """How the start of a joint is written; None if it is an entry ``initial`` or not given."""


class NumbersOfVariants(FileTerms, Protocol):
    """Finds the numbers of variants of a linkage."""

    def __call__(self, numbers: Sequence[float]) -> Numbers | None:
        """The numbers of a variant from those of the expressions of its description; None where it
        has to be read as a whole, because of a fault perhaps."""


@dataclass(frozen=True, eq=False)
class Translation:
    """A file of any format as a tree and the tables of a description.

    Attributes
    ----------
    tree
        Root element of a URDF without loops, in the dialect of ``docs/formats.md``; building the
        mechanism changes it.
    write
        Makes its text, with what is only drawn; by default that of ``tree`` as it is now.
    entries
        Keys and values of a description (:mod:`srm_mbs.formats.toml.schema`) as ``tomllib`` would
        give them: ``loop``, ``force``, ``initial``, ``base``, ``gravity``, ...; without ``format``
        and ``urdf``.
    notes
        Sentences about approximations and ignored elements, with the reason.
    urdf_file
        The file that the URDF came from, if it is another one than that translated.
    file_terms
        Speaks in the terms of the file; None where these are the entries.
    parts
        The bodies and joints of the tree, for :class:`KnownTree`; None where variants are built
        from their tree, or made from another.
    model
        Pinocchio's model, if it was made from that of a :class:`KnownTree`: ``tree`` is empty.
    vary
        Makes the numbers of variants from those at some places of the description, where nothing
        else differs; None for places that change more.
    """

    tree: Element
    write: Callable[[], str] | None = None
    entries: dict[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    urdf_file: str = ""
    file_terms: FileTerms | None = None
    parts: TreeParts | None = None
    model: pin.Model | None = None
    vary: Callable[[Sequence[Place]], NumbersOfVariants | None] | None = None

    def __post_init__(self) -> None:
        if self.write is None:  # building the mechanism changes the tree
            kept = deepcopy(self.tree)
            object.__setattr__(self, "write", partial(urdf_text, kept))

    @property
    def urdf(self) -> str:
        """The text of the URDF."""
        return "" if self.write is None else self.write()

    def extended(self, notes: Iterable[str], **more: Any) -> Translation:
        """With further notes and entries: lists follow those of the same key, and what is empty is
        left out."""
        entries = dict(self.entries)
        for key, value in more.items():
            if value:
                entries[key] = [*entries.get(key, ()), *value] if key in LISTS else value
        return replace(self, entries=entries, notes=(*self.notes, *notes))


LISTS = ("lock", "loop", "force", "drive")
"""Keys whose lists in a description and in the file that it names are joined."""
TABLES = ("simulation", "gravity_compensation", "points", "actuators")
"""Tables that are merged key by key."""
MODEL_KEYS = ("urdf", "sdf", "mjcf")
"""Keys of a description that name a file of another format."""
PLANAR = "planar"
"""Key of a description that has the links and joints in place of a file."""


def merged(own: Mapping[str, Any], entries: Mapping[str, Any], urdf: str) -> dict[str, Any]:
    """The description ``own`` (as ``tomllib`` gives it) with the entries of the file it names.

    Loops, forces and drives of both count; of everything else the description's own counts.

    Parameters
    ----------
    own, entries
        The description, and :attr:`Translation.entries`.
    urdf
        File name of the translated URDF, written into the description.
    """
    dropped = (*MODEL_KEYS, PLANAR, "format", "cut")
    out: dict[str, Any] = {"format": 1}
    if "name" in own or "name" in entries:
        out["name"] = own.get("name") or entries.get("name", "")
    out["urdf"] = urdf
    for key in dict.fromkeys((*own, *entries)):
        if key in dropped or key in out:
            continue
        if key in LISTS:
            theirs = entries.get(key, ())
            if key == "lock":
                theirs = [name for name in theirs if name not in own.get(key, ())]
            out[key] = [*own.get(key, ()), *theirs]
        elif key in TABLES:
            out[key] = {**entries.get(key, {}), **own.get(key, {})}
        elif key == "initial":
            out[key] = merged_initial(own.get(key, {}), entries.get(key, {}))
        else:
            out[key] = own[key] if key in own else entries[key]
    return out


def merged_initial(own: Mapping[str, Any], entries: Mapping[str, Any]) -> dict[str, Any]:
    """Joint by joint; a position that the description gives replaces a held or guessed one."""
    placed = {*own.get("q", ()), *own.get("guess", ())}
    out: dict[str, Any] = {}
    for part in ("q", "v", "guess"):
        theirs = {
            joint: value
            for joint, value in entries.get(part, {}).items()
            if part == "v" or joint not in placed
        }
        values = {**theirs, **own.get(part, {})}
        if values:
            out[part] = values
    return out
