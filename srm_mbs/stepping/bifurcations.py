"""Where a run came to a singular configuration without the momentum to pass it.

Several branches of the motion meet at a singular configuration, and momentum chooses one.  A
motion that comes to rest there, or turns back so close to it that its error could decide, has no
unique continuation.  The run keeps the branch it came along; what it could not know is listed here.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from srm_mbs.arrays import FloatArray
from srm_mbs.stepping.crossings import Crossing, Watched, passage_at
from srm_mbs.stepping.dense import DenseOutput, StepData
from srm_mbs.systems.multibody import ClosedSystem, OpenSystem
from srm_mbs.systems.singular import SingularConfiguration, nearest_singular

LOOKED_AT = 0.02
"""sigma below which a motion that turns back is looked at."""
UNDECIDED = 100.0
"""Distance to the singular configuration (units), over rtol, below which errors could decide."""
SLOW = 0.01
"""Part of the largest speed of a run below which its end is without momentum."""
WITHIN = 0.05
"""How far (units) the singular configuration is looked for."""
SAMPLES = 21


@dataclass(frozen=True)
class Bifurcation:
    """A singular configuration that was reached without the momentum to choose a branch.

    Attributes
    ----------
    start, end
        Time (s) at which the motion came so close, and left or ended.
    distance
        Smallest distance to the singular configuration (rad, scene diagonals).
    stopped
        Whether the run ended there because it could not go on.
    """

    start: float
    end: float
    distance: float
    stopped: bool
    _passage: Crossing = field(repr=False, compare=False)

    @property
    def singular(self) -> SingularConfiguration | None:
        """Its local analysis; None if none was found close to the motion."""
        return self._passage.singular

    @property
    def configuration(self) -> FloatArray | None:
        """The singular configuration (nq,)."""
        return self._passage.configuration

    @property
    def loops(self) -> tuple[str, ...]:
        """Names of the loops whose rows lose rank there."""
        return self._passage.loops

    @property
    def drives(self) -> tuple[str, ...]:
        """Names of the drives whose rows do so with them."""
        return self._passage.drives

    @property
    def branches(self) -> FloatArray:
        """Velocity directions (k, nv) of the branches that meet there; see
        :attr:`~srm_mbs.stepping.crossings.Crossing.branches`."""
        return self._passage.branches

    @property
    def kept(self) -> int | None:
        """Index in ``branches`` of the branch that the run came along and kept; None if it cannot
        be told."""
        return self._passage.arrived_on

    def __str__(self) -> str:
        span = f"From t = {self.start:.6g} to {self.end:.6g} s the motion stayed"
        moment = f"At t = {self.start:.6g} s the motion turned back"
        kept = "" if self.kept is None else f", number {self.kept}"
        did = "stopped there" if self.stopped else f"kept the one it came along{kept}"
        return (
            f"{span if self.end > self.start else moment} next to a singular "
            f"configuration of {self._passage.participants} without the "
            f"momentum to choose one of the {len(self.branches)} branches that meet there: the run "
            f"{did} (solution.bifurcations)"
        )


def _turns_back(nq: int, steps: StepData, unit: FloatArray) -> set[int]:
    """Indices of the steps next to a singular configuration in which the motion reverses."""
    v = steps.states[:, nq:] / unit
    reverses = (v[:-1] * v[1:]).sum(axis=1) <= 0.0
    close = steps.sigmas.min(axis=1) < LOOKED_AT
    return set(np.flatnonzero(reverses & close).tolist())


def _slow(nq: int, steps: StepData, unit: FloatArray) -> bool:
    """Whether the run ends slowly, compared with its fastest: one that cannot go on while it moves
    has another trouble than its momentum."""
    speeds = np.linalg.norm(steps.states[:, nq:] / unit, axis=1)
    return bool(speeds[-1] <= SLOW * speeds.max())


def _ranges(marked: list[int], steps: StepData) -> list[tuple[int, int]]:
    """First and last of the ``marked`` steps between which the motion does not get away."""
    out: list[tuple[int, int]] = []
    for i in marked:
        if out and steps.sigmas[out[-1][1] : i + 1].max() < LOOKED_AT:
            out[-1] = (out[-1][0], i)
        else:
            out.append((i, i))
    return out


def _closest(watched: Watched, t: FloatArray) -> float:
    """When, within the times t (SAMPLES,), sigma is smallest."""
    sigma = watched.smallest(t)
    k = int(np.argmin(sigma))
    if 0 < k < SAMPLES - 1:
        return watched.minimum(t[k - 1 : k + 2], sigma[k - 1 : k + 2])[0]
    return float(t[k])


def _turn(watched: Watched, t: FloatArray) -> float:
    """When, within the times t (k,), the motion turns back."""
    from scipy.optimize import brentq

    unit = watched.geometry.coordinate_unit

    def rates(times: FloatArray) -> FloatArray:
        return np.array([v for _, v in watched.states(times)]) / unit

    ends = rates(t[[0, -1]])
    direction = ends[0] - ends[1]

    def along(time: float) -> float:
        return float(rates(np.array([time]))[0] @ direction)

    values = rates(t) @ direction
    changes = np.flatnonzero(values[:-1] * values[1:] < 0.0)
    if not len(changes):
        return float(t[np.argmin(np.abs(values))])
    k = int(changes[0])
    return float(brentq(along, t[k], t[k + 1], xtol=1e-12 * (t[-1] - t[0]), rtol=1e-15))


def find_bifurcations(
    system: OpenSystem | ClosedSystem,
    steps: StepData,
    dense: DenseOutput,
    rtol: float,
    failed: bool,
) -> tuple[Bifurcation, ...]:
    """The singular configurations that a run reached without momentum, in order of time.

    Parameters
    ----------
    failed
        Whether the run could not go on from its last state.
    """
    if not isinstance(system, ClosedSystem) or not steps.count:
        return ()
    if not steps.held.any() and not steps.sigmas.min() < LOOKED_AT:
        return ()
    held = set(np.flatnonzero(steps.held).tolist())
    unit = system.mechanism.structure.units.coordinate
    turning = _turns_back(system.nq, steps, unit)
    last = steps.count - 1
    stops = failed and steps.sigmas[last].min() < LOOKED_AT and _slow(system.nq, steps, unit)
    marked = sorted(held | turning | ({last} if stops else set()))
    found: list[Bifurcation] = []
    if not marked:
        return ()
    watched = Watched(system, dense)
    for first, final in _ranges(marked, steps):
        t = np.linspace(steps.times[first], min(steps.times[final + 1], steps.end), SAMPLES)
        stayed = final > first or first in held
        stopped = bool(stops and final == last)
        # Where a motion turns back tells whether it had the momentum to pass: it may have passed
        # and come back within the step.
        closest = _closest(watched, t) if stayed or stopped else _turn(watched, t)
        q = watched.place(closest)
        singular = nearest_singular(watched.geometry, q, watched.rank, WITHIN)
        if singular is None:
            continue
        distance = float(np.linalg.norm(watched.geometry.difference(singular, q)))
        if not (stayed or stopped or distance < UNDECIDED * rtol):
            continue
        begin, end = (float(t[0]), float(t[-1])) if stayed else (closest, closest)
        # The way it came is told from where the motion was faster.
        passage = passage_at(watched, steps, begin, float(t[-1] - t[0]) / (final + 1 - first))
        found.append(Bifurcation(begin, end, distance, stopped, passage))
    return tuple(found)
