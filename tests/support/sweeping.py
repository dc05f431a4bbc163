"""Functions that sweeps of the tests send to other processes."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

import srm_mbs as srm


def states(solution: srm.Solution) -> dict[str, Any]:
    """The end of a run, to the last bit, and who made it."""
    q = {f"q_{k}": value for k, value in enumerate(solution.q[-1])}
    v = {f"v_{k}": value for k, value in enumerate(solution.v[-1])}
    return {**q, **v, "steps": solution.stats.steps, "process": os.getpid()}


def drawn(solution: srm.Solution) -> dict[str, Any]:
    """A number drawn at random."""
    return {"number": os.urandom(8).hex()}


def pendulum(mass: float = 1.0, length: float = 1.0, angle: float = 0.3) -> srm.Mechanism:
    """A point mass on a rod that swings in the vertical plane; ``angle`` from hanging, rad."""
    if length <= 0.0:
        raise ValueError(f"the length {length:g} m is not positive")
    model = pin.Model()
    model.name = "pendulum"
    joint = model.addJoint(0, pin.JointModelRY(), pin.SE3.Identity(), "hinge")
    bob = pin.Inertia(mass, np.array([0.0, 0.0, -length]), np.zeros((3, 3)))
    model.appendBodyToJoint(joint, bob, pin.SE3.Identity())
    return srm.Mechanism(model, q0=[angle])


def period(solution: srm.Solution) -> dict[str, Any]:
    """Of a swing, s: between the first two passages downwards through the lowest point."""
    assert solution.t_events is not None
    first, second = solution.t_events[0][:2]
    return {"period": second - first}


def lowest(t: float, q: Any, v: Any) -> float:
    return float(q[0])


lowest.direction = -1  # type: ignore[attr-defined]


def deadly(length: float = 1.0) -> srm.Mechanism:
    """A pendulum; its process dies if the length is infinite."""
    if np.isinf(length):
        os.kill(os.getpid(), signal.SIGKILL)
    return pendulum(length=length)


def dying_once(length: float, fatal: bool, folder: str) -> srm.Mechanism:
    """A pendulum; the first process that makes the ``fatal`` one dies, and leaves its id."""
    left = Path(folder) / "died"
    if fatal and not left.exists():
        left.write_text(str(os.getpid()), encoding="utf-8")
        os.kill(os.getpid(), signal.SIGKILL)
    return pendulum(length=length)
