"""What is drawn beside the bodies: springs, paths of points, gaps and reactions of closures.

All of it is computed at the key frames; springs and gaps are shapes of unit length along z, which
the animation turns and stretches.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from srm_mbs.anchors import Anchor
from srm_mbs.arrays import FloatArray
from srm_mbs.errors import InputError
from srm_mbs.forces import SpringDamper
from srm_mbs.mechanism import Mechanism
from srm_mbs.solution import Solution
from srm_mbs.visuals import Colour, Cylinder, Mesh, Shape, Sphere

if TYPE_CHECKING:
    from srm_mbs.loop_closure import LoopClosure
    from srm_mbs.motion import Playable
    from srm_mbs.scene import Motion

SPRING_COLOUR: Colour = (0.35, 0.38, 0.42, 1.0)
DAMPER_COLOUR: Colour = (0.60, 0.63, 0.67, 1.0)
GAP_COLOUR: Colour = (0.835, 0.0, 0.35, 1.0)
TRACE_COLOURS: tuple[Colour, ...] = (  # as srm_mbs.visuals.PALETTE, darker: lines are thin
    (0.835, 0.369, 0.000, 1.0),
    (0.000, 0.350, 0.560, 1.0),
    (0.000, 0.480, 0.350, 1.0),
    (0.620, 0.300, 0.480, 1.0),
)
RAMP: tuple[tuple[float, float, float], ...] = (  # cividis, even in lightness
    (0.000, 0.135, 0.305),
    (0.255, 0.305, 0.425),
    (0.485, 0.482, 0.470),
    (0.720, 0.675, 0.430),
    (0.995, 0.909, 0.218),
)
LARGEST_GAP = 0.1
"""Part of the picture's extent that the largest gap may take."""
HIGH = 98.0
"""Percentile of the reactions at the end of the colours: near singular passages they have peaks."""
SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
TURNS, AROUND, SECTION = 7, 12, 5
"""Of a coil: turns, points around one, corners of the wire."""


@dataclass(frozen=True, eq=False)
class Moving:
    """A shape with a motion of its own.

    Attributes
    ----------
    name
        Of its node in the page.
    parts
        Shapes with their colours; along z from 0 to 1 where the motion stretches.
    positions : (n, 3) m, quaternions : (n, 4), scales : (n, 3)
        At the key frames, in the world; no scales where it keeps its size.
    colours : (n, 3) or None
        Over time.
    in_front
        Seen through everything before it, as closures lie within the bodies.
    """

    name: str
    parts: tuple[tuple[Shape, pin.SE3, Colour], ...]
    positions: FloatArray
    quaternions: FloatArray
    scales: FloatArray | None = None
    colours: FloatArray | None = None
    in_front: bool = False


@dataclass(frozen=True, eq=False)
class Trace:
    """The path ``points`` (n, 3) m of a point, in the world."""

    name: str
    points: FloatArray
    colour: Colour


@dataclass(frozen=True)
class Wanted:
    """What is drawn beside the bodies and springs.

    Parameters
    ----------
    trace
        Points whose paths are drawn.
    gaps
        Draw the gaps of the closures, exaggerated.
    reactions
        Colour the closures by the size of their reaction force.
    """

    trace: Sequence[Anchor] = ()
    gaps: bool = False
    reactions: bool = False

    def check(self, mechanism: Mechanism) -> None:
        """Refuse what ``mechanism`` has not.

        Raises
        ------
        InputError
            As :meth:`anchors`, or if reactions are wanted and no closure has anchors.
        """
        self.anchors(mechanism)
        if self.reactions and not any(loop.anchors for loop in mechanism.loops):
            raise InputError(
                "the mechanism has no closures with reactions",
                element="reactions",
                remedy="Leave the option away",
            )

    def anchors(self, mechanism: Mechanism) -> list[tuple[int, pin.SE3]]:
        """Joint and placement of the traced points.

        Raises
        ------
        InputError
            If one is no anchor, is not there, or lies on the ground.
        """
        if isinstance(self.trace, Anchor):
            raise InputError("trace is one anchor", element="trace", remedy="Give a list of them")
        found = []
        for anchor in self.trace:
            if not isinstance(anchor, Anchor):
                raise InputError(
                    f"{anchor!r} cannot be traced",
                    element="trace",
                    remedy='Give for example srm.Anchor("rod", xyz=(1.0, 0.0, 0.0))',
                )
            try:
                joint, placement = anchor.resolve(mechanism.model)
            except InputError as error:
                error.element = "trace"
                raise
            if joint == 0:
                raise InputError(
                    f"{anchor.where!r} lies on the ground and has no path",
                    element="trace",
                    remedy="Trace a point of a link that moves",
                )
            found.append((joint, placement))
        return found


@dataclass
class Overlays:
    """What was asked for, computed: shapes, paths, and what the panel says about them."""

    moving: list[Moving] = field(default_factory=list)
    traces: list[Trace] = field(default_factory=list)
    notes: list[dict[str, Any]] = field(default_factory=list)

    def points(self) -> FloatArray:
        """Points (n, 3) m that the camera should see."""
        parts = [np.empty((0, 3)), *(trace.points for trace in self.traces)]
        return np.concatenate([*parts, *(each.positions for each in self.moving)])


def springs_of(mechanism: Mechanism) -> list[SpringDamper]:
    """The force elements that are drawn: those between two points."""
    return [force for force in mechanism.forces if isinstance(force, SpringDamper)]


def joints_of(mechanism: Mechanism, wanted: Wanted) -> set[int]:
    """Joints whose motion :func:`make_overlays` needs."""
    anchors = wanted.anchors(mechanism)
    for spring in springs_of(mechanism):
        anchors += [spring.a.resolve(mechanism.model), spring.b.resolve(mechanism.model)]
    if wanted.reactions or wanted.gaps:
        for loop in mechanism.loops:
            anchors += loop.resolve(mechanism.model) if loop.anchors else ()
    return {joint for joint, _ in anchors} - {0}


def make_overlays(solution: Playable, wanted: Wanted, motion: Motion, extent: float) -> Overlays:
    """Springs, and what is wanted, at the key frames of ``motion``.

    Parameters
    ----------
    extent
        Size of the picture, m.

    Raises
    ------
    InputError
        If an anchor cannot be traced, or the reactions are not known.
    """
    mechanism = solution.mechanism
    out = Overlays()
    for number, spring in enumerate(springs_of(mechanism)):
        ends = [path_of(motion, *side.resolve(mechanism.model)) for side in (spring.a, spring.b)]
        out.moving.append(_spring(f"spring_{number}", spring, ends, extent))
    for number, (joint, placement) in enumerate(wanted.anchors(mechanism)):
        points = path_of(motion, joint, placement)
        colour = TRACE_COLOURS[number % len(TRACE_COLOURS)]
        out.traces.append(Trace(f"trace_{number}", points, colour))
        ball = (Sphere(0.012 * extent), pin.SE3.Identity(), colour)
        out.moving.append(Moving(f"point_{number}", (ball,), points, _no_turn(len(points))))
    if wanted.reactions:
        _add_reactions(out, solution, motion, extent)
    if wanted.gaps:
        _add_gaps(out, solution, motion, extent)
    return out


def path_of(motion: Motion, joint: int, placement: pin.SE3) -> FloatArray:
    """Positions (n, 3) m in the world of a point fixed to a joint (0: the ground)."""
    offset = np.array(placement.translation)
    if joint == 0:
        return np.tile(offset, (len(motion.times), 1))
    k = motion.joints.index(joint)
    axis, w = motion.quaternions[:, k, :3], motion.quaternions[:, k, 3:]
    across = 2.0 * np.cross(axis, offset)
    turned = offset + w * across + np.cross(axis, across)
    return np.asarray(motion.positions[:, k] + turned)


def _no_turn(count: int) -> FloatArray:
    return np.tile([0.0, 0.0, 0.0, 1.0], (count, 1))


def turns_along(directions: FloatArray) -> FloatArray:
    """Quaternions (n, 4) x, y, z, w that turn z to ``directions`` (n, 3), of continuous sign and,
    since each follows its predecessor the shortest way, without twist."""
    turn = pin.Quaternion.Identity()
    here = np.array([0.0, 0.0, 1.0])
    out = np.empty((len(directions), 4))
    for i, direction in enumerate(directions):
        size = float(np.linalg.norm(direction))
        if size > 0.0:
            there = direction / size
            turn = pin.Quaternion.FromTwoVectors(here, there) * turn
            turn.normalize()
            here = there
        out[i] = turn.coeffs()
    flips = np.where(np.sum(out[1:] * out[:-1], axis=1) < 0.0, -1.0, 1.0)
    out[1:] *= np.cumprod(flips)[:, None]
    return out


def _stretched(
    name: str,
    parts: tuple[tuple[Shape, pin.SE3, Colour], ...],
    starts: FloatArray,
    arrows: FloatArray,
) -> Moving:
    lengths = np.linalg.norm(arrows, axis=1)
    # A scale of zero has no inverse, which three.js needs for the light.
    scales = np.column_stack([np.ones((len(lengths), 2)), np.maximum(lengths, 1e-9)])
    return Moving(name, parts, starts, turns_along(arrows), scales)


# Springs ------------------------------------------------------------------------------------


def _spring(name: str, spring: SpringDamper, ends: list[FloatArray], extent: float) -> Moving:
    """A coil, a piston in its cylinder, or both."""
    arrows = ends[1] - ends[0]
    mean = float(np.linalg.norm(arrows, axis=1).mean())
    mean = mean if mean > 0.0 else extent
    radius = min(0.02 * extent, 0.2 * mean)
    parts: list[tuple[Shape, pin.SE3, Colour]] = []
    if spring.stiffness:
        parts.append((_coil(radius, mean), pin.SE3.Identity(), SPRING_COLOUR))
    if spring.damping:
        for part, centre, width in ((1.0, 0.5, 0.18), (0.45, 0.4, 0.5)):
            place = pin.SE3(np.eye(3), np.array([0.0, 0.0, centre]))
            parts.append((Cylinder(width * radius, part), place, DAMPER_COLOUR))
    return _stretched(name, tuple(parts), ends[0], arrows)


def _coil(radius: float, length: float) -> Mesh:
    """A wire wound about z from 0 to 1, with straight ends on the axis; the wire is round when
    stretched to ``length`` (m)."""
    angle = np.linspace(0.0, 2.0 * np.pi * TURNS, TURNS * AROUND + 1)
    out = np.clip(np.minimum(angle, angle[-1] - angle) / (0.5 * np.pi), 0.0, 1.0) * radius
    height = (0.08 + 0.84 * angle / angle[-1]) * length
    line = np.column_stack([out * np.cos(angle), out * np.sin(angle), height])
    line = np.concatenate([[[0.0, 0.0, 0.0]], line, [[0.0, 0.0, length]]])
    outwards = np.column_stack([np.cos(angle), np.sin(angle), 0.0 * angle])
    outwards = np.concatenate([outwards[:1], outwards, outwards[-1:]])
    tangent = np.gradient(line, axis=0)
    second = np.cross(tangent, outwards)
    second /= np.linalg.norm(second, axis=1)[:, None]
    corners = 2.0 * np.pi * np.arange(SECTION) / SECTION
    wire = 0.16 * radius
    ring = np.cos(corners)[None, :, None] * outwards[:, None, :]
    ring = ring + np.sin(corners)[None, :, None] * second[:, None, :]
    vertices = (line[:, None, :] + wire * ring).reshape(-1, 3) / [1.0, 1.0, length]
    i, j = np.meshgrid(np.arange(len(line) - 1), np.arange(SECTION), indexing="ij")
    a, b = i * SECTION + j, i * SECTION + (j + 1) % SECTION
    faces = [np.stack([a, b, b + SECTION], axis=-1), np.stack([a, b + SECTION, a + SECTION], -1)]
    return Mesh(vertices, np.concatenate([f.reshape(-1, 3) for f in faces]).astype(np.uint32))


# Closures -----------------------------------------------------------------------------------


def gaps_of(solution: Playable, times: FloatArray) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Per closure with anchors and rows of length: b's origin (n, 3) m and the gap (n, 3) m from
    it, both in the world: the part of the way to a's origin that the closure excludes."""
    mechanism = solution.mechanism
    model = mechanism.model
    data = model.createData()
    sides = {
        loop.name: (loop, loop.resolve(model))
        for loop in mechanism.loops
        if len(loop.rows.directions) or loop.rows.distances
    }
    out = {name: (np.empty((len(times), 3)), np.empty((len(times), 3))) for name in sides}
    for i, q in enumerate(solution(times)[0]):
        pin.forwardKinematics(model, data, q)
        for name, (loop, ((joint_a, in_a), (joint_b, in_b))) in sides.items():
            b = data.oMi[joint_b] * in_b
            p = b.actInv((data.oMi[joint_a] * in_a).translation)
            out[name][0][i] = b.translation
            out[name][1][i] = b.rotation @ _excluded(loop, p)
    return out


def _excluded(loop: LoopClosure, p: FloatArray) -> FloatArray:
    """The part of a's position ``p`` (3,) m in b that the rows of length make zero."""
    directions = loop.rows.directions
    gap = directions.T @ (directions @ p)
    size = float(np.linalg.norm(p))
    for length in loop.rows.distances:
        gap = gap + (size - length) * p / (size or 1.0)
    return np.asarray(gap)


def _add_gaps(out: Overlays, solution: Playable, motion: Motion, extent: float) -> None:
    gaps = gaps_of(solution, motion.times)
    largest = max((float(np.linalg.norm(gap, axis=1).max()) for _, gap in gaps.values()), default=0)
    if not largest > 0.0:
        out.notes.append({"text": "the closures have no gaps"})
        return
    power = int(np.floor(np.log10(LARGEST_GAP * extent / largest)))
    factor = 10.0**power
    for number, (start, gap) in enumerate(gaps.values()):
        bar = Cylinder(0.006 * extent, 1.0)
        middle = pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.5]))
        parts = ((bar, middle, GAP_COLOUR),)
        bars = _stretched(f"gap_{number}", parts, start, factor * gap)
        out.moving.append(replace(bars, in_front=True))
    out.notes.append(
        {
            "text": f"gaps of the closures, at most {largest:.1e} m, drawn 10"
            f"{str(power).translate(SUPERSCRIPTS)} times as large"
        }
    )


def _add_reactions(out: Overlays, solution: Playable, motion: Motion, extent: float) -> None:
    if not isinstance(solution, Solution):
        raise InputError(
            "a motion that was not simulated has no reactions",
            element="reactions",
            remedy="Leave the option away",
        )
    mechanism = solution.mechanism
    sizes = {
        name: np.linalg.norm(wrench[:, :3], axis=1)
        for name, wrench in solution.at(motion.times).reactions.items()
    }
    together = np.concatenate(list(sizes.values()))
    together = together[np.isfinite(together)]
    top = float(np.percentile(together, HIGH)) if len(together) else 0.0
    for number, loop in enumerate(loop for loop in mechanism.loops if loop.name in sizes):
        path = path_of(motion, *loop.resolve(mechanism.model)[0])
        colours = ramp_colours(sizes[loop.name] / top if top else 0.0 * sizes[loop.name])
        ball = Sphere(0.014 * extent)
        parts = ((ball, pin.SE3.Identity(), (*RAMP[0], 1.0)),)
        name = f"closure_{number}"
        out.moving.append(Moving(name, parts, path, _no_turn(len(path)), None, colours, True))
    out.notes.append(
        {
            "text": "force in the closures",
            "ramp": [f"rgb({', '.join(str(round(255 * c)) for c in colour)})" for colour in RAMP],
            "ends": ["0", f"{top:.3g} N and more"],
        }
    )


def ramp_colours(parts: FloatArray) -> FloatArray:
    """Colours (n, 3) at ``parts`` (n,) of the ramp, 0 to 1; beyond, those of its ends."""
    parts = np.nan_to_num(parts, nan=1.0, posinf=1.0)
    at = np.linspace(0.0, 1.0, len(RAMP))
    return np.column_stack([np.interp(parts, at, channel) for channel in np.array(RAMP).T])
