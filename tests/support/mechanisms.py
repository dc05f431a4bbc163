"""Mechanisms that only tests need."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.multibody import make_system
from srm_mbs.dynamics.system import Terms
from srm_mbs.formats.load import models_folder


def _has_closures_and_no_drive(name: str) -> bool:
    text = (models_folder() / f"{name}.toml").read_text(encoding="utf-8")
    return ("[[loop]]" in text or "[planar]" in text) and "drive]]" not in text


LONG_TO_COMPILE = ("delta_robot", "stewart_platform")
"""Bundled mechanisms whose code takes the compiler seconds."""
DISTINCT_MODELS = tuple(name for name in srm.bundled_models() if not name.endswith("_planar"))
"""Without those that are others typed in as points and bars, to which a test compares them."""
COMPILED_MODELS = [
    pytest.param(name, marks=pytest.mark.stress) if name in LONG_TO_COMPILE else name
    for name in DISTINCT_MODELS
]
"""The same, as parameters of tests that compile the code of each."""
CLOSED_MODELS = tuple(filter(_has_closures_and_no_drive, DISTINCT_MODELS))
"""Those with closures alone; the rows of drives have tests of their own."""
ANCHORED_MODELS = tuple(name for name in CLOSED_MODELS if name != "differential")
"""Those whose closures join bodies; the others are couplings of joints."""
INDEPENDENT_MODELS = tuple(name for name in CLOSED_MODELS if name != "bricard")
"""Those whose rows that are kept are independent off the closed configurations, too."""


def rod(mass: float = 1.0, length: float = 1.0, thickness: float = 0.24) -> pin.Inertia:
    """Uniform rod along x from the origin; ``thickness``: ratio of axial to transverse inertia."""
    transverse = mass * length**2 / 12.0
    inertia = np.diag([thickness * transverse, transverse, transverse])
    return pin.Inertia(mass, np.array([length / 2.0, 0.0, 0.0]), inertia)


def add_link(
    model: pin.Model,
    parent: int,
    joint: object,
    name: str,
    inertia: pin.Inertia | None = None,
    at: pin.SE3 | None = None,
) -> int:
    """Add a joint and a link on it, both called ``name``; by default a :func:`rod` at the parent.

    Returns the index of the joint.
    """
    here = pin.SE3.Identity()
    index: int = model.addJoint(parent, joint, at or here, name)
    model.appendBodyToJoint(index, inertia or rod(), here)
    model.addBodyFrame(name, index, here, 0)
    return index


def random_state(
    model: pin.Model, seed: int | np.random.Generator, turn: float = 1.0
) -> tuple[FloatArray, FloatArray]:
    """q (nq,) up to ``turn`` (rad, m) away from neutral in each direction, and v (nv,) up to 1."""
    rng = np.random.default_rng(seed)
    q = pin.integrate(model, pin.neutral(model), turn * rng.uniform(-1.0, 1.0, model.nv))
    return q, rng.uniform(-1.0, 1.0, model.nv)


def along_x(distance: float) -> pin.SE3:
    return pin.SE3(np.eye(3), np.array([distance, 0.0, 0.0]))


def start_terms(mechanism: srm.Mechanism) -> Terms:
    """The terms of the reference at the start."""
    state = np.concatenate([mechanism.q0, mechanism.v0])
    return make_system(mechanism).evaluate(0.0, state)


def floating_ring(root: object | None = None, seed: int = 0) -> srm.Mechanism:
    """Four rods in a ring of ball joints, free in space without gravity: nq != nv throughout."""
    rng = np.random.default_rng(seed)
    model = pin.Model()
    model.name = "floating_ring"
    model.gravity.linear = np.zeros(3)
    parent = 0
    for i, name in enumerate("abcd"):
        joint = pin.JointModelSpherical() if i else (root or pin.JointModelFreeFlyer())
        parent = add_link(model, parent, joint, name, at=along_x(1.0 if i else 0.0))
    q = pin.neutral(model)
    turn = np.array([0.1, 0.15, 1.0])
    quaternion = pin.Quaternion(pin.exp3(1.4 * turn / np.linalg.norm(turn))).coeffs()
    for name in "bcd":
        start = model.joints[model.getJointId(name)].idx_q
        q[start : start + 4] = quaternion
    loop = srm.LoopClosure(
        "point", srm.Anchor("d", xyz=(1.0, 0.0, 0.0)), srm.Anchor("a"), name="ring"
    )
    mechanism = srm.Mechanism(model, (loop,), q0=q)
    state = srm.assemble(mechanism, v=1.5 * rng.standard_normal(model.nv))
    return mechanism.with_state(state.q, state.v)


def with_slider_mass(mass: float) -> srm.Mechanism:
    """The bundled slider_crank_slider with another mass (kg) of the slider."""
    base = srm.load("slider_crank_slider")
    model = base.model.copy()
    slider = model.getJointId("slider")
    inertia = model.inertias[slider]
    model.inertias[slider] = pin.Inertia(
        mass, inertia.lever, inertia.inertia * (mass / inertia.mass)
    )
    return srm.Mechanism(model, base.loops, q0=base.q0, v0=base.v0)


def ball_dead_point(angle: float = -np.pi / 6.0, rate: float = 4.0) -> srm.Mechanism:
    """The bundled spatial_dead_point with a Pinocchio ball joint: nq != nv.

    ``angle`` (rad) and ``rate`` (rad/s) of the crank count from the guide line, where
    :func:`tests.support.reduced.spatial_dead_point` has them.  Axes: x along the line, z along the
    crank's axis; gravity is tilted instead of the line.  The rod does not spin.
    """
    crank, side = 2.0, 1.5
    model = pin.Model()
    model.name = "ball_dead_point"
    model.gravity.linear = 9.81 * np.array([-0.5, -np.sqrt(0.75), 0.0])
    first = add_link(model, 0, pin.JointModelRZ(), "crank", rod(1.0, crank, 0.0))
    ball, inertia = pin.JointModelSpherical(), rod(1.0, 2.5, 0.02)
    add_link(model, first, ball, "rod", inertia, along_x(crank))
    loop = srm.LoopClosure(
        "point_on_line",
        srm.Anchor("rod", xyz=(2.5, 0.0, 0.0)),
        srm.Anchor("world", xyz=(0.0, 0.0, side)),
        (1.0, 0.0, 0.0),
        "rail",
    )
    c, s = np.cos(angle), np.sin(angle)
    along = np.array([crank * c, -crank * s, side])
    along_rate = np.array([-crank * s, -crank * c, 0.0]) * rate
    across = np.cross([0.3, 0.1, 1.0], along)
    across /= np.linalg.norm(across)
    x = along / 2.5
    R = np.column_stack([x, across, np.cross(x, across)])
    turn = np.cross(along, along_rate) / 2.5**2 - np.array([0.0, 0.0, rate])
    Rc = pin.exp3(np.array([0.0, 0.0, angle]))
    q = np.concatenate([[angle], pin.Quaternion(Rc.T @ R).coeffs()])
    return srm.Mechanism(model, (loop,), q0=q, v0=np.concatenate([[rate], R.T @ turn]))


def floating_slider_crank(
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0), away: float = 0.0
) -> srm.Mechanism:
    """A slider-crank on a free-flying beam without gravity, starting on a singular configuration.

    The beam carries a crank and a rod of 1 m, whose tip slides along the beam; ``turn`` is the
    beam's orientation (rotation vector, rad), ``away`` the crank's angle from square to the beam.
    """
    model = pin.Model()
    model.name = "floating_slider_crank"
    model.gravity.linear = np.zeros(3)
    base = model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "beam")
    model.appendBodyToJoint(base, rod(2.0, 3.0), along_x(-0.5))
    model.addBodyFrame("beam", base, pin.SE3.Identity(), 0)
    crank = add_link(model, base, pin.JointModelRZ(), "crank")
    add_link(model, crank, pin.JointModelRZ(), "rod", rod(1.5), along_x(1.0))
    loop = srm.LoopClosure(
        "point_on_line",
        srm.Anchor("rod", xyz=(1.0, 0.0, 0.0)),
        srm.Anchor("beam"),
        (1.0, 0.0, 0.0),
        "slide",
    )
    q = pin.neutral(model)
    q[3:7] = pin.Quaternion(pin.exp3(np.array(turn))).coeffs()
    q[7:] = [0.5 * np.pi + away, -np.pi - 2.0 * away]
    v = np.array([0.3, -0.2, 0.5, 0.7, -0.4, 0.6, 2.0, -4.0])
    return srm.Mechanism(model, (loop,), q0=q, v0=v)


@cache
def slider_crank_of_points(apart: float) -> srm.Mechanism:
    """slider_crank of two free bodies, whose hinges are two points each, ``apart`` (m) from each
    other on the axis; so are those of the tip on its plane."""
    base = srm.load("slider_crank")
    model = pin.Model()
    model.name = "slider_crank_of_points"
    model.gravity.linear = base.model.gravity.linear
    first, second = np.cumsum(-base.q0)
    tip = 2.0 * np.array([np.cos(first), 0.0, -np.sin(first)])
    q: list[float] = []
    for name, turn, origin in (("crank", first, np.zeros(3)), ("rod", second, tip)):
        add_link(model, 0, pin.JointModelFreeFlyer(), name, rod(1.0, 2.0))
        q += [*origin, 0.0, np.sin(0.5 * turn), 0.0, np.cos(0.5 * turn)]
    ends = (("crank", 0.0, "world", 0.0), ("rod", 0.0, "crank", 2.0), ("rod", 2.0, "world", 0.0))
    loops = []
    for name, (a, at_a, b, at_b) in zip(("pivot", "hinge", "pin"), ends):
        for k, y in enumerate((0.0, apart)):
            anchors = srm.Anchor(a, xyz=(at_a, y, 0.0)), srm.Anchor(b, xyz=(at_b, y, 0.0))
            if name == "pin":
                plane = (0.0, 0.0, 1.0)
                loops.append(srm.LoopClosure("point_on_plane", *anchors, plane, f"pin_{k}"))
            else:
                loops.append(srm.LoopClosure("point", *anchors, name=f"{name}_{k}"))
    return srm.Mechanism(model, tuple(loops), q0=np.array(q))


def rescaled(
    mechanism: srm.Mechanism, length: float = 1.0, mass: float = 1.0, time: float = 1.0
) -> srm.Mechanism:
    """The same mechanism in other units: lengths, masses and times multiplied."""
    model = mechanism.model.copy()
    for j in range(model.njoints):
        placement, inertia = model.jointPlacements[j], model.inertias[j]
        model.jointPlacements[j] = pin.SE3(placement.rotation, placement.translation * length)
        model.inertias[j] = pin.Inertia(
            inertia.mass * mass, inertia.lever * length, inertia.inertia * (mass * length**2)
        )
    for frame in model.frames:
        frame.placement = pin.SE3(frame.placement.rotation, frame.placement.translation * length)
    model.gravity.linear = model.gravity.linear * (length / time**2)

    def moved(anchor: srm.Anchor) -> srm.Anchor:
        x, y, z = anchor.xyz
        return replace(anchor, xyz=(x * length, y * length, z * length))

    def pushed(element: srm.ForceElement) -> srm.ForceElement:
        force = mass * length / time**2
        if isinstance(element, srm.JointTorque):  # of a hinge
            return replace(element, torque=float(np.float64(element.torque) * force * length))
        if isinstance(element, srm.TorsionSpring):
            return replace(
                element,
                stiffness=element.stiffness * force * length,
                damping=element.damping * force * length * time,
            )
        assert isinstance(element, srm.SpringDamper)
        return replace(
            element,
            a=moved(element.a),
            b=moved(element.b),
            stiffness=element.stiffness * (force / length),
            damping=element.damping * (force / length * time),
            rest_length=element.rest_length * length,  # type: ignore[operator]
        )

    loops = tuple(
        loop
        if loop.a is None or loop.b is None
        else replace(loop, a=moved(loop.a), b=moved(loop.b))
        for loop in mechanism.loops  # bundled couplings join hinges
    )
    translation = mechanism.structure.units.coordinate != 1.0
    model.damping = model.damping * np.where(translation, 1.0, length**2) * (mass / time)
    unit = np.where(translation, length, 1.0)
    q0 = np.array(mechanism.q0)
    for joint in list(model.joints)[1:]:
        lengths = translation[joint.idx_v : joint.idx_v + joint.nv]
        # A quaternion comes after the position.
        q0[joint.idx_q : joint.idx_q + lengths.size][lengths] *= length
    return srm.Mechanism(
        model,
        loops,
        q0=q0,
        v0=mechanism.v0 * unit / time,
        forces=tuple(pushed(force) for force in mechanism.forces),
        name=mechanism.name,
    )


def distance(mechanism: srm.Mechanism, a: srm.Solution, b: srm.Solution) -> float:
    """Largest difference of the last states, in tangent coordinates."""
    dq = pin.difference(mechanism.model, a.q[-1], b.q[-1])
    return max(float(np.abs(dq).max()), float(np.abs(a.v[-1] - b.v[-1]).max()))
