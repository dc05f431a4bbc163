"""Results of runs: states, statistics, and quantities that are computed when they are read."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, Self, cast

import numpy as np
from numpy.typing import NDArray

from srm_mbs._kernel import core
from srm_mbs._typing import BoolArray, FloatArray
from srm_mbs.dynamics.constraints.reactions import Reactions
from srm_mbs.dynamics.controllers import HeldForce
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.dynamics.multibody import ClosedSystem, OpenSystem
from srm_mbs.dynamics.observables import Observables
from srm_mbs.dynamics.point_motion import (
    Place,
    PointMotion,
    place_of,
    point_accelerations,
    point_positions,
    point_velocities,
)
from srm_mbs.errors import InputError, KnownKeys, safe_repr, time_text
from srm_mbs.integration.dense_output import (
    DenseOutput,
    StepData,
    checked_output_times,
    close_to_singular,
    unwrapped_angles,
)
from srm_mbs.integration.driver import RunStatus
from srm_mbs.integration.events import Occurrence
from srm_mbs.integration.kernel import dense_output as kernel_steps
from srm_mbs.integration.kernel.backend import COMPILED
from srm_mbs.integration.kernel.dense_output import CompiledDenseOutput
from srm_mbs.integration.kernel.observables import CompiledObservables
from srm_mbs.integration.methods.base import ErrorNorm
from srm_mbs.integration.methods.butcher import ButcherTableau
from srm_mbs.integration.methods.psrm import is_split
from srm_mbs.integration.run_samples import RunSamples, run_samples
from srm_mbs.integration.singular_passages import (
    Bifurcation,
    Crossing,
    find_bifurcations,
    find_crossings,
)
from srm_mbs.model.anchors import Anchor
from srm_mbs.model.lazy import cached_property
from srm_mbs.simulation.consistency import closed_end, closed_states
from srm_mbs.simulation.energy_balance import EnergyBalance, Powers, energy_balance
from srm_mbs.simulation.options import RunOptions
from srm_mbs.simulation.streamed_output import StreamedOutput


@dataclass(frozen=True)
class Statistics:
    """Work done by a run.

    Attributes
    ----------
    steps, rejected
        Accepted steps, and steps rejected for their error.
    placements, replaced
        Steps shortened in advance, and redone, so that no stage lies on a singular point.
    zone_steps
        Accepted steps with a stage so close to a singular configuration that rows were dropped.
    evaluations
        Evaluations of the equations of motion, the initial step's included.
    factorisations
        Factorisations of the constraint algebra; 0 for an open chain.
    wall_time
        Seconds.
    """

    steps: int
    rejected: int
    placements: int
    replaced: int
    zone_steps: int
    evaluations: int
    factorisations: int
    wall_time: float


@dataclass(frozen=True)
class Settings:
    """How a run was made; kept for saving and for reports."""

    method: str
    tableau: str
    rtol: float
    atol: tuple[float, ...]
    step: float | None
    controlled: bool
    placement: str = "automatic"
    singular_times: tuple[float, ...] = ()
    backend: str = "python"
    singular_tolerance: float = 1e-9
    stiff: tuple[tuple[float, float], ...] = ()
    """Intervals (s) in which the problem was found to be stiff: the tableau ``auto`` has its scheme
    for stiff problems there, others are limited by their stability."""
    user_forces: bool = False
    """Whether there was a :class:`~srm_mbs.model.forces.UserForce` among the forces."""


ATTEMPT = np.dtype([("t", float), ("h", float), ("error_ratio", float), ("verdict", "U8")])
"""A step that was not accepted: its start and length (s), its error estimate over the tolerance,
and whether it was ``"rejected"`` for its error or ``"replaced"`` because of a singular
configuration."""


def attempt_array(attempts: Iterable[Any]) -> NDArray[np.void]:
    """The ``attempts`` of a run as a structured array (k,) of :data:`ATTEMPT`."""
    rows = [(a.t, a.h, a.error_ratio, a.decision.value) for a in attempts]
    return np.array(rows, dtype=ATTEMPT)


class RunOutcome:
    """Steps, status and statistics, which results of mechanisms and of DAEs have in common.

    Attributes
    ----------
    steps
        The accepted steps.
    attempts
        The rejected and redone ones: a structured array of :data:`ATTEMPT`.
    status, message
        ``finished``, ``event`` (a terminal event), ``failed`` or ``interrupted``; when and why.
    error
        The exception that ended a failed run, with its traceback and, as its ``__cause__``, what a
        function of the user raised; None without one, and for a loaded run.
    stats, settings
        :class:`Statistics` and :class:`Settings`.
    """

    steps: StepData
    attempts: NDArray[np.void]
    status: RunStatus
    message: str
    error: BaseException | None = None
    stats: Statistics
    settings: Settings

    @property
    def success(self) -> bool:
        """Whether the end, or a terminal event, was reached."""
        return self.status in (RunStatus.FINISHED, RunStatus.EVENT)

    @property
    def span(self) -> tuple[float, float]:
        """Start and end (s) of the run, whatever ``t`` holds."""
        return float(self.steps.times[0]), self.steps.end

    @property
    def rejected(self) -> FloatArray:
        """Start and length (k, 2) s of the steps rejected for their error."""
        return self._attempted("rejected")

    @property
    def replaced(self) -> FloatArray:
        """Start and length (k, 2) s of the steps redone because of a singular configuration."""
        return self._attempted("replaced")

    def _attempted(self, verdict: str) -> FloatArray:
        chosen = self.attempts[self.attempts["verdict"] == verdict]
        return np.column_stack([chosen["t"], chosen["h"]])


class RunData(Protocol):
    """The data of a run of a mechanism, computed when they are first read.

    Attributes
    ----------
    steps, dense
        The accepted steps and their dense output; None of a run with output times that did not
        keep them.
    span
        Start and end (s) of the steps that the run keeps.
    nodes
        Times (n + 1,) s and states (n + 1, nx) at the ends of the steps, as
        :meth:`~srm_mbs.integration.dense_output.DenseOutput.nodes`, of a run that has them.
    output, again
        Of such a run, its output, and a function that makes it again; None otherwise, and if it
        cannot be made again.
    backend, controlled
        What made the run, and whether functions of the user acted, as in its settings.
    bifurcations
        As in :class:`SimulationResult`; None where they have not been looked for.
    attempts, message, stats, settings
        As in :class:`SimulationResult`.
    """

    @property
    def steps(self) -> StepData | None: ...
    @property
    def dense(self) -> DenseOutput | None: ...
    @property
    def span(self) -> tuple[float, float]: ...
    @property
    def nodes(self) -> tuple[FloatArray, FloatArray]: ...
    @property
    def output(self) -> StreamedOutput | None: ...
    @property
    def again(self) -> Callable[[], SimulationResult] | None: ...
    @property
    def bifurcations(self) -> tuple[Bifurcation, ...] | None: ...
    @property
    def attempts(self) -> NDArray[np.void]: ...
    @property
    def message(self) -> str: ...
    @property
    def stats(self) -> Statistics: ...
    @property
    def settings(self) -> Settings: ...
    @property
    def backend(self) -> str: ...
    @property
    def controlled(self) -> bool: ...


@dataclass(frozen=True, eq=False)
class KnownRunData:
    """:class:`RunData` that have been computed: of runs from files and other processes."""

    steps: StepData | None
    dense: DenseOutput | None
    attempts: NDArray[np.void]
    message: str
    stats: Statistics
    settings: Settings
    output: StreamedOutput | None = None
    again: Callable[[], SimulationResult] | None = None
    bifurcations: tuple[Bifurcation, ...] | None = None

    @property
    def span(self) -> tuple[float, float]:
        steps = cast(StepData, self.steps)
        return float(steps.times[0]), steps.end

    @property
    def nodes(self) -> tuple[FloatArray, FloatArray]:
        return cast(DenseOutput, self.dense).nodes()

    @property
    def backend(self) -> str:
        return self.settings.backend

    @property
    def controlled(self) -> bool:
        return self.settings.controlled


class SimulationResult(RunOutcome):
    """Result of a run of a mechanism; :class:`srm_mbs.Solution` adds pictures and files.

    Attributes
    ----------
    mechanism
        What was simulated.
    t : (n,) s
        ``t_eval``, or the ends of the accepted steps, the start first and a terminal event last.
    q : (n, nq), v : (n, nv)
        Configurations and velocities there.
    status, message
        ``finished``, ``event``, ``failed`` or ``interrupted``; when and why.
    stats
        :class:`Statistics`.
    settings
        :class:`Settings`.
    attempts : (k,)
        The rejected and redone steps, a structured array of :data:`ATTEMPT`.
    t_events, q_events, v_events
        For each event in turn its times (k,) s, and the states (k, nq), (k, nv) there; None if
        no events were given.
    request
        :class:`~srm_mbs.simulation.options.RunOptions`: what else it takes to make the run again;
        None if the file that it is from does not say.
    """

    request: RunOptions | None = None

    def __init__(
        self,
        mechanism: Mechanism,
        system: OpenSystem | ClosedSystem,
        scheme: ButcherTableau,
        run: RunData,
        *,
        t_eval: FloatArray | None,
        events: tuple[list[FloatArray], list[FloatArray]] | None = None,
        status: str,
    ) -> None:
        self.mechanism = mechanism
        self._run = run
        self.scheme = scheme
        self.status = status if type(status) is RunStatus else RunStatus(status)
        self._system = system
        self.t_eval = t_eval
        if t_eval is not None:
            _ = self._computed_nodes  # what cannot be evaluated is an error here
        self._events = events

    @cached_property
    def attempts(self) -> NDArray[np.void]:  # type: ignore[override]
        return self._run.attempts

    @cached_property
    def message(self) -> str:  # type: ignore[override]
        return self._run.message

    @cached_property
    def stats(self) -> Statistics:  # type: ignore[override]
        return self._run.stats

    @cached_property
    def settings(self) -> Settings:  # type: ignore[override]
        return self._run.settings

    @property
    def backend(self) -> str:
        """Backend of the run: ``settings.backend``, without the rest of the settings."""
        return self._run.backend

    @cached_property
    def _nodes(self) -> tuple[FloatArray, FloatArray]:
        """Times (n,) s, and states (n, nx) there; that at the end of the run is on the closures, as
        the other ends of steps are but for sweeps."""
        t, states = self._computed_nodes
        mechanism = self.mechanism
        ended = self.status is not RunStatus.FAILED and len(t) and t[-1] == self.span[1]
        if not (ended and mechanism.constrained and self.is_split):
            return t, states
        end = states[-1]
        last = closed_end(mechanism, float(t[-1]), end, self.backend, self._system)
        if last is not end:
            states = states.copy()
            states[-1] = last
            states.setflags(write=False)
        return t, states

    @property
    def is_split(self) -> bool:
        """Whether the split PSRM made the run; False where that is not known."""
        request = self.request
        method = None if request is None else request.method
        return method == "psrm" if method is None or isinstance(method, str) else is_split(method)

    @cached_property
    def _computed_nodes(self) -> tuple[FloatArray, FloatArray]:
        """Times (n,) s, and states (n, nx) there, as the steps have them."""
        output = self._run.output
        if output is not None:
            return output.t, output.states
        if self.t_eval is not None:
            t = self.t_eval[self.t_eval <= self.steps.end]
            return t, self._dense(t)
        t, states = self._whole.nodes
        # q and v are views: writing to them would change the dense output.
        states.setflags(write=False)
        t.setflags(write=False)
        return t, states

    @cached_property
    def t(self) -> FloatArray:
        return self._nodes[0]

    @cached_property
    def q(self) -> FloatArray:
        return self._nodes[1][:, : self.mechanism.model.nq]

    @cached_property
    def v(self) -> FloatArray:
        return self._nodes[1][:, self.mechanism.model.nq :]

    @property
    def last_state(self) -> FloatArray:
        """q and v (nq + nv,) in the last row, as the steps have them."""
        last: FloatArray = self._computed_nodes[1][-1]
        return last

    @property
    def t_events(self) -> list[FloatArray] | None:
        """Times (k,) s of each event; None if no events were given."""
        return None if self._events is None else self._events[0]

    @property
    def q_events(self) -> list[FloatArray] | None:
        """Configurations (k, nq) at these times."""
        return self._columns_of_events(slice(None, self.mechanism.model.nq))

    @property
    def v_events(self) -> list[FloatArray] | None:
        """Velocities (k, nv) at these times."""
        return self._columns_of_events(slice(self.mechanism.model.nq, None))

    def _columns_of_events(self, columns: slice) -> list[FloatArray] | None:
        return None if self._events is None else [x[:, columns] for x in self._events[1]]

    def add_occurrences(self, occurrences: Sequence[Occurrence]) -> None:
        """Add ``occurrences`` of events at the start or the end of the run."""
        if self._events is None:
            return
        times, states = map(list, self._events)
        for found in occurrences:
            i = found.event
            times[i] = np.append(times[i], found.time)
            order = np.argsort(times[i], kind="stable")
            times[i] = times[i][order]
            states[i] = np.concatenate([states[i], found.state[None]])[order]
        self._events = times, states

    @property
    def steps(self) -> StepData:  # type: ignore[override]
        """The accepted steps.

        A run with output times keeps them up to 8 MB; of a longer one it is made again here, once.

        Raises
        ------
        InputError
            If that run called Python functions, which are not called again.
        """
        return self._whole.steps  # type: ignore[return-value]

    @property
    def _dense(self) -> DenseOutput:
        return self._whole.dense  # type: ignore[return-value]

    @cached_property
    def _whole(self) -> RunData:
        """The run with its steps, made again if it did not keep them."""
        run = self._run
        if run.output is None:
            return run
        if run.again is None:
            raise InputError(
                f"the run has output times and {self.stats.steps} steps, which are more than it "
                "keeps, and called Python functions, so that it is not made again",
                element="t_eval",
                remedy="Run it without t_eval, and read solution.at(times)",
            )
        return run.again()._run

    @cached_property
    def span(self) -> tuple[float, float]:
        """Start and end (s) of the run, whatever ``t`` holds."""
        output = self._run.output
        return self._run.span if output is None else output.span

    @property
    def held(self) -> HeldForce | None:
        """Forces that a sampled controller held; None without one."""
        return self._system.held

    @property
    def system(self) -> OpenSystem | ClosedSystem:
        """The equations of motion of the run."""
        return self._system

    @property
    def _by_kernel(self) -> bool:
        """Whether the kernel made the run and is there."""
        return self.backend in COMPILED and core is not None

    @cached_property
    def observables(self) -> Observables:
        """Quantities at many states of the mechanism, by the backend of the run."""
        return (CompiledObservables if self._by_kernel else Observables)(self._system)

    @property
    def steps_to_save(self) -> StepData:
        """The steps; complete where functions of the user, which are not saved, would be needed to
        read between them."""
        system = self._system
        called = system.has_user_forces or (system.controlled and self.held is None)
        return self._dense.complete() if called else self.steps

    def __call__(self, t: Any) -> tuple[FloatArray, FloatArray]:
        """Dense output: q and v at time ``t`` (s), a scalar or an array of any order.

        Returns shapes (nq,), (nv,) for a scalar, (k, nq), (k, nv) for an array.

        Raises
        ------
        InputError
            If a time lies outside the run, or t has more than one dimension.
        """
        times = checked_output_times(t, scalar=True)
        states = self._dense(times.reshape(-1))
        nq = self._system.nq
        q, v = states[:, :nq], states[:, nq:]
        return (q[0], v[0]) if times.ndim == 0 else (q, v)

    def at(self, t: Any) -> Self:
        """The same run read at other times: q, v, drift, energy, reactions, joints.

        Parameters
        ----------
        t : (k,) s
            Times within the run, in any order.

        Raises
        ------
        InputError
            If a time lies outside the run, or ``t`` has not one dimension.
        """
        times = checked_output_times(t)
        self._dense.check(times)
        run = type(self)(
            self.mechanism,
            self._system,
            self.scheme,
            self._whole,
            t_eval=np.clip(times, self.steps.times[0], self.steps.end),
            events=self._events,
            status=self.status,
        )
        run.request, run.error = self.request, self.error
        run.observables = self.observables  # and their workspace
        return run

    def states(self, t: FloatArray, allowed: FloatArray | None = None) -> FloatArray:
        """States (k, nq + nv) at the times ``t`` (k,) s; with ``allowed`` (2 nv,) those of
        ascending times to within that only: most then need no evaluation."""
        dense = self._dense
        return dense(t) if allowed is None else dense.between_ends(t, allowed)

    def samples(self) -> RunSamples:
        """Samples that show the accuracy of a run of one segment, whatever ``t`` holds."""
        dense, unit = self._dense, self.mechanism.structure.units.state
        found = dense.samples(unit) if isinstance(dense, CompiledDenseOutput) else None
        return found or run_samples(self.scheme, self.steps, dense, unit)

    def unwrapped(self, name: str, t: FloatArray, states: FloatArray) -> FloatArray:
        """Angle (k,) rad of a joint that is stored as cosine and sine, with the ``states``
        (k, nq + nv) at the times ``t`` (k,) s."""
        joint, nq = self.mechanism.joint(name), self.mechanism.model.nq
        return unwrapped_angles(joint, nq, self.steps, self.scheme, t, states)

    @property
    def segments(self) -> tuple[SimulationResult, ...]:
        """The smooth parts of the run: itself, unless events acted on it."""
        return (self,)

    def joint(self, name: str) -> tuple[FloatArray, FloatArray]:
        """Position and rate (n,), (n,) of a one-degree joint at ``t``; angles are unwrapped.

        Raises
        ------
        InputError
            If there is no such joint, or it has more than one degree of freedom.
        """
        joint = self.mechanism.joint(name)
        if joint.nv != 1:
            raise InputError(
                f"joint {safe_repr(name)} has {joint.nv} degrees of freedom",
                remedy=f"Use solution.v[:, {joint.idx_v}:{joint.idx_v + joint.nv}]",
            )
        rate = self.v[:, joint.idx_v]
        if joint.nq == 1:
            return self.q[:, joint.idx_q], rate
        if self._run.output is not None:
            return self._run.output.angles[self.mechanism.model.getJointId(name)], rate
        return self.unwrapped(name, self.t, np.hstack([self.q, self.v])), rate

    @cached_property
    def crossings(self) -> tuple[Crossing, ...]:
        """Passages through singular configurations, in order of time."""
        system, scheme = self._system, self.scheme
        searches: tuple[Any, ...] = ()
        if self._by_kernel:
            compiled = kernel_steps.recorded_turns, kernel_steps.critical_near
            searches = kernel_steps.recorded_dips, *compiled
            tolerance = self.settings.singular_tolerance
            found = kernel_steps.dips_in_records(system, scheme, self._dense, tolerance)
            if found == ():
                return ()
            if found is not None:
                searches = (lambda *_: found), *compiled

        def monitored() -> tuple[DenseOutput, float]:
            return self._dense, self.settings.singular_tolerance

        return find_crossings(system, scheme, self.steps, monitored, *searches)

    @cached_property
    def bifurcations(self) -> tuple[Bifurcation, ...]:
        """Singular configurations that the run reached without the momentum to choose a branch."""
        known = self._run.bifurcations
        if known is not None:
            return known
        failed = self.status is RunStatus.FAILED
        return find_bifurcations(self._system, self.steps, lambda: self._dense, failed)

    @cached_property
    def drift(self) -> FloatArray:
        """Closure errors (n, 2): ||g - s|| (m, rad) and ||G v - s'|| (m/s, rad/s), s the motion of
        the drives; all rows, unscaled."""
        g, c = self.observables.closure_errors(self.t, self.q, self.v)
        return np.column_stack([np.linalg.norm(g, axis=1), np.linalg.norm(c, axis=1)])

    @property
    def energies(self) -> FloatArray:
        """Kinetic and potential energy (n, 2) J."""
        return self.observables.energies(self.q, self.v)

    @cached_property
    def energy(self) -> FloatArray:
        """Kinetic plus potential energy (n,) J: gravity, springs and bushings.

        Constant torques and wrenches have no potential here.
        """
        energy: FloatArray = self.energies.sum(axis=1)
        return energy

    @cached_property
    def accelerations(self) -> FloatArray:
        """v' (n, nv) of the equations of motion at ``t``, controller included.

        Raises
        ------
        InputError
            For a loaded run that had a controller.
        """
        self._need_controller("acceleration")
        return self.observables.accelerations(self.t, self.q, self.v)

    def closed_motion(self, consistent: float) -> tuple[FloatArray, FloatArray]:
        """The motion at ``t`` on the closures and drives: (q, v, v') (n, nq + 2 nv), and how far
        each state was moved (n,) for it, over the tolerance of the run.

        See :func:`~srm_mbs.simulation.consistency.closed_states` for ``consistent`` and errors.
        """
        states = np.concatenate((self.q, self.v), axis=1)
        accelerations, sizes = self.accelerations, np.zeros(len(states))
        if self.mechanism.constrained:
            norm = ErrorNorm(np.array(self.settings.atol), self.settings.rtol)
            states, sizes = closed_states(
                self.mechanism, self.t, states, norm, self.backend, self._system, consistent
            )
        if sizes.any():
            q, v = np.split(states, [self.mechanism.model.nq], axis=1)
            accelerations = self.observables.accelerations(self.t, q, v)
        return np.concatenate((states, accelerations), axis=1), sizes

    def point(self, point: Anchor | str) -> PointMotion:
        """Motion of a point of a link at ``t``: position, velocity and acceleration (n, 3), world
        axes.

        Parameters
        ----------
        point
            For example ``srm.Anchor("rod", xyz=(1.0, 0.0, 0.0))``, or the name of a point that the
            mechanism has.

        Raises
        ------
        InputError
            If there is no such point, link or frame; when the acceleration is read, for a loaded
            run that had a controller.
        """
        return self.motion_of(place_of(self.mechanism, point))

    def motion_of(self, place: Place) -> PointMotion:
        """As :meth:`point`, for a joint and a placement in it."""
        model = self.mechanism.model
        readers: dict[str, Callable[[], FloatArray]] = {
            "position": lambda: point_positions(model, place, self.q),
            "velocity": lambda: point_velocities(model, place, self.q, self.v),
            "acceleration": lambda: point_accelerations(
                model, place, self.q, self.v, self.accelerations
            ),
        }
        return PointMotion(lambda which: readers[which]())

    @property
    def steps_with_stages(self) -> BoolArray:
        """Which steps (n,) have stages that lie on the motion, to their order
        (:meth:`~srm_mbs.integration.dense_output.StepData.with_stages`)."""
        close = kernel_steps.close_to_singular if self._by_kernel else close_to_singular
        return self.steps.with_stages(self.scheme, close)

    def element_works(self, t: FloatArray) -> Powers | None:
        """Work (n,) J of each force element, but that of its potential, up to the times ``t`` (n,)
        s, by the scheme of the run at its own stages; None where it has to be integrated step by
        step."""
        dense, observables = self._dense, self.observables
        if isinstance(dense, CompiledDenseOutput) and isinstance(observables, CompiledObservables):
            return dense.element_works(observables, t)
        return None

    @cached_property
    def energy_balance(self) -> EnergyBalance:
        """Energies and the works of everything that acts; see
        :class:`srm_mbs.simulation.energy_balance.EnergyBalance`.

        Raises
        ------
        InputError
            For a loaded run that had a controller or a ``UserForce``.
        """
        return self.balance_at(self.t, self.energies)

    def balance_at(self, t: FloatArray, energies: FloatArray) -> EnergyBalance:
        """As :attr:`energy_balance` at the times ``t`` (n,) s, ascending, with the energies (n, 2)
        there."""
        self._need_controller("energy balance")
        return energy_balance(self, self._system, t, energies)

    def _need_controller(self, what: str) -> None:
        system = self._system
        if not self._run.controlled or system.has_user_forces:
            return
        # What a sampled controller held is saved, which the system has in its place.
        of_forces = self.settings.user_forces
        if of_forces or not system.controlled:
            lost = "UserForce" if of_forces else "controller"
            raise InputError(
                f"the {what} of a loaded run with a {lost} cannot be computed: "
                f"{'their functions' if of_forces else 'controllers'} are not saved",
                remedy="Read that before the run is saved, or simulate again",
            )

    @cached_property
    def _reactions(self) -> Reactions:
        self._need_controller("reactions")
        return self.observables.reactions(self.t, self.q, self.v)

    @property
    def reactions(self) -> Mapping[str, FloatArray]:
        """Per loop (n, 6): force (N) then moment (N m) that a exerts on b, at b's origin, world
        axes.  Where redundancy makes them non-unique: the values of least norm."""
        return self._reactions.closures

    @property
    def reaction_multipliers(self) -> Mapping[str, FloatArray]:
        """Per loop (n, rows): the multipliers lam of M v' = f - G^T lam, rows unscaled."""
        return self._reactions.multipliers

    @property
    def joint_reactions(self) -> Mapping[str, FloatArray]:
        """Per joint of the tree (n, 6): force (N) then moment (N m) that the parent link exerts on
        the child, at the origin of the joint, world axes.

        What acts on the coordinates of a joint is part of it: controller, drive, springs, damping,
        friction.  A rotor (armature) is no part of the child.  Components of
        :attr:`indeterminate_joint_reactions` follow from reactions of least norm.
        """
        return self._reactions.joints

    @property
    def drive_forces(self) -> Mapping[str, FloatArray]:
        """Per drive (n,): the force (N) or torque (N m) that it exerts on its coordinate, in the
        positive sense, and the opposite one on what carries it: what an actuator has to give.
        Where drives and closures are redundant: the values of least norm."""
        return self._reactions.drives

    @cached_property
    def drive_rates(self) -> Mapping[str, FloatArray]:
        """Per drive (n,): the prescribed rate s'(t) (rad/s, m/s); times the force its power."""
        curves = self.mechanism.drive_curves
        return KnownKeys({name: curve.at(self.t)[1] for name, curve in curves.items()})

    @property
    def coupling_forces(self) -> Mapping[str, FloatArray]:
        """Per coupling (n, joints): generalised forces on its joints, in their order, N m or N."""
        out = KnownKeys[FloatArray]()
        for loop in self.mechanism.loops:
            for row, lam in zip(loop.rows.joint_rows, self.reaction_multipliers[loop.name].T):
                positions = np.column_stack([self.joint(name)[0] for name in row.joints])
                out[loop.name] = -lam[:, None] * row.gradient(positions)
        return out

    @property
    def indeterminate_reactions(self) -> tuple[str, ...]:
        """Closure rows, ``loop.row``, whose reactions equilibrium alone does not determine.

        For these :attr:`reactions`, :attr:`reaction_multipliers` and :attr:`coupling_forces` hold
        the values of least norm (docs/closures.md); all others are unique.
        """
        return self.mechanism.mobility.indeterminate_rows

    @property
    def indeterminate_joint_reactions(self) -> tuple[str, ...]:
        """Components of :attr:`joint_reactions` that equilibrium alone does not determine.

        ``joint.fx`` to ``joint.mz``: force and moment along the axes of the world.  They follow
        from the values of least norm of the closures; all others are unique.
        """
        return self.mechanism.mobility.indeterminate_joints

    def __repr__(self) -> str:
        first, last = (self.t[0], self.t[-1]) if len(self.t) else (0.0, 0.0)
        return (
            f"Solution({self.mechanism.name!r}, t={time_text(first)}..{time_text(last)} s, "
            f"{len(self.t)} points, {self.stats.steps} steps, {self.status}, "
            f"{self.settings.backend})"
        )


def check_run(solution: Any) -> None:
    """Refuse what is not the run of a mechanism.

    Raises
    ------
    InputError
        If it is anything else.
    """
    if not isinstance(solution, SimulationResult):
        raise InputError(
            f"a {type(solution).__name__} is not a run",
            element="solution",
            remedy="Give what srm.simulate or srm.load_solution returned",
        )
