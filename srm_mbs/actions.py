"""What happens at events: actions that change the state, or the mechanism."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from srm_mbs.arrays import FloatArray
from srm_mbs.errors import InputError
from srm_mbs.mechanism import Mechanism
from srm_mbs.options import numbers
from srm_mbs.systems.multibody import make_system
from srm_mbs.workspaces import workspace


class Event:
    """An event function with its attributes in one call.

    Parameters
    ----------
    function
        (t, q, v) -> float; the event is where it passes zero.
    direction
        > 0 for zeros passed upwards, < 0 downwards, 0 for both.
    terminal
        Whether it ends the run, or after how many occurrences.
    action
        (t, q, v) -> what goes on from there, called at each occurrence that does not end the run:
        None if nothing changes, a consistent (q, v), or a :class:`Switch`.  The state that it gets
        is on the closures.

    Raises
    ------
    InputError
        If ``function`` or ``action`` cannot be called.
    """

    def __init__(
        self,
        function: Callable[[float, FloatArray, FloatArray], Any],
        *,
        direction: float = 0.0,
        terminal: bool | int = False,
        action: Callable[[float, FloatArray, FloatArray], Any] | None = None,
    ) -> None:
        for given, what in ((function, "function"), (action, "action")):
            if given is not None and not callable(given):
                raise InputError(
                    f"the {what} {given!r} of an event cannot be called",
                    element=what,
                    remedy="Give a function of (t, q, v)",
                )
        self.__name__ = getattr(function, "__name__", "<lambda>")
        self.function, self.action = function, action
        self.direction, self.terminal = direction, terminal

    def __call__(self, t: float, q: FloatArray, v: FloatArray) -> Any:
        """The value of the function."""
        return self.function(t, q, v)


@dataclass(frozen=True, eq=False)
class Switch:
    """Another mechanism from here on, as the answer of an action.

    Parameters
    ----------
    mechanism
        With the same joints: other closures (:meth:`srm_mbs.Mechanism.with_loop`,
        :meth:`~srm_mbs.Mechanism.without_loop`), drives or forces.
    q : (nq,), v : (nv,)
        By default as they are.  The positions must satisfy its closures, but for the tolerance of
        the run.  The velocities are projected on them, M-orthogonally: constraint impulses act, as
        in an inelastic impact, and nothing else.

    Drives that the mechanism had go on.  A new one engages: its law counts in the time of the run,
    from the position in which it finds its coordinate, s(t) = s(t_s) + law(t) - law(t_s); an
    absolute one must find it where it prescribes it.
    """

    mechanism: Mechanism
    q: Any = None
    v: Any = None


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
    """
    import pinocchio as pin

    if not 0.0 <= restitution <= 1.0:
        raise InputError(
            f"restitution = {restitution!r} is not between 0 and 1",
            element="restitution",
            remedy="Give 0 (nothing springs back) to 1 (all of it)",
        )
    here = mechanism.with_state(q, v)
    remedy = f"Give {here.model.nv} numbers"
    n = numbers(normal, "normal", remedy)
    if n.shape != here.v0.shape:
        raise InputError(
            f"normal has shape {n.shape}, not {here.v0.shape}", element="normal", remedy=remedy
        )
    M = pin.crba(here.model, workspace(here.model), here.q0, pin.Convention.WORLD)
    along = np.linalg.solve(np.triu(M) + np.triu(M, 1).T, n)
    terms = make_system(here).evaluate(0.0, np.concatenate([here.q0, here.v0]))
    free = along - terms.project(along)
    gain = float(n @ free)
    if not gain > 1e-12 * float(n @ along):
        raise InputError(
            "the closures do not let the mechanism move along this normal",
            element="normal",
            remedy="Give the gradient of the gap, which some motion of the mechanism changes",
        )
    out: FloatArray = here.v0 - (1.0 + restitution) * float(n @ here.v0) / gain * free
    return out
