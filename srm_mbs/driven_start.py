"""Where drives begin that prescribe positions and not only motions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from srm_mbs.arrays import FloatArray
from srm_mbs.coordinates import set_position
from srm_mbs.errors import AssemblyError
from srm_mbs.mechanism import Mechanism

CONTRADICTS = 1e-9
"""Difference (rad, m) between a held position and where a drive begins."""


def with_absolute_drives(
    mechanism: Mechanism, start: FloatArray, held: tuple[str, ...]
) -> tuple[tuple[str, ...], Mechanism]:
    """Put what absolute drives begin with: joints into ``start`` and ``held``, points into the
    loops of the mechanism.

    Raises
    ------
    AssemblyError
        If a held position contradicts a drive.
    """
    loops = list(mechanism.loops)
    for drive in mechanism.drives:
        if not drive.absolute:
            continue
        value = drive.curve(0.0)(0.0)[0]
        if drive.joint is None:
            loops.append(drive.frozen(value))
            continue
        wanted = start.copy()
        set_position(mechanism, wanted, drive.joint, value)
        if drive.joint in held and np.abs(wanted - start).max() > CONTRADICTS:
            raise AssemblyError(
                f"the held position of {drive.joint!r} contradicts the drive {drive.name!r}, "
                f"which begins at {value:.6g}",
                residuals={},
                q=start,
                held=(drive.joint,),
                element="initial.q",
                remedy="Free it, or remove absolute from the drive: its law then begins there",
            )
        start[:] = wanted
        held = (*held, *(() if drive.joint in held else (drive.joint,)))
    if len(loops) == len(mechanism.loops):
        return held, mechanism
    return held, replace(mechanism, loops=tuple(loops), drives=())
