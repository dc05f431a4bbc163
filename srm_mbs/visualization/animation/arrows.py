"""Arrows of the forces and moments in a mechanism: reactions, drives and force elements.

An arrow is the force or the moment of one wrench, at the point of a body on which it acts, over
time.  The page draws it from there along the vector, at a scale that is the same for all forces,
and for all moments.  All arrows on a body together are what accelerates it, besides gravity and
what acts between the coordinates of its joints, which is part of their reactions.
"""

from __future__ import annotations

import base64
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from srm_mbs._kernel.workspace import workspace
from srm_mbs._typing import BoolArray, FloatArray
from srm_mbs.dynamics.constraints.wrenches import Placements, moved
from srm_mbs.dynamics.forces import ForceKinematics
from srm_mbs.errors import InputError
from srm_mbs.model.closures import LoopClosure
from srm_mbs.model.drives import Drive
from srm_mbs.model.forces import Bushing, SpringDamper, Wrench
from srm_mbs.simulation.result import SimulationResult
from srm_mbs.visualization.animation.shapes import Colour
from srm_mbs.visualization.animation.trajectory import (
    ActiveIntervals,
    BodyMotion,
    DrawableMotion,
    active_at,
    active_closures,
    active_elements,
)

COLOURS: dict[str, Colour] = {
    "reactions": (0.80, 0.00, 0.22, 1.0),
    "indeterminate reactions": (0.45, 0.45, 0.45, 1.0),
    "drives": (0.38, 0.12, 0.68, 1.0),
    "force elements": (0.00, 0.36, 0.36, 1.0),
}
"""Groups of arrows in the order of the legend; none has the colour of a body."""
LONGEST = {"force": 0.22, "moment": 0.06}
"""Length of the arrow of the largest force, and radius of the curved arrow of the largest moment,
over the extent of the picture."""
ROBUST_PERCENTILE = 98.0
"""Percentile over time of each arrow; the largest of them is that largest force or moment, as
reactions peak next to singular configurations."""
CUT = 1.5
"""Length or radius above which arrows are cut, over :data:`LONGEST`."""
NEGLIGIBLE = 1e-9
"""Part of the largest force below which a force is rounding; of this force times the extent of the
picture a moment."""
NOTABLE = 1e-6
"""Part of a force or moment above which an indeterminate component makes it indeterminate."""
MAX_NUMBERS = 75_000
"""Components of all arrows together at all times: some 430 kB in a page."""
FEWEST_TIMES = 50
"""Times of the arrows of very many joints."""
LINK_FORCES = (SpringDamper, Bushing, Wrench)


@dataclass(frozen=True, eq=False)
class Arrow:
    """One force or moment over time.

    Attributes
    ----------
    label
        What it is, for the panel.
    group
        One of :data:`COLOURS`.
    kind
        ``force`` (N) or ``moment`` (N m).
    on
        Joint whose body it acts on; 0 for the ground.
    source
        Joint whose body has the opposite at the same point; None if an arrow of its own shows it.
    joint, point
        Joint to which its point is fixed, and its position (3,) m there.
    vectors : (n, 3)
        In world axes at the :attr:`Arrows.times`; NaN while it does not act.
    """

    label: str
    group: str
    kind: str
    on: int
    source: int | None
    joint: int
    point: FloatArray
    vectors: FloatArray


@dataclass(frozen=True, eq=False)
class Arrows:
    """The arrows of a picture.

    Attributes
    ----------
    arrows
        All that are not negligible.
    times : (n,) s
        Key frames at which their vectors are known.
    frames : (n,)
        Numbers of these key frames.
    tops
        Largest robust force (N) and moment (N m), 0 without any.
    extent
        Size of the picture, m.
    indeterminate
        Names of the rows and components that equilibrium alone does not determine.
    """

    arrows: tuple[Arrow, ...]
    times: FloatArray
    frames: FloatArray
    tops: dict[str, float]
    extent: float
    indeterminate: tuple[str, ...]

    def length(self, kind: str) -> float:
        """Drawn length of one newton, or radius of one newton metre, m."""
        return LONGEST[kind] * self.extent / self.tops[kind] if self.tops[kind] else 0.0

    def ends(self, bodies: BodyMotion) -> FloatArray:
        """Ends (k, 3) m of all arrows at their times."""
        parts = [np.empty((0, 3))]
        for arrow in self.arrows:
            start = bodies.path(arrow.joint, pin.SE3(np.eye(3), arrow.point))[self.frames]
            drawn = self.length(arrow.kind) * arrow.vectors
            size = np.linalg.norm(drawn, axis=1, keepdims=True)
            longest = CUT * LONGEST[arrow.kind] * self.extent
            parts.append(start + drawn * np.minimum(1.0, longest / np.maximum(size, 1e-300)))
        ends = np.concatenate(parts)
        return ends[np.isfinite(ends).all(axis=1)]

    def data(self, nodes: Sequence[str]) -> dict[str, Any]:
        """The arrows for the page, ready for JSON; ``nodes`` are the names of those of the bodies.

        Vectors are base64 of little-endian single precision.
        """
        return {
            "times": [float(f"{t:.9g}") for t in self.times.tolist()],
            "size": self.extent,
            "scales": {
                kind: {
                    "length": self.length(kind),
                    "longest": CUT * LONGEST[kind] * self.extent,
                    "unit": "N" if kind == "force" else "N m",
                }
                for kind in LONGEST
            },
            "arrows": [
                {
                    "label": arrow.label,
                    "colour": [round(part, 3) for part in COLOURS[arrow.group][:3]],
                    "kind": arrow.kind,
                    "on": nodes[arrow.on],
                    "source": None if arrow.source is None else nodes[arrow.source],
                    "node": nodes[arrow.joint],
                    "point": arrow.point.tolist(),
                    "vectors": base64.b64encode(arrow.vectors.astype("<f4").tobytes()).decode(),
                }
                for arrow in self.arrows
            ],
        }

    def note(self) -> dict[str, Any]:
        """The legend."""
        if not self.arrows:
            return {"text": "no forces act in the mechanism"}
        used = [group for group in COLOURS if any(a.group == group for a in self.arrows)]
        kinds = [kind for kind in LONGEST if any(a.kind == kind for a in self.arrows)]
        words = {"force": "forces", "moment": "moments (curved)"}
        text = " and ".join(words[kind] for kind in kinds)
        note: dict[str, Any] = {
            "text": text,
            "bars": kinds,
            "keys": [{"colour": _css(COLOURS[group]), "text": group} for group in used],
        }
        if "indeterminate reactions" in used:
            note["more"] = "indeterminate: least norm, as equilibrium alone does not determine them"
        return note


def _css(colour: Colour) -> str:
    return f"rgb({', '.join(str(round(255 * part)) for part in colour[:3])})"


def arrows_of(motion: DrawableMotion, bodies: BodyMotion, extent: float) -> Arrows:
    """The arrows of a run.

    Parameters
    ----------
    motion
        The run.
    bodies
        Motion of its bodies, at the key frames.
    extent
        Size of the picture, m.

    Raises
    ------
    InputError
        If the motion was not simulated, or the reactions are not known.
    """
    if not isinstance(motion, SimulationResult):
        raise InputError(
            "a motion that was not simulated has no forces",
            element="arrows",
            remedy="Leave the option out",
        )
    count = max(1, 6 * (motion.mechanism.model.njoints + len(motion.mechanism.loops)))
    allowed = min(max(MAX_NUMBERS // count, FEWEST_TIMES), len(bodies.times))
    frames = np.unique(np.linspace(0, len(bodies.times) - 1, allowed).round().astype(int))
    found = _Wrenches(motion, bodies.times[frames])
    made = [arrow for wrench in found.all() for arrow in _arrows(*wrench)]
    made = [arrow for arrow in made if np.isfinite(arrow.vectors).any()]
    largest = {
        kind: max((_size(a, 100.0) for a in made if a.kind == kind), default=0.0)
        for kind in LONGEST
    }
    floors = {
        "force": NEGLIGIBLE * largest["force"],
        "moment": NEGLIGIBLE * max(largest["moment"], largest["force"] * extent),
    }
    kept = tuple(arrow for arrow in made if _size(arrow, 100.0) > floors[arrow.kind])
    tops = {
        kind: max((_size(a, ROBUST_PERCENTILE) for a in kept if a.kind == kind), default=0.0)
        for kind in LONGEST
    }
    return Arrows(kept, bodies.times[frames], frames, tops, extent, found.indeterminate)


def _size(arrow: Arrow, percentile: float) -> float:
    sizes = np.linalg.norm(arrow.vectors, axis=1)
    return float(np.percentile(sizes[np.isfinite(sizes)], percentile))


_Wrench = tuple[str, tuple[str, str], int, int | None, int, FloatArray, FloatArray]


def _arrows(
    name: str,
    groups: tuple[str, str],
    on: int,
    source: int | None,
    joint: int,
    point: FloatArray,
    wrench: FloatArray,
) -> Iterator[Arrow]:
    """Force and moment of ``wrench`` (n, 6), of the ``groups`` of each."""
    for kind, group, part in zip(LONGEST, groups, (wrench[:, :3], wrench[:, 3:])):
        yield Arrow(f"{kind} {name}", group, kind, on, source, joint, point, part)


class _Wrenches:
    """The wrenches of a run at ``times`` (n,) s."""

    def __init__(self, motion: SimulationResult, times: FloatArray) -> None:
        self.motion, self.times = motion, times
        self.run = motion.at(times)
        self.model = motion.mechanism.model
        self.placed = Placements.at(self.model, workspace(self.model), self.run.q)
        self.indeterminate = (
            *motion.indeterminate_reactions,
            *motion.indeterminate_joint_reactions,
        )

    def all(self) -> Iterator[_Wrench]:
        """Label, groups of force and moment, body, other body, joint and point, wrench (n, 6)."""
        yield from self.closures()
        yield from self.joints()
        yield from self.drives()
        yield from self.forces()

    def closures(self) -> Iterator[_Wrench]:
        reactions = self.run.reactions
        for loop, active in active_closures(self.motion):
            if loop.name not in reactions:
                continue
            (a, _), (b, in_b) = loop.resolve(self.model)
            wrench, rows = self._while_active(reactions[loop.name], active), loop.row_names
            lam = self.run.reaction_multipliers[loop.name]
            lengths, turns, _ = loop.rows.blocks
            groups = (
                self._group(rows[lengths], lam[:, lengths], wrench[:, :3]),
                self._group(rows[turns], lam[:, turns], wrench[:, 3:]),
            )
            yield f"in {loop.name}", groups, b, a, b, in_b.translation.copy(), wrench

    def joints(self) -> Iterator[_Wrench]:
        # What a drive exerts has an arrow of its own.
        driven = {
            drive.joint: self._of_drive(drive)
            for drive, _ in self._drives()
            if drive.joint is not None
        }
        for name, wrench in self.run.joint_reactions.items():
            joint = self.model.getJointId(name)
            if name in driven:
                wrench = wrench - np.nan_to_num(driven[name])
            force, moment = wrench[:, :3], wrench[:, 3:]
            groups = (
                self._group([f"{name}.f{axis}" for axis in "xyz"], force, force),
                self._group([f"{name}.m{axis}" for axis in "xyz"], moment, moment),
            )
            parent = int(self.model.parents[joint])
            yield f"in {name}", groups, joint, parent, joint, np.zeros(3), wrench

    def drives(self) -> Iterator[_Wrench]:
        groups = ("drives", "drives")
        for drive, active in self._drives():
            wrench = self._while_active(self._of_drive(drive), active)
            if drive.joint is not None:
                joint = self.model.getJointId(drive.joint)
                parent = int(self.model.parents[joint])
                yield f"of {drive.name}", groups, joint, parent, joint, np.zeros(3), wrench
                continue
            (a, in_a), (b, _) = _closure(drive).resolve(self.model)
            yield f"of {drive.name}", groups, a, b, a, in_a.translation.copy(), wrench

    def forces(self) -> Iterator[_Wrench]:
        groups = ("force elements", "force elements")
        data = workspace(self.model)
        for force, active in active_elements(
            self.motion,
            lambda mechanism: [f for f in mechanism.forces if isinstance(f, LINK_FORCES)],
        ):
            kinematics = ForceKinematics(self.model, [force])
            about_world = np.empty((len(self.times), 6))
            for i, (t, q, v) in enumerate(zip(self.times, self.run.q, self.run.v)):
                pin.forwardKinematics(self.model, data, q, v)
                (found,) = kinematics.between_links(data, q, v, t)
                about_world[i] = found.wrench
            about_world = self._while_active(about_world, active)
            sides = [force.at] if isinstance(force, Wrench) else [force.a, force.b]
            for side, sign in zip(sides, (1.0, -1.0)):
                joint, inside = side.resolve(self.model)
                at = self.placed.of(joint, inside)[1]
                wrench = sign * moved(about_world, at)
                point = inside.translation.copy()
                yield f"of {force.name}", groups, joint, None, joint, point, wrench

    def _drives(self) -> list[tuple[Drive, ActiveIntervals | None]]:
        return active_elements(self.motion, lambda mechanism: mechanism.drives)

    def _of_drive(self, drive: Drive) -> FloatArray:
        """The wrench (n, 6) of a drive on the child of its joint, or on a at a's origin."""
        size = self.run.drive_forces[drive.name]
        out = np.zeros((len(self.times), 6))
        if drive.joint is not None:
            joint = self.model.getJointId(drive.joint)
            axis = self._subspace(joint)
            rotation = self.placed.rotation[:, joint]
            for part in (slice(0, 3), slice(3, 6)):
                out[:, part] = (rotation @ axis[part]) * size[:, None]
            return out
        (_, at_a), (turned, at_b) = (
            self.placed.of(*side) for side in _closure(drive).resolve(self.model)
        )
        if drive.distance:
            apart = at_a - at_b
            along = apart / np.linalg.norm(apart, axis=1, keepdims=True)
        else:
            along = turned @ np.asarray(drive.axis, dtype=float)
        out[:, :3] = along * size[:, None]
        return out

    def _subspace(self, joint: int) -> FloatArray:
        """Direction (6,) of a unit force on the coordinate of a joint, in its own axes."""
        q = self.run.q[0]
        data = workspace(self.model)
        column = int(self.model.joints[joint].idx_v)
        jacobian = pin.computeJointJacobian(self.model, data, q, joint)
        return np.array(jacobian[:, column])

    def _while_active(self, wrench: FloatArray, active: ActiveIntervals | None) -> FloatArray:
        there: BoolArray = active_at(self.times, active, self.motion.span[1])
        return np.where(there[:, None], wrench, np.nan)

    def _group(self, names: Sequence[str], parts: FloatArray, whole: FloatArray) -> str:
        """The group of a force or moment ``whole`` (n, 3), which the ``parts`` (n, k) of these
        ``names`` make up: of planar mechanisms only what is zero is indeterminate."""
        some = np.isin(names, self.indeterminate)
        largest = np.nanmax(np.abs(parts[:, some]), initial=0.0)
        size = np.nanmax(np.abs(whole), initial=0.0)
        return "indeterminate reactions" if largest > NOTABLE * size else "reactions"


def _closure(drive: Drive) -> LoopClosure:
    """The closure of a drive between points."""
    closure = drive.closure
    if closure is None:
        raise TypeError(f"drive {drive.name!r} is that of a joint")
    return closure
