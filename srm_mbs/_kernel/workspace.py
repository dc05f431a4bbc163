"""Pinocchio's workspaces, without its second derivatives where those would fill the memory.

A ``pin.Data`` holds second derivatives of the dynamics, 4 nv^3 numbers: 8 GB at 640 coordinates.
Nothing here uses them.
"""

from __future__ import annotations

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
