"""Which backend makes a run: the compiled kernel where it is there and has what is asked for.

How runs are made on it is in :mod:`srm_mbs.integration.kernel`.
"""

from __future__ import annotations

import os
from functools import cache

from srm_mbs._kernel import core, missing, remedy
from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.errors import InputError, get_logger, known_names, safe_repr, warn
from srm_mbs.integration.generated.code import source_of_structure, structure_of_mechanism
from srm_mbs.integration.generated.code_cache import compiler
from srm_mbs.integration.generated.policy import code_at_hand, compile_seconds
from srm_mbs.integration.methods.base import Method
from srm_mbs.integration.methods.psrm import is_split
from srm_mbs.model.numbers import choice

log = get_logger(__name__)

BACKENDS = ("auto", "python", "kernel", "generated")
COMPILED = ("kernel", "generated")
"""Those of which the compiled kernel makes the runs."""
PLACEMENTS = ("automatic", "off")
"""Those that the kernel has."""


def backend(mechanism: Mechanism | None = None) -> str:
    """The backend that ``backend="auto"`` takes where it can: ``"kernel"``, ``"python"`` or
    ``"generated"``.

    ``"python"`` where there is no kernel (``srm-mbs info`` says why), or where the environment
    variable SRM_MBS_BACKEND is ``python``.

    Parameters
    ----------
    mechanism
        For its next run: ``"generated"`` if its code was compiled, and SRM_MBS_BACKEND is not
        ``kernel``.  Without a mechanism, ``"generated"`` only where that variable is ``generated``
        and there is a C compiler, so that code is compiled for every run.

    Raises
    ------
    InputError
        If SRM_MBS_BACKEND names no backend.
    """
    asked = _of_environment()
    if core is None or asked == "python":
        return "python"
    if asked == "generated" and compiler() is not None:
        return "generated"
    found = None if mechanism is None or asked == "kernel" else code_at_hand(mechanism)
    return "kernel" if found is None else "generated"


def _of_environment() -> str:
    """The backend of runs with ``backend="auto"``, as the environment has it."""
    asked = os.environ.get("SRM_MBS_BACKEND") or "auto"
    if asked not in BACKENDS:
        raise InputError(
            f"the environment variable SRM_MBS_BACKEND = {safe_repr(asked)} names no backend",
            element="backend",
            remedy=known_names(BACKENDS),
        )
    return asked


def code_is_compiled() -> bool:
    """Whether code of mechanisms is compiled for runs with ``backend="auto"`` to come."""
    return _of_environment() == "auto" and compiler() is not None


def code_status(mechanism: Mechanism) -> str | None:
    """Whether a mechanism has generated code, or why not; None where runs are made in Python."""
    asked = _of_environment()
    if core is None or asked == "python":
        return None
    if asked == "kernel":
        return "not taken, because SRM_MBS_BACKEND is kernel"
    if code_at_hand(mechanism) is not None:
        return "compiled"
    if compiler() is None:
        return "none: there is no C compiler"
    try:
        statements = source_of_structure(structure_of_mechanism(mechanism)[0]).operations
    except InputError as error:
        return f"none: {error.problem}"
    if asked == "generated":
        return "compiled by the next run"
    return (
        f"compiled once runs have used {compile_seconds(statements):.2g} s, or by srm-mbs compile"
    )


def check_kernel() -> None:
    """Check that ``backend="auto"`` takes the compiled kernel where it can.

    Raises
    ------
    InputError
        If it takes the Python reference.
    """
    if core is None:
        raise InputError(
            f"the compiled kernel is not available: {missing}", element="backend", remedy=remedy
        )
    if _of_environment() == "python":
        raise InputError(
            "the environment variable SRM_MBS_BACKEND asks for the Python reference",
            element="backend",
            remedy="Run: unset SRM_MBS_BACKEND",
        )


def unsupported_reason(method: Method, placement: str, singular_times: FloatArray) -> str | None:
    """Which option of a run the kernel lacks; None if it has them all."""
    if not is_split(method):
        return "it has the split PSRM only"
    if placement not in PLACEMENTS:
        return f"it has no placement {safe_repr(placement)}"
    if len(singular_times):
        return "it has no given singular times"
    return None


def chosen_backend(asked: str, method: Method, placement: str, singular_times: FloatArray) -> str:
    """The backend of a run with ``backend=asked``, for
    :func:`~srm_mbs.integration.generated.policy.code_of_run`.

    Warns, once per process, where the kernel would make the run if it were available.

    Returns
    -------
    str
        ``"python"``, ``"kernel"``, ``"generated"``; or ``"auto"``: generated code, if the mechanism
        has it, else the kernel.

    Raises
    ------
    InputError
        If there is no such backend, or ``asked`` needs the kernel and it cannot make the run.
    """
    choice(asked, BACKENDS, "backend")
    wanted = _of_environment() if asked == "auto" else asked
    if wanted == "python":
        return "python"
    lacking = unsupported_reason(method, placement, singular_times)
    if asked in COMPILED and (lacking or core is None):
        other = "Use the backend auto, which takes the Python reference where it has to"
        raise InputError(
            f"the compiled kernel cannot make this run: {lacking or missing}",
            element="backend",
            remedy=other if lacking else f"{remedy}. {other}",
        )
    if lacking:
        log.info("the Python reference makes this run, not the compiled kernel: %s", lacking)
    elif core is None:
        warn_missing()
    if core is None or lacking:
        return "python"
    if wanted == "generated" and asked == "auto" and compiler() is None:
        return "kernel"
    return wanted


@cache
def warn_missing() -> None:
    """Warn, once per process, that runs are slow because there is no kernel."""
    warn(
        "runs use the Python reference, which is many times slower, because the compiled kernel "
        f"is not available: {missing}. {remedy}"
    )
