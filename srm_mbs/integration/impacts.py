"""Impacts: velocities that change at once, by impulses along a normal and along the closures."""

from __future__ import annotations

import math
from collections import deque
from typing import Any

from srm_mbs._kernel import core
from srm_mbs._kernel.workspace import LARGE, take_idle
from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.mechanism import Mechanism, check_mechanism
from srm_mbs.dynamics.multibody import ClosedSystem, OpenSystem, make_system
from srm_mbs.errors import InputError, counted, safe_repr
from srm_mbs.integration.kernel.backend import backend
from srm_mbs.integration.kernel.system import Evaluator, make_kernel_system
from srm_mbs.model.mechanism import per_model
from srm_mbs.model.numbers import finite_array
from srm_mbs.model.validation import STATE_ARGUMENTS, checked_start

SMALLEST_GAIN = 1e-12
"""Response of n.v to an impulse along n, over that without closures, below which the closures do
not let the mechanism move along n."""


@per_model
def _idle_systems(mechanism: Mechanism) -> deque[OpenSystem | ClosedSystem | Evaluator]:
    """The equations of motion that an impact left: their parts that depend on the start do not
    matter to impulses."""
    return deque(maxlen=1)


def _share(restitution: Any) -> float | None:
    """``restitution`` as a number from 0 to 1; None if it is none."""
    if type(restitution) is not float:
        found = finite_array(restitution, ())
        restitution = math.nan if found is None else float(found)
    return restitution if 0.0 <= restitution <= 1.0 else None


def _make_system(mechanism: Mechanism) -> OpenSystem | ClosedSystem | Evaluator:
    """The equations of motion, on the kernel if it has closures and is available."""
    system = make_system(mechanism)
    if core is None or not system.has_constraints:
        return system
    return Evaluator(system, make_kernel_system(system))


def impact(
    mechanism: Mechanism, q: Any, v: Any, normal: Any, restitution: float = 0.0
) -> FloatArray:
    """Velocities after an impact that closures take part in.

    An impulse acts along ``normal`` and along the closures, so that the rate n.v turns into
    -e n.v while G v = 0 stays: v + a mu with a = (1 - P) M^{-1} n (Newton's law of restitution).

    Parameters
    ----------
    mechanism
        What is hit.
    q : (nq,), v : (nv,)
        State before.
    normal : (nv,)
        n: gradient of the distance to the stop in the coordinates of v.
    restitution
        e, from 0 (it stays) to 1 (elastic).

    Returns
    -------
    v : (nv,)

    Raises
    ------
    InputError
        For another shape, a restitution that is none, or if the closures do not let the mechanism
        move along ``normal``.
    EvaluationError
        If the mass matrix is not positive definite, or a closure has no direction at q.
    """
    check_mechanism(mechanism)
    share = _share(restitution)
    if share is None:
        raise InputError(
            f"restitution = {safe_repr(restitution)} is not between 0 and 1",
            element="restitution",
            remedy="Give 0 (nothing springs back) to 1 (all of it)",
        )
    q, v = checked_start(mechanism.model, q, v, STATE_ARGUMENTS)
    remedy = f"Give {counted(len(v), 'number')}"
    n = finite_array(normal)
    if n is None:
        raise InputError(
            f"normal = {safe_repr(normal)} does not consist of finite numbers",
            element="normal",
            remedy=remedy,
        )
    if n.shape != v.shape:
        raise InputError(
            f"normal has shape {n.shape}, not {v.shape}", element="normal", remedy=remedy
        )
    idle = _idle_systems(mechanism)
    system = take_idle(idle) or _make_system(mechanism)
    used = system
    if isinstance(system, Evaluator) and backend() == "python":
        used = system.system
    along, free = used.impulse_response(q, n)
    if mechanism.model.nv <= LARGE:
        idle.append(system)
    gain = float(n.dot(free))
    if not gain > SMALLEST_GAIN * float(n.dot(along)):
        raise InputError(
            "the closures do not let the mechanism move along this normal",
            element="normal",
            remedy="Give the gradient of the gap, which some motion of the mechanism changes",
        )
    out: FloatArray = v - (1.0 + share) * float(n.dot(v)) / gain * free
    return out
