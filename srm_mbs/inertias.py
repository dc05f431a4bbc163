"""Whether the inertias of a tree determine its motion."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from scipy.linalg.lapack import dpotrf

from srm_mbs.arrays import FloatArray
from srm_mbs.errors import InputError
from srm_mbs.workspaces import workspace

NO_INERTIA = 1e-13
"""An articulated inertia below this fraction of the composite one is the rounding of zero."""


def check_inertia(model: pin.Model, file: str | None = None) -> None:
    """Refuse joints that move no inertia: the equations of motion have no solution.

    ``file`` is what the model was read from.

    Raises
    ------
    InputError
        Naming the joint and the links that it moves.
    """
    if model.nv == 0:
        return
    moved = np.zeros((model.njoints, 2))
    for joint in range(model.njoints - 1, 0, -1):
        inertia = model.inertias[joint]
        moved[joint] += inertia.mass, np.trace(inertia.inertia)
        moved[model.parents[joint]] += moved[joint]

    def links(joint: int) -> str:
        names = [
            repr(f.name)
            for f in model.frames
            if f.parentJoint == joint and f.type == pin.FrameType.BODY
        ]
        return ", ".join(names) or "its body"

    for joint in range(1, model.njoints):
        if not moved[joint].any():
            raise InputError(
                f"neither {links(joint)} nor anything behind it has inertia",
                file=file,
                element=f"joint {model.names[joint]!r}",
                remedy="Give the moving end of the chain an <inertial>",
            )
    rng = np.random.default_rng(0)
    q = pin.integrate(model, pin.neutral(model), rng.uniform(-1.0, 1.0, model.nv))
    at = undetermined_joint(model, q, file)
    if at is not None:
        raise InputError(
            f"the joint moves mass ({links(at)} and what is behind it) but no inertia in one "
            "of its directions: its acceleration is not determined",
            file=file,
            element=f"joint {model.names[at]!r}",
            remedy="Give a moment of inertia, or a centre of mass off the axis",
        )


def undetermined_joint(model: pin.Model, q: FloatArray, file: str | None = None) -> int | None:
    """A joint with a direction in which it moves no inertia at q (nq,); None if there is none.

    As one whose axis runs through a point mass, or the outer axes of massless links in line.  The
    pivots of M, tips first, show it; they are those of the articulated inertias over M_ii.

    Raises
    ------
    InputError
        If the mass matrix is not finite.
    """
    with np.errstate(all="ignore"):
        M = pin.crba(model, workspace(model), q)
        M = (np.triu(M) + np.triu(M, 1).T)[::-1, ::-1]
        size = np.sqrt(np.diag(M))
        scaled = M / size[:, None] / size
    if not np.isfinite(M).all():
        raise InputError(
            "the mass matrix is not finite",
            file=file,
            remedy="Check the size of the masses, inertias and lengths",
        )
    bad = np.flatnonzero(~(size > 0.0))
    if bad.size:
        failed = int(bad[0])
    else:
        factor, info = dpotrf(scaled, lower=1)
        small = np.flatnonzero(np.diag(factor)[: info - 1 if info else None] ** 2 < NO_INERTIA)
        if not small.size and not info:
            return None
        failed = int(small[0]) if small.size else info - 1
    component = model.nv - 1 - failed
    return next(i for i in range(1, model.njoints) if component < _velocity_end(model, i))


def _velocity_end(model: pin.Model, joint: int) -> int:
    return int(model.joints[joint].idx_v + model.joints[joint].nv)
