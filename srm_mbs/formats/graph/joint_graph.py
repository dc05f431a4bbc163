"""Bodies and joints of a file, as a graph, and the spanning tree that is simulated.

Other formats describe joints between any two bodies.  The choice of the tree follows one rule:
of each loop the joint with the most freedom is cut, since it adds the fewest closure rows and
leaves the fewest joint coordinates; among those the one farthest from the root, so that the tree
stays shallow.  A joint with a property that no closure has (friction, a thread, a coupling) is cut
only if the loop has no other joint.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
import pinocchio as pin

from srm_mbs._typing import FloatArray
from srm_mbs.errors import InputError, known_names
from srm_mbs.model.anchors import WORLD
from srm_mbs.model.forces import OPEN_LIMIT

Direction = tuple[float, float, float]

FREEDOM = {
    "fixed": 0,
    "revolute": 1,
    "prismatic": 1,
    "screw": 1,
    "slot": 2,
    "universal": 2,
    "spherical": 3,
    "floating": 6,
}
"""Degrees of freedom of the types of joint; a slot is a pin that slides along a line."""
ROOT_JOINT = "root_joint"
"""Pinocchio's name for the joint of a floating or planar base."""


@dataclass(frozen=True, eq=False)
class Body:
    """One rigid body.

    Attributes
    ----------
    name
        Unique.
    inertia
        Mass (kg), centre of mass (m) and inertia (kg m^2) in the body's frame; None: massless.
    visuals
        ``<visual>`` elements of URDF, in the body's frame.
    """

    name: str
    inertia: pin.Inertia | None = None
    visuals: tuple[Element, ...] = ()


def inertia_tensor(moments: Sequence[float] | FloatArray) -> FloatArray:
    """The tensor (3, 3) of the moments xx, yy, zz, xy, xz, yz (kg m^2)."""
    xx, yy, zz, xy, xz, yz = moments
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def inertia_at(
    placement: pin.SE3, mass: float, moments: Sequence[float] | FloatArray
) -> pin.Inertia:
    """Inertia in the body's frame, from the moments about the centre of mass, which is at
    ``placement``, in its axes (:func:`inertia_tensor`)."""
    R = placement.rotation
    out = pin.Inertia(mass, placement.translation, np.zeros((3, 3)))
    out.inertia = R @ inertia_tensor(moments) @ R.T  # unchecked here: the check of the tree does
    return out


@dataclass(frozen=True, eq=False)
class Joint:
    """A joint between two bodies; its frames on the two coincide where its position is zero.

    Attributes
    ----------
    name, type
        ``type`` is a key of :data:`FREEDOM`.
    parent, child
        Names of bodies; ``world`` is the ground.
    in_parent, in_child
        Placement of the joint's frame in the two bodies' frames.
    axis, second_axis
        Unit vectors in the joint's frame; the second is that of a universal joint and turns with
        the child.
    pitch
        Of a screw: metres along the axis per turn.
    lower, upper, effort, speed
        Limits, in SI units.
    damping, friction
        N m s/rad and N m, or N s/m and N.
    stiffness, rest
        Of a spring on the joint's coordinate: N m/rad or N/m, and the position where it is relaxed.
    armature
        Inertia of the motor that adds to the joint's own: kg m^2 or kg.
    coupled
        Whether the joint's position is used elsewhere, so that it should not be cut.
    """

    name: str
    type: str
    parent: str
    child: str
    in_parent: pin.SE3 = field(default_factory=pin.SE3.Identity)
    in_child: pin.SE3 = field(default_factory=pin.SE3.Identity)
    axis: Direction = (1.0, 0.0, 0.0)
    second_axis: Direction | None = None
    pitch: float = 0.0
    lower: float = -OPEN_LIMIT
    upper: float = OPEN_LIMIT
    effort: float = OPEN_LIMIT
    speed: float = OPEN_LIMIT
    damping: float = 0.0
    friction: float = 0.0
    stiffness: float = 0.0
    rest: float = 0.0
    armature: float = 0.0
    coupled: bool = False

    @property
    def kept(self) -> bool:
        """Whether a closure could not replace it."""
        return bool(self.coupled or self.friction or self.armature or self.type == "screw")

    def reversed(self) -> Joint:
        """The same motion with parent and child exchanged.

        Of one-degree joints also the coordinate is the same: the parent turns about the negative
        axis against the child.  Of a universal joint the two angles change places.
        """
        first, second = _negative(self.axis), self.second_axis
        if second is not None:
            first, second = _negative(second), first
        return replace(
            self,
            parent=self.child,
            child=self.parent,
            in_parent=self.in_child,
            in_child=self.in_parent,
            axis=first,
            second_axis=second,
        )


THREAD_PITCH = "<thread_pitch> x is read as libsdformat converts it, -2 pi/x metres per turn"
"""Note about :func:`metres_per_turn`."""


def metres_per_turn(thread_pitch: float) -> float:
    """The pitch of a screw from the ``<thread_pitch>`` of SDF, which is not zero."""
    return -2.0 * math.pi / thread_pitch


def _negative(axis: Direction) -> Direction:
    x, y, z = (-np.array(axis) + 0.0).tolist()
    return (x, y, z)


@dataclass(frozen=True)
class SpanningTree:
    """The joints of the tree, from the root outwards, and those that are cut.

    Attributes
    ----------
    joints
        Each joint's parent is nearer to the root than its child.
    reversed
        Names of the tree's joints whose parent and child changed places.
    cut
        As the file has them.
    """

    joints: tuple[Joint, ...]
    reversed: tuple[str, ...]
    cut: tuple[Joint, ...]


def _graph(joints: Sequence[Joint], root: str) -> Any:
    """The joints as the edges of a networkx multigraph whose nodes are bodies, in their order."""
    import networkx  # only files with graphs of joints need it

    graph = networkx.MultiGraph()
    graph.add_node(root)
    for joint in joints:
        graph.add_edge(joint.parent, joint.child, joint.name, joint=joint)
    return graph


def distances(joints: Sequence[Joint], root: str) -> dict[str, int]:
    """Number of joints between ``root`` and each body connected with it, nearest first."""
    import networkx

    return dict(networkx.single_source_shortest_path_length(_graph(joints, root), root))


def spanning_tree(joints: Sequence[Joint], root: str, cut: Sequence[str] = ()) -> SpanningTree:
    """A spanning tree of the joints, which connect all bodies with ``root``.

    A minimal spanning tree (Kruskal's algorithm) by: properties that no closure has, freedom,
    distance from the root, place in the file.

    Parameters
    ----------
    joints
        The graph's edges, with unique names.
    root
        The root body.
    cut
        Names of the joints to cut; empty: by the rule above.

    Raises
    ------
    InputError
        If cutting ``cut`` does not leave a tree.
    """
    import networkx

    depth = distances(joints, root)

    def cost(joint: Joint) -> tuple[bool, int, int]:
        where = depth[joint.parent] + depth[joint.child]
        return (not joint.kept, FREEDOM[joint.type], where)

    candidates = [joint for joint in joints if joint.name not in cut]
    graph = _graph(candidates, root)
    for rank, joint in enumerate(sorted(candidates, key=cost)):
        graph.edges[joint.parent, joint.child, joint.name]["weight"] = rank
    edges = networkx.minimum_spanning_edges(graph, data=False)
    chosen = {name for _, _, name in edges}
    if cut:
        _check_cut(joints, candidates, chosen, cut, root)
    tree = _graph([joint for joint in joints if joint.name in chosen], root)
    order, turned = [], []
    for body, other in networkx.bfs_edges(tree, root):
        (edge,) = tree[body][other].values()
        joint = edge["joint"]
        if joint.parent != body:
            joint = joint.reversed()
            turned.append(joint.name)
        order.append(joint)
    return SpanningTree(
        tuple(order), tuple(turned), tuple(j for j in joints if j.name not in chosen)
    )


def _check_cut(
    joints: Sequence[Joint],
    candidates: Sequence[Joint],
    chosen: set[str],
    cut: Sequence[str],
    root: str,
) -> None:
    """Refuse joints to ``cut`` that there are not, that leave a loop, or that separate a body."""

    def fault(problem: str, remedy: str) -> InputError:
        return InputError(problem, element="cut", remedy=remedy)

    known = [joint.name for joint in joints]
    for name in cut:
        if name not in known:
            raise fault(f"there is no joint {name!r} to cut", known_names(known))
    cutting = f"cutting {', '.join(map(repr, cut))}"
    proposal = f"Left out, cut is {[joint.name for joint in spanning_tree(joints, root).cut]}"
    for joint in candidates:
        if joint.name not in chosen:
            raise fault(
                f"{cutting} leaves a loop through joint {joint.name!r}",
                f"Cut one joint of each loop. {proposal}",
            )
    reached = distances(candidates, root)
    for joint in joints:
        for body in (joint.parent, joint.child):
            if body not in reached:
                raise fault(
                    f"{cutting} separates {body!r} from {root!r}",
                    f"Cut one joint of each loop only. {proposal}",
                )


def components(bodies: Mapping[str, Body], joints: Sequence[Joint]) -> Iterator[list[str]]:
    """Connected components, their bodies in the order of the file; ``world`` is the ground."""
    import networkx

    graph = networkx.MultiGraph()
    graph.add_nodes_from((WORLD, *bodies))
    graph.add_edges_from((joint.parent, joint.child) for joint in joints)
    for found in networkx.connected_components(graph):
        yield [body for body in (WORLD, *bodies) if body in found]
