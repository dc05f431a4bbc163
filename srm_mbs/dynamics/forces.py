"""Generalised forces of the force elements, from the kinematics of one evaluation.

A wrench W = (f, m) in world axes about the world origin that acts on body a, and -W on body b,
gives

    tau = (J_a - J_b)^T W

with J the world-frame joint Jacobian; all elements between bodies are reduced to it.  Velocities
are spatial, in world axes at the world origin; that of a point p is v_lin + w x p.

Each element of :mod:`srm_mbs.model.forces` has an :class:`Evaluator`: first those between links
(springs, wrenches, bushings), then those on joints (torques, springs, limits), then functions of
the user.  :class:`ForceKinematics` has all elements of a mechanism.

The rotation vector of a bushing, and with it its moment, jumps to the opposite at half a turn.  In
the stages of a step it goes on smoothly beyond: of the two rotation vectors of less than a turn,
the stages take the one nearest to that at the start of the step.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from math import copysign, inf, pi, sqrt, tanh
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from srm_mbs._kernel.workspace import workspace
from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.constraints.rows import (
    COINCIDENT,
    cross,
    placement_numbers,
    support,
    world_jacobian,
)
from srm_mbs.dynamics.controllers import evaluate_callback
from srm_mbs.errors import EvaluationError
from srm_mbs.model.anchors import Anchor
from srm_mbs.model.forces import (
    Bushing,
    CouplingSpring,
    ForceElement,
    JointTorque,
    LimitSpring,
    SpringDamper,
    TorsionSpring,
    UserForce,
    Wrench,
)
from srm_mbs.model.laws import Law, curve_of
from srm_mbs.model.lazy import cached_property
from srm_mbs.model.mechanism import FRICTION_SPEED, MechanismData, per_model


class LinkWrench(NamedTuple):
    """A wrench between two bodies.

    Attributes
    ----------
    a, b
        Joints that carry the bodies, 0 for the ground.
    wrench : (6,)
        Force (N) then moment (N m) about the world origin, in world axes, that acts on a; its
        opposite acts on b.
    """

    a: int
    b: int
    wrench: FloatArray


class Coefficient(NamedTuple):
    """A coefficient c of an element, and the direction n of generalised forces in which it acts
    with -c n^T v or -c n^T dq.

    Attributes
    ----------
    kind
        "damping", "stiffness", or "friction": F/v_s, what friction damps with at rest.
    value
        c, N s/m or N/m; N m s/rad or N m/rad if ``angular``.
    direction : (nv,)
        n.
    """

    kind: str
    value: float
    direction: FloatArray
    angular: bool


class Evaluator(ABC):
    """One element, resolved against a model.  ``data`` holds placements, velocities and J."""

    @abstractmethod
    def add(self, tau: FloatArray, data: pin.Data, q: FloatArray, v: FloatArray, t: float) -> None:
        """Add the element's generalised forces at t (s) to ``tau`` (nv,)."""

    def between(self, data: pin.Data, q: FloatArray, v: FloatArray, t: float) -> LinkWrench | None:
        """The wrench at t (s), if it acts between bodies; None if it acts on joint coordinates."""
        return None

    def energy(self, data: pin.Data, q: FloatArray) -> float:
        """Its potential energy (J), if it has one; ``data`` need hold the placements only."""
        return 0.0

    def coefficients(self, data: pin.Data) -> list[Coefficient]:
        """Its coefficients that are not zero, if it damps or stores energy."""
        return []

    @abstractmethod
    def constants(self) -> dict[str, Any] | None:
        """Constants for the compiled kernel, of which ``kind`` is that of forces.hpp; None for
        functions of the user, which the kernel calls."""


class LawEvaluator(Evaluator):
    """An element between links, or on several joints, with laws: forces and moments, each along
    its own direction."""

    law_count: int
    """Number of its laws."""

    @abstractmethod
    def laws(
        self,
        data: pin.Data,
        q: FloatArray,
        v: FloatArray,
        step: BushingStep | None = None,
    ) -> FloatArray:
        """Values (law_count,) of its laws; ``step``: that of a bushing to which the stage
        belongs."""

    @abstractmethod
    def apply(
        self,
        tau: FloatArray,
        data: pin.Data,
        values: FloatArray,
        step: BushingStep | None = None,
    ) -> None:
        """Add the generalised forces to ``tau`` (nv,) if ``values`` (law_count,) act in place of
        its laws; ``step`` as for :meth:`laws`."""


class ResolvedAnchor:
    """An anchor as a frame on the body of a joint, 0 for the world."""

    def __init__(self, model: pin.Model, anchor: Anchor) -> None:
        self.joint, self.in_joint = anchor.resolve(model)
        self.support = support(model, self.joint)

    def constants(self) -> tuple[int, FloatArray]:
        """Joint, and placement in its axes as numbers, for the compiled kernel."""
        return self.joint, placement_numbers(self.in_joint)

    def placement(self, data: pin.Data) -> pin.SE3:
        """Placement of the frame in the world."""
        return data.oMi[self.joint] * self.in_joint if self.joint else self.in_joint

    def velocity(self, data: pin.Data) -> pin.Motion:
        """Spatial velocity of the body, in world axes at the world origin."""
        joint = self.joint
        return data.oMi[joint].act(data.v[joint]) if joint else pin.Motion.Zero()


def wrench_at(point: FloatArray, force: FloatArray, moment: FloatArray | None = None) -> FloatArray:
    """The wrench (6,) about the world origin of a force (3,) at ``point`` (3,) and a moment (3,),
    all in world axes."""
    about_origin = cross(point, force)
    return np.concatenate([force, about_origin if moment is None else moment + about_origin])


def add_wrench(tau: FloatArray, data: pin.Data, support: FloatArray, wrench: FloatArray) -> None:
    """Add J^T W to ``tau`` (nv,) on the joints of ``support`` (nv,), of a ``wrench`` (6,) about the
    world origin, in world axes."""
    tau += (world_jacobian(data).T @ wrench) * support


def point_velocity(body: pin.Motion, point: FloatArray) -> FloatArray:
    """Velocity (3,) of ``point``, in world axes, that moves with ``body``."""
    return body.linear + cross(body.angular, point)  # type: ignore[no-any-return]


class ValuesOverTime:
    """Numbers (n,) that laws multiply over time: no law, one for all of them, or one for each."""

    def __init__(
        self, numbers: Sequence[float] | FloatArray, law: Law | Sequence[Law] | None
    ) -> None:
        self._numbers = np.array(numbers, dtype=float)
        laws = () if law is None else (law,) if isinstance(law, Law) else law
        self._curves = list(map(curve_of, laws))

    def at(self, t: float) -> FloatArray:
        """The numbers at t (s)."""
        if not self._curves:
            return self._numbers
        factors = [curve(t)[0] for curve in self._curves]
        return self._numbers * (factors[0] if len(factors) == 1 else np.array(factors))

    def constants(self) -> dict[str, Any]:
        """Numbers and curves, for the compiled kernel."""
        curves = [curve.constants() for curve in self._curves]
        return {"numbers": self._numbers, "curves": curves}


def stretched(beyond: float, slack: float) -> float:
    """Stretch of a spring ``beyond`` its rest length, without force up to ``slack`` from there."""
    return beyond - min(max(beyond, 0.0), slack)


class SpringDamperEvaluator(LawEvaluator):
    """A :class:`~srm_mbs.model.forces.SpringDamper`, resolved against a model."""

    def __init__(self, model: pin.Model, force: SpringDamper) -> None:
        self.name = force.name
        self.a, self.b = ResolvedAnchor(model, force.a), ResolvedAnchor(model, force.b)
        self.support = self.a.support - self.b.support
        self.stiffness, self.damping = force.stiffness, force.damping
        self.rest_length = float(force.rest_length or 0.0)
        self.slack = force.slack
        self.law_count = 1 if self.rest_length or self.slack else 0

    def add(self, tau: FloatArray, data: pin.Data, q: FloatArray, v: FloatArray, t: float) -> None:
        force, at_a, _ = self._force(data)
        add_wrench(tau, data, self.support, wrench_at(at_a, force))

    def between(self, data: pin.Data, q: FloatArray, v: FloatArray, t: float) -> LinkWrench:
        force, at_a, _ = self._force(data)
        return LinkWrench(self.a.joint, self.b.joint, wrench_at(at_a, force))

    def laws(
        self,
        data: pin.Data,
        q: FloatArray,
        v: FloatArray,
        step: BushingStep | None = None,
    ) -> FloatArray:
        """The force along the line."""
        if not self.law_count:
            return np.zeros(0)
        force, _, line = self._force(data)
        return np.array([force @ line])

    def apply(
        self,
        tau: FloatArray,
        data: pin.Data,
        values: FloatArray,
        step: BushingStep | None = None,
    ) -> None:
        force, at_a, line = self._force(data)
        if self.law_count:
            force = values[0] * line
        add_wrench(tau, data, self.support, wrench_at(at_a, force))

    def _force(self, data: pin.Data) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Force (3,) on a, the point at which it acts, and the direction of the line."""
        at_a = self.a.placement(data).translation
        at_b = self.b.placement(data).translation
        apart = at_a - at_b
        length = sqrt(apart @ apart)
        if length < COINCIDENT * self.rest_length:
            raise EvaluationError(
                f"the two points of the force {self.name!r} coincide: its direction is not "
                "determined"
            )
        # k (l - l0) apart/l, without dividing where l = l0 = 0.
        force = -self.stiffness * apart
        if self.slack:
            force *= stretched(length - self.rest_length, self.slack) / (length or 1.0)
        elif self.rest_length:
            force *= 1.0 - self.rest_length / length
        if self.damping:
            rate = point_velocity(self.a.velocity(data), at_a)
            rate -= point_velocity(self.b.velocity(data), at_b)
            # Points that meet move along the line that joins them.
            along = apart * ((apart / length) @ rate / length) if length else rate
            force -= self.damping * along
        return force, at_a, apart / (length or 1.0)

    def coefficients(self, data: pin.Data) -> list[Coefficient]:
        _, at_a, line = self._force(data)
        directions = []
        for axis in [line] if self.law_count else np.eye(3):
            directions.append(np.zeros(len(self.support)))
            add_wrench(directions[-1], data, self.support, wrench_at(at_a, axis))
        return [
            Coefficient(kind, value, direction, angular=False)
            for kind, value in (("damping", self.damping), ("stiffness", self.stiffness))
            for direction in directions
            if value
        ]

    def energy(self, data: pin.Data, q: FloatArray) -> float:
        apart = self.a.placement(data).translation - self.b.placement(data).translation
        beyond = sqrt(apart @ apart) - self.rest_length
        return 0.5 * self.stiffness * stretched(beyond, self.slack) ** 2

    def constants(self) -> dict[str, Any]:
        own = {"numbers": np.array([self.slack])} if self.slack else {}
        return {
            "kind": "spring_damper",
            "a": self.a.constants(),
            "b": self.b.constants(),
            "support": self.support,
            "stiffness": self.stiffness,
            "damping": self.damping,
            "rest": self.rest_length,
        } | own


class WrenchEvaluator(Evaluator):
    """A :class:`~srm_mbs.model.forces.Wrench`, resolved against a model."""

    def __init__(self, model: pin.Model, force: Wrench) -> None:
        self.at = ResolvedAnchor(model, force.at)
        self.in_link_axes = force.frame == "link"
        self.wrench = ValuesOverTime([*force.force, *force.moment], force.law)

    def add(self, tau: FloatArray, data: pin.Data, q: FloatArray, v: FloatArray, t: float) -> None:
        add_wrench(tau, data, self.at.support, self.between(data, q, v, t).wrench)

    def between(self, data: pin.Data, q: FloatArray, v: FloatArray, t: float) -> LinkWrench:
        at = self.at.placement(data)
        numbers = self.wrench.at(t)
        force, moment = numbers[:3], numbers[3:]
        if self.in_link_axes:
            force, moment = at.rotation @ force, at.rotation @ moment
        return LinkWrench(self.at.joint, 0, wrench_at(at.translation, force, moment))

    def constants(self) -> dict[str, Any]:
        return {
            "kind": "wrench",
            "a": self.at.constants(),
            "support": self.at.support,
            "in_link_axes": self.in_link_axes,
        } | self.wrench.constants()


HALF_TURN_ROUNDING = 1e-12
"""Distance (rad) from half a turn that is rounding."""
LOCATED_HALF_TURN = 1e-9
"""Distance (rad) from half a turn of the ends of steps that lie there."""


class BushingEvaluator(LawEvaluator):
    """A :class:`~srm_mbs.model.forces.Bushing`, resolved against a model."""

    def __init__(self, model: pin.Model, force: Bushing) -> None:
        self.name = force.name
        self.a, self.b = ResolvedAnchor(model, force.a), ResolvedAnchor(model, force.b)
        self.support = self.a.support - self.b.support
        self.stiffness = np.array(force.stiffness, dtype=float)
        self.damping = np.array(force.damping, dtype=float)
        self._own = np.flatnonzero((self.stiffness > 0.0) | (self.damping > 0.0))
        self.law_count = len(self._own)

    @property
    def turns(self) -> bool:
        """Whether it has a moment."""
        return bool(self.stiffness[3:].any() or self.damping[3:].any())

    def rotation(self, data: pin.Data) -> FloatArray:
        """Rotation vector (3,) rad of a's axes relative to b's, up to half a turn."""
        relative = self.b.placement(data).actInv(self.a.placement(data))
        return pin.log3(relative.rotation)  # type: ignore[no-any-return]

    def rotation_rate(self, data: pin.Data, turn: FloatArray) -> float:
        """Rate (rad/s) of the angle of the rotation vector ``turn`` (3,)."""
        spin = self.a.velocity(data).angular - self.b.velocity(data).angular
        return float(turn @ (self.b.placement(data).rotation.T @ spin)) / sqrt(turn @ turn)

    def add(
        self,
        tau: FloatArray,
        data: pin.Data,
        q: FloatArray,
        v: FloatArray,
        t: float,
        step: BushingStep | None = None,
    ) -> None:
        """See :class:`Evaluator`; ``step``: to which the stage belongs."""
        self._act(tau, data, *self._forces(data, step))

    def between(self, data: pin.Data, q: FloatArray, v: FloatArray, t: float) -> LinkWrench:
        wrench = self._wrench(data, *self._forces(data, None))
        return LinkWrench(self.a.joint, self.b.joint, wrench)

    def laws(
        self,
        data: pin.Data,
        q: FloatArray,
        v: FloatArray,
        step: BushingStep | None = None,
    ) -> FloatArray:
        """The forces and moments that are not always zero, with the opposite sign."""
        force, moment, _ = self._forces(data, step)
        return np.concatenate([force, moment])[self._own]

    def apply(
        self,
        tau: FloatArray,
        data: pin.Data,
        values: FloatArray,
        step: BushingStep | None = None,
    ) -> None:
        both = np.zeros(6)
        both[self._own] = values
        self._act(tau, data, both[:3], both[3:], self._forces(data, step)[2])

    def coefficients(self, data: pin.Data) -> list[Coefficient]:
        found = []
        for i in self._own.tolist():
            direction = np.zeros(len(self.support))
            unit = np.eye(6)[i]
            self._act(direction, data, unit[:3], unit[3:], self._forces(data, None)[2])
            for kind, values in (("damping", self.damping), ("stiffness", self.stiffness)):
                if values[i]:
                    found.append(Coefficient(kind, float(values[i]), direction, angular=i > 2))
        return found

    def _act(
        self,
        tau: FloatArray,
        data: pin.Data,
        force: FloatArray,
        moment: FloatArray,
        L: FloatArray,
    ) -> None:
        add_wrench(tau, data, self.support, self._wrench(data, force, moment, L))

    def _wrench(
        self, data: pin.Data, force: FloatArray, moment: FloatArray, L: FloatArray
    ) -> FloatArray:
        """The wrench (6,) on a of what :meth:`_forces` gives."""
        Ta, Tb = self.a.placement(data), self.b.placement(data)
        force, moment = -(Tb.rotation @ force), -(Tb.rotation @ (L @ moment))
        return wrench_at(Ta.translation, force, moment)

    def _forces(
        self, data: pin.Data, step: BushingStep | None
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Force (3,) along b's axes, moment (3,) as it does work on the rotation vector, and the
        Jacobian (3, 3) of that vector."""
        Ta, Tb = self.a.placement(data), self.b.placement(data)
        relative = Tb.actInv(Ta)
        shortest = pin.log3(relative.rotation)
        turn = shortest if step is None else step.nearest(shortest)
        # dphi/dt is Jlog3 w for w in a's axes, and L^T w in b's: Jlog3 R^T = Jlog3^T.
        L = pin.Jlog3(relative.rotation) if turn is shortest else _log_jacobian(turn)
        force = self.stiffness[:3] * relative.translation
        moment = self.stiffness[3:] * turn
        if self.damping.any():
            # The motion relative to b's axes and origin.
            W = self.a.velocity(data) - self.b.velocity(data)
            rate = Tb.rotation.T @ point_velocity(W, Ta.translation)
            spin = L.T @ (Tb.rotation.T @ W.angular)
            force = force + self.damping[:3] * rate
            moment = moment + self.damping[3:] * spin
        return force, moment, L

    def energy(self, data: pin.Data, q: FloatArray) -> float:
        relative = self.b.placement(data).actInv(self.a.placement(data))
        moved = np.concatenate([relative.translation, pin.log3(relative.rotation)])
        return 0.5 * float(self.stiffness @ (moved * moved))

    def constants(self) -> dict[str, Any]:
        return {
            "kind": "bushing",
            "a": self.a.constants(),
            "b": self.b.constants(),
            "support": self.support,
            "numbers": np.concatenate([self.stiffness, self.damping]),
        }


def _other_way(turn: FloatArray) -> FloatArray:
    """The rotation vector (3,) of the same rotation about the opposite axis."""
    angle = sqrt(turn @ turn)
    return turn if angle == 0.0 else turn * (1.0 - 2.0 * pi / angle)


def _distance(a: FloatArray, b: FloatArray) -> float:
    apart = a - b
    return float(apart @ apart)


class BushingStep:
    """The rotation vector of a bushing over a step.

    Parameters
    ----------
    bushing
        The bushing.
    data
        Workspace with placements and velocities at the start of the step.
    t
        Start of the step (s).
    """

    def __init__(self, bushing: BushingEvaluator, data: pin.Data, t: float) -> None:
        self._bushing = bushing
        self._passed = False
        self._start = bushing.rotation(data)
        # At half a turn, the one that gets smaller; a step that ends there measured the same, but
        # for rounding.
        if self._past_half_turn(data, t, self._start, 2.0) == 0.0:
            self._start = _other_way(self._start)

    def nearest(self, turn: FloatArray) -> FloatArray:
        """Of the two rotation vectors (3,) that are less than a turn, ``turn`` and the opposite
        one, that closest to the start."""
        other = _other_way(turn)
        if not _distance(other, self._start) < _distance(turn, self._start):
            return turn
        self._passed |= float(other @ other) > (pi + LOCATED_HALF_TURN) ** 2
        return other

    def past_half_turn(self, data: pin.Data, t: float) -> float:
        """Time (s) since it passed half a turn outwards, in a step that ends at t (s): 0 up to
        rounding, negative before; infinite if it passed and returned."""
        passed = self._passed
        late = self._past_half_turn(data, t, self.nearest(self._bushing.rotation(data)))
        return inf if passed and late == -inf else late

    def _past_half_turn(
        self, data: pin.Data, t: float, turn: FloatArray, roundings: float = 1.0
    ) -> float:
        angle = sqrt(turn @ turn)
        if angle < 0.5 * pi:
            return -inf
        speed, beyond = self._bushing.rotation_rate(data, turn), angle - pi
        if speed > 0.0:
            rounding = HALF_TURN_ROUNDING + speed * 4.0 * float(np.spacing(abs(t)))
            return 0.0 if abs(beyond) <= roundings * rounding else beyond / speed
        return copysign(inf, beyond - HALF_TURN_ROUNDING)


def _log_jacobian(turn: FloatArray) -> FloatArray:
    """Jlog3 (3, 3) at a rotation vector (3,) of half a turn and more."""
    angle = sqrt(turn @ turn)
    ratio = 0.5 * np.sin(angle) / (1.0 - np.cos(angle))
    out: FloatArray = (1.0 / angle**2 - ratio / angle) * np.outer(turn, turn)
    out += angle * ratio * np.eye(3) + 0.5 * pin.skew(turn)
    return out


class JointTorqueEvaluator(Evaluator):
    """A :class:`~srm_mbs.model.forces.JointTorque`, resolved against a model."""

    def __init__(self, model: pin.Model, force: JointTorque) -> None:
        joint = model.joints[model.getJointId(force.joint)]
        self.own = slice(joint.idx_v, joint.idx_v + joint.nv)
        self.torque = ValuesOverTime(np.array(force.torque, dtype=float, ndmin=1), force.law)

    def add(self, tau: FloatArray, data: pin.Data, q: FloatArray, v: FloatArray, t: float) -> None:
        tau[self.own] += self.torque.at(t)

    def constants(self) -> dict[str, Any]:
        return {"kind": "joint_torque", "in_v": self.own.start} | self.torque.constants()


def _along_direction(
    element: CoordinateEvaluator | CouplingSpringEvaluator, direction: FloatArray, angular: bool
) -> list[Coefficient]:
    """The coefficients of an element that acts along one ``direction`` (nv,)."""
    return [
        Coefficient(kind, value, direction, angular)
        for kind, value in (("damping", element.damping), ("stiffness", element.stiffness))
        if value
    ]


class CoordinateEvaluator(Evaluator):
    """A spring and damper on one coordinate, whose force is the law of the coordinate."""

    kind: str

    def __init__(self, model: pin.Model, force: TorsionSpring | LimitSpring) -> None:
        joint = model.joints[model.getJointId(force.joint)]
        self.in_q, self.in_v = joint.idx_q, joint.idx_v
        self.stiffness, self.damping = force.stiffness, force.damping

    def coefficients(self, data: pin.Data) -> list[Coefficient]:
        direction = np.zeros(data.M.shape[0])
        direction[self.in_v] = 1.0
        angular = bool(np.abs(world_jacobian(data)[3:, self.in_v]).max() > 0.0)
        return _along_direction(self, direction, angular)

    def constants(self) -> dict[str, Any]:
        return {
            "kind": self.kind,
            "in_q": self.in_q,
            "in_v": self.in_v,
            "stiffness": self.stiffness,
            "damping": self.damping,
        }


class TorsionSpringEvaluator(CoordinateEvaluator):
    """A :class:`~srm_mbs.model.forces.TorsionSpring`, resolved against a model."""

    kind = "torsion_spring"

    def __init__(self, model: pin.Model, force: TorsionSpring) -> None:
        super().__init__(model, force)
        self.rest_angle = force.rest_angle

    def add(self, tau: FloatArray, data: pin.Data, q: FloatArray, v: FloatArray, t: float) -> None:
        turned = q[self.in_q] - self.rest_angle
        tau[self.in_v] -= self.stiffness * turned + self.damping * v[self.in_v]

    def energy(self, data: pin.Data, q: FloatArray) -> float:
        return 0.5 * self.stiffness * float(q[self.in_q] - self.rest_angle) ** 2

    def constants(self) -> dict[str, Any]:
        return super().constants() | {"rest": self.rest_angle}


class CouplingSpringEvaluator(LawEvaluator):
    """A :class:`~srm_mbs.model.forces.CouplingSpring`, resolved against a model."""

    law_count = 1

    def __init__(self, model: pin.Model, force: CouplingSpring, friction_speed: float) -> None:
        joints = [model.joints[model.getJointId(name)] for name in force.joints]
        # In the order of the velocities, as the kernel has them.
        order = np.argsort([joint.idx_v for joint in joints])
        self.in_q = np.array([joints[k].idx_q for k in order])
        self.in_v = np.array([joints[k].idx_v for k in order])
        self.factors = np.array(force.coefficients)[order]
        self.size = model.nv
        self.stiffness, self.damping, self.rest = force.stiffness, force.damping, force.rest
        self.slack, self.friction, self.speed = force.slack, force.friction, friction_speed

    def add(self, tau: FloatArray, data: pin.Data, q: FloatArray, v: FloatArray, t: float) -> None:
        self.apply(tau, data, self.laws(data, q, v))

    def laws(
        self,
        data: pin.Data,
        q: FloatArray,
        v: FloatArray,
        step: BushingStep | None = None,
    ) -> FloatArray:
        """The force on the sum."""
        rate = self.factors @ v[self.in_v]
        force = self.stiffness * self._stretch(q) + self.damping * rate
        if self.friction:
            force += self.friction * tanh(rate / self.speed)
        return np.array([-force])

    def apply(
        self,
        tau: FloatArray,
        data: pin.Data,
        values: FloatArray,
        step: BushingStep | None = None,
    ) -> None:
        tau[self.in_v] += values[0] * self.factors

    def _stretch(self, q: FloatArray) -> float:
        return stretched(float(self.factors @ q[self.in_q]) - self.rest, self.slack)

    def energy(self, data: pin.Data, q: FloatArray) -> float:
        return 0.5 * self.stiffness * self._stretch(q) ** 2

    def along(self) -> FloatArray:
        """The derivatives (nv,) of the sum by the coordinates."""
        along = np.zeros(self.size)
        along[self.in_v] = self.factors
        return along

    def coefficients(self, data: pin.Data) -> list[Coefficient]:
        angular = bool(np.abs(world_jacobian(data)[3:, self.in_v]).max() > 0.0)
        found = _along_direction(self, self.along(), angular)
        if self.friction:
            at_rest = self.friction / self.speed
            found.append(Coefficient("friction", at_rest, self.along(), angular))
        return found

    def constants(self) -> dict[str, Any]:
        acts = self.slack or self.friction
        own = {"numbers": np.array([self.slack, self.friction, self.speed])} if acts else {}
        return {
            "kind": "coupling_spring",
            "support": self.along(),
            "positions": self.in_q.tolist(),
            "stiffness": self.stiffness,
            "damping": self.damping,
            "rest": self.rest,
        } | own


class LimitSpringEvaluator(CoordinateEvaluator):
    """A :class:`~srm_mbs.model.forces.LimitSpring`, resolved against a model."""

    kind = "limit_spring"

    def __init__(self, model: pin.Model, force: LimitSpring) -> None:
        super().__init__(model, force)
        self.lower, self.upper, self.depth = force.resolved(model)

    def _beyond(self, q: FloatArray) -> float:
        position = float(q[self.in_q])
        return max(position - self.upper, 0.0) + min(position - self.lower, 0.0)

    def add(self, tau: FloatArray, data: pin.Data, q: FloatArray, v: FloatArray, t: float) -> None:
        beyond = self._beyond(q)
        if beyond == 0.0:
            return
        x = min(abs(beyond) / self.depth, 1.0)
        contact = x * x * x * (10.0 + x * (6.0 * x - 15.0))
        tau[self.in_v] -= contact * (self.stiffness * beyond + self.damping * v[self.in_v])

    def energy(self, data: pin.Data, q: FloatArray) -> float:
        """The integral of k d S(d / depth)."""
        beyond, depth = abs(self._beyond(q)), self.depth
        x = min(beyond / depth, 1.0)
        inside = depth**2 * x**5 * (2.0 + x * (6.0 / 7.0 * x - 2.5))
        return self.stiffness * (inside + 0.5 * max(beyond**2 - depth**2, 0.0))

    def constants(self) -> dict[str, Any]:
        return super().constants() | {"numbers": np.array([self.lower, self.upper, self.depth])}


class _UserForceEvaluator(Evaluator):
    """A :class:`~srm_mbs.model.forces.UserForce`, resolved against a model."""

    def __init__(self, model: pin.Model, force: UserForce) -> None:
        self.name, self.function = f"the force {force.name!r}", force.function
        self.at = None if force.at is None else ResolvedAnchor(model, force.at)
        self.size = model.nv if force.at is None else 6

    def add(self, tau: FloatArray, data: pin.Data, q: FloatArray, v: FloatArray, t: float) -> None:
        given = self._given(q, v, t)
        if self.at is None:
            tau += given
        else:
            add_wrench(tau, data, self.at.support, self._wrench(self.at, data, given))

    def between(self, data: pin.Data, q: FloatArray, v: FloatArray, t: float) -> LinkWrench | None:
        if self.at is None:
            return None
        return LinkWrench(self.at.joint, 0, self._wrench(self.at, data, self._given(q, v, t)))

    def _given(self, q: FloatArray, v: FloatArray, t: float) -> FloatArray:
        return evaluate_callback(self.name, self.function, self.size, "numbers", t, q, v)

    @staticmethod
    def _wrench(at: ResolvedAnchor, data: pin.Data, given: FloatArray) -> FloatArray:
        return wrench_at(at.placement(data).translation, given[:3], given[3:])

    def constants(self) -> None:
        return None


_EVALUATORS = {
    SpringDamper: SpringDamperEvaluator,
    JointTorque: JointTorqueEvaluator,
    TorsionSpring: TorsionSpringEvaluator,
    Wrench: WrenchEvaluator,
    Bushing: BushingEvaluator,
    LimitSpring: LimitSpringEvaluator,
    UserForce: _UserForceEvaluator,
}


_LAWFUL = LawEvaluator | CoordinateEvaluator


@per_model
def resolved_forces(mechanism: MechanismData) -> ForceKinematics | None:
    """The force elements of ``mechanism``, resolved once; None if it has none."""
    if not mechanism.forces:
        return None
    return ForceKinematics(mechanism.model, mechanism.forces, mechanism.friction_speed)


def friction_sums(model: pin.Model, forces: ForceKinematics | None) -> FloatArray:
    """The rates on which dry friction acts, as sums of velocity components: coefficients (n, nv) of
    the coordinates with joint friction, and of those with friction of ``forces``."""
    sums = np.eye(model.nv)[model.friction > 0.0]
    return sums if forces is None else np.vstack([sums, forces.sums_with_friction()])


def over_half_turn(mechanism: MechanismData, q: FloatArray) -> tuple[str, ...]:
    """See :meth:`ForceKinematics.over_half_turn`."""
    forces = resolved_forces(mechanism)
    if forces is None or not forces.bushings:
        return ()
    return forces.over_half_turn(workspace(mechanism.model), q)


class ForceKinematics:
    """All force elements of a mechanism: ``forces`` on the tree ``model``, with the speed over
    which dry friction changes its sign."""

    def __init__(
        self,
        model: pin.Model,
        forces: Sequence[ForceElement],
        friction_speed: float = FRICTION_SPEED,
    ) -> None:
        self._model, self._nv = model, model.nv
        self._elements: list[Evaluator] = [
            CouplingSpringEvaluator(model, force, friction_speed)
            if isinstance(force, CouplingSpring)
            else _EVALUATORS[type(force)](model, force)
            for force in forces
        ]

        self.bushings = [e for e in self._elements if isinstance(e, BushingEvaluator) and e.turns]
        """The bushings that have a moment."""

    def over_half_turn(self, data: pin.Data, q: FloatArray) -> tuple[str, ...]:
        """Names of the bushings that turn by more than half a turn along the configurations q
        (n, nq) at the ends of steps, of which one lies there: the rotation vector is the opposite
        before or after it."""
        pin.forwardKinematics(self._model, data, q[0])
        before = {
            bushing: turn
            for bushing, turn in ((e, e.rotation(data)) for e in self.bushings)
            if float(np.linalg.norm(turn)) + self._largest_motion(bushing, q) >= np.pi
        }
        found: dict[str, None] = {}
        for row in q if before else ():
            pin.forwardKinematics(self._model, data, row)
            for bushing, last in before.items():
                turn = bushing.rotation(data)
                largest = sqrt(max(turn @ turn, last @ last))
                if largest > np.pi - LOCATED_HALF_TURN and float(turn @ last) < 0.0:
                    found[bushing.name] = None
                before[bushing] = turn
        return tuple(found)

    def _largest_motion(self, bushing: BushingEvaluator, q: FloatArray) -> float:
        """Sum of the ranges (rad) of the joints between its links; infinite with others than
        those of one bounded coordinate."""
        total = 0.0
        for joint in list(self._model.joints)[1:]:
            if bushing.support[joint.idx_v : joint.idx_v + joint.nv].any():
                if (joint.nq, joint.nv) != (1, 1):
                    return np.inf
                total += float(np.ptp(q[:, joint.idx_q]))
        return total

    def begin_step(
        self, data: pin.Data, q: FloatArray, v: FloatArray, t: float
    ) -> dict[Evaluator, BushingStep]:
        """The bushings in a step from q, v and t; ``data`` is a workspace."""
        pin.forwardKinematics(self._model, data, q, v)
        return {bushing: BushingStep(bushing, data, t) for bushing in self.bushings}

    def past_half_turn(
        self,
        data: pin.Data,
        q: FloatArray,
        v: FloatArray,
        t: float,
        step: Mapping[Evaluator, BushingStep],
    ) -> float:
        """Time (s) since the first of the bushings passed half a turn in a ``step`` that ends at q,
        v and t (:meth:`BushingStep.past_half_turn`)."""
        pin.forwardKinematics(self._model, data, q, v)
        return max(bushing.past_half_turn(data, t) for bushing in step.values())

    def generalised(
        self,
        data: pin.Data,
        q: FloatArray,
        v: FloatArray,
        t: float,
        step: Mapping[Evaluator, BushingStep] = MappingProxyType({}),
    ) -> FloatArray:
        """tau (nv,) in N and N m at q (nq,), v (nv,) and t (s).

        ``step``: the bushings in the step to which the stage belongs.

        ``data`` must hold placements, velocities and the world Jacobian at that state: of crba in
        the WORLD convention and nonLinearEffects, or of forwardKinematics and
        computeJointJacobians.

        Raises
        ------
        EvaluationError
            If the points of a spring with a rest length coincide.
        ControllerError
            If a function of the user raises, or returns anything but finite numbers.
        """
        tau = np.zeros(self._nv)
        for element in self._elements:
            if isinstance(element, BushingEvaluator):
                element.add(tau, data, q, v, t, step.get(element))
            else:
                element.add(tau, data, q, v, t)
        return tau

    def between_links(
        self, data: pin.Data, q: FloatArray, v: FloatArray, t: float
    ) -> list[LinkWrench]:
        """Wrenches of the elements that act between links; ``data`` must hold placements and
        velocities.

        Raises
        ------
        EvaluationError, ControllerError
            As for :meth:`generalised`.
        """
        found = (element.between(data, q, v, t) for element in self._elements)
        return [wrench for wrench in found if wrench is not None]

    def coefficients(self, data: pin.Data) -> list[list[Coefficient]]:
        """Those of each element; ``data`` as for :meth:`generalised`."""
        return [element.coefficients(data) for element in self._elements]

    def energy(self, data: pin.Data, q: FloatArray) -> float:
        """Potential energy (J) of springs and bushings; ``data`` must hold the placements."""
        return sum(element.energy(data, q) for element in self._elements)

    @cached_property
    def has_user_forces(self) -> bool:
        """Whether there are functions of the user among the elements."""
        return any(isinstance(element, _UserForceEvaluator) for element in self._elements)

    def user_forces(self, data: pin.Data, q: FloatArray, v: FloatArray, t: float) -> FloatArray:
        """tau (nv,) of the functions of the user alone; ``data`` is a workspace."""
        pin.forwardKinematics(self._model, data, q, v)
        pin.computeJointJacobians(self._model, data, q)
        tau = np.zeros(self._nv)
        for element in self._elements:
            if isinstance(element, _UserForceEvaluator):
                element.add(tau, data, q, v, t)
        return tau

    def sums_with_friction(self) -> FloatArray:
        """The sums of rates on which dry friction acts: coefficients (n, nv)."""
        rubs = (e for e in self._elements if isinstance(e, CouplingSpringEvaluator) and e.friction)
        return np.array([e.along() for e in rubs]).reshape(-1, self._nv)

    def coordinates(self) -> list[int]:
        """Velocity indices of the coordinates on which springs and limits act."""
        return [e.in_v for e in self._elements if isinstance(e, CoordinateEvaluator)]

    def laws(
        self,
        data: pin.Data,
        q: FloatArray,
        v: FloatArray,
        step: Mapping[Evaluator, BushingStep] = MappingProxyType({}),
    ) -> tuple[FloatArray, list[FloatArray]]:
        """Laws of the coordinates (nv,), and those of each element between links; ``step`` as for
        :meth:`generalised`."""
        along = np.zeros(self._nv)
        for element in self._elements:
            if isinstance(element, CoordinateEvaluator):
                element.add(along, data, q, v, 0.0)
        between = [e for e in self._elements if isinstance(e, LawEvaluator)]
        return along, [e.laws(data, q, v, step.get(e)) for e in between]

    def of_laws(
        self,
        data: pin.Data,
        q: FloatArray,
        v: FloatArray,
        step: Mapping[Evaluator, BushingStep] = MappingProxyType({}),
    ) -> FloatArray:
        """Generalised forces (nv,) of all elements with laws; ``step`` as for
        :meth:`generalised`."""
        tau = self.laws(data, q, v, step)[0]
        for element in self._elements:
            if isinstance(element, LawEvaluator):
                own = step.get(element)
                element.apply(tau, data, element.laws(data, q, v, own), own)
        return tau

    def without_laws(self, data: pin.Data, q: FloatArray, v: FloatArray, t: float) -> FloatArray:
        """Generalised forces (nv,) of all other elements."""
        tau = np.zeros(self._nv)
        for element in self._elements:
            if not isinstance(element, _LAWFUL):
                element.add(tau, data, q, v, t)
        return tau

    @property
    def has_laws(self) -> bool:
        """Whether elements have laws."""
        return any(isinstance(element, _LAWFUL) for element in self._elements)

    @property
    def law_count(self) -> int:
        """Number of the laws of elements between links."""
        return sum(e.law_count for e in self._elements if isinstance(e, LawEvaluator))

    def generalised_with(
        self,
        data: pin.Data,
        q: FloatArray,
        v: FloatArray,
        t: float,
        applied: FloatArray,
        step: Mapping[Evaluator, BushingStep],
    ) -> FloatArray:
        """As :meth:`generalised`, where ``applied`` act in place of the laws between links, and
        no springs on coordinates."""
        tau = np.zeros(self._nv)
        first = 0
        for element in self._elements:
            if isinstance(element, CoordinateEvaluator):
                continue
            if isinstance(element, LawEvaluator):
                values = applied[first : first + element.law_count]
                element.apply(tau, data, values, step.get(element))
                first += element.law_count
            else:
                element.add(tau, data, q, v, t)
        return tau

    def constants(self) -> list[dict[str, Any]]:
        """Constants of each element for the compiled kernel, without the functions of the user."""
        return [own for element in self._elements if (own := element.constants()) is not None]
