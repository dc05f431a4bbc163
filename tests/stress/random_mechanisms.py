"""Random mechanisms: a closed configuration first, then closures that hold there.

The numbers of bodies and loops are drawn by hypothesis, so that a failure shrinks to few of them;
a :class:`Spec` says the rest, and building it again gives the same mechanism.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from hypothesis import strategies as st

import srm_mbs as srm
from srm_mbs._typing import FloatArray

G = 9.81
WORLD = -1
PLANAR_CLOSURES = {"point": 2, "revolute": 2, "frame": 3, "point_on_line": 1, "point_on_plane": 1}
SPATIAL_CLOSURES = {"point": 3, "revolute": 5, "frame": 6, "point_on_line": 2, "point_on_plane": 1}
"""Degrees of freedom that a closure takes away at most."""
SPATIAL_JOINTS = {"revolute": 1, "prismatic": 1, "ball": 3, "free": 6}
Y = np.array([0.0, 1.0, 0.0])


@dataclass(frozen=True)
class Closure:
    """A closure between two bodies (``WORLD`` is the ground), ``copies`` times."""

    kind: str
    a: int
    b: int
    copies: int = 1


@dataclass(frozen=True)
class Spec:
    """A random mechanism; the same values give the same mechanism.

    Attributes
    ----------
    planar
        Motion in the x-z plane, gravity along -z; otherwise in space.
    seed
        Of everything that is not listed here.
    length
        Mean size of the bodies (m).
    parents, joints
        Per body: the body that carries it, and the type of its joint.
    closures
        The loops.
    """

    planar: bool
    seed: int
    length: float
    parents: tuple[int, ...]
    joints: tuple[str, ...]
    closures: tuple[Closure, ...]


@st.composite
def specs(draw: st.DrawFn, planar: bool) -> Spec:
    """Mechanisms with at least one loop and one degree of freedom, lengths over four decades.

    Drawn are few numbers, of which every combination is another mechanism: hypothesis repeats
    itself, and would repeat whole mechanisms if it drew every joint.
    """
    bodies = draw(st.integers(2, 7 if planar else 5))
    loops = draw(st.integers(1, 3))
    seed = draw(st.integers(0, 2**32 - 1))
    rng = np.random.default_rng([seed, bodies, loops])
    kinds = ("revolute", "revolute", "revolute", "prismatic") if planar else tuple(SPATIAL_JOINTS)
    joints = tuple(str(kind) for kind in rng.choice(kinds, bodies))
    takes = PLANAR_CLOSURES if planar else SPATIAL_CLOSURES
    freedom = bodies if planar else sum(SPATIAL_JOINTS[kind] for kind in joints)
    closures = []
    for _ in range(loops):
        affordable = [kind for kind, taken in takes.items() if taken < freedom]
        if not affordable:
            break
        kind = str(rng.choice(affordable))
        a = int(rng.integers(bodies))
        b = int(rng.choice([body for body in range(WORLD, bodies) if body != a]))
        closures.append(Closure(kind, a, b, int(rng.choice([1, 1, 1, 2]))))
        freedom -= takes[kind]
    length = 10.0 ** rng.uniform(-2.0, 2.0)
    parents = _parents(rng.choice([0, 0, 1, 2, 3], bodies).tolist())
    return Spec(planar, seed, length, parents, joints, tuple(closures))


def _parents(ups: list[int]) -> tuple[int, ...]:
    """Body i hangs ``ups[i]`` bodies below the one before it: trees in depth-first order."""
    parents: list[int] = []
    for i, up in enumerate(ups):
        at = i - 1
        for _ in range(up):
            at = parents[at] if at != WORLD else WORLD
        parents.append(at)
    return tuple(parents)


def _unit_vector(rng: np.random.Generator, planar: bool) -> FloatArray:
    direction = rng.standard_normal(3)
    if planar:
        direction[1] = 0.0
    return np.asarray(direction / np.linalg.norm(direction))


def _inertia(rng: np.random.Generator, mass: float, size: float, planar: bool) -> pin.Inertia:
    """A body of about ``size``; the inertia tensor is that of a real body."""
    gyration = (size * rng.uniform(0.2, 0.4, 3)) ** 2  # second moments over the mass
    lever = 0.5 * size * _unit_vector(rng, planar)
    turn = np.eye(3) if planar else pin.exp3(rng.uniform(-1.0, 1.0, 3))
    tensor = mass * turn @ np.diag(gyration.sum() - gyration) @ turn.T
    return pin.Inertia(mass, lever, tensor)


def _joint(kind: str, axis: FloatArray) -> object:
    return {
        "revolute": lambda: pin.JointModelRevoluteUnaligned(axis),
        "prismatic": lambda: pin.JointModelPrismaticUnaligned(axis),
        "ball": pin.JointModelSpherical,
        "free": pin.JointModelFreeFlyer,
    }[kind]()


def _tree(spec: Spec) -> tuple[pin.Model, FloatArray, FloatArray]:
    """The tree, a random configuration and random rates."""
    model = pin.Model()
    model.gravity.linear = np.array([0.0, 0.0, -G])
    lengths, turns, rates = [], [], []
    for i, (parent, kind) in enumerate(zip(spec.parents, spec.joints)):
        rng = np.random.default_rng([spec.seed, i])
        size = spec.length * 10.0 ** rng.uniform(-0.4, 0.4)
        reach = spec.length if parent == WORLD else lengths[parent]
        placement = pin.SE3(np.eye(3), reach * _unit_vector(rng, spec.planar))
        axis = Y if spec.planar and kind == "revolute" else _unit_vector(rng, spec.planar)
        joint = model.addJoint(parent + 1, _joint(kind, axis), placement, f"joint_{i}")
        mass = 10.0 ** rng.uniform(-2.0, 2.0)
        model.appendBodyToJoint(joint, _inertia(rng, mass, size, spec.planar), pin.SE3.Identity())
        model.addBodyFrame(f"body_{i}", joint, pin.SE3.Identity(), 0)
        lengths.append(size)
        unit = np.ones(model.joints[joint].nv)
        if kind in ("prismatic", "free"):
            unit[:3] *= spec.length
        turns.append(unit * rng.uniform(-1.5, 1.5, len(unit)))
        rates.append(unit * rng.uniform(-1.0, 1.0, len(unit)) * np.sqrt(G / spec.length))
    q = pin.integrate(model, pin.neutral(model), np.concatenate(turns))
    return model, q, np.concatenate(rates)


def _anchor(body: int, pose: pin.SE3, bodies: list[pin.SE3]) -> srm.Anchor:
    """The anchor on ``body`` that has the world placement ``pose``."""
    local = pose if body == WORLD else bodies[body].actInv(pose)
    return srm.Anchor(
        "world" if body == WORLD else f"body_{body}",
        xyz=tuple(local.translation),
        rpy=tuple(pin.rpy.matrixToRpy(local.rotation)),
    )


def build(spec: Spec) -> tuple[srm.Mechanism, FloatArray]:
    """The mechanism, closed at its q0, and random rates (nv,) that its loops do not allow yet."""
    model, q, rates = _tree(spec)
    data = model.createData()
    pin.forwardKinematics(model, data, q)
    bodies = list(data.oMi)[1:]
    loops = []
    for i, closure in enumerate(spec.closures):
        rng = np.random.default_rng([spec.seed, 1000 + i])
        turn = pin.exp3(rng.uniform(-1.0, 1.0, 3) * (Y if spec.planar else 1.0))
        offset = spec.length * rng.uniform(0.3, 1.0) * _unit_vector(rng, spec.planar)
        pose = pin.SE3(turn, bodies[closure.a].act(offset))
        axis = {
            "revolute": Y if spec.planar else _unit_vector(rng, False),
            "point_on_line": _unit_vector(rng, spec.planar),
            "point_on_plane": _unit_vector(rng, spec.planar),
        }.get(closure.kind)
        loops += [
            srm.LoopClosure(
                closure.kind,
                _anchor(closure.a, pose, bodies),
                _anchor(closure.b, pose, bodies),
                None if axis is None else tuple(axis),
                name=f"loop_{i}_{copy}",
            )
            for copy in range(closure.copies)
        ]
    return srm.Mechanism(model, tuple(loops), q0=q, name="random"), rates
