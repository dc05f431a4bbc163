"""The generated code of a mechanism: made once, shared by mechanisms of one structure.

:func:`load_code` gives the kernel's ``GeneratedTerms`` of a mechanism, from this process, from the
cache of the user, or newly compiled.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Callable
from pathlib import Path
from threading import Lock
from typing import Any, NamedTuple

from srm_mbs._kernel import core
from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.dynamics.multibody import make_system
from srm_mbs.errors import InputError, get_logger
from srm_mbs.integration.generated.code_cache import (
    CompilationError,
    Compiled,
    compile_and_load,
    load_cached,
)
from srm_mbs.integration.generated.source import Source, source_of
from srm_mbs.integration.generated.structure import (
    Structure,
    UnsupportedElementError,
    structure_of,
)
from srm_mbs.model.mechanism import MechanismData, per_model

log = get_logger(__name__)

MOST_OPERATIONS = 40_000
"""Statements of generated code: compilation takes about 0.15 ms each, and more for each the more
there are."""
KEPT = 256
"""Structures whose code a process keeps."""


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


class _Library(NamedTuple):
    """The code of a structure in this process."""

    source: Source
    terms: Any
    """A ``GeneratedTerms``; others are made from it."""
    compiled: Compiled


_libraries: OrderedDict[Structure, _Library] = OrderedDict()
_lock = Lock()


@per_model
def _loaded(mechanism: MechanismData) -> deque[Any]:
    """The ``GeneratedTerms`` of a mechanism, once it was asked for."""
    return deque(maxlen=1)


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
        structure, parameters = _structure(mechanism)
        find = _library if compiles else _cached_library
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


def code_of_run(by: str, asked: str, mechanism: Mechanism) -> tuple[str, Any]:
    """Backend of a run of ``mechanism``, and its ``GeneratedTerms`` or None.

    Parameters
    ----------
    by
        From :func:`~srm_mbs.integration.kernel.backend.chosen_backend`.
    asked
        The option ``backend``: with ``"auto"``, the kernel runs where there is no code.

    Raises
    ------
    InputError
        If generated code is insisted on and cannot be made.
    """
    if by != "generated":
        return by, None
    try:
        return by, load_code(mechanism)
    except InputError as error:
        if asked != "auto":
            raise
        log.info("the kernel makes this run without generated code: %s", error)
        return "kernel", None


def compile_mechanism(mechanism: Mechanism) -> CompiledMechanism:
    """Load the code of a mechanism, and say how it was made; raises as :func:`load_code`."""
    structure, parameters = _structure(mechanism)
    known = structure in _libraries
    library = _library(structure, parameters)
    load_code(mechanism)
    seconds = 0.0 if known else library.compiled.seconds
    source = library.source
    return CompiledMechanism(source.operations, seconds, library.compiled.path, source.text)


def generated_source(mechanism: Mechanism) -> str:
    """The C of a mechanism, which need not be compiled.

    Raises
    ------
    InputError
        If it cannot be generated.
    """
    return _source(_structure(mechanism)[0]).text


def _structure(mechanism: Mechanism) -> tuple[Structure, FloatArray]:
    try:
        return structure_of(mechanism.model, make_system(mechanism).constants())
    except UnsupportedElementError as error:
        raise _not_generated(str(error)) from error


def _not_generated(why: str) -> InputError:
    return InputError(
        f"no code can be generated for this mechanism: {why}",
        element="backend",
        remedy="Use the backend kernel",
    )


def _source(structure: Structure) -> Source:
    try:
        source = source_of(structure)
    except UnsupportedElementError as error:
        raise _not_generated(str(error)) from error
    if source.operations > MOST_OPERATIONS:
        raise _not_generated(
            f"it would have {source.operations} statements, more than {MOST_OPERATIONS}"
        )
    return source


def _library(structure: Structure, parameters: FloatArray) -> _Library:
    """The code of a structure; ``parameters`` are those of one mechanism of it."""
    found = _known(structure)
    if found is not None:
        return found
    source = _source(structure)
    try:
        return _remember(structure, source, *compile_and_load(source.text, _loader(parameters)))
    except CompilationError as error:
        raise InputError(
            f"the generated code cannot be compiled: {error}",
            element="backend",
            remedy=f"{error.remedy}, or use the backend kernel",
        ) from error


def _cached_library(structure: Structure, parameters: FloatArray) -> _Library | None:
    """As :func:`_library`; None where it would have to be compiled."""
    found = _known(structure)
    if found is not None:
        return found
    source = _source(structure)
    made = load_cached(source.text, _loader(parameters))
    return None if made is None else _remember(structure, source, *made)


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


def _known(structure: Structure) -> _Library | None:
    """The code of a structure that this process has."""
    with _lock:
        found = _libraries.get(structure)
        if found is not None:
            _libraries.move_to_end(structure)
        return found


def _remember(structure: Structure, source: Source, terms: Any, compiled: Compiled) -> _Library:
    with _lock:
        _libraries[structure] = library = _Library(source, terms, compiled)
        while len(_libraries) > KEPT:
            _libraries.popitem(last=False)
    return library
