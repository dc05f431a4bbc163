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
from enum import Enum
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.constraints.structure import structure_of
from srm_mbs.dynamics.singularities.critical import (
    LARGEST_DEVIATION,
    CriticalConfiguration,
    CurveThroughSaddle,
    critical_configuration,
)
from srm_mbs.dynamics.system import BranchSystem, System
from srm_mbs.errors import EvaluationError, time_text
from srm_mbs.integration.control.branch_guard import may_cross
from srm_mbs.integration.control.placement import zero_within
from srm_mbs.integration.methods.base import ErrorNorm, Method, StepResult
from srm_mbs.integration.methods.butcher import ButcherTableau
from srm_mbs.integration.methods.psrm import is_split
from srm_mbs.model.lazy import cached_property
from srm_mbs.model.mechanism import MechanismData

SEARCH = 0.6
"""Distance (rad, scene diagonals) from the predicted passage within which its critical
configuration is looked for."""
PASSED = 0.5
"""Distance of the predicted passage from the critical configuration, over that of the start of the
step, below which the step passes it.  In a wide layer the curve itself tells."""
FARTHEST = 1.5
"""Distance (units) of a critical configuration that is expected ahead from which a motion waits:
another one may lie between."""
EXAMINED_AGAIN = 0.7
"""Fall of sigma after which a motion that passes no critical configuration so far is examined
again; with a dead point ahead, the lowest over the last one in a step that leads past it."""
ROUNDED_RESIDUAL = 1e-13
"""Residual (row units) below which the configuration counts as singular at every tolerance."""
STEPPED_RESIDUAL = 1e-14
"""That up to which steps pass it: rounding.  With a larger one they come into the layer at tight
tolerances."""
DEAD_POINT_WIDTH = 1e-2
"""Width (units) of a layer up to which dead points of drives are looked for in it: steps stop at
others."""
DEAD_POINT_WIDTHS = 100.0
"""Distance from its middle, over the width, at which the curve is earlier than there."""
WIDE = 0.5 * SEARCH**2
"""Residual (row units) from which the layer, of sqrt(2 |delta|) where H is 1, is as wide as that:
steps resolve it."""
LARGEST = 64
"""Coordinates of a mechanism whose passages are examined, at most: the search is dense algebra."""
LAYER = 1.5
"""|xi| up to which the panel in the middle reaches; a third more instead of a short panel more."""
SHORTEST_PANEL = 0.1
"""Length of a panel in xi, at least."""
PANEL_ERROR = 1.0
"""Largest error of interpolation on a panel (units), over rtol.  Gauss quadrature, which leads from
panel to panel, is far more accurate."""
RELATIVE_PANEL_ERROR = 2e-4
"""Largest one over the size of the panel: dense output shows layers that are far below rtol."""
SHRINKAGE = 0.8
"""Ratio of the lengths that are tried."""
BISECTIONS = 50
DEPENDENT = 1e-10
"""Part of a row without those of others below which it depends on them."""
LAYER_SINGULARITY = 0.25j * np.pi
"""Where, in the complex plane of xi, the inertia along a typical hyperbola vanishes."""
CURVATURE = 2.0
"""Distance (units) at which closures leave their tangents, about: the singularity of the curve in
the complex plane of beta."""
SWEEPS = 12
CONVERGED = 0.01
"""Last relative change of places and energies in a sweep at which the collocation is solved, over
rtol."""
PLACING_STEPS = 4
"""Newton steps onto the curve before an evaluation there, at most."""
CONVERGING = 0.5
"""Largest ratio of such a step to the one before, and of the first to the distance from the
critical configuration: longer steps lead to other configurations, and are not made."""
TURNED = 1.0
"""Largest relative change of the rates in that sweep, over rtol."""
PLACE_ROUNDING = 2e-15
"""Rounding (units^2) of a place on the curve, times its distance from the critical
configuration."""
EXTRAPOLATED = 1e-4
"""Distance (units) from the critical configuration from which that of the curve from its hyperbola
is known beyond rounding."""
CUT, CUT_FROM = 1.1, 0.9
"""Length of a panel in which the passage is to stop, over the one that is predicted to lead there,
and the length, over that of the whole panel, below which it is cut so.  Interpolation to a time in
it is then almost as accurate as its quadrature."""
START_REACH = 0.1
"""Distance (units) from a critical configuration up to which a motion that starts in its layer is
followed along the curve."""
LAYERS_LEFT = 10.0
"""The same over the width of the layer, at least: there the residual is closed again."""
SPENT_ENERGY = 0.25
"""Part of the kinetic energy that the forces at the start may change up to there, if the residual
counts as zero: such a motion is followed as a whole, or not at all."""
FIRST_PART = 0.1
"""First step after a motion that starts in a layer, over the time in which it leaves that."""
SHORTENED = 0.5
"""Length of a panel outside of the layer, over that of one in which the energy changes too much."""
LEAST_ENERGY = 0.75
"""Least kinetic energy on a panel outside of the layer, over the largest, from which polynomials on
it resolve the time: the rate of that grows without bound where the motion turns back."""
FALLING_SIGMA = 0.5
"""sigma beyond the layer, over the largest one on a panel before, below which the curve comes to
another layer."""
SMALLEST_REST = 1e-9
"""Rest of a passage, over its whole, that is none."""


@lru_cache(maxsize=16)
def exact_up_to(singular_tolerance: float) -> float:
    """Residual (row units) up to which a critical configuration counts as singular."""
    return max(singular_tolerance, ROUNDED_RESIDUAL)


def gauss_nodes(count: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Nodes (k,) on [0, 1], weights (k,), and the integrals (k, k) of the basis up to the nodes."""
    x, w = np.polynomial.legendre.leggauss(count)
    x, w = 0.5 * (x + 1.0), 0.5 * w
    # Legendre polynomials on [-1, 1], and their integrals from -1.
    legendre, y = np.polynomial.legendre, 2.0 * x - 1.0
    basis = np.linalg.inv(legendre.legvander(y, count - 1))
    integral = np.array([legendre.legint(e, lbnd=-1.0) for e in np.eye(count)])
    return x, w, 0.5 * legendre.legval(y, integral.T).T @ basis


@lru_cache(maxsize=16)
def node_count(rtol: float) -> int:
    """Collocation nodes of a panel, an even number."""
    return 2 * int(np.ceil(0.5 - 0.3 * np.log10(rtol)))


def interpolation_error(a: float, b: float, nodes: int, width: float, layer: bool) -> float:
    """Relative error of polynomials through ``nodes`` Gauss nodes on the panel [a, b] of xi.

    It falls with the ellipse around the panel through the next singularity: that of the layer, if
    there is a ``layer``, and that of the curve, at beta = +-i CURVATURE.
    """
    middle, half = 0.5 * (a + b), 0.5 * (b - a)
    of_curve = complex(np.arcsinh(1j * CURVATURE / width))
    places = [of_curve.real + 0.5j * np.pi, -of_curve.real + 0.5j * np.pi]
    if layer:
        places.append(LAYER_SINGULARITY)
    error = 0.0
    for place in places:
        z = (place - middle) / half
        root = np.sqrt(z * z - 1.0)
        error = max(error, float(max(abs(z + root), abs(z - root))) ** -nodes)
    return error


def panel_edges(
    reach: float, nodes: int, width: float, layer: bool, tolerance: float
) -> list[float]:
    """Edges of the panels on [-reach, reach] in xi, symmetric, on which polynomials through
    ``nodes`` Gauss nodes are accurate to ``tolerance`` (units).

    Their number is odd, and the number of nodes even: none lies at 0, which may be singular.
    """

    def accurate(a: float, b: float) -> bool:
        error = interpolation_error(a, b, nodes, width, layer)
        return error <= min(RELATIVE_PANEL_ERROR, tolerance / (width * float(np.sinh(b))))

    edge, out = reach, [reach]
    while edge > SHORTEST_PANEL and not (edge <= 4.0 / 3.0 * LAYER and accurate(-edge, edge)):
        length = edge - LAYER if edge > 4.0 / 3.0 * LAYER else 0.5 * edge
        while length > SHORTEST_PANEL and not accurate(edge - length, edge):
            length *= SHRINKAGE
        edge -= length
        out.append(edge)
    return [-x for x in out] + out[::-1]


def interpolated(x: FloatArray, values: FloatArray, at: float) -> float:
    """The polynomial through ``values`` (k,) at x (k,), at a point between."""
    off = at - x
    if not off.all():
        return float(values[int(np.argmin(np.abs(off)))])
    weights = np.array([1.0 / np.prod(np.delete(a - x, i)) for i, a in enumerate(x)]) / off
    return float(weights @ values / weights.sum())


def bisected(x: FloatArray, values: FloatArray, value: float) -> float:
    """Where the polynomial through increasing ``values`` (k,) at x (k,) has the ``value``."""
    low, high = float(x[0]), float(x[-1])
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        if interpolated(x, values, middle) < value:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)


@dataclass(frozen=True, eq=False)
class Node:
    """A point of the motion along a curve, as its last evaluation left it.

    Attributes
    ----------
    place
        The configuration, as the geometry takes it.
    beta
        Where it is on the curve.
    tangent : (n,)
        Its derivative by beta, in units.
    rates : (n,)
        That by time.
    off
        Newton step (units) that led there.
    inertia, power
        m, and the work of the forces per beta.
    acceleration : (nv,)
        Of the motion.
    sigma
        That of the closures.
    """

    place: FloatArray
    beta: float
    tangent: FloatArray
    rates: FloatArray
    off: float
    inertia: float
    power: float
    acceleration: FloatArray
    sigma: float


@dataclass(frozen=True, eq=False)
class PlaceOnCurve:
    """Where a motion past a critical configuration stopped on its way.

    Attributes
    ----------
    critical, exact, curve
        The critical configuration, whether its residual counts as zero, and the curve beside it.
    start
        beta at which the passage began; it ends at -start.
    beta, energy
        beta and the kinetic energy (J) where it stopped.
    beside
        Whether the state there is only next to the curve, in a layer that counts as none.
    """

    critical: CriticalConfiguration
    exact: bool
    curve: CurveThroughSaddle
    start: float
    beta: float
    energy: float
    beside: bool = False

    def __deepcopy__(self, memo: Any) -> PlaceOnCurve:
        """Itself: nothing of it changes."""
        return self


@dataclass(eq=False)
class PassageAlongCurve:
    """The motion past a critical configuration, along the curve of closed configurations.

    Each sweep over a panel evaluates the equations of motion once at each of its nodes, and moves
    places, energies and times there.

    Parameters
    ----------
    system
        The mechanism, with one degree of freedom or with drives that leave none.
    critical
        The critical configuration next to the motion.
    t, state
        Start (s), and the state (nq + nv,) there, moving towards the critical configuration.
    end
        Time (s) at which the passage ends at the latest.
    exact
        Whether the residual counts as zero, so that the motion goes straight on.
    rtol
        Relative tolerance of the run.
    begun
        Where the passage was stopped, if it was; ``state`` at ``t`` is the one there.

    Attributes
    ----------
    rest
        Where it stops at ``end``; None if it does not.
    times : (k,) s, states : (k, nq + nv), rates : (k, 2 nv), sigmas : (k,)
        The motion at the nodes: states, tangent rates and sigma.

    Raises
    ------
    ValueError
        If the motion has no such passage: the critical configuration is no saddle, the motion
        leads away from it, has more freedom, or turns back for want of energy.
    """

    system: BranchSystem
    critical: CriticalConfiguration
    t: float
    state: FloatArray
    end: float
    exact: bool
    rtol: float
    begun: PlaceOnCurve | None = None
    rest: PlaceOnCurve | None = field(init=False, default=None)
    times: FloatArray = field(init=False)
    states: FloatArray = field(init=False)
    rates: FloatArray = field(init=False)
    sigmas: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        geometry = self.critical.geometry
        q, v = self.system.singularities.split(self.state)
        self._nv = len(v)
        self._driven = len(geometry.unit) > self._nv
        place, rates = geometry.at(q, self.t), geometry.rates(v)
        begun = self.begun
        if begun is None:
            curve = self._curve = CurveThroughSaddle(self.critical, place, self.exact)
            self._start = beta = curve.beta
        else:
            curve, self._start, beta = begun.curve, begun.start, begun.beta
            self._curve = curve
        self._heading = -float(np.sign(self._start))
        self._found: list[tuple[Node, float, float]] = []
        known = begun is not None and self._rounded(beta)
        if begun is not None and begun.beside:
            geometry.closure(place)
            place, rates, _ = self._predicted(beta, begun.energy, geometry.mass())
        here = self._evaluated(place, beta, rates, self.t, self._closes(beta), known)
        if begun is None and not float(rates @ here.tangent) * beta < 0.0:
            raise ValueError("the motion leads away from the critical configuration")
        self._width = curve.width or abs(self._start)
        if begun is None:
            speed = float(curve.along @ rates) / float(curve.along @ here.tangent)
            self._energy = 0.5 * here.inertia * speed**2
        else:
            self._energy = begun.energy
        self._clock = self.t
        if self._driven and begun is not None and begun.beside:
            self._clock = float(here.place[-1])
        self._found.append((here, self._energy, self.t))
        self._count = node_count(self.rtol)
        reach = float(np.arcsinh(abs(self._start) / self._width))
        allowed = PANEL_ERROR * self.rtol
        edges = panel_edges(reach, self._count, self._width, not self.exact, allowed)
        at = self._heading * float(np.arcsinh(beta / self._width))
        if begun is None:
            at = edges[0]
        for edge in edges[1:]:
            at = self._panels(at, edge)
            if at < edge:
                break
        if self._clock < self.end:
            beyond = -self._start
            if at < edges[-1]:
                beyond = self._width * float(np.sinh(self._heading * at))
            self._point(beyond, self._energy, self._clock)
            if self._driven:
                node, energy, _ = self._found.pop()
                self._found.append((node, energy, float(node.place[-1])))
        self.times = np.array([t for *_, t in self._found])
        self.sigmas = np.array([node.sigma for node, *_ in self._found])
        motion = [self._motion(node, energy) for node, energy, _ in self._found]
        self.states = np.array([state for state, _ in motion])
        self.rates = np.array([rate for _, rate in motion])
        self.states[0] = self.state

    def _panels(self, at: float, edge: float) -> float:
        """Go on from ``at`` to the ``edge``, of xi times the heading; where that led.

        Beyond the layer that may be less, where the motion turns back soon.  Where the energy
        changes much, panels are shorter.
        """
        target = edge
        while at < edge and self._clock < self.end:
            try:
                at, target = self._panel(at, target), edge
            except ValueError:
                beyond, before = at >= LAYER, target <= -LAYER
                bounded = self._bounded(at, target)
                target = at + SHORTENED * (target - at)
                if bounded:
                    continue
                if self.exact or not (beyond or before):
                    raise
                if target - at < SHORTEST_PANEL:
                    if before:
                        raise
                    break
        return at

    def _bounded(self, a: float, b: float) -> bool:
        """Whether the energy of a straight motion may change by a part only on the panel from
        ``a`` to ``b``: the shortest ones follow it as well as they can."""
        return self.exact and not self._driven and b - a > SHORTEST_PANEL

    def _closes(self, beta: float) -> bool:
        """Whether the closures are to hold at ``beta``, also where their residual counts as
        zero: where it turns the curve by less than the tolerance, and at the ends."""
        turned = self.rtol * beta**2 > self._curve.layer**2
        return turned or not abs(beta) < abs(self._start)

    def _rounded(self, beta: float) -> bool:
        """Whether rounding turns the normals at ``beta``, on a curve that leads straight through
        the critical configuration, by more than the tolerance."""
        return self.exact and self.rtol * beta**2 < PLACE_ROUNDING

    def _predicted(
        self, beta: float, energy: float, mass: FloatArray
    ) -> tuple[FloatArray, FloatArray, float]:
        """Place, rates (n,) and beta' at ``beta``, with the kinetic ``energy`` (J) and the ``mass``
        matrix (nv, nv): those of the hyperbola, moved by the distance of the last nodes from it,
        which grows with the square of that from the critical configuration."""
        geometry = self.critical.geometry
        away, tangent = self._curve.hyperbola(beta)
        known = [
            (node.beta, self._off_hyperbola(node) / self._distance(node.beta) ** 2)
            for node, *_ in self._found[-2:]
            if self._distance(node.beta) ** 2 > EXTRAPOLATED * abs(beta)
        ]
        if known:
            (a, at_a), (b, at_b) = known[0], known[-1]
            slope = (at_b - at_a) / (b - a) if len(known) == 2 else np.zeros(len(away))
            curvature, square = at_b + (beta - b) * slope, self._distance(beta) ** 2
            away = away + square * curvature
            tangent = tangent + 2.0 * beta * curvature + square * slope
        if self._driven:
            speed = float(1.0 / (tangent[-1] * geometry.unit[-1]))
        else:
            inertia = tangent @ mass @ tangent
            speed = self._heading * float(np.sqrt(2.0 * energy / inertia))
        return geometry.move(self.critical.q, away), speed * tangent, speed

    def _off_hyperbola(self, node: Node) -> FloatArray:
        away = self.critical.geometry.difference(self.critical.q, node.place)
        return away - self._curve.hyperbola(node.beta)[0]

    def _evaluated(
        self,
        place: FloatArray,
        beta: float,
        rates: FloatArray,
        t: float,
        closed: bool = False,
        known: bool = False,
    ) -> Node:
        """The node next to ``place``, from one evaluation on the curve with the ``rates`` (n,), in
        units; ``known``: it is there, and the rates are along the curve."""
        system, geometry, nv = self.system, self.critical.geometry, self._nv
        unit = geometry.coordinate_unit
        if known:
            geometry.closure(place)
            step = turned = np.zeros(len(rates))
            tangent = rates / float(self._curve.along @ rates)
        else:
            place, rates, step, tangent, matrix = self._on_curve(place, beta, rates, closed)
            turned = self._curve.bend(place, rates, matrix)
        M = geometry.mass()
        q, v = place[:-1] if self._driven else place, rates[:nv] * unit
        if self._driven:
            t = float(place[-1])
        sigma = system.evaluate(t, np.concatenate([q, v])).sigma
        force = system.working_force(t, q, v) * unit
        inertial = system.inertial_force(q, v) * unit
        tangent = tangent / self._growth(place, tangent)
        own = tangent[:nv]
        inertia = float(own @ M @ own)
        if self._driven:
            along = -turned[-1] / tangent[-1]
        else:
            along = float(own @ (force + inertial - M @ turned[:nv])) / inertia
        return Node(
            place=geometry.move(place, step),
            beta=beta,
            tangent=tangent,
            rates=rates,
            off=float(np.abs(step).max()),
            inertia=inertia,
            power=0.0 if self._driven else float(own @ force),
            acceleration=(own * along + turned[:nv]) * unit,
            sigma=sigma,
        )

    def _on_curve(
        self, place: FloatArray, beta: float, rates: FloatArray, closed: bool
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        """``place`` and ``rates`` (n,) after Newton steps onto the curve, and what
        :meth:`~srm_mbs.dynamics.singularities.critical.CurveThroughSaddle.linearised` gives there.

        They take the closures alone, which cost a part of an evaluation.
        """
        left, last = PLACING_STEPS, self._distance(beta)
        while True:
            step, tangent, matrix = self._curve.linearised(place, beta, closed)
            off = float(np.abs(step).max())
            if not left or self._placed(beta, off) or not off <= CONVERGING * last:
                return place, rates, step, tangent, matrix
            last = off
            place = self.critical.geometry.move(place, step)
            rates = float(self._curve.along @ rates) * tangent
            left -= 1

    def _distance(self, beta: float) -> float:
        """Size of the displacement from the critical configuration at ``beta`` (units)."""
        return float(np.hypot(beta, self._curve.width))

    def _placed(self, beta: float, off: float) -> bool:
        """Whether a Newton step of the size ``off`` (units) leads to the curve at ``beta``, for the
        tolerance or to rounding."""
        distance = self._distance(beta)
        return off <= CONVERGED * self.rtol * distance + PLACE_ROUNDING / distance

    def _growth(self, place: FloatArray, tangent: FloatArray) -> float:
        """Derivative of beta along ``tangent`` (n,), of which the part along is 1."""
        system, geometry, nv = self.system, self.critical.geometry, self._nv
        if geometry.commutes:
            return 1.0
        unit, none = geometry.coordinate_unit, np.zeros(nv)
        away = geometry.difference(self.critical.q, place)
        delta, rate = (np.concatenate([x[:nv] * unit, none]) for x in (away, tangent))
        charted = system.chart_rate(delta, rate)[:nv] / unit
        return float(self._curve.along @ np.concatenate([charted, tangent[nv:]]))

    def _speed(self, node: Node, energy: float) -> float:
        """beta' of a motion with the kinetic ``energy`` (J), or with drives that of their time."""
        if self._driven:
            return float(1.0 / (node.tangent[-1] * self.critical.geometry.unit[-1]))
        return float(self._heading * np.sqrt(2.0 * energy / node.inertia))

    def _motion(self, node: Node, energy: float) -> tuple[FloatArray, FloatArray]:
        """State and tangent rate at a node."""
        q = node.place[:-1] if self._driven else node.place
        rates = self._speed(node, energy) * node.tangent[: self._nv]
        v = rates * self.critical.geometry.coordinate_unit
        return np.concatenate([q, v]), np.concatenate([v, node.acceleration])

    def _solved(self, node: Node, speed: float) -> bool:
        """Whether ``node`` is on the curve and was evaluated with the rates of the ``speed``, for
        the tolerance or to rounding."""
        rounding = PLACE_ROUNDING / (node.beta**2 + self._curve.width**2)
        rates = speed * node.tangent
        turned = float(np.abs(rates - node.rates).max() / np.abs(rates).max())
        return self._placed(node.beta, node.off) and turned <= TURNED * self.rtol + rounding

    def _panel(self, a: float, b: float) -> float:
        """Go on along the panel from ``a`` to ``b``, of xi times the heading, or only to a place
        beyond the end of the passage; where it led."""
        x, w, integrals = gauss_nodes(self._count)
        weights, own = np.vstack([integrals, w]), np.concatenate([[0.0], x, [1.0]])
        # Of the evaluation made last.
        mass = self.critical.geometry.mass()
        least, most = 0.0, np.inf
        if not (self._driven or self.exact):
            least = LEAST_ENERGY * self._energy if a >= LAYER else 0.0
            most = self._energy / LEAST_ENERGY if b <= -LAYER else np.inf
        elif self._bounded(a, b):
            least, most = LEAST_ENERGY * self._energy, self._energy / LEAST_ENERGY
        while True:
            xi = self._heading * (a + (b - a) * x)
            slope = self._width * np.cosh(xi) * self._heading * (b - a)
            betas = self._width * np.sinh(xi)
            start = self._width * np.sinh(self._heading * a)
            energy = self._energy + self._found[-1][0].power * (betas - start)
            if not ((energy > least) & (energy < most)).all():
                raise ValueError("the energy changes too much")
            predicted = [
                self._predicted(*one, mass) for one in zip(betas.tolist(), energy.tolist())
            ]
            t = self._clock + weights @ (slope / np.array([one[2] for one in predicted]))
            if not t[-1] > self.end:
                break
            length = CUT * bisected(own, np.concatenate([[self._clock], t]), self.end)
            if not length < CUT_FROM:
                break
            b = a + length * (b - a)
        places, rates = [one[0] for one in predicted], [one[1] for one in predicted]
        nodes = [self._evaluated(*one) for one in zip(places, betas.tolist(), rates, t.tolist())]
        for _ in range(SWEEPS):
            energies = self._energy + weights @ (slope * [node.power for node in nodes])
            if not ((energies > least) & (energies < most)).all():
                raise ValueError("the energy changes too much")
            speeds = [self._speed(*one) for one in zip(nodes, energies.tolist())]
            if not (np.array(speeds) * slope > 0.0).all():
                raise ValueError("the drives lead where the mechanism cannot follow")
            times = self._clock + weights @ (slope / speeds)
            left = [i for i, node in enumerate(nodes) if not self._solved(node, speeds[i])]
            if not left:
                break
            for i in left:
                here = nodes[i]
                nodes[i] = self._evaluated(
                    here.place, here.beta, speeds[i] * here.tangent, float(times[i])
                )
        else:
            raise ValueError("the collocation does not converge")
        for before, node in pairwise([self._found[-1][0], *nodes]):
            self._check_neighbours(before, node)
        if a >= LAYER:
            sigmas = np.array([node.sigma for node in (self._found[-1][0], *nodes)])
            if (sigmas < FALLING_SIGMA * np.maximum.accumulate(sigmas)).any():
                raise ValueError("the curve comes to another layer")
        energy, t = energies[:-1], times[:-1]
        begin, energy_at_begin = self._clock, self._energy
        self._energy, self._clock = float(energies[-1]), float(times[-1])
        if self._driven:  # known without any integral
            t = np.array([node.place[-1] for node in nodes])
        new = list(zip(nodes, energy.tolist(), t.tolist()))
        self._found += [one for one in new if self.t < one[-1] < self.end]
        if self._clock >= self.end:
            # The end of the run, or of its smooth interval, lies in the panel.
            clock = np.concatenate([[begin], times])
            at = bisected(own, clock, self.end)
            between = interpolated(own, np.concatenate([[energy_at_begin], energies]), at)
            beta = self._width * float(np.sinh(self._heading * (a + (b - a) * at)))
            if self._rounded(beta):
                self._found.append((self._between(nodes, at, beta), between, self.end))
            else:
                self._point(beta, between, self.end)
            if self._heading * beta < (1.0 - SMALLEST_REST) * abs(self._start):
                self.rest = PlaceOnCurve(
                    self.critical, self.exact, self._curve, self._start, beta, between
                )
        return b

    def _between(self, nodes: list[Node], at: float, beta: float) -> Node:
        """The node at ``beta``, a part ``at`` of the panel with the ``nodes``, by interpolation."""
        x, critical, n = gauss_nodes(self._count)[0], self.critical, len(self._curve.along)
        values = np.array(
            [
                [
                    *critical.geometry.difference(critical.q, node.place),
                    *node.tangent,
                    *(node.inertia, node.power, node.sigma),
                    *node.acceleration,
                ]
                for node in nodes
            ]
        )
        found = np.array([interpolated(x, column, at) for column in values.T])
        away, tangent, (inertia, power, sigma), acceleration = np.split(
            found, [n, 2 * n, 2 * n + 3]
        )
        return Node(
            place=critical.geometry.move(critical.q, away),
            beta=beta,
            tangent=tangent,
            rates=tangent,
            off=0.0,
            inertia=float(inertia),
            power=float(power),
            acceleration=acceleration,
            sigma=abs(float(sigma)),
        )

    def _point(self, beta: float, energy: float, t: float) -> None:
        """Go on to ``beta``, where the motion has the kinetic ``energy`` (J) at ``t`` (s); a
        residual that counts as zero is closed again where it can be."""
        mass = self.critical.geometry.mass()
        place, rates, _ = self._predicted(beta, energy, mass)
        for _ in range(SWEEPS):
            node = self._evaluated(place, beta, rates, t, self._closes(beta))
            speed = self._speed(node, energy)
            if self._solved(node, speed):
                break
            place, rates = node.place, speed * node.tangent
        else:
            raise ValueError("the end of the curve does not converge")
        self._check_neighbours(self._found[-1][0], node)
        self._found.append((node, energy, t))

    def _check_neighbours(self, before: Node, node: Node) -> None:
        """Refuse a ``node`` to which the tangents there and at the one ``before`` do not lead:
        closed configurations have other curves."""
        moved = self.critical.geometry.difference(before.place, node.place)
        led = 0.5 * (node.beta - before.beta) * (before.tangent + node.tangent)
        if not np.linalg.norm(moved - led) < LARGEST_DEVIATION * np.linalg.norm(led):
            raise ValueError("the configurations are on different curves")


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
    system: System,
    method: Method,
    norm: ErrorNorm,
    placement: str,
    tolerance: float,
) -> CriticalPassages | None:
    """The examination of the passages of a run; None where steps make them all: without closures,
    without automatic placement, in sweeps and in large mechanisms."""
    branch_system = system.branch_system
    if branch_system is None or not is_split(method) or placement != "automatic":
        return None
    if branch_system.nv > LARGEST:
        return None
    return CriticalPassages(branch_system, method.scheme, norm, tolerance)


def step_from_layer(mechanism: MechanismData, state: FloatArray) -> float:
    """The first step (s) after a motion that starts in a layer with ``state`` (nx,): a part of the
    time in which it leaves that, as it may turn back soon."""
    rates = state[mechanism.model.nq :] / structure_of(mechanism).units.coordinate
    return FIRST_PART * START_REACH / float(np.abs(rates).max())


def layer_motion(
    system: BranchSystem, t: float, state: FloatArray, tolerance: float, reach: float
) -> PlaceOnCurve | None:
    """The motion from ``state`` (nx,) at ``t`` (s) in the layer of a critical configuration, to be
    followed along the curve up to the distance ``reach`` (units) from that; None if there is none,
    or the residual is zero to rounding.

    With a residual up to ``tolerance`` (row units) the curve is the branch along which the rates
    lead.  The energy is that of the rates as they are: rounding turns them by more than it changes
    their size.
    """
    analysis = system.singularities
    q, v = analysis.split(state)
    geometry = analysis.geometry(analysis.q0, t)
    place, rates = geometry.at(q, t), geometry.rates(v)
    try:
        critical = critical_configuration(
            geometry, analysis.rank, place, SEARCH, (), STEPPED_RESIDUAL
        )
        if critical is None or not abs(critical.residual) > STEPPED_RESIDUAL:
            return None
        exact = not abs(critical.residual) > tolerance
        curve = CurveThroughSaddle(critical, place, exact, rates if exact else None)
        geometry.closure(place)
        along, own = float(curve.along @ rates), rates[: len(v)]
        energy = 0.5 * float(own @ geometry.mass() @ own)
        if exact and not geometry.drives:
            tangent = curve.hyperbola(curve.beta)[1] * geometry.coordinate_unit
            power = abs(float(tangent @ system.working_force(t, q, v)))
            if power * reach > SPENT_ENERGY * energy:
                reach = SPENT_ENERGY * energy / power
            if not reach > LAYERS_LEFT * curve.layer:
                return None
    except (ValueError, EvaluationError, np.linalg.LinAlgError):
        return None
    if along == 0.0 or not max(abs(curve.beta), curve.layer) < reach:
        return None
    begin = -float(np.sign(along)) * reach
    return PlaceOnCurve(critical, exact, curve, begin, curve.beta, energy, exact)


def leads_to_dead_point(critical: CriticalConfiguration, place: FloatArray) -> bool:
    """Whether drives lead the motion at ``place`` to a dead point in the layer of a ``critical``
    configuration: the curve turns back in time there."""
    try:
        curve = CurveThroughSaddle(critical, place, False)
    except (ValueError, np.linalg.LinAlgError):
        return False
    if not curve.width < DEAD_POINT_WIDTH:
        return False
    far = DEAD_POINT_WIDTHS * curve.width
    before, middle, after = (float(curve.hyperbola(x)[0][-1]) for x in (-far, 0.0, far))
    return max(before, after) < middle


class StepBeside(Enum):
    """Where a step leads beside a critical configuration that the closures avoid."""

    UNKNOWN = "not told by the hyperbolas"
    STAYS = "along its curve, on one side"
    PASSES = "along its curve, past the critical configuration"
    CHANGES = "to the other curve"


def _step_beside(critical: CriticalConfiguration, begin: FloatArray, end: FloatArray) -> StepBeside:
    sides, betas = [], []
    for place in (begin, end):
        try:
            curve = CurveThroughSaddle(critical, place, False)
        except (ValueError, np.linalg.LinAlgError):
            return StepBeside.UNKNOWN
        on, away = curve.hyperbola(curve.beta)[0], critical.geometry.difference(critical.q, place)
        kept = on - curve.beta * curve.along
        if not np.linalg.norm(away - on) < LARGEST_DEVIATION * np.linalg.norm(kept):
            return StepBeside.UNKNOWN
        sides.append(kept)
        betas.append(curve.beta)
    if float(sides[0] @ sides[1]) < 0.0:
        return StepBeside.CHANGES
    return StepBeside.PASSES if betas[0] * betas[1] < 0.0 else StepBeside.STAYS


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
    curve_limit
        Longest step (s) after one that led to another curve.
    """

    def __init__(
        self, system: BranchSystem, scheme: ButcherTableau, norm: ErrorNorm, tolerance: float
    ) -> None:
        self._system, self._scheme, self._norm = system, scheme, norm
        self._tolerance = exact_up_to(tolerance)
        self._known = self._quiet = False
        self._sigma = self._examine_below = np.inf
        self._rest: PlaceOnCurve | None = None
        self._found: list[CriticalConfiguration] = []
        self._avoided: CriticalConfiguration | None = None
        self._unresolved: ExaminedPassage | None = None
        self._dead_end = False
        self.curve_limit = np.inf
        self.examined: list[ExaminedPassage] = []

    @cached_property
    def _one_freedom(self) -> bool:
        """Whether the closed configurations are curves, which may be followed."""
        analysis = self._system.singularities
        return len(analysis.geometry(analysis.q0).unit) - analysis.rank == 1

    @property
    def under_way(self) -> bool:
        """Whether a passage stopped on its way; :meth:`steps_on` goes on with it."""
        return self._rest is not None

    def begin(self, t: float, state: FloatArray) -> bool:
        """Whether the motion from ``state`` (nx,) at ``t`` (s) starts in a layer, from where
        :meth:`steps_on` makes it."""
        if self._one_freedom:
            self._rest = layer_motion(self._system, t, state, self._tolerance, START_REACH)
        return self.under_way

    def crossing(self, state: FloatArray, result: StepResult) -> float | None:
        """When (s) the step of ``result`` from ``state`` (nx,) passes a singular configuration that
        has not been examined; None if it does not."""
        self._unresolved = None
        # A step across the middle of a passage may be quiet: sigma is the same at both ends.
        if self._known:
            return None
        lowest = int(np.argmin(result.sigmas))
        if not may_cross(result):
            return None
        if lowest == 0:
            # No step before the first one has seen sigma fall, and all its stages may lie beyond.
            first = np.isinf(self._sigma) and self._one_freedom
            return self._approached(state, result) if first else None
        abscissae = self._scheme.member(result.stiff).abscissae
        zero = zero_within(abscissae, result.sigmas)
        if zero is None or not 0.0 < zero <= 1.0:
            zero = float(abscissae[lowest])
        return float(result.t + zero * result.h)

    def _approached(self, state: FloatArray, result: StepResult) -> float | None:
        """When (s) the motion from ``state`` (nx,) comes to the critical configuration next to it;
        None if that is not within the step of ``result``."""
        analysis = self._system.singularities
        q, v = analysis.split(state)
        geometry = analysis.geometry(analysis.q0, result.t)
        place = geometry.at(q, result.t)
        critical = critical_configuration(
            geometry, analysis.rank, place, SEARCH, self._found, STEPPED_RESIDUAL
        )
        if critical is None:
            return None
        away, rates = geometry.difference(place, critical.q)[: len(v)], geometry.rates(v)[: len(v)]
        ahead = float(away @ rates / (rates @ rates))
        return result.t + ahead if 0.0 < ahead < result.h else None

    def unexamined(self, zero: float | None, t: float) -> float | None:
        """The ``zero`` (s) of sigma that is expected after ``t`` (s), unless it was examined."""
        if self._known or zero is None or not zero > t or not self._sigma < self._examine_below:
            return None
        return None if self._quiet and not self._one_freedom else zero

    def changes_curve(self, state: FloatArray, result: StepResult) -> bool:
        """Whether the step of ``result`` from ``state`` (nx,) is to be made again, shorter: it
        leads to the other one of the curves beside a critical configuration."""
        beside = self._beside(state, result)
        if beside is StepBeside.STAYS:
            self._unresolved = None
        if beside is not StepBeside.CHANGES:
            return False
        self.curve_limit = 0.5 * result.h
        return True

    def _beside(self, state: FloatArray, result: StepResult) -> StepBeside:
        """Where the step of ``result`` from ``state`` (nx,) leads beside the critical configuration
        that steps were to pass, or beside the one to which it turns back, if it started as near to
        that as it comes again."""
        if not self._one_freedom:
            return StepBeside.UNKNOWN
        if self._dead_end and result.sigmas.min() < EXAMINED_AGAIN * result.sigmas[-1]:
            return StepBeside.CHANGES  # up to the dead point sigma falls
        if not may_cross(result):
            return StepBeside.UNKNOWN
        system = self._system
        analysis = system.singularities
        geometry = analysis.geometry(analysis.q0, result.t)
        begin, end = (
            geometry.at(analysis.split(x)[0], t)
            for x, t in ((state, result.t), (result.state, result.t + result.h))
        )
        if int(np.argmin(result.sigmas)) == 0:
            before, after = (
                geometry.rates(rate[: system.nv])[: system.nv]
                for rate in (result.rates[0], result.end_rate)
            )
            if not float(before @ after) < 0.0:
                return StepBeside.UNKNOWN
            critical = critical_configuration(
                geometry, analysis.rank, begin, SEARCH, self._found, STEPPED_RESIDUAL
            )
            if critical is not None and not self._avoids(critical):
                critical = None
            self._avoided = critical
        if self._avoided is None:
            return StepBeside.UNKNOWN
        return _step_beside(self._avoided, begin, end)

    def _avoids(self, critical: CriticalConfiguration) -> bool:
        return abs(critical.residual) > self._tolerance

    def accepted(self, result: StepResult) -> None:
        """A step was accepted: where sigma rises, the next passage is another one."""
        self._quiet, self._sigma = result.quiet, float(result.sigmas[-1])
        self.curve_limit = np.inf
        self._dead_end = self._dead_end and not result.quiet
        if self._unresolved is not None:
            self.examined.append(self._unresolved)
        if result.sigmas[-1] > result.sigmas[0]:
            self._known, self._examine_below = False, np.inf

    def steps_past(
        self, t: float, state: FloatArray, rate: FloatArray, zero: float, end: float, expected: bool
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
        expected
            Whether the passage is only expected: no step was made that passes it.

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
        self._examine_below = EXAMINED_AGAIN * self._sigma
        geometry = analysis.geometry(analysis.q0, t)
        place = geometry.at(q, zero)
        critical = critical_configuration(
            geometry, analysis.rank, place, SEARCH, self._found, STEPPED_RESIDUAL
        )
        self._avoided = None
        if critical is None:
            return []
        begin = geometry.at(analysis.split(state)[0], t)
        left, covered = (geometry.difference(critical.q, x) for x in (place, begin))
        self._known = bool(np.linalg.norm(left) < PASSED * np.linalg.norm(covered))
        residual = critical.residual
        if abs(residual) > STEPPED_RESIDUAL and expected and np.linalg.norm(covered) > FARTHEST:
            self._known = False
            return []
        if abs(residual) <= STEPPED_RESIDUAL:
            # Steps pass it in any turn.  A passage along a curve depends on where a search begins,
            # and whether it ends: it has one of its own.
            if self._one_freedom and not geometry.drives and critical.geometry is geometry:
                self._found.append(critical)
            return []
        avoided, steps_pass = self._avoids(critical), False
        steps: list[tuple[StepResult, float]] = []
        try:
            passage = PassageAlongCurve(
                system, critical, t, state, end, not avoided, self._norm.rtol
            )
            steps = self._along(passage)
        except (ValueError, EvaluationError, np.linalg.LinAlgError):
            # Steps pass it as well as they can, and the message says so.  A motion that has
            # still to turn back is examined again.
            steps_pass = self._one_freedom
        found = ExaminedPassage(zero, residual, avoided, bool(steps))
        if self._known and steps_pass and not expected:
            self._unresolved = found
        self._known = self._known and not steps_pass
        if self._known or steps:
            self.examined.append(found)
        if steps_pass and avoided:
            self._avoided = critical
            if geometry.drives and leads_to_dead_point(critical, begin):
                self._dead_end = True
        if steps:
            self._dead_end = False
        return steps

    def steps_on(self, t: float, state: FloatArray, end: float) -> list[tuple[StepResult, float]]:
        """The steps of :meth:`steps_past` from where the passage stopped, at ``t`` (s)."""
        begun, self._rest = self._rest, None
        if begun is None:
            return []
        try:
            return self._along(
                PassageAlongCurve(
                    self._system,
                    begun.critical,
                    t,
                    state,
                    end,
                    begun.exact,
                    self._norm.rtol,
                    begun,
                )
            )
        except (ValueError, EvaluationError, np.linalg.LinAlgError):
            return []  # forces have changed, and it turns back

    def steps_to(self, t: float, state: FloatArray, end: float) -> list[tuple[StepResult, float]]:
        """The steps from ``state`` (nx,) at ``t`` (s), where one of a passage begins, to ``end``
        (s) within that step; none where the residual counts as zero.

        Dense output between the points of a layer is less accurate than they are.
        """
        self._rest = layer_motion(self._system, t, state, self._tolerance, SEARCH)
        return self.steps_on(t, state, end)

    def _along(self, passage: PassageAlongCurve) -> list[tuple[StepResult, float]]:
        """The ``passage`` as steps from node to node."""
        steps = [(self._step(passage, i), t) for i, t in enumerate(passage.times[1:].tolist())]
        self._rest = passage.rest
        if steps:
            self._known, self._quiet, self._examine_below = False, False, np.inf
            self._sigma = float(steps[-1][0].sigmas[-1])
        return steps

    def _step(self, passage: PassageAlongCurve, i: int) -> StepResult:
        """The step from node ``i`` to the next."""
        system, scheme = self._system, self._scheme
        times, states, rates, sigmas = passage.times, passage.states, passage.rates, passage.sigmas
        h = float(times[i + 1] - times[i])
        delta = system.difference(states[i], states[i + 1], h * rates[i])
        stages = np.tile(rates[i], (scheme.n_stages + 1, 1))
        if scheme.n_stages > 1:
            # Rates between the ends only say how far the step leads.
            first = float(scheme.b[0])
            stages[1:] = (delta / h - first * rates[i]) / (1.0 - first)
        stages[-1] = rates[i + 1]
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
            rank=system.singularities.rank,
            state_scale=system.state_scale(states[i + 1]),
            placement="critical",
        )

    def ended(self, t: float) -> None:
        """The run ended at ``t`` (s): steps did not make the passages that were expected later."""
        self.examined = [one for one in self.examined if one.resolved or one.time <= t]

    def message(self) -> str:
        """Sentences on the passages that the tolerance decided, or that could not be resolved."""
        residuals = [abs(one.residual) for one in self.examined if not one.avoided]
        by_tolerance = [residual for residual in residuals if residual > ROUNDED_RESIDUAL]
        unresolved = [one for one in self.examined if one.avoided and not one.resolved]
        missed = [one for one in unresolved if abs(one.residual) < WIDE]
        out = ""
        if by_tolerance:
            out += (
                f" {len(by_tolerance)} singular configurations with residuals up to "
                f"{max(by_tolerance):.1e} count as exact (singular_tolerance)."
            )
        if missed:
            out += (
                f" The mechanism avoids its singular configuration near t = "
                f"{time_text(missed[0].time)} s "
                f"(residual {missed[0].residual:.1e}) in a layer that the steps may not have "
                "resolved."
            )
        return out
