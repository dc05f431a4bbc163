"""Output of runs with output times, without their steps.

A run with ``t_eval`` keeps its steps up to :data:`KEPT_BYTES`; a longer one is read at its output
times block by block, while it is made, and keeps what it was asked for: states, angles, singular
configurations without momentum, joints that left their limits.  What needs the steps makes the run
again (:meth:`~srm_mbs.simulation.result.SimulationResult.steps`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.forces import over_half_turn
from srm_mbs.dynamics.multibody import ClosedSystem, OpenSystem
from srm_mbs.integration.dense_output import StepData, step_bytes, unwrapped_angles
from srm_mbs.integration.kernel.dense_output import dense_output
from srm_mbs.integration.methods.butcher import ButcherTableau
from srm_mbs.integration.singular_passages import Bifurcation, find_bifurcations

KEPT_BYTES = 8e6
"""Size of the steps that a run with output times keeps."""
BLOCK_BYTES = 2e6
"""Size of the steps that are read together."""
MOST_BLOCK_STEPS = 4000
GUARD_STEPS = 16
"""Steps beside a step from which its dense output may interpolate: the last ones of a block are
read with the next block."""


@dataclass(frozen=True)
class StreamedOutput:
    """Output of a run that did not keep its steps.

    Attributes
    ----------
    t : (n,) s, states : (n, nx)
        Output times and states.
    angles
        The angle (n,) rad at ``t`` of each joint that stores (cos, sin), by its index.
    span
        Start and end of the run (s).
    count, zone_steps
        Numbers of steps, and of those with a stage in the zone.
    least, largest : (nq,)
        Smallest and largest coordinates at the ends of steps.
    bifurcations
        Singular configurations that the run reached without momentum.
    over_half_turn
        Names of the bushings that turned by more than half a turn.
    stiff_intervals
        Starts and ends (s) of the intervals of stiff steps.
    """

    t: FloatArray
    states: FloatArray
    angles: dict[int, FloatArray]
    span: tuple[float, float]
    count: int
    zone_steps: int
    least: FloatArray
    largest: FloatArray
    bifurcations: tuple[Bifurcation, ...]
    over_half_turn: tuple[str, ...]
    stiff_intervals: list[tuple[float, float]]


def contiguous(parts: list[StepData]) -> StepData:
    """One set of steps, of parts that follow each other."""
    if len(parts) == 1:
        return parts[0]
    starts = np.cumsum([0, *(part.count for part in parts)]).tolist()
    joined: dict[str, Any] = {
        name: np.concatenate([getattr(part, name) for part in parts]) for name in _ROWS
    }
    return replace(
        parts[-1],
        **joined,
        times=np.concatenate([parts[0].times, *(part.times[1:] for part in parts[1:])]),
        states=np.concatenate([parts[0].states, *(part.states[1:] for part in parts[1:])]),
        zones={
            start + step: zone
            for start, part in zip(starts, parts)
            for step, zone in part.zones.items()
        },
        breaks=np.concatenate([part.breaks + start for start, part in zip(starts, parts)]),
    )


_ROWS = (
    *("rates", "corrections", "sigmas", "ranks", "error_ratios", "placements", "held"),
    *("stiff", "break_rates"),
)


def last_steps(data: StepData, count: int) -> StepData:
    """A copy of the last ``count`` steps of ``data``, or all."""
    first = max(0, data.count - count)
    later = data.breaks > first
    rows: dict[str, Any] = {
        name: getattr(data, name)[first:].copy() for name in _ROWS if name != "break_rates"
    }
    return replace(
        data,
        **rows,
        times=data.times[first:].copy(),
        states=data.states[first:].copy(),
        zones={step - first: zone for step, zone in data.zones.items() if step >= first},
        breaks=data.breaks[later] - first,
        break_rates=data.break_rates[later].copy(),
    )


class OutputStream:
    """Takes the steps of a run block by block.

    Parameters
    ----------
    system, scheme
        Equations and tableau of the run.
    t_eval : (n,) s
        Output times.
    made_by
        Backend of the run.
    """

    def __init__(
        self,
        system: OpenSystem | ClosedSystem,
        scheme: ButcherTableau,
        t_eval: FloatArray,
        made_by: str,
    ) -> None:
        self._system, self._scheme, self._t_eval = system, scheme, t_eval
        self._made_by = made_by
        size = step_bytes(scheme, system.tangent_size)
        self.block = int(np.clip(BLOCK_BYTES / size, 4 * GUARD_STEPS, MOST_BLOCK_STEPS))
        self._most_kept = max(self.block, int(KEPT_BYTES / size))
        self._parts: list[StepData] = []
        self._kept = 0
        self._dropped = False
        self._tail: StepData | None = None
        self._read = 0
        self._searched = -np.inf
        self._start = 0.0
        self._count = self._zone_steps = 0
        self._states: list[FloatArray] = []
        self._turning = [
            i for i, joint in enumerate(system.model.joints) if i and (joint.nq, joint.nv) == (2, 1)
        ]
        self._angles: dict[int, list[FloatArray]] = {i: [] for i in self._turning}
        self._known_angles: dict[int, float] = {}
        self._bifurcations: list[Bifurcation] = []
        self._turned: dict[str, None] = {}
        self._stiff: list[tuple[float, float]] = []
        self._least = np.full(system.nq, np.inf)
        self._largest = np.full(system.nq, -np.inf)

    def take(self, data: StepData) -> None:
        """The next steps of the run."""
        self._append(data)
        if self._dropped or self._kept > self._most_kept:
            self._drop(final=False)

    def _append(self, data: StepData) -> None:
        if not self._count:
            self._start = float(data.times[0])
        self._parts.append(data)
        self._kept += data.count
        self._count += data.count
        self._zone_steps += len(data.zones)
        for start, end in data.stiff_intervals:
            if self._stiff and self._stiff[-1][1] == start:
                start = self._stiff.pop()[0]
            self._stiff.append((start, end))

    def finish(self, data: StepData, failed: bool) -> StepData | StreamedOutput:
        """After the last steps: all steps if they were kept, else the output.

        ``failed``: whether the run could not go on.
        """
        self._append(data)
        if not self._dropped:
            return contiguous([part for part in self._parts if part.count] or [data])
        self._drop(final=True, failed=failed)
        t = self._t_eval[: self._read]
        shape = (len(t), self._system.nq + self._system.nv)
        return StreamedOutput(
            t,
            np.concatenate(self._states).reshape(shape),
            {i: np.concatenate(found) for i, found in self._angles.items()},
            (self._start, data.end),
            self._count,
            self._zone_steps,
            self._least,
            self._largest,
            tuple(self._bifurcations),
            tuple(self._turned),
            self._stiff,
        )

    def _drop(self, final: bool, failed: bool = False) -> None:
        """Read the steps that are here, and keep those only that the next ones need."""
        self._dropped = True
        tail = [] if self._tail is None else [self._tail]
        parts = [*tail, *(part for part in self._parts if part.count)]
        self._parts, self._kept = [], 0
        if not parts:
            return
        data = contiguous(parts)
        system = self._system
        work = system.evaluations, system.factorisations
        with system.everywhere():
            self._take_output(data, final, failed)
        # Reading between the ends of steps is no work of the run.
        system.count(work[0] - system.evaluations, work[1] - system.factorisations)
        self._tail = last_steps(data, 2 * GUARD_STEPS)

    def _take_output(self, data: StepData, final: bool, failed: bool) -> None:
        system, scheme = self._system, self._scheme
        dense = dense_output(system, scheme, data, self._made_by)
        until = data.end if final else float(data.times[-1 - GUARD_STEPS])
        count = int(np.searchsorted(self._t_eval, until, side="right"))
        t = self._t_eval[self._read : count]
        self._read = count
        states = dense(t)
        self._states.append(states)
        joints = system.model.joints
        next_start = max(0, data.count - 2 * GUARD_STEPS)
        for i in self._turning:
            ends = unwrapped_angles(
                joints[i],
                system.nq,
                data,
                scheme,
                data.times[[0, next_start]],
                data.states[[0, next_start]],
            )
            shift = self._known_angles.get(i, float(ends[0])) - float(ends[0])
            self._known_angles[i] = float(ends[1]) + shift
            own = unwrapped_angles(joints[i], system.nq, data, scheme, t, states)
            self._angles[i].append(own + shift)
        q = dense.nodes()[1][:, : system.nq]
        self._turned |= dict.fromkeys(over_half_turn(system.mechanism, q))
        self._least = np.minimum(self._least, q.min(axis=0))
        self._largest = np.maximum(self._largest, q.max(axis=0))
        found = find_bifurcations(system, data, lambda: dense, failed and final)
        self._bifurcations += [place for place in found if place.start > self._searched]
        self._searched = float(data.times[-1])
