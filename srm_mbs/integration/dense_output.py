r"""Dense output: the state at any time of a run, and angles followed through its steps.

The Runge-Kutta extension of a step ends at the uncorrected point x^-; the correction (dq, dv) at
the step end is added as a smooth ramp,

    s = 3 theta^2 - 2 theta^3,  r = theta^3 - theta^2:   q += s dq + h r dv,   v += s dv,

so that the interpolant joins the corrected states with matching slopes and stays within
tolerance of the closures.  The extra stages of dop853 are evaluated only when a step is read.

Where a step passes, or almost touches, a singular configuration, the rates of its stages carry the
rounding of the stage over its distance to that configuration, which the weights of a continuous
extension multiply.  The accepted states and their rates do not: they lie further away.  States
within such a step follow from Hermite interpolation (:class:`HermiteStep`): the polynomial through
the states and rates at the nearest ends of steps, in the chart at the start of the step.  Where a
step ends next to a slow turn its rates carry that rounding too; the polynomial that leaves such
ends out is taken if it is confirmed better.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, cast

import numpy as np

from srm_mbs._typing import BoolArray, FloatArray, IndexArray
from srm_mbs.dynamics.observables import Observables
from srm_mbs.dynamics.system import System, Zone
from srm_mbs.errors import EvaluationError, InputError, safe_repr
from srm_mbs.integration.methods.base import StepResult
from srm_mbs.integration.methods.branch_nodes import BRANCH_SIGMA
from srm_mbs.integration.methods.butcher import ButcherTableau
from srm_mbs.integration.methods.multiplier_history import MultiplierHistory
from srm_mbs.model.lazy import cached_property
from srm_mbs.model.numbers import finite_number

TIME_TOLERANCE = 1e-12
"""Largest distance of an output time beyond the ends of a run, over the time, for rounding."""
HERMITE_NODES = (4, 6, 8)
"""Numbers of ends of steps: polynomials of degree 7, 11 and 15."""
NODE_SPACING = 0.1
"""Smallest distance of the ends of steps that are used, over the length of the step: closer ones
would magnify their rounding."""
AWAY_REACH = 16
"""Steps to each side among whose ends those are looked for whose rates carry no rounding."""
LEAST_AWAY = 4
"""Fewest such ends that are used without the others."""
CLOSE_SIGMA = 1.0
"""Smallest sigma of a step, over the change of sigma in the step, below which the step is close to
a singular configuration."""
COMPARED_AT = np.array([0.25, 0.5, 0.75])
"""Fractions of the step at which polynomials are compared."""
STEP_PLACEMENTS = ("", "a priori", "redone", "critical")
"""How steps are placed around singular configurations; see
:class:`~srm_mbs.integration.methods.base.StepResult`."""
CRITICAL = STEP_PLACEMENTS.index("critical")


def checked_output_times(t: Any, *, scalar: bool = False) -> FloatArray:
    """Output times ``t`` (s) as a new array (k,), or () where a ``scalar`` is allowed.

    Raises
    ------
    InputError
        For more dimensions, or values that are not numbers.
    """
    try:
        times = np.array(t, dtype=float)
    except Exception:  # objects may raise anything
        raise InputError(
            f"t = {safe_repr(t)} does not consist of numbers", element="t", remedy="Give times"
        ) from None
    if times.ndim != 1 and not (scalar and times.ndim == 0):
        kinds = "a scalar or a vector of times" if scalar else "a vector of times"
        raise InputError(f"t has shape {times.shape}", element="t", remedy=f"Give {kinds}")
    return times


def check_within(t: FloatArray, start: float, end: float, unit: str = " s") -> None:
    """Refuse times ``t`` (k,) outside a run from ``start`` to ``end`` (s), of that ``unit``.

    Raises
    ------
    InputError
        If there are any.
    """
    tolerance = TIME_TOLERANCE * max(abs(start), abs(end))
    if len(t) and not (np.min(t) >= start - tolerance and np.max(t) <= end + tolerance):
        raise InputError(
            f"the run covers t = {start:.9g} to {end:.9g}{unit}, "
            f"asked for are {np.min(t):.9g} to {np.max(t):.9g}{unit}",
            element="t",
            remedy="Give times of the run",
        )


def checked_time(t: Any, start: float, end: float, element: str) -> float:
    """``t``, one time (s) of a run from ``start`` to ``end`` (s).

    Raises
    ------
    InputError
        About ``element``, if it is anything else.
    """
    number = finite_number(t, "t", element, "Give a time of the run")
    if not start <= number <= end:
        raise InputError(
            f"{number:g} s lies outside the run, from {start:g} to {end:g} s",
            element=element,
            remedy="Give a time of the run",
        )
    return number


def close_to_singular(abscissae: FloatArray, sigmas: FloatArray) -> BoolArray:
    """Whether stages of each step (abscissae (s + 1,) and sigma (..., s + 1)) lie close to a zero
    of sigma, compared with its change, or so close that only nodes of the branch solve them."""
    later = abscissae > 0.0
    with np.errstate(invalid="ignore"):  # infinite without closures
        changes = np.abs(sigmas[..., later] - sigmas[..., :1]) / abscissae[later]
    close = sigmas.min(axis=-1) < np.maximum(CLOSE_SIGMA * changes.max(axis=-1), BRANCH_SIGMA)
    out: BoolArray = np.isfinite(sigmas).all(axis=-1) & close
    return out


class HermiteStep:
    """The interpolant of one step.

    Degree 11 where degree 15 confirms it better than it confirms degree 7: between steps of very
    different lengths a higher degree is not better.  Past a critical configuration the motion is
    that of a hyperbola, smooth in asinh((t - t_c) / tau), with the time tau (s) of its layer around
    t_c; polynomials in that variable are taken where they are confirmed better.

    Parameters
    ----------
    system, steps, step
        The run, and the number of the step.
    scheme
        The tableau of the run.
    """

    def __init__(self, system: System, steps: StepData, step: int, scheme: ButcherTableau) -> None:
        self._system = system
        self._steps = steps
        self._step = step
        self._scheme = scheme
        # Rates jump at breakpoints: a polynomial ends there.
        self._interval = steps.smooth_interval(step)
        self._start = steps.states[step]
        self._h = steps.times[step + 1] - steps.times[step]
        best = np.inf
        ends = [self._nodes(count) for count in HERMITE_NODES]
        away = [self._away(count) for count in HERMITE_NODES]
        variants: list[tuple[FloatArray | None, list[list[int]]]] = [(None, ends)]
        if away != ends:
            variants.append((None, away))
        if steps.layers[step, 1] > 0.0:
            variants.append((steps.layers[step], ends))
        for layer, nodes in variants:
            polynomials = [self._through(own, layer) for own in nodes]
            values = [poly(self._variable(COMPARED_AT, layer)[0]) for poly in polynomials]
            changes = [float(np.abs(b - a).max()) for a, b in pairwise(values)]
            if min(changes) < best:
                best, self._layer = min(changes), layer
                self._polynomial = polynomials[1 if changes[1] <= changes[0] else 0]

    def _variable(self, theta: Any, layer: FloatArray | None) -> tuple[Any, Any]:
        """The variable of a polynomial at the fractions ``theta`` of the step, in a ``layer`` (2,)
        if there is one, and its derivative by the time in steps."""
        if layer is None:
            return theta, np.ones_like(theta)
        centre, width = layer
        beside = (self._steps.times[self._step] - centre + theta * self._h) / width
        return np.arcsinh(beside), self._h / width / np.hypot(1.0, beside)

    def _nodes(self, count: int, least_sigma: float = 0.0, reach: int | None = None) -> list[int]:
        """Indices of up to ``count`` ends of steps around the step, none too close together, with
        ``least_sigma`` at least, and no more than ``reach`` steps away."""
        times, near = self._steps.times, NODE_SPACING * self._h
        states, reachable = self._steps.states, self._system.reachable
        first, last = self._interval
        i, j = self._step, self._step + 1
        if reach is not None:
            first, last = max(first, i - reach), min(last, j + reach)
        before: list[int] = []
        after: list[int] = []
        while len(before) + len(after) < count and (i >= first or j <= last):
            left = i >= first and (j > last or len(before) <= len(after))
            node, own = (i, before) if left else (j, after)
            if not own or abs(times[own[-1]] - times[node]) >= near:
                if not reachable(self._start, states[node]):
                    first, last = (node + 1, last) if left else (first, node - 1)
                elif self._sigma(node) >= least_sigma:
                    own.append(node)
            i, j = (i - 1, j) if left else (i, j + 1)
        return sorted(before + after)

    def _away(self, count: int) -> list[int]:
        """Nodes as of :meth:`_nodes`, without ends whose rates may carry rounding; all if few
        others are near, or none on one side of the step: polynomials are no extrapolations."""
        away = self._nodes(count, BRANCH_SIGMA, AWAY_REACH)
        within = len(away) >= LEAST_AWAY and away[0] <= self._step < away[-1]
        return away if within else self._nodes(count)

    def _sigma(self, node: int) -> float:
        """sigma at an end of a step."""
        sigmas = self._steps.sigmas
        return float(sigmas[node, 0] if node < len(sigmas) else sigmas[-1, -1])

    def _moved(self, node: int) -> FloatArray:
        """Motion (m,) from the step to a node, in the charts of the steps between, whole turns
        included."""
        steps = self._steps
        own = slice(min(node, self._step), max(node, self._step))
        h = np.diff(steps.times[own.start : own.stop + 1])
        moved = np.zeros(steps.rates.shape[2])
        stiff = steps.stiff[own] > 0.0
        for kind in (False, True):
            chosen = stiff == kind
            if chosen.any():
                # Over a whole step, of the rates that there are.
                weights = self._scheme.member(kind).dense.rows[0, : steps.rates.shape[1]]
                rates = steps.rates[own][chosen, : len(weights)]
                moved += weights @ np.tensordot(h[chosen], rates, axes=1)
        return moved if node > self._step else -moved

    def _through(
        self, nodes: list[int], layer: FloatArray | None
    ) -> Callable[[FloatArray], FloatArray]:
        from scipy.interpolate import KroghInterpolator

        steps = self._steps
        last = self._interval[1]
        t0 = steps.times[self._step]
        points: list[float] = []
        values: list[FloatArray] = []
        for i in nodes:
            moved = self._moved(i) if self._system.wraps else None
            delta = self._system.difference(self._start, steps.states[i], moved)
            rate = steps.rate_at(i, last)
            at, growth = self._variable((steps.times[i] - t0) / self._h, layer)
            points += 2 * [float(at)]
            values += [delta, self._h / growth * self._system.chart_rate(delta, rate)]
        return KroghInterpolator(np.array(points), np.array(values))  # type: ignore[no-any-return]

    def __call__(self, theta: FloatArray) -> FloatArray:
        """States (k, nx) at the fractions ``theta`` (k,) of the step."""
        deltas = self._polynomial(self._variable(theta, self._layer)[0])
        return np.array([self._system.retract(self._start, delta) for delta in deltas])


def step_bytes(scheme: ButcherTableau, tangent_size: int) -> int:
    """Memory that a step takes, about: rates, and as much for states, corrections and sigmas."""
    return 8 * ((scheme.n_stages + 3) * tangent_size + 2 * scheme.n_stages)


@dataclass(frozen=True, eq=False)
class StepData:
    """The accepted steps of a run as arrays, n steps of a tableau with s stages.

    Attributes
    ----------
    times : (n + 1,) s
        Ends of the steps, the start first.
    states : (n + 1, nx)
        States there.
    rates : (n, s + 1, m) or (n, s + 1 + e, m)
        Chart rates of the stages and the end point; of the extra stages as well for methods that
        evaluate them in every step.
    corrections : (n, m)
        Corrections subtracted at each step end; (n, 0) without closures.
    sigmas : (n, s + 1)
        sigma at the stages and the end point.
    ranks : (n,)
        Smallest number of rows in use in the step.
    error_ratios : (n,)
        Error estimate over tolerance.
    placements : (n,)
        How the step was placed around a singular configuration: index into STEP_PLACEMENTS.
    held : (n,)
        1 for steps that lingered next to a singular configuration, held on their branch, else 0.
    end_rate : (m,)
        Tangent rate at the end of the last step.
    zones
        Step index -> (threshold, history) of the steps with a stage in the zone.
    stop
        Where a terminal event ended the run within the last step (s); None at the step's end.
    breaks : (k,)
        Numbers of the steps that end on a breakpoint, counted from 1: the rates jump there.
    break_rates : (k, m)
        Tangent rates before those breakpoints.
    stiff : (n,)
        1 for steps before which the problem had been found to be stiff, else 0: those of the
        tableau ``auto`` are then of its scheme for stiff problems.
    """

    times: FloatArray
    states: FloatArray
    rates: FloatArray
    corrections: FloatArray
    sigmas: FloatArray
    ranks: FloatArray
    error_ratios: FloatArray
    placements: FloatArray
    held: FloatArray
    end_rate: FloatArray
    zones: dict[int, tuple[float, MultiplierHistory]]
    stop: float | None = None
    breaks: IndexArray = field(default_factory=lambda: np.zeros(0, dtype=int))
    break_rates: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    stiff: FloatArray = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        if not len(self.stiff):
            object.__setattr__(self, "stiff", np.zeros(len(self.ranks)))
        if not len(self.breaks):
            object.__setattr__(self, "break_rates", np.zeros((0, len(self.end_rate))))

    def stage_times(self, scheme: ButcherTableau) -> FloatArray:
        """Times (n, s + 1) s of the stages and of the ends of the steps, those of ``sigmas``."""
        one, other = (scheme.member(stiff).abscissae for stiff in (False, True))
        abscissae = one if one is other else np.where(self.stiff[:, None] > 0.0, other, one)
        stages: FloatArray = self.times[:-1, None] + abscissae * np.diff(self.times)[:, None]
        return stages

    @property
    def stiff_intervals(self) -> list[tuple[float, float]]:
        """Starts and ends (s) of the intervals of stiff steps."""
        if not np.logical_or.reduce(self.stiff):
            return []
        edges = np.flatnonzero(np.diff(self.stiff, prepend=0.0, append=0.0)).tolist()
        return list(zip(self.times[edges[::2]].tolist(), self.times[edges[1::2]].tolist()))

    @property
    def end(self) -> float:
        """End of the run (s)."""
        return float(self.times[-1]) if self.stop is None else self.stop

    @property
    def count(self) -> int:
        """Number of steps."""
        return len(self.times) - 1

    @cached_property
    def critical_ranges(self) -> list[tuple[int, int]]:
        """First step, and the one after the last, of each passage past a critical configuration."""
        critical = self.placements == CRITICAL
        if not np.logical_or.reduce(critical):
            return []
        edges = np.flatnonzero(np.diff(critical, prepend=False, append=False)).tolist()
        return list(zip(edges[::2], edges[1::2]))

    @cached_property
    def between_nodes(self) -> list[int]:
        """The steps, ascending, that are known by the states and rates at their ends alone: those
        with a stage in the zone, and those past a critical configuration."""
        critical = [step for one in self.critical_ranges for step in range(*one)]
        return sorted({*self.zones, *critical}) if critical else sorted(self.zones)

    def with_stages(
        self,
        scheme: ButcherTableau,
        close: Callable[[FloatArray, FloatArray], BoolArray] = close_to_singular,
    ) -> BoolArray:
        """Which steps (n,) are explicit ones of ``scheme`` whose stages lie on the motion, to their
        order: away from singular configurations, of which ``close`` tells."""
        explicit = scheme.member(False)
        out = ~close(explicit.abscissae, self.sigmas)
        out &= (self.stiff == 0.0) & (explicit.implicit is None)
        out[self.between_nodes] = False
        return out

    @cached_property
    def layers(self) -> FloatArray:
        """Time and width (s) of the layer that a step belongs to (n, 2); width 0 without one.

        Past a critical configuration sigma^2 is a parabola; it leads through the lowest ends of the
        steps there.
        """
        out = np.zeros((self.count, 2))
        for first, last in self.critical_ranges:
            sigmas = np.append(self.sigmas[first:last, 0], self.sigmas[last - 1, -1])
            k = int(np.argmin(sigmas))
            if not 0 < k < last - first:
                continue
            t, f = self.times[first + k - 1 : first + k + 2], sigmas[k - 1 : k + 2] ** 2
            slopes = np.diff(f) / np.diff(t)
            bend = (slopes[1] - slopes[0]) / (t[2] - t[0])
            centre = 0.5 * (t[0] + t[1] - slopes[0] / bend)
            square = f[1] / bend - (t[1] - centre) ** 2
            if square > (NODE_SPACING * (t[2] - t[0])) ** 2:
                out[first:last] = centre, np.sqrt(square)
        return out

    def smooth_interval(self, step: int) -> tuple[int, int]:
        """First and last end of a step, as indices into ``times``, of the smooth interval around
        ``step``."""
        k = int(np.searchsorted(self.breaks, step, side="right"))
        first = int(self.breaks[k - 1]) if k else 0
        last = int(self.breaks[k]) if k < len(self.breaks) else self.count
        return first, last

    def rate_at(self, node: int, last: int) -> FloatArray:
        """Tangent rate (m,) at the end ``node`` of a step, of the smooth interval that ends at
        ``last``."""
        rate: FloatArray
        if node < last:
            rate = self.rates[node, 0]
        elif node == self.count:
            rate = self.end_rate
        else:
            rate = self.break_rates[int(np.searchsorted(self.breaks, node))]
        return rate


def step_data(
    t0: float,
    x0: FloatArray,
    times: Sequence[float],
    steps: Sequence[StepResult],
    scheme: ButcherTableau,
    tangent_size: int,
    stop: float | None = None,
    breaks: Sequence[int] = (),
) -> StepData:
    """The ``steps`` from (``t0``, ``x0``), which end at ``times``, as arrays."""
    n, stages = len(steps), scheme.n_stages + 1
    return StepData(
        times=np.array([t0, *times]),
        states=np.array([x0, *(s.state for s in steps)]),
        rates=np.array([s.rates for s in steps]).reshape(n, -1 if n else stages, tangent_size),
        corrections=_corrections(steps),
        sigmas=np.array([s.sigmas for s in steps]).reshape(n, stages),
        ranks=np.array([s.rank for s in steps], dtype=float),
        error_ratios=np.array([s.error_ratio for s in steps]),
        placements=np.array([STEP_PLACEMENTS.index(s.placement) for s in steps], dtype=float),
        held=np.array([s.held for s in steps], dtype=float),
        end_rate=np.array(steps[-1].end_rate if n else np.zeros(tangent_size)),
        zones={
            i: (s.zone.threshold, s.history)
            for i, s in enumerate(steps)
            if s.zone is not None and s.history is not None
        },
        stop=stop,
        breaks=np.array(breaks, dtype=int),
        break_rates=np.array([steps[i - 1].end_rate for i in breaks]).reshape(-1, tangent_size),
        stiff=np.array([s.stiff for s in steps], dtype=float),
    )


def _corrections(steps: Sequence[StepResult]) -> FloatArray:
    """Corrections at the ends of the ``steps``; 0 in steps that a method does not correct."""
    size = max((s.correction.size for s in steps), default=0)
    nothing = np.zeros(size)
    rows = [s.correction if s.correction.size else nothing for s in steps]
    return np.array(rows).reshape(len(steps), size)


class DenseOutput:
    """Evaluates the continuous extension of a run.

    Parameters
    ----------
    system
        Used for retraction, and for the extra stages of tableaus that have them.
    scheme
        The tableau of the run.
    steps
        The accepted steps, or a function that returns them when they are first read.
    end_state : (nx,)
        State at the end of the run, if it is known.

    Attributes
    ----------
    file
        The file that the steps are from; empty for a run of this program.
    """

    file = ""

    def __init__(
        self,
        system: System,
        scheme: ButcherTableau,
        steps: StepData | Callable[[], StepData],
        end_state: FloatArray | None = None,
    ) -> None:
        self._system = system
        self._end_state = end_state
        self._scheme = scheme
        self._smooth: dict[int, HermiteStep] = {}
        self._source = steps
        self._extra: dict[int, FloatArray] = {}

    @cached_property
    def _steps(self) -> StepData:
        return self._source if isinstance(self._source, StepData) else self._source()

    @cached_property
    def observables(self) -> Observables:
        """Quantities at many states of the mechanism of the run; other systems have none."""
        return Observables(cast(Any, self._system))

    def __call__(self, t: FloatArray) -> FloatArray:
        """States (k, nx) at the times ``t`` (k,), in any order.

        Raises
        ------
        InputError
            If a time lies outside the run; of a run from a file also if a stage of its steps cannot
            be evaluated.
        EvaluationError
            If a stage cannot be evaluated.
        """
        self.check(t)
        times = self._steps.times
        out = np.empty((len(t), self._steps.states.shape[1]))
        if self._steps.count == 0:
            out[:] = self._steps.states[0]
            return out
        index = np.clip(np.searchsorted(times, t, side="right") - 1, 0, self._steps.count - 1)
        # np.unique is slower, and aborts a program that ends while a daemon thread is in it.
        for step in sorted(set(index.tolist())):
            here = np.flatnonzero(index == step)
            theta = (t[here] - times[step]) / (times[step + 1] - times[step])
            out[here] = self._steps.states[step + (theta == 1.0)]
            inside = (theta != 0.0) & (theta != 1.0)
            if not inside.any():
                continue
            try:
                out[here[inside]] = self._in_step(step, theta[inside])
            except EvaluationError as error:
                if not self.file:
                    raise
                raise InputError(
                    f"the run cannot be read in the step from t = {times[step]:.9g}"
                    f"{self._system.time_unit}: {error}",
                    file=self.file,
                    remedy="Run the simulation again: the numbers in the file disagree",
                ) from error
        return out

    def between_ends(self, t: FloatArray, allowed: FloatArray) -> FloatArray:
        """States (k, nx) at the times ``t`` (k,), ascending, to within ``allowed`` (m,).

        The kernel takes polynomials through the ends of steps where two of them agree so far, which
        saves evaluations.

        Raises
        ------
        InputError, EvaluationError
            As a call.
        """
        return self(t)

    def check(self, t: FloatArray) -> None:
        """Raise InputError if a time of ``t`` (k,) lies outside the run."""
        times, unit = self._steps.times, self._system.time_unit
        check_within(t, float(times[0]), self._steps.end, unit)

    def nodes(self) -> tuple[FloatArray, FloatArray]:
        """Times (n + 1,) and states (n + 1, nx) at the ends of the steps, the start first; the
        last ones at the end of the run."""
        data = self._steps
        if data.stop is None:
            return data.times, data.states
        if self._end_state is None:
            self._end_state = self(np.array([data.stop]))[0]
        times, states = data.times.copy(), data.states.copy()
        times[-1], states[-1] = data.stop, self._end_state
        return times, states

    def complete(self) -> StepData:
        """The steps with the rates of all stages that dense output needs: for a reader without the
        controller."""
        data = self._steps
        count = max(self._scheme.member(stiff).dense.n_rates for stiff in (False, True))
        if not data.count or data.rates.shape[1] == count:
            return data
        rates = np.zeros((data.count, count, data.rates.shape[2]))
        rates[:, : data.rates.shape[1]] = data.rates
        for step, h in enumerate(np.diff(data.times)):
            if not self._between_neighbours(step):
                own = self._all_rates(step, h)
                rates[step, : len(own)] = own
        return replace(data, rates=rates)

    def _scheme_of(self, step: int) -> ButcherTableau:
        return self._scheme.member(bool(self._steps.stiff[step]))

    def _between_neighbours(self, step: int) -> bool:
        """Whether a step is interpolated between ends of steps (:class:`HermiteStep`)."""
        data = self._steps
        first, last = data.smooth_interval(step)
        if data.placements[step] == CRITICAL:
            return True
        return last - first > 1 and (
            step in data.zones
            or bool(close_to_singular(self._scheme_of(step).abscissae, data.sigmas[step]))
        )

    def _in_step(self, step: int, theta: FloatArray) -> FloatArray:
        data, system = self._steps, self._system
        if self._between_neighbours(step):
            if step not in self._smooth:
                self._smooth[step] = HermiteStep(system, data, step, self._scheme)
            return self._smooth[step](theta)
        h = data.times[step + 1] - data.times[step]
        start = data.states[step]
        weights = h * self._scheme_of(step).dense.weights(theta)
        rates = self._all_rates(step, h)
        ramps = self._ramps(step, theta, h)
        states = []
        for k in range(len(theta)):
            # One at a time: the order of BLAS sums would depend on the other times.
            x = system.retract(start, weights[k] @ rates)
            states.append(x if ramps is None else system.retract(x, ramps[k]))
        return np.array(states)

    def _ramps(self, step: int, theta: FloatArray, h: float) -> FloatArray | None:
        correction = self._steps.corrections[step]
        if not correction.size:
            return None
        s = theta**2 * (3.0 - 2.0 * theta)
        r = theta**2 * (theta - 1.0)
        slope = self._system.rate_change(-correction)
        return -np.outer(s, correction) + h * np.outer(r, slope)

    def _all_rates(self, step: int, h: float) -> FloatArray:
        extension = self._scheme_of(step).dense
        rates: FloatArray = self._steps.rates[step][: extension.n_rates]
        A, c = extension.extra_A, extension.extra_c
        if len(rates) == extension.n_rates:  # no extra stages, or evaluated by the method
            return rates
        if step not in self._extra:
            start, t = self._steps.states[step], self._steps.times[step]
            zone = None
            if step in self._steps.zones:
                threshold, history = self._steps.zones[step]
                zone = Zone(threshold, history.predict)
            full = np.vstack([rates, np.zeros((len(c), rates.shape[1]))])
            self._system.begin_step(t, start)
            for i, ci in enumerate(c):
                delta = (h * A[i]) @ full
                terms = self._system.evaluate(t + ci * h, self._system.retract(start, delta), zone)
                full[len(rates) + i] = self._system.chart_rate(delta, terms.rate())
            self._system.end_step()
            self._extra[step] = full[len(rates) :]
        return np.vstack([rates, self._extra[step]])


def unwrapped_angles(
    joint: Any, nq: int, steps: StepData, scheme: ButcherTableau, t: FloatArray, states: FloatArray
) -> FloatArray:
    """Angle (n,) rad of a (cos, sin) joint at ``t``, followed through every step of the run.

    Parameters
    ----------
    joint
        Pinocchio's joint model.
    nq
        Length of a configuration: the rates follow it in a state.
    steps, scheme
        The steps of the run, and the scheme that made them.
    t : (n,) s, states : (n, nq + nv)
        Times within the run, and the states there.
    """
    nodes, cos, sin = steps.states, joint.idx_q, joint.idx_q + 1
    principal = np.arctan2(nodes[:, sin], nodes[:, cos])
    here = np.arctan2(states[:, sin], states[:, cos])
    if not steps.count:
        return here
    # A long step may turn the joint by more than pi: its chart coordinate knows by how much.
    h = np.diff(steps.times)
    turned = h * (steps.rates[:, : scheme.n_stages, joint.idx_v] @ scheme.b)
    if steps.stiff.any():
        own = steps.stiff > 0.0
        other = scheme.member(True)
        turned[own] = h[own] * (steps.rates[own, : other.n_stages, joint.idx_v] @ other.b)
    unwrapped = principal[0] + np.concatenate([[0.0], np.cumsum(turned)])
    unwrapped = _nearest_turn(principal, unwrapped)
    step = np.clip(np.searchsorted(steps.times, t, side="right") - 1, 0, steps.count - 1)
    theta = (t - steps.times[step]) / h[step]
    return _nearest_turn(here, _between(unwrapped, nq, joint.idx_v, steps, step, theta))


def _nearest_turn(principal: FloatArray, guess: FloatArray) -> FloatArray:
    out: FloatArray = principal + 2.0 * np.pi * np.round((guess - principal) / (2.0 * np.pi))
    return out


def _between(
    unwrapped: FloatArray, nq: int, k: int, steps: StepData, step: IndexArray, theta: FloatArray
) -> FloatArray:
    """The angle (n,) at the fractions ``theta`` (n,) of the steps ``step`` (n,), by the polynomial
    of degree 5 through the angle ``unwrapped``, the rate v_k and its derivative at both ends of a
    step."""
    h, rate = np.diff(steps.times), steps.states[:, nq + k]
    place = steps.rates.shape[2] // 2 + k
    starts = steps.rates[:, 0, place]
    ends = np.append(starts[1:], steps.end_rate[place])
    if len(steps.breaks):
        ends[steps.breaks - 1] = steps.break_rates[:, place]
    v0, v1 = (h * rate[:-1])[step], (h * rate[1:])[step]
    a0, a1 = (h**2 * starts)[step], (h**2 * ends)[step]
    start, gain = unwrapped[step], np.diff(unwrapped)[step]
    # Differences from the Taylor polynomial at the start.
    p = gain - v0 - 0.5 * a0
    v = v1 - v0 - a0
    a = a1 - a0
    bend = 10.0 * p - 4.0 * v + 0.5 * a + theta * (-15.0 * p + 7.0 * v - a)
    bend += theta**2 * (6.0 * p - 3.0 * v + 0.5 * a)
    out: FloatArray = start + theta * (v0 + theta * (0.5 * a0 + theta * bend))
    return out
