r"""Kinematics of a linkage over a turn of its crank: limits, strokes, transmission angles.

The linkage has one degree of freedom.  Along its path the rates of all joints are the null vector
n of the closure rows, G n = 0, so that a joint j moves with dq_j/dq_crank = n_j / n_crank.  By
virtual work the same number relates forces: without inertia and friction, a torque T on the crank
balances the force T n_crank / n_j on j, the mechanical advantage.

A four-bar is a loop of four parallel hinges, O and C on the ground, A and B on the coupler.  Its
class follows from the lengths s <= p, q <= l of its bars: some bar turns fully if s + l <= p + q
(F. Grashof, *Theoretische Maschinenlehre*, vol. 2, 1883).  The transmission angle is that between
coupler and output link at B, from 0 to 90 degrees; for a slider that between coupler and the normal
of its path.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin
from scipy.optimize import brentq

from srm_mbs._kernel.workspace import workspace
from srm_mbs._typing import FloatArray
from srm_mbs.analysis.path_following import follow
from srm_mbs.assembly.position import ClosureProblem, polish
from srm_mbs.dynamics.constraints.rows import LoopKinematics
from srm_mbs.dynamics.constraints.wrenches import Placements
from srm_mbs.dynamics.manifold import joint_track
from srm_mbs.dynamics.mechanism import Mechanism, check_mechanism
from srm_mbs.dynamics.scaling import coordinate_units, is_angle
from srm_mbs.errors import InputError, KnownKeys
from srm_mbs.formats.files import checked_path
from srm_mbs.model.anchors import one_degree_joint
from srm_mbs.model.coordinates import position_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

POSITIONS = 361
"""Positions of the crank over a turn, one for each degree."""
PARALLEL = 1e-6
"""Sine of the angle between two axes below which they are parallel."""
SAME_LENGTH = 1e-9
"""Difference of sums of bar lengths, over them, below which a four-bar has a change point."""
WHOLE_TURN = 0.5
"""Net motion (rad) of a joint over a turn of the crank above which it turns fully itself."""
REFINED = 1e-12
"""Accuracy (rad, m) of the crank's position at a limit."""
STILL, DEAD = 1e-12, 1e-6
"""Rate of a joint, over that of the mechanism (in units), below which it rests: rounding; at a dead
point of the crank, which is known to the root of it, DEAD."""
CORRECTION = 0.1
"""Distance of a closed configuration from the tangent of the path, over the way along it, below
which it is on that path."""


@dataclass(frozen=True)
class Stroke:
    """Motion of a joint between its limits.

    At its limits a joint rests for a moment: were it the one that drives, these would be its dead
    points.

    Attributes
    ----------
    unit
        ``rad`` or ``m``.
    lower, upper
        Smallest and largest position.
    crank_at_lower, crank_at_upper
        Positions (rad, m) of the crank there.
    limits
        All positions of the crank at which the joint turns back.
    time_ratio
        Duration of the slower stroke over that of the faster one at a constant rate of the crank;
        None if the crank does not turn fully.
    """

    unit: str
    lower: float
    upper: float
    crank_at_lower: float
    crank_at_upper: float
    limits: tuple[float, ...]
    time_ratio: float | None

    @property
    def length(self) -> float:
        """The stroke (rad, m)."""
        return self.upper - self.lower


@dataclass(frozen=True, eq=False)
class LinkageReport:
    """Kinematics of a linkage over the motion of its crank.

    Attributes
    ----------
    mechanism, crank
        The linkage, and the joint that drives it.
    turns
        Whether the crank turns fully.
    positions : (n,)
        Positions of the crank (rad, m), increasing.
    q : (n, nq)
        Configurations there.
    joints : {joint: (n,)}
        Positions of the other joints of one degree of freedom, angles unwrapped.
    ratios : {joint: (n,)}
        dq_joint/dq_crank; infinite where the crank cannot move on.
    strokes : {joint: Stroke}
        Of the joints that do not turn fully.
    dead_points
        Positions of the crank beyond which it cannot move; empty if it turns fully.
    transmission_angle : (n,) rad
        Of a four-bar or slider-crank; None for others.
    lengths
        Crank, coupler, output and ground (m) of a four-bar; None for others.
    """

    mechanism: Mechanism
    crank: str
    turns: bool
    positions: FloatArray
    q: FloatArray
    joints: Mapping[str, FloatArray]
    ratios: Mapping[str, FloatArray]
    strokes: Mapping[str, Stroke]
    dead_points: tuple[float, ...]
    transmission_angle: FloatArray | None
    lengths: tuple[float, float, float, float] | None

    @property
    def mechanical_advantage(self) -> Mapping[str, FloatArray]:
        """Force on each joint (n,) that a unit force on the crank balances: N m or N each."""
        with np.errstate(divide="ignore"):
            return KnownKeys((name, 1.0 / ratio) for name, ratio in self.ratios.items())

    @property
    def grashof_class(self) -> str | None:
        """``crank-rocker``, ``rocker-crank`` (the output turns), ``double-crank``,
        ``double-rocker`` (the coupler turns), ``triple-rocker`` (no bar does) or ``change-point``;
        None unless it is a four-bar."""
        if self.lengths is None:
            return None
        shortest, *middle, longest = sorted(self.lengths)
        gap = shortest + longest - sum(middle)
        if abs(gap) <= SAME_LENGTH * sum(self.lengths):
            return "change-point"
        if gap > 0.0:
            return "triple-rocker"
        crank, coupler, _, ground = self.lengths
        if shortest == ground:
            return "double-crank"
        if shortest == coupler:
            return "double-rocker"
        return "crank-rocker" if shortest == crank else "rocker-crank"

    def rows(self) -> Iterator[tuple[str, str]]:
        """The report as a table: (quantity, value)."""
        unit = "rad" if is_angle(self.mechanism.model, self.crank) else "m"
        if self.turns:
            yield "crank", f"{self.crank} turns fully"
        else:
            low, high = self.positions[[0, -1]]
            yield "crank", f"{self.crank} moves from {low:.6g} to {high:.6g} {unit}"
        for dead in self.dead_points:
            yield "dead point", f"{self.crank} = {dead:.9g} {unit}"
        if self.lengths is not None:
            lengths = ", ".join(f"{length:.6g}" for length in self.lengths)
            yield "crank, coupler, output, ground", f"{lengths} m"
            yield "Grashof class", str(self.grashof_class)
        if self.transmission_angle is not None:
            low, high = np.degrees([self.transmission_angle.min(), self.transmission_angle.max()])
            yield "transmission angle", f"{low:.4g} to {high:.4g} deg"
        for name in self.joints:
            stroke = self.strokes.get(name)
            if stroke is None:
                yield f"joint {name}", "turns fully"
                continue
            span = f"{stroke.lower:.6g} to {stroke.upper:.6g} {stroke.unit}"
            yield f"joint {name}", f"{span}, stroke {stroke.length:.6g} {stroke.unit}"
            at = ", ".join(f"{position:.6g}" for position in stroke.limits)
            yield "  limits at", f"{self.crank} = {at} {unit}" if at else "none"
            if stroke.time_ratio is not None:
                yield "  time ratio", f"{stroke.time_ratio:.6g}"

    def __repr__(self) -> str:
        motion = "turns fully" if self.turns else f"{len(self.dead_points)} dead points"
        return (
            f"LinkageReport({self.mechanism.name!r}, crank={self.crank!r}, {motion}, "
            f"{len(self.positions)} positions, {len(self.joints)} joints)"
        )

    def __str__(self) -> str:
        rows = list(self.rows())
        width = max(len(name) for name, _ in rows)
        return "\n".join(f"{name:<{width}}  {value}" for name, value in rows)

    def plot(self, path: str | Path | None = None) -> Figure:
        """Positions, ratios and the transmission angle over the crank.

        Parameters
        ----------
        path
            Where to save the figure (.png, .pdf or .svg); not saved if omitted.

        Raises
        ------
        InputError
            For an unknown suffix.
        OSError
            If the file cannot be written.
        """
        from srm_mbs.visualization.plotting.figure import check_suffix, save
        from srm_mbs.visualization.plotting.linkage import draw_linkage

        file = None if path is None else checked_path(path)
        if file is not None:
            check_suffix(file)
        figure = draw_linkage(
            self.mechanism,
            self.crank,
            self.positions,
            self.joints,
            self.ratios,
            self.transmission_angle,
        )
        if file is not None:
            save(figure, file, "srm_mbs: kinematics over a turn of the crank")
        return figure


def check_crank(mechanism: Mechanism, crank: str) -> Mechanism:
    """The mechanism without its drives, if it has one degree of freedom and such a joint.

    Raises
    ------
    InputError
        If there is no joint ``crank`` of one degree of freedom, no motion moves it, or the
        mechanism has another number of degrees of freedom.
    """
    check_mechanism(mechanism)
    mechanism = mechanism.undriven
    one_degree_joint(mechanism.model, crank, "crank", "Give a joint of one degree of freedom")
    if mechanism.degrees_of_freedom != 1:
        raise InputError(
            f"the mechanism has {mechanism.degrees_of_freedom} degrees of freedom, and its joints "
            "do not follow from the crank",
            element="mechanism",
            remedy="Give one of one degree of freedom",
        )
    if crank in mechanism.mobility.unreachable_joints:
        raise InputError(
            f"no motion of the mechanism moves the joint {crank!r}",
            element="crank",
            remedy="Give another joint",
        )
    return mechanism


def linkage_report(mechanism: Mechanism, crank: str) -> LinkageReport:
    """Analyse a linkage of one degree of freedom over a turn of its crank.

    Parameters
    ----------
    mechanism
        The linkage; its drives do not count.
    crank
        Joint of one degree of freedom that drives it.  It turns from its initial position once, or
        both ways as far as it goes; a slider goes as far as it can within a scene diagonal.

    Raises
    ------
    InputError
        If there is no such joint, the mechanism has no loop or another number of degrees of
        freedom, or the way of the crank meets a singular configuration.
    """
    mechanism = check_crank(mechanism, crank)
    model = mechanism.model
    turning = is_angle(model, crank)
    start = position_of(mechanism, mechanism.q0, crank)
    whole = (
        2.0 * np.pi if turning else coordinate_units(mechanism, mechanism.q0, mechanism.v0).length
    )
    ahead = np.linspace(0.0, whole, POSITIONS)
    forth = follow(mechanism, {crank: start + ahead})
    turns = turning and forth.complete
    ways = [(forth, ahead)]
    if not turns:
        ways.append((follow(mechanism, {crank: start - ahead[1:]}), -ahead[1:]))
    for way, _ in ways:
        if way.singular:
            raise InputError(
                f"the linkage meets a singular configuration at {crank} = "
                f"{way.singular[0].values[crank]:.6g}, from where its motion does not follow from "
                "the crank",
                element="mechanism",
                remedy="Give other lengths, or analyse the branch with srm.follow",
            )
    limits = [way.limit for way, _ in ways if way.limit is not None]
    dead = np.array([limit.values[crank] for limit in limits])
    positions = np.concatenate([*(start + steps[: len(way.q)] for way, steps in ways), dead])
    q = np.concatenate([*(way.q for way, _ in ways), *(limit.q[None] for limit in limits)])
    order = np.argsort(positions, kind="stable")
    positions, q = positions[order], q[order]
    return _Analysis(mechanism, crank, positions, q, turns).report(tuple(sorted(dead.tolist())))


class _Analysis:
    """The quantities of a report along the configurations ``q`` (n, nq)."""

    def __init__(
        self, mechanism: Mechanism, crank: str, positions: FloatArray, q: FloatArray, turns: bool
    ) -> None:
        self.mechanism, self.crank, self.turns = mechanism, crank, turns
        self.positions, self.q = positions, q
        self._rows = LoopKinematics(mechanism.model, mechanism.loops)
        self._data = workspace(mechanism.model)
        self._unit = coordinate_units(mechanism, mechanism.q0, mechanism.v0).coordinate
        names = [n for n in mechanism.joint_names if mechanism.joint(n).nv == 1 and n != crank]
        rates = np.array([self.rates(row) for row in q])
        self.joints: KnownKeys[FloatArray] = KnownKeys(
            (name, joint_track(mechanism, q, name)) for name in names
        )
        driving = rates[:, [mechanism.joint(crank).idx_v]].copy()
        rates[np.abs(rates) <= STILL * self._unit] = 0.0
        with np.errstate(divide="ignore", invalid="ignore"):
            along = rates / driving
        self._along, self._rates = along, rates
        self._closures = ClosureProblem(mechanism, mechanism.q0)
        self._free = np.delete(np.arange(mechanism.model.nv), mechanism.joint(crank).idx_v)
        self.ratios: KnownKeys[FloatArray] = KnownKeys(
            (name, along[:, mechanism.joint(name).idx_v]) for name in names
        )

    def rates(self, q: FloatArray) -> FloatArray:
        """The null vector (nv,) of the closure rows, positive for the crank."""
        self._rows.evaluate(self.mechanism.model, self._data, q)
        null: FloatArray = np.linalg.svd(self._rows.G * self._unit)[2][-1] * self._unit
        return null * (1.0 if null[self.mechanism.joint(self.crank).idx_v] >= 0.0 else -1.0)

    def report(self, dead: tuple[float, ...]) -> LinkageReport:
        """The report, with the positions of the crank beyond which it cannot move."""
        self._orient_at_dead_points()
        strokes = KnownKeys(
            (name, self._stroke(name, values))
            for name, values in self.joints.items()
            if not self._turns_fully(name, values)
        )
        angle, lengths = four_bar_of(self.mechanism, self.crank, self.q)
        return LinkageReport(
            self.mechanism,
            self.crank,
            self.turns,
            self.positions,
            self.q,
            self.joints,
            self.ratios,
            strokes,
            dead,
            angle,
            lengths,
        )

    def _orient_at_dead_points(self) -> None:
        """Give the rates at dead points, where the crank has none, the sense of those beside them;
        joints that rest there as well keep the rates that they have beside them."""
        column = self.mechanism.joint(self.crank).idx_v
        rests = np.abs(self._rates) <= DEAD * self._unit
        moving = np.flatnonzero(~rests[:, column])
        for i in np.flatnonzero(rests[:, column]).tolist():
            inside = int(moving[np.argmin(np.abs(moving - i))])
            way = self._closures.difference(self.q[inside], self.q[i]) * (inside < i or -1.0)
            sense = np.copysign(1.0, way @ (self._rates[i] / self._unit))
            self._rates[i] = np.where(rests[i], self._rates[inside], sense * self._rates[i])

    def _turns_fully(self, name: str, values: FloatArray) -> bool:
        turning = is_angle(self.mechanism.model, name)
        return self.turns and turning and abs(values[-1] - values[0]) > WHOLE_TURN

    def _stroke(self, name: str, values: FloatArray) -> Stroke:
        back = self._rates[:, self.mechanism.joint(name).idx_v] < 0.0
        changes = np.flatnonzero(back[:-1] != back[1:])
        at = [self._limit(name, k) for k in changes.tolist()]
        cranks = np.concatenate([self.positions, [crank for crank, _ in at]])
        reached = np.concatenate([values, [value for _, value in at]])
        low, high = int(np.argmin(reached)), int(np.argmax(reached))
        ratio_of_times = None
        if self.turns:
            part = (cranks[high] - cranks[low]) % (2.0 * np.pi)
            parts = part, 2.0 * np.pi - part
            ratio_of_times = max(parts) / min(parts)
        return Stroke(
            "rad" if is_angle(self.mechanism.model, name) else "m",
            float(reached[low]),
            float(reached[high]),
            float(cranks[low]),
            float(cranks[high]),
            tuple(crank for crank, _ in at),
            ratio_of_times,
        )

    def _limit(self, name: str, k: int) -> tuple[float, float]:
        """Positions of the crank and of the joint ``name`` where that turns back, between the
        positions k and k + 1."""
        column = self.mechanism.joint(name).idx_v
        low, high = self.positions[k : k + 2].tolist()
        ends: dict[float, float] = dict(zip((low, high), self._rates[k : k + 2, column].tolist()))

        def rate(crank: float) -> float:
            if crank in ends:
                return ends[crank]
            return float(self.rates(self._configuration(k, crank))[column])

        crank = float(brentq(rate, low, high, xtol=REFINED))
        value = position_of(self.mechanism, self._configuration(k, crank), name)
        if is_angle(self.mechanism.model, name):
            value += 2.0 * np.pi * np.round((self.joints[name][k] - value) / (2.0 * np.pi))
        return crank, float(value)

    def _configuration(self, k: int, crank: float) -> FloatArray:
        """The configuration (nq,) where the crank is at ``crank`` (rad, m), between the positions k
        and k + 1."""
        problem = self._closures
        if not np.isfinite(self._along[k]).all() or (k == 0 and not self.turns):
            k += 1  # nothing leads away from a dead point
        move = self._along[k] * (crank - self.positions[k]) / problem.unit
        way = float(np.linalg.norm(move))
        if way < 1.0:  # beside a dead point the tangent is no guess
            guess = problem.move(self.q[k], move)
            found = polish(problem, guess, self._free)
            off = float(np.linalg.norm(problem.difference(guess, found)))
            if problem.closed(found) and off <= CORRECTION * way + REFINED:
                return found
        path = follow(self.mechanism, {self.crank: [crank]}, self.q[k])
        return path.q[-1] if path.limit is None else path.limit.q  # at a dead point, to rounding


def four_bar_of(
    mechanism: Mechanism, crank: str, q: FloatArray
) -> tuple[FloatArray | None, tuple[float, float, float, float] | None]:
    """Transmission angle (n,) rad of a four-bar or slider-crank at q (n, nq), and the lengths (m)
    of crank, coupler, output and ground of a four-bar; None for others."""
    model = mechanism.model
    loops = [loop for loop in mechanism.loops if loop.anchors]
    if len(loops) != 1 or len(mechanism.loops) != 1 or model.njoints != 4:
        return None, None
    placed = Placements.at(model, workspace(model), q)
    (a, _), (b, inside) = loops[0].resolve(model)
    pins = {frozenset((a, b)): placed.of(b, inside)[1]}
    slides: dict[frozenset[int], FloatArray] = {}
    hinges = []
    for j in range(1, 4):
        edge = frozenset((j, int(model.parents[j])))
        axis = placed.rotation[:, j] @ _axis(model, j)
        if is_angle(model, model.names[j]):
            pins[edge] = placed.origin[:, j]
            hinges.append(axis)
        else:
            slides[edge] = axis
    driver = int(model.getJointId(crank))
    second = [e for e in pins if driver in e and 0 not in e]
    hinged = model.parents[driver] == 0 and frozenset((0, driver)) in pins
    if not hinged or len(second) != 1 or len(pins) + len(slides) != 4:
        return None, None
    (coupler,) = second[0] - {driver}
    third = [e for e in (*pins, *slides) if coupler in e and driver not in e]
    if len(third) != 1 or 0 in third[0]:
        return None, None
    (output,) = third[0] - {coupler}
    last = frozenset((0, output))
    normal = hinges[0]
    if third[0] not in pins or any(
        np.abs(np.cross(axis, normal)).max() > PARALLEL for axis in hinges
    ):
        return None, None
    ground_pin, A, B = (pins[edge] for edge in (frozenset((0, driver)), second[0], third[0]))
    rod = _across(B - A, normal)
    if last in slides:
        # The angle between the coupler and the normal of the slider's path.
        along = np.abs(np.einsum("nk,nk->n", rod, slides[last])) / np.linalg.norm(rod, axis=1)
        return np.arcsin(np.minimum(along, 1.0)), None
    if last not in pins:
        return None, None
    arm = _across(B - pins[last], normal)
    cosine = np.abs(np.einsum("nk,nk->n", rod, arm))
    cosine /= np.linalg.norm(rod, axis=1) * np.linalg.norm(arm, axis=1)
    bars = (_across(A - ground_pin, normal), rod, arm, _across(pins[last] - ground_pin, normal))
    crank_bar, coupler_bar, output_bar, ground = (float(np.linalg.norm(bar[0])) for bar in bars)
    lengths = crank_bar, coupler_bar, output_bar, ground
    return np.arccos(np.minimum(cosine, 1.0)), lengths


def _axis(model: pin.Model, joint: int) -> FloatArray:
    """Axis (3,) of a joint of one degree of freedom, in its own frame."""
    data = model.createData()
    pin.computeJointJacobians(model, data, pin.neutral(model))
    J = pin.getJointJacobian(model, data, joint, pin.ReferenceFrame.LOCAL).reshape(6, -1)
    column = J[:, model.joints[joint].idx_v]
    axis: FloatArray = column[3:] if is_angle(model, model.names[joint]) else column[:3]
    return axis


def _across(vectors: FloatArray, normal: FloatArray) -> FloatArray:
    """The parts of ``vectors`` (n, 3) across the unit vectors ``normal`` (n, 3)."""
    across: FloatArray = vectors - np.einsum("nk,nk->n", vectors, normal)[:, None] * normal
    return across
