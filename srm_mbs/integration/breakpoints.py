r"""Breakpoints: times at which the right-hand side is not smooth.

Knots of tables, switches of drives, samples of a controller.  Between two of them, on a *smooth
interval*, the equations are smooth and every scheme keeps its order.  So a step ends on each
breakpoint.  Its last stages are evaluated with the forces just before, and the first stage after it
is evaluated again with those just after.  Multipliers are not extrapolated across, because they
jump with the forces.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.system import System
from srm_mbs.errors import EvaluationError, InputError
from srm_mbs.integration.methods.base import ErrorNorm, IntegratorState, Method
from srm_mbs.integration.methods.near_singular import LARGEST_ZONE_SIGMA, POSITION_ROUNDING
from srm_mbs.integration.singular_endpoints import NEAR_SINGULAR_SIGMA, singular_arrival, start

SMALLEST_DISTANCE = 2e-14
"""Distance of two breakpoints, over the length of the run, below which they are one: no step is
that short."""
ROUNDING_BESIDE = 8.0
"""Distance from a breakpoint, in units of rounding of t, of the nearest time on one side of it, so
that ``t < 0.3``, ``t <= 0.3`` and ``floor(t / 0.1)`` all mean the intended side."""
REPEATED_SEARCH_SIGMA = 0.5
"""sigma, over that of the last search for a singular configuration, at which it is repeated."""
FIRST_STAGE_ERROR = 0.1
"""Part of the tolerance that rounding in the first stage of a smooth interval may take."""

_UNBOUNDED, _MINUS_UNBOUNDED = np.array([np.inf]), np.array([-np.inf])
_NONE = np.zeros(0, dtype=bool)


@dataclass(frozen=True, eq=False)
class SmoothIntervals:
    """The smooth intervals of a run, n of them.

    Attributes
    ----------
    ends : (n,) s
        Their ends, the end of the run last.
    first, last : (n,) s
        The times at which the system is evaluated lie between these.
    given : (n - 1,) bool
        Which of the breakpoints between them were marked by the caller.
    """

    ends: FloatArray
    first: FloatArray
    last: FloatArray
    given: FloatArray

    @property
    def count(self) -> int:
        """Number of intervals."""
        return len(self.ends)

    @property
    def unbroken(self) -> bool:
        """Whether there are no breakpoints, at the ends of the run neither."""
        return self.first is _MINUS_UNBOUNDED and self.last is _UNBOUNDED


@lru_cache(maxsize=64)
def _single_interval(t_end: float) -> SmoothIntervals:
    return SmoothIntervals(np.array([t_end]), _MINUS_UNBOUNDED, _UNBOUNDED, _NONE)


def smooth_intervals(
    times: FloatArray, marked: FloatArray, t0: float, t_end: float
) -> SmoothIntervals:
    """The intervals into which ``times`` divide the run from ``t0`` to ``t_end`` (s).

    Parameters
    ----------
    times : (k,) s
        Breakpoints in any order; those outside the run are left out.
    marked : (j,) s
        Further ones, which :attr:`SmoothIntervals.given` marks; those at the ends of the run count
        as outside.
    """
    if not len(times) and not len(marked):
        return _single_interval(t_end)
    order = np.concatenate([marked, times])
    is_marked = np.arange(len(order)) < len(marked)
    by_time = np.argsort(order, kind="stable")
    order, is_marked = order[by_time], is_marked[by_time]
    rounding = float(np.spacing(max(abs(t0), abs(t_end))))
    near = max(SMALLEST_DISTANCE * (t_end - t0), ROUNDING_BESIDE * rounding)
    inside = (order >= t0 - near) & (order <= t_end + near)
    order, is_marked = order[inside], is_marked[inside]
    # Each cluster of times that no step fits between is one breakpoint, at its first time.
    new = np.diff(order, prepend=-np.inf) > near
    cluster = np.cumsum(new) - 1
    begin = order[new]
    final = order[np.append(new[1:], True)] if len(order) else order
    has_marked = np.zeros(len(begin), dtype=bool)
    np.logical_or.at(has_marked, cluster, is_marked)
    before = begin - ROUNDING_BESIDE * np.spacing(np.abs(begin))
    after = final + ROUNDING_BESIDE * np.spacing(np.abs(final))
    between = (begin > t0 + near) & (begin < t_end - near)
    at_start, at_end = after[begin <= t0 + near], before[begin >= t_end - near]
    return SmoothIntervals(
        ends=np.append(begin[between], t_end),
        first=np.concatenate([at_start[-1:] if len(at_start) else [-np.inf], after[between]]),
        last=np.concatenate([before[between], at_end[:1] if len(at_end) else [np.inf]]),
        given=has_marked[between],
    )


def direct_from(memory: IntegratorState, norm: ErrorNorm, span: float, nv: int) -> float:
    """sigma from which the first stage of an interval of length ``span`` (s) can be evaluated
    directly.

    Rounding in a direct solve grows like 1/sigma^2; over a short interval it is harmless.  At most,
    and without a tolerance (fixed steps), it is the sigma at which the zone ends.
    """
    if norm.negligible == 0.0:
        return LARGEST_ZONE_SIGMA
    error = np.zeros(2 * nv)
    rotation = 3.0 * memory.sigma_slope**2 * norm.one[:nv]
    error[nv:] = span * POSITION_ROUNDING * (np.abs(memory.rate[nv:]) + rotation)
    weighed = norm(error, norm.weights(memory.state_scale))
    return min(LARGEST_ZONE_SIGMA, float(np.sqrt(weighed / FIRST_STAGE_ERROR)))


class SingularProximity:
    """When the singular configuration next to the first stage of an interval is searched for.

    Attributes
    ----------
    looked
        Half the sigma of the last search; NEAR_SINGULAR_SIGMA far away.
    """

    def __init__(self) -> None:
        self.looked = NEAR_SINGULAR_SIGMA

    def matters(self, fresh: IntegratorState, norm: ErrorNorm, span: float, nv: int) -> bool:
        """Whether for ``fresh``, at the start of an interval of length ``span`` (s)."""
        if fresh.sigma >= NEAR_SINGULAR_SIGMA:
            self.looked = NEAR_SINGULAR_SIGMA
        if not fresh.sigma < self.looked or not fresh.sigma < direct_from(fresh, norm, span, nv):
            return False
        self.looked = REPEATED_SEARCH_SIGMA * fresh.sigma
        return True


def beside_singular(
    system: System,
    method: Method,
    t: float,
    state: FloatArray,
    norm: ErrorNorm,
    end: float,
    fresh: IntegratorState,
) -> IntegratorState:
    """``fresh``, of the first stage of an interval up to ``end``, made accurate next to a singular
    configuration; the parameters are those of
    :func:`~srm_mbs.integration.singular_endpoints.start`.

    Raises
    ------
    EvaluationError
        If the motion from there is not determined.
    """
    try:
        return start(system, method, t, state, norm, end, fresh)
    except InputError as error:
        # The remedy of the error is for those who can choose the state.
        raise EvaluationError(
            f"at the breakpoint {error.problem}; let drives and forces change beside it, at "
            "another time"
        ) from error


class BreakpointHandler:
    """The breakpoints of a run, and the ends beside a singular configuration; used by the drivers.

    Parameters
    ----------
    intervals, system, method, norm
        Of the run.
    evaluator
        Evaluates the stages at breakpoints and next to singular ends; ``system`` by default.

    Attributes
    ----------
    sample
        Called with (t, state) at the marked breakpoints, before anything is evaluated there.
    arrivals
        Whether :meth:`singular_arrival` can do anything.
    """

    def __init__(
        self,
        intervals: SmoothIntervals,
        system: System,
        method: Method,
        norm: ErrorNorm,
        evaluator: Any = None,
    ) -> None:
        self._intervals = intervals
        self._system = system
        self._method = method
        self._norm = norm
        self._evaluator: Any = system if evaluator is None else evaluator
        self.sample: Callable[[float, FloatArray], None] | None = None
        self.arrivals = system.branch_system is not None
        self._index = 0
        self._nearness = SingularProximity()
        self._evaluate_within(0)

    @property
    def end(self) -> float:
        """End of the current interval (s)."""
        return float(self._intervals.ends[self._index])

    def _evaluate_within(self, index: int) -> None:
        if self._intervals.unbroken:
            return  # the system may be evaluated at any time
        first, last = self._intervals.first[index], self._intervals.last[index]
        self._evaluator.between(float(first), float(last))

    def enter(self, index: int, t: float, state: FloatArray) -> None:
        """Enter the interval ``index``, which starts at ``t`` (s): the system is evaluated in it.

        Raises
        ------
        ControllerError
            If the sampled controller fails.
        """
        if self.sample is not None and self._intervals.given[index - 1]:
            self.sample(t, state)
        self._index = index
        self._evaluate_within(index)

    def follow(self, index: int) -> None:
        """Follow the kernel into the interval ``index``, if it entered that by itself."""
        if index != self._index:
            self._index = index
            self._evaluate_within(index)

    def next(
        self, t: float, state: FloatArray, memory: IntegratorState, evaluated: bool = True
    ) -> IntegratorState:
        """Enter the next interval; ``memory``, with its first stage if that is to be
        ``evaluated``.

        Raises
        ------
        ControllerError
            If the sampled controller fails.
        EvaluationError
            As :meth:`resolved`, or if the stage cannot be evaluated.
        """
        self.enter(self._index + 1, t, state)
        return self.past_jump(t, state, memory) if evaluated else memory

    def past_jump(self, t: float, state: FloatArray, memory: IntegratorState) -> IntegratorState:
        """``memory`` with the first stage after a jump of forces at ``t`` (s).

        Raises
        ------
        EvaluationError
            As :meth:`resolved`, or if the stage cannot be evaluated.
        """
        fresh = self._resumed(t, state, memory)
        if self._nearness.matters(fresh, self._norm, self.end - t, self._system.multiplier_size):
            return self._beside_singular(t, state, fresh)
        return fresh

    def resolved(self, t: float, state: FloatArray, memory: IntegratorState) -> IntegratorState:
        """``memory`` with the first stage of the current interval, at its start, made accurate
        next to a singular configuration.

        Raises
        ------
        EvaluationError
            If it cannot be evaluated, or the motion from there is not determined.
        """
        return self._beside_singular(t, state, self._resumed(t, state, memory))

    def _resumed(self, t: float, state: FloatArray, memory: IntegratorState) -> IntegratorState:
        self._evaluator.begin_step(t, state)
        return self._method.resume(self._evaluator, t, state, memory, self._norm)

    def _beside_singular(
        self, t: float, state: FloatArray, fresh: IntegratorState
    ) -> IntegratorState:
        return beside_singular(self._evaluator, self._method, t, state, self._norm, self.end, fresh)

    def singular_arrival(
        self, t: float, state: FloatArray, memory: IntegratorState, index: int | None = None
    ) -> IntegratorState:
        """``memory`` with the multipliers known up to the end of the interval, which lies beside a
        singular configuration; see
        :func:`~srm_mbs.integration.singular_endpoints.singular_arrival`.

        ``index``: of that interval, if the kernel entered it by itself.
        """
        if index is not None:
            self.follow(index)
        return singular_arrival(self._evaluator, t, state, memory, self._norm, self.end)

    def done(self) -> None:
        """The run is over: the system may be evaluated at any time."""
        if not self._intervals.unbroken:
            self._evaluator.between(-np.inf, np.inf)
