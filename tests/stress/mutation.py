"""A mutated input and what may become of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np

T = TypeVar("T")

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
    remarked
        Whether there must be such a note or warning.
    """

    loads: bool
    refused: bool
    changes: frozenset[str] = field(default_factory=frozenset)
    noted: bool = False
    remarked: bool = False


REFUSED = Expectation(loads=False, refused=True)
REFUSED_OR_NOTED = Expectation(loads=True, refused=True, noted=True)
THE_SAME_WITH_A_NOTE = Expectation(loads=True, refused=False, remarked=True)


def unchanged(*but: str) -> Expectation:
    """The same mechanism but for these parts."""
    return Expectation(loads=True, refused=False, changes=frozenset(but))


def legal(*changes: str) -> Expectation:
    """Another legal mechanism, or one that cannot be built or assembled."""
    return Expectation(loads=True, refused=True, changes=frozenset(changes))


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
    written_out
        The same input with a default written out: the outcome, refused or loaded, must be the same.
    """

    model: str
    change: str
    files: Files
    expectation: Expectation
    written_out: Files | None = None


GARBAGE = ("", "x", "1 2", "1,5", "nan", "inf", "1e999", "0x10", "1_0", "--1", "1 2 3 4")
"""Texts in place of one number."""


def misspelt(word: str, rng: np.random.Generator) -> str:
    """``word`` with a letter lost, doubled, or in capitals."""
    at = int(rng.integers(len(word)))
    return [
        word[:at] + word[at + 1 :] or "x",
        word[:at] + word[at] + word[at:],
        word.capitalize() if word != word.capitalize() else word.upper(),
        word + "_2",
    ][int(rng.integers(4))]


def one_of(items: Sequence[T], rng: np.random.Generator) -> T:
    """A random item."""
    return items[int(rng.integers(len(items)))]
