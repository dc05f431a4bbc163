"""Which backend makes a run: the compiled kernel where it is there and has what is asked for.

How runs are made on it is in :mod:`srm_mbs.integration.kernel`.
"""

from __future__ import annotations

import os
from functools import cache

from srm_mbs._kernel import core, missing, remedy
from srm_mbs._typing import FloatArray
from srm_mbs.errors import InputError, get_logger, safe_repr, warn
from srm_mbs.integration.generated.code_cache import compiler
from srm_mbs.integration.methods.base import Method
from srm_mbs.integration.methods.psrm import PSRM

log = get_logger(__name__)

BACKENDS = ("auto", "python", "kernel", "generated")
COMPILED = ("kernel", "generated")
"""Those of which the compiled kernel makes the runs."""
PLACEMENTS = ("automatic", "off")
"""Those that the kernel has."""


def backend() -> str:
    """The backend that ``backend="auto"`` takes where it can: ``"kernel"``, ``"python"`` or
    ``"generated"``.

    ``"python"`` where there is no kernel (``srm-mbs info`` says why), or where the environment
    variable SRM_MBS_BACKEND is ``python``; ``"generated"`` where that variable is ``generated`` and
    there is a C compiler.
    """
    if core is None or _unwanted():
        return "python"
    return "generated" if generated_wanted() else "kernel"


def generated_wanted() -> bool:
    """Whether runs with ``backend="auto"`` take generated code where they can."""
    return os.environ.get("SRM_MBS_BACKEND") == "generated" and compiler() is not None


def _unwanted() -> bool:
    return os.environ.get("SRM_MBS_BACKEND") == "python"


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
    if _unwanted():
        raise InputError(
            "the environment variable SRM_MBS_BACKEND asks for the Python reference",
            element="backend",
            remedy="Run: unset SRM_MBS_BACKEND",
        )


def unsupported_reason(method: Method, placement: str, singular_times: FloatArray) -> str | None:
    """Which option of a run the kernel lacks; None if it has them all."""
    if not (isinstance(method, PSRM) and method.correction == "split"):
        return "it has the split PSRM only"
    if placement not in PLACEMENTS:
        return f"it has no placement {safe_repr(placement)}"
    if len(singular_times):
        return "it has no given singular times"
    return None


def chosen_backend(asked: str, method: Method, placement: str, singular_times: FloatArray) -> str:
    """The backend of a run with ``backend=asked``: ``"python"``, ``"kernel"``, or ``"generated"``;
    the last one for ``"auto"``, too, where it is wanted and the mechanism allows it
    (:func:`~srm_mbs.integration.generated.code.code_of_run`).

    Warns, once per process, where the kernel would make the run if it were available.

    Raises
    ------
    InputError
        If there is no such backend, or ``asked`` needs the kernel and it cannot make the run.
    """
    if not isinstance(asked, str) or asked not in BACKENDS:
        raise InputError(
            f"there is no backend {safe_repr(asked)}",
            element="backend",
            remedy=f"Known: {', '.join(BACKENDS)}",
        )
    if asked == "python" or (asked == "auto" and _unwanted()):
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
    if asked != "auto":
        return asked
    return "generated" if generated_wanted() else "kernel"


@cache
def warn_missing() -> None:
    """Warn, once per process, that runs are slow because there is no kernel."""
    warn(
        "runs use the Python reference, which is many times slower, because the compiled kernel "
        f"is not available: {missing}. {remedy}"
    )
