r"""What the peers simulate: a Pinocchio tree, point closures, constant torques and springs.

The peers get the equations here, from Pinocchio's kinematics and dense algebra, and nothing from
the package that is measured:

    M v' = tau - nle - G^T lam,   g = p_a - p_b,   G = J_a - J_b,

and Gdot v from classical accelerations at v' = 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pinocchio as pin

from srm_mbs.dynamics.mechanism import Mechanism

Array = Any
AXES = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED


@dataclass(frozen=True)
class PointClosure:
    """Point ``in_a`` of joint ``a`` and point ``in_b`` of joint ``b`` (0: ground) coincide.

    ``rows``: the world axes whose rows are independent; the others hold by themselves in the plane.
    """

    a: int
    in_a: tuple[float, float, float]
    b: int
    in_b: tuple[float, float, float]
    rows: tuple[int, ...] = (0, 1, 2)


@dataclass(frozen=True)
class Spring:
    """Linear spring (N/m, rest length m) from point ``at`` of ``joint`` to ``ground`` (m).

    The joint is a hinge on the ground.
    """

    joint: int
    at: tuple[float, float, float]
    ground: tuple[float, float, float]
    stiffness: float
    rest: float


@dataclass(frozen=True)
class TorsionSpring:
    """Spring on the coordinate of a hinge: N m/rad, and the angle (rad) where it is relaxed."""

    joint: int
    stiffness: float
    rest: float


@dataclass(frozen=True, eq=False)
class Tree:
    """A mechanism as the peers get it; ``torque`` (nv,) acts on the joints, constant."""

    model: pin.Model
    closures: tuple[PointClosure, ...]
    q0: Array
    v0: Array
    torque: Array = None
    springs: tuple[Spring, ...] = ()
    torsion: tuple[TorsionSpring, ...] = ()

    @property
    def flat(self) -> bool:
        """Whether q' = v; otherwise the first joint, and no other, is a free flyer."""
        return bool(self.model.nq == self.model.nv)


def tree_of(mechanism: Mechanism, rows: tuple[int, ...] = (0, 1, 2)) -> Tree:
    """The tree of a mechanism whose loops are all point closures.

    Raises
    ------
    ValueError
        For another closure, or a joint that is neither of one degree nor a free-flying root.
    """
    model = mechanism.model
    for index, joint in enumerate(model.joints):
        if index and joint.nq != 1 and not (index == 1 and joint.nq == 7):
            raise ValueError(f"the joint {model.names[index]} has {joint.nq} coordinates")
    closures = []
    for loop in mechanism.loops:
        if loop.type != "point":
            raise ValueError(f"the loop {loop.name} is a {loop.type} closure")
        (a, in_a), (b, in_b) = loop.a.resolve(model), loop.b.resolve(model)
        closures.append(PointClosure(a, tuple(in_a.translation), b, tuple(in_b.translation), rows))
    return Tree(model, tuple(closures), mechanism.q0.copy(), mechanism.v0.copy())


class _HingedSpring:
    """A spring on a body that is hinged on the ground: its torque in plain numbers.

    The point moves on p = a + b cos q + c sin q.
    """

    def __init__(self, model: pin.Model, spring: Spring) -> None:
        joint = model.joints[spring.joint]
        if model.parents[spring.joint] != 0 or joint.nq != 1:
            raise ValueError("a spring is on a body that is not hinged on the ground")
        self.index, self._coordinate = joint.idx_v, joint.idx_q
        self._spring = spring
        data = model.createData()
        points = []
        for angle in (0.0, 0.5 * np.pi, np.pi):
            q = pin.neutral(model)
            q[joint.idx_q] = angle
            pin.forwardKinematics(model, data, q)
            points.append(data.oMi[spring.joint].act(np.array(spring.at)))
        start, quarter, half = points
        centre = 0.5 * (start + half)
        ground = np.array(spring.ground)
        self._arms = list(
            zip(*(x.tolist() for x in (centre - ground, start - centre, quarter - centre)))
        )

    def torque(self, q: Array) -> float:
        """Torque (N m) on the hinge."""
        angle = float(q[self._coordinate])
        cosine, sine = math.cos(angle), math.sin(angle)
        square = moment = 0.0
        for a, b, c in self._arms:
            along = a + b * cosine + c * sine
            square += along * along
            moment += along * (c * cosine - b * sine)
        length = math.sqrt(square)
        spring = self._spring
        return -spring.stiffness * (length - spring.rest) / length * moment


@dataclass
class Equations:
    """Evaluates a tree; mutable, one per run."""

    tree: Tree
    model: pin.Model = field(init=False)

    def __post_init__(self) -> None:
        tree = self.tree
        self.model = model = tree.model.copy()
        self._pairs = []
        for k, closure in enumerate(tree.closures):
            frames = [
                model.addFrame(
                    pin.Frame(
                        f"anchor_{side}_{k}",
                        joint,
                        pin.SE3(np.eye(3), np.array(point)),
                        pin.FrameType.OP_FRAME,
                    )
                )
                for side, joint, point in (
                    ("a", closure.a, closure.in_a),
                    ("b", closure.b, closure.in_b),
                )
            ]
            self._pairs.append((*frames, list(closure.rows)))
        self.data = model.createData()
        self.m = sum(len(closure.rows) for closure in tree.closures)
        self._springs = [_HingedSpring(model, spring) for spring in tree.springs]
        self._zero = np.zeros(model.nv)
        self._damping = model.damping.copy() if np.any(model.damping) else None
        self.constant = self._zero if tree.torque is None else tree.torque
        joints = [model.joints[spring.joint] for spring in tree.torsion]
        self._twisted = np.array([joint.idx_q for joint in joints], dtype=int)
        self._turning = np.array([joint.idx_v for joint in joints], dtype=int)
        self._stiffness = np.array([spring.stiffness for spring in tree.torsion])
        self._relaxed = np.array([spring.rest for spring in tree.torsion])
        self.passive = (
            tree.torque is None and not tree.springs and not tree.torsion and self._damping is None
        )

    def applied(self, q: Array, v: Array) -> Array:
        """Joint torques of motors, springs and damping (nv,)."""
        if self.passive:
            return self._zero
        tau = self.constant if self._damping is None else self.constant - self._damping * v
        if self._springs or self.tree.torsion:
            tau = tau.copy()
            for spring in self._springs:
                tau[spring.index] += spring.torque(q)
            tau[self._turning] -= self._stiffness * (q[self._twisted] - self._relaxed)
        return tau

    def position_rate(self, q: Array, v: Array) -> Array:
        """q' (nq,)."""
        if self.tree.flat:
            return v
        x, y, z, w = q[3:7]
        wx, wy, wz = v[3:6]
        out = np.empty(q.size)
        rotation = pin.Quaternion(q[3:7]).matrix()
        out[:3] = rotation @ v[:3]
        out[3] = 0.5 * (w * wx + y * wz - z * wy)
        out[4] = 0.5 * (w * wy + z * wx - x * wz)
        out[5] = 0.5 * (w * wz + x * wy - y * wx)
        out[6] = -0.5 * (x * wx + y * wy + z * wz)
        out[7:] = v[6:]
        return out

    def normalised(self, q: Array) -> Array:
        """q with a unit quaternion."""
        if self.tree.flat:
            return q
        q = q.copy()
        q[3:7] /= np.linalg.norm(q[3:7])
        return q

    def moved(self, q: Array, dq: Array) -> Array:
        """q (+) dq, dq (nv,) in the tangent space."""
        return q + dq if self.tree.flat else pin.integrate(self.model, q, dq)

    def gaps(self, q: Array) -> tuple[Array, Array]:
        """g (m,) in m and G (m, nv)."""
        model, data = self.model, self.data
        pin.computeJointJacobians(model, data, q)
        g, G = np.empty(self.m), np.empty((self.m, model.nv))
        at = 0
        for a, b, rows in self._pairs:
            own = slice(at, at + len(rows))
            at = own.stop
            pa = pin.updateFramePlacement(model, data, a).translation
            pb = pin.updateFramePlacement(model, data, b).translation
            g[own] = (pa - pb)[rows]
            Ja = pin.getFrameJacobian(model, data, a, AXES)
            G[own] = (Ja - pin.getFrameJacobian(model, data, b, AXES))[rows]
        return g, G

    def bias(self, q: Array, v: Array) -> Array:
        """Gdot v (m,)."""
        model, data = self.model, self.data
        pin.forwardKinematics(model, data, q, v, self._zero)
        out = np.empty(self.m)
        at = 0
        for a, b, rows in self._pairs:
            own = slice(at, at + len(rows))
            at = own.stop
            difference = (
                pin.getFrameClassicalAcceleration(model, data, a, AXES).linear
                - pin.getFrameClassicalAcceleration(model, data, b, AXES).linear
            )
            out[own] = difference[rows]
        return out

    def mass_and_force(self, q: Array, v: Array) -> tuple[Array, Array]:
        """M (nv, nv), symmetric, and tau - nle (nv,)."""
        model, data = self.model, self.data
        tau = self.applied(q, v)
        M = pin.crba(model, data, q, pin.Convention.WORLD)
        return M, tau - pin.nonLinearEffects(model, data, q, v)

    def acceleration(self, q: Array, v: Array) -> tuple[Array, Array]:
        """v' (nv,) and lam (m,) of the index-1 equations, by one dense KKT solve."""
        M, f = self.mass_and_force(q, v)
        if not self.m:
            return np.linalg.solve(M, f), np.zeros(0)
        _, G = self.gaps(q)
        nv, m = f.size, self.m
        kkt = np.zeros((nv + m, nv + m))
        kkt[:nv, :nv] = M
        kkt[:nv, nv:] = G.T
        kkt[nv:, :nv] = G
        solution = np.linalg.solve(kkt, np.concatenate([f, -self.bias(q, v)]))
        return solution[:nv], solution[nv:]

    def _weighted(self, q: Array, M: Array) -> tuple[Array, Array, Array]:
        g, G = self.gaps(q)
        X = np.linalg.solve(M, G.T)
        return g, G, np.linalg.solve(G @ X, X.T).T

    def projected(
        self, q: Array, v: Array, iterations: int = 3, enough: float = 1e-15
    ) -> tuple[Array, Array]:
        """(q, v) moved onto closures and their rates, along the least M-norm."""
        if not self.m:
            return q, v
        M = pin.crba(self.model, self.data, q, pin.Convention.WORLD).copy()
        for _ in range(iterations):
            g, G, E = self._weighted(q, M)
            if np.abs(g).max() <= enough:
                break
            q = self.moved(q, -(E @ g))
        g, G, E = self._weighted(q, M)
        return q, v - E @ (G @ v)

    def largest_gap(self, q: Array) -> float:
        """Largest |g| (m) over the states q (n, nq)."""
        if not self.m:
            return 0.0
        return max(float(np.linalg.norm(self.gaps(self.normalised(x))[0])) for x in q)

    def energy(self, q: Array, v: Array) -> Array:
        """Kinetic and potential energy (n,) J of the states q (n, nq), v (n, nv).

        Springs count, and minus the work of constant torques.
        """
        out = np.empty(len(q))
        for i, (x, w) in enumerate(zip(q, v)):
            x = self.normalised(np.ascontiguousarray(x))
            w = np.ascontiguousarray(w)
            out[i] = pin.computeMechanicalEnergy(self.model, self.data, x, w)
            for spring in self.tree.springs:
                point = self.data.oMi[spring.joint].act(np.array(spring.at))
                stretch = np.linalg.norm(point - np.array(spring.ground)) - spring.rest
                out[i] += 0.5 * spring.stiffness * stretch**2
            out[i] += 0.5 * self._stiffness @ (x[self._twisted] - self._relaxed) ** 2
            if self.tree.torque is not None:
                out[i] -= self.tree.torque @ x  # one-degree joints only
        return out
