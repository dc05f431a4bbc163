r"""Dense output: the state at any time of a run.

The Runge-Kutta extension of a step ends at the uncorrected point x^-; the correction (dq, dv) at
the step end is added as a smooth ramp,

    s = 3 theta^2 - 2 theta^3,  r = theta^3 - theta^2:   q += s dq + h r dv,   v += s dv,

so that the interpolant joins the corrected states with matching slopes and stays within
tolerance of the closures.  The extra stages of dop853 are evaluated only when a step is read.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache

import numpy as np

from srm_mbs.arrays import FloatArray, IndexArray
from srm_mbs.methods.base import StepResult
from srm_mbs.methods.butcher import ButcherTableau
from srm_mbs.methods.history import MultiplierHistory
from srm_mbs.stepping.hermite import HermiteStep, close_to_singular
from srm_mbs.stepping.reading_times import check_within
from srm_mbs.systems.base import System, Zone

PLACEMENTS = ("", "a priori", "redone")
"""How steps are placed around singular configurations; see
:class:`~srm_mbs.methods.base.StepResult`."""


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
        What was subtracted at each step end; (n, 0) without closures.
    sigmas : (n, s + 1)
        sigma at the stages and the end point.
    ranks : (n,)
        Smallest number of rows in use in the step.
    error_ratios : (n,)
        Error estimate over tolerance.
    placements : (n,)
        How the step was placed around a singular configuration: index into PLACEMENTS.
    held : (n,)
        1 for steps that lingered next to a singular configuration, held on their branch, else 0.
    end_rate : (m,)
        Tangent rate at the end of the last step.
    zones
        Step index -> (threshold, history) of the steps with a stage in the zone.
    stop
        Where a terminal event ended the run within the last step (s); None at the step's end.
    breaks : (k,)
        Numbers of the steps that end on a breakpoint, counted from 1: behind it rates are others.
    break_rates : (k, m)
        Tangent rates before those breakpoints.
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

    @property
    def end(self) -> float:
        """End of the run (s)."""
        return float(self.times[-1]) if self.stop is None else self.stop

    @property
    def count(self) -> int:
        """Number of steps."""
        return len(self.times) - 1

    def piece(self, step: int) -> tuple[int, int]:
        """First and last end of a step, as indices into ``times``, between the breakpoints around
        ``step``."""
        k = int(np.searchsorted(self.breaks, step, side="right"))
        first = int(self.breaks[k - 1]) if k else 0
        last = int(self.breaks[k]) if k < len(self.breaks) else self.count
        return first, last

    def rate_at(self, node: int, last: int) -> FloatArray:
        """Tangent rate (m,) at the end ``node`` of a step of the piece that ends at ``last``."""
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
        placements=np.array([PLACEMENTS.index(s.placement) for s in steps], dtype=float),
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
    )


def _corrections(steps: Sequence[StepResult]) -> FloatArray:
    """What was subtracted at the ends of the ``steps``; 0 where a method does not in every step."""
    size = max((s.correction.size for s in steps), default=0)
    nothing = np.zeros(size)
    rows = [s.correction if s.correction.size else nothing for s in steps]
    return np.array(rows).reshape(len(steps), size)


@lru_cache(maxsize=64)
def _abscissae(scheme: ButcherTableau) -> FloatArray:
    """Those of the stages, and of the end."""
    return np.append(scheme.c, 1.0)


class DenseOutput:
    """Evaluates the continuous extension of a run.

    Parameters
    ----------
    system
        Used for retraction, and for the extra stages of tableaus that have them.
    scheme
        The tableau of the run.
    steps
        The accepted steps.
    """

    def __init__(self, system: System, scheme: ButcherTableau, steps: StepData) -> None:
        self._system = system
        self._extension = scheme.dense
        self._abscissae = _abscissae(scheme)
        self._smooth: dict[int, HermiteStep] = {}
        self._steps = steps
        self._extra: dict[int, FloatArray] = {}

    def __call__(self, t: FloatArray) -> FloatArray:
        """States (k, nx) at the times ``t`` (k,), in any order.

        Raises
        ------
        ValueError
            If a time lies outside the run.
        """
        self.check(t)
        times = self._steps.times
        out = np.empty((len(t), self._steps.states.shape[1]))
        if self._steps.count == 0:
            out[:] = self._steps.states[0]
            return out
        index = np.clip(np.searchsorted(times, t, side="right") - 1, 0, self._steps.count - 1)
        for step in np.unique(index):
            here = index == step
            h = times[step + 1] - times[step]
            out[here] = self._in_step(int(step), (t[here] - times[step]) / h)
        return out

    def check(self, t: FloatArray) -> None:
        """Raise InputError if a time of ``t`` (k,) lies outside the run."""
        check_within(t, float(self._steps.times[0]), self._steps.end)

    def nodes(self) -> tuple[FloatArray, FloatArray]:
        """Times (n + 1,) and states (n + 1, nx) at the ends of the steps, the start first; the
        last ones at the end of the run."""
        data = self._steps
        if data.stop is None:
            return data.times, data.states
        times, states = data.times.copy(), data.states.copy()
        times[-1], states[-1] = data.stop, self(np.array([data.stop]))[0]
        return times, states

    def complete(self) -> StepData:
        """The steps with the rates of all stages that reading between them needs: for a reader
        that does not have the controller."""
        data, count = self._steps, self._extension.n_rates
        if not data.count or data.rates.shape[1] == count:
            return data
        rates = np.zeros((data.count, count, data.rates.shape[2]))
        rates[:, : data.rates.shape[1]] = data.rates
        for step, h in enumerate(np.diff(data.times)):
            if not self._between_neighbours(step):
                rates[step] = self._all_rates(step, h)
        return replace(data, rates=rates)

    @cached_property
    def _whole(self) -> FloatArray:
        """Weights of the rates over a whole step, as far as the steps have them: those of extra
        stages are zero."""
        weights: FloatArray = self._extension.weights(np.ones(1))[0]
        return weights[: self._steps.rates.shape[1]]

    def _between_neighbours(self, step: int) -> bool:
        """Whether a step is read from its neighbours (:mod:`.hermite`), not from its stages."""
        data = self._steps
        first, last = data.piece(step)
        return last - first > 1 and (
            step in data.zones or close_to_singular(self._abscissae, data.sigmas[step])
        )

    def _in_step(self, step: int, theta: FloatArray) -> FloatArray:
        data, system = self._steps, self._system
        if self._between_neighbours(step):
            if step not in self._smooth:
                self._smooth[step] = HermiteStep(system, data, step, self._whole)
            return self._smooth[step](theta)
        h = data.times[step + 1] - data.times[step]
        start = data.states[step]
        weights, rates = h * self._extension.weights(theta), self._all_rates(step, h)
        ramps = self._ramps(step, theta, h)
        states = []
        for k in range(len(theta)):
            # One at a time: how BLAS sums would depend on what else is read with it.
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
        rates: FloatArray = self._steps.rates[step]
        A, c = self._extension.extra_A, self._extension.extra_c
        if len(rates) == self._extension.n_rates:  # no extra stages, or evaluated by the method
            return rates
        if step not in self._extra:
            start, t = self._steps.states[step], self._steps.times[step]
            zone = None
            if step in self._steps.zones:
                threshold, history = self._steps.zones[step]
                zone = Zone(threshold, history.predict)
            full = np.vstack([rates, np.zeros((len(c), rates.shape[1]))])
            for i, ci in enumerate(c):
                delta = (h * A[i]) @ full
                terms = self._system.evaluate(t + ci * h, self._system.retract(start, delta), zone)
                full[len(rates) + i] = self._system.chart_rate(delta, terms.rate())
            self._extra[step] = full[len(rates) :]
        return np.vstack([rates, self._extra[step]])
