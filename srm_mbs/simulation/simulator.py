"""``Simulator``: a mechanism that is stepped from outside, for control loops and learning."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Mapping
from functools import wraps
from threading import Lock
from typing import Any, TypeVar, cast

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.controllers import HeldForce, forces_of_joints
from srm_mbs.dynamics.mechanism import Mechanism, check_mechanism
from srm_mbs.dynamics.multibody import make_system
from srm_mbs.errors import (
    ControllerError,
    EvaluationError,
    InputError,
    SimulationError,
    safe_repr,
    time_text,
)
from srm_mbs.integration.breakpoints import smooth_intervals
from srm_mbs.integration.generated.policy import charge, code_of_run
from srm_mbs.integration.kernel.backend import COMPILED, chosen_backend, code_is_compiled
from srm_mbs.integration.messages import FailureCause
from srm_mbs.integration.methods.base import Method
from srm_mbs.integration.methods.branch_nodes import onto_closed_branch
from srm_mbs.integration.methods.butcher import ButcherTableau
from srm_mbs.model.numbers import positive_number, real_array
from srm_mbs.model.validation import STATE_ARGUMENTS
from srm_mbs.simulation.consistency import closed_start
from srm_mbs.simulation.failure_causes import HeldForceWatch, failure_cause
from srm_mbs.simulation.incremental_run import IncrementalRun, KernelRun, ReferenceRun
from srm_mbs.simulation.options import (
    SINGULAR_TOLERANCE,
    RunOptions,
    check_embedded,
    finite,
)
from srm_mbs.simulation.result import Statistics
from srm_mbs.simulation.runner import (
    above_rounding,
    checked_accuracy,
    error_norm,
)

NEGLIGIBLE_DT = 8.0
"""Steps up to this many units of rounding of the time move nothing but the time."""
RESTART_GROWTH = 1e10
"""Where a step is longer than its predecessor by this factor, its inner steps begin as at a
start."""
WATCHED_FORCES = 8
"""Numbers of steps whose forces are examined where they may be unstable."""
MANY_STEPS = 100
"""Inner steps of one step, from which they are."""
CHARGED = 0.05
"""Time (s) within steps after which it is counted for the policy of generated code."""
BREAKPOINT_ROUNDING = 1e-14
"""Distance of a breakpoint from the end of a step that is rounding, over the time."""

Called = TypeVar("Called", bound=Callable[..., Any])


def _alone(called: Called) -> Called:
    """``called``, a method, refuses to run while such a method of the same simulator runs: its run
    is one memory, from which the kernel works without the interpreter's lock."""

    @wraps(called)
    def checked(self: Simulator, *args: Any, **kwargs: Any) -> Any:
        if not self._lock.acquire(blocking=False):
            raise InputError(
                "another thread uses this simulator, or a function that it calls does",
                element="simulator",
                remedy="Give each thread a clone() of its own",
            )
        try:
            return called(self, *args, **kwargs)
        finally:
            self._lock.release()

    return cast(Called, checked)


class Simulator:
    """A mechanism at a time, with a state, that :meth:`step` moves on.

    One compiled run is kept alive; nothing is recorded, so that memory does not grow.  Each step
    takes as many inner steps as the tolerance needs; singular configurations are passed as in
    :func:`srm_mbs.simulate`.  The same calls give the same numbers, bit by bit.  One thread at a
    time uses a simulator: a call during another one is refused; each thread may have a
    :meth:`clone`.

    Parameters
    ----------
    mechanism
        From :func:`srm_mbs.load`, or built from a ``pin.Model``.  It starts in its initial state.
    method, tableau, rtol, atol, max_step, placement, backend, singular_tolerance
        As for :func:`srm_mbs.simulate`.
    step
        Longest inner step (s) of fixed steps, instead of step-size control: each call is divided
        into equal ones.

    Raises
    ------
    InputError
        For invalid input.
    """

    def __init__(
        self,
        mechanism: Mechanism,
        *,
        method: str | Method = "psrm",
        tableau: str | ButcherTableau | None = None,
        rtol: float = 1e-6,
        atol: Any = None,
        step: float | None = None,
        max_step: float | None = None,
        placement: str = "automatic",
        backend: str = "auto",
        singular_tolerance: float = SINGULAR_TOLERANCE,
    ) -> None:
        given = locals()  # every other parameter is an option
        del given["self"], given["mechanism"]
        check_mechanism(mechanism)
        options = checked_accuracy(mechanism, RunOptions(math.inf, **given), 0.0, math.inf)
        options = above_rounding(mechanism, options)
        check_embedded(options.method.scheme, step)
        self._norm = error_norm(mechanism, options)
        state, _ = closed_start(mechanism, 0.0, self._norm)
        if state is not mechanism.start_state:
            nq = mechanism.model.nq
            mechanism = mechanism.with_state(state[:nq], state[nq:])
            self._norm = error_norm(mechanism, options)
        self._mechanism, self._options = mechanism, options
        by = chosen_backend(backend, options.method, options.placement, options.singular_times)
        self._backend, _ = code_of_run(by, backend, mechanism)
        metered = self._backend == "kernel" and backend == "auto" and code_is_compiled()
        self._charge_every = CHARGED if metered else math.inf
        self._no_force = np.zeros(mechanism.model.nv)
        # Start (s), length (s), number and end (s) of the last steps of equal length.
        self._equal_steps: tuple[float, float, int, float] = 0.0, math.nan, 0, 0.0
        self._make()
        self.reset()

    def _make(self) -> None:
        """A run of its own."""
        self._lock = Lock()
        held = HeldForce()
        held.only(self._no_force)
        self._system = make_system(self._mechanism, held)
        options = self._options._replace(backend=self._backend)
        kind: type[IncrementalRun] = KernelRun if self._backend in COMPILED else ReferenceRun
        self._run = kind(self._system, held, self._norm, options)
        self._nq = self._mechanism.model.nq
        self._smooth = not len(self._mechanism.breakpoints(-math.inf, math.inf))
        self._wall_time = 0.0
        self._charge_at = self._charge_every
        self._forces: deque[FloatArray] = deque(maxlen=WATCHED_FORCES)
        self._last_dt = math.inf
        self._busy = False
        # Where it starts, until the first step knows what acts.
        self._pending_start: tuple[float, FloatArray] | None = None

    @property
    def mechanism(self) -> Mechanism:
        """The simulated mechanism."""
        return self._mechanism

    @property
    def t(self) -> float:
        """Time (s)."""
        return self._run.t if self._pending_start is None else self._pending_start[0]

    @property
    def q(self) -> FloatArray:
        """Configuration (nq,), a copy."""
        return self._state()[: self._nq]

    @property
    def v(self) -> FloatArray:
        """Velocity (nv,), a copy."""
        return self._state()[self._nq :]

    def _state(self) -> FloatArray:
        return self._run.state if self._pending_start is None else self._pending_start[1].copy()

    @property
    def stats(self) -> Statistics:
        """Work done since it was made: inner steps, evaluations, seconds within :meth:`step`."""
        return self._run.statistics(self._wall_time)

    @_alone
    def step(self, dt: float, tau: Any = None) -> tuple[FloatArray, FloatArray]:
        """Move on by ``dt`` (s).

        Parameters
        ----------
        dt
            Positive; need not be the same every time.  Equal ones add up without rounding: k of
            them from t_0 end at t_0 + k dt.  One within rounding of ``t`` moves the time only.
        tau : (nv,) or {joint: force}
            Generalised forces held during the step, N and N m, beside those of the mechanism;
            none by default.  A mapping is that of a controller: joints that it does not name have
            none.

        Returns
        -------
        q (nq,), v (nv,)
            At the end; arrays of the caller's own.

        Raises
        ------
        InputError
            For a bad ``dt`` or ``tau``; before the first step after a :meth:`reset`, also if that
            was to a singular configuration from where the motion is not determined.
        SimulationError
            If the mechanism cannot move on, or if ``tau`` reverses and grows step by step, with
            rates beyond use: ``t``, ``q`` and ``v`` are then those of the last good inner step.
        """
        started = time.perf_counter()
        dt = positive_number(dt, "dt", " of seconds")
        force = self._no_force if tau is None else self._force(tau)
        run, t = self._run, self.t
        end = self._end_of_step(t, dt)
        if dt <= NEGLIGIBLE_DT * math.ulp(t):
            return self._move_time(t, end, dt)
        if dt > RESTART_GROWTH * self._last_dt:
            self._pending_start = t, self._state()
        self._last_dt = dt
        if self._pending_start is not None:
            if not np.isfinite(force).all():
                raise _bad_force(tau, len(self._no_force))
            self._begin(*self._pending_start, force, dt)
        self._forces.append(force)
        if self._busy:
            cause = self._watch().cause(dt)
            if cause is not None:
                raise _failed(t, cause)
        try:
            if self._smooth:
                run.go_on(end, -math.inf, math.inf, force, False, self._grid(dt))
                self._busy = run.last_steps >= MANY_STEPS
            else:
                self._piecewise(t, end, force)
        except ValueError as error:
            raise _bad_force(tau, len(self._no_force)) from error
        except SimulationError as error:
            cause = failure_cause(self._mechanism, self.t, self.q, self._watch())
            if cause is None:
                raise
            raise _failed(self.t, cause) from error
        finally:
            self._wall_time += time.perf_counter() - started
            if self._wall_time >= self._charge_at:
                self._charge()
        state = run.state
        return state[: self._nq], state[self._nq :]

    def _end_of_step(self, t: float, dt: float) -> float:
        """End (s) of a step ``dt`` (s) from ``t`` (s): k equal ones from t_0 end at t_0 + k dt, so
        that the rounding of times does not add up."""
        start, length, count, end = self._equal_steps
        if dt != length or t != end:
            start, count = t, 0
        count += 1
        end = start + count * dt
        self._equal_steps = start, dt, count, end
        return end

    def _move_time(self, t: float, end: float, dt: float) -> tuple[FloatArray, FloatArray]:
        """Go on from ``t`` to ``end`` (s) in the same state: a step ``dt`` (s) within rounding.

        Raises
        ------
        InputError
            If ``dt`` is below the rounding of ``t``.
        """
        if not end > t:
            raise InputError(
                f"dt = {safe_repr(dt)} s is below the rounding of t = {t!r} s",
                element="dt",
                remedy="Give a longer one, or reset to an earlier time",
            )
        self._pending_start = end, self._state()
        return self.q, self.v

    def _begin(self, t: float, state: FloatArray, force: FloatArray, dt: float) -> None:
        """Start the run from ``state`` at ``t`` (s), under ``force`` (nv,), for steps ``dt`` (s).

        Raises
        ------
        SimulationError
            If the first stage cannot be evaluated.
        """
        smooth_until = math.inf
        if not self._smooth:
            after = t + BREAKPOINT_ROUNDING * (abs(t) + dt)
            smooth_until = min(self._mechanism.breakpoints(after, math.inf), default=math.inf)
        try:
            self._run.begin(t, state, force, dt, smooth_until)
        except EvaluationError as error:
            raise SimulationError(f"Stopped at t = {time_text(t)} s: {error}.", None) from error
        self._pending_start = None

    def _charge(self) -> None:
        """Count the time of the last steps, for which code may be compiled for others."""
        charge(self._mechanism, self._wall_time - self._charge_at + self._charge_every)
        self._charge_at = self._wall_time + self._charge_every

    def _watch(self) -> HeldForceWatch:
        """The signs of an unstable controller in the forces of the last samples."""
        watch = HeldForceWatch(self._mechanism)
        v = self.v
        for force in self._forces:
            watch.add(force, v)
        return watch

    def _force(self, tau: Any) -> FloatArray:
        if isinstance(tau, Mapping):
            try:
                return forces_of_joints(tau, self._mechanism, self.t, "the force")
            except ControllerError as error:
                raise InputError(
                    str(error),
                    element="tau",
                    remedy="Give finite forces of joints by their names, N and N m",
                ) from error
        try:
            force = real_array(tau)  # the caller may change it afterwards
        except (TypeError, ValueError) as error:
            raise _bad_force(tau, len(self._no_force)) from error
        if force.shape != self._no_force.shape:
            raise _bad_force(tau, len(self._no_force))
        return force

    def _grid(self, length: float) -> float:
        """Length of fixed steps that divide ``length`` (s); 0 with step-size control."""
        step = self._options.step
        return 0.0 if step is None else length / math.ceil(length / step - 1e-9)

    def _piecewise(self, t: float, end: float, force: FloatArray) -> None:
        """Go on from ``t`` to ``end`` (s) across breakpoints."""
        # Breakpoints at the ends count, too: forces just before and just after them differ.
        beside = BREAKPOINT_ROUNDING * (abs(t) + end - t)
        kinks = np.array(self._mechanism.breakpoints(t - beside, end + beside), dtype=float)
        intervals = smooth_intervals(kinks, np.zeros(0), t, end)
        steps = 0
        for k, until in enumerate(intervals.ends.tolist()):
            first, last = float(intervals.first[k]), float(intervals.last[k])
            forces_jumped = k > 0 or first > -math.inf
            grid = self._grid(until - self._run.t)
            self._run.go_on(until, first, last, force, forces_jumped, grid)
            steps += self._run.last_steps
        self._busy = steps >= MANY_STEPS

    @_alone
    def reset(
        self, q: Any = None, v: Any = None, t: float = 0.0, *, project: bool = False
    ) -> tuple[FloatArray, FloatArray]:
        """Go to a state, as a new simulator would start there; the statistics go on.

        Parameters
        ----------
        q : (nq,), v : (nv,)
            By default the mechanism's own.
        t
            Time (s).
        project
            Move the state onto the closures (:meth:`set_state`) instead of refusing one that
            violates them.

        Returns
        -------
        q (nq,), v (nv,)

        Raises
        ------
        InputError
            If the state violates the closures, or has another shape, or ``t`` is no finite number.
        """
        mechanism = self._mechanism
        t = finite(t, "t")
        if q is None and v is None and not project:
            state = mechanism.start_state
            if mechanism.drives:
                state, _ = closed_start(mechanism, t, self._norm, names=STATE_ARGUMENTS)
        else:
            q = mechanism.q0 if q is None else q
            v = mechanism.v0 if v is None else v
            state = self._consistent(q, v, t, project)
        self._pending_start = t, state
        self._last_dt = math.inf
        self._equal_steps = t, math.nan, 0, t
        self._forces.clear()
        self._busy = False
        return self.q, self.v

    @_alone
    def set_state(self, q: Any = None, v: Any = None, *, project: bool = False) -> None:
        """Change the state at the current time.

        Parameters
        ----------
        q : (nq,), v : (nv,)
            By default as they are.  They must satisfy the closures as the start of
            :func:`srm_mbs.simulate` does: up to ten times the tolerance, they are moved onto them.
        project
            Move them onto the closures however far they are: q along the normals, v to the
            M-orthogonal projection v - P v, as after an inelastic impact.

        Raises
        ------
        InputError
            If the state violates the closures, has another shape, or cannot be projected.
        """
        q = self.q if q is None else q
        v = self.v if v is None else v
        self._pending_start = self.t, self._consistent(q, v, self.t, project)

    def _consistent(self, q: Any, v: Any, t: float, project: bool) -> FloatArray:
        if project:
            try:
                given = self._mechanism.moved(q, v).start_state
                state = onto_closed_branch(self._system, t, given)
            except EvaluationError as error:
                raise InputError(
                    f"the state cannot be projected: {error}",
                    element="q",
                    remedy="Use srm.assemble(mechanism, q=..., v=...)",
                ) from error
            q, v = state[: self._nq], state[self._nq :]
        moved = self._mechanism.moved(q, v)
        return closed_start(moved, t, self._norm, names=STATE_ARGUMENTS)[0]

    @_alone
    def clone(self) -> Simulator:
        """An independent copy, which continues identically; its statistics start at 0."""
        other = Simulator.__new__(Simulator)
        for name, value in vars(self).items():
            setattr(other, name, value)
        other._make()
        other._forces.extend(self._forces)
        other._last_dt, other._busy = self._last_dt, self._busy
        if self._pending_start is None:
            other._run.go_on_from(self._run)
        else:
            other._pending_start = self._pending_start[0], self._pending_start[1].copy()
        return other

    __copy__ = clone

    def __deepcopy__(self, memo: Any) -> Simulator:
        return self.clone()

    def __reduce__(self) -> Any:
        raise InputError(
            "a simulator cannot be sent to another process, or kept in a file",
            element="simulator",
            remedy="Give its mechanism and t, q and v instead, and reset a new one to them",
        )

    def __repr__(self) -> str:
        return f"Simulator({self._mechanism.name!r}, t={time_text(self.t)} s)"


def _failed(t: float, cause: FailureCause) -> SimulationError:
    """The error of a step that failed at ``t`` (s) by ``cause``."""
    return SimulationError(
        f"Stopped at t = {time_text(t)} s: {cause.clause}. {cause.remedy}.", None
    )


def _bad_force(tau: Any, size: int) -> InputError:
    return InputError(
        f"tau = {safe_repr(tau)} is not a vector of finite generalised forces",
        element="tau",
        remedy=f"Give {size} numbers or {{joint: force}}, N and N m",
    )
