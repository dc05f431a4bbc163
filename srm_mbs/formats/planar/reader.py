"""From the drawing of a planar linkage to a tree of links and joints, and closures.

Pins, and sliders with mass, are the joints of a graph whose nodes are the ground and the bars
(:mod:`srm_mbs.formats.graph.joint_graph`); sliders without mass are slots, of two degrees of
freedom, which the spanning tree cuts first.  A joint is called after its pin, or ``pin:bar`` where
more than two bodies meet, a slide after its slider.

The x axis of the drawing is x of the world, its y axis z of the world; joints turn about -y, so
that angles count from x to y.  A link has its origin at the joint that carries it, and its x axis
from there to the next of its points: the angle of a pin on the ground is that of its bar.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from copy import copy
from dataclasses import replace
from functools import lru_cache, partial
from types import MappingProxyType
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element

import numpy as np
import pinocchio as pin

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.errors import InputError, known_names, naming
from srm_mbs.formats.document import Document
from srm_mbs.formats.graph.joint_graph import (
    Body,
    Joint,
    SpanningTree,
    components,
    distances,
    spanning_tree,
)
from srm_mbs.formats.graph.spanning_tree_to_urdf import IDENTITY_ROUNDING, closure, urdf_tree
from srm_mbs.formats.planar.drawing import Change, Drawing, fault, listed
from srm_mbs.formats.planar.shapes import (
    GREY,
    PALETTE,
    bar_visuals,
    block,
    body_inertia,
    direction_angle,
    in_space,
    pin_visual,
    rod,
    slender,
    slender_body,
    turned,
)
from srm_mbs.formats.planar.variants import model_of_variant, plain_parts
from srm_mbs.formats.toml.parameters import Place
from srm_mbs.formats.toml.schema import PlanarEntry, PlanarSlider
from srm_mbs.formats.translation import PLANAR, Numbers, Options, Translation, urdf_text
from srm_mbs.model.anchors import WORLD
from srm_mbs.model.lazy import cached_property

HINGE_AXIS = (0.0, -1.0, 0.0)
"""Axis of all pins, in the axes of the world."""
KEPT_GRAPHS = 64
"""Graphs of joints whose spanning trees are kept: variants of a linkage have the same."""
UNTURNED = np.eye(3)
"""Rotation of the frames of links against each other, as drawn."""
WIDTH = 0.02
"""Width of a bar as it is drawn, over the size of the drawing."""
LAW_VALUES: Mapping[str, tuple[str, ...]] = {
    "constant_speed": ("speed",),
    "sine": ("amplitude", "offset"),
    "polynomial": ("coefficients",),
    "minimum_jerk": ("target",),
    "table": ("values",),
}
"""Keys of laws whose numbers are in the unit of the coordinate that follows it."""


def translate(document: Document, options: Options) -> Translation:
    """The tree and the entries of the section ``[planar]`` of a description.

    Raises
    ------
    InputError
        Naming the point, bar, slider or pin that cannot be.
    """
    if options.planar is None:  # pragma: no cover - the format is found by this section
        raise InputError("there is no section [planar]", remedy="Add it", file=document.file)
    with naming(file=document.file):
        if options.own.get("base", "fixed") != "fixed":
            raise fault("base", "a planar linkage stands on its ground", "Remove base")
        return _Linkage(options.planar, options).translation()


class _Connections(NamedTuple):
    """How the bodies of a linkage are joined: the same for all its variants.

    Attributes
    ----------
    loose
        The first bodies that are not connected with the ground; without any, the rest follows.
    hubs
        The body nearest to the ground at each point, which the others there are joined with.
    joints
        Name, type, parent, child and point of all joints.
    """

    loose: tuple[str, ...]
    hubs: Mapping[str, str]
    joints: tuple[tuple[str, str, str, str, str], ...]


@lru_cache(maxsize=KEPT_GRAPHS)
def _connections(
    bodies: tuple[str, ...],
    carriers: tuple[tuple[str, tuple[str, ...]], ...],
    sliders: tuple[tuple[str, str, str, bool], ...],
) -> _Connections:
    """The connections of ``bodies``, the ground first.

    Parameters
    ----------
    carriers
        Points, and the bodies that have each.
    sliders
        Name, point, the body on which it slides, and whether it has mass.
    """
    at = dict(carriers)
    links = [(there[0], other) for there in at.values() for other in there[1:]]
    links += [(on, body) for _, point, on, _ in sliders for body in at[point]]
    named = [Joint(str(k), "revolute", a, b) for k, (a, b) in enumerate(links)]
    parts = components({name: Body(name) for name in bodies}, named)
    loose = next((tuple(part) for part in parts if WORLD not in part), ())
    if loose:
        return _Connections(loose, {}, ())
    depths = distances(named, WORLD)
    hubs = {
        point: min(there, key=lambda body: (depths[body], bodies.index(body)))
        for point, there in carriers
        if there
    }
    joints = []
    # Slides first: of joints that could be cut equally well, they stay in the tree.
    for name, point, on, massive in sliders:
        kind, child = ("prismatic", name) if massive else ("slot", hubs[point])
        joints.append((name, kind, on, child, point))
    for point, there in carriers:
        for body in there:
            if body != hubs[point]:
                name = point if len(there) == 2 else f"{point}:{body}"
                joints.append((name, "revolute", hubs[point], body, point))
    return _Connections((), MappingProxyType(hubs), tuple(joints))


@lru_cache(maxsize=KEPT_GRAPHS)
def _spanned(
    joints: tuple[tuple[str, str, str, str, bool], ...], cut: tuple[str, ...]
) -> SpanningTree:
    """The spanning tree of joints: name, type, parent, child, and whether the tree keeps it."""
    named = [
        Joint(name, kind, parent, child, coupled=coupled)
        for name, kind, parent, child, coupled in joints
    ]
    return spanning_tree(named, WORLD, cut)


class _Linkage:
    """One linkage on its way from the drawing to the tree."""

    def __init__(self, entry: PlanarEntry, options: Options) -> None:
        self.entry, self.options = entry, options
        self.drawing = Drawing(entry)
        self.bodies: list[str] = list(self.drawing.bodies)
        self.slots: list[PlanarSlider] = [each for each in entry.slider if not each.mass]
        self.connections = self._connected()
        self.points_of_joints = {name: point for name, *_, point in self.connections.joints}
        """The point of each joint."""
        self.joints = self._tree()
        for joint in self.joints:
            if joint.type == "revolute" and joint.child in self.drawing.bars:
                self.drawing.begin(joint.child, self._point(joint))
        self.origins = {WORLD: np.zeros(2)} | {
            joint.child: self.drawing.on_body(joint.child, self._drawn(joint), self._point(joint))
            for joint in self.joints
        }
        """Of the links, in the axes of :meth:`Drawing.on_body`."""
        self._local_places: dict[tuple[str, str], FloatArray] = {}
        """Results of :meth:`_local`."""

    # -- the graph ---------------------------------------------------------------------------

    def _connected(self) -> _Connections:
        """How its bodies are joined, all with the ground."""
        drawing = self.drawing
        found = _connections(
            drawing.bodies,
            drawing.carried,
            tuple((s.name, s.point, s.on or WORLD, bool(s.mass)) for s in self.entry.slider),
        )
        first = found.loose
        if first:
            one = len(first) == 1
            raise fault(
                f"bar {first[0]!r}" if one else f"bars {listed(first)}",
                "nothing connects it with the ground"
                if one
                else "nothing connects them with the ground",
                "Give it a point of another bar, or one of its points to ground",
            )
        return found

    @cached_property
    def _acted_on(self) -> dict[str, str]:
        """Joints that the description names, which the tree therefore keeps, and where."""
        entry, own = self.entry, self.options.own
        found: dict[str, str] = {}
        for kind in ("start", "rates"):
            found |= dict.fromkeys(getattr(entry, kind), f"planar.{kind}")
        for kind in ("torque", "drive"):
            for i, each in enumerate(getattr(entry, kind)):
                found[each.pin] = f"planar.{kind}[{i}].pin"
        known = dict.fromkeys(own.get("lock", ()), "")
        for part in ("q", "v", "guess"):
            known |= dict.fromkeys(own.get("initial", {}).get(part, ()), "")
        for kind in ("force", "drive", "loop"):
            for table in own.get(kind, ()):
                known |= dict.fromkeys([*table.get("joints", ()), table.get("joint", "")], "")
        return known | found

    def _tree(self) -> list[Joint]:
        graph = self.connections.joints
        names = [name for name, *_ in graph]
        if len(self.points_of_joints) < len(names):
            name = next(name for name in names if names.count(name) > 1)
            raise fault(
                f"slider {name!r}", "a pin has the same name", "Give one of them another name"
            )
        for name, where in self._acted_on.items():
            if where and name not in names:
                raise fault(where, f"there is no pin or slider {name!r}", known_names(names))
        kept = tuple((*joint[:4], joint[0] in self._acted_on) for joint in graph)
        tree = _spanned(kept, tuple(self.options.cut))
        for joint in tree.cut:
            if joint.name in self._acted_on:
                raise fault(
                    self._acted_on[joint.name] or f"pin {joint.name!r}",
                    f"{joint.name!r} closes a loop whose other joints are named too or kept: it "
                    "has no coordinate",
                    "Remove one of them",
                )
        self.cut = tree.cut
        return [part for joint in tree.joints for part in self._expanded(joint)]

    def _expanded(self, joint: Joint) -> list[Joint]:
        """A slot of the tree as the slide and the pin of a massless body; others as they are."""
        if joint.type != "slot":
            return [joint]
        slider = self.drawing.sliders[joint.name]
        on = slider.on or WORLD
        forward = joint.parent == on
        hub = joint.child if forward else joint.parent
        others = self.drawing.carriers(slider.point)
        name = slider.point if len(others) == 1 else f"{slider.point}:{slider.name}"
        self.points_of_joints[name] = slider.point
        self.slots.remove(slider)
        self.bodies.append(slider.name)
        slide = Joint(joint.name, "prismatic", on, slider.name, coupled=joint.coupled)
        pin_ = Joint(name, "revolute", slider.name, hub)
        return [slide, pin_] if forward else [pin_.reversed(), slide.reversed()]

    # -- geometry ----------------------------------------------------------------------------

    def _point(self, joint: Joint) -> str:
        return self.points_of_joints[joint.name]

    def _drawn(self, joint: Joint) -> FloatArray:
        return self.drawing.points[self._point(joint)]

    def _local(self, body: str, point: str) -> FloatArray:
        """A point (2,) in the frame of the link of a body."""
        key = body, point
        if key not in self._local_places:
            drawing = self.drawing
            at = drawing.on_body(body, drawing.points[point], point)
            self._local_places[key] = at - self.origins[body]
        return self._local_places[key]

    def _at(self, body: str, point: str) -> pin.SE3:
        return pin.SE3(UNTURNED, in_space(self._local(body, point)))

    def _anchor(self, body: str, point: str) -> dict[str, Any]:
        x, y = self._local(body, point).tolist()
        if max(abs(x), abs(y)) <= IDENTITY_ROUNDING:
            return {"link": body}
        return {"link": body, "xyz": [x + 0.0, 0.0, y + 0.0]}

    def _carrier(self, point: str, element: str) -> str:
        """The body on which a point is fixed."""
        self.drawing.point(point, element)
        bodies = self.drawing.carriers(point)
        if not bodies:
            raise fault(element, f"point {point!r} is on no bar", "Give it to a bar, or to ground")
        return self.connections.hubs[point]

    def _line(self, slider: PlanarSlider, normal: bool = False) -> tuple[float, float, float]:
        """Direction of the line of a slider, or its normal, in the body on which it slides."""
        angle = self.drawing.direction(slider) - self.drawing.body_angle(slider.on)
        unit = turned(np.array([1.0, 0.0]), angle + (0.5 * math.pi if normal else 0.0))
        unit[np.abs(unit) < 1e-15] = 0.0
        x, y, z = in_space(unit).tolist()
        return (x, y + 0.0, z)

    # -- the tree ----------------------------------------------------------------------------

    def translation(self) -> Translation:
        drawing, entry = self.drawing, self.entry
        entries: dict[str, Any] = {}
        if entry.gravity is not None:
            if "gravity" in self.options.own:
                raise fault("planar.gravity", "gravity is given twice", "Remove one of the two")
            x, y = entry.gravity
            entries["gravity"] = [x, 0.0, y]
        found = {
            "loop": list(self._closures()),
            "force": list(self._forces()),
            "drive": list(self._drives()),
            "initial": self._initial(),
        }
        entries |= {key: tables for key, tables in found.items() if tables}
        entries["points"] = {
            name: self._anchor(self._carrier(name, f"point {name!r}"), name)
            for name in drawing.points
        }
        bodies, joints = self._parts
        model = model_of_variant(self.options.known, bodies, joints)
        return Translation(
            Element("robot") if model is not None else self._urdf(drawn=False),
            lambda: urdf_text(self._urdf(drawn=True)),
            entries,
            tuple(self._notes()),
            check=self.check,
            parts=plain_parts(bodies, joints) if model is None else None,
            model=model,
            vary=self.variants if model is None else None,
        )

    @cached_property
    def _parts(self) -> tuple[list[Body], list[Joint]]:
        """Bodies, without what is drawn, and the joints of the tree."""
        bodies = [Body(name, self._inertia(name)) for name in self.bodies[1:]]
        return bodies, list(map(self._placed, self.joints))

    def _urdf(self, drawn: bool) -> Element:
        """The tree; most of it is what is only ``drawn``."""
        bodies, joints = self._parts
        if drawn:
            bodies = [replace(body, visuals=self._visuals(body.name)) for body in bodies]
        name = self.options.own.get("name", "") or "linkage"
        tree = urdf_tree(name, bodies, joints)
        if drawn:
            world = next(link for link in tree.findall("link") if link.get("name") == WORLD)
            world.extend(self._ground_visuals())
        return tree

    def _placed(self, joint: Joint) -> Joint:
        """A joint of the tree with its frame on the parent; that on the child is the link's."""
        place, axis = self._at(joint.parent, self._point(joint)), HINGE_AXIS
        if joint.type != "revolute":
            slider = self.drawing.sliders[joint.name]
            x, y, z = self._line(slider)
            axis = (x, y, z) if joint.child == slider.name else (-x, y, -z)
        return Joint(joint.name, joint.type, joint.parent, joint.child, place, axis=axis)

    def _inertia(self, body: str) -> pin.Inertia | None:
        drawing = self.drawing
        if body in drawing.sliders:
            slider = drawing.sliders[body]
            tensor = np.diag([0.5, 1.0, 0.5]) * slider.inertia
            at = self._local(body, slider.point)
            return body_inertia(slider.mass, at, tensor) if slider.mass else None
        bar = drawing.bars[body]
        shape = slender(drawing.shape(body) - self.origins[body])
        mass = bar.mass
        if mass is None:
            density = bar.mass_per_length
            density = self.entry.mass_per_length if density is None else density
            mass = shape.length * (density or 0.0)
        if not mass:
            return None
        centre = shape.centre
        if bar.centre is not None:
            place = drawing.unit * np.array(bar.centre)
            centre = drawing.on_body(body, place) - self.origins[body]
        return slender_body(shape, mass, centre, bar.inertia)

    # -- closures, forces, start ---------------------------------------------------------------

    def _closures(self) -> Iterator[dict[str, Any]]:
        """A cut pin is a point, a slot a point on a line of the plane: out of the plane, rows of a
        closure are zero."""
        for joint in self.cut:
            point = self._point(joint)
            a, b = self._anchor(joint.child, point), self._anchor(joint.parent, point)
            if joint.type == "revolute":
                yield {"name": joint.name, "type": "point", "a": a, "b": b}
                continue
            slider = self.drawing.sliders[joint.name]
            if joint.type == "slot":
                normal = list(self._line(slider, normal=True))
                yield {"name": joint.name, "type": "point_on_plane", "a": a, "b": b, "axis": normal}
                continue
            yield closure(
                "prismatic",
                joint.name,
                (joint.parent, self._at(joint.parent, point)),
                (joint.child, self._at(joint.child, point)),
                self._line(slider),
                fault=partial(fault, f"slider {joint.name!r}"),
            )

    def _forces(self) -> Iterator[dict[str, Any]]:
        for i, spring in enumerate(self.entry.spring):
            element = f"spring {spring.name!r}" if spring.name else f"spring[{i}]"
            ends = [self._carrier(point, element) for point in (spring.a, spring.b)]
            first, second = map(self.drawing.carriers, (spring.a, spring.b))
            together = [name for name in first if name in second]
            if together:
                where = "the ground" if together[0] == WORLD else f"bar {together[0]!r}"
                raise fault(
                    element,
                    f"its points {spring.a!r} and {spring.b!r} are both on {where}",
                    "Give points that move against each other",
                )
            out: dict[str, Any] = {
                "type": "spring_damper",
                "name": spring.name or f"{spring.a}_{spring.b}",
                "a": self._anchor(ends[0], spring.a),
                "b": self._anchor(ends[1], spring.b),
                "stiffness": spring.stiffness,
                "damping": spring.damping,
            }
            if spring.rest_length is not None:
                out["rest_length"] = self.drawing.unit * spring.rest_length
            elif spring.stiffness:
                raise fault(
                    element, "a spring needs a rest_length", "Give its length without force"
                )
            yield out
        for torque in self.entry.torque:
            yield {"type": "torque", "joint": torque.pin, "torque": torque.torque}
        for i, load in enumerate(self.entry.load):
            body = self._carrier(load.point, f"load[{i}]")
            if body == WORLD:
                raise fault(
                    f"load[{i}]", f"point {load.point!r} is on the ground", "Give one that moves"
                )
            x, y = load.force
            yield {
                "type": "wrench",
                "name": f"load_{load.point}",
                "at": self._anchor(body, load.point),
                "force": [x, 0.0, y],
            }

    def _factor(self, joint: str) -> float:
        """The unit of a coordinate in the section: m of slides, rad of pins."""
        return self.drawing.unit if joint in self.drawing.sliders else self.drawing.angle

    def _drives(self) -> Iterator[dict[str, Any]]:
        for i, drive in enumerate(self.entry.drive):
            table = drive.model_dump(exclude_none=True)
            joint, factor = table.pop("pin"), self._factor(drive.pin)
            if not table["absolute"]:
                del table["absolute"]
            if "table" in table and factor != 1.0:
                raise fault(
                    f"planar.drive[{i}].table",
                    "tables of files are in rad and m",
                    "Give a [[drive]] outside of [planar], or the section in rad and m",
                )
            for key in LAW_VALUES.get(table["type"], ()):
                if key in table:
                    values = factor * np.array(table[key])
                    table[key] = values.tolist()
            yield {"joint": joint, **table}

    def _initial(self) -> dict[str, Any]:
        start = {name: self._factor(name) * value for name, value in self.entry.start.items()}
        angles = {}
        for joint in self.joints:
            if joint.type == "revolute" and joint.name not in start:
                turn = self.drawing.body_angle(joint.child) - self.drawing.body_angle(joint.parent)
                angles[joint.name] = math.remainder(turn, 2.0 * math.pi)
        rates = {name: self._factor(name) * value for name, value in self.entry.rates.items()}
        parts = {"q": start, "v": rates, "guess": angles}
        return {part: values for part, values in parts.items() if values}

    def _notes(self) -> Iterator[str]:
        for a, b in self.drawing.coinciding():
            yield (
                f"the points {a!r} and {b!r} coincide as drawn and are two pins: nothing joins "
                "them there"
            )

    def check(self, mechanism: Mechanism) -> None:
        """Refuse a linkage that cannot move."""
        if mechanism.degrees_of_freedom == 0 and not mechanism.drives:
            raise fault(
                f"bars {listed(self.drawing.bars)}",
                "they form a structure: the linkage has no degree of freedom",
                "Remove a bar, or a point from ground, or let a pin slide",
            )

    # -- variants ------------------------------------------------------------------------------

    def variants(self, places: Sequence[Place]) -> LinkageVariants | None:
        """The variants whose numbers at ``places`` of the description vary; None where they change
        more than points, masses and the start."""
        change = self._change(places)
        return None if change is None else LinkageVariants(self, change, tuple(places))

    def _change(self, places: Sequence[Place]) -> Change | None:
        """All that the numbers at ``places`` of the description may change; None where that is more
        than points, masses and the start."""
        entry, points, bars, masses = self.entry, set[str](), set[str](), set[str]()
        for section, *place in places:
            match place if section == PLANAR else ():
                case ["points", str(name), _]:
                    points.add(name)
                case ["bar", int(i), str(key), *_] if key in NUMBERS_OF_BARS:
                    (bars if key == "length" else masses).add(entry.bar[i].name)
                case ["slider", int(i), "mass" | "inertia"]:
                    masses.add(entry.slider[i].name)
                case ["length", int(i), "length"]:
                    ends = set(entry.length[i].between)
                    bars.update(bar.name for bar in entry.bar if ends <= set(bar.points))
                case ["mass_per_length"]:
                    masses.update(bar.name for bar in entry.bar)
                case ["start" | "rates", str()]:
                    pass
                case _:
                    return None
        bars.update(bar.name for bar in entry.bar if not points.isdisjoint(bar.points))
        for slider in entry.slider:
            if slider.point in points or slider.on in bars:
                bars.add(slider.name)
        return Change(frozenset(points), frozenset(bars), frozenset(masses))

    @staticmethod
    def _varies(body: str, point: str, change: Change) -> bool:
        """Whether a point may be elsewhere in a body."""
        return body in change.bodies or point in change.points

    def varied(self, entry: PlanarEntry, change: Change) -> _Linkage | None:
        """The same linkage with the numbers of ``entry``; None as for :meth:`Drawing.varied`."""
        drawing = self.drawing.varied(entry, change)
        if drawing is None:
            return None
        out = copy(self)
        out.entry, out.drawing = entry, drawing
        out.origins = dict(self.origins)
        for joint in self.joints:
            point = self._point(joint)
            if self._varies(joint.child, point, change):
                out.origins[joint.child] = drawing.on_body(joint.child, out._drawn(joint), point)
        out._local_places = {
            place: at
            for place, at in self._local_places.items()
            if not self._varies(*place, change)
        }
        return out

    def numbers(self, first: _Linkage, change: Change) -> Numbers | None:
        """The numbers that differ from those of the linkage ``first``, of which this is a variant;
        None if an axis differs, or whether a body has mass."""
        moved = []
        for own, placed in zip(self.joints, first._parts[1]):
            varies = self._varies(own.parent, self._point(own), change)
            if varies or own.type != "revolute":
                joint = self._placed(own)
                if joint.axis != placed.axis:
                    return None
                if varies:
                    moved.append(joint)
        heavier = {}
        for body in first._parts[0]:
            if body.name in change.bodies or body.name in change.masses:
                inertia = self._inertia(body.name)
                if (inertia is None) != (body.inertia is None):
                    return None
                if inertia is not None:
                    heavier[body.name] = inertia
        closures = {}
        for joint in self.cut:
            if joint.type != "revolute":
                slider = self.drawing.sliders[joint.name]
                if self._line(slider) != first._line(slider):
                    return None
            point = self._point(joint)
            if self._varies(joint.child, point, change) or self._varies(
                joint.parent, point, change
            ):
                closures[joint.name] = (
                    self._anchor(joint.child, point),
                    self._anchor(joint.parent, point),
                )
        points = {
            point: self._anchor(body, point)
            for point, body in self.connections.hubs.items()
            if self._varies(body, point, change)
        }
        forces: dict[str, dict[str, Any]] = {
            table["name"]: {key: table[key] for key in ("a", "b", "at") if key in table}
            for table in self._forces()
            if table["type"] != "torque"
        }
        notes = tuple(self._notes())
        return Numbers(moved, heavier, closures, points, forces, self._initial(), notes)

    # -- visuals -------------------------------------------------------------------------------

    @cached_property
    def _layers(self) -> dict[str, int]:
        """Layers in which bodies are drawn: those that meet in a pin lie in different ones."""
        import networkx

        graph = networkx.Graph()
        graph.add_nodes_from(self.bodies)
        for joint in (*self.joints, *self.cut):
            graph.add_edge(joint.parent, joint.child)
        graph.remove_node(WORLD)
        colours = networkx.greedy_color(graph, strategy="connected_sequential_bfs")
        return {WORLD: 0} | {body: 1 + colour for body, colour in colours.items()}

    @property
    def _width(self) -> float:
        return WIDTH * self.drawing.size

    def _visuals(self, body: str) -> tuple[Element, ...]:
        width, layer = self._width, self._width * 1.2 * self._layers[body]
        if body in self.drawing.sliders:
            slider = self.drawing.sliders[body]
            angle = direction_angle(np.array(self._line(slider))[[0, 2]])
            return (block(self._local(body, slider.point), angle, layer, width),)
        index = list(self.drawing.bars).index(body)
        points = self.drawing.shape(body) - self.origins[body]
        bars = bar_visuals(points, layer, width, PALETTE[index % len(PALETTE)])
        return (*bars, *self._bolts(body))

    def _bolts(self, body: str) -> Iterator[Element]:
        """The bolts of the pins whose bodies are joined with this one."""
        for point in dict.fromkeys(self.drawing.bars[body].points):
            bodies = self.drawing.carriers(point)
            if len(bodies) > 1 and next(name for name in bodies if name != WORLD) == body:
                layers = [1.2 * self._width * self._layers[name] for name in bodies]
                yield pin_visual(self._local(body, point), layers, self._width)

    def _ground_visuals(self) -> Iterator[Element]:
        width = self._width
        for name in self.drawing.ground:
            at = in_space(self.drawing.points[name])
            down = np.array([0.0, 0.0, -2.5 * width])
            yield rod(at + down, at, 0.8 * width, GREY)
        for slider in self.entry.slider:
            if not slider.on:
                at, along = (
                    in_space(self.drawing.points[slider.point]),
                    np.array(self._line(slider)),
                )
                reach = 0.25 * self.drawing.size * along
                yield rod(at - reach, at + reach, 0.25 * width, GREY)


# -- variants ------------------------------------------------------------------------------------

NUMBERS_OF_BARS = ("length", "mass", "mass_per_length", "inertia", "centre")
"""Keys of a bar whose numbers may vary while the rest of the linkage is kept."""


class LinkageVariants:
    """The numbers of the variants of a linkage: what they do not change is taken over.

    Parameters
    ----------
    linkage
        The linkage that was read first, translated.
    change
        What they may change.
    places
        Their numbers in the description.
    """

    def __init__(self, linkage: _Linkage, change: Change, places: tuple[Place, ...]) -> None:
        self._linkage, self._change, self._places = linkage, change, places

    def __call__(self, entry: PlanarEntry) -> Numbers | None:
        """The numbers of a variant with the section ``entry``; None where it has to be read as a
        whole, because of a fault perhaps."""
        varied = self._linkage.varied(entry, self._change)
        return None if varied is None else varied.numbers(self._linkage, self._change)

    def check(self, mechanism: Mechanism) -> None:
        """Refuse a linkage that cannot move."""
        self._linkage.check(mechanism)

    def __reduce__(self) -> tuple[Any, ...]:
        """Without the checked section, whose tables may have classes made at run time."""
        options = self._linkage.options
        return _variants_again, (dict(options.own), options.cut, self._places)


def _variants_again(
    own: dict[str, Any], cut: tuple[str, ...], places: tuple[Place, ...]
) -> LinkageVariants | None:
    entry = PlanarEntry.model_validate(own[PLANAR])
    linkage = _Linkage(entry, Options(cut, own, planar=entry))
    linkage.translation()
    return linkage.variants(places)
