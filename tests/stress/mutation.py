"""A mutated input and what may become of it."""

from __future__ import annotations

from dataclasses import dataclass, field

TREE, LOOPS, START, DEFAULTS, NAMES = "tree", "loops", "start", "defaults", "names"
"""Parts of a fingerprint (``load_batch.fingerprint``)."""


@dataclass(frozen=True)
class Expectation:
    """What is allowed.

    Attributes
    ----------
    loads, refused
        Whether it may load, and whether it may be refused with an ``InputError``.
    changes
        Parts of the mechanism that may differ, because the mutated file legally says so.
    noted
        Further parts may differ if a note or a warning says that something is ignored.
    """

    loads: bool
    refused: bool
    changes: frozenset[str] = field(default_factory=frozenset)
    noted: bool = False


def must_be_refused() -> Expectation:
    return Expectation(loads=False, refused=True)


def must_load_unchanged(*but: str) -> Expectation:
    return Expectation(loads=True, refused=False, changes=frozenset(but))


def legal(*changes: str) -> Expectation:
    """Another legal mechanism, or one that cannot be built or assembled."""
    return Expectation(loads=True, refused=True, changes=frozenset(changes))


def refused_or_noted() -> Expectation:
    return Expectation(loads=True, refused=True, noted=True)


@dataclass(frozen=True)
class Files:
    """A description and the URDF that it names, as texts."""

    toml: str
    urdf: str


@dataclass(frozen=True)
class Mutation:
    """One mutated description or URDF.

    Attributes
    ----------
    model
        The bundled mechanism.
    change
        What was done, and where.
    files
        The mutated input.
    expectation
        What may become of it.
    twin
        Input that says the same in so many words (a default written out): the outcome, refused or
        loaded, must be that of ``kernel_system``.
    """

    model: str
    change: str
    files: Files
    expectation: Expectation
    kernel_system: Files | None = None
