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
  ``<use_parent_model_frame>`` in the root link's.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
import pinocchio as pin

from srm_mbs._typing import FloatArray
from srm_mbs.errors import InputError
from srm_mbs.formats.graph.spanning_tree_to_urdf import (
    CLOSURE_OF,
    anchor,
    bushing,
    closure,
    placement,
)
from srm_mbs.formats.urdf.graph import Graph
from srm_mbs.formats.urdf.validation import ElementChecker
from srm_mbs.model.anchors import WORLD

DRAKE = "drake"


def local_name(node: Element) -> str:
    """The tag without its namespace."""
    return node.tag.rsplit("}", 1)[-1].rsplit(":", 1)[-1]


class LoopElements(ElementChecker):
    """Reads the loop elements of one URDF into :attr:`loops` and :attr:`forces`."""

    def __init__(self, file: str, graph: Graph) -> None:
        super().__init__(file)
        self.graph = graph
        self.loops: list[dict[str, Any]] = []
        self.forces: list[dict[str, Any]] = []
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
            self._readers[tag](node, f"<{tag}> {name!r}" if name else f"<{tag}>")
            root.remove(node)
            found = True
        return found

    # -- parts of the elements ------------------------------------------------------------------

    def parts(
        self,
        node: Element,
        where: str,
        needed: dict[str, tuple[str, ...]],
        *optional: str,
        inner: tuple[str, ...] = (),
    ) -> dict[str, Element]:
        """The children of ``node``, each at most once, with no attributes but those named.

        Parameters
        ----------
        needed
            Tags and their attributes; of these elements all but ``optional`` must be there.
        inner
            Tags of those that have children of their own.
        """
        found: dict[str, Element] = {}
        for child in node:
            tag = local_name(child)
            if tag not in needed:
                raise self.fault(
                    where, f"unknown element <{tag}> in it", f"Known: {', '.join(needed)}"
                )
            if tag in found:
                raise self.fault(where, f"<{tag}> is given twice", "Keep one")
            self.only(child, where, needed[tag])
            if tag not in inner:
                self.leaf(child, where)
            found[tag] = child
        for tag in needed:
            if tag not in found and tag not in optional:
                raise self.fault(where, f"it has no <{tag}>", "Add it")
        return found

    def only(self, node: Element, where: str, known: tuple[str, ...]) -> None:
        """Refuse attributes of ``node`` but those that are known."""
        for key in node.attrib:
            if key not in known:
                raise self.fault(
                    where,
                    f"<{local_name(node)}> has an unknown attribute {key!r}",
                    f"Known: {', '.join(known) or 'none'}",
                )

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
        if name not in self.graph.links and name != WORLD:
            raise self.fault(
                where,
                f"the link {name!r} does not exist",
                f"Known: {', '.join(self.graph.links)}",
            )
        return name

    def vector(self, node: Element | None, key: str, where: str) -> list[float]:
        """Three numbers of an attribute, zero if it is not there."""
        if node is None or node.get(key) is None:
            return [0.0, 0.0, 0.0]
        return self.numbers(node, key, 3, where)

    def origin_of(self, node: Element | None, where: str) -> pin.SE3:
        """The placement by ``xyz`` and ``rpy`` of ``node``; the identity if it is None."""
        return placement(self.vector(node, "xyz", where), self.vector(node, "rpy", where))

    def kind(self, node: Element, where: str) -> str:
        """Its joint type."""
        kind = node.get("type")
        if not kind:
            raise self.fault(where, "it has no type", 'Give type="..."')
        return kind

    def fault_at(self, where: str) -> Callable[[str, str], InputError]:
        """Faults of one element."""
        return lambda problem, remedy: self.fault(where, problem, remedy)

    def add(self, *args: Any, where: str) -> None:
        """Add a :func:`~srm_mbs.formats.graph.spanning_tree_to_urdf.closure`; the arguments are its
        own."""
        self.loops.append(closure(*args, fault=self.fault_at(where)))

    def joint(
        self,
        kind: str,
        name: str,
        parent: tuple[str, pin.SE3],
        child: tuple[str, pin.SE3],
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
        self.only(node, where, ("name", "type"))
        parts = self.parts(
            node,
            where,
            {"predecessor": ("link",), "successor": ("link",), "axis": ("xyz",)},
            "axis",
            inner=("predecessor", "successor"),
        )
        ends = []
        for side in ("predecessor", "successor"):
            inner = self.parts(parts[side], where, {"origin": ("xyz", "rpy")}, "origin")
            frame = self.origin_of(inner.get("origin"), where)
            ends.append((self.link(parts[side], "link", where), frame))
        axis = self.numbers(parts["axis"], "xyz", 3, where) if "axis" in parts else None
        self.add(self.kind(node, where), node.get("name", ""), *ends, axis, where=where)

    def _coupling(self, node: Element, where: str) -> None:
        """URDF+: ratio times the sum of the joints from the nearest common ancestor to the
        predecessor is that of the joints to the successor."""
        self.only(node, where, ("name", "type"))
        kind = node.get("type", "rolling")
        if kind != "rolling":
            raise self.fault(where, f"there is no coupling type {kind!r}", "Known: rolling")
        parts = self.parts(
            node,
            where,
            {"predecessor": ("link",), "successor": ("link",), "ratio": ("value",)},
        )
        (ratio,) = self.numbers(parts["ratio"], "value", 1, where)
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
        self.only(node, where, ("name", "type"))
        ends, axes = [], []
        for child in node:
            tag = local_name(child)
            self.leaf(child, where)
            if tag == "axis":
                self.only(child, where, ("xyz",))
                axes.append(self.numbers(child, "xyz", 3, where))
            elif tag in ("link1", "link2"):
                self.only(child, where, ("link", "xyz", "rpy"))
                ends.append((tag, self.link(child, "link", where), self.origin_of(child, where)))
            else:
                raise self.fault(
                    where, f"unknown element <{tag}> in it", "Known: link1, link2, axis"
                )
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
        frames = [(link, frame) for _, link, frame in ends]
        self.add(kind, node.get("name", ""), *frames, axes[0] if axes else None, where=where)

    def _constraint(self, node: Element, where: str) -> None:
        """urdfdom: a frame and an axis in it on either side."""
        self.only(node, where, ("name", "type"))
        placed = {f"{side}_origin": ("xyz", "rpy") for side in ("parent", "child")}
        axes = {f"{side}_axis": ("xyz",) for side in ("parent", "child")}
        parts = self.parts(
            node,
            where,
            {"parent": ("link",), "child": ("link",), **placed, **axes},
            *placed,
            *axes,
        )
        ends = [
            (
                self.link(parts[side], "link", where),
                self.origin_of(parts.get(f"{side}_origin"), where),
            )
            for side in ("parent", "child")
        ]
        own, other = (
            self.numbers(parts[tag], "xyz", 3, where) if tag in parts else None for tag in axes
        )
        self.add(
            self.kind(node, where), node.get("name", ""), *ends, own or other, other, where=where
        )

    def _drake(self, node: Element, where: str, *numbers: str) -> dict[str, Any]:
        """Bodies A and B, points P and Q on them, and more numbers, by their short names."""
        prefix = f"{local_name(node)}_"
        named = {"body_A": "name", "body_B": "name", "p_AP": "value", "p_BQ": "value"}
        keys = {**named, **dict.fromkeys(numbers, "value")}
        parts = self.parts(
            node, where, {prefix + key: (attribute,) for key, attribute in keys.items()}
        )
        out: dict[str, Any] = {}
        for key, attribute in keys.items():
            part = parts[prefix + key]
            if key.startswith("body"):
                out[key] = self.link(part, attribute, where)
            else:
                values = self.numbers(part, attribute, 3 if key.startswith("p_") else 1, where)
                out[key] = values if key.startswith("p_") else values[0]
        for side, point in (("body_A", "p_AP"), ("body_B", "p_BQ")):
            out[side] = anchor(out[side], placement(out[point], (0.0, 0.0, 0.0)))
        return out

    def _ball_constraint(self, node: Element, where: str) -> None:
        self.only(node, where, ("name",))
        given = self._drake(node, where)
        name = node.get("name", "")
        self.loops.append(
            {"name": name, "type": "point", "a": given["body_B"], "b": given["body_A"]}
        )

    def _linear_spring_damper(self, node: Element, where: str) -> None:
        self.only(node, where, ("name",))
        given = self._drake(node, where, "free_length", "stiffness", "damping")
        for key in ("free_length", "stiffness", "damping"):
            if given[key] < 0.0:
                raise self.fault(
                    where, f"its {key} {given[key]:g} is negative", "Give a value >= 0"
                )
        force = {"name": node.get("name", ""), "type": "spring_damper"}
        force |= {"a": given["body_A"], "b": given["body_B"], "rest_length": given["free_length"]}
        self.forces.append(force | {key: given[key] for key in ("stiffness", "damping")})


DRAKE_ELEMENTS = ("ball_constraint", "linear_spring_damper")


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


NOT_ACTING = ("physics", "sensor")
"""Elements inside a Gazebo joint that belong to Gazebo's own solver."""


def read_gazebo_joints(root: Element, elements: LoopElements) -> bool:
    """Read and remove the joints of Gazebo in ``root``; whether there were any.

    Raises
    ------
    InputError
        Naming the joint that cannot be read.
    """
    found = False
    for block in root.findall("gazebo"):
        for joint in block.findall("joint"):
            _read_joint(joint, elements)
            block.remove(joint)
            found = True
        if found and not len(block) and not block.attrib:
            root.remove(block)
    return found


def _read_joint(joint: Element, elements: LoopElements) -> None:
    name = joint.get("name", "")
    where = f"<gazebo><joint> {name!r}"
    elements.only(joint, where, ("name", "type"))
    known = ("parent", "child", "pose", "axis", "axis2", *NOT_ACTING)
    parts: dict[str, Element] = {}
    for node in joint:
        if node.tag not in known:
            raise elements.fault(
                where, f"unknown element <{node.tag}> in it", f"Known: {', '.join(known)}"
            )
        if node.tag in parts:
            raise elements.fault(where, f"<{node.tag}> is given twice", "Keep one")
        parts[node.tag] = node
        if node.tag in ("parent", "child", "pose"):
            elements.leaf(node, where)
    parent, child = (_link(parts.get(side), side, where, elements) for side in ("parent", "child"))
    frame = _pose(parts.get("pose"), child, where, elements)
    graph = elements.graph
    poses = {
        link: pin.SE3.Identity() if link == WORLD else graph.pose(link) for link in (parent, child)
    }
    at = poses[child] * frame
    damping = sum(_damping(parts.get(tag), tag, where, elements) for tag in ("axis", "axis2"))
    axes = [_axis(parts.get(tag), tag, at, where, elements) for tag in ("axis", "axis2")]
    elements.joint(
        elements.kind(joint, where),
        name,
        (parent, poses[parent].actInv(at)),
        (child, frame),
        axes,
        damping=damping,
        where=where,
    )


def _text(node: Element | None) -> str:
    return "" if node is None else (node.text or "").strip()


def _numbers(node: Element, count: int, where: str, elements: LoopElements) -> list[float]:
    """The numbers that are the text of an element."""
    bare = Element(node.tag, value=_text(node))
    return elements.numbers(bare, "value", count, where)


def _link(node: Element | None, side: str, where: str, elements: LoopElements) -> str:
    name = _text(node)
    if not name:
        raise elements.fault(where, f"it has no <{side}>", f"Name its {side} link")
    return elements.link(Element(side, link=name), "link", where)


def _pose(node: Element | None, child: str, where: str, elements: LoopElements) -> pin.SE3:
    """Placement of the joint's frame in the child link."""
    if node is None:
        return pin.SE3.Identity()
    elements.only(node, where, ("relative_to", "frame"))
    relative = node.get("relative_to", node.get("frame", ""))
    if relative not in ("", child):
        raise elements.fault(
            where, f"its <pose> is relative to {relative!r}", "Give it relative to the child link"
        )
    values = _numbers(node, 6, where, elements)
    return placement(values[:3], values[3:])


def _damping(node: Element | None, tag: str, where: str, elements: LoopElements) -> float:
    """Damping about <axis>; friction and springs there are refused."""
    values = {}
    for key in ("damping", "friction", "spring_stiffness"):
        given = None if node is None else node.find(f"dynamics/{key}")
        values[key] = 0.0 if given is None else _numbers(given, 1, where, elements)[0]
        if values[key] and (key != "damping" or tag == "axis2"):
            raise elements.fault(
                where,
                f"its {key} would not act: a closure has none",
                "Set it to 0, or add a [[force]] in a description",
            )
    return values["damping"]


def _axis(
    node: Element | None, tag: str, at: pin.SE3, where: str, elements: LoopElements
) -> FloatArray | None:
    """Direction of <axis> or <axis2> in the joint's frame."""
    if node is None:
        return None
    known = ("xyz", "limit", "dynamics", "use_parent_model_frame", "initial_position")
    for inner in node:
        if inner.tag not in known:
            raise elements.fault(
                where, f"unknown element <{inner.tag}> in <{tag}>", f"Known: {', '.join(known)}"
            )
        if len(node.findall(inner.tag)) > 1:
            raise elements.fault(where, f"<{inner.tag}> is given twice", "Keep one")
        if inner.tag not in ("limit", "dynamics"):
            elements.leaf(inner, where)
    xyz = node.find("xyz")
    if xyz is None:
        raise elements.fault(where, f"<{tag}> has no <xyz>", "Give its direction")
    direction = np.array(_numbers(xyz, 3, where, elements))
    if _text(node.find("use_parent_model_frame")) in ("1", "true"):
        direction = at.rotation.T @ direction
    return direction
