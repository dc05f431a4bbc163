"""References that share nothing with the package's stepping: reduced models, SciPy on index 1."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pinocchio as pin
from scipy.integrate import solve_ivp

import srm_mbs as srm
from srm_mbs.dynamics.constraints.rows import LoopKinematics
from srm_mbs.dynamics.mechanism import Mechanism
from tests.support.dynamics import mass_matrix

G = 9.81
Field = Callable[[float, Any], Any]


def cross(a: Any, b: Any) -> np.ndarray:
    """np.cross, which takes six times as long for two vectors."""
    out: np.ndarray = pin.skew(a) @ b
    return out


def integrate(field: Field, start: list[float], t_end: float) -> np.ndarray:
    """State at ``t_end`` by DOP853 at 1e-13."""
    return trajectory(field, start, np.array([t_end]))[0]


def error_at_end(
    solution: srm.Solution, field: Field, start: list[float], joint: str | None = None
) -> float:
    """Largest error of angle and rate of a joint, by default the first, at the end of a run.

    ``start``: its angle and rate, in the coordinates of ``field``, at the time 0.
    """
    assert solution.success, solution.message
    expected = integrate(field, start, float(solution.t[-1]))
    position, rate = solution.joint(joint or solution.mechanism.joint_names[0])
    return float(np.abs([position[-1], rate[-1]] - expected).max())


def trajectory(field: Field, start: list[float], times: np.ndarray) -> np.ndarray:
    """States (k, n) at ``times`` (k,), increasing, by DOP853 at 1e-13."""
    run = solve_ivp(
        field, (0.0, times[-1]), start, method="DOP853", t_eval=times, rtol=1e-13, atol=1e-13
    )
    assert run.success
    return run.y.T


def slider_crank(slider_mass: float = 0.0) -> Field:
    """Equal bars of 2 m and 1 kg (thesis 1.4.1): (theta, omega) of the crank.

    (4/3 + 4 (1 + 2 m_s) sin^2) theta'' = -4 (1 + 2 m_s) sin cos theta'^2 - g cos theta.
    """
    k = 4.0 * (1.0 + 2.0 * slider_mass)

    def field(t: float, y: Any) -> list[float]:
        s, c = np.sin(y[0]), np.cos(y[0])
        return [y[1], (-k * s * c * y[1] ** 2 - G * c) / (4.0 / 3.0 + k * s * s)]

    return field


def regular_slider_crank(torque: Callable[[float], float] = lambda rate: 0.0) -> Field:
    """Crank 1 m 1 kg, rod 3 m 3 kg, uniform, massless slider on the x axis: Lagrange by hand.

    With the rod's angle beta, sin beta = -sin theta / 3, the kinetic energy is I(theta) w^2 / 2.
    ``torque``: on the crank (N m) at its rate w (rad/s).
    """

    def inertia(theta: float) -> tuple[float, float]:
        s, c = np.sin(theta), np.cos(theta)
        cb = np.sqrt(1.0 - s * s / 9.0)
        db = -c / (3.0 * cb)  # d beta / d theta
        ddb = s / (3.0 * cb) - c * c * s / (27.0 * cb**3)
        sb = -s / 3.0
        # rod centre (cos theta + 1.5 cos beta, sin theta + 1.5 sin beta) and its derivatives
        x1, z1 = -s - 1.5 * sb * db, c + 1.5 * cb * db
        x2 = -c - 1.5 * (cb * db**2 + sb * ddb)
        z2 = -s + 1.5 * (-sb * db**2 + cb * ddb)
        rod = 3.0 * 9.0 / 12.0
        value = 1.0 / 3.0 + 3.0 * (x1**2 + z1**2) + rod * db**2
        slope = 6.0 * (x1 * x2 + z1 * z2) + 2.0 * rod * db * ddb
        return value, slope

    def field(t: float, y: Any) -> list[float]:
        theta, w = y
        value, slope = inertia(theta)
        c = np.cos(theta)
        # potential: crank centre sin/2, rod centre sin/2 (the slider stays at z = 0)
        force = torque(w) - G * (0.5 * c + 3.0 * 0.5 * c)
        return [w, (force - 0.5 * slope * w * w) / value]

    return field


def n_four_bar(n: int) -> Field:
    """Common crank angle of the IFToMM N-four-bar."""
    inertia, weight = (n + 1) / 3.0 + n, (n + 1) / 2.0 + n
    return lambda t, y: [y[1], -G * weight / inertia * np.cos(y[0])]


def parallelogram() -> Field:
    """Crank angle of the bundled parallelogram: (8/9) theta'' = -g cos theta."""
    return lambda t, y: [y[1], -9.0 / 8.0 * G * np.cos(y[0])]


def spatial_dead_point() -> Field:
    """(angle of the crank from the guide line, its rate) of the bundled spatial_dead_point.

    With a that angle, crank 2 m and guide 1.5 m to the side, the slider is at 4 cos(a) on the
    line, the rod's vector (2 cos a, -2 sin a, 1.5) and its centre at (3 cos a, sin a).  Twice the
    kinetic energy is a'^2 times 4/3 (crank) + 9 sin^2 a + cos^2 a + 1/3 (rod) = 8/3 + 8 sin^2 a,
    whatever the axial inertia: the rod's spin is constant, and its gyroscopic torque does no work.
    """
    rise = np.pi / 6.0

    def field(t: float, y: Any) -> list[float]:
        s, c = np.sin(y[0]), np.cos(y[0])
        weight = G * (np.cos(rise) * c - 2.0 * np.sin(rise) * s)
        return [y[1], (-4.0 * s * c * y[1] ** 2 - weight) / (4.0 / 3.0 + 4.0 * s * s)]

    return field


def index_one(mechanism: Mechanism, steady: tuple[str, ...] = ()) -> Field:
    """q' = v, M v' + G^T lam = f, G v' = -Gdot v: the unstabilised index-1 equations, flat q.

    Pinocchio's terms, a dense KKT solve; redundant rows left out.  What a user would integrate
    with SciPy.  The joints ``steady`` turn at constant speed.
    """
    model = mechanism.model
    assert model.nq == model.nv
    data = model.createData()
    structure = mechanism.structure
    rows = LoopKinematics(model, mechanism.loops, structure.row_scale, structure.kept)
    nv = model.nv
    held = np.eye(nv)[[model.joints[model.getJointId(joint)].idx_v for joint in steady]]
    m = len(rows.g) + len(held)

    def field(t: float, x: Any) -> np.ndarray:
        q, v = x[:nv], x[nv:]
        pin.crba(model, data, q, pin.Convention.WORLD)
        pin.nonLinearEffects(model, data, q, v)
        rows.update(data, q, v)
        G = np.concatenate([rows.G, held])
        kkt = np.block([[data.M, G.T], [G, np.zeros((m, m))]])
        right = np.concatenate([-data.nle - model.damping * v, -rows.bias, np.zeros(len(held))])
        return np.concatenate([v, np.linalg.solve(kkt, right)[:nv]])

    return field


class OneDegree:
    """Equation of motion of a closed mechanism with one degree of freedom, in one joint's angle s.

    The other joints follow s by Newton on frame placements, their rates by least squares on frame
    Jacobians, q'' from classical accelerations; then, with q' = dq/ds,

        q'^T M q' s'' = q'^T (tau - M q'' s'^2 - nle(q, q' s')).

    ``force`` (nv,) is tau, by default 0.  Nothing of the package's closures, algebra or stepping is
    used; point and revolute closures.
    """

    def __init__(self, mechanism: Mechanism, joint: str) -> None:
        assert not mechanism.forces
        self.model = mechanism.model
        self.data = self.model.createData()
        self.joint = self.model.joints[self.model.getJointId(joint)].idx_q
        self.loops = mechanism.loops
        self.q = np.array(mechanism.q0)
        self.others = [i for i in range(self.model.nv) if i != self.joint]
        self.force = np.zeros(self.model.nv)

    def _rows(self, q: Any, v: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """g, G and Gdot v, in the world."""
        model, data = self.model, self.data
        pin.forwardKinematics(model, data, q, v, np.zeros(model.nv))
        pin.computeJointJacobians(model, data, q)
        local = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        parts = []
        for loop in self.loops:
            ends = []
            for anchor in (loop.a, loop.b):
                joint, place = anchor.resolve(model)
                if joint == 0:
                    zero = np.zeros(3), np.zeros((6, model.nv)), np.zeros((2, 3))
                    ends.append((place.translation, place.rotation, *zero))
                    continue
                world = data.oMi[joint] * place
                arm = world.translation - data.oMi[joint].translation
                J = pin.getJointJacobian(model, data, joint, local).copy()
                J[:3] -= pin.skew(arm) @ J[3:]
                w = data.oMi[joint].rotation @ data.v[joint].angular
                bias = pin.getClassicalAcceleration(model, data, joint, local)
                linear = bias.linear + cross(bias.angular, arm) + cross(w, cross(w, arm))
                accelerations = np.array([linear, bias.angular])
                ends.append((world.translation, world.rotation, w, J, accelerations))
            (pa, Ra, wa, Ja, aa), (pb, Rb, wb, Jb, ab) = ends
            parts.append((pa - pb, Ja[:3] - Jb[:3], aa[0] - ab[0]))
            if loop.type == "revolute":
                # u x n = 0 for the axis u of a and n of b, both of which may turn.
                u, n = Ra @ np.array(loop.axis), Rb @ np.array(loop.axis)
                du, dn = cross(wa, u), cross(wb, n)
                turn = -pin.skew(n) @ -pin.skew(u) @ Ja[3:] + pin.skew(u) @ -pin.skew(n) @ Jb[3:]
                ddu = cross(aa[1], u) + cross(wa, du)
                ddn = cross(ab[1], n) + cross(wb, dn)
                bend = cross(ddu, n) + 2.0 * cross(du, dn) + cross(u, ddn)
                parts.append((cross(u, n), turn, bend))
        return tuple(np.concatenate(part) for part in zip(*parts))  # type: ignore[return-value]

    def configuration(self, s: float) -> np.ndarray:
        """q with the joint at s, followed from the last one in steps that keep the branch."""
        q, still = self.q, np.zeros(self.model.nv)
        before = q[self.joint]
        for part in np.linspace(before, s, 2 + int(abs(s - before) / 0.05))[1:]:
            q[self.joint] = part
            for _ in range(30):
                g, G, _ = self._rows(q, still)
                step = np.linalg.lstsq(G[:, self.others], g, rcond=1e-9)[0]
                q[self.others] -= step
                if np.abs(step).max() < 1e-13:
                    break
        return q

    def rates(self, s: float, rate: float) -> np.ndarray:
        """v at s and s'."""
        _, G, _ = self._rows(self.configuration(s), np.zeros(self.model.nv))
        along = np.zeros(self.model.nv)
        along[self.joint] = 1.0
        wanted = -G[:, self.joint]
        along[self.others] = np.linalg.lstsq(G[:, self.others], wanted, rcond=1e-9)[0]
        return along * rate

    def __call__(self, t: float, y: Any) -> list[float]:
        s, rate = y
        along = self.rates(s, 1.0)
        q, v = self.configuration(s), along * rate
        _, G, bias = self._rows(q, v)
        bend = np.zeros(self.model.nv)
        bend[self.others] = np.linalg.lstsq(G[:, self.others], -bias, rcond=1e-9)[0]
        nle = pin.nonLinearEffects(self.model, self.data, q, v)
        M = mass_matrix(self.model, q)
        return [rate, float(along @ (self.force - M @ bend - nle) / (along @ M @ along))]
