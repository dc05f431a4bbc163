"""Estimate of the error of a run by comparison with reruns of other accuracy.

The difference to a tighter run approximates the error of the run if the error of the tighter one is
much smaller.  A third run between them verifies this: errors must decrease with the tolerance, or
with the order of the scheme.  Errors that all runs share are not observed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from srm_mbs._typing import BoolArray, FloatArray
from srm_mbs.analysis.accuracy.samples import sample_times
from srm_mbs.dynamics.observables import NO_ANGLES
from srm_mbs.dynamics.scaling import angle_coordinates, start_rounding
from srm_mbs.errors import InputError
from srm_mbs.integration.run_samples import RunSamples
from srm_mbs.model.lazy import cached_property
from srm_mbs.model.mechanism import MechanismData, per_model
from srm_mbs.model.numbers import positive_number
from srm_mbs.simulation.options import tightest_rtol
from srm_mbs.simulation.rerun import rerun
from srm_mbs.simulation.result import SimulationResult

READING_ERROR = 2e-3
"""Largest error of reading a rerun between its steps, over the tolerance of the one before it."""
READING_PART = 1e-3
"""The same, over the difference of the run from the tightest one, if that is larger."""
READING_MARGIN = 5.0
"""Difference of two runs, over that error, below which they are read by dense output."""
JUMP_MARGIN = 1e-9
"""Part of the run on either side of a jump of the state that is left out."""
TIGHTEST_RATIO = 1e-2
"""Tolerance of the tightest run over that of the run."""
INTERMEDIATE_RATIO = 3.0
"""Smallest factor between two tolerances for which a third run between them is made."""
DIFFERENT_RATIO = 1.5
"""Factor within which two tolerances are regarded as equal."""
ROUNDING = 1e-12
"""Difference of two runs (units) below which it is rounding, whose decrease is not observed."""
DISAGREEMENT = 0.05
"""Difference of two runs (units) from which they disagree about the position of the mechanism."""
AGREEMENT = 1e-3
"""Difference of two runs (units) below which they agree."""
SUDDEN = 0.3
"""Time between agreement and disagreement, times the characteristic rate, that is too short for
chaos."""
SMALLEST_ORDER = 0.5
"""Observed order from which the differences of fixed steps are extrapolated to step 0."""


class JointDifference(NamedTuple):
    """The largest difference of two runs in one joint.

    Attributes
    ----------
    joint
        Its name.
    unit
        ``rad`` or ``m``; a joint with both has two rows.
    position, rate
        Largest difference, in ``unit`` and ``unit``/s; of several coordinates the norm.
    travel, speed
        Largest distance of the joint from its start, and its largest rate.
    """

    joint: str
    unit: str
    position: float
    rate: float
    travel: float
    speed: float

    @property
    def relative_position(self) -> float | None:
        """``position`` over ``travel``; None where the joint did not move."""
        return self.position / self.travel if self.travel > 0.0 else None

    @property
    def relative_rate(self) -> float | None:
        """``rate`` over ``speed``; None where the joint did not move."""
        return self.rate / self.speed if self.speed > 0.0 else None


@dataclass(frozen=True, eq=False)
class Sizes:
    """Sizes of the differences of two runs.

    Attributes
    ----------
    t : (n,) s
        Times of comparison.
    size : (n, 2)
        Largest difference of any coordinate in its unit: 1 rad, or the scene diagonal; and of any
        rate, those times the characteristic rate (:class:`srm_mbs.dynamics.scaling.Units`).
    """

    t: FloatArray
    size: FloatArray

    @cached_property
    def largest(self) -> float:
        """The largest of ``size``, positions and rates; 0 without any time."""
        return float(self.size.max(initial=0.0))

    def until(self, limit: float) -> float | None:
        """The first time (s) at which ``size`` exceeds ``limit``; None if never."""
        beyond = self.size > limit
        return float(self.t[beyond.any(axis=1).argmax()]) if beyond.any() else None


@dataclass(frozen=True, eq=False)
class Comparison(Sizes):
    """Differences of two runs over time.

    Attributes
    ----------
    t, size
        As in :class:`Sizes`.
    joints
        The largest difference of each joint.
    jumps : (k,) s
        Differences in time of the jumps of the state, of runs with event actions.
    """

    joints: tuple[JointDifference, ...]
    jumps: FloatArray


@dataclass(frozen=True)
class Trial:
    """One of the runs that were compared.

    Attributes
    ----------
    setting
        Its relative tolerance, or its step (s).
    own
        Whether it is the run itself.
    steps, evaluations, wall_time
        Its work; s.
    status, end
        Status and time (s) of its end.
    difference
        Its largest difference to the tightest run, in units (:attr:`Comparison.size`), up to the
        time at which they disagree; None for the tightest run itself.
    """

    setting: float
    own: bool
    steps: int
    evaluations: int
    wall_time: float
    status: str
    end: float
    difference: float | None


@dataclass(frozen=True, eq=False)
class ErrorEstimate:
    """The error of a run, estimated from reruns.

    Attributes
    ----------
    fixed
        Whether the run has fixed steps: ``setting`` of the trials is then the step.
    trials
        The runs that were compared, the tightest last.
    joints
        The estimated error of each joint: the largest over the run, or up to ``apart``.
    size
        The largest of all in units (:attr:`Comparison.size`).
    bound
        Whether ``joints`` and ``size`` are bounds only, because the run itself is the tightest.
    order
        With fixed steps the observed order, from three steps; otherwise the slope of log error over
        log tolerance.  None if it cannot be observed.
    expected_order
        With fixed steps the order of the scheme, otherwise 1; None where theory gives none.
    apart
        The time (s) from which the runs disagree; None if they agree.
    branch
        The time (s) of a singular passage that they left on different branches; None if they agree.
    comparison
        Of the run with the tightest one or, if the run is the tightest, with the next looser one;
        over the time that both cover.
    """

    fixed: bool
    trials: tuple[Trial, ...]
    joints: tuple[JointDifference, ...] = field(repr=False)
    size: float
    bound: bool
    order: float | None
    expected_order: float | None
    apart: float | None
    branch: float | None
    comparison: Comparison = field(repr=False)


def checked_settings(solution: SimulationResult, rtol: float | None) -> list[float]:
    """Tolerances, or fixed steps, of the reruns, the tightest last.

    Raises
    ------
    InputError
        If ``rtol`` is no tolerance, is that of the run, or the run has fixed steps.
    """
    settings = solution.settings
    if settings.step is not None:
        if rtol is not None:
            raise InputError(
                f"the run has fixed steps of {settings.step:g} s: no tolerance decides its error",
                element="rtol",
                remedy="Leave rtol out: the run is repeated with half and a quarter of the step",
            )
        return [settings.step / 2.0, settings.step / 4.0]
    # By default no tolerance is so tight that rounding dominates.
    rounding = start_rounding(solution.mechanism).relative
    tightest = max(tightest_rtol(solution.scheme, True), rounding)
    tighter = max(TIGHTEST_RATIO * settings.rtol, tightest)
    other = tighter if rtol is None else positive_number(rtol, "rtol")
    if rtol is None and settings.rtol < INTERMEDIATE_RATIO * tightest:
        other = INTERMEDIATE_RATIO * settings.rtol  # a looser run gives a bound
    ratio = max(other / settings.rtol, settings.rtol / other)
    if ratio < DIFFERENT_RATIO:
        raise InputError(
            f"rtol = {other:g} is that of the run: two equal runs show no error",
            element="rtol",
            remedy=f"Give for example rtol={tighter:g}",
        )
    between = [math.sqrt(other * settings.rtol)] * (ratio > INTERMEDIATE_RATIO)
    return sorted([other, *between], reverse=True)


def estimate_error(
    solution: SimulationResult,
    settings: list[float],
    samples: Sequence[RunSamples],
    progress: Any,
) -> ErrorEstimate | str:
    """Repeat ``solution`` at each of ``settings``, and compare; or the reason why that failed.

    Parameters
    ----------
    samples
        Of each segment of ``solution``.
    """
    fixed = solution.settings.step is not None
    name = "step" if fixed else "rtol"
    runs = [(float(solution.settings.step or solution.settings.rtol), solution)]
    for setting in settings:
        options: dict[str, Any] = {name: setting}
        try:
            again = rerun(solution, **options, progress=progress)
        except InputError as error:
            return f"the run at {name} = {setting:.3g} was refused: {error}"
        if not again.stats.steps:
            return f"the run at {name} = {setting:.3g} did not start: {again.message}"
        runs.append((setting, again))
    runs.sort(key=lambda pair: pair[0], reverse=True)
    tightest = runs[-1][1]
    bound = tightest is solution
    partner = runs[-2][1] if bound else tightest
    known = times, _ = _sample_states(solution, samples)
    # A scheme has its order at the ends of steps only; the coarsest grid is a subset of the others.
    whole_grid = sample_times(runs[0][1], fixed=True) if fixed else times
    least = 0.0 if fixed else READING_ERROR * min(setting for setting, _ in runs[:-1])
    part = READING_PART
    readings = Readings(solution, known)
    while True:
        readings.allowed = least
        kept = whole = compare(solution, partner, times, readings)
        grid, apart = whole_grid, whole.until(DISAGREEMENT)
        if apart is not None:  # more times tell from when on they disagree
            times = np.union1d(times, sample_times(solution))
            whole = compare(solution, partner, times, readings)
            apart = whole.until(DISAGREEMENT) or apart
            grid = whole_grid if fixed else times
            kept = compare(solution, partner, times[times < apart], readings)
            grid = grid[grid < apart]
        if least:
            readings.allowed = max(least, part * kept.largest)
        differences = [
            # Adaptive runs were compared with their partner on this grid already.
            kept.largest
            if {id(run), id(tightest)} == {id(solution), id(partner)} and not fixed
            else compare(run, tightest, grid, readings).largest
            for _, run in runs[:-1]
        ]
        if not least or min(differences) > READING_MARGIN * readings.allowed:
            break
        # Smaller ones take closer readings.
        least, part = (least, 0.0) if readings.allowed > least else (0.0, 0.0)
    compared = kept.comparison()
    comparison = compared if kept is whole else whole.comparison()
    order = observed_order([setting for setting, _ in runs], differences)
    beyond = 1.0
    if fixed and order is not None and order > SMALLEST_ORDER:
        beyond = 1.0 / (1.0 - 4.0**-order)
    trials = [
        Trial(
            setting,
            run is solution,
            run.stats.steps,
            run.stats.evaluations,
            run.stats.wall_time,
            run.status,
            run.span[1],
            difference,
        )
        for (setting, run), difference in zip(runs, [*differences, None])
    ]
    return ErrorEstimate(
        fixed,
        tuple(trials),
        compared.joints
        if beyond == 1.0
        else tuple(
            row._replace(position=beyond * row.position, rate=beyond * row.rate)
            for row in compared.joints
        ),
        beyond * kept.largest,
        bound,
        order,
        _expected(solution, fixed),
        apart,
        None if apart is None else parted_at(comparison, solution, partner),
        comparison,
    )


def _sample_states(
    solution: SimulationResult, samples: Sequence[RunSamples]
) -> tuple[FloatArray, FloatArray]:
    """Times (n,) s, ascending, at which runs are compared, and the states (n, nq + nv) of
    ``solution``."""
    if len(samples) > 1:
        times = sample_times(solution)
        return times, solution.states(times)
    ((times, states, _, whole),) = samples
    return times[:whole], states[:whole]


def observed_order(settings: Sequence[float], differences: Sequence[float]) -> float | None:
    """Order p of errors c s^p at three settings s in the ratio 1 : r : r^2.

    The differences to the last are c s^p (1 - r^2p) and c s^p (r^p - r^2p); their quotient is
    r^-p + 1.
    """
    if len(differences) < 2 or min(differences[:2]) < ROUNDING:
        return None
    quotient = differences[0] / differences[1] - 1.0
    if quotient <= 1.0:
        return 0.0
    return math.log(quotient) / math.log(settings[0] / settings[1])


def _expected(solution: SimulationResult, fixed: bool) -> float | None:
    if not fixed:
        return 1.0
    return float(solution.scheme.order) if solution.is_split else None


def parted_at(whole: Comparison, run: SimulationResult, other: SimulationResult) -> float | None:
    """The singular passage (s) at which two runs left on different branches.

    The rates differ suddenly there; otherwise small differences grow over many times 1/rate.
    """
    rates = whole.size[:, 1]
    beyond = np.flatnonzero(rates > DISAGREEMENT)
    if not len(beyond):
        return None
    near = np.flatnonzero(rates[: beyond[0]] < AGREEMENT)
    if not len(near):
        return None
    before, after = float(whole.t[near[-1]]), float(whole.t[beyond[0]])
    if (after - before) * run.mechanism.structure.units.rate > SUDDEN:
        return None
    slack = after - before
    met = [c.time for c in (*run.crossings, *other.crossings)]
    met += [b.start for b in (*run.bifurcations, *other.bifurcations)]
    return next((t for t in met if before - slack <= t <= after + slack), None)


# Comparison of two runs ----------------------------------------------------------------------


class Readings:
    """Runs read at times of comparison: ``solution`` by its dense output, and its reruns within a
    part of the tolerance, each once.

    Parameters
    ----------
    solution
        The run whose error is estimated.
    known
        Times (n,) s and the states (n, nq + nv) of ``solution`` there, if they have been read.

    Attributes
    ----------
    allowed
        Largest error of reading a rerun from now on, in units; 0 to read by dense output.
    """

    def __init__(
        self, solution: SimulationResult, known: tuple[FloatArray, FloatArray] | None = None
    ) -> None:
        self.allowed = 0.0
        self._solution = solution
        # Of each run and times, what was allowed and the states.
        self._known: dict[tuple[int, bytes], tuple[float, FloatArray]] = {}
        if known is not None:
            self._known[id(solution), known[0].tobytes()] = 0.0, known[1]

    def __call__(self, run: SimulationResult, times: FloatArray) -> FloatArray:
        """States (n, nq + nv) at the ``times`` (n,) s."""
        allowed = 0.0 if run is self._solution else self.allowed
        key = id(run), times.tobytes()
        found = self._known.get(key)
        if found is None or found[0] > allowed:
            errors = allowed * run.mechanism.structure.units.state if allowed else None
            found = self._known[key] = allowed, run.states(times, errors)
        return found[1]


@dataclass(frozen=True, eq=False)
class Differences(Sizes):
    """Differences of two runs at n times.

    Attributes
    ----------
    t, size
        As in :class:`Sizes`.
    jumps
        As in :class:`Comparison`.
    norms
        The largest norm at any time of the motion from one to the other of each of k parts of the
        joints (:class:`Parts`), and then of the change of the rates of each.
    states : (n, nq + nv)
        Those of the first one.
    run
        The first one.
    """

    jumps: FloatArray
    norms: list[float]
    states: FloatArray
    run: SimulationResult

    def comparison(self) -> Comparison:
        """With the largest difference of each joint."""
        run, start = self.run, self.states[:1].copy()
        start[:, run.mechanism.model.nq :] = 0.0  # differences from there are the rates themselves
        parts = _parts(run.mechanism)
        angles = [
            angle - angle[:1]
            for angle in (run.unwrapped(name, self.t, self.states) for name in parts.turned)
        ]
        _, norms = _largest(run, start, self.states, angles)
        count = len(parts.names)
        numbers = zip(self.norms[:count], self.norms[count:], norms[:count], norms[count:])
        joints = tuple(JointDifference(*own, *each) for own, each in zip(parts.names, numbers))
        return Comparison(self.t, self.size, joints, self.jumps)


def compare(
    run: SimulationResult, other: SimulationResult, times: FloatArray, read: Readings
) -> Differences:
    """Differences of two runs at those of ``times`` (n,) s, ascending, that both cover.

    Windows around jumps of the state, whose times differ, are left out.
    """
    times = times[: times.searchsorted(min(run.span[1], other.span[1]), side="right")]
    jumps = np.zeros(0)
    if len(run.segments) > 1 or len(other.segments) > 1:
        allowed, jumps = _between_jumps(run, other, times)
        times = times[allowed]
    a, b = read(run, times), read(other, times)
    angles = [
        other.unwrapped(name, times, b) - run.unwrapped(name, times, a)
        for name in _parts(run.mechanism).turned
    ]
    size, norms = _largest(run, a, b, angles)
    return Differences(times, size, jumps, norms, a, run)


def _largest(
    run: SimulationResult, a: FloatArray, b: FloatArray, angles: list[FloatArray]
) -> tuple[FloatArray, list[float]]:
    """Sizes (n, 2) of the differences of the states a (n, nx) or (1, nx) and b (n, nx) of ``run``
    or another one, and norms of their parts; ``angles``: those (n,) of each joint of
    :attr:`Parts.turned`."""
    parts, units = _parts(run.mechanism), run.mechanism.structure.units.state
    turned = [*parts.turned.values()], np.column_stack(angles) if angles else NO_ANGLES
    observables = run.segments[0].observables
    return observables.largest_differences(a, b, units, parts.order, parts.starts, *turned)


@dataclass(frozen=True, eq=False)
class Parts:
    """The lengths and the angles of each joint.

    Attributes
    ----------
    names
        Joint and unit of each part.
    order : (2 nv,)
        Indices of their coordinates, one part after the other, and those of their rates.
    starts
        Where the coordinates and the rates of each begin in ``order``.
    turned
        Velocity index, by name, of each joint whose angle is stored as cosine and sine.
    """

    names: list[tuple[str, str]]
    order: list[int]
    starts: list[int]
    turned: dict[str, int]


@per_model
def _parts(mechanism: MechanismData) -> Parts:
    """The parts of all joints."""
    turns = angle_coordinates(mechanism.model)
    names, indices, turned = [], [], {}
    for name in mechanism.joint_names:
        joint = mechanism.joint(name)
        if joint.nv == 1 and joint.nq > 1:
            turned[name] = joint.idx_v
        own = np.arange(joint.idx_v, joint.idx_v + joint.nv)
        for unit, chosen in (("m", own[~turns[own]]), ("rad", own[turns[own]])):
            if len(chosen):
                names.append((name, unit))
                indices.append(chosen)
    indices += [mechanism.model.nv + own for own in indices]
    starts = np.cumsum([0, *(len(own) for own in indices[:-1])])
    return Parts(names, np.concatenate(indices).tolist(), starts.tolist(), turned)


def _jump_times(run: SimulationResult) -> Sequence[float]:
    return [segment.span[0] for segment in run.segments[1:]]


def _between_jumps(
    run: SimulationResult, other: SimulationResult, times: FloatArray
) -> tuple[BoolArray, FloatArray]:
    """Which times (n,) lie between the same jumps of both runs, and the differences in time (k,) s
    of the jumps."""
    pairs = list(zip(_jump_times(run), _jump_times(other)))
    allowed = np.ones(len(times), dtype=bool)
    slack = JUMP_MARGIN * float(np.ptp(times)) if len(times) else 0.0
    for pair in pairs:
        allowed &= (times < min(pair) - slack) | (times > max(pair) + slack)
    more = [*_jump_times(run)[len(pairs) :], *_jump_times(other)[len(pairs) :]]
    if more:  # only one of the runs jumps there
        allowed &= times < more[0]
    return allowed, np.array([abs(a - b) for a, b in pairs])
