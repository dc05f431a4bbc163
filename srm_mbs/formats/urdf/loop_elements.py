"""Loop elements that other tools write into a URDF.

* URDF+ (M. Chignoli et al., arXiv 2411.19753): ``<loop>``, ``<coupling>``;
* Isaac Sim: ``<loop_joint>``;
* the proposal for urdfdom (ros/urdfdom, pull request 264): ``<constraint>``;
* Drake: ``<drake:ball_constraint>``, ``<drake:linear_spring_damper>``.

In each of them a frame is placed on each of two links, by ``xyz`` and ``rpy`` as in an
``<origin>``.

* Gazebo: ``<gazebo><joint>``, a joint of SDF that Gazebo inserts into the SDF that it makes of the
  URDF.  Its frame is given on the child, displaced by ``<pose>``; on the parent it is placed so
  that both coincide at q = 0.  Axes are in the joint's frame, or with
  ``<use_parent_model_frame>`` in the root link's.  A screw, which no closure can be, goes into the
  tree, and what held its child is cut.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any
from xml.etree.ElementTree import Element, SubElement

import pinocchio as pin

from srm_mbs._typing import FloatArray
from srm_mbs.errors import InputError
from srm_mbs.formats.graph.joint_graph import THREAD_PITCH, metres_per_turn
from srm_mbs.formats.graph.spanning_tree_to_urdf import (
    CLOSURE_OF,
    anchor,
    bushing,
    closure,
    is_identity,
    numbers,
    origin,
    placement,
)
from srm_mbs.formats.urdf.graph import Graph
from srm_mbs.formats.urdf.validation import ElementChecker
from srm_mbs.formats.xml import local_name
from srm_mbs.model.anchors import WORLD

DRAKE_ELEMENTS = ("ball_constraint", "linear_spring_damper")
SDF_AXES = ("axis", "axis2")
NOT_ACTING = ("physics", "sensor")
"""Elements inside a Gazebo joint that belong to Gazebo's own solver."""
End = tuple[str, pin.SE3]
"""A link and, in its frame, the frame of a joint."""


class LoopElements(ElementChecker):
    """Reads the loop elements of one URDF into :attr:`loops` and :attr:`forces`.

    Parameters
    ----------
    file, graph
        The file, and its links and joints.
    fixed_base
        Whether the ground holds the root link.

    Attributes
    ----------
    placed
        Placement of links inside ``<gazebo>``, which the file gives, in the root link's frame.
    """

    def __init__(self, file: str, graph: Graph, fixed_base: bool) -> None:
        super().__init__(file)
        self.graph, self.fixed_base = graph, fixed_base
        self.loops: list[dict[str, Any]] = []
        self.forces: list[dict[str, Any]] = []
        self.placed: dict[str, pin.SE3] = {}
        self._on_screws: set[str] = set()
        self._readers: dict[str, Callable[[Element, str], None]] = {
            "loop": self._loop,
            "coupling": self._coupling,
            "loop_joint": self._loop_joint,
            "constraint": self._constraint,
            "ball_constraint": self._ball_constraint,
            "linear_spring_damper": self._linear_spring_damper,
        }

    def read(self, root: Element) -> bool:
        """Read and remove the elements of ``root``; whether there were any.

        Raises
        ------
        InputError
            Naming the element that cannot be read.
        """
        found = False
        for node in list(root):
            tag = local_name(node)
            # An element <drake:loop> is none of ours.
            if tag not in self._readers or (tag != node.tag) != (tag in DRAKE_ELEMENTS):
                continue
            name = node.get("name")
            where = f"<{tag}> {name!r}" if name else f"<{tag}>"
            self.only(node, where, ("name",) if tag in DRAKE_ELEMENTS else ("name", "type"))
            self._readers[tag](node, where)
            root.remove(node)
            found = True
        for block in root.findall("gazebo"):
            for joint in block.findall("joint"):
                self._gazebo_joint(joint, f"<gazebo><joint> {joint.get('name', '')!r}")
                block.remove(joint)
                found = True
            if found and not len(block) and not block.attrib:
                root.remove(block)
        return found

    # -- parts of the elements ------------------------------------------------------------------

    def parts(
        self,
        node: Element,
        where: str,
        known: Mapping[str, Sequence[str] | None],
        *optional: str,
        inner: Sequence[str] = (),
    ) -> dict[str, Element]:
        """The children of ``node``, each at most once.

        Parameters
        ----------
        known
            Tags and their attributes (None: any); of these elements all but ``optional`` must be
            there.
        inner
            Tags of those that have children of their own.
        """
        found: dict[str, Element] = {}
        for child in node:
            tag = local_name(child)
            if tag not in known:
                raise self.unknown(where, f"unknown element <{tag}> in it", known)
            if tag in found:
                raise self.fault(where, f"<{tag}> is given twice", "Keep one")
            attributes = known[tag]
            if attributes is not None:
                self.only(child, where, attributes)
            if tag not in inner:
                self.leaf(child, where)
            found[tag] = child
        for tag in known:
            if tag not in found and tag not in optional:
                raise self.fault(where, f"it has no <{tag}>", "Add it")
        return found

    def leaf(self, node: Element, where: str) -> None:
        """Refuse elements inside ``node``."""
        for inner in node:
            raise self.fault(
                where,
                f"unknown element <{local_name(inner)}> in <{local_name(node)}>",
                "Remove it",
            )

    def link(self, node: Element, key: str, where: str) -> str:
        """The existing link that attribute ``key`` names."""
        name = node.get(key)
        if not name:
            raise self.fault(where, f"<{local_name(node)}> has no {key!r}", f'Give {key}="..."')
        return self.existing(name, where)

    def existing(self, link: str, where: str) -> str:
        """The link of this name, or ``world``."""
        if link not in self.graph.links and link != WORLD:
            raise self.unknown(where, f"the link {link!r} does not exist", self.graph.links)
        return link

    def end(self, node: Element, origin: Element | None, where: str) -> End:
        """The link that ``node`` names, and the frame that ``origin`` places on it."""
        return self.link(node, "link", where), self.origin_of(origin, where)

    def origin_of(self, node: Element | None, where: str) -> pin.SE3:
        """The placement by ``xyz`` and ``rpy`` of ``node``; the identity if it is None."""
        xyz, rpy = (self.vector_or_zero(node, key, where) for key in ("xyz", "rpy"))
        return placement(xyz, rpy)

    def kind(self, node: Element, where: str) -> str:
        """Its joint type."""
        kind = node.get("type")
        if not kind:
            raise self.fault(where, "it has no type", 'Give type="..."')
        return kind

    def add(self, *args: Any, where: str) -> None:
        """Add a :func:`~srm_mbs.formats.graph.spanning_tree_to_urdf.closure`; the arguments are its
        own."""
        self.loops.append(closure(*args, fault=partial(self.fault, where)))

    def joint(
        self,
        kind: str,
        name: str,
        parent: End,
        child: End,
        axes: Sequence[Sequence[float] | FloatArray | None],
        *,
        damping: float = 0.0,
        where: str,
    ) -> None:
        """Add the closure of a joint with <axis> and, if it is universal, <axis2>.

        Its damping (N m s/rad, N s/m) becomes a bushing.
        """
        if axes[1] is not None and kind != "universal":
            raise self.fault(where, f"a {kind} joint takes no <axis2>", "Remove it")
        self.add(kind, name, parent, child, *axes, where=where)
        if damping == 0.0:
            return
        if damping < 0.0:
            raise self.fault(where, f"the damping {damping:g} is negative", "Give a value >= 0")
        if CLOSURE_OF[kind] not in ("revolute", "prismatic"):
            raise self.fault(
                where,
                f"its damping ({damping:g}) would not act: a closure has none",
                "Set it to 0, or cut the loop at another joint",
            )
        axis = self.loops[-1]["axis"]
        self.forces.append(
            bushing(f"{name}::damping" if name else "", kind, parent, child, axis, damping=damping)
        )

    # -- one reader each ----------------------------------------------------------------------

    def _loop(self, node: Element, where: str) -> None:
        """URDF+: a joint between the two frames; its axis has the same components in both."""
        sides = ("predecessor", "successor")
        known = {**dict.fromkeys(sides, ("link",)), "axis": ("xyz",)}
        parts = self.parts(node, where, known, "axis", inner=sides)
        ends = []
        for side in sides:
            inner = self.parts(parts[side], where, {"origin": ("xyz", "rpy")}, "origin")
            ends.append(self.end(parts[side], inner.get("origin"), where))
        axis = self.vector(parts["axis"], "xyz", where) if "axis" in parts else None
        self.add(self.kind(node, where), node.get("name", ""), *ends, axis, where=where)

    def _coupling(self, node: Element, where: str) -> None:
        """URDF+: ratio times the sum of the joints from the nearest common ancestor to the
        predecessor is that of the joints to the successor."""
        kind = node.get("type", "rolling")
        if kind != "rolling":
            raise self.unknown(where, f"there is no coupling type {kind!r}", ("rolling",))
        known = {"predecessor": ("link",), "successor": ("link",), "ratio": ("value",)}
        parts = self.parts(node, where, known)
        ratio = self.number(parts["ratio"], "value", where)
        if ratio == 0.0:
            raise self.fault(where, "its ratio is zero", "Give another one")
        before, after = (
            self.link(parts[side], "link", where) for side in ("predecessor", "successor")
        )
        try:
            first, second = self.graph.chains(before, after)
        except InputError as error:
            raise self.fault(where, error.problem, error.remedy) from error
        self.loops.append(coupling(node.get("name", ""), second, first, ratio))

    def _loop_joint(self, node: Element, where: str) -> None:
        """Isaac Sim: link1 is the parent; in some files both links are called link1."""
        ends, axes = [], []
        for child in node:
            tag = local_name(child)
            self.leaf(child, where)
            if tag == "axis":
                self.only(child, where, ("xyz",))
                axes.append(self.vector(child, "xyz", where))
            elif tag in ("link1", "link2"):
                self.only(child, where, ("link", "xyz", "rpy"))
                ends.append((tag, self.end(child, child, where)))
            else:
                known = ("link1", "link2", "axis")
                raise self.unknown(where, f"unknown element <{tag}> in it", known)
        if len(ends) != 2 or len(axes) > 1:
            raise self.fault(where, "it does not name two links", "Give <link1> and <link2>")
        if ends[0][0] == "link2" and ends[1][0] == "link1":
            ends.reverse()
        kind = self.kind(node, where)
        if not axes and kind not in ("spherical", "fixed"):
            raise self.fault(
                where,
                f"a {kind} loop joint does not say its axis",
                'Add <axis xyz="..."/>, in the frame on link1',
            )
        frames = [end for _, end in ends]
        self.add(kind, node.get("name", ""), *frames, axes[0] if axes else None, where=where)

    def _constraint(self, node: Element, where: str) -> None:
        """urdfdom: a frame and an axis in it on either side."""
        sides = ("parent", "child")
        placed = {f"{side}_origin": ("xyz", "rpy") for side in sides}
        axes = {f"{side}_axis": ("xyz",) for side in sides}
        known = {**dict.fromkeys(sides, ("link",)), **placed, **axes}
        parts = self.parts(node, where, known, *placed, *axes)
        ends = [self.end(parts[side], parts.get(f"{side}_origin"), where) for side in sides]
        own, other = (
            self.vector(parts[tag], "xyz", where) if tag in parts else None for tag in axes
        )
        self.add(
            self.kind(node, where), node.get("name", ""), *ends, own or other, other, where=where
        )

    def _drake(self, node: Element, where: str, *numbers: str) -> dict[str, Any]:
        """Anchors ``body_A``, ``body_B`` at the points P and Q on them, and more numbers, by their
        short names."""
        prefix = f"{local_name(node)}_"
        points = {"body_A": "p_AP", "body_B": "p_BQ"}
        known = {prefix + body: ("name",) for body in points}
        known |= {prefix + key: ("value",) for key in (*points.values(), *numbers)}
        parts = self.parts(node, where, known)
        out: dict[str, Any] = {
            key: self.number(parts[prefix + key], "value", where) for key in numbers
        }
        for body, point in points.items():
            xyz = self.vector(parts[prefix + point], "value", where)
            link = self.link(parts[prefix + body], "name", where)
            out[body] = anchor(link, placement(xyz, (0.0, 0.0, 0.0)))
        return out

    def _ball_constraint(self, node: Element, where: str) -> None:
        given = self._drake(node, where)
        name = node.get("name", "")
        self.loops.append(
            {"name": name, "type": "point", "a": given["body_B"], "b": given["body_A"]}
        )

    def _linear_spring_damper(self, node: Element, where: str) -> None:
        given = self._drake(node, where, "free_length", "stiffness", "damping")
        for key in ("free_length", "stiffness", "damping"):
            if given[key] < 0.0:
                problem = f"its {key} {given[key]:g} is negative"
                raise self.fault(where, problem, "Give a value >= 0")
        force = {"name": node.get("name", ""), "type": "spring_damper"}
        force |= {"a": given["body_A"], "b": given["body_B"], "rest_length": given["free_length"]}
        self.forces.append(force | {key: given[key] for key in ("stiffness", "damping")})

    def screws(self, root: Element) -> list[str]:
        """Move the screws among the joints of Gazebo into the tree, because no closure has a
        thread; names of the joints by which they hold their children."""
        held = []
        for block in root.findall("gazebo"):
            for joint in block.findall("joint"):
                if joint.get("type") == "screw":
                    where = f"<gazebo><joint> {joint.get('name', '')!r}"
                    held.append(self._gazebo_screw(root, joint, where))
                    block.remove(joint)
            if held and not len(block) and not block.attrib:
                root.remove(block)
        return held

    def _gazebo_screw(self, root: Element, joint: Element, where: str) -> str:
        """Add a screw of Gazebo to ``root``; name of the joint that holds its child."""
        name = joint.get("name", "")
        if not name or name in self.graph.joints:
            raise self.fault(where, "another joint has its name", "Rename one of them")
        pitch = self._gazebo_pitch(joint, where)
        parent, child, (axis, _), damping = self.gazebo_ends(joint, where)
        if axis is None:
            raise self.fault(where, "it has no <axis>", "Give it")
        if WORLD in (parent[0], child[0]) and WORLD not in self.graph.links:
            parent, child = self._on_root(parent, child, where)
        # The child of a screw must not carry its parent; a link that a screw holds already is
        # taken if the other is no better.
        ways = [
            way
            for way in ((parent, child, axis), (child, parent, -axis))
            if way[1][0] not in self.graph.ancestors(way[0][0])
        ]
        if not ways:
            raise self.fault(where, "both its ends are on one link", "Remove it")
        parent, child, axis = min(ways, key=lambda way: way[1][0] in self._on_screws)
        shared = child[0] in self._on_screws
        self._on_screws.add(child[0])
        screw = SubElement(root, "joint", name=name, type="screw")
        SubElement(screw, "axis", xyz=numbers(axis))
        SubElement(screw, "thread_pitch", value=numbers([pitch]))
        if damping:
            SubElement(screw, "dynamics", damping=numbers([damping]))
        if is_identity(child[1]):
            _hang(screw, parent[0], child[0], parent[1])
            if not shared:
                self.graph.above[child[0]] = screw
            return name
        between = f"{name}::joint_frame"
        SubElement(root, "link", name=between)
        _hang(screw, parent[0], between, parent[1])
        fixed = SubElement(root, "joint", name=f"{name}::fixed", type="fixed")
        _hang(fixed, between, child[0], child[1].inverse())
        self.graph.above[between] = screw
        if not shared:
            self.graph.above[child[0]] = fixed
        return f"{name}::fixed"

    def _on_root(self, parent: End, child: End, where: str) -> tuple[End, End]:
        """The two ends of a screw on the ground, with the root link, which it holds, instead."""
        if not self.fixed_base:
            raise self.fault(
                where,
                "a screw on the ground of a base that is not fixed is not read",
                'Give base = "fixed"',
            )
        link = child[0] if parent[0] == WORLD else parent[0]
        root = self.graph.ancestors(link)[-1]
        if link == root:
            raise self.fault(
                where, f"it holds the root link {link!r}, which the ground holds", "Remove it"
            )
        ground = [(root if end[0] == WORLD else end[0], end[1]) for end in (parent, child)]
        return ground[0], ground[1]

    def _gazebo_pitch(self, joint: Element, where: str) -> float:
        """Metres per turn of a screw, whose elements about it are removed."""
        found = {}
        for tag in ("thread_pitch", "screw_thread_pitch"):
            node = joint.find(tag)
            if node is not None:
                self.leaf(node, where)
                found[tag] = float(self.numbers(node.text, 1, where, f"<{tag}>")[0])
                joint.remove(node)
        if not any(found.values()):
            raise self.fault(where, "it has no thread", "Give <screw_thread_pitch>, in m per turn")
        if "screw_thread_pitch" in found:
            return found["screw_thread_pitch"]
        self.notes.append(f"{joint.get('name', '')!r}: {THREAD_PITCH}")
        return metres_per_turn(found["thread_pitch"])

    def _gazebo_joint(self, joint: Element, where: str) -> None:
        """Gazebo: the joint becomes a closure."""
        parent, child, axes, damping = self.gazebo_ends(joint, where)
        self.joint(
            self.kind(joint, where),
            joint.get("name", ""),
            parent,
            child,
            axes,
            damping=damping,
            where=where,
        )

    def gazebo_ends(
        self, joint: Element, where: str
    ) -> tuple[End, End, list[FloatArray | None], float]:
        """Parent, child, axes and damping: the joint's frame is given on the child; at q = 0 that
        on the parent is there."""
        self.only(joint, where, ("name", "type"))
        known = {"parent": (), "child": (), "pose": ("relative_to", "frame")}
        inside = dict.fromkeys((*SDF_AXES, *NOT_ACTING))  # with any attributes
        parts = self.parts(joint, where, known | inside, "pose", *inside, inner=tuple(inside))
        parent, child = (self.existing(_text(parts[side]), where) for side in ("parent", "child"))
        frame = self._gazebo_pose(parts.get("pose"), child, where)
        poses = {
            link: pin.SE3.Identity() if link == WORLD else self._pose(link)
            for link in (parent, child)
        }
        at = poses[child] * frame
        damping = sum(self._gazebo_damping(parts.get(tag), tag, where) for tag in SDF_AXES)
        axes = [
            self._gazebo_axis(parts[tag], at, f"{where}, <{tag}>") if tag in parts else None
            for tag in SDF_AXES
        ]
        return (parent, poses[parent].actInv(at)), (child, frame), axes, damping

    def _pose(self, link: str) -> pin.SE3:
        """Placement of a link in the root link's frame at q = 0."""
        return self.placed[link] if link in self.placed else self.graph.pose(link)

    def _gazebo_pose(self, node: Element | None, child: str, where: str) -> pin.SE3:
        """Placement of the joint's frame in the child link."""
        if node is None:
            return pin.SE3.Identity()
        relative = node.get("relative_to", node.get("frame", ""))
        if relative not in ("", child):
            problem = f"its <pose> is relative to {relative!r}"
            raise self.fault(where, problem, "Give it relative to the child link")
        values = self.numbers(node.text, 6, where, "<pose>")
        return placement(values[:3], values[3:])

    def _gazebo_damping(self, node: Element | None, tag: str, where: str) -> float:
        """Damping about <axis>; friction and springs there are refused."""
        values = {}
        for key in ("damping", "friction", "spring_stiffness"):
            given = None if node is None else node.find(f"dynamics/{key}")
            values[key] = 0.0 if given is None else self.numbers(given.text, 1, where, key)[0]
            if values[key] and (key != "damping" or tag == "axis2"):
                raise self.fault(
                    where,
                    f"its {key} would not act: a closure has none",
                    "Set it to 0, or add a [[force]] in a description",
                )
        return float(values["damping"])

    def _gazebo_axis(self, node: Element, at: pin.SE3, where: str) -> FloatArray:
        """Direction of an axis in the joint's frame, which is placed at ``at``."""
        known = {"xyz": (), "use_parent_model_frame": None, "initial_position": None}
        inside = dict.fromkeys(("limit", "dynamics"))
        optional = ("use_parent_model_frame", "initial_position", *inside)
        parts = self.parts(node, where, known | inside, *optional, inner=tuple(inside))
        direction = self.numbers(parts["xyz"].text, 3, where, "<xyz>")
        if _text(parts.get("use_parent_model_frame")) in ("1", "true"):
            direction = at.rotation.T @ direction
        return direction


def _hang(joint: Element, parent: str, child: str, at: pin.SE3) -> None:
    """Add the two links of a joint of the tree to it, and its placement in the parent."""
    SubElement(joint, "parent", link=parent)
    SubElement(joint, "child", link=child)
    origin(joint, at)


def _text(node: Element | None) -> str:
    return "" if node is None else (node.text or "").strip()


def coupling(
    name: str,
    followers: list[str],
    leaders: list[str],
    ratio: float,
    offset: float = 0.0,
) -> dict[str, Any]:
    """The ``[[loop]]`` of: sum of the followers = ratio times that of the leaders + offset."""
    out: dict[str, Any] = {"name": name, "type": "coupling", "joints": [*followers, *leaders]}
    if len(followers) == len(leaders) == 1:
        out["ratio"] = ratio
    else:
        out["coefficients"] = [1.0] * len(followers) + [-ratio] * len(leaders)
    return out | ({"offset": offset} if offset else {})
