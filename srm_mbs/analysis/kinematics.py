"""Closed configurations of a mechanism of one degree of freedom, for a crank turned by hand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.optimize import brentq

from srm_mbs._typing import FloatArray
from srm_mbs.analysis.linkage import check_crank, four_bar_of
from srm_mbs.assembly.assemble import assemble
from srm_mbs.assembly.closed_curve import ClosedCurve, CurveFollower
from srm_mbs.assembly.continuation import Met
from srm_mbs.assembly.position import ClosureProblem
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.dynamics.scaling import is_angle
from srm_mbs.errors import AnalysisError, InputError
from srm_mbs.model.coordinates import position_of
from srm_mbs.visualization.animation.crank_motion import CrankMark
from srm_mbs.visualization.animation.joint_motion import CrankMotion

TURN_TIME = 4.0
"""Duration (s) of a turn of the crank in the animation, and of a motion back and forth."""
PER_TURN = 360
"""Configurations in a turn of the crank."""
BACK_AND_FORTH = 720
"""Configurations between and beyond dead points of the crank."""
REFINED = 1e-12
"""Accuracy of the arclength of a dead point, in units."""


def kinematics(mechanism: Mechanism, crank: str) -> CrankMotion:
    """All closed configurations on the branch of the initial one, over the position of a crank.

    The result is a motion that is shown like a run.  Its page has a slider that turns the crank by
    hand, and the bodies can be dragged with the mouse or a finger.  The branch passes dead points
    of the crank and, straight on, singular configurations.

    Parameters
    ----------
    mechanism
        A mechanism of one degree of freedom with loops; its drives do not count.
    crank
        Joint of one degree of freedom whose position is the slider.

    Raises
    ------
    InputError
        If there is no such joint, the mechanism has no loop or another number of degrees of
        freedom, or begins on a singular configuration.
    AnalysisError
        If the branch cannot be followed from the initial configuration.
    """
    mechanism = check_crank(mechanism, crank)
    if not mechanism.loops:
        raise InputError(
            "a mechanism without loops has nothing to follow",
            element="loop",
            remedy="Set its joint directly: no other depends on it",
        )
    start = assemble(mechanism, mechanism.q0, hold=[crank])
    if start.singular:
        raise InputError(
            "the initial configuration is singular, where branches meet",
            element="q0",
            remedy="Start next to it, on the branch that is meant",
        )
    problem = ClosureProblem(mechanism, start.q)
    column = mechanism.joint(crank).idx_v
    follower = CurveFollower(problem, start.q, mechanism.structure.rank, column)
    curve = follower.curve()
    if len(curve.q) < 2:
        raise AnalysisError(
            "the mechanism does not move from its initial configuration",
            q=start.q,
            remedy="Give another initial configuration",
        )
    return _Sampling(mechanism, crank, follower, curve).motion()


@dataclass(frozen=True, eq=False)
class _Knot:
    """A configuration q (nq,) on the curve, its arclength in units from the start, and what it
    is: the loops of a singular configuration, none of a dead point, None of others."""

    length: float
    q: FloatArray
    loops: tuple[str, ...] | None = None


class _Sampling:
    """A curve of closed configurations, read at equal steps of the crank or of its arclength."""

    def __init__(
        self, mechanism: Mechanism, crank: str, follower: CurveFollower, curve: ClosedCurve
    ) -> None:
        self.mechanism, self.crank = mechanism, crank
        self.follower, self.problem, self.curve = follower, follower.problem, curve
        self.column = mechanism.joint(crank).idx_v
        along = curve.tangents[:, self.column]
        self.turns = bool(is_angle(mechanism.model, crank) and curve.closed and along.min() > 0.0)
        knots = [_Knot(*pair) for pair in zip(curve.lengths.tolist(), curve.q)]
        knots += [self._singular(met) for met in curve.met]
        if not self.turns:
            changes = np.flatnonzero((along[:-1] > 0.0) != (along[1:] > 0.0))
            knots += [self._dead_point(k) for k in changes.tolist()]
        self.knots = sorted(knots, key=lambda knot: knot.length)
        self.lengths = np.array([knot.length for knot in self.knots])
        travelled = self._travelled([knot.q for knot in self.knots])
        here = travelled - travelled[np.argmin(np.abs(self.lengths))]
        self.positions = here + position_of(mechanism, follower.start, crank)
        self.over = self.positions if self.turns else self.lengths

    def _travelled(self, path: Sequence[FloatArray]) -> FloatArray:
        """Motion (n,) of the crank from the first of some configurations (rad, m)."""
        steps = [self.problem.difference(*pair)[self.column] for pair in pairwise(path)]
        return np.asarray(np.cumsum([0.0, *steps]) * self.problem.unit[self.column])

    def _singular(self, met: Met) -> _Knot:
        ways = np.array([self.problem.difference(q, met.q) for q in self.curve.q])
        k = int(np.linalg.norm(ways, axis=1).argmin())
        return _Knot(
            float(self.curve.lengths[k] + ways[k] @ self.curve.tangents[k]), met.q, met.loops
        )

    def _dead_point(self, k: int) -> _Knot:
        """Where the crank turns back, between the configurations k and k + 1 of the curve."""
        q, along = self.curve.q[k], self.curve.tangents[k]

        def after(way: float) -> FloatArray:
            found = self.follower.closed_at(self.problem.move(q, way * along), along)
            if found is None:
                raise AnalysisError(
                    f"the motion next to a dead point of {self.crank} cannot be followed",
                    q=q,
                    remedy="Give another crank",
                )
            return found[0]

        last = float(self.problem.difference(q, self.curve.q[k + 1]) @ along)
        ends = {0.0: along, last: self.curve.tangents[k + 1]}

        def rate(way: float) -> float:
            known = ends.get(way)
            found = self.follower.tangent(after(way), along) if known is None else known
            return float(found[self.column])

        way = float(brentq(rate, 0.0, last, xtol=REFINED))
        return _Knot(float(self.curve.lengths[k] + way), after(way), ())

    def _at(self, x: float) -> FloatArray:
        """The configuration (nq,) where the parameter is x."""
        k = int(np.clip(np.searchsorted(self.over, x, side="right") - 1, 0, len(self.over) - 2))
        q = self.knots[k].q
        part = (x - self.over[k]) / (self.over[k + 1] - self.over[k])
        chord = self.problem.difference(q, self.knots[k + 1].q)
        across = chord / np.linalg.norm(chord)
        if self.turns:
            across = np.eye(len(chord))[self.column]
        found = self.follower.closed_at(self.problem.move(q, part * chord), across)
        if found is None:
            raise AnalysisError(
                f"no closed configuration was found between two that are close to each other, "
                f"where {self.crank} = {self.positions[k]:.6g}",
                q=q,
                remedy="Give another crank",
            )
        return found[0]

    def motion(self) -> CrankMotion:
        """The curve as a motion."""
        first, whole = float(self.over[0]), float(self.over[-1] - self.over[0])
        turns = round(whole / (2.0 * np.pi)) if self.turns else 1
        count = PER_TURN * turns if self.turns else BACK_AND_FORTH
        # The slider of a crank that turns begins at a whole turn.
        origin = 2.0 * np.pi * np.floor(first / (2.0 * np.pi)) if self.turns else first
        wanted = origin + np.linspace(0.0, whole, count + 1)
        q = np.array([self._at(x + whole if x < first else x) for x in wanted.tolist()])
        if self.turns:  # configurations after the end of the curve, a period earlier
            period = self.knots[-1].q - self.knots[0].q
            q[wanted < first] -= np.where(np.abs(period) > 1.0, period, 0.0)
            positions = wanted
        else:
            positions = self.positions[0] + self._travelled(list(q))
        duration = TURN_TIME * turns

        def time_of(x: float) -> float:
            return duration * (x - origin) / whole

        marks = []
        for x, position, knot in zip(self.over, self.positions, self.knots):
            if knot.loops is not None:
                earlier = whole if self.turns and x > wanted[-1] else 0.0
                at = time_of(float(x) - earlier)
                marks.append(CrankMark(at, float(position) - earlier, knot.loops))
        initial = self.over[np.argmin(np.abs(self.lengths))]
        return CrankMotion(
            mechanism=self.mechanism,
            t=duration * np.linspace(0.0, 1.0, count + 1),
            q=q,
            crank=self.crank,
            positions=positions,
            rates=self._rates(q),
            start=time_of(float(initial)),
            turns=self.turns,
            closed=self.curve.closed,
            marks=tuple(sorted(marks, key=lambda mark: mark.time)),
            transmission_angle=four_bar_of(self.mechanism, self.crank, q)[0],
        )

    def _rates(self, q: FloatArray) -> FloatArray:
        """dq/dq_crank (n, nv)."""
        rates, along = np.empty((len(q), self.problem.model.nv)), None
        for k, row in enumerate(q):
            along = self.follower.tangent(row, along)
            rates[k] = along * self.problem.unit
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(rates / rates[:, [self.column]])
