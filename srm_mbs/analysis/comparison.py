"""How far two runs of one mechanism are from each other, over time and joint by joint."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from srm_mbs.arrays import BoolArray, FloatArray, IndexArray
from srm_mbs.mechanism import Mechanism
from srm_mbs.solution import Solution
from srm_mbs.systems.units import turning_coordinates

STEP_ENDS = 2000
"""Most ends of steps at which two runs are compared."""
EVEN_TIMES = 501
"""Evenly spaced times at which they are compared as well: between the ends, by dense output."""
BESIDE_JUMP = 1e-9
"""Part of the run on either side of a jump of the state that is left out."""


@dataclass(frozen=True)
class JointDifference:
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
        How far the joint got from its start, and its largest rate.
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
class Comparison:
    """Two runs side by side.

    Attributes
    ----------
    t : (n,) s
        Where both were read.
    size : (n, 2)
        Largest difference of any coordinate in its unit: 1 rad, or the scene diagonal; and of any
        rate, those times the characteristic rate (:class:`srm_mbs.systems.units.Units`).
    joints
        The largest difference of each joint.
    jumps : (k,) s
        How far apart in time the jumps of the state are, of runs with event actions.
    """

    t: FloatArray
    size: FloatArray
    joints: tuple[JointDifference, ...]
    jumps: FloatArray

    @property
    def largest(self) -> float:
        """The largest of ``size``, positions and rates; 0 without any time."""
        return float(self.size.max(initial=0.0))

    def until(self, limit: float) -> float | None:
        """The time (s) from which on the runs are further apart than ``limit``; None if never."""
        beyond = np.flatnonzero((self.size > limit).any(axis=1))
        return float(self.t[beyond[0]]) if len(beyond) else None


def sample_times(solution: Solution, *, fixed: bool = False) -> FloatArray:
    """Times (n,) s at which a run is compared: ends of its steps, and evenly spaced ones.

    With ``fixed``, the ends only, where the method has its order.
    """
    start, end = solution.span
    ends = solution.steps.times
    ends = ends[(ends >= start) & (ends <= end)]
    if len(ends) > STEP_ENDS:
        ends = ends[np.unique(np.linspace(0, len(ends) - 1, STEP_ENDS).astype(int))]
    if fixed:
        return np.union1d(ends, [end])
    return np.union1d(ends, np.linspace(start, end, EVEN_TIMES))


def compare(run: Solution, other: Solution, times: FloatArray) -> Comparison:
    """Both runs at ``times`` (n,) s, as far as both go; windows around jumps of the state, which
    differ in time as well, are left out."""
    end = min(run.span[1], other.span[1])
    times = times[times <= end]
    allowed, jumps = _between_jumps(run, other, times)
    times = times[allowed]
    mechanism, model = run.mechanism, run.mechanism.model
    a, b = run.at(times), other.at(times)
    apart = _differences(model, a.q, b.q)
    moved = _differences(model, np.repeat(a.q[:1], len(times), axis=0), a.q)
    rates = b.v - a.v
    units = mechanism.structure.units
    for name in mechanism.joint_names:
        joint = mechanism.joint(name)
        if joint.nv == 1 and joint.nq > 1:  # its turns count
            angle, _ = a.joint(name)
            apart[:, joint.idx_v] = b.joint(name)[0] - angle
            moved[:, joint.idx_v] = angle - angle[:1]
    size = np.column_stack(
        [
            np.abs(apart / units.coordinate).max(axis=1, initial=0.0),
            np.abs(rates / (units.coordinate * units.rate)).max(axis=1, initial=0.0),
        ]
    )
    joints = tuple(
        JointDifference(name, unit, *(_largest(x[:, own]) for x in (apart, rates, moved, a.v)))
        for name, unit, own in _parts(mechanism)
    )
    return Comparison(times, size, joints, jumps)


def _parts(mechanism: Mechanism) -> Iterator[tuple[str, str, IndexArray]]:
    """(joint, unit, velocity indices): the lengths and the angles of each joint."""
    turns = turning_coordinates(mechanism.model)
    for name in mechanism.joint_names:
        joint = mechanism.joint(name)
        own = np.arange(joint.idx_v, joint.idx_v + joint.nv)
        for unit, chosen in (("m", own[~turns[own]]), ("rad", own[turns[own]])):
            if len(chosen):
                yield name, unit, chosen


def _differences(model: pin.Model, a: FloatArray, b: FloatArray) -> FloatArray:
    """b less a in tangent coordinates (n, nv), for configurations (n, nq)."""
    if model.nq == model.nv:
        return b - a
    rows = [pin.difference(model, *pair) for pair in zip(a, b)]
    return np.array(rows).reshape(len(rows), model.nv)


def _largest(rows: FloatArray) -> float:
    return float(np.linalg.norm(rows, axis=1).max(initial=0.0))


def _jump_times(run: Solution) -> Sequence[float]:
    return [segment.span[0] for segment in run.segments[1:]]


def _between_jumps(
    run: Solution, other: Solution, times: FloatArray
) -> tuple[BoolArray, FloatArray]:
    """Which times (n,) lie between the same jumps of both runs, and how far those are apart."""
    pairs = list(zip(_jump_times(run), _jump_times(other)))
    allowed = np.ones(len(times), dtype=bool)
    slack = BESIDE_JUMP * float(np.ptp(times)) if len(times) else 0.0
    for pair in pairs:
        allowed &= (times < min(pair) - slack) | (times > max(pair) + slack)
    more = [*_jump_times(run)[len(pairs) :], *_jump_times(other)[len(pairs) :]]
    if more:  # one run jumps there, the other does not
        allowed &= times < more[0]
    return allowed, np.array([abs(a - b) for a, b in pairs])
