r"""Passages of critical configurations that steps cannot make.

A mechanism with a small residual delta avoids its singular configuration within a layer of
sqrt(2 |delta| / H) (:mod:`srm_mbs.dynamics.singularities.critical`).  Stages in the layer lose
their normals to rounding over delta, and stages across it see branches that are none of this
mechanism.  With one degree of freedom the closed configurations are a curve q(beta), along which
the closures do no work:

    T' = q' . f(t, q, v),   t' = sqrt(m / (2 T)),   m = q' . M q',   v = q' / t',

' for the derivative by beta, T the kinetic energy, f the forces but those of inertia and closures.
These equations are regular in the layer; they are solved by collocation in xi with
beta = width sinh(xi), which resolves it.  With drives that leave no freedom beta prescribes t
itself.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from itertools import pairwise

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.multibody import ClosedSystem, OpenSystem
from srm_mbs.dynamics.singularities.critical import (
    CriticalConfiguration,
    CurveThroughSaddle,
    critical_configuration,
)
from srm_mbs.errors import EvaluationError
from srm_mbs.integration.control.branch_guard import may_cross
from srm_mbs.integration.control.placement import zero_within
from srm_mbs.integration.methods.base import ErrorNorm, Method, StepResult
from srm_mbs.integration.methods.butcher import ButcherTableau
from srm_mbs.integration.methods.psrm import PSRM

SEARCH = 0.3
"""Distance (rad, scene diagonals) from the predicted passage within which its critical
configuration is looked for."""
PASSED = 0.5
"""Distance of the predicted passage from the critical configuration, over that of the start of the
step, below which the step passes it."""
ROUNDED_RESIDUAL = 1e-13
"""Residual (row units) below which the configuration is singular to rounding."""
DISTURBING = 1e-3
"""Residual that counts as zero, over rtol, up to which steps pass as if it were."""
LARGEST = 64
"""Coordinates of a mechanism whose passages are examined, at most: the search is dense algebra."""
LAYER = 2.0
"""|xi| up to which the motion changes on the scale of the layer, which dense output resolves."""
OUTER_PANEL = 1.0
"""Largest length of a panel of collocation nodes in xi, outside the layer."""
SHORTEST_PANEL = 0.2
"""Shortest length of a panel in the layer."""
SWEEPS = 12
CONVERGED = 1e-14
"""Relative change of energies and times in a sweep at which the collocation is solved."""
ROUNDED = 1e-11
"""That from which rounding may end it."""


@lru_cache(maxsize=16)
def gauss_nodes(count: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Nodes (k,) on [0, 1], weights (k,), and the integrals (k, k) of the basis up to the nodes."""
    x, w = np.polynomial.legendre.leggauss(count)
    x, w = 0.5 * (x + 1.0), 0.5 * w
    # Legendre polynomials on [-1, 1], and their integrals from -1.
    legendre, y = np.polynomial.legendre, 2.0 * x - 1.0
    basis = np.linalg.inv(legendre.legvander(y, count - 1))
    integral = np.array([legendre.legint(e, lbnd=-1.0) for e in np.eye(count)])
    return x, w, 0.5 * legendre.legval(y, integral.T).T @ basis


def panel_edges(reach: float, inner: float) -> FloatArray:
    """Edges of the panels on [-reach, reach] in xi: of the length ``inner`` in the layer, where
    |xi| < LAYER, of OUTER_PANEL elsewhere.

    Their number is odd, and the number of nodes even: none lies at 0, which may be singular.
    """
    layer = min(reach, LAYER)
    half = max(1, int(np.ceil(layer / inner - 0.5)))
    within = np.linspace(-layer, layer, 2 * half + 2)
    outer = np.linspace(layer, reach, 1 + int(np.ceil((reach - layer) / OUTER_PANEL)))[1:]
    return np.concatenate([-outer[::-1], within, outer])


@dataclass(frozen=True, eq=False)
class _Point:
    """A configuration of the curve.

    Attributes
    ----------
    place, beta
        The configuration, and where on the curve it is.
    tangent, bend : (n,)
        Its first and second derivative by beta, in units.
    inertia
        m.
    """

    place: FloatArray
    beta: float
    tangent: FloatArray
    bend: FloatArray
    inertia: float


@dataclass(eq=False)
class PassageAlongCurve:
    """The motion past a critical configuration, along the curve of closed configurations.

    Parameters
    ----------
    system
        The mechanism, with one degree of freedom or with drives that leave none.
    critical
        The critical configuration next to the motion.
    t, state
        Start (s), and the state (nq + nv,) there, moving towards the critical configuration.
    exact
        Whether the residual counts as zero, so that the motion goes straight on.
    panel, nodes
        Length in xi of a panel in the layer, and collocation nodes of a panel, an even number.

    Attributes
    ----------
    times : (k,) s, states : (k, nq + nv), rates : (k, 2 nv)
        The motion at the nodes: states and tangent rates.

    Raises
    ------
    ValueError
        If the motion has no such passage: the critical configuration is no saddle, the motion
        leads away from it, has more freedom, or turns back for want of energy.
    """

    system: ClosedSystem
    critical: CriticalConfiguration
    t: float
    state: FloatArray
    exact: bool
    panel: float
    nodes: int
    times: FloatArray = field(init=False)
    states: FloatArray = field(init=False)
    rates: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        geometry = self.critical.geometry
        q, v = self.system.split(self.state)
        self._nv = len(v)
        self._driven = len(geometry.unit) > self._nv
        self._curve = CurveThroughSaddle(self.critical, geometry.at(q, self.t), self.exact)
        start = self._curve.beta
        u = geometry.rates(v)
        here = self._point(start)
        if not float(u @ here.tangent) * start < 0.0:
            raise ValueError("the motion leads away from the critical configuration")
        self._heading = -float(np.sign(start))
        self._width = self._curve.width or abs(start)
        geometry.closure(here.place)
        M, own = geometry.mass(), u[: self._nv]
        self._energy, self._t = 0.5 * float(own @ M @ own), self.t
        reach = float(np.arcsinh(abs(start) / self._width))
        edges = self._edges = self._heading * panel_edges(reach, self.panel)
        found = [(here, self._energy, self.t)]
        for a, b in pairwise(edges.tolist()):
            found += self._panel(a, b)
        # A residual that counts as zero is closed again where it leaves.
        point, energy, t = found[-1]
        found[-1] = self._point(point.beta, closed=True), energy, t
        self.times = np.array([t for *_, t in found])
        self._energies = np.array([energy for _, energy, _ in found])
        motion = [self._motion(*one) for one in found]
        self.states = np.array([state for state, _ in motion])
        self.rates = np.array([rate for _, rate in motion])
        self.states[0] = self.state

    def _point(self, beta: float, closed: bool = False) -> _Point:
        geometry, nv = self.critical.geometry, self._nv
        place, tangent, bend = self._curve.at(beta, closed)
        geometry.closure(place)
        own = tangent[:nv]
        return _Point(place, beta, tangent, bend, float(own @ geometry.mass() @ own))

    def _speed(self, point: _Point, energy: float) -> float:
        """beta' of a motion with the kinetic ``energy`` (J), or with drives that of their time."""
        if self._driven:
            return float(1.0 / (point.tangent[-1] * self.critical.geometry.unit[-1]))
        return float(self._heading * np.sqrt(2.0 * energy / point.inertia))

    def _state_at(self, point: _Point, energy: float) -> tuple[FloatArray, FloatArray]:
        """q (nq,) and v (nv,) at a point."""
        q = point.place[:-1] if self._driven else point.place
        unit = self.critical.geometry.coordinate_unit
        return q, self._speed(point, energy) * point.tangent[: self._nv] * unit

    def _motion(self, point: _Point, energy: float, t: float) -> tuple[FloatArray, FloatArray]:
        """State and tangent rate at a point."""
        geometry, nv = self.critical.geometry, self._nv
        unit, speed = geometry.coordinate_unit, self._speed(point, energy)
        q, v = self._state_at(point, energy)
        tangent, turned = point.tangent[:nv], point.bend[:nv] * speed**2
        if self._driven:
            along = -point.bend[-1] * speed**2 / point.tangent[-1]
        else:
            force = self.system.working_force(t, q, v) + self.system.inertial_force(q, v)
            geometry.closure(point.place)
            along = float(tangent @ (force * unit - geometry.mass() @ turned)) / point.inertia
        acceleration = (tangent * along + turned) * unit
        return np.concatenate([q, v]), np.concatenate([v, acceleration])

    def _power(self, point: _Point, t: float, energy: float) -> float:
        """q' . f at a point: the work per beta; with drives, which prescribe the motion, 0."""
        if self._driven:
            return 0.0
        force = self.system.working_force(t, *self._state_at(point, energy))
        return float((point.tangent * self.critical.geometry.coordinate_unit) @ force)

    def _panel(self, a: float, b: float) -> list[tuple[_Point, float, float]]:
        """Points, energies and times at the nodes of the panel [a, b] of xi, and at its end."""
        x, w, integrals = gauss_nodes(self.nodes)
        xi = a + (b - a) * np.append(x, 1.0)
        weights = np.vstack([integrals, w])
        points = [self._point(float(beta)) for beta in self._width * np.sinh(xi)]
        inner, slope = points[:-1], self._width * np.cosh(xi[:-1]) * (b - a)
        energy, t = np.full(len(x), self._energy), np.full(len(x), self._t)
        last = np.inf
        for _ in range(SWEEPS):
            work = slope * [self._power(*one) for one in zip(inner, t.tolist(), energy.tolist())]
            energies = self._energy + weights @ work
            if not (energies > 0.0).all():
                raise ValueError("the energy does not suffice to pass")
            speeds = np.array([self._speed(*one) for one in zip(inner, energies.tolist())])
            if not (speeds * slope > 0.0).all():
                raise ValueError("the drives lead where the mechanism cannot follow")
            times = self._t + weights @ (slope / speeds)
            change = float(
                np.abs(energies[:-1] - energy).max() / energies.max()
                + np.abs(times[:-1] - t).max() / (times[-1] - self._t)
            )
            energy, t = energies[:-1], times[:-1]
            if change < CONVERGED or (change < ROUNDED and not change < last):
                break
            last = change
        self._energy, self._t = float(energies[-1]), float(times[-1])
        return list(zip(points, energies.tolist(), times.tolist()))

    def at_time(self, t: float) -> tuple[FloatArray, FloatArray]:
        """State (nq + nv,) and tangent rate (2 nv,) at the time t (s) of the passage."""
        from scipy.interpolate import BarycentricInterpolator
        from scipy.optimize import brentq

        count = self.nodes + 1
        k = int(np.searchsorted(self.times, t, side="right")) - 1
        panel = min(k, len(self.times) - 2) // count
        own = slice(panel * count, (panel + 1) * count + 1)
        x = np.concatenate([[0.0], gauss_nodes(self.nodes)[0], [1.0]])
        begin = self.times[own.start]
        clock = BarycentricInterpolator(x, self.times[own] - begin)
        place = brentq(lambda s: float(clock(s)) - (t - begin), 0.0, 1.0, xtol=1e-15)
        a, b = self._edges[panel : panel + 2]
        energy = float(BarycentricInterpolator(x, self._energies[own])(place))
        point = self._point(self._width * float(np.sinh(a + (b - a) * place)))
        return self._motion(point, energy, t)


@dataclass(frozen=True)
class ExaminedPassage:
    """A passage next to a critical configuration, and what was decided.

    Attributes
    ----------
    time
        When it was expected (s).
    residual
        delta of the critical configuration, in row units.
    avoided
        Whether the motion follows the residual; else it counts as zero.
    resolved
        Whether the passage was made along the curve of closed configurations, not by steps.
    """

    time: float
    residual: float
    avoided: bool
    resolved: bool


def examined_passages(
    system: ClosedSystem | OpenSystem,
    method: Method,
    norm: ErrorNorm,
    placement: str,
    tolerance: float,
) -> CriticalPassages | None:
    """The examination of the passages of a run; None where steps make them all: without closures,
    without automatic placement, in sweeps and in large mechanisms."""
    split = isinstance(method, PSRM) and method.correction == "split"
    if not (isinstance(system, ClosedSystem) and split and placement == "automatic"):
        return None
    if system.nv > LARGEST:
        return None
    return CriticalPassages(system, method.scheme, norm, tolerance)


class CriticalPassages:
    """Examines the singular configurations that steps would pass; used by the drivers.

    Parameters
    ----------
    system, scheme, norm
        Of the run.
    tolerance
        Residual (row units) up to which a critical configuration counts as singular.

    Attributes
    ----------
    examined
        The passages whose residual is not zero to rounding, in order of time.
    """

    def __init__(
        self, system: ClosedSystem, scheme: ButcherTableau, norm: ErrorNorm, tolerance: float
    ) -> None:
        self._system, self._scheme, self._norm = system, scheme, norm
        self._tolerance = tolerance
        self._known = False
        self.examined: list[ExaminedPassage] = []

    def crossing(self, result: StepResult) -> float | None:
        """When (s) the step of ``result`` passes a singular configuration that has not been
        examined; None if it does not."""
        lowest = int(np.argmin(result.sigmas))
        if self._known or result.quiet or lowest == 0 or not may_cross(result):
            return None
        abscissae = self._scheme.member(result.stiff).abscissae
        zero = zero_within(abscissae, result.sigmas)
        if zero is None or not 0.0 < zero <= 1.0:
            zero = float(abscissae[lowest])
        return float(result.t + zero * result.h)

    def unexamined(self, zero: float | None, t: float) -> float | None:
        """The ``zero`` (s) of sigma that is expected after ``t`` (s), unless it was examined."""
        return None if self._known or zero is None or not zero > t else zero

    def accepted(self, result: StepResult) -> None:
        """A step was accepted: where sigma rises, the next passage is another one."""
        if result.sigmas[-1] > result.sigmas[0]:
            self._known = False

    def steps_past(
        self, t: float, state: FloatArray, rate: FloatArray, zero: float, end: float
    ) -> list[tuple[StepResult, float]]:
        """The steps of the motion past the critical configuration next to a passage.

        Parameters
        ----------
        t, state, rate
            Where the step begins (s), the state (nx,) and the tangent rate (n,) there.
        zero
            When the passage is expected (s).
        end
            End of the smooth interval (s).

        Returns
        -------
        list
            Each step with its end (s); empty if ordinary steps are to make the passage.
        """
        system = self._system
        analysis = system.singularities
        nv, ahead = system.nv, zero - t
        move = np.zeros(2 * nv)
        move[:nv] = ahead * (rate[:nv] + 0.5 * ahead * rate[nv:])
        q = analysis.split(system.retract(state, move))[0]
        geometry = analysis.geometry(analysis.q0, t)
        place = geometry.at(q, zero)
        critical = critical_configuration(geometry, analysis.rank, place, SEARCH)
        if critical is None:
            return []
        begin = geometry.at(analysis.split(state)[0], t)
        left, covered = (geometry.difference(critical.q, x) for x in (place, begin))
        if not np.linalg.norm(left) < PASSED * np.linalg.norm(covered):
            return []
        self._known = True
        if abs(critical.residual) <= ROUNDED_RESIDUAL:
            return []
        residual = critical.residual
        avoided = abs(residual) > self._tolerance
        steps: list[tuple[StepResult, float]] = []
        if avoided or abs(residual) > DISTURBING * self._norm.rtol:
            panel = max(SHORTEST_PANEL, (1e4 * self._norm.rtol) ** 0.1)
            nodes = 2 * int(np.ceil(0.5 - 0.3 * np.log10(self._norm.rtol)))
            try:
                passage = PassageAlongCurve(system, critical, t, state, not avoided, panel, nodes)
                steps = self._steps(passage, end)
            except (ValueError, EvaluationError, np.linalg.LinAlgError):
                pass  # steps pass it as well as they can, and the message says so
        self.examined.append(ExaminedPassage(zero, residual, avoided, bool(steps)))
        return steps

    def _steps(self, passage: PassageAlongCurve, end: float) -> list[tuple[StepResult, float]]:
        """The ``passage`` as steps from node to node, up to ``end`` (s)."""
        inside = passage.times < end
        times, states, rates = passage.times[inside], passage.states[inside], passage.rates[inside]
        if not inside.all():
            state, rate = passage.at_time(end)
            times = np.append(times, end)
            states, rates = np.vstack([states, state]), np.vstack([rates, rate])
        system = self._system
        sigmas = [system.evaluate(t, x).sigma for t, x in zip(times.tolist(), states)]
        return [
            (self._step(times, states, rates, sigmas, i), float(times[i + 1]))
            for i in range(len(times) - 1)
        ]

    def _step(
        self,
        times: FloatArray,
        states: FloatArray,
        rates: FloatArray,
        sigmas: list[float],
        i: int,
    ) -> StepResult:
        system, scheme = self._system, self._scheme
        h = float(times[i + 1] - times[i])
        delta = system.difference(states[i], states[i + 1], h * rates[i])
        # Rates between the ends only say how far the step leads.
        first = float(scheme.b[0])
        between = (delta / h - first * rates[i]) / (1.0 - first)
        stages = np.tile(between, (scheme.n_stages + 1, 1))
        stages[0], stages[-1] = rates[i], rates[i + 1]
        along = np.append(scheme.c, 1.0)
        return StepResult(
            t=float(times[i]),
            h=h,
            state=states[i + 1],
            rates=stages,
            end_rate=rates[i + 1],
            correction=np.zeros(2 * system.nv),
            error_ratio=0.0,
            sigmas=sigmas[i] + along * (sigmas[i + 1] - sigmas[i]),
            rank=system.structure.rank,
            state_scale=system.state_scale(states[i + 1]),
            placement="critical",
        )

    def message(self) -> str:
        """Sentences on the passages that the tolerance decided, or that could not be resolved."""
        by_tolerance = [abs(one.residual) for one in self.examined if not one.avoided]
        missed = [one for one in self.examined if one.avoided and not one.resolved]
        out = ""
        if by_tolerance:
            out += (
                f" {len(by_tolerance)} singular configurations with residuals up to "
                f"{max(by_tolerance):.1e} count as exact (singular_tolerance)."
            )
        if missed:
            out += (
                f" The mechanism avoids its singular configuration near t = {missed[0].time:.6g} s "
                f"(residual {missed[0].residual:.1e}) in a layer that the steps may not have "
                "resolved."
            )
        return out
