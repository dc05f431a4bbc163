"""Pinocchio's workspaces, without its second derivatives where those would fill the memory.

A ``pin.Data`` holds second derivatives of the dynamics, 4 nv^3 numbers: 8 GB at 640 coordinates.
Nothing here uses them.
"""

from __future__ import annotations

import threading
from typing import Any

import pinocchio as pin

LARGE = 64
"""Coordinates from which the kernel makes the workspaces: Pinocchio's own have 8 MB there."""


def workspace(model: pin.Model) -> pin.Data:
    """A ``pin.Data`` for kinematics, Jacobians, crba, nonLinearEffects, aba and energies.

    Large models get one that has no derivatives and regressors: Pinocchio's other algorithms must
    not be called with it.  Without the kernel it is Pinocchio's own.
    """
    if model.nv > LARGE:
        from srm_mbs._kernel import core

        if core is not None:
            return core.lean_data(model)
    return model.createData()


_latest = threading.local()


def scratch(model: pin.Model) -> pin.Data:
    """A :func:`workspace` for one evaluation: the next call for ``model`` in this thread may return
    the same one, so that nothing may refer to its arrays any longer then.

    Loading evaluates several things once, and making a workspace takes longer than they do.
    """
    if model.nv > LARGE:
        return workspace(model)
    latest: tuple[Any, int, pin.Data] | None = getattr(_latest, "workspace", None)
    if latest is None or latest[0] is not model or latest[1] != model.njoints:
        latest = _latest.workspace = model, int(model.njoints), workspace(model)
    return latest[2]
