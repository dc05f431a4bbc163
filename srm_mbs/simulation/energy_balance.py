r"""Energy balance of a run: the energy gained is the work of controller, damping, forces, drives.

    K + V - (K + V)(t_0) = sum of the works W_i,   W_i' = tau_i . v,

with the works of the controller, of joint damping and friction, of each force element (of springs
and bushings the damping only: their potential is part of V), and of each drive.  Closures, which do
not depend on time, do no work.  Each power is integrated step by step: where dampers do all the
work, by the scheme of the run at its own stages,

    W_{n+1} = W_n + h sum_i b_i P(x_i),

as if W were a part of the state, so that the residual is that of the run; else, and where a step
has no such stages, by Gauss quadrature on the dense output.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, Self

import numpy as np

from srm_mbs._typing import BoolArray, FloatArray, IndexArray
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.dynamics.multibody import ClosedSystem, OpenSystem
from srm_mbs.dynamics.observables import LINEAR, Observables, working_elements
from srm_mbs.errors import KnownKeys
from srm_mbs.integration.dense_output import StepData
from srm_mbs.integration.methods.butcher import ButcherTableau
from srm_mbs.model.lazy import cached_property
from srm_mbs.model.mechanism import per_model

NODES = 8
"""Gauss points per step: exact to degree 15, twice the degree of the dense output and one.  Fewer
would err by tolerances in steps across the onset of a limit spring."""

SMOOTH_NODES = 6
"""Gauss points per step where every power is a smooth function of the state, that of dampers: the
error is then below a hundredth of the residual of a run with rtol up to 1e-4."""

GAUSS = {count: np.polynomial.legendre.leggauss(count) for count in (NODES, SMOOTH_NODES)}
"""Points on [-1, 1] and weights, by their number."""

RELATIVE_ROUNDING = 1e-13
"""Bound of the rounding error of a sum of energies, relative to its terms."""

Powers = dict[str, FloatArray]
"""Power (n,) W of each thing that does work, by name."""


@dataclass(frozen=True, eq=False)
class EnergyBalance:
    """Energies and works over a run.

    Attributes
    ----------
    t : (n,) s
        The times of the solution.
    kinetic, potential : (n,) J
        Of the bodies; of gravity, springs and bushings.
    works : {name: (n,) J}
        Work done on the mechanism since the start of the run, by what does it: ``controller``,
        ``joint damping``, ``joint friction``, ``force NAME``, ``drive NAME``; and ``events``, what
        their actions changed at once.
    start
        Energy (J) at the start of the run.
    rounding
        Residual (J) that rounding alone may leave: a small part of the energies, and of the weight
        times the scene diagonal.
    """

    t: FloatArray
    kinetic: FloatArray
    potential: FloatArray
    works: Mapping[str, FloatArray]
    start: float
    rounding: float

    @cached_property
    def residual(self) -> FloatArray:
        """Energy gained minus all works (n,) J: the error of the run, and of this balance."""
        residual: FloatArray = self.kinetic + self.potential - self.start
        for done in self.works.values():
            residual -= done
        return residual

    @cached_property
    def largest_residual(self) -> float:
        """Largest absolute value of the residual (J)."""
        return _largest(self.residual)

    @cached_property
    def scale(self) -> float:
        """The energy (J) that took part: the largest of kinetic energy, change of potential energy
        and each work."""
        sizes = [self.kinetic, self.potential - self.potential[:1], *self.works.values()]
        return _largest(np.array(sizes))

    @property
    def relative(self) -> float:
        """Largest residual over the scale; 0 where nothing moved but for rounding."""
        return self.largest_residual / self.scale if self.scale > self.rounding else 0.0

    def __repr__(self) -> str:
        return (
            f"EnergyBalance({len(self.t)} times, residual at most {self.largest_residual:.2g} J "
            f"of {self.scale:.3g} J, works={list(self.works)})"
        )


_System = OpenSystem | ClosedSystem


class BalancedRun(Protocol):
    """The part of a :class:`~srm_mbs.simulation.result.SimulationResult` that a balance reads."""

    mechanism: Mechanism
    scheme: ButcherTableau

    @property
    def t(self) -> FloatArray:
        """Times (n,) s."""

    @property
    def q(self) -> FloatArray:
        """Configurations (n, nq)."""

    @property
    def v(self) -> FloatArray:
        """Velocities (n, nv)."""

    @property
    def span(self) -> tuple[float, float]:
        """Start and end (s) of the run."""

    @property
    def steps(self) -> StepData:
        """The accepted steps."""

    @property
    def steps_with_stages(self) -> BoolArray:
        """Which steps (n,) have stages that lie on the motion."""

    @property
    def observables(self) -> Observables:
        """Quantities at many states of the mechanism."""

    @property
    def energies(self) -> FloatArray:
        """Kinetic and potential energy (n, 2) J."""

    @property
    def energy_balance(self) -> EnergyBalance:
        """The balance at ``t``."""

    def element_works(self, t: FloatArray) -> Powers | None:
        """Works (n,) J up to ``t`` (n,) s by the stages of the run, of the kernel."""

    @property
    def drive_rates(self) -> Mapping[str, FloatArray]:
        """Prescribed rate of each drive (n,), m/s or rad/s."""

    def at(self, t: Any) -> Self:
        """The run at other times."""


class Nodes:
    """The nodes of the quadrature, in the intervals between ``ends`` (n + 1,) s, and the run there:
    those at stages of the run, and after them those that dense output is read at.

    They are looked for only where something does work, and read only where the power needs it.
    """

    def __init__(self, solution: BalancedRun, system: _System, ends: FloatArray) -> None:
        self._run, self._ends, self._lengths = solution, ends, ends[1:] - ends[:-1]
        self._smooth = _is_smooth(system)
        self.observables = solution.observables
        self._scheme = solution.scheme.member(False)
        self._stages = np.flatnonzero(self._scheme.b)

    @cached_property
    def _steps(self) -> IndexArray:
        """Of each interval (n,) the step whose stages are its nodes; -1 where it is read."""
        ends, steps = self._ends, self._run.steps
        out = np.full(len(ends) - 1, -1)
        if not (self._smooth and len(self._scheme.dense.extra_c) and steps.count):
            return out
        with_stages = self._run.steps_with_stages
        if np.array_equal(ends, steps.times):  # all intervals are steps
            return np.where(with_stages, np.arange(steps.count), out)
        step = np.clip(np.searchsorted(steps.times, ends[:-1]), 0, steps.count - 1)
        whole = (steps.times[step] == ends[:-1]) & (steps.times[step + 1] == ends[1:])
        return np.where(whole & with_stages[step], step, out)

    @cached_property
    def _started(self) -> IndexArray:
        """The steps (k,) whose stages are nodes."""
        return self._steps[self._steps >= 0]

    @cached_property
    def _read_at(self) -> FloatArray:
        """Times (k,) s that are read."""
        read, (points, _) = self._steps < 0, self._gauss
        if not np.logical_or.reduce(read):
            return np.zeros(0)
        starts, lengths = self._ends[:-1][read], self._lengths[read]
        return (starts[:, None] + np.outer(lengths, 0.5 * (points + 1.0))).ravel()

    @property
    def _gauss(self) -> tuple[FloatArray, FloatArray]:
        return GAUSS[SMOOTH_NODES if self._smooth else NODES]

    @cached_property
    def run(self) -> BalancedRun:
        """The run where it is read."""
        return self._run.at(self._read_at)

    @cached_property
    def _coefficients(self) -> FloatArray:
        """Those (k, s) of the stages that are nodes."""
        return np.ascontiguousarray(self._scheme.A[self._stages])

    @cached_property
    def v(self) -> FloatArray:
        """Velocities (k, nv)."""
        steps, model, own = self._run.steps, self._run.mechanism.model, self._started
        rates = steps.rates[own, : self._scheme.n_stages, model.nv :]
        gained = np.diff(steps.times)[own, None, None] * (self._coefficients @ rates)
        stages = (steps.states[own, None, model.nq :] + gained).reshape(-1, model.nv)
        return np.concatenate((stages, self.run.v)) if len(self._read_at) else stages

    def element_powers(self) -> Powers:
        """Power (k,) of each force element but that of its potential."""
        parts: list[Powers] = []
        if len(self._started) or not len(self._read_at):
            steps, c = self._run.steps, self._scheme.c[self._stages]
            arrays = steps.times, steps.states, steps.rates, self._coefficients, c
            parts.append(self.observables.stage_powers(self._started, *arrays))
        if len(self._read_at):
            run = self.run
            parts.append(self.observables.powers(run.t, run.q, run.v))
        if len(parts) == 1:
            return {name: power.ravel() for name, power in parts[0].items()}
        return {name: np.concatenate([part[name].ravel() for part in parts]) for name in parts[0]}

    def works(self, powers: Powers, place: IndexArray) -> Powers:
        """Work (m,) J up to the ends at ``place`` (m,) by each of the ``powers`` (k,) W."""
        if not powers:
            return {}
        power = np.array(list(powers.values()))
        at_stages, lengths = self._steps >= 0, self._lengths
        nodes = len(self._started) * len(self._stages)
        out = np.zeros((len(powers), len(self._ends)))
        gained = out[:, 1:]
        for chosen, weights, own in (
            (at_stages, self._scheme.b[self._stages], power[:, :nodes]),
            (~at_stages, 0.5 * self._gauss[1], power[:, nodes:]),
        ):
            if own.size:
                mean = own.reshape(len(own), -1, len(weights)) @ weights
                gained[:, chosen] = lengths[chosen] * mean
        return dict(zip(powers, np.add.accumulate(out, axis=1)[:, place]))


def _controller(nodes: Nodes, system: _System) -> Powers:
    if not system.controlled:
        return {}
    states = zip(nodes.run.t, nodes.run.q, nodes.run.v)  # not smooth: all nodes are read
    return {"controller": np.array([system.controlled_force(*x) @ x[2] for x in states])}


def _joints(nodes: Nodes, system: _System) -> Powers:
    powers = {}
    if system.is_damped:
        v = nodes.v
        powers["joint damping"] = (system.damping_force(v) * v).sum(axis=1)
    if system.has_friction:
        v = nodes.v
        powers["joint friction"] = (system.friction_force(v) * v).sum(axis=1)
    return powers


def _elements(nodes: Nodes, system: _System) -> Powers:
    """Power of force elements; of springs and bushings without their force at rest, which has a
    potential."""
    if not working_elements(system.mechanism):
        return {}
    return _of_forces(nodes.element_powers())


def _of_forces(elements: Powers) -> Powers:
    return {f"force {name}": values for name, values in elements.items()}


def _drives(nodes: Nodes, system: _System) -> Powers:
    if not system.mechanism.drives:
        return {}
    run = nodes.run  # drives are not smooth: all nodes are read
    rates, forces = run.drive_rates, run.observables.drive_forces(run.t, run.q, run.v)
    return {f"drive {name}": force * rates[name] for name, force in forces.items()}


TERMS: tuple[Callable[[Nodes, _System], Powers], ...] = (
    _controller,
    _joints,
    _elements,
    _drives,
)
"""Everything that does work beside the potentials; what is new is added here."""


def _is_smooth(system: _System) -> bool:
    """Whether dampers do all the work, and no force has a kink."""
    acting = system.controlled or system.has_friction
    return not acting and _dampers_alone(system.mechanism)


@per_model
def _dampers_alone(mechanism: Mechanism) -> bool:
    """Whether all force elements are springs and dampers without a kink, and no drive moves it."""
    return not mechanism.drives and all(
        isinstance(force, LINEAR) and not getattr(force, "slack", 0.0) for force in mechanism.forces
    )


def energy_balance(
    solution: BalancedRun, system: _System, t: FloatArray, energies: FloatArray
) -> EnergyBalance:
    """The balance of ``solution`` at times (n,) s; ``system`` is the one that made it.

    Parameters
    ----------
    t, energies
        The times, and kinetic and potential energy (n, 2) J there.

    Raises
    ------
    EvaluationError
        If a force cannot be evaluated.
    """
    first = energies[:1]
    if not len(t) or t[0] != solution.span[0]:
        nq, states = solution.mechanism.model.nq, solution.steps.states[:1]
        first = solution.observables.energies(states[:, :nq], states[:, nq:])
    works = _works(solution, system, t) if _acted_on(system) else {}
    start = float(first.sum())
    kinetic, potential = energies.T
    largest = max(abs(start), _largest(kinetic), _largest(kinetic + potential))
    rounding = _rounding(solution.mechanism, largest)
    return EnergyBalance(t, kinetic, potential, KnownKeys(works), start, rounding)


def _acted_on(system: _System) -> bool:
    """Whether anything may do work beside the potentials."""
    mechanism = system.mechanism
    by_joints = system.controlled or system.is_damped or system.has_friction
    return by_joints or bool(mechanism.drives or working_elements(mechanism))


def _works(solution: BalancedRun, system: _System, t: FloatArray) -> Powers:
    """The works (n,) J up to the times ``t`` (n,)."""
    scheme = solution.scheme.member(False)
    by_stages = scheme.implicit is None and len(scheme.dense.extra_c) > 0
    if by_stages and _is_smooth(system) and not system.is_damped:
        found = solution.element_works(t)
        if found is not None:
            return _of_forces(found)
    steps = solution.steps
    ends = np.append(steps.times[:-1], steps.end)
    place = np.searchsorted(ends, t)
    if not np.array_equal(ends[np.minimum(place, steps.count)], t):  # steps are integrated whole
        ends = np.unique(np.concatenate([ends[:-1], t]))
        place = np.searchsorted(ends, t)
    nodes = Nodes(solution, system, ends)
    powers = {name: one for term in TERMS for name, one in term(nodes, system).items()}
    return nodes.works(powers, place)


def _largest(values: FloatArray) -> float:
    return float(np.abs(values).max(initial=0.0))


@per_model
def _weight(mechanism: Mechanism) -> float:
    """Weight (N) of all bodies."""
    mass: float = sum(inertia.mass for inertia in mechanism.model.inertias.tolist()[1:])
    return mass * float(np.linalg.norm(mechanism.model.gravity.linear))


def _rounding(mechanism: Mechanism, largest: float) -> float:
    """Rounding error (J) of sums of energies up to the ``largest``, whose zero is where potentials
    cancel."""
    return float(
        RELATIVE_ROUNDING * (_weight(mechanism) * mechanism.structure.units.length + largest)
    )


def joined_balance(
    segments: Sequence[BalancedRun], parts: Sequence[BalancedRun], order: IndexArray | slice
) -> EnergyBalance:
    """The balance of a run of several segments, with what happened between them as ``events``.

    Parameters
    ----------
    segments
        The whole segments.
    parts
        The same ones, read at the times that are wanted.
    order
        Index of the rows of all parts, one part after the other, that puts them in order.
    """
    balances = [part.energy_balance for part in parts]
    ends = [segment.at([segment.steps.end]).energy_balance for segment in segments]
    names = dict.fromkeys(name for end in ends for name in end.works)
    rows: dict[str, list[FloatArray]] = {name: [] for name in (*names, "events")}
    before, jumped = dict.fromkeys(names, 0.0), 0.0
    for k, (balance, end) in enumerate(zip(balances, ends)):
        nothing = np.zeros(len(balance.t))
        for name in names:
            rows[name].append(before[name] + balance.works.get(name, nothing))
            before[name] += float(end.works.get(name, np.zeros(1))[-1])
        rows["events"].append(nothing + jumped)
        if k + 1 < len(ends):
            jumped += ends[k + 1].start - float(end.kinetic[-1] + end.potential[-1])

    def joined(pieces: Sequence[FloatArray]) -> FloatArray:
        whole: FloatArray = np.concatenate(pieces)[order]
        return whole

    return EnergyBalance(
        joined([balance.t for balance in balances]),
        joined([balance.kinetic for balance in balances]),
        joined([balance.potential for balance in balances]),
        KnownKeys((name, joined(pieces)) for name, pieces in rows.items()),
        ends[0].start,
        max(balance.rounding for balance in balances),
    )
