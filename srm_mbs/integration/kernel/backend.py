"""Which backend makes a run: the compiled kernel where it is there and has what is asked for.

How runs are made on it is in :mod:`srm_mbs.integration.kernel`.
"""

from __future__ import annotations

import logging
import os
from functools import cache

from srm_mbs._kernel import OUTDATED, core, missing
from srm_mbs._typing import FloatArray
from srm_mbs.errors import InputError
from srm_mbs.integration.methods.base import Method
from srm_mbs.integration.methods.psrm import PSRM

log = logging.getLogger(__name__)

BACKENDS = ("auto", "python", "kernel")
PLACEMENTS = ("automatic", "off")
"""Those that the kernel has."""


def backend() -> str:
    """What ``backend="auto"`` takes where it can: ``"kernel"`` or ``"python"``.

    ``"python"`` where there is no kernel (``srm-mbs info`` says why), or where the environment
    variable SRM_MBS_BACKEND is ``python``.
    """
    return "python" if core is None or _unwanted() else "kernel"


def _unwanted() -> bool:
    return os.environ.get("SRM_MBS_BACKEND") == "python"


def unsupported_reason(method: Method, placement: str, singular_times: FloatArray) -> str:
    """Why the kernel cannot make a run: it is not there, or lacks an option; empty if it can."""
    if core is None:
        return missing
    if not (isinstance(method, PSRM) and method.correction == "split"):
        return "it has the split PSRM only"
    if placement not in PLACEMENTS:
        return f"it has no placement {placement!r}"
    if len(singular_times):
        return "it has no given singular times"
    return ""


def uses_kernel(asked: str, method: Method, placement: str, singular_times: FloatArray) -> bool:
    """Whether a run with ``backend=asked`` is made by the compiled kernel.

    Raises
    ------
    InputError
        If there is no such backend, or ``asked`` is the kernel and it cannot make the run.
    """
    if asked not in BACKENDS:
        raise InputError(
            f"there is no backend {asked!r}",
            element="backend",
            remedy=f"Known: {', '.join(BACKENDS)}",
        )
    if asked == "python" or (asked == "auto" and _unwanted()):
        return False
    reason = unsupported_reason(method, placement, singular_times)
    if asked == "kernel" and reason:
        raise InputError(
            f"the compiled kernel cannot make this run: {reason}",
            element="backend",
            remedy="Use the backend auto, which takes the Python reference where it has to",
        )
    if reason == OUTDATED:
        warn_outdated()
    elif reason:
        log.info("the Python reference makes this run, not the compiled kernel: %s", reason)
    return not reason


@cache
def warn_outdated() -> None:
    """Say, once, that runs are slow because the kernel does not fit the sources any more."""
    log.warning(
        "runs use the Python reference, because the compiled kernel is left out: %s", missing
    )
