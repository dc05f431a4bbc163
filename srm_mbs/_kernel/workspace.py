"""Pinocchio's workspaces, without its second derivatives where those would fill the memory; pools
of idle ones.

A ``pin.Data`` holds second derivatives of the dynamics, 4 nv^3 numbers: 8 GB at 640 coordinates.
Nothing here uses them.
"""

from __future__ import annotations

import threading
from collections import deque
from typing import Any, NamedTuple, TypeVar

import pinocchio as pin

LARGE = 64
"""Coordinates from which the kernel makes the workspaces: Pinocchio's own have 8 MB there."""

KEPT_SYSTEMS = 4
"""Kernel systems of one mechanism that wait for users, at most; of a large mechanism one."""

Pooled = TypeVar("Pooled")


def idle_pool(nv: int) -> deque[Any]:
    """An empty pool for kernel systems of a mechanism with ``nv`` coordinates."""
    return deque(maxlen=1 if nv > LARGE else KEPT_SYSTEMS)


def take_idle(pool: deque[Pooled]) -> Pooled | None:
    """One of ``pool``, which no other thread gets; None if it is empty.

    Its user appends it afterwards.  What was used last is taken first, and a deque of limited
    length drops what has waited longest.
    """
    try:
        return pool.pop()
    except IndexError:  # another thread may take the last one after any look at the length
        return None


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


class _Scratch(NamedTuple):
    """The workspace of :func:`scratch`.

    Attributes
    ----------
    model, joints
        The model for which it was asked last, and its joints then.
    data
        The workspace.
    origin
        The model for which it was made, or of which that is a copy (:func:`share_scratch`).
    """

    model: pin.Model
    joints: int
    data: pin.Data
    origin: pin.Model


def scratch(model: pin.Model) -> pin.Data:
    """A :func:`workspace` for one evaluation: the next call for ``model`` in this thread may return
    the same one, so that nothing may refer to its arrays any longer then.

    Loading evaluates several things once, and making a workspace takes longer than they do.
    """
    if model.nv > LARGE:
        return workspace(model)
    latest: _Scratch | None = getattr(_latest, "workspace", None)
    if latest is None or latest.model is not model or latest.joints != model.njoints:
        latest = _Scratch(model, int(model.njoints), workspace(model), model)
        _latest.workspace = latest
    return latest.data


def share_scratch(origin: pin.Model, model: pin.Model) -> None:
    """Let ``model``, a copy of ``origin`` with other placements and inertias, on which no workspace
    depends, have the :func:`scratch` of ``origin`` or of another such copy."""
    if model.nv > LARGE:
        return
    latest: _Scratch | None = getattr(_latest, "workspace", None)
    joints = int(model.njoints)
    if latest is not None and latest.origin is origin and latest.joints == joints:
        data = latest.data
    else:
        data = workspace(model)
    _latest.workspace = _Scratch(model, joints, data, origin)
