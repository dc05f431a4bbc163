"""Runs whose state or mechanism was changed by the actions of events."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from operator import attrgetter
from typing import Any, Generic, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from srm_mbs._typing import FloatArray, IndexArray
from srm_mbs.dynamics.controllers import HeldForce
from srm_mbs.dynamics.point_motion import Place, PointMotion
from srm_mbs.errors import KnownKeys
from srm_mbs.integration.dense_output import StepData, check_within, checked_output_times
from srm_mbs.integration.driver import RunStatus
from srm_mbs.integration.singular_passages import Bifurcation, Crossing
from srm_mbs.model.lazy import cached_property
from srm_mbs.simulation.energy_balance import EnergyBalance, joined_balance
from srm_mbs.simulation.result import Settings, SimulationResult, Statistics

_STATISTICS = attrgetter(*(key.name for key in fields(Statistics)))


class SegmentedResult(SimulationResult):
    """Result of a run with event actions: smooth segments on one time axis.

    ``t``, ``q`` and ``v`` have two rows at each jump, before and after; dense output, ``t_eval``
    and :meth:`at` give the state after it.

    Attributes
    ----------
    segments
        The :class:`~srm_mbs.Solution` of each segment, with the mechanism that it had.
    mechanism
        That of the first segment.
    """

    def __init__(
        self,
        segments: Sequence[SimulationResult],
        *,
        t_eval: FloatArray | None,
        status: str,
        message: str,
    ) -> None:
        self._segments = tuple(segments)
        first = self.segments[0]
        self.mechanism = first.mechanism
        self.scheme = first.scheme
        self.status, self.message = RunStatus(status), message
        self.t_eval = t_eval
        self._parts: tuple[SimulationResult, ...] = self.segments
        self._order: IndexArray | slice = slice(None)
        if t_eval is not None:
            self._read_at(t_eval[t_eval <= self.segments[-1].steps.end])
        self._events = None
        if first.t_events is not None:
            of_parts = [part._events for part in self.segments if part._events is not None]
            times, states = (
                [np.concatenate(parts) for parts in zip(*(events[k] for events in of_parts))]
                for k in (0, 1)
            )
            self._events = times, states

    @property
    def segments(self) -> tuple[SimulationResult, ...]:
        """The smooth parts of the run, between the actions of events."""
        return self._segments

    @cached_property
    def settings(self) -> Settings:  # type: ignore[override]
        stiff = tuple(
            times
            for part in self.segments
            if np.logical_or.reduce(part.steps.stiff)
            for times in part.settings.stiff
        )
        return replace(self.segments[0].settings, stiff=stiff)

    @cached_property
    def attempts(self) -> NDArray[np.void]:  # type: ignore[override]
        attempts = [segment.attempts for segment in self.segments]
        return np.concatenate([some for some in attempts if len(some)] or attempts[:1])

    @cached_property
    def stats(self) -> Statistics:  # type: ignore[override]
        counts = zip(*(_STATISTICS(part.stats) for part in self.segments))
        return Statistics(*map(sum, counts))

    @cached_property
    def _nodes(self) -> tuple[FloatArray, FloatArray]:
        t = self.rows_of_parts(lambda part: part._nodes[0])
        return t, self.rows_of_parts(lambda part: part._nodes[1])

    @cached_property
    def _starts(self) -> FloatArray:
        """Times (s) at which the segments start."""
        return np.array([segment.steps.times[0] for segment in self.segments])

    def _read_at(self, t: FloatArray) -> None:
        """Read each segment at those of ``t`` that lie in it; at a jump the later segment."""
        index = np.clip(np.searchsorted(self._starts, t, side="right") - 1, 0, None)
        chosen = np.argsort(index, kind="stable")
        self._order = np.argsort(chosen, kind="stable")
        self._parts = tuple(segment.at(t[index == k]) for k, segment in enumerate(self.segments))

    def rows_of_parts(self, read: Callable[[Any], FloatArray]) -> FloatArray:
        """Rows that ``read`` returns for the segments, in the order of ``t``."""
        rows = self._ordered([read(part) for part in self._parts])
        rows.setflags(write=False)
        return rows

    def _ordered(self, rows: list[FloatArray]) -> FloatArray:
        joined: FloatArray = np.concatenate(rows)[self._order]
        return joined

    def __call__(self, t: Any) -> tuple[FloatArray, FloatArray]:
        """Dense output, right-continuous; see :class:`~srm_mbs.Solution`."""
        times = checked_output_times(t, scalar=True)
        found = self.at(np.atleast_1d(times))
        return (found.q[0], found.v[0]) if times.ndim == 0 else (found.q, found.v)

    def at(self, t: Any) -> Self:
        """The same run read at other times; see :meth:`~srm_mbs.Solution.at`."""
        times = checked_output_times(t)
        start, end = self.span
        check_within(times, start, end)
        run = type(self)(
            self.segments,
            t_eval=np.clip(times, start, end),
            status=self.status,
            message=self.message,
        )
        run.request, run.error = self.request, self.error
        return run

    def states(self, t: FloatArray, allowed: FloatArray | None = None) -> FloatArray:
        """As :meth:`at`: segments are short."""
        run = self.at(t)
        return np.concatenate((run.q, run.v), axis=1)

    def unwrapped(self, name: str, t: FloatArray, states: FloatArray) -> FloatArray:
        """See :meth:`~srm_mbs.simulation.result.SimulationResult.unwrapped`."""
        return self.at(t).joint(name)[0]

    @property
    def span(self) -> tuple[float, float]:
        """Start and end of the run (s)."""
        return float(self._starts[0]), self.segments[-1].steps.end

    @property
    def held(self) -> HeldForce | None:
        """Forces that a sampled controller held in the first segment; None without one."""
        return self.segments[0].held

    @cached_property
    def steps(self) -> StepData:  # type: ignore[override]
        """All steps, for plots; a jump is the end of a step."""
        return _joined([segment.steps for segment in self.segments])

    def joint(self, name: str) -> tuple[FloatArray, FloatArray]:
        """Position and rate of a one-degree joint; see :meth:`~srm_mbs.Solution.joint`."""
        pairs = [part.joint(name) for part in self._parts]
        positions = [position for position, _ in pairs]
        if self.mechanism.joint(name).nq > 1:
            # An angle goes on from where it was: which turn it is in is not in q.
            whole = [segment.joint(name)[0] for segment in self.segments]
            shift = 0.0
            for k in range(1, len(whole)):
                shift += 2.0 * np.pi * np.round((whole[k - 1][-1] - whole[k][0]) / (2.0 * np.pi))
                positions[k] = positions[k] + shift
        rates = [rate for _, rate in pairs]
        return self._ordered(positions), self._ordered(rates)

    def motion_of(self, place: Place) -> PointMotion:
        """See :meth:`~srm_mbs.Solution.motion_of`."""
        motions = [part.motion_of(place) for part in self._parts]
        return PointMotion(lambda which: self._ordered([getattr(m, which) for m in motions]))

    @cached_property
    def crossings(self) -> tuple[Crossing, ...]:
        """Passages through singular configurations, in order of time."""
        return tuple(c for segment in self.segments for c in segment.crossings)

    @cached_property
    def bifurcations(self) -> tuple[Bifurcation, ...]:
        """See :attr:`~srm_mbs.Solution.bifurcations`."""
        return tuple(b for segment in self.segments for b in segment.bifurcations)

    @cached_property
    def drift(self) -> FloatArray:
        """Closure errors (n, 2), of the closures that were there."""
        return self.rows_of_parts(lambda part: part.drift)

    @cached_property
    def energy(self) -> FloatArray:
        """Kinetic plus potential energy (n,) J."""
        return self.rows_of_parts(lambda part: part.energy)

    @cached_property
    def accelerations(self) -> FloatArray:
        """See :attr:`~srm_mbs.Solution.accelerations`."""
        return self.rows_of_parts(lambda part: part.accelerations)

    def closed_motion(self, consistent: float) -> tuple[FloatArray, FloatArray]:
        """See :meth:`~srm_mbs.simulation.result.SimulationResult.closed_motion`."""
        motions, sizes = zip(*(part.closed_motion(consistent) for part in self._parts))
        return self._ordered(list(motions)), self._ordered(list(sizes))

    @cached_property
    def energy_balance(self) -> EnergyBalance:
        """See :attr:`~srm_mbs.Solution.energy_balance`; what actions change is in ``events``."""
        return joined_balance(self.segments, self._parts, self._order)

    def _named(self, which: str) -> Mapping[str, FloatArray]:
        """A table of rows by name; 0 in the segments whose mechanism has not that name."""
        tables = [getattr(part, which) for part in self._parts]
        shapes = {name: rows.shape[1:] for table in tables for name, rows in table.items()}
        return KnownKeys(
            {
                name: self._ordered(
                    [
                        table.get(name, np.zeros((len(part.t), *shape)))
                        for table, part in zip(tables, self._parts)
                    ]
                )
                for name, shape in shapes.items()
            }
        )

    @cached_property
    def reactions(self) -> Mapping[str, FloatArray]:
        """See :attr:`~srm_mbs.Solution.reactions`; 0 while a closure is not there."""
        return self._named("reactions")

    @cached_property
    def reaction_multipliers(self) -> Mapping[str, FloatArray]:
        """See :attr:`~srm_mbs.Solution.reaction_multipliers`; 0 while a closure is not there."""
        return self._named("reaction_multipliers")

    @cached_property
    def joint_reactions(self) -> Mapping[str, FloatArray]:
        """See :attr:`~srm_mbs.Solution.joint_reactions`."""
        return self._named("joint_reactions")

    @cached_property
    def drive_forces(self) -> Mapping[str, FloatArray]:
        """See :attr:`~srm_mbs.Solution.drive_forces`; 0 while a drive is not there."""
        return self._named("drive_forces")

    @cached_property
    def drive_rates(self) -> Mapping[str, FloatArray]:
        """See :attr:`~srm_mbs.Solution.drive_rates`; 0 while a drive is not there."""
        return self._named("drive_rates")

    @cached_property
    def coupling_forces(self) -> Mapping[str, FloatArray]:
        """See :attr:`~srm_mbs.Solution.coupling_forces`; 0 while a coupling is not there."""
        return self._named("coupling_forces")

    @property
    def indeterminate_reactions(self) -> tuple[str, ...]:
        """See :attr:`~srm_mbs.Solution.indeterminate_reactions`; those of any segment."""
        rows = (row for segment in self.segments for row in segment.indeterminate_reactions)
        return tuple(dict.fromkeys(rows))

    @property
    def indeterminate_joint_reactions(self) -> tuple[str, ...]:
        """See :attr:`~srm_mbs.Solution.indeterminate_joint_reactions`; those of any segment."""
        found = (name for part in self.segments for name in part.indeterminate_joint_reactions)
        return tuple(dict.fromkeys(found))


_ROWS = ("rates", "sigmas", "ranks", "error_ratios", "placements", "held", "stiff")


def _joined(parts: Sequence[StepData]) -> StepData:
    """One set of steps; the states are those before the jumps."""
    width = max(part.corrections.shape[1] for part in parts)
    at = np.cumsum([0, *(part.count for part in parts)])

    def rows(name: str) -> FloatArray:
        return np.concatenate([getattr(part, name) for part in parts])

    return replace(
        parts[-1],
        times=np.concatenate(
            [parts[0].times[:1], *(np.append(part.times[:-1], part.end)[1:] for part in parts)]
        ),
        states=np.concatenate([parts[0].states[:1], *(part.states[1:] for part in parts)]),
        corrections=np.concatenate(
            [
                part.corrections if part.corrections.shape[1] else np.zeros((part.count, width))
                for part in parts
            ]
        ),
        zones={
            int(start) + step: zone
            for start, part in zip(at, parts)
            for step, zone in part.zones.items()
        },
        stop=None,
        breaks=np.concatenate([part.breaks + start for start, part in zip(at, parts)]),
        break_rates=rows("break_rates"),
        **{name: rows(name) for name in _ROWS},
    )


R = TypeVar("R", bound=SimulationResult)


@dataclass(frozen=True)
class ResultTypes(Generic[R]):
    """Classes of the results that a runner makes: of one segment, and of several."""

    plain: type[R]
    segmented: Callable[..., R]


RESULTS: ResultTypes[SimulationResult] = ResultTypes(SimulationResult, SegmentedResult)
"""Results without pictures and files."""
