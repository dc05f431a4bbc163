"""Overlays of an animation: springs, massless rods, paths of points, gaps and reactions.

All of them are computed at the key frames of the bodies, and drawn during their active intervals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pinocchio as pin

from srm_mbs._kernel.workspace import workspace
from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.errors import InputError
from srm_mbs.model.anchors import Anchor, resolve_moving
from srm_mbs.model.closures import LoopClosure
from srm_mbs.model.forces import SpringDamper
from srm_mbs.model.numbers import flag
from srm_mbs.simulation.result import SimulationResult
from srm_mbs.visualization.animation.arrows import Arrows, arrows_of
from srm_mbs.visualization.animation.shapes import Colour, Cylinder, Mesh, Shape, Sphere, rods
from srm_mbs.visualization.animation.trajectory import (
    ActiveIntervals,
    BodyMotion,
    DrawableMotion,
    active_at,
    active_closures,
    active_elements,
    continuous_sign,
)

SPRING_COLOUR: Colour = (0.35, 0.38, 0.42, 1.0)
DAMPER_COLOUR: Colour = (0.60, 0.63, 0.67, 1.0)
ROD_COLOUR: Colour = SPRING_COLOUR
GAP_COLOUR: Colour = (0.835, 0.0, 0.35, 1.0)
TRACE_COLOURS: tuple[Colour, ...] = (
    (0.835, 0.369, 0.000, 1.0),
    (0.000, 0.350, 0.560, 1.0),
    (0.000, 0.480, 0.350, 1.0),
    (0.620, 0.300, 0.480, 1.0),
)
"""Colours of the bodies (:data:`srm_mbs.visualization.animation.shapes.PALETTE`), but darker, as
lines are thin."""
RAMP: tuple[tuple[float, float, float], ...] = (  # cividis, even in lightness
    (0.000, 0.135, 0.305),
    (0.255, 0.305, 0.425),
    (0.485, 0.482, 0.470),
    (0.720, 0.675, 0.430),
    (0.995, 0.909, 0.218),
)
"""Colours of reaction forces from 0 to the largest drawn one."""
FORCE_PERCENTILE = 98.0
"""Percentile of the reaction forces at the upper end of the ramp: near singular passages they
peak."""
LARGEST_GAP = 0.1
"""Largest drawn gap over the extent of the picture."""
COIL_TURNS, POINTS_PER_TURN, WIRE_CORNERS = 7, 12, 5
"""Resolution of the coil of a spring."""
SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


@dataclass(frozen=True)
class ViewOptions:
    """The overlays of an animation, image or video: those that are requested beside springs and
    massless rods.

    The methods that show a motion (:class:`srm_mbs.JointMotion`) take them by these names, as does
    the command line.

    Parameters
    ----------
    trace
        Points whose paths are drawn, for example ``[srm.Anchor("rod", xyz=(1.0, 0.0, 0.0))]``.
    gaps
        Draw the gaps of the closures, exaggerated by a factor that the panel gives.
    reactions
        Colour the closures by the magnitude of their reaction force, with a legend in the panel.
    arrows
        Draw the forces and moments in joints and closures, of drives and of force elements.
    """

    trace: Sequence[Anchor] = ()
    gaps: bool = False
    reactions: bool = False
    arrows: bool = False

    def check(self, *mechanisms: Mechanism) -> None:
        """Refuse overlays that none of ``mechanisms``, those of a run, has.

        Raises
        ------
        InputError
            As :meth:`anchors`, or if gaps or reactions are requested and no closure has anchors.
        """
        self.anchors(mechanisms[0])
        flag(self.arrows, "arrows")
        loops = [loop for mechanism in mechanisms for loop in mechanism.loops]
        for element, requested in (("gaps", self.gaps), ("reactions", self.reactions)):
            if flag(requested, element) and not any(loop.anchors for loop in loops):
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
            If one is no anchor, does not exist, or lies on the ground.
        """
        return resolve_moving(mechanism.model, self.trace, "trace")


NO_OVERLAYS = ViewOptions()
"""Springs and massless rods only."""
ALONG_Z = pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.5]))
"""Placement of a cylinder from 0 to 1 on z."""


@dataclass(frozen=True, eq=False)
class AnimatedShape:
    """A group of shapes with key frames of its own.

    Attributes
    ----------
    name
        Of its node in the page.
    parts
        Shapes with placement and colour; along z from 0 to 1 if the group is scaled.
    positions : (n, 3) m, quaternions : (n, 4), scales : (n, 3)
        Placement in the world at the key frames; no scales if its size is constant.
    colours : (n, 3) or None
        At the key frames, if they change.
    in_front
        Drawn in front of everything else, as closures lie within the bodies.
    active
        When it is drawn (s); None for always.
    """

    name: str
    parts: tuple[tuple[Shape, pin.SE3, Colour], ...]
    positions: FloatArray
    quaternions: FloatArray
    scales: FloatArray | None = None
    colours: FloatArray | None = None
    in_front: bool = False
    active: ActiveIntervals | None = None


@dataclass(frozen=True, eq=False)
class Trace:
    """The path ``points`` (n, 3) m of a point, in the world."""

    name: str
    points: FloatArray
    colour: Colour


@dataclass
class Overlays:
    """The overlays of a picture: animated shapes, paths, arrows, and their notes in the panel."""

    shapes: list[AnimatedShape] = field(default_factory=list)
    traces: list[Trace] = field(default_factory=list)
    notes: list[dict[str, Any]] = field(default_factory=list)
    arrows: Arrows | None = None
    arrow_ends: FloatArray = field(default_factory=lambda: np.empty((0, 3)))

    def points(self) -> FloatArray:
        """Points (n, 3) m that must be in view of the camera."""
        parts = [self.arrow_ends, *(trace.points for trace in self.traces)]
        return np.concatenate([*parts, *(shape.positions for shape in self.shapes)])


def active_springs(
    motion: DrawableMotion,
) -> list[tuple[SpringDamper, ActiveIntervals | None]]:
    """The force elements that are drawn, those between two points, with active intervals."""
    return active_elements(
        motion,
        lambda mechanism: [force for force in mechanism.forces if isinstance(force, SpringDamper)],
    )


def active_rods(motion: DrawableMotion) -> list[tuple[LoopClosure, ActiveIntervals | None]]:
    """The closures that are drawn as :func:`~srm_mbs.visualization.animation.shapes.rods`, with
    active intervals."""
    return active_elements(motion, rods)


def overlay_joints(motion: DrawableMotion, options: ViewOptions) -> set[int]:
    """Indices of the joints whose motion :func:`make_overlays` reads."""
    model = motion.mechanism.model
    anchors = options.anchors(motion.mechanism)
    for spring, _ in active_springs(motion):
        anchors += [spring.a.resolve(model), spring.b.resolve(model)]
    for rod, _ in active_rods(motion):
        anchors += rod.resolve(model)
    if options.arrows:
        return set(range(1, model.njoints))
    if options.reactions or options.gaps:
        for loop, _ in active_closures(motion):
            anchors += loop.resolve(model) if loop.anchors else ()
    return {joint for joint, _ in anchors} - {0}


def make_overlays(
    motion: DrawableMotion, options: ViewOptions, bodies: BodyMotion, extent: float
) -> Overlays:
    """Springs, massless rods, and the requested overlays, at the key frames of ``bodies``.

    Parameters
    ----------
    motion
        The run or prescribed motion.
    options
        The requested overlays.
    bodies
        Motion of the bodies, and of the :func:`overlay_joints`.
    extent
        Size of the picture, m.

    Raises
    ------
    InputError
        If an anchor cannot be traced, or the reactions are not known.
    """
    model = motion.mechanism.model
    out = Overlays()
    for number, (spring, active) in enumerate(active_springs(motion)):
        ends = [bodies.path(*side.resolve(model)) for side in (spring.a, spring.b)]
        drawn = _spring(f"spring_{number}", spring, ends, extent)
        out.shapes.append(replace(drawn, active=active))
    for number, (rod, active) in enumerate(active_rods(motion)):
        a, b = (bodies.path(*side) for side in rod.resolve(model))
        part = Cylinder(0.006 * extent, 1.0), ALONG_Z, ROD_COLOUR
        out.shapes.append(replace(_stretched(f"rod_{number}", (part,), a, b - a), active=active))
    for number, (joint, placement) in enumerate(options.anchors(motion.mechanism)):
        points = bodies.path(joint, placement)
        colour = TRACE_COLOURS[number % len(TRACE_COLOURS)]
        out.traces.append(Trace(f"trace_{number}", points, colour))
        out.shapes.append(_ball(f"point_{number}", 0.012 * extent, points, colour))
    for draw, requested in ((_draw_reactions, options.reactions), (_draw_gaps, options.gaps)):
        if requested:
            shapes, note = draw(motion, bodies, extent)
            out.shapes += shapes
            out.notes.append(note)
    if options.arrows:
        out.arrows = arrows_of(motion, bodies, extent)
        out.arrow_ends = out.arrows.ends(bodies)
        out.notes.append(out.arrows.note())
    return out


# Springs ------------------------------------------------------------------------------------


def _spring(
    name: str, spring: SpringDamper, ends: list[FloatArray], extent: float
) -> AnimatedShape:
    """A coil, a piston in its cylinder, or both."""
    arrows = ends[1] - ends[0]
    mean = float(np.linalg.norm(arrows, axis=1).mean()) or extent
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
    """A wire wound about z from 0 to 1, with straight ends on the axis.

    The cross-section of the wire is round when the coil is stretched to ``length`` (m).
    """
    angle = np.linspace(0.0, 2.0 * np.pi * COIL_TURNS, COIL_TURNS * POINTS_PER_TURN + 1)
    out = np.clip(np.minimum(angle, angle[-1] - angle) / (0.5 * np.pi), 0.0, 1.0) * radius
    height = (0.08 + 0.84 * angle / angle[-1]) * length
    line = np.column_stack([out * np.cos(angle), out * np.sin(angle), height])
    line = np.concatenate([[[0.0, 0.0, 0.0]], line, [[0.0, 0.0, length]]])
    outwards = np.column_stack([np.cos(angle), np.sin(angle), 0.0 * angle])
    outwards = np.concatenate([outwards[:1], outwards, outwards[-1:]])
    tangent = np.gradient(line, axis=0)
    second = np.cross(tangent, outwards)
    second /= np.linalg.norm(second, axis=1)[:, None]
    corners = 2.0 * np.pi * np.arange(WIRE_CORNERS) / WIRE_CORNERS
    wire = 0.16 * radius
    ring = np.cos(corners)[None, :, None] * outwards[:, None, :]
    ring = ring + np.sin(corners)[None, :, None] * second[:, None, :]
    vertices = (line[:, None, :] + wire * ring).reshape(-1, 3) / [1.0, 1.0, length]
    i, j = np.meshgrid(np.arange(len(line) - 1), np.arange(WIRE_CORNERS), indexing="ij")
    a, b = i * WIRE_CORNERS + j, i * WIRE_CORNERS + (j + 1) % WIRE_CORNERS
    c, d = a + WIRE_CORNERS, b + WIRE_CORNERS
    faces = [np.stack([a, b, d], axis=-1), np.stack([a, d, c], axis=-1)]
    return Mesh(vertices, np.concatenate([f.reshape(-1, 3) for f in faces]).astype(np.uint32))


# Gaps ---------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Gap:
    """The translational residual of one closure over time.

    Attributes
    ----------
    loop
        The closure.
    active
        When it is drawn (s); None for always.
    starts : (n, 3) m, arrows : (n, 3) m
        Origin of b in the world, and the component of the vector from there to the origin of a
        that the closure makes zero; zero while the closure is not active.
    """

    loop: LoopClosure
    active: ActiveIntervals | None
    starts: FloatArray
    arrows: FloatArray


def gaps_of(motion: DrawableMotion, times: FloatArray) -> list[Gap]:
    """The gaps at ``times`` (n,) s of the closures with anchors and rows of length."""
    model = motion.mechanism.model
    data = workspace(model)
    out, sides = [], []
    for loop, active in active_closures(motion):
        if len(loop.rows.directions) or loop.rows.distances:
            starts, arrows = np.zeros((len(times), 3)), np.zeros((len(times), 3))
            out.append(Gap(loop, active, starts, arrows))
            sides.append((loop.resolve(model), active_at(times, active, motion.span[1])))
    for i, q in enumerate(motion(times)[0]):
        pin.forwardKinematics(model, data, q)
        for gap, (((joint_a, in_a), (joint_b, in_b)), is_active) in zip(out, sides):
            b = data.oMi[joint_b] * in_b
            gap.starts[i] = b.translation
            if is_active[i]:
                p = b.actInv((data.oMi[joint_a] * in_a).translation)
                gap.arrows[i] = b.rotation @ _constrained_part(gap.loop, p)
    return out


def _constrained_part(loop: LoopClosure, p: FloatArray) -> FloatArray:
    """The component of a's position ``p`` (3,) m in b that the rows of length make zero."""
    directions = loop.rows.directions
    gap = directions.T @ (directions @ p)
    size = float(np.linalg.norm(p))
    for length in loop.rows.distances:
        gap = gap + (size - length) * p / (size or 1.0)
    return np.asarray(gap)


def _draw_gaps(
    motion: DrawableMotion, bodies: BodyMotion, extent: float
) -> tuple[list[AnimatedShape], dict[str, Any]]:
    """The gaps as bars, all exaggerated by the same factor, and their note."""
    gaps = gaps_of(motion, bodies.times)
    sizes = (float(np.linalg.norm(gap.arrows, axis=1).max()) for gap in gaps)
    largest = max(sizes, default=0.0)
    if not largest > 0.0:
        return [], {"text": "the closures have no gaps"}
    power = int(np.floor(np.log10(LARGEST_GAP * extent / largest)))
    bar = Cylinder(0.006 * extent, 1.0)
    middle = pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.5]))
    shapes = []
    for number, gap in enumerate(gaps):
        parts = ((bar, middle, GAP_COLOUR),)
        bars = _stretched(f"gap_{number}", parts, gap.starts, 10.0**power * gap.arrows)
        shapes.append(replace(bars, in_front=True, active=gap.active))
    return shapes, {
        "text": f"gaps of the closures, at most {largest:.1e} m, drawn 10"
        f"{str(power).translate(SUPERSCRIPTS)} times as large"
    }


# Reactions ----------------------------------------------------------------------------------


def _draw_reactions(
    motion: DrawableMotion, bodies: BodyMotion, extent: float
) -> tuple[list[AnimatedShape], dict[str, Any]]:
    """The closures as balls, coloured by their reaction force, and the legend.

    Raises
    ------
    InputError
        If the reactions are not known.
    """
    if not isinstance(motion, SimulationResult):
        raise InputError(
            "a motion that was not simulated has no reactions",
            element="reactions",
            remedy="Leave the option out",
        )
    model = motion.mechanism.model
    sizes = {
        name: np.linalg.norm(wrench[:, :3], axis=1)
        for name, wrench in motion.at(bodies.times).reactions.items()
    }
    loops = [(loop, active) for loop, active in active_closures(motion) if loop.name in sizes]
    # While a closure is not active it has no force, and none of zero either.
    active = [active_at(bodies.times, intervals, motion.span[1]) for _, intervals in loops]
    together = np.concatenate([sizes[loop.name][own] for (loop, _), own in zip(loops, active)])
    together = together[np.isfinite(together)]
    top = float(np.percentile(together, FORCE_PERCENTILE)) if len(together) else 0.0
    shapes = []
    for number, (loop, intervals) in enumerate(loops):
        path = bodies.path(*loop.resolve(model)[0])
        ball = _ball(f"closure_{number}", 0.014 * extent, path, (*RAMP[0], 1.0))
        colours = ramp_colours(sizes[loop.name] / top if top else 0.0 * sizes[loop.name])
        shapes.append(replace(ball, colours=colours, in_front=True, active=intervals))
    return shapes, {
        "text": "force in the closures",
        "ramp": [f"rgb({', '.join(str(round(255 * c)) for c in colour)})" for colour in RAMP],
        "ends": ["0", f"{top:.3g} N and more"],
    }


def ramp_colours(parts: FloatArray) -> FloatArray:
    """Colours (n, 3) at ``parts`` (n,) of the ramp, 0 to 1; those of its ends outside."""
    parts = np.nan_to_num(parts, nan=1.0, posinf=1.0)
    at = np.linspace(0.0, 1.0, len(RAMP))
    return np.column_stack([np.interp(parts, at, channel) for channel in np.array(RAMP).T])


# Orientation --------------------------------------------------------------------------------


def _ball(name: str, radius: float, path: FloatArray, colour: Colour) -> AnimatedShape:
    """A ball of ``radius`` (m) that moves along ``path`` (n, 3) m."""
    parts = ((Sphere(radius), pin.SE3.Identity(), colour),)
    return AnimatedShape(name, parts, path, np.tile([0.0, 0.0, 0.0, 1.0], (len(path), 1)))


def turns_along(directions: FloatArray) -> FloatArray:
    """Quaternions (n, 4) x, y, z, w that rotate z to ``directions`` (n, 3).

    Their sign is continuous.  Each follows from its predecessor by the shortest rotation, so that
    shapes do not twist.
    """
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
    return continuous_sign(out)


def _stretched(
    name: str,
    parts: tuple[tuple[Shape, pin.SE3, Colour], ...],
    starts: FloatArray,
    arrows: FloatArray,
) -> AnimatedShape:
    """Parts along z from 0 to 1 m, rotated and scaled to ``arrows`` (n, 3) m at ``starts``."""
    lengths = np.linalg.norm(arrows, axis=1)
    # A scale of zero has no inverse, which three.js needs for the light.
    scales = np.column_stack([np.ones((len(lengths), 2)), np.maximum(lengths, 1e-9)])
    return AnimatedShape(name, parts, starts, turns_along(arrows), scales)
