"""Consistency of states with closures and drives: the check of starts, and the ends of runs.

The correction at the end of a step closes the loops up to the square of what it corrects, so the
end of a run with a loose tolerance may be farther from the closures than a start is allowed to be.
:func:`closed_end` moves it onto them, so that another run can start there.
"""

from __future__ import annotations

from contextlib import suppress
from typing import NamedTuple

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.constraints.rheonomic import constraint_errors
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.dynamics.multibody import ClosedSystem, OpenSystem, make_system
from srm_mbs.dynamics.scaling import Units, constraint_units
from srm_mbs.errors import EvaluationError, InputError
from srm_mbs.integration.kernel.backend import COMPILED
from srm_mbs.integration.kernel.observables import closure_errors, largest_errors
from srm_mbs.integration.methods.branch_nodes import onto_closed_branch
from srm_mbs.model.mechanism import per_start
from srm_mbs.model.validation import START_ARGUMENTS

CONSISTENT = 1e-8
"""Largest closure error of an accepted start, in row units, and of its rates in those per time."""
MAY_VIOLATE = 0.1
"""Part of CONSISTENT in the units of the start of a run, from which it may be more in those of its
end."""


class Violation(NamedTuple):
    """The row that a state violates most.

    Attributes
    ----------
    rate
        Whether the rate of the row is violated, not its position.
    row
        Its number; those of drives follow those of closures.
    value
        Its error (m, rad, m/s, rad/s).
    """

    rate: bool
    row: int
    value: float


def largest_violation(
    mechanism: Mechanism,
    t: float,
    q: FloatArray,
    v: FloatArray,
    backend: str,
    system: OpenSystem | ClosedSystem | None,
    units: Units | None = None,
    consistent: float = CONSISTENT,
) -> Violation | None:
    """The row that q (nq,) and v (nv,) violate most at ``t`` (s) by more than ``consistent`` in
    ``units``, those of the mechanism unless given, as ``backend`` evaluates it; None if there is
    none."""
    units = units or mechanism.structure.units
    unit = constraint_units(mechanism, units)
    by_kernel = backend in COMPILED and not mechanism.drives
    if by_kernel:
        open_by, rate = largest_errors(mechanism, t, q, v, unit, system)
        if open_by <= consistent and rate <= consistent * units.rate:
            return None
    speed = max(units.rate, *np.abs(v / units.coordinate).tolist())
    start = np.array([t]), q[None], v[None]
    if by_kernel:
        g, c = (e[0] for e in closure_errors(mechanism, *start, system))
    elif t == 0.0 and q is mechanism.q0 and v is mechanism.v0:
        g, c = mechanism.initial_errors
    else:
        g, c = (e[0] for e in constraint_errors(mechanism, *start))
    if not len(g):
        return None
    for values, limit in ((g, consistent), (c, consistent * speed)):
        errors = np.abs(values) / unit
        if max(errors.tolist()) > limit:
            worst = int(errors.argmax())
            return Violation(values is c, worst, float(values[worst]))
    return None


@per_start
def _accepted_times(mechanism: Mechanism) -> set[float]:
    """Times (s) at which the initial state satisfies closures and drives, as far as checked."""
    return set()


def check_consistent(
    mechanism: Mechanism,
    t: float = 0.0,
    backend: str = "python",
    system: OpenSystem | ClosedSystem | None = None,
    names: tuple[str, str] = START_ARGUMENTS,
) -> None:
    """Refuse a start at ``t`` (s) that violates the closures, the drives or their rates, which
    ``backend`` evaluates; ``system`` is that of the mechanism, if it is at hand.  Messages call
    positions and rates ``names``.

    Raises
    ------
    InputError
        Naming the row that is violated most.
    """
    accepted = _accepted_times(mechanism)
    if t in accepted:
        return
    found = largest_violation(mechanism, t, mechanism.q0, mechanism.v0, backend, system)
    if found is not None:
        rows = mechanism.structure.row_names
        kind = "drives" if found.row >= len(rows) - len(mechanism.drives) else "closures"
        raise InputError(
            f"the initial state violates the {kind}: row {rows[found.row]} by {found.value:.1e}",
            element=names[found.rate],
            remedy="Use srm.assemble(mechanism, q=..., v=...) to get a consistent q and v",
        )
    accepted.add(t)


def closed_end(
    mechanism: Mechanism,
    t: float,
    state: FloatArray,
    backend: str,
    system: OpenSystem | ClosedSystem,
) -> FloatArray:
    """``state`` (nq + nv,) at the end ``t`` (s) of a run, on the closures and drives: itself if
    a run may start there.

    The move is a part of the tolerance of the run.  Where the state cannot be evaluated, or no
    closed one is near, it remains as it is.
    """
    q, v = state[: mechanism.model.nq], state[mechanism.model.nq :]

    def violated(units: Units | None, limit: float) -> bool:
        found = largest_violation(mechanism, t, q, v, backend, system, units, limit)
        return found is not None

    with suppress(EvaluationError):
        # The units of a run follow from its start.
        if violated(None, MAY_VIOLATE * CONSISTENT) and violated(
            mechanism.with_state(q, v).structure.units, CONSISTENT
        ):
            # Functions of the user are not called again.
            return onto_closed_branch(make_system(mechanism), t, state)
    return state
