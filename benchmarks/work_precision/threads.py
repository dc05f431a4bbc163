"""One thread for everything that is measured; imported before NumPy."""

from __future__ import annotations

import os
import sys
from collections.abc import MutableMapping, Sequence

VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "BLIS_NUM_THREADS",
    "NUMEXPR_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
)
PARALLEL = 1.25
"""CPU time over wall time from which a run cannot have had one thread."""
SHORT = 0.05
"""Runs shorter than this (s) are not looked at: the clocks are read one after the other."""


def single_threaded(environment: MutableMapping[str, str]) -> bool:
    """Set the variables in ``environment``; whether they were set already."""
    missing = [name for name in VARIABLES if environment.get(name) != "1"]
    environment.update(dict.fromkeys(missing, "1"))
    return not missing


def enforce(arguments: Sequence[str]) -> None:
    """Go on on one thread: libraries read the variables when they are loaded.

    If NumPy has been loaded without them, the process replaces itself by
    ``python -m benchmarks.work_precision`` with ``arguments``.
    """
    if not single_threaded(os.environ) and "numpy" in sys.modules:
        sys.stdout.flush()
        sys.stderr.flush()
        command = [sys.executable, "-m", "benchmarks.work_precision", *arguments]
        os.execv(sys.executable, command)


def check(cpu: float, wall: float) -> None:
    """Refuse a measurement whose CPU time (s) shows more than one thread.

    Raises
    ------
    RuntimeError
        If ``cpu`` exceeds ``wall`` by more than the resolution of the clocks.
    """
    if cpu > SHORT and cpu > PARALLEL * wall:
        raise RuntimeError(
            f"{cpu:.2f} s of CPU time in {wall:.2f} s: something runs on several threads"
        )
