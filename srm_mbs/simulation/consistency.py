"""Consistency of states with closures and drives: the starts of runs, their states, their ends.

The correction at the end of a step closes the loops up to the square of what it corrects, and dense
output lies within the tolerance of the closures, so states of a run may be farther from them than
:data:`CONSISTENT`.  A run may start at such states of another one all the same, and an analysis may
begin there: :func:`closed_start` moves a start onto the closures if its tolerance allows that,
:func:`closed_states` the states of a run, :func:`closed_end` its end, from where one with any
tolerance may go on.
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
from srm_mbs.dynamics.system import System, onto_closures
from srm_mbs.errors import EvaluationError, InputError, time_text
from srm_mbs.integration.kernel.backend import COMPILED
from srm_mbs.integration.kernel.observables import closure_errors, largest_errors
from srm_mbs.integration.methods.base import ErrorNorm
from srm_mbs.integration.methods.branch_nodes import onto_closed_branch
from srm_mbs.integration.methods.near_singular import WATCHED_SIGMA
from srm_mbs.model.mechanism import per_start
from srm_mbs.model.validation import START_ARGUMENTS

CONSISTENT = 1e-8
"""Closure error of a start, in row units, and of its rates in those per time, up to which it stays
as it is."""
LARGEST_MOVE = 10.0
"""Largest motion of a start onto the closures, over the tolerance of the run: that of dense output
with loose tolerances."""
CLOSED = 1e-12
"""Closure error, in row units, up to which a moved start is on the closures."""
OPEN_DISTANCE = 0.05
"""Motion of a start onto the closures, over sigma, above which it may belong to another branch: in
narrow layers Newton's method led to that from 0.09 on."""
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


class Motion(NamedTuple):
    """The motion of a start onto the closures.

    Attributes
    ----------
    size
        Norm, over the tolerance of the run.
    sigma
        sigma at the start.
    is_open
        Whether the start may belong to another branch than that to which the motion leads.
    """

    size: float
    sigma: float
    is_open: bool

    @classmethod
    def of(
        cls, system: System, t: float, state: FloatArray, closed: FloatArray, norm: ErrorNorm
    ) -> Motion:
        """That of ``state`` (nx,) at ``t`` (s) to ``closed`` (nx,)."""
        move = system.difference(state, closed)
        sigma = system.evaluate(t, state).sigma
        is_open = system.position_norm(move) > OPEN_DISTANCE * sigma
        return cls(norm(move, norm.weights(system.state_scale(state))), sigma, is_open)

    @property
    def is_near_singular(self) -> bool:
        """Whether that is so because a singular configuration is near."""
        return self.is_open and self.sigma < WATCHED_SIGMA

    @property
    def size_text(self) -> str:
        """The size, for messages."""
        return f"{self.size:.2g} times the tolerance of the run (at most {LARGEST_MOVE:g})"


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
    found = _violated(mechanism, t, backend, system)
    if found is not None:
        raise _refusal(mechanism, t, found, names)


def closed_start(
    mechanism: Mechanism,
    t: float,
    norm: ErrorNorm,
    backend: str = "python",
    system: OpenSystem | ClosedSystem | None = None,
    names: tuple[str, str] = START_ARGUMENTS,
    remedy: str = "",
) -> tuple[FloatArray, float]:
    """The state (nq + nv,) on the closures and drives in which a run of ``mechanism`` starts, and
    how far it was moved for that, over the tolerance of the run.

    It is the initial state itself (``mechanism.start_state``) up to :data:`CONSISTENT`.  Beyond, it
    is that moved along the normals, velocities by the M-orthogonal projection, if the motion is at
    most :data:`LARGEST_MOVE` of the tolerance in ``norm``, that of the run.

    Parameters
    ----------
    mechanism, t, backend, system, names
        As for :func:`check_consistent`.
    remedy
        What the reader of a refusal can do, instead of that for starts of runs.

    Raises
    ------
    InputError
        For another start, naming the row that is violated most, and for one so close to a singular
        configuration that the motion might lead to another branch.
    """
    found = _violated(mechanism, t, backend, system)
    if found is None:
        return mechanism.start_state, 0.0
    return _moved(mechanism, t, found, norm, backend, names, remedy)


def closed_states(
    mechanism: Mechanism,
    t: FloatArray,
    states: FloatArray,
    norm: ErrorNorm,
    backend: str,
    system: OpenSystem | ClosedSystem,
    consistent: float,
) -> tuple[FloatArray, FloatArray]:
    """``states`` (n, nq + nv) of a run of ``mechanism`` at ``t`` (n,) s, and their motions (n,)
    onto the closures and drives, over the tolerance of the run.

    States that violate these by ``consistent`` at most stay as they are; the others are moved as
    those of :func:`closed_start`, whose parameters these are.

    Raises
    ------
    InputError
        As of :func:`closed_start`, naming the time.
    """
    states, sizes, nq = states.copy(), np.zeros(len(t)), mechanism.model.nq
    for k, (time, state) in enumerate(zip(t.tolist(), states)):
        q, v = state[:nq], state[nq:]
        found = largest_violation(mechanism, time, q, v, backend, system, None, consistent)
        if found is not None:
            states[k], sizes[k] = _moved(
                mechanism.moved(q, v),
                time,
                found,
                norm,
                backend,
                ("motion", "motion"),
                "Leave this time out, or simulate with a smaller rtol or shorter steps",
                f"at t = {time_text(time)} s the state of the run",
            )
    return states, sizes


def _moved(
    mechanism: Mechanism,
    t: float,
    found: Violation,
    norm: ErrorNorm,
    backend: str,
    names: tuple[str, str],
    remedy: str,
    what: str = "the state",
) -> tuple[FloatArray, float]:
    """The initial state (nq + nv,), which has the violation ``found``, moved onto the closures, and
    the motion over the tolerance; messages call it ``what``."""
    state = mechanism.start_state
    also, near_singular = "", False
    with suppress(EvaluationError):
        closures = make_system(mechanism)  # the controller is not called
        closed = onto_closed_branch(closures, t, state)
        # Nodes of a branch lead straight on, also where branches almost cross.
        if closures.constraint_residual(t, closed) > CLOSED:
            closed = onto_closures(closures, t, state)
        motion = Motion.of(closures, t, state, closed, norm)
        near_singular = motion.is_near_singular
        if near_singular:
            also = (
                ", which leaves its branch open next to a singular configuration "
                f"(sigma = {motion.sigma:.0e})"
            )
        elif motion.size > LARGEST_MOVE:
            also = f"; the way onto them is {motion.size_text}"
        elif not motion.is_open:
            there = mechanism.moved(*closures.split(closed))
            if _violated(there, t, backend) is None:
                return closed, motion.size
    raise _refusal(mechanism, t, found, names, also, near_singular, remedy, what)


def _violated(
    mechanism: Mechanism, t: float, backend: str, system: OpenSystem | ClosedSystem | None = None
) -> Violation | None:
    """:func:`largest_violation` of the initial state, which is remembered to have none."""
    accepted = _accepted_times(mechanism)
    if t in accepted:
        return None
    found = largest_violation(mechanism, t, mechanism.q0, mechanism.v0, backend, system)
    if found is None:
        accepted.add(t)
    return found


def _refusal(
    mechanism: Mechanism,
    t: float,
    found: Violation,
    names: tuple[str, str],
    also: str = "",
    near_singular: bool = False,
    remedy: str = "",
    what: str = "the state",
) -> InputError:
    """The error about the violation ``found`` of ``what``, the start at ``t`` (s); ``also`` says
    more of it."""
    rows = mechanism.structure.row_names
    kind = "drives" if found.row >= len(rows) - len(mechanism.drives) else "closures"
    return InputError(
        f"{what} violates the {kind}: row {rows[found.row]} by {found.value:.1e}{also}",
        element=names[found.rate],
        remedy=remedy or _way_to_a_start(mechanism, t, names, near_singular),
    )


def _way_to_a_start(
    mechanism: Mechanism, t: float, names: tuple[str, str], near_singular: bool
) -> str:
    """The remedy for the start of a run at ``t`` (s) that is refused."""
    q, v = names
    at = f", {t!r}" if t else ""
    projected = f"srm.Simulator(mechanism).reset({q}, {v}{at}, project=True)"
    if near_singular:
        return (
            f"Start at another time of the motion, or on the branch of {v}: {projected} returns it"
        )
    if mechanism.drives and t:  # where drives lead to by then, assembly does not know
        return f"Use {projected}, which returns a consistent q and v"
    return "Use srm.assemble(mechanism, q=..., v=...) to get a consistent q and v"


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
            # The controller is not called again.
            return onto_closed_branch(make_system(mechanism), t, state)
    return state
