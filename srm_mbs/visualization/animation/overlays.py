"""What is drawn beside the bodies: springs, paths of points, gaps and reactions of closures.

All of it is computed at the key frames.  What an event lets go or adds is drawn while it is there.

Shapes with a motion of their own, beside the bodies: springs, gaps, points.

Springs and gaps are of unit length along z; the animation turns and stretches them.

What is drawn of closures: their gaps, and the size of their reactions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from srm_mbs._kernel.workspace import workspace
from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.errors import InputError
from srm_mbs.model.anchors import Anchor, resolve_moving
from srm_mbs.model.forces import SpringDamper
from srm_mbs.simulation.result import SimulationResult
from srm_mbs.visualization.animation.shapes import Colour, Cylinder, Mesh, Shape, Sphere
from srm_mbs.visualization.animation.trajectory import Spans, loops_of, spans_of, within

if TYPE_CHECKING:
    from srm_mbs.model.closures import LoopClosure
    from srm_mbs.visualization.animation.joint_motion import Playable
    from srm_mbs.visualization.animation.scene import Motion


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
    spans
        When it is there (s); None for always.
    """

    name: str
    parts: tuple[tuple[Shape, pin.SE3, Colour], ...]
    positions: FloatArray
    quaternions: FloatArray
    scales: FloatArray | None = None
    colours: FloatArray | None = None
    in_front: bool = False
    spans: Spans | None = None


@dataclass(frozen=True, eq=False)
class Trace:
    """The path ``points`` (n, 3) m of a point, in the world."""

    name: str
    points: FloatArray
    colour: Colour


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


def no_turn(count: int) -> FloatArray:
    return np.tile([0.0, 0.0, 0.0, 1.0], (count, 1))


def turns_between(first: FloatArray, second: FloatArray) -> FloatArray:
    """Rotation vectors (..., 3), rad in the world, between quaternions (..., 4) x, y, z, w."""
    a, wa, b, wb = first[..., :3], first[..., 3:], second[..., :3], second[..., 3:]
    axis = wa * b - wb * a - np.cross(b, a)
    w = wa * wb + np.sum(a * b, axis=-1, keepdims=True)
    sine = np.linalg.norm(axis, axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, w)
    return np.asarray(axis * np.divide(angle, sine, out=np.full_like(sine, 2.0), where=sine > 0.0))


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


def stretched(
    name: str,
    parts: tuple[tuple[Shape, pin.SE3, Colour], ...],
    starts: FloatArray,
    arrows: FloatArray,
) -> Moving:
    lengths = np.linalg.norm(arrows, axis=1)
    # A scale of zero has no inverse, which three.js needs for the light.
    scales = np.column_stack([np.ones((len(lengths), 2)), np.maximum(lengths, 1e-9)])
    return Moving(name, parts, starts, turns_along(arrows), scales)


GAP_COLOUR: Colour = (0.835, 0.0, 0.35, 1.0)
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


@dataclass(frozen=True, eq=False)
class Gap:
    """What one closure is open by, over time.

    Attributes
    ----------
    loop
        The closure.
    spans
        When it is there (s); None for always.
    starts : (n, 3) m, arrows : (n, 3) m
        b's origin in the world, and from there the part of the way to a's origin that the closure
        excludes; zero while it is not there.
    """

    loop: LoopClosure
    spans: Spans | None
    starts: FloatArray
    arrows: FloatArray


def gaps_of(solution: Playable, times: FloatArray) -> list[Gap]:
    """The gaps at ``times`` (n,) s of the closures with anchors and rows of length."""
    model = solution.mechanism.model
    data = workspace(model)
    out, sides = [], []
    for loop, spans in loops_of(solution):
        if len(loop.rows.directions) or loop.rows.distances:
            starts, arrows = np.zeros((len(times), 3)), np.zeros((len(times), 3))
            out.append(Gap(loop, spans, starts, arrows))
            sides.append((loop.resolve(model), within(times, spans, solution.span[1])))
    for i, q in enumerate(solution(times)[0]):
        pin.forwardKinematics(model, data, q)
        for gap, (((joint_a, in_a), (joint_b, in_b)), there) in zip(out, sides):
            b = data.oMi[joint_b] * in_b
            gap.starts[i] = b.translation
            if there[i]:
                p = b.actInv((data.oMi[joint_a] * in_a).translation)
                gap.arrows[i] = b.rotation @ _excluded(gap.loop, p)
    return out


def _excluded(loop: LoopClosure, p: FloatArray) -> FloatArray:
    """The part of a's position ``p`` (3,) m in b that the rows of length make zero."""
    directions = loop.rows.directions
    gap = directions.T @ (directions @ p)
    size = float(np.linalg.norm(p))
    for length in loop.rows.distances:
        gap = gap + (size - length) * p / (size or 1.0)
    return np.asarray(gap)


def draw_gaps(
    solution: Playable, motion: Motion, extent: float
) -> tuple[list[Moving], dict[str, Any]]:
    """The gaps as bars, all exaggerated by the same factor, and what the panel says about it."""
    gaps = gaps_of(solution, motion.times)
    sizes = (float(np.linalg.norm(gap.arrows, axis=1).max()) for gap in gaps)
    largest = max(sizes, default=0.0)
    if not largest > 0.0:
        return [], {"text": "the closures have no gaps"}
    power = int(np.floor(np.log10(LARGEST_GAP * extent / largest)))
    bar = Cylinder(0.006 * extent, 1.0)
    middle = pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.5]))
    moving = []
    for number, gap in enumerate(gaps):
        parts = ((bar, middle, GAP_COLOUR),)
        bars = stretched(f"gap_{number}", parts, gap.starts, 10.0**power * gap.arrows)
        moving.append(replace(bars, in_front=True, spans=gap.spans))
    return moving, {
        "text": f"gaps of the closures, at most {largest:.1e} m, drawn 10"
        f"{str(power).translate(SUPERSCRIPTS)} times as large"
    }


def draw_reactions(
    solution: Playable, motion: Motion, extent: float
) -> tuple[list[Moving], dict[str, Any]]:
    """The closures as balls, coloured by their reaction force, and the legend.

    Raises
    ------
    InputError
        If the reactions are not known.
    """
    if not isinstance(solution, SimulationResult):
        raise InputError(
            "a motion that was not simulated has no reactions",
            element="reactions",
            remedy="Leave the option out",
        )
    model = solution.mechanism.model
    sizes = {
        name: np.linalg.norm(wrench[:, :3], axis=1)
        for name, wrench in solution.at(motion.times).reactions.items()
    }
    loops = [(loop, spans) for loop, spans in loops_of(solution) if loop.name in sizes]
    # While a closure is not there, it has no force, and not one of zero.
    there = [within(motion.times, spans, solution.span[1]) for _, spans in loops]
    together = np.concatenate([sizes[loop.name][own] for (loop, _), own in zip(loops, there)])
    together = together[np.isfinite(together)]
    top = float(np.percentile(together, HIGH)) if len(together) else 0.0
    ball = Sphere(0.014 * extent)
    moving = []
    for number, (loop, spans) in enumerate(loops):
        path = path_of(motion, *loop.resolve(model)[0])
        colours = ramp_colours(sizes[loop.name] / top if top else 0.0 * sizes[loop.name])
        parts = ((ball, pin.SE3.Identity(), (*RAMP[0], 1.0)),)
        turns = no_turn(len(path))
        moving.append(Moving(f"closure_{number}", parts, path, turns, None, colours, True, spans))
    return moving, {
        "text": "force in the closures",
        "ramp": [f"rgb({', '.join(str(round(255 * c)) for c in colour)})" for colour in RAMP],
        "ends": ["0", f"{top:.3g} N and more"],
    }


def ramp_colours(parts: FloatArray) -> FloatArray:
    """Colours (n, 3) at ``parts`` (n,) of the ramp, 0 to 1; beyond, those of its ends."""
    parts = np.nan_to_num(parts, nan=1.0, posinf=1.0)
    at = np.linspace(0.0, 1.0, len(RAMP))
    return np.column_stack([np.interp(parts, at, channel) for channel in np.array(RAMP).T])


SPRING_COLOUR: Colour = (0.35, 0.38, 0.42, 1.0)
DAMPER_COLOUR: Colour = (0.60, 0.63, 0.67, 1.0)
TRACE_COLOURS: tuple[
    Colour, ...
] = (  # as srm_mbs.visualization.animation.shapes.PALETTE, darker: lines are thin
    (0.835, 0.369, 0.000, 1.0),
    (0.000, 0.350, 0.560, 1.0),
    (0.000, 0.480, 0.350, 1.0),
    (0.620, 0.300, 0.480, 1.0),
)
TURNS, AROUND, SECTION = 7, 12, 5
"""Of a coil: turns, points around one, corners of the wire."""


@dataclass(frozen=True)
class OverlayOptions:
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

    def check(self, *mechanisms: Mechanism) -> None:
        """Refuse what no one of ``mechanisms``, those of a run, has.

        Raises
        ------
        InputError
            As :meth:`anchors`, or if gaps or reactions are wanted and no closure has anchors.
        """
        self.anchors(mechanisms[0])
        loops = [loop for mechanism in mechanisms for loop in mechanism.loops]
        for element, wanted in (("gaps", self.gaps), ("reactions", self.reactions)):
            if wanted and not any(loop.anchors for loop in loops):
                raise InputError(
                    f"the mechanism has no closures with {element}",
                    element=element,
                    remedy="Leave the option out",
                )

    def anchors(self, mechanism: Mechanism) -> list[tuple[int, pin.SE3]]:
        """Joint and placement of the traced points.

        Raises
        ------
        InputError
            If one is no anchor, is not there, or lies on the ground.
        """
        return resolve_moving(mechanism.model, self.trace, "trace")


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


def springs_of(solution: Playable) -> list[tuple[SpringDamper, Spans | None]]:
    """The force elements that are drawn, those between two points, with when they are there."""
    return spans_of(
        solution,
        lambda mechanism: [force for force in mechanism.forces if isinstance(force, SpringDamper)],
    )


def joints_of(solution: Playable, wanted: OverlayOptions) -> set[int]:
    """Joints whose motion :func:`make_overlays` needs."""
    model = solution.mechanism.model
    anchors = wanted.anchors(solution.mechanism)
    for spring, _ in springs_of(solution):
        anchors += [spring.a.resolve(model), spring.b.resolve(model)]
    if wanted.reactions or wanted.gaps:
        for loop, _ in loops_of(solution):
            anchors += loop.resolve(model) if loop.anchors else ()
    return {joint for joint, _ in anchors} - {0}


def make_overlays(
    solution: Playable, wanted: OverlayOptions, motion: Motion, extent: float
) -> Overlays:
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
    for number, (spring, spans) in enumerate(springs_of(solution)):
        ends = [path_of(motion, *side.resolve(mechanism.model)) for side in (spring.a, spring.b)]
        out.moving.append(_spring(f"spring_{number}", spring, ends, extent, spans))
    for number, (joint, placement) in enumerate(wanted.anchors(mechanism)):
        points = path_of(motion, joint, placement)
        colour = TRACE_COLOURS[number % len(TRACE_COLOURS)]
        out.traces.append(Trace(f"trace_{number}", points, colour))
        ball = (Sphere(0.012 * extent), pin.SE3.Identity(), colour)
        out.moving.append(Moving(f"point_{number}", (ball,), points, no_turn(len(points))))
    for draw, asked in ((draw_reactions, wanted.reactions), (draw_gaps, wanted.gaps)):
        if asked:
            moving, note = draw(solution, motion, extent)
            out.moving += moving
            out.notes.append(note)
    return out


# Springs ------------------------------------------------------------------------------------


def _spring(
    name: str,
    spring: SpringDamper,
    ends: list[FloatArray],
    extent: float,
    spans: Spans | None,
) -> Moving:
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
    return replace(stretched(name, tuple(parts), ends[0], arrows), spans=spans)


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
