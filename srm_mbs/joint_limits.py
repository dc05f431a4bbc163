"""Position limits of joints: which are left, and closing within them."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from srm_mbs.arrays import FloatArray, IndexArray
from srm_mbs.closing import ClosureProblem, close_from
from srm_mbs.forces import OPEN, LimitSpring
from srm_mbs.mechanism import Mechanism
from srm_mbs.systems.units import coordinate_units
from srm_mbs.workspaces import workspace

SLACK = 1e-9
"""What rounding may take a joint beyond its limit, rad or m."""
CONTACT = 100.0
"""Angular frequency of a default contact over the mechanism's characteristic rate."""
DAMPING_RATIO = 0.1
SMALLEST_INERTIA = 1e-3
"""Least inertia that a default contact is made for, over the largest of the tree."""
STARTS = 24
SPREAD = 1.5
"""Size of the restarts, rad or scene diagonals."""


def _limited(mechanism: Mechanism) -> list[tuple[str, int, int, float, float]]:
    """(name, index in q, index in v, lowest, highest) of the one-degree joints with limits."""
    model = mechanism.model
    rows = []
    for name in mechanism.joint_names:
        joint = mechanism.joint(name)
        if joint.nq == joint.nv == 1:
            low = float(model.lowerPositionLimit[joint.idx_q])
            high = float(model.upperPositionLimit[joint.idx_q])
            # Without limits Pinocchio has -inf, inf, or both zero where none were ever set.
            if low < high:
                rows.append((name, joint.idx_q, joint.idx_v, low, high))
    return rows


def beyond_limits(mechanism: Mechanism, q: FloatArray) -> dict[str, tuple[float, float]]:
    """Joint name -> (its position in q (nq,), the limit that it is beyond), rad or m."""
    out = {}
    for name, i, _, low, high in _limited(mechanism):
        if q[i] < low - SLACK:
            out[name] = (float(q[i]), low)
        elif q[i] > high + SLACK:
            out[name] = (float(q[i]), high)
    return out


def close_within_limits(
    problem: ClosureProblem, start: FloatArray, free: IndexArray
) -> FloatArray | None:
    """The closed configuration nearest to ``start`` that was found within all limits, or None."""
    mechanism = problem.mechanism
    rng = np.random.default_rng(0)
    limited = _limited(mechanism)
    found: list[FloatArray] = []
    for k in range(STARTS):
        q = (
            problem.move(start, rng.uniform(-SPREAD, SPREAD, len(free)), free)
            if k
            else start.copy()
        )
        low, high = np.full(problem.model.nv, -np.inf), np.full(problem.model.nv, np.inf)
        for _, i, j, least, largest in limited:
            inside = 1e-6 * min(1.0, largest - least)  # the search starts within its bounds
            if j in free:
                q[i] = np.clip(q[i], least + inside, largest - inside)
            low[j], high[j] = (least - q[i]) / problem.unit[j], (largest - q[i]) / problem.unit[j]
        closed = close_from(problem, q, free, bounds=(low[free], high[free]))
        # Angles count as they are: a turn more may be within the limits.
        if problem.closed(closed) and not beyond_limits(mechanism, closed):
            found.append(closed)
    return min(found, key=problem.distance, default=None)


def limit_springs(mechanism: Mechanism) -> tuple[LimitSpring, ...]:
    """Springs at all position limits that have none yet, as stiff as the mechanism is fast.

    k = M_jj (100 w)^2 and c = 0.2 sqrt(k M_jj), with the inertia M_jj that the joint moves in the
    open tree at q0 and the mechanism's characteristic rate w
    (:class:`~srm_mbs.systems.units.Units`): a contact takes about a hundredth of its time.
    """
    there = {force.joint for force in mechanism.forces if isinstance(force, LimitSpring)}
    rate = coordinate_units(mechanism, mechanism.q0, mechanism.v0).rate
    inertia = np.diag(pin.crba(mechanism.model, workspace(mechanism.model), mechanism.q0))
    out = []
    for name, _, j, low, high in _limited(mechanism):
        moved = max(float(inertia[j]), SMALLEST_INERTIA * float(inertia.max()))
        stiffness = moved * (CONTACT * rate) ** 2
        if name not in there and min(abs(low), abs(high)) < OPEN:
            damping = 2.0 * DAMPING_RATIO * float(np.sqrt(stiffness * moved))
            out.append(LimitSpring(name, stiffness, damping, name=f"limit_{name}"))
    return tuple(out)
