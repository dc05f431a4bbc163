"""The generated code of a mechanism: made once, shared by mechanisms of one structure.

:func:`load_code` gives the kernel's ``GeneratedTerms`` of a mechanism, from this process, from the
cache of the user, or newly compiled.
"""

from __future__ import annotations

import hashlib
import os
import pkgutil
from collections import OrderedDict, deque
from collections.abc import Callable
from functools import cache, lru_cache
from pathlib import Path
from threading import Lock
from typing import Any, NamedTuple

from srm_mbs._kernel import core
from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.dynamics.multibody import make_system
from srm_mbs.errors import InputError
from srm_mbs.integration.generated.code_cache import (
    PATIENCE,
    Compilation,
    CompilationError,
    Compiled,
    compile_and_load,
    load_cached,
)
from srm_mbs.integration.generated.source import Source, source_of
from srm_mbs.integration.generated.structure import (
    Origin,
    Structure,
    UnsupportedElementError,
    parameters_of_variant,
    structure_of,
)
from srm_mbs.model.mechanism import MechanismData, per_model, per_tree

MOST_OPERATIONS = 40_000
"""Statements of generated code: compilation takes about 0.15 ms each, and more for each the more
there are."""
KEPT = 256
"""Structures whose code a process keeps."""
KEPT_ORIGINS = 4
"""Structures with which variants of one tree are compared."""


class CompiledMechanism(NamedTuple):
    """Generated code of a mechanism.

    Attributes
    ----------
    operations
        Statements of one evaluation.
    seconds
        Time (s) that compilation took; 0 if the code was there.
    path
        Where it lies in the cache of the user; None if it could not be kept.
    source
        Its C.
    """

    operations: int
    seconds: float
    path: Path | None
    source: str

    def __repr__(self) -> str:
        made = f"compiled in {self.seconds:.2f} s" if self.seconds else "found"
        return f"CompiledMechanism({self.operations} operations, {made})"


class Library(NamedTuple):
    """The code of a structure in this process.

    Attributes
    ----------
    terms
        A ``GeneratedTerms``; others are made from it.
    compiled
        How it was found.
    """

    terms: Any
    compiled: Compiled


_NO_GENERATOR = ("code", "code_cache", "policy")
"""Modules of this package on which the source of a structure does not depend."""
_libraries: OrderedDict[Structure, Library] = OrderedDict()
_refused: dict[Structure, str] = {}
"""Why no code can be generated for a structure, of up to KEPT: finding out may take a second."""
_lock = Lock()
_arrivals = 0


def arrivals() -> int:
    """How often code arrived in this process."""
    return _arrivals


@per_model
def _loaded(mechanism: MechanismData) -> deque[Any]:
    """The ``GeneratedTerms`` of a mechanism, once they were found."""
    return deque(maxlen=1)


def loaded_code(mechanism: Mechanism) -> Any:
    """The ``GeneratedTerms`` of a mechanism that it has already; None without them."""
    found = _loaded(mechanism)
    return found[0] if found else None


def load_code(mechanism: Mechanism, compiles: bool = True) -> Any:
    """The ``GeneratedTerms`` of a mechanism.

    Parameters
    ----------
    compiles
        Whether code is compiled that is neither in this process nor in the cache; None is returned
        otherwise.

    Raises
    ------
    InputError
        If its code cannot be generated or compiled.
    """
    found = _loaded(mechanism)
    if not found:
        structure, parameters = structure_of_mechanism(mechanism)
        find = _library if compiles else cached_library
        library = find(structure, parameters)
        if library is None:
            return None
        found.append(library.terms.with_parameters(parameters))
    return found[0]


def code_of_record(by: str, mechanism: Mechanism) -> Any:
    """The ``GeneratedTerms`` of a run that the backend ``by`` made, maybe elsewhere, or None.

    Without them the kernel evaluates its output, which agrees to rounding: reading a run compiles
    nothing.
    """
    if by != "generated":
        return None
    try:
        return load_code(mechanism, compiles=False)
    except InputError:
        return None


def compile_mechanism(mechanism: Mechanism) -> CompiledMechanism:
    """Load the code of a mechanism, and say how it was made; raises as :func:`load_code`."""
    structure, parameters = structure_of_mechanism(mechanism)
    known = known_library(structure) is not None
    library = _library(structure, parameters)
    load_code(mechanism)
    seconds = 0.0 if known else library.compiled.seconds
    source = source_of_structure(structure)
    return CompiledMechanism(source.operations, seconds, library.compiled.path, source.text)


def generated_source(mechanism: Mechanism) -> str:
    """The C of a mechanism, which need not be compiled.

    Raises
    ------
    InputError
        If it cannot be generated.
    """
    return source_of_structure(structure_of_mechanism(mechanism)[0]).text


@per_model
def structure_of_mechanism(mechanism: Mechanism) -> tuple[Structure, FloatArray]:
    """Structure and parameters of a mechanism.

    Raises
    ------
    InputError
        If no code can be generated for an element.
    """
    known = _origins(mechanism)
    for origin in tuple(known):
        parameters = parameters_of_variant(mechanism, origin)
        if parameters is not None:
            return origin.structure, parameters
    try:
        found = structure_of(mechanism.model, make_system(mechanism).constants())
    except UnsupportedElementError as error:
        raise _not_generated(str(error)) from error
    known.append(Origin.of(mechanism, *found))
    return found


@per_tree
def _origins(mechanism: Mechanism) -> deque[Origin]:
    """Mechanisms of different structures among the variants of one tree."""
    return deque(maxlen=KEPT_ORIGINS)


def _not_generated(why: str) -> InputError:
    return InputError(
        f"no code can be generated for this mechanism: {why}",
        element="backend",
        remedy="Use the backend kernel",
    )


@lru_cache(maxsize=1)  # the library and the report about it ask for the same
def source_of_structure(structure: Structure) -> Source:
    """The C of a structure: some 10 us of CPU time for each statement, in each frame that is tried.

    Raises
    ------
    InputError
        If it cannot be generated.
    """
    known = _refused.get(structure)
    if known is not None:
        raise _not_generated(known)
    try:
        source = source_of(structure)
        if source.operations > MOST_OPERATIONS:
            raise UnsupportedElementError(
                f"it would have {source.operations} statements, more than {MOST_OPERATIONS}"
            )
    except UnsupportedElementError as error:
        if len(_refused) >= KEPT:
            _refused.clear()
        _refused[structure] = str(error)
        raise _not_generated(str(error)) from error
    return source


def identity_of(structure: Structure) -> str:
    """A text that determines the source of a structure: itself, and the generator."""
    return f"{_generator()} {structure!r}"


@cache
def _generator() -> str:
    """The digest of the modules that write a source."""
    digest = hashlib.sha256()
    for module in pkgutil.iter_modules([os.path.dirname(__file__)]):
        if module.name not in _NO_GENERATOR:
            digest.update(pkgutil.get_data(__package__, f"{module.name}.py") or b"")
    return digest.hexdigest()


def _library(structure: Structure, parameters: FloatArray) -> Library:
    """The code of a structure; ``parameters`` are those of one mechanism of it."""
    found = cached_library(structure, parameters)
    if found is not None:
        return found
    source = source_of_structure(structure)
    load, identity = _loader(parameters), identity_of(structure)
    try:
        made = compile_and_load(source.text, load, source.units, identity=identity)
        return remember(structure, *made)
    except CompilationError as error:
        raise InputError(
            f"the generated code cannot be compiled: {error}",
            element="backend",
            remedy=f"{error.remedy}, or use the backend kernel",
        ) from error


def cached_library(structure: Structure, parameters: FloatArray) -> Library | None:
    """The code of a structure in this process or in the cache; None without it."""
    found = known_library(structure)
    if found is not None:
        return found
    made = load_cached(identity_of(structure), _loader(parameters))
    return None if made is None else remember(structure, *made)


def begin_compilation(structure: Structure, source: Source) -> Compilation | None:
    """Start the compiler beside the program; None where another process compiles the same.

    Raises
    ------
    CompilationError
        If there is no compiler, or it cannot be started.
    """
    identity = identity_of(structure)
    return Compilation.begin(
        source.text, source.units, identity, PATIENCE, alone=True, background=True
    )


def take_compilation(
    structure: Structure, parameters: FloatArray, compilation: Compilation
) -> Library:
    """The code that the compiler made.

    Raises
    ------
    CompilationError
        If it made none.
    """
    return remember(structure, *compilation.load(_loader(parameters)))


def _loader(parameters: FloatArray) -> Callable[[Path], Any]:
    """Makes ``GeneratedTerms`` of the path of a library."""
    if core is None:
        raise InputError(
            "generated code needs the compiled kernel, which is not available",
            element="backend",
            remedy="Use the backend auto",
        )
    make = core.GeneratedTerms
    return lambda path: make(str(path), parameters)


def known_library(structure: Structure) -> Library | None:
    """The code of a structure that this process has; None without it."""
    with _lock:
        found = _libraries.get(structure)
        if found is not None:
            _libraries.move_to_end(structure)
        return found


def remember(structure: Structure, terms: Any, compiled: Compiled) -> Library:
    """Keep the code of a structure in this process."""
    global _arrivals
    with _lock:
        _arrivals += 1
        _libraries[structure] = library = Library(terms, compiled)
        while len(_libraries) > KEPT:
            _libraries.popitem(last=False)
    return library


def _new_lock() -> None:
    """In a fork: a thread that it does not have may have held the lock."""
    global _lock
    _lock = Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_new_lock)
