"""What is drawn beside the bodies: springs, paths of points, gaps and reactions of closures.

All of it is computed at the key frames.  What an event lets go or adds is drawn while it is there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from srm_mbs.anchors import Anchor, resolve_moving
from srm_mbs.arrays import FloatArray
from srm_mbs.closure_overlays import draw_gaps, draw_reactions
from srm_mbs.errors import InputError
from srm_mbs.forces import SpringDamper
from srm_mbs.mechanism import Mechanism
from srm_mbs.moving import Moving, Trace, no_turn, path_of, stretched
from srm_mbs.spans import Spans, loops_of, spans_of
from srm_mbs.visuals import Colour, Cylinder, Mesh, Shape, Sphere

if TYPE_CHECKING:
    from srm_mbs.motion import Playable
    from srm_mbs.scene import Motion

SPRING_COLOUR: Colour = (0.35, 0.38, 0.42, 1.0)
DAMPER_COLOUR: Colour = (0.60, 0.63, 0.67, 1.0)
TRACE_COLOURS: tuple[Colour, ...] = (  # as srm_mbs.visuals.PALETTE, darker: lines are thin
    (0.835, 0.369, 0.000, 1.0),
    (0.000, 0.350, 0.560, 1.0),
    (0.000, 0.480, 0.350, 1.0),
    (0.620, 0.300, 0.480, 1.0),
)
TURNS, AROUND, SECTION = 7, 12, 5
"""Of a coil: turns, points around one, corners of the wire."""


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


def joints_of(solution: Playable, wanted: Wanted) -> set[int]:
    """Joints whose motion :func:`make_overlays` needs."""
    model = solution.mechanism.model
    anchors = wanted.anchors(solution.mechanism)
    for spring, _ in springs_of(solution):
        anchors += [spring.a.resolve(model), spring.b.resolve(model)]
    if wanted.reactions or wanted.gaps:
        for loop, _ in loops_of(solution):
            anchors += loop.resolve(model) if loop.anchors else ()
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
