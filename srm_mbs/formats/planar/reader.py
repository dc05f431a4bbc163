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
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from types import MappingProxyType
from typing import Any, NamedTuple, TypeVar
from xml.etree.ElementTree import Element

import numpy as np
import pinocchio as pin

from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.errors import AssemblyError, InputError, known_names, naming
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
    PlanarInertia,
    Point,
    bar_visuals,
    block,
    difference,
    direction_angle,
    in_space,
    pin_visual,
    rod,
    slender,
    turned,
)
from srm_mbs.formats.planar.variants import model_of_variant, plain_parts
from srm_mbs.formats.toml.parameters import Place, nested, with_numbers
from srm_mbs.formats.toml.schema import PlanarEntry, PlanarSlider
from srm_mbs.formats.translation import (
    PLANAR,
    Numbers,
    Options,
    Translation,
    Vector,
    Written,
    merged_initial,
    urdf_text,
)
from srm_mbs.formats.urdf.variants import inertia_as_read
from srm_mbs.model.anchors import WORLD
from srm_mbs.model.copies import copied
from srm_mbs.model.lazy import cached_property
from srm_mbs.model.numbers import LARGEST_MAGNITUDE

Key = TypeVar("Key", str, int)

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


def _as_written(point: Point) -> Vector:
    """A point of a link in its frame, in space, as files give it: rounding of its origin is left
    out, and signs of zeros."""
    x, y = point
    if max(abs(x), abs(y)) <= IDENTITY_ROUNDING:
        return 0.0, 0.0, 0.0
    return x + 0.0, 0.0, y + 0.0


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
                self.drawing.begin(joint.child, self.point(joint))
        self.origins: dict[str, Point] = {WORLD: (0.0, 0.0)} | {
            joint.child: self._on_body(joint.child, self.point(joint)) for joint in self.joints
        }
        """Of the links, in the axes of :meth:`Drawing.on_body`."""

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

    def point(self, joint: Joint) -> str:
        return self.points_of_joints[joint.name]

    def _on_body(self, body: str, point: str) -> Point:
        """A point in the axes of :meth:`Drawing.on_body`."""
        return self.drawing.on_body(body, self.drawing.points[point], point)

    def _local(self, body: str, point: str) -> Point:
        """A point in the frame of the link of a body."""
        return difference(self._on_body(body, point), self.origins[body])

    def _at(self, body: str, point: str) -> pin.SE3:
        return pin.SE3(UNTURNED, in_space(self._local(body, point)))

    def place(self, body: str, point: str) -> Vector:
        """A point in the frame of the link of a body, as files give it."""
        return _as_written(self._local(body, point))

    def _anchor(self, body: str, point: str) -> dict[str, Any]:
        place = self.place(body, point)
        return {"link": body, "xyz": list(place)} if any(place) else {"link": body}

    def _carrier(self, point: str, element: str) -> str:
        """The body on which a point is fixed."""
        self.drawing.point(point, element)
        bodies = self.drawing.carriers(point)
        if not bodies:
            raise fault(element, f"point {point!r} is on no bar", "Give it to a bar, or to ground")
        return self.connections.hubs[point]

    def line(self, slider: PlanarSlider, normal: bool = False) -> tuple[float, float, float]:
        """Direction of the line of a slider, or its normal, in the body on which it slides."""
        angle = self.drawing.direction(slider) - self.drawing.body_angle(slider.on)
        x, y = turned((1.0, 0.0), angle + (0.5 * math.pi if normal else 0.0))
        return (0.0 if abs(x) < 1e-15 else x, 0.0, 0.0 if abs(y) < 1e-15 else y)

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
            "initial": self.initial(),
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
            tuple(self.notes()),
            file_terms=self,
            parts=plain_parts(bodies, joints) if model is None else None,
            model=model,
            vary=self.variants if model is None else None,
        )

    @cached_property
    def _parts(self) -> tuple[list[Body], list[Joint]]:
        """Bodies, without what is drawn, and the joints of the tree."""
        inertias = {name: self.inertia(name) for name in self.bodies[1:]}
        bodies = [
            Body(name, None if inertia is None else inertia.in_space())
            for name, inertia in inertias.items()
        ]
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
        place, axis = self._at(joint.parent, self.point(joint)), HINGE_AXIS
        if joint.type != "revolute":
            slider = self.drawing.sliders[joint.name]
            x, y, z = self.line(slider)
            axis = (x, y, z) if joint.child == slider.name else (-x, y, -z)
        return Joint(joint.name, joint.type, joint.parent, joint.child, place, axis=axis)

    def inertia(self, body: str) -> PlanarInertia | None:
        """Inertia of a body in the frame of its link."""
        drawing = self.drawing
        if body in drawing.sliders:
            slider = drawing.sliders[body]
            half = 0.5 * slider.inertia
            tensor = (half, 0.0, slider.inertia, half)
            at = self._local(body, slider.point)
            return PlanarInertia(slider.mass, at, tensor) if slider.mass else None
        bar, origin = drawing.bars[body], self.origins[body]
        shape = slender([difference(point, origin) for point in drawing.shape(body)])
        mass = bar.mass
        if mass is None:
            density = bar.mass_per_length
            density = self.entry.mass_per_length if density is None else density
            mass = shape.length * (density or 0.0)
        if not mass:
            return None
        centre = shape.centre
        if bar.centre is not None:
            x, y = bar.centre
            place = drawing.on_body(body, (drawing.unit * x, drawing.unit * y))
            centre = difference(place, origin)
        return shape.body(mass, centre, bar.inertia)

    # -- closures, forces, start ---------------------------------------------------------------

    def _closures(self) -> Iterator[dict[str, Any]]:
        """A cut pin is a point, a slot a point on a line of the plane: out of the plane, rows of a
        closure are zero."""
        for joint in self.cut:
            point = self.point(joint)
            a, b = self._anchor(joint.child, point), self._anchor(joint.parent, point)
            if joint.type == "revolute":
                yield {"name": joint.name, "type": "point", "a": a, "b": b}
                continue
            slider = self.drawing.sliders[joint.name]
            if joint.type == "slot":
                normal = list(self.line(slider, normal=True))
                yield {"name": joint.name, "type": "point_on_plane", "a": a, "b": b, "axis": normal}
                continue
            yield closure(
                "prismatic",
                joint.name,
                (joint.parent, self._at(joint.parent, point)),
                (joint.child, self._at(joint.child, point)),
                self.line(slider),
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

    def _unit(self, joint: str) -> str:
        """The name of :meth:`_factor`."""
        return self.entry.unit if joint in self.drawing.sliders else self.entry.angle

    def initial(self, angles: Mapping[str, float] | None = None) -> dict[str, Any]:
        """The table ``initial``, with the guessed ``angles`` of revolute joints, if they are known,
        by name."""
        start = {name: self._factor(name) * value for name, value in self.entry.start.items()}
        if angles is None:
            angles = {
                joint.name: self.angle(joint)
                for joint in self.joints
                if joint.type == "revolute" and joint.name not in start
            }
        rates = {name: self._factor(name) * value for name, value in self.entry.rates.items()}
        parts = {"q": start, "v": rates, "guess": angles}
        return {part: values for part, values in parts.items() if values}

    def angle(self, joint: Joint) -> float:
        """Angle (rad) of a revolute joint as drawn."""
        turn = self.drawing.body_angle(joint.child) - self.drawing.body_angle(joint.parent)
        return math.remainder(turn, 2.0 * math.pi)

    def notes(self) -> Iterator[str]:
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

    def explain(self, error: AssemblyError) -> None:
        """Name the key of the section from which the part of ``initial`` was made that ``error`` is
        about, unless the description has that part itself."""
        entry, own = self.entry, self.options.own.get("initial", {})
        if error.element == "initial.guess" and "guess" not in own:
            error.element = f"{PLANAR}.points"
            error.remedy = (
                "Check the lengths, or draw the points closer to a closed pose; the closest one "
                "found is in the error's q"
            )
        for part, key in (("q", "start"), ("v", "rates")):
            given = getattr(entry, key)
            if error.element != f"initial.{part}" or part in own:
                continue
            if given:
                error.element = f"{PLANAR}.{key}"
            elif entry.drive:
                error.element = f"{PLANAR}.drive"
        in_units = [
            f"{name} = {value / self._factor(name):.9g} {self._unit(name)}"
            for name, value in error.nearest.items()
            if self._factor(name) != 1.0
        ]
        if in_units:
            error.remedy += f" ({', '.join(in_units)})"

    def written(self, joint: str) -> Written | None:
        """How the start of a joint is written in the section; None if it is not given there, or
        the description has one that counts instead."""
        own = self.options.own.get("initial", {})
        if joint not in self.entry.start or joint in {*own.get("q", ()), *own.get("guess", ())}:
            return None
        return Written(f"{PLANAR}.start", self._unit(joint), self._factor(joint))

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

    def varied(self, entry: PlanarEntry, change: Change) -> _Linkage | None:
        """The same linkage with the numbers of ``entry``; None as for :meth:`Drawing.varied`."""
        drawing = self.drawing.varied(entry, change)
        if drawing is None:
            return None
        out = copied(self, entry=entry, drawing=drawing, origins=dict(self.origins))
        for joint in self.joints:
            if change.reaches(joint.child, self.point(joint)):
                out.origins[joint.child] = out._on_body(joint.child, self.point(joint))
        return out

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
            x, _, z = self.line(slider)
            angle = direction_angle((x, z))
            return (block(self._local(body, slider.point), angle, layer, width),)
        index = list(self.drawing.bars).index(body)
        origin = self.origins[body]
        points = [difference(point, origin) for point in self.drawing.shape(body)]
        bars = bar_visuals(points, layer, width, PALETTE[index % len(PALETTE)])
        return (*bars, *self._bolts(body))

    def _bolts(self, body: str) -> Iterator[Element]:
        """The bolts of the pins whose bodies are joined with this one."""
        for point in dict.fromkeys(self.drawing.order[body]):
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
                    np.array(self.line(slider)),
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
        own, entry, reaches = linkage.options.own, linkage.entry, change.reaches
        self._numbers = nested(places)[PLANAR]
        self._not_negative = [k for k, place in enumerate(places) if place[-1] in NUMBERS_OF_BARS]
        """Places, in the order of ``places``, of the numbers that cannot be negative."""
        self._lines = {
            slider.name: linkage.line(slider)
            for slider in entry.slider
            if slider.on in change.bodies
            or (isinstance(slider.along, list) and not change.points.isdisjoint(slider.along))
        }
        """Lines of sliders that may have another direction, as first read."""
        self._bodies = {
            body: linkage.inertia(body) is None
            for body in linkage.bodies[1:]
            if body in change.bodies or body in change.masses
        }
        """Bodies that may have another inertia, and whether they have none."""
        hubs, joints = linkage.connections.hubs, linkage.joints
        self._joints = {
            joint.child: (joint.parent, linkage.point(joint))
            for joint in joints
            if reaches(joint.parent, linkage.point(joint))
        }
        """Bodies and points that may be elsewhere in them, by the links that joints there carry."""
        self._closures = {
            joint.name: ends
            for joint in linkage.cut
            for point in [linkage.point(joint)]
            if (ends := self._ends(a=(joint.child, point), b=(joint.parent, point)))
        }
        self._points = {
            point: (body, point)
            for point, body in hubs.items()
            if point not in own.get("points", ()) and reaches(body, point)
        }
        forces = [
            *(
                self._ends(a=(hubs[each.a], each.a), b=(hubs[each.b], each.b))
                for each in entry.spring
            ),
            *({} for _ in entry.torque),
            *(self._ends(at=(hubs[each.point], each.point)) for each in entry.load),
        ]
        self._forces = {
            number: ends for number, ends in enumerate(forces, len(own.get("force", ()))) if ends
        }
        """As those of joints: of closures, points and forces."""
        self._angles = {
            joint.name: linkage.angle(joint)
            for joint in joints
            if joint.type == "revolute" and joint.name not in entry.start
        }
        self._turning = [
            joint
            for joint in joints
            if joint.name in self._angles
            and not change.bodies.isdisjoint((joint.child, joint.parent))
        ]

    def _ends(self, **ends: tuple[str, str]) -> dict[str, tuple[str, str]]:
        """Those of the ``ends``, each a body and a point, that may be elsewhere in the body."""
        return {key: end for key, end in ends.items() if self._change.reaches(*end)}

    def __call__(self, numbers: Sequence[float]) -> Numbers | None:
        """The numbers of the variant with these at the places; None where it has to be read as a
        whole, because of a fault perhaps."""
        if any(numbers[k] < 0.0 for k in self._not_negative):
            return None
        entry = with_numbers(self._linkage.entry, self._numbers, numbers)
        varied = self._linkage.varied(entry, self._change)
        if varied is None or any(
            varied.line(varied.drawing.sliders[name]) != line for name, line in self._lines.items()
        ):
            return None
        place = varied.place
        joints = {link: place(*at) for link, at in self._joints.items()}
        sizes: list[tuple[float, ...]] = [*joints.values()]
        inertias = {}
        for body, massless in self._bodies.items():
            inertia = varied.inertia(body)
            if (inertia is None) != massless:
                return None
            if inertia is not None:
                inertias[body] = _as_read(inertia)
                sizes += [(inertia.mass, *inertia.centre), inertia.tensor]
        # Everything here is a real body: other checks of the tree have nothing to say.
        if not all(abs(x) <= LARGEST_MAGNITUDE for values in sizes for x in values):
            return None
        angles = self._angles | {joint.name: varied.angle(joint) for joint in self._turning}
        return Numbers(
            joints,
            inertias,
            _places(place, self._closures),
            {name: place(*at) for name, at in self._points.items()},
            _places(place, self._forces),
            merged_initial(self._linkage.options.own.get("initial", {}), varied.initial(angles)),
            tuple(varied.notes()),
        )

    def check(self, mechanism: Mechanism) -> None:
        """Refuse a linkage that cannot move."""
        self._linkage.check(mechanism)

    def explain(self, error: AssemblyError) -> None:
        """Name what the section has."""
        self._linkage.explain(error)

    def written(self, joint: str) -> Written | None:
        """How the section has it."""
        return self._linkage.written(joint)

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


def _places(
    place: Callable[[str, str], Vector], ends: Mapping[Key, Mapping[str, tuple[str, str]]]
) -> dict[Key, dict[str, Vector]]:
    """Places of the ends of elements."""
    return {key: {side: place(*at) for side, at in own.items()} for key, own in ends.items()}


def _as_read(inertia: PlanarInertia) -> pin.Inertia:
    """The inertia as Pinocchio's reader of URDF has it."""
    return inertia_as_read(inertia.mass, _as_written(inertia.centre), inertia.matrix())
